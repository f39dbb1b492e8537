"""The flight as a service: retries of its start, signals, proof of its software release, and supervisors.

Nobody can restart a flight or the link on a board, so the start is retried until it succeeds. An invalid
configuration ends the start, because waiting would not help. Other problems may pass: a disk error, a missing
address or folder, or a bus that another flight uses. After each failed attempt, everything that was opened is
closed, with the coils at zero. The first pause before the next attempt is 0.2 s, and each later pause is
twice as long, up to 30 s. An unexpected exception ends the process, and the service manager starts a new
process.

The signals that end a flight are SIGINT (Ctrl-C), SIGTERM, and SIGHUP when a terminal closes.

Before the flight, the script `deploy/releases.py` chooses the software release, counts its starts in a file
of the state folder, and passes its name and the reasons of the choice in the environment. After a minute of
flight, the release is recorded as proven, and the flight reports why another release was abandoned.

The external supervisors of the flight are the guardian of the coils and the service manager. The loop calls
`beat` at the end of every control cycle without an error, and `feed` while nothing is stalled. A running loop
does not prove that commands reach the coils, so heartbeats are passed to the guardian only while the job of
the coil driver runs. With the first heartbeat, READY is reported to the service manager, because the devices
are open and the loop runs.

When large memory blocks are freed, glibc raises its threshold for mapping blocks separately (mallopt(3)).
Frames are then allocated on the heap, where small blocks cause fragmentation, so that the heap grows. Fixed
thresholds prevent the growth of the heap; a C library other than glibc ignores them.
"""

from __future__ import annotations

import ctypes
import gc
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

from flight.link import events
from flight.link.events import EventKind
from flight.link.telemetry.log import Recorder
from flight.loop.facts import EventLog
from flight.loop.flight_loop import FlightLoop
from flight.loop.state import LinuxFiles, replace_file, service_folder
from flight.schema.document import UnreadConfigError
from hal.buses import linux_process
from hal.buses.clock import SystemClock
from hal.buses.linux_process import ServiceManager
from hal.drivers.coils import DEVICE as COILS
from hal.guardian import GuardianLine
from hal.interfaces.errors import DeviceError
from hal.interfaces.guardian import CoilGuardian, GuardianNews, Overseer
from hal.interfaces.wires import SECOND_NS, Clock, Rig, Ticker
from knightcube.errors import FlightError

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 30.0
_MEAL_NS = 200_000_000
_ATTEMPT_S = 30.0
"""Extension (s) of the start's timeout that each attempt requests from the service manager."""

J = TypeVar("J")
T = TypeVar("T")


class StoppedError(FlightError):
    """A signal arrived before the flight or the link had begun."""


class StartRetry:
    """Waits between the attempts of a start, reports their problems, and triggers the watchdog."""

    def __init__(self, interrupted: Callable[[], bool], clock: Clock | None = None) -> None:
        """`interrupted` is a function that returns whether a signal has arrived."""
        self._interrupted = interrupted
        self._clock = clock or SystemClock()
        self._overseer = ServiceManager(os.environ, os.getpid())
        self._failed = 0
        self._waited = 0.0
        self._problem = ""

    def summary(self) -> str:
        """Return number and duration of the attempts; empty if the first attempt succeeded."""
        begun = f"begun at attempt {self._failed + 1} after {self._waited:.1f} s"
        return f"{begun}: {self._problem}" if self._failed else ""

    def wait(self, problem: str, pause: float) -> None:
        """Wait for `pause` s because of a problem. Raises StoppedError if a signal arrives."""
        self._failed += 1
        self._waited += pause
        self._problem = problem
        with suppress(OSError):
            sys.stderr.write(f"flight: cannot begin yet: {problem}; tried again in {pause:g} s\n")
            sys.stderr.flush()
        self._overseer.status(f"waiting to begin, {self._failed} attempts: {problem}")
        until_ns = self._clock.now_ns() + round(pause * SECOND_NS)
        while not self._interrupted() and (now_ns := self._clock.now_ns()) < until_ns:
            self._overseer.feed_watchdog()
            self._overseer.extend_start(_ATTEMPT_S)
            self._clock.sleep_until_ns(min(now_ns + _MEAL_NS, until_ns))
        if self._interrupted():
            raise StoppedError(f"stopped before it could begin: {problem}")

    def close(self) -> None:
        """Close the connection to the service manager. Safe to call twice."""
        self._overseer.close()


