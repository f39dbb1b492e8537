"""From exec to READY and to the first coil command: `python -m tests.studies.bench startup [RUNS]`.

In real time, on emulated devices that are there before, as a board's are, and besides on devices that the
flight starts itself (`flight run --realtime`). READY is taken at the service manager's socket; the first
command is the coil's first current in the devices' own log (25 ms apart).
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.hal.guardian.live_flight import CoilTruth, LiveFlight, devices_running, live_flight

READY_LIMIT, COMMAND_LIMIT = 1.5, 2.0
DURATION = 1.5


def main(arguments: Sequence[str]) -> int:
    """Print each start; fail when the median exceeds a limit."""
    runs = int(arguments[0]) if arguments else 5
    failed = False
    for name, start in (
        ("devices running", _start_beside_devices),
        ("devices started too", _start_devices_too),
    ):
        starts = []
        for _ in range(runs):
            with tempfile.TemporaryDirectory() as folder:
                starts.append(start(Path(folder)))
        ready, command, processor = np.median(starts, axis=0)
        slowest = np.max(starts, axis=0)
        sys.stdout.write(
            f"{name:20} median (slowest) of {runs}: READY {ready:.2f} ({slowest[0]:.2f}) s of {READY_LIMIT}, "
            f"first command {command:.2f} ({slowest[1]:.2f}) s of {COMMAND_LIMIT}, "
            f"processor until READY {processor:.2f} s\n"
        )
        if start is _start_beside_devices:
            failed = ready > READY_LIMIT or command > COMMAND_LIMIT
    return int(failed)


def _start_beside_devices(folder: Path) -> tuple[float, float, float]:
    """Return READY, the first command and the processor's time until READY, all in s from exec."""
    devices = folder / "devices"
    devices.mkdir()
    with devices_running(devices) as facts, live_flight(folder, DURATION, "--devices", str(facts)) as flight:
        ready, processor = _time_to_ready(flight)
    return ready, CoilTruth(flight.folder, devices).driven_after(flight.begun_ns), processor


def _start_devices_too(folder: Path) -> tuple[float, float, float]:
    """Return the same where the flight starts its devices itself."""
    with live_flight(folder, DURATION) as flight:
        ready, processor = _time_to_ready(flight)
    return ready, CoilTruth(flight.folder).driven_after(flight.begun_ns), processor


def _time_to_ready(flight: LiveFlight) -> tuple[float, float]:
    """Return the time from exec to READY and the processor's time until then, s, once the flight is over.

    The second is what the start costs on any machine that is busy with other things too.
    """
    ready_ns = flight.wait_for("READY=1")
    words = Path(f"/proc/{flight.process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    processor = sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")
    flight.process.wait(timeout=20.0)
    return (ready_ns - flight.begun_ns) * 1e-9, processor
