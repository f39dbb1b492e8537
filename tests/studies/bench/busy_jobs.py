"""Workers that are never idle: each repeats its last job until the next job arrives.

`python -m tests.studies.bench executive --busy` uses them, because ordinary workers are mostly idle: a
satellite plans at most every 10 s, and emulating a camera frame takes longer than processing it. The flight's
own jobs are repeated, and the results of the repetitions are discarded. A new job waits for the end of the
running repetition. Modules are imported inside the functions, because the functions run in the workers.
"""

from __future__ import annotations

import copy
import ctypes
import importlib
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from flight.loop.worker import give_back

if TYPE_CHECKING:
    from flight.loop.executive import Worker

_M_ARENA_MAX = -8  # malloc.h


class Again:
    """Runner of the jobs of one module, which repeats the last job until a new job arrives."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._goes = threading.Event()
        self._last: Any = None

    def __call__(self, module: str, argument: Any) -> Any:
        run = importlib.import_module(module).run
        _one_heap()
        self._goes.clear()
        with self._turn:
            result = run(argument)
            # The caller may overwrite the job's arrays once the result is sent.
            begun, self._last = self._last is not None, copy.deepcopy(argument)
        self._goes.set()
        if not begun:
            threading.Thread(target=self._repeat, args=(run,), daemon=True).start()
        return result

    def rest(self) -> None:
        """Pause the repetition of the last job until the next job arrives."""
        self._goes.clear()

    def _repeat(self, run: Callable[[Any], Any]) -> None:
        while self._goes.wait():
            with self._turn, suppress(Exception):
                run(self._last)
            give_back()  # as a worker does


def _one_heap() -> None:
    """Make all threads of this process use one heap, as in a worker, which has one thread."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


_again = Again()


def plan_testbed(job: Any) -> Any:
    """Plan for the testbed."""
    return _again("knightcube.gnc.guidance.vmc", job)


def plan_orbit(job: Any) -> Any:
    """Plan for the satellite."""
    return _again("knightcube.gnc.control.pointing_job", job)


def see(job: Any) -> Any:
    """Process a star camera frame."""
    return _again("knightcube.vision.frame_job", job)


def see_wide(job: Any) -> Any:
    """Process the frames of the horizon cameras."""
    return _again("knightcube.vision.horizon_camera_job", job)


BUSY: dict[str, Callable[[Any], Any]] = {
    "knightcube.gnc.guidance.vmc": plan_testbed,
    "knightcube.gnc.control.pointing_job": plan_orbit,
    "knightcube.vision.frame_job": see,
    "knightcube.vision.horizon_camera_job": see_wide,
}
"""Functions that repeat the jobs of a module, by the name of the module."""


def keep_busy() -> None:
    """Make the flight in this process use workers that are never idle."""
    from flight.app import flight as opening  # noqa: PLC0415
    from flight.app.flight import workers as made  # noqa: PLC0415

    def workers(*arguments: Any) -> list[Worker]:
        return [replace(worker, function=BUSY[worker.function.__module__]) for worker in made(*arguments)]

    setattr(opening, "workers", workers)  # noqa: B010 - a name that it imports