def retried_start(
    judge: Callable[[], J], attempt: Callable[[J, ExitStack], T], stack: ExitStack, retry: StartRetry
) -> T:
    """Return the result of the first attempt that succeeds; `stack` closes what it has opened.

    Each attempt reads and validates a configuration with `judge`, and opens it with `attempt`. Raises
    UsageError for an invalid configuration, and StoppedError after a signal.
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
    """Yield the pauses (s) between the attempts of a start."""
    pause = FIRST_PAUSE_S
    while True:
        yield pause
        pause = min(2.0 * pause, LONGEST_PAUSE_S)


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EndingSignals:
    """A context in which a signal ends the flight after the running cycle.

    A signal during the opening ends the flight at its first cycle; a second signal interrupts the opening. If
    the process ignores SIGHUP, as under nohup, SIGHUP stays ignored.
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
        """End this flight when a signal arrives, or at once if a signal has already arrived."""
        self._loop = loop
        if self._received:
            self._stop(self._received[0])

    def __enter__(self) -> EndingSignals:
        # Signal handlers can be set only in the main thread; a flight in another thread ignores signals.
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
"""Flight time (ns) after which a release is proven, so that later crashes no longer count against it."""
_KEPT = 4


class FlownRelease:
    """The software release that flies; without a name, no release is recorded as proven."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Read name and note of the release from the environment of the process."""
        self._name = environment.get(NAME, "")
        self.note = environment.get(NOTE, "")
        folder = service_folder(environment)
        self._path = folder / TRIALS if folder is not None and self._name else None
        self._done = False

    def serve(self, clock: Clock, stack: ExitStack) -> None:
        """Record the release as proven after `PROVEN_NS`, outside the loop, until `stack` is closed."""
        if self._path is not None:
            stack.callback(clock.ticker("release", PROVEN_NS, self.prove).stop)

    def prove(self) -> None:
        """Record this release as proven; a failed write is retried a minute later."""
        if self._path is None or self._done:
            return
        with suppress(OSError):
            proven = [name for name in _proven(self._path) if name != self._name]
            self._write([*proven, self._name][-_KEPT:])
            self._done = True

    def end(self) -> None:
        """Reset the count of starts of the release, because it ended by itself."""
        if self._path is not None:
            with suppress(OSError):
                self._write(_proven(self._path))

    def _write(self, proven: list[str]) -> None:
        assert self._path is not None
        text = json.dumps({"starts": {}, "proven": proven})
        replace_file(LinuxFiles(), self._path, text.encode())


def _proven(path: Path) -> list[str]:
    """Return the proven releases, or an empty list if the file is missing or damaged."""
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        kept: dict[str, Any] = json.loads(LinuxFiles().read(path) or b"")
        return [str(name) for name in kept["proven"]]
    return []


LARGE_BYTES = 256 * 1024
"""Size (bytes) from which a block is mapped separately, and returned to the kernel when it is freed."""
SPARE_BYTES = 4 * 1024 * 1024
"""Free memory (bytes) kept at the top of the heap, so that control cycles seldom call the kernel."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h


def settle_memory() -> None:
    """Set the heap's thresholds, and replace the automatic garbage collection by a `Collector`.

    The function `settle_memory` is called when the flight has been built. All present objects are exempt from
    garbage collection, because examining all modules and tasks would take tens of ms in a control cycle.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, SPARE_BYTES)
    gc.collect()
    gc.freeze()
    gc.disable()


class Collector:
    """Collects the garbage since its last call, and exempts the surviving objects from later collections.

    Only failures create garbage that needs a collection. If the collector is called every few seconds, a
    collection examines few objects and takes at most 2 ms. The first call only exempts the objects that the
    start of the flight created.
    """

    def __init__(self) -> None:
        self._begun = False

    def __call__(self) -> None:
        """Collect."""
        if self._begun:
            gc.collect()
        self._begun = True
        gc.freeze()


_THROTTLE_NS = 1_000_000_000
"""Shortest time (ns) between events of one kind; a guardian is replaced at most once per second."""
_UNSERVED_NS = 150_000_000
"""Longest gap (ns), three periods, of the coil driver's job for which heartbeats are passed on."""

