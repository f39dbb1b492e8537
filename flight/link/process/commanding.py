"""Command delivery to the control process, command verification (PUS service 1) and scheduled commands.

The stages of a command are: accepted or refused, started, and completed or failed. Each command is sent from
a separate socket, so that an answer cannot be assigned to the wrong command. The control process answers a
command after executing it. A command that changes the mode is completed when a mode packet in the live
telemetry shows the new mode. A command that changes the mode fails if the mode becomes SAFE or if a newer
command replaces it. A slew command is completed when the slew has arrived, and fails if the slew mode ends
otherwise.

The schedule of time-tagged commands is stored in two copies, so that one valid copy exists even if the
process is killed while writing. A schedule entry is deleted from disk before its command is executed, so that
no command is executed twice. A command that is more than ten seconds late, for example because the flight
computer was off, is reported as failed and not executed. A scheduled command also fails in mode SAFE, because
only the ground may decide how to leave SAFE. After a start, no scheduled command is executed until telemetry
has shown the current mode.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Generic, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from flight.link.commands import ChangeMode, Command, CommandError, Point, Slew, command_of_words
from flight.link.events import Mode
from flight.link.files.store import line_of, overwrite, read_regular, to_record
from flight.link.process.directives import LONGEST_COMMAND, SCHEDULE, Deletion, Listing, Scheduled
from flight.link.security import COPIES
from flight.link.telemetry.definitions import COMMAND, HEALTH, MODE
from flight.link.telemetry.packets import LONGEST_PACKET, row_of, to_text, walk
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import KnightCubeError

_ARRIVED = "arrived"  # field `trigger` of the mode packet at the end of a slew (flight.loop.modes)


class Stage(IntEnum):
    """Stage of a command. The enumeration values are the values in the verification packet."""

    ACCEPTED = 1
    REFUSED = 2
    STARTED = 3
    COMPLETED = 4
    FAILED = 5
    REPEATED = 6
    """A frame with an already used counter was refused. The refusal does not show whether the command that
    used the counter was executed."""

    @property
    def final(self) -> bool:
        """Whether the stage is the last stage of a command."""
        return self in {Stage.REFUSED, Stage.COMPLETED, Stage.FAILED}


class Request(NamedTuple):
    """Identification of a command packet by its first 16 bits and its sequence count."""

    packet: int
    sequence: int


UNREAD = Request(0, 0)
"""Placeholder request for a frame whose packet was not read."""


def request_of(packet: bytes) -> Request:
    """Return the identification of a command packet."""
    return Request(int.from_bytes(packet[:2], "big"), int.from_bytes(packet[2:4], "big") & 0x3FFF)


@dataclass(frozen=True, slots=True)
class Sent:
    """Command sent to the control process, with SPI and counter of the frame that contained the command."""

    spi: int
    counter: int
    command: Command
    request: Request = UNREAD


@dataclass(frozen=True, slots=True)
class Report:
    """Verification report: the values of a verification packet."""

    spi: int
    counter: int
    stage: Stage
    name: str
    text: str
    request: Request = UNREAD


def report(sent: Sent, stage: Stage, text: str) -> Report:
    """Return the verification report of a command that has reached a stage."""
    return Report(sent.spi, sent.counter, stage, sent.command.packet.name, text, sent.request)


def final_mode(command: Command) -> Mode | None:
    """Return the mode whose entry completes a command, or None for a command that is completed at once."""
    match command:
        case ChangeMode(mode):
            return mode
        case Slew():
            return Mode.HOLD
        case Point():
            return Mode.POINT
        case _:
            return None


_LOG_DELAY_NS = 10 * SECOND_NS
"""Mission time (ns) by which the link has read the BOOT packet at the beginning of a flight."""


class Verification:
    """Tracker of the stages of commands that were sent to the control process."""

    def __init__(self) -> None:
        # The command being executed, the mode that completes it, and the mission time (ns) of its answer.
        self._open: tuple[Sent, Mode, int] | None = None

    def answered(self, sent: Sent, answer: bytes) -> list[Report]:
        """Return the reports for an answer of the control process. Empty bytes represent a missing answer."""
        rows = (row_of(COMMAND, answer[begin:end]) for _, begin, end in walk(answer))
        row = next((row for row in rows if row is not None), None)
        if row is None:
            problem = "answered in another version" if answer else "did not answer"
            return [report(sent, Stage.FAILED, f"the flight {problem}")]
        text = to_text(row["text"])
        if not row["obeyed"]:
            return [report(sent, Stage.FAILED, text)]
        reports = [report(sent, Stage.STARTED, text)]
        wanted = final_mode(sent.command)
        if wanted is None:
            return [*reports, report(sent, Stage.COMPLETED, sent.command.text)]
        if self._open is not None:
            reports.append(report(self._open[0], Stage.FAILED, f"replaced by: {sent.command.text}"))
        self._open = (sent, wanted, int(row["time_ns"]))
        if int(row["mode"]) == wanted and not isinstance(sent.command, Slew):
            reports += self._close(Stage.COMPLETED, f"mode {wanted.label}")
        return reports

    def followed(self, packet: bytes) -> list[Report]:
        """Return the reports of commands whose completion or failure a live telemetry packet shows."""
        if self._open is None or (row := row_of(MODE, packet)) is None:
            return []
        sent, wanted, since_ns = self._open
        slews, trigger = isinstance(sent.command, Slew), to_text(row["trigger"])
        # The mission time of a restarted flight begins at 0 again, with the mode BOOT.
        restarted = row["mode"] == Mode.BOOT and since_ns > _LOG_DELAY_NS
        if row["time_ns"] <= since_ns and not restarted:
            return []
        if row["mode"] == wanted and (not slews or trigger == _ARRIVED):
            return self._close(Stage.COMPLETED, f"mode {wanted.label}")
        if row["mode"] in {Mode.SAFE, Mode.BOOT} or (slews and row["mode"] != Mode.SLEW):
            return self._close(Stage.FAILED, f"{trigger}: {to_text(row['reason'])}")
        return []

    def _close(self, stage: Stage, text: str) -> list[Report]:
        assert self._open is not None
        sent, self._open = self._open[0], None
        return [report(sent, stage, text)]


AT_MOST = 8
"""Maximum number of commands that wait for their answers at the same time."""

PATIENCE_NS = 5_000_000_000
"""Timeout (ns) for an answer from the control process, which reads commands every 0.1 s."""

T = TypeVar("T")


@dataclass(slots=True)
class _Waiting(Generic[T]):
    command: T
    line: socket.socket
    path: Path
    until_ns: int


class ControlLine(Generic[T]):
    """Client of the control process's command socket. The type T identifies a command for the caller."""

    def __init__(self, target: Path, folder: Path) -> None:
        """Send to the socket `target`; answers arrive on sockets in `folder`, which `target` must reach."""
        self._target = str(target)
        self._folder = folder
        self._waiting: list[_Waiting[T]] = []
        self._count = 0

    @property
    def is_full(self) -> bool:
        """Whether the maximum number of commands (`AT_MOST`) is waiting for answers."""
        return len(self._waiting) >= AT_MOST

    def send(self, command: T, data: bytes, now_ns: int) -> str:
        """Send a command without waiting. Return the problem, or an empty text on success."""
        if self.is_full:
            return f"{AT_MOST} commands are already waiting for answers"
        self._count += 1
        path = self._folder / f"answer-{self._count}"
        with ExitStack() as stack:
            try:
                line = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
                line.setblocking(False)
                stack.callback(_remove, path)
                path.unlink(missing_ok=True)
                line.bind(str(path))
                path.chmod(0o660)
                line.sendto(data, self._target)
            except OSError as error:
                return f"no flight listens: {error.strerror or error}"
            stack.pop_all()
        self._waiting.append(_Waiting(command, line, path, now_ns + PATIENCE_NS))
        return ""

    def answers(self, now_ns: int) -> list[tuple[T, bytes]]:
        """Return the received answers with their commands. Empty bytes represent an answer that timed out."""
        found, still = [], []
        for waiting in self._waiting:
            try:
                data = waiting.line.recv(LONGEST_PACKET)
            except OSError:
                if now_ns < waiting.until_ns:
                    still.append(waiting)
                    continue
                data = b""
            self._end(waiting)
            found.append((waiting.command, data))
        self._waiting = still
        return found

    def close(self) -> None:
        """Stop waiting for answers and close all sockets."""
        for waiting in self._waiting:
            self._end(waiting)
        self._waiting = []

    def _end(self, waiting: _Waiting[T]) -> None:
        waiting.line.close()
        _remove(waiting.path)


