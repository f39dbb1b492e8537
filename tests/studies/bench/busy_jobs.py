"""Workers that are never idle: each does its last job again and again until the next one comes.

For `python -m tests.studies.bench executive --busy`: a satellite plans every 10 s at most, and to emulate a
camera's frame costs more than to work on it. What is repeated is the flight's own work on its own jobs; the
results are dropped. A new job waits for the repetition that runs. Imports are made late, as these functions
are the workers'.
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
    """Runs the job of one module, and the last one again while there is no other."""

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
            # What the job holds may be overwritten once its result is sent.
            begun, self._last = self._last is not None, copy.deepcopy(argument)
        self._goes.set()
        if not begun:
            threading.Thread(target=self._repeat, args=(run,), daemon=True).start()
        return result

    def rest(self) -> None:
        """Do nothing again until the next job."""
        self._goes.clear()

    def _repeat(self, run: Callable[[Any], Any]) -> None:
        while self._goes.wait():
            with self._turn, suppress(Exception):
                run(self._last)
            give_back()  # as a worker does


def _one_heap() -> None:
    """Have all threads of this process use one heap, as a worker's only thread does."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


_again = Again()


def plan_testbed(job: Any) -> Any:
    """Plan for the testbed."""
    return _again("knightcube.gnc.guidance.one_axis.vmc", job)


def plan_orbit(job: Any) -> Any:
    """Plan for the satellite."""
    return _again("knightcube.gnc.control.pointing_job", job)


def see(job: Any) -> Any:
    """Work on a star camera's frame."""
    return _again("knightcube.vision.frame_job", job)


def see_wide(job: Any) -> Any:
    """Work on the wide cameras' frames."""
    return _again("knightcube.vision.horizon_camera_job", job)


BUSY: dict[str, Callable[[Any], Any]] = {
    "knightcube.gnc.guidance.one_axis.vmc": plan_testbed,
    "knightcube.gnc.control.pointing_job": plan_orbit,
    "knightcube.vision.frame_job": see,
    "knightcube.vision.horizon_camera_job": see_wide,
}
"""By the module of the job that is done again."""


def keep_busy() -> None:
    """Have the flight that this process opens keep its workers busy."""
    from flight.app import flight as opening  # noqa: PLC0415
    from flight.app.flight import workers as made  # noqa: PLC0415

    def workers(*arguments: Any) -> list[Worker]:
        return [replace(worker, function=BUSY[worker.function.__module__]) for worker in made(*arguments)]

    setattr(opening, "workers", workers)  # noqa: B010 - a name that it imports
