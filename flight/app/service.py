"""A flight as a service: configuration, start attempts, signals, confirmation of the release, supervisors.

Nobody can restart a flight or the link on a flight computer in orbit, so the start is retried until it
succeeds. An invalid configuration aborts the start, because later attempts would fail as well. Other problems
may be temporary: a disk error, a missing address or folder, or a bus that another flight uses. After each
failed attempt, everything that was opened is closed, with the coils at zero. The first pause before the next
attempt is 0.2 s, and each later pause is twice as long, up to 30 s. An unexpected exception ends the process,
and the service manager starts a new process.

A flight uses the accepted configuration file or, if this file is damaged, the last flown configuration. The
script `deploy/install.sh` writes the SHA-256 checksum of an accepted configuration beside its file. A flight
reads its configuration file once, verifies the bytes against the checksum, and uses exactly these bytes. A
flipped bit on the disk can turn 1.05e-3 into 1.05e-7, which validation would not detect. A file without a
checksum is used unchecked, unless an accepted configuration is stored, which shows that a checksum has
existed. A service stores the three newest accepted and flown configurations in its state folder. Each stored
configuration is one file, created by a single rename. The file name contains a number and the SHA-256
checksum, so that no configuration can be stored without its checksum.

The signals that end a flight are SIGINT (Ctrl-C), SIGTERM, and SIGHUP when a terminal closes.

Before the flight, the script `deploy/releases.py` chooses the software release and counts its starts in a
file of the state folder. The script passes the name of the release and the reasons for the choice in
environment variables. After a minute of flight, the release is recorded as proven, and the flight reports why
another release was abandoned.

The external supervisors of the flight are the guardian of the coils and the service manager. The loop calls
`beat` at the end of every error-free control cycle, and `feed` while no task is stalled. A running loop does
not prove that commands reach the coils, so heartbeats are passed to the guardian only while the job of the
coil driver runs. With the first heartbeat, READY is reported to the service manager, because the devices are
open and the loop runs.

When large memory blocks are freed, glibc raises its threshold for mapping blocks separately (mallopt(3)).
With a raised threshold, frames are allocated on the heap, where small blocks cause fragmentation, and the
heap grows. Fixed thresholds prevent the growth of the heap; a C library other than glibc ignores them.
"""

from __future__ import annotations

import ctypes
import gc
import hashlib
import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from flight.app.devices import corrupted_text
from flight.app.run import RunRequest
from flight.link import events
from flight.link.events import EventKind
from flight.link.files.store import line_of, read_regular, to_record
from flight.link.telemetry.log import Recorder
from flight.loop.facts import EventLog
from flight.loop.state import LARGEST_FILE, LinuxFiles, replace_file, service_folder
from flight.schema import reader as configuration
from flight.schema.document import (
    ConfigError,
    UnreadConfigError,
    checked_length,
    no_such_file,
    not_utf_8,
    read_text,
)
from flight.schema.sections import Config
from hal.buses import system
from hal.buses.system import ServiceManager, SystemClock
from hal.drivers.coils import DEVICE as COILS
from hal.guardian import GuardianLine
from hal.interfaces.errors import DeviceError
from hal.interfaces.guardian import CoilGuardian, GuardianNews, Overseer
from hal.interfaces.wires import SECOND_NS, Clock, Rig, Ticker
from knightcube.errors import KnightCubeError, UsageError, reason_of

if TYPE_CHECKING:  # see `flight.app.run`
    from flight.loop.flight_loop import FlightLoop

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 30.0
_MEAL_NS = 200_000_000
_ATTEMPT_S = 30.0
"""Extension (s) of the start's timeout that each attempt requests from the service manager."""

J = TypeVar("J")
T = TypeVar("T")


class StoppedError(KnightCubeError):
    """A signal arrived before the flight or the link had begun."""


