"""Time-tagged commands: their storage on disk and their execution at the commanded UTC.

The schedule is stored in two copies, so that a process killed at any moment leaves one valid copy. An entry
leaves the disk before its command is executed, so no command is executed twice. A command that is more than
ten seconds late, for example because the board was off, is reported as failed and not executed. A command
that falls due in SAFE also fails, because the ground decides how to leave SAFE. A command waits until
telemetry has shown the mode.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from flight.link.commands.codec import CommandError, command_of_words
from flight.link.modes import Mode
from flight.link.process.directives import LONGEST_COMMAND, SCHEDULE, Deletion, Listing, Scheduled
from flight.link.process.verification import Report, Sent, Stage
from flight.link.regular_files import read_regular
from flight.link.security.associations import COPIES, overwrite
from flight.link.telemetry.definitions import HEALTH, MODE
from flight.link.telemetry.packets import LAYOUTS
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import FlightError

MOST_ENTRIES = 32
HIGHEST = 2**63 - 1
"""Largest number in a stored copy; as a UTC in ns it is in the year 2262."""
_LONGEST_FILE = 1 << 16

_Count = Annotated[int, Meta(ge=0, le=HIGHEST)]


class TimetableError(FlightError):
    """Raised if an entry cannot be added, found or removed; the text states the reason."""


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Command in words that is due at a UTC (ns since 1970), with SPI and counter of its frame."""

    number: _Count
    at_ns: _Count
    spi: _Count
    counter: _Count
    command: Annotated[str, Meta(max_length=LONGEST_COMMAND)]


class _Copy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of one file. The copy with the higher version is valid; `last` is the last assigned number."""

    version: _Count = 0
    last: _Count = 0
    entries: Annotated[tuple[Entry, ...], Meta(max_length=MOST_ENTRIES)] = ()


@dataclass(frozen=True, slots=True)
class _Read:
    copy: _Copy | None
    present: bool


class Timetable:
    """Stored entries of a folder, which only one process may use."""

    def __init__(self, folder: Path) -> None:
        """Read the newest valid copy; `lost` is set if copies exist but none is valid."""
        self._folder = folder
        read = [self._read(copy) for copy in COPIES]
        good = [one.copy for one in read if one.copy is not None]
        self.lost = not good and any(one.present for one in read)
        self._now = max(good, key=lambda copy: copy.version, default=_Copy())

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries in the order in which they are due."""
        return tuple(sorted(self._now.entries, key=lambda entry: (entry.at_ns, entry.number)))

    def add(self, at_ns: int, spi: int, counter: int, command: str) -> Entry:
        """Add an entry and store it durably. Raises TimetableError."""
        if len(self._now.entries) >= MOST_ENTRIES:
            raise TimetableError(f"{MOST_ENTRIES} commands are scheduled already: delete one")
        entry = Entry(self._now.last + 1, at_ns, spi, counter, command)
        self._store((*self._now.entries, entry), entry.number)
        return entry

    def remove(self, number: int) -> None:
        """Remove an entry durably; 0 removes all entries. Raises TimetableError."""
        left = tuple(entry for entry in self._now.entries if number and entry.number != number)
        if number and len(left) == len(self._now.entries):
            raise TimetableError(f"no command is scheduled under {number}")
        self._store(left, self._now.last)

    def forget(self, number: int) -> None:
        """Remove an entry from memory only, if the disk cannot be written."""
        left = tuple(entry for entry in self._now.entries if entry.number != number)
        self._now = msgspec.structs.replace(self._now, entries=left)

    def _store(self, entries: tuple[Entry, ...], last: int) -> None:
        copy = _Copy(self._now.version + 1, last, entries)
        data = _encode(copy)
        if not sum([overwrite(self._path(name), data) for name in COPIES]):
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


def _encode(copy: _Copy) -> bytes:
    line = msgspec.json.encode(copy) + b"\n"
    return line + b"%08x\n" % zlib.crc32(line)


def _decode(data: bytes) -> _Copy | None:
    """Return a decoded copy, or None for bytes that `_encode` does not produce."""
    line, end, crc = data.partition(b"\n")
    if crc != b"%08x\n" % zlib.crc32(line + end):
        return None
    try:
        return msgspec.json.decode(line, type=_Copy)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


