"""A real-time flight process with emulated devices. The tests stop, hang and kill the process.

The truth log of the devices contains the coil currents. The service manager's end of the notification socket
receives the message that the flight is ready.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.log import find_segments
from ground.telemetry import Run, read_run, scan
from tests.support.flights import CONFIG

ROOT = CONFIG.parents[1]
HANG_S = 1.0
DRIVEN_A = 1e-3

SLEEPS, SPINS = signal.SIGUSR1, signal.SIGUSR2
"""Signals that hang only the control thread, or all threads by holding the interpreter's lock."""

FLIGHT = f"""
import ctypes, os, signal, time
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
held = ctypes.PyDLL(None)  # unlike CDLL, keeps the interpreter's lock
signal.signal({int(SLEEPS)}, lambda *_: time.sleep({HANG_S}))
signal.signal({int(SPINS)}, lambda *_: held.usleep({round(1e6 * HANG_S)}))
from flight.app.cli import main
"""
_MAIN = "raise SystemExit(main())"


def write_config(folder: Path) -> Path:
    """Write the step demonstration without its camera, so that it starts fast and always drives the coils."""
    text = CONFIG.read_text(encoding="utf-8")
    before, _, rest = text.partition("\ncamera:")
    path = folder / "flight.yaml"
    path.write_text(
        f"{before}\ncamera: none\n\nestimation:{rest.partition('estimation:')[2]}", encoding="utf-8"
    )
    return path


class LiveFlight:
    """One running flight process with its devices and sockets."""

    def __init__(
        self,
        folder: Path,
        config: Path,
        notifications: socket.socket,
        duration: float,
        *more: str,
        before: str = "",
    ) -> None:
        """Start the flight process. The process first runs `before`, a line of Python."""
        self._notifications = notifications
        self.folder = folder / "run"
        words = [
            "run",
            str(config),
            "--realtime",
            "--out",
            str(self.folder),
            "--duration",
            str(duration),
            *more,
        ]
        self.begun_ns = time.monotonic_ns()
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"{FLIGHT}{before}\n{_MAIN}", *words],
            cwd=ROOT,
            env={**os.environ, "NOTIFY_SOCKET": notifications.getsockname(), "WATCHDOG_USEC": "2000000"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_for(self, word: str, patience: float = 30.0) -> int:
        """Wait until the service manager receives `word`; return the monotonic time (ns)."""
        deadline = time.monotonic() + patience
        while (left := deadline - time.monotonic()) > 0.0 and self.process.poll() is None:
            if select.select([self._notifications], [], [], min(left, 0.2))[0]:
                words = self._notifications.recv(4096).decode().split("\n")
                if word in words:
                    return time.monotonic_ns()
        raise AssertionError(f"no {word} within {patience:g} s: {self.end()}")

    def wait_until_driven(self, patience: float = 30.0) -> None:
        """Wait until the coil was driven for the last quarter of a second in the log of true states.

        Raises AssertionError if this takes longer than `patience` s.
        """
        deadline = time.monotonic() + patience
        begun = 0
        while time.monotonic() < deadline:
            data = b"".join(path.read_bytes() for path in find_segments(self.folder, "truth"))
            current = np.abs(scan(data).packets["truth"]["current"][:, 0])
            begun = begun or len(current)
            if len(current) >= begun + 10 and np.all(current[-10:] > DRIVEN_A):
                return
            time.sleep(0.05)
        raise AssertionError(f"the coil was not driven within {patience:g} s: {self.end()}")

    def reported(self, name: str) -> int:
        """Return how many events named `name` the flight log contains."""
        data = b"".join(path.read_bytes() for path in find_segments(self.folder, "flight"))
        return int(np.count_nonzero(scan(data).packets["event"]["name"] == name.encode()))

    def do(self, number: signal.Signals) -> int:
        """Send a signal to the flight process; return the monotonic time (ns) of the signal."""
        self.process.send_signal(number)
        return time.monotonic_ns()

    def guardian(self) -> int:
        """Return the process identifier of the active guardian."""
        for child in self.children():
            if b"hal.guardian" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
        raise AssertionError("no guardian is on watch")

    def children(self) -> list[int]:
        """Return the running child processes of the flight process."""
        tasks = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        return [int(child) for task in tasks for child in task.read_text().split()]

    def end(self) -> str:
        """End the flight process by SIGTERM, and return its standard error."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
        try:
            return self.process.communicate(timeout=20.0)[1] or ""
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.communicate()[1] or ""


@contextmanager
def devices_running(folder: Path) -> Iterator[Path]:
    """Serve emulated devices, started before the flight process, with their truth log in `folder`."""
    facts = folder / "facts.json"
    words = [sys.executable, "-m", "sim_hal", "serve", str(write_config(folder))]
    words += ["--folder", str(folder), "--facts", str(facts)]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE) as server:
        try:
            assert server.stdout is not None
            server.stdout.readline()
            yield facts
        finally:
            server.terminate()


@contextmanager
def live_flight(folder: Path, duration: float = 60.0, *more: str) -> Iterator[LiveFlight]:
    """Start a flight process with the additional arguments `more`, and end it when the context ends."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifications:
        notifications.bind(str(folder / "notify"))
        flight = LiveFlight(folder, write_config(folder), notifications, duration, *more)
        try:
            yield flight
        finally:
            flight.end()


class CoilTruth:
    """True coil currents on the machine's monotonic clock; `current` (n,), A, is the current of coil x."""

    def __init__(self, folder: Path, devices: Path | None = None) -> None:
        """Read the run in `folder`, after the truth log was moved there from the folder `devices`."""
        for path in find_segments(devices, "truth") if devices is not None else ():
            path.rename(folder / path.name)
        self.run: Run = read_run(folder)
        start = self.run["run"][0]
        # Mission time zero of the run is stated in UTC only, so both clocks are read at the same time.
        epoch_ns = int(start["utc_ns"]) - (time.time_ns() - time.monotonic_ns())
        truth = self.run["truth"]
        self.time_ns: npt.NDArray[np.int64] = truth["time_ns"].astype(np.int64) + epoch_ns
        self.current: npt.NDArray[np.float64] = truth["current"][:, 0].astype(np.float64)
        self.epoch_ns = epoch_ns

    def before(self, act_ns: int) -> float:
        """Return the largest current (A) in the quarter of a second before a signal was sent.

        On a busy machine, a late reading makes the flight switch the current off for one or two cycles.
        """
        shortly = (self.time_ns > act_ns - 250_000_000) & (self.time_ns <= act_ns)
        return float(np.abs(self.current[shortly]).max(initial=0.0))

    def zero_after(self, act_ns: int, until_ns: int) -> float:
        """Return the time (s) from a signal until the current was zero and stayed zero until `until_ns`."""
        inside = (self.time_ns >= act_ns) & (self.time_ns <= until_ns)
        driven = np.flatnonzero(inside & (self.current != 0.0))
        first = int(driven[-1]) + 1 if len(driven) else int(np.flatnonzero(inside)[0])
        if first >= len(self.time_ns) or self.time_ns[first] > until_ns:
            return float("inf")
        return float(self.time_ns[first] - act_ns) * 1e-9

    def driven_after(self, act_ns: int) -> float:
        """Return the time (s) from a signal until a coil was driven again."""
        any_current = np.any(self.run["truth"]["current"] != 0.0, axis=1)
        driven = np.flatnonzero((self.time_ns >= act_ns) & any_current)
        return float(self.time_ns[driven[0]] - act_ns) * 1e-9 if len(driven) else float("inf")