def _remove(path: Path) -> None:
    """Remove a socket file if possible. The method `send` removes a remaining file later."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


MOST_ENTRIES = 32
HIGHEST = 2**63 - 1
"""Largest integer in a stored schedule; as UTC in ns since 1970 it is a time in the year 2262."""
_LONGEST_FILE = 1 << 16

_Count = Annotated[int, Meta(ge=0, le=HIGHEST)]


class TimetableError(KnightCubeError):
    """Raised if a schedule entry cannot be added, found or removed. The error text states the reason."""


class Entry(msgspec.Struct, frozen=True):
    """Schedule entry, numbered from 1: a command in words, due at the UTC `at_ns` (ns since 1970).

    The values `spi` and `counter` come from the frame that contained the scheduling command.
    """

    number: _Count
    at_ns: _Count
    spi: _Count
    counter: _Count
    command: Annotated[str, Meta(max_length=LONGEST_COMMAND)]


class _Copy(msgspec.Struct, frozen=True):
    """Stored copy of the schedule with the last entry number; the copy with the higher version is used."""

    version: _Count = 0
    last: _Count = 0
    entries: Annotated[tuple[Entry, ...], Meta(max_length=MOST_ENTRIES)] = ()


@dataclass(frozen=True, slots=True)
class _Read:
    copy: _Copy | None
    present: bool


class Timetable:
    """Schedule of time-tagged commands, stored in a folder that only one process may use."""

    def __init__(self, folder: Path, restored: bool = False) -> None:
        """Read the newest valid copy of the schedule. Set `lost` if copies exist but none is valid.

        If the folder was `restored` from a backup, its schedule is outdated: all entries are deleted.
        """
        self._folder = folder
        read = [self._read(copy) for copy in COPIES]
        good = [one.copy for one in read if one.copy is not None]
        self.lost = not good and any(one.present for one in read)
        self._now = max(good, key=lambda copy: copy.version, default=_Copy())
        if restored and self._now.entries:
            self.lost, last = True, self._now.last
            self._now = msgspec.structs.replace(self._now, entries=())
            with suppress(TimetableError):
                self._store((), last)

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All schedule entries in order of their due times."""
        return tuple(sorted(self._now.entries, key=lambda entry: (entry.at_ns, entry.number)))

    def add(self, at_ns: int, spi: int, counter: int, command: str) -> Entry:
        """Add an entry and store the schedule. Raises TimetableError if the disk or the schedule is full."""
        if len(self._now.entries) >= MOST_ENTRIES:
            raise TimetableError(f"{MOST_ENTRIES} commands are scheduled already: delete one")
        entry = Entry(self._now.last + 1, at_ns, spi, counter, command)
        self._store((*self._now.entries, entry), entry.number)
        return entry

    def remove(self, number: int) -> None:
        """Remove an entry by its number, or all entries for number 0.

        Raises TimetableError if there is no such entry, or if the schedule cannot be stored.
        """
        left = tuple(entry for entry in self._now.entries if number and entry.number != number)
        if number and len(left) == len(self._now.entries):
            raise TimetableError(f"no command is scheduled with the number {number}")
        self._store(left, self._now.last)

    def forget(self, number: int) -> None:
        """Remove an entry from memory only, for use if the disk cannot be written."""
        left = tuple(entry for entry in self._now.entries if entry.number != number)
        self._now = msgspec.structs.replace(self._now, entries=left)

    def _store(self, entries: tuple[Entry, ...], last: int) -> None:
        copy = _Copy(self._now.version + 1, last, entries)
        data = to_record(msgspec.json.encode(copy))
        if not sum([overwrite(self._path(name), data) for name in COPIES]):
            # A version is never reused, because a write that failed may have reached the disk.
            self._now = msgspec.structs.replace(self._now, version=copy.version)
            raise TimetableError("the schedule could not be stored")
        self._now = copy

    def _read(self, name: str) -> _Read:
        try:
            data = read_regular(self._path(name), _LONGEST_FILE)
        except OSError:
            return _Read(None, present=True)
        return _Read(None if data is None else _decode(data), present=data is not None)

    def _path(self, name: str) -> Path:
        return self._folder / f"schedule.{name}"