_EVENTS = {
    GuardianNews.LOST: events.GUARDIAN_LOST,
    GuardianNews.READY: events.GUARDIAN_READY,
    GuardianNews.ACTED: events.GUARDIAN_ACTED,
    GuardianNews.FAILED: events.GUARDIAN_BLIND,
}


class Supervision:
    """Passes heartbeats to the guardian, and reports the guardian's state changes as events."""

    def __init__(
        self,
        guardian: CoilGuardian,
        overseer: Overseer,
        clock: Clock,
        recorder: Recorder,
        status: str,
        coils: Ticker,
        settle: Callable[[], None] | None = None,
    ) -> None:
        """Connect the supervisors with `coils`, the job of the coil driver.

        The service manager shows the text `status` once the flight is ready. The function `settle` is called
        once, when all parts of the flight exist, before READY is reported.
        """
        self._guardian = guardian
        self._overseer = overseer
        self._clock = clock
        # A separate event log is used, because the loop does not exist yet, and no event needs a reaction.
        self._events = EventLog(recorder.event, _THROTTLE_NS)
        self._status = status
        self._coils = coils
        self._settle = settle
        self._ready = False
        self._notes: list[tuple[EventKind, str]] = []

    def note(self, kind: EventKind, text: str) -> None:
        """Store an event of the start, which is reported when the flight has begun."""
        self._notes.append((kind, text))

    def beat(self) -> None:
        """Pass a heartbeat to the guardian, unless the job of the coil driver is stalled."""
        if self._clock.now_ns() - self._coils.served_ns > _UNSERVED_NS:
            return
        self._guardian.beat()
        if not self._ready:
            self._ready = True
            if self._settle is not None:
                self._settle()
            self._overseer.ready(self._status)

    def close(self) -> None:
        """Write the events that are still held back."""
        self._events.flush(self._clock.now_ns())

    def feed(self) -> None:
        """Trigger the watchdog, restart the guardian if needed, and report its state changes."""
        self._overseer.feed_watchdog()
        now_ns = self._clock.now_ns()
        notes = self._notes + [(_EVENTS[news], news.value) for news in self._guardian.tend(now_ns)]
        self._notes.clear()
        for kind, text in notes:
            self._events.report(kind, now_ns, text)


CONTROL_PRIORITY = 50
"""SCHED_FIFO priority of the control thread and of the coil driver's thread."""
NEXT_PRIORITY = CONTROL_PRIORITY - 10
"""SCHED_FIFO priority of the other threads of the control process."""
_COLLECT_NS = 2 * SECOND_NS


def start_guardian(rig: Rig, stack: ExitStack) -> GuardianLine | None:
    """Start the guardian before any coil can be energised, and close it last, with the coils off."""
    if rig.reach is None:
        return None
    guardian = GuardianLine(rig.reach)
    stack.callback(guardian.close)
    return guardian


def supervise(guardian: GuardianLine, clock: Clock, recorder: Recorder, stack: ExitStack) -> Supervision:
    """Connect the supervisors, and raise the priority of the control loop and the coil driver."""
    overseer = ServiceManager(os.environ, os.getpid())
    stack.callback(overseer.close)
    first = [thread for thread in threading.enumerate() if thread.name == COILS]
    obtained = linux_process.obtain([0, *(thread.native_id or 0 for thread in first)], CONTROL_PRIORITY)
    stack.callback(linux_process.relinquish)
    stack.callback(overseer.stopping)
    coils = next(ticker for ticker in clock.tickers if ticker.name == COILS)

    stack.callback(gc.enable)
    collector = clock.ticker("garbage", _COLLECT_NS, Collector())
    stack.callback(collector.stop)

    def settle() -> None:
        settle_memory()
        if obtained.priority:
            prioritise_other_threads()

    status = f"flying; {obtained}"
    supervision = Supervision(guardian, overseer, clock, recorder, status, coils, settle)
    stack.callback(supervision.close)
    supervision.note(events.REAL_TIME_REFUSED if obtained.refusals else events.REAL_TIME, str(obtained))
    return supervision


def prioritise_other_threads() -> None:
    """Give the other threads of this process (log, serial line, disk) the next lower priority.

    A thread with a low priority could be preempted while it holds the interpreter's lock, which would block
    the control thread for a time slice or longer on a busy machine.
    """
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and thread.name != COILS:
            linux_process.prioritise(thread.native_id or 0, NEXT_PRIORITY)
