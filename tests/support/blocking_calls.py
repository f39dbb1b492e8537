"""Lists the system calls that the control loop's thread makes during a flight.

`python -m tests.support.blocking_calls CONFIG OUT DEVICES` runs a flight on emulated devices in real time.
The program prints a JSON list of all calls of C functions that may block; each entry names the product
function that makes the call. Methods of non-blocking sockets are omitted. Calls at the start and at the end
of the flight may block, and are omitted too.
"""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any
from unittest.mock import patch

from flight.app.cli import main
from flight.loop.flight_loop import ControlCycle
from tests.support.flights import CONFIG

ROOT = str(CONFIG.parents[1])
MODULES = frozenset(
    {"posix", "time", "select", "_socket", "_posixsubprocess", "_io", "io", "fcntl", "mmap", "_thread"}
)
"""Modules of the C functions, and of the types with C methods, that may wait in the operating system."""
HARMLESS = frozenset({"monotonic_ns", "monotonic", "time_ns", "time", "perf_counter", "perf_counter_ns"})
FIRST, LAST = 40, 200
"""First and last control cycle of the interval in which calls are recorded."""


class BlockingCalls:
    """Recorder of the calls that may block, in the thread that starts it."""

    def __init__(self) -> None:
        self.found: set[tuple[str, str]] = set()

    def start(self) -> None:
        """Start to record calls."""
        sys.setprofile(self._profile)

    def stop(self) -> None:
        """Stop the recording of calls."""
        sys.setprofile(None)

    def _profile(self, frame: FrameType, event: str, called: Any) -> None:
        if event != "c_call":
            return
        name, owner = called.__name__, getattr(called, "__self__", None)
        if isinstance(owner, type(sys)) or owner is None:
            module, kind = called.__module__, ""
        else:
            modules = [base.__module__ for base in type(owner).__mro__]
            module, kind = next((m for m in modules if m in MODULES), ""), f"{type(owner).__name__}."
        if module not in MODULES or name in HARMLESS:
            return
        if isinstance(owner, socket.socket) and owner.gettimeout() == 0.0:
            return
        self.found.add((_caller(frame), f"{module}.{kind}{name}"))


def _caller(frame: FrameType | None) -> str:
    """Return the innermost function of the flight software on the stack."""
    while frame is not None:
        path = frame.f_code.co_filename.removeprefix(f"{ROOT}/")
        if path.startswith(("flight/", "hal/", "knightcube/")):
            return f"{path}:{frame.f_code.co_qualname}"
        frame = frame.f_back
    return ""


def run(words: Sequence[str]) -> int:
    """Run a flight, and print its calls that may block."""
    config, out, devices = words
    calls, fly = BlockingCalls(), ControlCycle.run

    def run_watched(control: ControlCycle, cycle: Any) -> Any:
        if FIRST <= cycle.slot < LAST:
            calls.start()
        else:
            calls.stop()
        return fly(control, cycle)

    with patch.object(ControlCycle, "run", run_watched):
        options = ["--realtime", "--out", out, "--devices", devices, "--duration", str(0.025 * (LAST + 20))]
        status = main(["run", config, *options])
    sys.stdout.write(json.dumps(sorted(calls.found)) + "\n")
    return status


if __name__ == "__main__":
    raise SystemExit(run(sys.argv[1:]))