LATEST_NS = 10 * SECOND_NS
"""Maximum delay (ns) after which a command is still executed."""

_WITH_MODE = {
    LAYOUTS[packet.name].identifier.to_bytes(2, "big"): LAYOUTS[packet.name] for packet in (MODE, HEALTH)
}


class Scheduling:
    """Executes the timetable of a link process. Times are UTC, ns since 1970."""

    def __init__(self, timetable: Timetable) -> None:
        self._timetable = timetable
        self._mode: int | None = None

    def beginning(self) -> list[Report]:
        """Return the reports due at the start of the process."""
        text = "both copies of the schedule are lost: it is empty"
        return [Report(0, 0, Stage.FAILED, SCHEDULE.name, text)] if self._timetable.lost else []

    def followed(self, packet: bytes) -> None:
        """Take the mode from a packet of live telemetry."""
        layout = _WITH_MODE.get(packet[:2])
        if layout is not None:
            self._mode = int(layout.array(packet)[0]["mode"])

    def obey(self, directive: Scheduled | Deletion | Listing, done: Report, utc_ns: int) -> list[Report]:
        """Execute a directive and return all its reports; `done` is the report of its completion."""
        try:
            match directive:
                case Scheduled():
                    return [replace(done, text=self._add(directive, done, utc_ns))]
                case Deletion(number):
                    self._timetable.remove(number)
                    return [done]
                case Listing():
                    texts = [text_of(entry) for entry in self._timetable.entries]
                    lines = [replace(done, stage=Stage.STARTED, text=text) for text in texts]
                    return [*lines, replace(done, text=f"{len(lines)} scheduled")]
        except (CommandError, TimetableError) as error:
            return [replace(done, stage=Stage.FAILED, text=str(error))]

    def due(self, utc_ns: int) -> Iterator[Report | Sent]:
        """Yield each due command, or the report why it is not executed. It is removed durably before."""
        for entry in self._timetable.entries:
            unknown = self._mode is None and utc_ns - entry.at_ns <= LATEST_NS
            if entry.at_ns > utc_ns or unknown:
                return
            problem = self._problem(entry, utc_ns)
            try:
                self._timetable.remove(entry.number)
            except (
                TimetableError
            ) as error:  # the entry is still on disk and could be executed again after a restart
                problem = str(error)
                self._timetable.forget(entry.number)
            if problem:
                text = f"not executed, {problem}: {text_of(entry)}"
                yield Report(entry.spi, entry.counter, Stage.FAILED, SCHEDULE.name, text)
            else:
                yield Sent(entry.spi, entry.counter, command_of_words(entry.command))

    def _problem(self, entry: Entry, utc_ns: int) -> str:
        """Return why a due command must not be executed, or an empty text if it may be."""
        if utc_ns - entry.at_ns > LATEST_NS:
            return f"it is {_utc(utc_ns)}"
        if self._mode == Mode.SAFE:
            return "in SAFE the ground decides"
        try:
            command_of_words(entry.command)
        except CommandError as error:  # of another release's table
            return str(error)
        return ""

    def _add(self, scheduled: Scheduled, done: Report, utc_ns: int) -> str:
        at_ns = utc_of(scheduled.at)
        command_of_words(scheduled.words)
        if at_ns <= utc_ns:
            raise TimetableError(f"{scheduled.at} has passed: it is {_utc(utc_ns)}")
        return text_of(self._timetable.add(at_ns, done.spi, done.counter, scheduled.words))


def utc_of(text: str) -> int:
    """Return the ns since 1970 of a UTC in ISO 8601, up to 2262-04-11. Raises CommandError."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise CommandError(f"{text!r} is no UTC such as 2026-11-23T21:00:00") from error
    time = time.replace(tzinfo=UTC) if time.tzinfo is None else time
    utc_ns = round(time.timestamp()) * SECOND_NS
    if utc_ns > HIGHEST:
        raise CommandError(f"{text} is beyond {_utc(HIGHEST)}")
    return utc_ns


def text_of(entry: Entry) -> str:
    """Return the text of an entry: its number, UTC and command."""
    return f"{entry.number}: {_utc(entry.at_ns)} {entry.command}"


def _utc(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns * 1e-9, UTC):%Y-%m-%dT%H:%M:%SZ}"