def _decode(data: bytes) -> _Copy | None:
    """Return the schedule in the bytes of a stored copy, or None if the copy is damaged."""
    line = line_of(data)
    try:
        return None if line is None else msgspec.json.decode(line, type=_Copy)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


_DATE_LENGTH = 10  # length of a date without the time of day
_PAST_ENTRIES = 8
"""Number of executed or failed entries whose results `list-schedule` reports."""
LATEST_NS = 10 * SECOND_NS
"""Maximum delay (ns) with which a scheduled command is still executed."""


class Scheduling:
    """Scheduler that executes time-tagged commands. Times are UTC in ns since 1970."""

    def __init__(self, timetable: Timetable, foreign: frozenset[Mode] = frozenset()) -> None:
        """Execute the entries of a timetable; commands to the `foreign` modes are refused."""
        self._timetable, self._foreign = timetable, foreign
        self._mode: int | None = None
        # Command text and result of each of the newest entries that were due, by SPI and counter.
        self._past: dict[tuple[int, int], tuple[str, str]] = {}

    def beginning(self) -> list[Report]:
        """Return the reports to be sent at the start of the link process."""
        text = "both copies of the schedule are lost or outdated, so the schedule is empty"
        return [Report(0, 0, Stage.FAILED, SCHEDULE.name, text)] if self._timetable.lost else []

    def followed(self, packet: bytes) -> None:
        """Update the current mode if a packet of live telemetry contains the mode."""
        for kind in (MODE, HEALTH):
            if (row := row_of(kind, packet)) is not None:
                self._mode = int(row["mode"])

    def reported(self, report: Report) -> None:
        """Update the result of a scheduled command from a report about this command."""
        key = report.spi, report.counter
        if key in self._past:
            stage, text = report.stage.name.lower(), self._past[key][0]
            own = f"{stage}, {report.text}" if report.stage is Stage.FAILED else stage
            self._past[key] = text, own

    def obey(self, directive: Scheduled | Deletion | Listing, done: Report, utc_ns: int) -> list[Report]:
        """Execute a directive and return all reports about it; `done` is the report of completion."""
        try:
            match directive:
                case Scheduled():
                    return [replace(done, text=self._add(directive, done, utc_ns))]
                case Deletion(number):
                    self._timetable.remove(number)
                    return [done]
                case Listing():
                    texts = [f"{own}: past entry {text}" for text, own in self._past.values()]
                    count = len(self._timetable.entries)
                    texts += [text_of(entry) for entry in self._timetable.entries]
                    lines = [replace(done, stage=Stage.STARTED, text=text) for text in texts]
                    return [*lines, replace(done, text=f"{count} scheduled")]
        except (CommandError, TimetableError) as error:
            return [replace(done, stage=Stage.FAILED, text=str(error))]

    def due(self, utc_ns: int) -> Iterator[Report | Sent]:
        """Yield each due command after its entry was removed, or a report why it is not executed."""
        for entry in self._timetable.entries:
            unknown = self._mode is None and utc_ns - entry.at_ns <= LATEST_NS
            if entry.at_ns > utc_ns or unknown:
                return
            problem = self._problem(entry, utc_ns)
            try:
                self._timetable.remove(entry.number)
            except TimetableError as error:  # the entry is still on disk, so a restart could execute it again
                problem = str(error)
                self._timetable.forget(entry.number)
            while len(self._past) >= _PAST_ENTRIES:
                del self._past[next(iter(self._past))]
            result = f"not executed, {problem}" if problem else "sent to the flight"
            self._past[entry.spi, entry.counter] = text_of(entry), result
            if problem:
                text = f"{result}: {text_of(entry)}"
                yield Report(entry.spi, entry.counter, Stage.FAILED, SCHEDULE.name, text)
            else:
                yield Sent(entry.spi, entry.counter, command_of_words(entry.command, stored=True))

    def _problem(self, entry: Entry, utc_ns: int) -> str:
        """Return why a due command must not be executed, or an empty text if it may be executed."""
        if utc_ns - entry.at_ns > LATEST_NS:
            return f"it is {_utc(utc_ns)}"
        if self._mode == Mode.SAFE:
            return "the flight is in mode SAFE"
        try:
            command_of_words(entry.command, stored=True)
        except CommandError as error:  # the entry was scheduled by another software release
            return str(error)
        return ""

    def _add(self, scheduled: Scheduled, done: Report, utc_ns: int) -> str:
        at_ns = utc_of(scheduled.at)
        mode = final_mode(command_of_words(scheduled.words))
        if mode in self._foreign:
            raise CommandError(f"{scheduled.words}: this body has no mode {mode.label}")
        if at_ns <= utc_ns:
            raise TimetableError(f"{scheduled.at} has passed: it is {_utc(utc_ns)}")
        return text_of(self._timetable.add(at_ns, done.spi, done.counter, scheduled.words))


def utc_of(text: str) -> int:
    """Return the ns since 1970 of a UTC in ISO 8601 format.

    Raises CommandError for any other text, and for a time after 2262-04-11.
    """
    try:
        time = datetime.fromisoformat(text)
        if len(text) <= _DATE_LENGTH:
            raise ValueError("the time of day is missing")
    except ValueError as error:
        raise CommandError(f"{text!r} is not a UTC such as 2026-11-23T21:00:00") from error
    time = time.replace(tzinfo=UTC) if time.tzinfo is None else time
    utc_ns = round(time.timestamp()) * SECOND_NS
    if utc_ns > HIGHEST:
        raise CommandError(f"{text} is too late: give a time up to {_utc(HIGHEST)}")
    return utc_ns


def text_of(entry: Entry) -> str:
    """Return the number, UTC and command of a schedule entry as text, with angles in degrees."""
    try:
        text = command_of_words(entry.command, stored=True).text
    except CommandError:  # the entry was scheduled by another software release
        text = entry.command
    return f"{entry.number}: {_utc(entry.at_ns)} {text}"


def _utc(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns * 1e-9, UTC):%Y-%m-%dT%H:%M:%SZ}"