class StartRetry:
    """Waits between attempts to start, reports why they failed, and triggers the watchdog."""

    def __init__(self, interrupted: Callable[[], bool], clock: Clock | None = None) -> None:
        """`interrupted` is a function that returns whether a signal has arrived."""
        self._interrupted = interrupted
        self._clock = clock or SystemClock()
        self._overseer = ServiceManager(os.environ, os.getpid())
        self._failed = 0
        self._waited = 0.0
        self._problem = ""

    def summary(self) -> str:
        """Return a text on the number and duration of the attempts; empty if the first attempt succeeded."""
        begun = f"started at attempt {self._failed + 1} after {self._waited:.1f} s"
        return f"{begun}: {self._problem}" if self._failed else ""

    def wait(self, problem: str, pause: float) -> None:
        """Wait for `pause` s because of a problem. Raises StoppedError if a signal arrives."""
        self._failed += 1
        self._waited += pause
        self._problem = problem
        with suppress(OSError):
            sys.stderr.write(f"knightcube: cannot start yet: {problem}; tried again in {pause:g} s\n")
            sys.stderr.flush()
        self._overseer.status(f"waiting to start, {self._failed} attempts: {problem}")
        until_ns = self._clock.now_ns() + round(pause * SECOND_NS)
        while not self._interrupted() and (now_ns := self._clock.now_ns()) < until_ns:
            self._overseer.feed_watchdog()
            self._overseer.extend_start(_ATTEMPT_S)
            self._clock.sleep_until_ns(min(now_ns + _MEAL_NS, until_ns))
        if self._interrupted():
            raise StoppedError(f"stopped before the start: {problem}")

    def close(self) -> None:
        """Close the connection to the service manager. Safe to call twice."""
        self._overseer.close()


def retried_start(
    judge: Callable[[], J], attempt: Callable[[J, ExitStack], T], stack: ExitStack, retry: StartRetry
) -> T:
    """Return the result of the first `attempt` that succeeds, whose resources `stack` closes.

    Each attempt opens the configuration that `judge` returns. Raises UsageError if the
    configuration is invalid, and StoppedError after a signal.
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
            except (KnightCubeError, DeviceError, OSError) as error:
                problem = str(error)
        retry.wait(problem, pause)
    raise AssertionError("the pauses do not end")


def pauses() -> Iterator[float]:
    """Yield the pauses (s) between attempts to start."""
    pause = FIRST_PAUSE_S
    while True:
        yield pause
        pause = min(2.0 * pause, LONGEST_PAUSE_S)


_POWERED = "powered"


class InhibitedError(KnightCubeError):
    """Raised while the separation inhibit lasts. The error text states the remaining time."""


class SeparationInhibit:
    """Keeps coils and transmitter off for a configured time after the first power-up.

    Launch providers require this inhibit. The CubeSat Design Specification allows no transmission within 45
    minutes after the deployment. The powered-on time is counted in a file, so that a restart neither ends the
    inhibit nor begins it again. Flight and link count the time separately, each in its own folder.

    A damaged or missing file counts as the first power-up, because it does less harm to keep the coils off
    for too long than to drive them too early. If there is no folder, each start of the process begins the
    inhibit.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._counted_ns = clock.now_ns()
        self._elapsed: float | None = None

    def check(self, folder: Path | None, seconds: float) -> None:
        """Store the powered-on time in `folder`, unless `folder` is None.

        Raises InhibitedError while the powered-on time is shorter than `seconds` s.
        """
        if seconds == 0.0:
            return
        if self._elapsed is None:
            self._elapsed = 0.0 if folder is None else _powered(folder / _POWERED)
        now_ns = self._clock.now_ns()
        stored = self._elapsed
        self._elapsed += (now_ns - self._counted_ns) / SECOND_NS
        self._counted_ns = now_ns
        if stored < seconds and folder is not None:
            with suppress(OSError):  # a disk that cannot be written only prolongs the inhibit at a restart
                folder.mkdir(parents=True, exist_ok=True)
                replace_file(LinuxFiles(), folder / _POWERED, to_record(b"%.1f" % self._elapsed))
        if (left := seconds - self._elapsed) > 0.0:
            raise InhibitedError(f"separation inhibit of {seconds:g} s: {left:.0f} s of powered time remain")


