"""Files of the product that one control cycle, the opening of a flight, and a star fix enter.

A file counts if one of its functions is called; the execution of a module or of a class body does not count.
The flight is the step demonstration in lock-step. Its emulated devices stand for the far end of the wires:
`sim_hal`, and whatever `sim_hal` calls, does not count. A job that the lock-step runner runs in the calling
thread belongs to a worker and does not count either.
"""

from __future__ import annotations

import inspect
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

import numpy as np

from flight.app import flight as application
from flight.app.run import RunRequest
from flight.loop.control_cycle import ControlCycle
from flight.loop.executive import Cycle, LockStepRunner
from flight.loop.flight_loop import FlightLoop
from knightcube import StarTracker
from sim_hal.star_camera import StarCameraModel
from tests.support.scenes import exposed

ROOT = Path(__file__).resolve().parents[3]
LIMITS = {"control cycle": 30, "opening of a flight": 51, "star fix": 20}
"""Largest number of files of each piece of work; the aims are 30, 45 and 25."""
_FIRST, _LAST = 400, 440
"""Control cycles that are measured: one second of steady flight, after the first plan."""


class Touched:
    """The files of the product entered while a block is measured, relative to `ROOT`."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self._outside = 0  # nested calls into and below code that does not count

    def _profile(self, frame: FrameType, event: str, _: Any) -> None:
        if event not in {"call", "return"}:
            return
        code = frame.f_code
        outside = code.co_filename.startswith(f"{ROOT}/sim_hal/") or code is LockStepRunner.submit.__code__
        if event == "return":
            self._outside -= bool(self._outside and outside)
            return
        self._outside += outside
        if self._outside or not code.co_flags & inspect.CO_OPTIMIZED:
            return
        if code.co_filename.startswith((f"{ROOT}/flight/", f"{ROOT}/hal/", f"{ROOT}/knightcube/")):
            self.files.add(code.co_filename.removeprefix(f"{ROOT}/"))

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Collect the files that the block enters."""
        self._outside = 0
        sys.setprofile(self._profile)
        try:
            yield
        finally:
            sys.setprofile(None)


def of_flight() -> dict[str, set[str]]:
    """Return the files of opening a flight, from its request to its first cycle, and of a control cycle.

    The control cycle is the one that enters the most files in a second of flight.
    """
    opening, cycles = Touched(), [Touched()]
    fly, run = FlightLoop.run, ControlCycle.run

    def fly_on(loop: FlightLoop, epoch_ns: int, label: Any) -> str:
        sys.setprofile(None)
        return fly(loop, epoch_ns, label)

    def run_measured(control: ControlCycle, cycle: Cycle) -> Any:
        if not _FIRST <= cycle.slot < _LAST:
            return run(control, cycle)
        cycles.append(Touched())
        with cycles[-1].measured():
            return run(control, cycle)

    with (
        patch.object(FlightLoop, "run", fly_on),
        patch.object(ControlCycle, "run", run_measured),
        tempfile.TemporaryDirectory() as folder,
        opening.measured(),
    ):
        configuration, duration = ROOT / "config/step_demo.yaml", 0.025 * (_LAST + 1)
        application.fly(RunRequest(configuration, Path(folder) / "run", duration=duration))
    largest = max((cycle.files for cycle in cycles), key=len)
    return {"control cycle": largest, "opening of a flight": opening.files}


def of_star_fix() -> dict[str, set[str]]:
    """Return the files between an image of stars at rest and its attitude."""
    camera = StarCameraModel(field_of_view=np.radians(12.0))
    scene = exposed(camera, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), 0.2, np.random.default_rng(1))
    touched, tracker = Touched(), StarTracker(fov_deg=12.0)
    with touched.measured():
        solution = tracker.solve(scene.pixels)
    assert solution, solution.reason
    return {"star fix": touched.files}


def measure() -> dict[str, set[str]]:
    """Return the files that each piece of work in `LIMITS` enters."""
    return of_flight() | of_star_fix()
