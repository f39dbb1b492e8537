"""The flight as a service: retries of its start, signals that end it, and the release that it proves.

On a board nobody can start a flight, or the link, again: the start is retried until it succeeds. A
configuration that was read whole and judged wrong ends the start: waiting would not help. Everything else may
pass: a disk's error, an address or a folder that is not there yet, a bus that another flight holds. After
each failure all that was opened is closed, with the coils at zero; the start is retried after 0.2 s, and
after twice as long each time, up to 30 s. An exception that is none of these ends the process, and the
service manager starts a fresh one.

The signals that end a flight are SIGINT of Ctrl-C, SIGTERM, and the SIGHUP of a terminal that closes.

`deploy/releases.py` chooses the release before any of this runs, counts its starts in the same file of the
state folder, and passes its name and its reasons in the environment. A flight proves its release after a
minute, and reports why another release was left.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from flight.loop.flight_loop import FlightLoop
from flight.loop.state import LinuxFiles, replace_file, service_folder
from flight.schema.document import UnreadConfigError
from hal.buses.clock import SystemClock
from hal.buses.linux_process import ServiceManager
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.errors import FlightError

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 30.0
_MEAL_NS = 200_000_000
_ATTEMPT_S = 30.0
"""Extension (s) of the start's timeout that each attempt requests from the service manager."""

J = TypeVar("J")
T = TypeVar("T")


class StoppedError(FlightError):
    """A signal came before the flight, or the link, could begin."""


class StartRetry:
    """Waits between the attempts of a start, reports their problems, and feeds the watchdog."""

    def __init__(self, interrupted: Callable[[], bool], clock: Clock | None = None) -> None:
        """`interrupted` returns whether a signal has arrived."""
        self._interrupted = interrupted
        self._clock = clock or SystemClock()
        self._overseer = ServiceManager(os.environ, os.getpid())
        self._failed = 0
        self._waited = 0.0
        self._problem = ""

    def summary(self) -> str:
        """Return the number and the duration of the attempts; empty if the first attempt succeeded."""
        begun = f"begun at try {self._failed + 1} after {self._waited:.1f} s"
        return f"{begun}: {self._problem}" if self._failed else ""

    def wait(self, problem: str, pause: float) -> None:
        """Wait `pause` (s) because of a problem. Raises StoppedError if a signal arrives."""
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


def retried_start(
    judge: Callable[[], J], attempt: Callable[[J, ExitStack], T], stack: ExitStack, retry: StartRetry
) -> T:
    """Return the result of the first attempt that succeeds; `stack` closes what it opened.

    Each attempt reads and validates a configuration by `judge`, and opens it by `attempt`. Raises UsageError
    for an invalid configuration, StoppedError after a signal.
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
        retry.wait(problem, pause)
    raise AssertionError("the pauses do not end")


def pauses() -> Iterator[float]:
    """Yield the pauses between attempts, in s."""
    pause = FIRST_PAUSE_S
    while True:
        yield pause
        pause = min(2.0 * pause, LONGEST_PAUSE_S)


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EndingSignals:
    """A context that ends a flight after the running cycle when a signal arrives.

    A signal during the opening ends the flight at its first cycle, and a second signal interrupts the
    opening. A SIGHUP that the process ignores, as under nohup, stays ignored.
    """

    def __init__(self) -> None:
        self._received: list[int] = []
        self._loop: FlightLoop | None = None
        self._before: dict[signal.Signals, object] = {}

    @property
    def received(self) -> bool:
        """Whether a signal has arrived."""
        return bool(self._received)

    def end(self, loop: FlightLoop) -> None:
        """End this flight when a signal arrives, or at once if a signal has arrived."""
        self._loop = loop
        if self._received:
            self._stop(self._received[0])

    def __enter__(self) -> EndingSignals:
        # Only the main thread receives signals, so they do not end a flight in another thread.
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in _ENDING:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # as `signal` returned it

    def _receive(self, number: int, _: FrameType | None) -> None:
        self._received.append(number)
        if self._loop is not None:
            self._stop(number)
        elif len(self._received) > 1:
            raise KeyboardInterrupt

    def _stop(self, number: int) -> None:
        assert self._loop is not None
        self._loop.stop(f"stopped by {signal.Signals(number).name}")


NAME, NOTE = "KNIGHTCUBE_RELEASE", "KNIGHTCUBE_RELEASE_NOTE"
TRIALS = "releases.json"
PROVEN_NS = 60 * SECOND_NS
"""Flight time (ns) after which a release is proven: power cuts and crashes no longer count against it."""
_KEPT = 4


class FlownRelease:
    """The release of this flight; without a name the flight proves no release."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Read the release's name and note from the process's environment."""
        self._name = environment.get(NAME, "")
        self.note = environment.get(NOTE, "")
        folder = service_folder(environment)
        self._path = folder / TRIALS if folder is not None and self._name else None
        self._done = False

    def serve(self, clock: Clock, stack: ExitStack) -> None:
        """Prove the release after `PROVEN_NS`, outside the loop, until `stack` is closed."""
        if self._path is not None:
            stack.callback(clock.ticker("release", PROVEN_NS, self.prove).stop)

    def prove(self) -> None:
        """Record that this release has flown; a failed write is retried a minute later."""
        if self._path is None or self._done:
            return
        with suppress(OSError):
            proven = [name for name in _proven(self._path) if name != self._name]
            self._write([*proven, self._name][-_KEPT:])
            self._done = True

    def end(self) -> None:
        """Reset the count of starts of a release that ends by itself, proven or not."""
        if self._path is not None:
            with suppress(OSError):
                self._write(_proven(self._path))

    def _write(self, proven: list[str]) -> None:
        assert self._path is not None
        text = json.dumps({"starts": {}, "proven": proven})
        replace_file(LinuxFiles(), self._path, text.encode())


def _proven(path: Path) -> list[str]:
    """Return the proven releases; an empty list if the file is missing or damaged."""
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        kept: dict[str, Any] = json.loads(LinuxFiles().read(path) or b"")
        return [str(name) for name in kept["proven"]]
    return []
