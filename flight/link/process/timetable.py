"""Time-tagged commands on disk, in two copies as the counters are: killed at any moment, one copy is whole.

An entry leaves the disk before it is executed, so none is executed twice.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from flight.link.regular_files import read_regular
from flight.link.security.associations import COPIES, overwrite
from knightcube.errors import FlightError

MOST_ENTRIES = 32
LONGEST_COMMAND = 96
"""Bytes of a command in words, with the zero that ends it."""
HIGHEST = 2**63 - 1
"""Largest number that a copy may hold; as a UTC in ns it is in the year 2262."""
_LONGEST_FILE = 1 << 16

_Count = Annotated[int, Meta(ge=0, le=HIGHEST)]


class TimetableError(FlightError):
    """An entry that cannot be added, found or removed; says why."""


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A command in words that is due at a UTC, ns since 1970; SPI and counter are those it came with."""

    number: _Count
    at_ns: _Count
    spi: _Count
    counter: _Count
    command: Annotated[str, Meta(max_length=LONGEST_COMMAND)]


class _Copy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file: the version that is higher counts; `last` is the highest number given."""

    version: _Count = 0
    last: _Count = 0
    entries: Annotated[tuple[Entry, ...], Meta(max_length=MOST_ENTRIES)] = ()


@dataclass(frozen=True, slots=True)
class _Read:
    copy: _Copy | None
    present: bool


class Timetable:
    """The entries of a folder, which one process has."""

    def __init__(self, folder: Path) -> None:
        """Read the newer good copy; `lost` says whether there were copies and none was good."""
        self._folder = folder
        read = [self._read(copy) for copy in COPIES]
        good = [one.copy for one in read if one.copy is not None]
        self.lost = not good and any(one.present for one in read)
        self._now = max(good, key=lambda copy: copy.version, default=_Copy())

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries, the next due first."""
        return tuple(sorted(self._now.entries, key=lambda entry: (entry.at_ns, entry.number)))

    def add(self, at_ns: int, spi: int, counter: int, command: str) -> Entry:
        """Add an entry, durably. Raises TimetableError."""
        if len(self._now.entries) >= MOST_ENTRIES:
            raise TimetableError(f"{MOST_ENTRIES} commands are scheduled already: delete one")
        entry = Entry(self._now.last + 1, at_ns, spi, counter, command)
        self._store((*self._now.entries, entry), entry.number)
        return entry

    def remove(self, number: int) -> None:
        """Remove an entry, durably; 0 removes all. Raises TimetableError."""
        left = tuple(entry for entry in self._now.entries if number and entry.number != number)
        if number and len(left) == len(self._now.entries):
            raise TimetableError(f"no command is scheduled under {number}")
        self._store(left, self._now.last)

    def forget(self, number: int) -> None:
        """Remove an entry from memory alone, where the disk takes nothing."""
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
    """Return a copy, None for anything that `_encode` does not produce."""
    line, end, crc = data.partition(b"\n")
    if crc != b"%08x\n" % zlib.crc32(line + end):
        return None
    try:
        return msgspec.json.decode(line, type=_Copy)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
