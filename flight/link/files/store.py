"""What outlives a process: records of open transfers, the last number, the last endings, and files that came.

A record is replaced as a whole (written beside, synced, renamed), so a crash leaves the old one or the new.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta

from flight.link.files.units import HIGHEST_NUMBER, Transaction
from flight.link.regular_files import read_regular
from knightcube.errors import FlightError, UsageError

LONGEST_NAME = 96
"""Bytes of a file's name, with the zero that ends it in a command."""
_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,63}")
_MOST_PARTS = 4
_KEPT_ENDINGS = 64
_FREE_BYTES = 64 << 20
"""Of the disk, which no file that comes may take."""
_LONGEST_RECORD = 4 << 20
"""Bytes; the record of a file of 64 MiB of which every other unit is missing has less than 1 MB."""

_Entity = Annotated[int, Meta(ge=0, le=(1 << 16) - 1)]
_Long = Annotated[int, Meta(ge=0, le=HIGHEST_NUMBER)]
_Stretch = tuple[_Long, _Long]
T = TypeVar("T")


class FileError(FlightError):
    """A file or transfer that cannot be; says why."""


class Outgoing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file that is sent: from `path` as `name`; `origin` says on whose command."""

    number: _Long
    destination: _Entity
    path: str
    name: str
    size: _Long
    modified_ns: int
    kind: Annotated[int, Meta(ge=0, le=15)]
    checksum: _Long | None = None
    origin: tuple[int, int, int, int] = (0, 0, 0, 0)


class Incoming(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file that comes: what is known of it, what of it is on disk, and how it ended."""

    source: _Entity
    number: _Long
    name: str | None = None
    size: _Long = 0
    kind: int = 0
    end: _Stretch | None = None
    ranges: tuple[_Stretch, ...] = ()
    finished: tuple[int, bool, int] | None = None


class Ending(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How an incoming transfer ended: answered again when its sender asks again."""

    source: _Entity
    number: _Long
    condition: int
    complete: bool
    kept: int


class _Numbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    last: _Long = 0
    endings: tuple[Ending, ...] = ()


def problem_of_name(name: str) -> str:
    """Return why a name must not stand for a file, empty when it may; no such name leaves its folder."""
    parts = name.split("/")
    if len(name.encode()) >= LONGEST_NAME or len(parts) > _MOST_PARTS:
        return f"{name[:LONGEST_NAME]!r} is too long for the name of a file"
    if not all(_PART.fullmatch(part) for part in parts):
        return f"{name!r} is no name: letters, digits and . _ + - of each part, no part begins with a dot"
    return ""


def files_folder(keys: Path) -> Path:
    """Return where an end of the link keeps its files: beside its keys."""
    return keys.absolute().parent / "files"


class Store:
    """The folder of one entity, which one process has.

    Attributes:
        received: the folder of the files that came.
        last: the last transaction number given.
        endings: of incoming transfers, the oldest first.
    """

    def __init__(self, folder: Path) -> None:
        """Make the folder where it is not there. Raises UsageError."""
        self._folder = folder / "transfers"
        self.received = folder / "received"
        try:
            for path in (self._folder, self.received):
                path.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise UsageError(f"{folder}: cannot be made: {error.strerror or error}") from error
        numbers = _read(self._folder / "numbers.json", _Numbers) or _Numbers()
        self.last, self.endings = numbers.last, numbers.endings

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Keep a second process from this folder. Raises UsageError where there is one."""
        file = os.open(self._folder / "owner", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(file)
            raise UsageError(f"{self._folder}: another process transfers these files") from error
        try:
            yield
        finally:
            os.close(file)

    def new_number(self, utc_ns: int) -> int:
        """Reserve a number, durably; beyond all given ones also where the record of them is lost."""
        self._write_numbers(max(self.last + 1, utc_ns // 10**9) & HIGHEST_NUMBER or 1, self.endings)
        return self.last

    def add_ending(self, ending: Ending) -> None:
        """Remember how a transfer ended."""
        self._write_numbers(self.last, (*self.endings, ending)[-_KEPT_ENDINGS:])

    def outgoing(self) -> list[Outgoing]:
        """Return the open transfers out; damaged records are none."""
        found = (_read(path, Outgoing) for path in sorted(self._folder.glob("out-*.json")))
        return [record for record in found if record is not None]

    def incoming(self) -> list[Incoming]:
        """Return the open transfers in."""
        found = (_read(path, Incoming) for path in sorted(self._folder.glob("in-*.json")))
        return [record for record in found if record is not None]

    def save(self, record: Outgoing | Incoming) -> None:
        """Make a record durable. Raises FileError."""
        write_whole(self._path(record), msgspec.json.encode(record))

    def remove(self, record: Outgoing | Incoming) -> None:
        """Remove a record and, of an incoming file, what came."""
        with suppress(OSError):
            self._path(record).unlink(missing_ok=True)
            if isinstance(record, Incoming):
                self.part(record).unlink(missing_ok=True)

    def part(self, record: Incoming) -> Path:
        """Return where the bytes of an incoming file stand until it is whole."""
        return self._path(record).with_suffix(".part")

    def place(self, record: Incoming) -> None:
        """Put a whole file where its name says. Raises FileError."""
        assert record.name is not None
        target = self.received / record.name
        try:
            target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            os.replace(self.part(record), target)
            _sync_folder(target.parent)
        except OSError as error:
            raise FileError(f"{record.name}: cannot be placed: {error.strerror or error}") from error

    def room(self) -> int:
        """Return how many bytes a file that comes may have for the disk's sake."""
        return max(0, shutil.disk_usage(self._folder).free - _FREE_BYTES)

    def _path(self, record: Outgoing | Incoming) -> Path:
        if isinstance(record, Outgoing):
            return self._folder / f"out-{record.number:010d}.json"
        return self._folder / f"in-{record.source:05d}-{record.number:010d}.json"

    def _write_numbers(self, last: int, endings: tuple[Ending, ...]) -> None:
        write_whole(self._folder / "numbers.json", msgspec.json.encode(_Numbers(last, endings)))
        self.last, self.endings = last, endings


def transaction_of(ending: Ending | Incoming, destination: int) -> Transaction:
    """Return the transaction of an incoming transfer."""
    return Transaction(ending.source, ending.number, destination)


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file, durably. Raises FileError."""
    beside = path.with_name(path.name + "~")
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise FileError(f"{path}: cannot be written: {error.strerror or error}") from error


def _sync_folder(folder: Path) -> None:
    file = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def _read(path: Path, shape: type[T]) -> T | None:
    """Return a record, None for none or a damaged one."""
    try:
        data = read_regular(path, _LONGEST_RECORD)
        return None if data is None else msgspec.json.decode(data, type=shape)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