def _powered(path: Path) -> float:
    """Return the stored powered-on time (s), or 0 if the file is missing or damaged."""
    with suppress(OSError, ValueError):
        return float(line_of(_persistently(LinuxFiles().read, path) or b"") or b"0")
    return 0.0


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class EndingSignals:
    """A context manager within which a signal ends the flight after the current control cycle.

    A signal that arrives before the control loop exists ends the flight at its first cycle; a second such
    signal raises KeyboardInterrupt. If the process ignores SIGHUP, as under nohup, SIGHUP stays ignored.
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


NAME, NOTE, RENEWAL = "KNIGHTCUBE_RELEASE", "KNIGHTCUBE_RELEASE_NOTE", "KNIGHTCUBE_RENEWAL"
TRIALS = "releases.json"
PROVEN_NS = 60 * SECOND_NS
"""Flight time (ns) after which a release is proven, so that later crashes no longer count against it."""
_KEPT = 4


def renewal_note(environment: Mapping[str, str]) -> str:
    """Return why the flight computer uses an earlier release again, or "" (deploy/renewal.py)."""
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        status = read_regular(Path(environment[RENEWAL]), LARGEST_FILE) or b""
        return str(json.loads(line_of(status) or b"")["note"])
    return ""


class FlownRelease:
    """The software release in use; a release whose name is unknown is not recorded as proven."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Read name and note of the release from the environment of the process."""
        self._name = environment.get(NAME, "")
        self.note = environment.get(NOTE, "")
        folder = service_folder(environment)
        self._path = folder / TRIALS if folder is not None and self._name else None
        self._done = False

    def serve(self, clock: Clock, stack: ExitStack) -> None:
        """Start a timer that records the release as proven after `PROVEN_NS`; `stack` stops the timer."""
        if self._path is not None:
            stack.callback(clock.ticker("release", PROVEN_NS, self.prove).stop)

    def prove(self) -> None:
        """Record this release as proven; a failed read or write is retried a minute later."""
        if self._path is None or self._done:
            return
        with suppress(OSError):
            proven = [name for name in _proven(self._path) if name != self._name]
            self._write([*proven, self._name][-_KEPT:])
            self._done = True

    def end(self) -> None:
        """Reset the count of starts of the release, because its flight ended normally.

        If the record cannot be read or written, the record stays unchanged.
        """
        if self._path is not None:
            with suppress(OSError):
                self._write(_proven(self._path))

    def _write(self, proven: list[str]) -> None:
        assert self._path is not None
        text = json.dumps({"starts": {}, "proven": proven})
        replace_file(LinuxFiles(), self._path, to_record(text.encode()))


def _proven(path: Path) -> list[str]:
    """Return the proven releases, or an empty list if the file is missing or damaged.

    Raises OSError if the file cannot be read, because the next write would otherwise drop its releases.
    """
    data = LinuxFiles().read(path) or b""
    with suppress(ValueError, TypeError, LookupError, RecursionError):
        kept: dict[str, Any] = json.loads(line_of(data) or b"")
        return [str(name) for name in kept["proven"]]
    return []


LARGE_BYTES = 256 * 1024
"""Size (bytes) from which a block is mapped separately, and returned to the kernel when it is freed."""
SPARE_BYTES = 4 * 1024 * 1024
"""Free memory (bytes) kept at the top of the heap, so that control cycles seldom call the kernel."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h


def settle_memory() -> None:
    """Set the heap's thresholds, and replace the automatic garbage collection by a `Collector`.

    The function `settle_memory` is called once, after all devices and tasks have been created. All present
    objects are exempt from garbage collection, because examining all modules and tasks would take tens of ms
    in a control cycle.
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

    Only errors create reference cycles, which reference counting cannot free. If the collector is called
    every few seconds, a collection examines few objects and takes at most 2 ms. The first call collects
    nothing, and only exempts the objects that the start created from later collections.
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
"""Time (ns) without a run of the coil driver's job after which heartbeats are withheld: three periods of the
job."""

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
        """Connect the supervisors; the ticker `coils` runs the coil driver; `settle` runs before READY."""
        self._guardian, self._overseer, self._clock = guardian, overseer, clock
        # A separate event log is used, because the loop does not exist yet, and no event needs a reaction.
        self._events = EventLog(recorder.event, _THROTTLE_NS)
        self._status, self._coils, self._settle = status, coils, settle
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
        """Write the events that the rate limit still holds back."""
        self._events.flush(self._clock.now_ns())

    def feed(self) -> None:
        """Trigger the watchdog, restart the guardian if needed, and report the guardian's state changes."""
        self._overseer.feed_watchdog()
        now_ns = self._clock.now_ns()
        notes = self._notes + [(_EVENTS[news], news.value) for news in self._guardian.tend(now_ns)]
        self._notes.clear()
        for kind, text in notes:
            self._events.report(kind, now_ns, text)
        self._events.release(now_ns)


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
    """Connect the supervisors, and raise the priority of the control loop and the coil driver.

    Raises ConfigError if the coil driver runs no ticker (periodic task), on which the heartbeats depend.
    """
    coils = next((ticker for ticker in clock.tickers if ticker.name == COILS), None)
    if coils is None:
        raise ConfigError(
            "coils.driver",
            f"has started no ticker {COILS!r}: start it in its method `start` (docs/extending)",
        )
    overseer = ServiceManager(os.environ, os.getpid())
    stack.callback(overseer.close)
    first = [thread for thread in threading.enumerate() if thread.name == COILS]
    obtained = system.obtain([0, *(thread.native_id or 0 for thread in first)], CONTROL_PRIORITY)
    stack.callback(system.relinquish)
    stack.callback(overseer.stopping)

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
            system.prioritise(thread.native_id or 0, NEXT_PRIORITY)


