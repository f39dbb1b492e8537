"""Tries the start of a flight, or of the link, until it succeeds: on a board nobody can start it again.

A configuration that was read whole and judged wrong ends the start: waiting would not help. Everything else
may pass: a disk's error, an address or a folder that is not there yet, a bus that another flight holds. After
each failure all that was opened is closed, with the coils at zero; the start is tried again after 0.2 s, and
after twice as long each time, up to 30 s. An exception that is none of these ends the process, and the
service manager starts a fresh one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import TypeVar

from flight.schema.errors import UnreadConfigError
from hal.buses.clock import SystemClock
from hal.buses.service_manager import ServiceManager
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.errors import FlightError

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 30.0
_MEAL_NS = 200_000_000
_ATTEMPT_S = 30.0
"""The service manager is asked for this time for each attempt."""

J = TypeVar("J")
T = TypeVar("T")


class StoppedError(FlightError):
    """A signal came before the flight, or the link, could begin."""


class Patience:
    """Waits between the attempts of a start: reports, feeds the watchdog, notices signals."""

    def __init__(self, interrupted: Callable[[], bool], clock: Clock | None = None) -> None:
        """Take a function that says whether a signal has come."""
        self._interrupted = interrupted
        self._clock = clock or SystemClock()
        self._overseer = ServiceManager(os.environ, os.getpid())
        self._failed = 0
        self._waited = 0.0
        self._problem = ""

    def summary(self) -> str:
        """Return how the start went, empty when it succeeded at once."""
        begun = f"begun at try {self._failed + 1} after {self._waited:.1f} s"
        return f"{begun}: {self._problem}" if self._failed else ""

    def wait(self, problem: str, pause: float) -> None:
        """Wait `pause` s because of a problem. Raises StoppedError when a signal comes."""
        self._failed += 1
        self._waited += pause
        self._problem = problem
        with suppress(OSError):
            sys.stderr.write(f"flight: cannot begin yet: {problem}; tried again in {pause:g} s\n")
            sys.stderr.flush()
        self._overseer.status(f"waiting to begin, {self._failed} tries: {problem}")
        until_ns = self._clock.now_ns() + round(pause * SECOND_NS)
        while not self._interrupted() and (now_ns := self._clock.now_ns()) < until_ns:
            self._overseer.feed_watchdog()
            self._overseer.extend_start(_ATTEMPT_S)
            self._clock.sleep_until_ns(min(now_ns + _MEAL_NS, until_ns))
        if self._interrupted():
            raise StoppedError(f"stopped before it could begin: {problem}")

    def close(self) -> None:
        """Close the line to the service manager. Safe to call twice."""
        self._overseer.close()


def patiently(
    judge: Callable[[], J], attempt: Callable[[J, ExitStack], T], stack: ExitStack, patience: Patience
) -> T:
    """Return the result of the first attempt that succeeds; `stack` closes what that one opened.

    Each attempt begins with `judge`, which reads a configuration and judges it, and gives it to `attempt`.
    Raises UsageError for one that was judged wrong, StoppedError.
    """
    for pause in pauses():
        try:
            judged = judge()
        except (UnreadConfigError, OSError) as error:
            problem = str(error)
        else:
            try:
                with ExitStack() as trial:
                    result = attempt(judged, trial)
                    stack.push(trial.pop_all())
                    return result
            except (FlightError, DeviceError, OSError) as error:
                problem = str(error)
        patience.wait(problem, pause)
    raise AssertionError("the pauses do not end")


def pauses() -> Iterator[float]:
    """Yield the pauses between attempts, in s."""
    pause = FIRST_PAUSE_S
    while True:
        yield pause
        pause = min(2.0 * pause, LONGEST_PAUSE_S)
