"""Stops, hangs and kills one flight process in several ways, and measures how long coil current flows."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from tests.hal.guardian.live_flight import HANG_S, SLEEPS, SPINS, CoilTruth, live_flight

STOPPED_S = 1.0
UNGUARDED = ("SIGSTOP, the guardian too", "SIGSTOP, the guardian too, once more")
"""The same action twice, because the last command before a stop can be a zero current."""
_CALM_S = 1.2
_PATIENCE_S = 30.0  # longest time until a new guardian is ready


@dataclass(frozen=True)
class ProcessFault:
    """Result of one test action, `act`: a process was stopped, hung or killed.

    Times are in s, and the current is in A. `recovered` is the time from the end of the action, or None if
    the process died.
    """

    act: str
    current: float
    zero_after: float
    recovered: float | None


@dataclass(frozen=True)
class Campaign:
    """Results of all test actions, truth and events of the run, and the guardian processes in order."""

    faults: list[ProcessFault]
    truth: CoilTruth
    guardians: list[int]
    guardian_lost_ns: list[int]
    left_over: list[int]


def disturb_in_every_way(folder: Path) -> Campaign:
    """Stop and hang the flight process in two ways, then kill and stop the guardian, then kill the flight."""
    times: list[tuple[str, int, int | None]] = []
    guardians: list[int] = []
    lost_ns: list[int] = []
    with live_flight(folder) as flight:
        flight.wait_for("READY=1")
        flight.wait_until_driven()
        begin_ns = flight.do(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        times.append(("SIGSTOP", begin_ns, flight.do(signal.SIGCONT)))
        time.sleep(_CALM_S)
        for name, number in (("hang, other threads alive", SLEEPS), ("hang, interpreter held", SPINS)):
            flight.wait_until_driven()
            begin_ns = flight.do(number)
            time.sleep(HANG_S + _CALM_S)
            times.append((name, begin_ns, begin_ns + round(HANG_S * 1e9)))
        for name in UNGUARDED:
            flight.wait_until_driven()
            # Without a guardian, the devices keep driving the coil after the end of the flight process.
            os.kill(flight.guardian(), signal.SIGSTOP)
            begin_ns = flight.do(signal.SIGSTOP)
            time.sleep(STOPPED_S)
            os.kill(flight.guardian(), signal.SIGCONT)
            times.append((name, begin_ns, flight.do(signal.SIGCONT)))
            time.sleep(_CALM_S)
        for number in (signal.SIGKILL, signal.SIGSTOP):
            guardians.append(flight.guardian())
            before = flight.reported("guardian-ready")
            os.kill(guardians[-1], number)
            lost_ns.append(time.monotonic_ns())
            time.sleep(2.5)
            deadline = time.monotonic() + _PATIENCE_S
            while flight.reported("guardian-ready") == before and time.monotonic() < deadline:
                time.sleep(0.1)
        guardians.append(flight.guardian())
        children = flight.children()
        flight.wait_until_driven()
        times.append(("kill -9", flight.do(signal.SIGKILL), None))
        flight.process.wait()
        time.sleep(_CALM_S)
        left_over = [child for child in guardians if lives(child)]
        _end_devices(children)
    truth = CoilTruth(flight.folder)
    faults = [_measured(truth, *act) for act in times]
    return Campaign(faults, truth, guardians, lost_ns, left_over)


def _measured(truth: CoilTruth, name: str, begin_ns: int, end_ns: int | None) -> ProcessFault:
    until_ns = end_ns if end_ns is not None else begin_ns + 1_000_000_000
    recovered = None if end_ns is None else truth.driven_after(end_ns)
    return ProcessFault(name, truth.before(begin_ns), truth.zero_after(begin_ns, until_ns), recovered)


def _end_devices(children: list[int]) -> None:
    """End the emulated devices, and wait until they have written their log."""
    for child in children:
        command = Path(f"/proc/{child}/cmdline")
        if command.exists() and b"sim_hal" in command.read_bytes():
            os.kill(child, signal.SIGTERM)
            deadline = time.monotonic() + 5.0
            while command.exists() and time.monotonic() < deadline:
                time.sleep(0.02)


def lives(process: int) -> bool:
    """Return whether a process runs. A zombie process has no command line."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    except (FileNotFoundError, ProcessLookupError):
        return False