FOLDER = "flown"
KEPT = 3
GOOD_START_NS = 10_000_000_000
"""Flight time (ns) after which the configuration is stored."""

_NAME = re.compile(r"(\d{6,})-([0-9a-f]{64})\.yaml")


@dataclass(frozen=True, slots=True)
class KeptConfig:
    """A stored configuration that was flown."""

    number: int
    path: Path
    text: str


def kept_configs(folder: Path) -> list[KeptConfig]:
    """Return the undamaged configurations stored in a state folder, newest first. Raises OSError."""
    return _read_kept(folder)[0]


def _read_kept(folder: Path) -> tuple[list[KeptConfig], list[Path]]:
    """Return the undamaged stored configurations, newest first, and the damaged files. Raises OSError.

    A file that cannot be read is in neither list, because a later attempt to read it may succeed.
    """
    found, damaged = list[KeptConfig](), list[Path]()
    for number, path, digest in _named(folder):
        with suppress(OSError):
            data = _persistently(LinuxFiles().read, path) or b""
            try:
                if hashlib.sha256(data).hexdigest() != digest:
                    raise ValueError("its checksum is wrong")
                found.append(KeptConfig(number, path, data.decode("utf-8")))
            except ValueError:
                damaged.append(path)
    return sorted(found, key=lambda kept: kept.number, reverse=True), damaged


class FlownConfig:
    """Stores the configuration of a flight that has run for `GOOD_START_NS`."""

    def __init__(self, text: str, folder: Path) -> None:
        """Prepare to store the text of a configuration in a state folder."""
        self._data = text.encode()
        self._folder = folder
        self._kept = False

    def serve(self, clock: Clock) -> Ticker:
        """Return the ticker (periodic task outside the loop) that stores the configuration."""
        return clock.ticker("configuration", GOOD_START_NS, self.keep)

    def keep(self) -> None:
        """Store the configuration unless it is the newest stored one; retry a failed write later."""
        if self._kept:
            return
        with suppress(OSError):
            place = self._folder / FOLDER
            place.mkdir(exist_ok=True)
            kept, damaged = _read_kept(self._folder)
            if not kept or kept[0].text.encode() != self._data:
                number = max((number for number, _, _ in _named(self._folder)), default=0) + 1
                name = f"{number:06d}-{hashlib.sha256(self._data).hexdigest()}.yaml"
                replace_file(LinuxFiles(), place / name, self._data)
                kept, damaged = _read_kept(self._folder)
            # Keep the newest copies of `KEPT` different texts, and delete damaged and older copies.
            texts: dict[str, Path] = {}
            for copy in kept:
                texts.setdefault(copy.text, copy.path)
            staying = set(list(texts.values())[:KEPT])
            for path in (*damaged, *(copy.path for copy in kept)):
                if path not in staying:
                    path.unlink(missing_ok=True)
            self._kept = True


def _named(folder: Path) -> list[tuple[int, Path, str]]:
    """Return number, path and checksum of the files named like a stored configuration. Raises OSError."""
    place = folder / FOLDER
    try:
        paths = list(place.iterdir())
    except FileNotFoundError:
        return []
    matches = ((_NAME.fullmatch(path.name), path) for path in paths)
    return [(int(match[1]), path, match[2]) for match, path in matches if match]


_CURE = "if it was edited, accept it by deploy/install.sh --accept, otherwise restore it"
_TRIES = 3
"""Number of attempts to read a file, because a single failed disk access does not mean damage."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """A configuration to fly.

    Attributes:
        path: file from which `text` was read.
        problem: reason why `path` is not the requested file; empty if it is.
        accepted: whether a checksum beside the requested file confirms its bytes.
    """

    path: Path
    text: str
    problem: str = ""
    accepted: bool = False


def sum_file(path: Path) -> Path:
    """Return the path of a configuration's checksum file, as written by sha256sum."""
    return path.parent / f"{path.name}.sha256"  # `with_name` fails on the path `.`


def accepted_config(path: Path, environment: Mapping[str, str]) -> Chosen:
    """Return the configuration to fly, which is read only once.

    Raises UnreadConfigError, with the remedy, if `path` is damaged and no flown configuration is stored.
    """
    folder = service_folder(environment)
    read = _read_any if folder is None else LinuxFiles().read
    data, problem, accepted = _verified(path, read)
    kept = kept_configs(folder) if folder is not None and not accepted else []
    if kept and not problem:
        problem = f"{sum_file(path).name} is missing"
    if data is not None and not problem:
        return Chosen(path, _text(path, data), "", accepted)
    for one in kept:
        try:
            configuration.parse(one.text, str(one.path))
        except ConfigError:  # the stored configuration was flown with another software version
            continue
        return Chosen(
            one.path, one.text, f"{path}: {problem}: the configuration of an earlier flight is used; {_CURE}"
        )
    if os.path.lexists(sum_file(path)) or folder is not None:
        problem += f", and no configuration of an earlier flight is stored; {_CURE}"
    raise UnreadConfigError(str(path), problem)


def _verified(path: Path, read: Callable[[Path], bytes | None]) -> tuple[bytes | None, str, bool]:
    """Return a file's bytes, why they are unusable (or ""), and whether a checksum confirms the bytes."""
    try:
        data = _persistently(read, path)
        expected = _persistently(LinuxFiles().read, sum_file(path))
    except OSError as error:
        return None, f"cannot be read: {reason_of(error)}", False
    if data is None:
        return None, f"cannot be read: {no_such_file(path)}", False
    if expected is None:
        dangling = os.path.lexists(sum_file(path))
        return data, f"{sum_file(path).name} leads nowhere" if dangling else "", False
    accepted = expected.split()[:1] == [hashlib.sha256(data).hexdigest().encode()]
    return data, "" if accepted else "differs from the accepted configuration (SHA-256)", accepted


def _persistently(read: Callable[[Path], bytes | None], path: Path) -> bytes | None:
    """Read a file with retries. Raises OSError."""
    for _ in range(_TRIES - 1):
        with suppress(OSError):
            return read(path)
    return read(path)


def _read_any(path: Path) -> bytes | None:
    """Return a limited number of bytes of any kind of file, for example of a pipe."""
    try:
        with path.open("rb") as file:
            return file.read(4 * LARGEST_FILE + 1)
    except FileNotFoundError:
        return None


def _text(path: Path, data: bytes) -> str:
    """Return the text of a configuration. Raises ConfigError for bytes that are not UTF-8."""
    try:
        return checked_length(data.decode("utf-8"), path)
    except UnicodeDecodeError as error:
        raise not_utf_8(path, error) from error


def requested_config(request: RunRequest, text: str | None = None) -> tuple[str, Config]:
    """Return the configuration as text (`text`, or the file's text) and as values.

    Changes that the request makes are contained in the values but not in the text. Raises ConfigError for an
    invalid configuration, and UsageError if the configuration cannot be changed as requested.
    """
    text = read_text(request.config_path) if text is None else text
    config = configuration.parse(text, str(request.config_path))
    if request.faults and config.simulation is None:
        raise UsageError("--fault: this configuration has real devices; faults need a section `simulation`")
    if request.faults:
        spoiled = corrupted_text(request, text)
        if spoiled != text:
            text, config = spoiled, configuration.parse(spoiled, str(request.config_path))
    if request.duration is not None:
        if not (np.isfinite(request.duration) and request.duration > 0.0):
            raise UsageError(f"--duration {request.duration}: must be a positive number of seconds")
        config = config.shortened(request.duration)
    if request.trial:
        commands = msgspec.structs.replace(config.commands, socket=None, udp=None)
        state = msgspec.structs.replace(config.state, folder=None)
        config = msgspec.structs.replace(config, commands=commands, state=state)
    return text, config
