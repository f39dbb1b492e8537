"""Files on disk: reading, records, durable writing and locks of files, and the state of file transfers.

Files are read with a size limit, because a FIFO at the path of an expected file would block the reader, and a
huge sparse file would exhaust the memory.

The state of file transfers consists of open transfers, transaction numbers, ended transfers and received
files. Each record is written to a temporary file, synced and renamed, so that a crash leaves the old or the
new record. A record is a line of JSON, followed by a line with its CRC-32 in hexadecimal digits. Unknown
fields of a record are ignored, so that an earlier release can read the records of a later release.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import stat
import weakref
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta

from flight.link.files.units import HIGHEST_NUMBER
from knightcube.errors import KnightCubeError, UsageError

_TRIES = 3
"""Number of attempts to read a file or to list a folder."""


def read_regular(path: Path, most: int) -> bytes | None:
    """Return the content of a file of at most `most` bytes, or None if the file does not exist.

    Raises OSError if the file cannot be read, is longer than the limit, or is not a regular file. Type and
    size are checked before the file is read. A failed read is repeated, because a single failed disk access
    does not mean damage.
    """
    for _ in range(_TRIES - 1):
        with suppress(OSError):
            return _read_once(path, most)
    return _read_once(path, most)


def _read_once(path: Path, most: int) -> bytes | None:
    try:
        file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        found = os.fstat(file)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "is not a regular file", str(path))
        if found.st_size > most:
            raise OSError(errno.EFBIG, f"{found.st_size} bytes are too many", str(path))
        data = b""
        while chunk := os.read(file, most + 1 - len(data)):
            data += chunk
        return data
    finally:
        os.close(file)


def to_record(line: bytes) -> bytes:
    """Return a record: a line of text without line breaks, and a line with the CRC-32 of the first line."""
    return line + b"\n%08x\n" % zlib.crc32(line + b"\n")


def line_of(data: bytes) -> bytes | None:
    """Return the line of a record, or None if its CRC-32 is wrong or missing."""
    line, end, crc = data.partition(b"\n")
    return line if crc == b"%08x\n" % zlib.crc32(line + end) else None


def make_lasting(folder: Path) -> None:
    """Sync a folder to disk, so that the names of its files survive a power loss. Raises OSError."""
    names = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(names)
    finally:
        os.close(names)


_SYNCED: set[Path] = set()
"""Files whose names this process has synced to disk. A killed process may have left a file whose name was not
synced, so each process syncs the name at its first write."""


def overwrite(path: Path, data: bytes) -> bool:
    """Overwrite a file in place and sync it to disk. Return whether the file was written."""
    try:
        if not path.exists():
            _SYNCED.discard(path)
        # Without O_NONBLOCK, opening a FIFO at this path would block.
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
        try:
            if os.pwrite(file, data, 0) != len(data):
                return False
            os.ftruncate(file, len(data))
            os.fsync(file)
        finally:
            os.close(file)
        if path not in _SYNCED:
            make_lasting(path.parent)
            _SYNCED.add(path)
    except OSError:
        return False
    return True


def make_folder(folder: Path, mode: int = 0o700) -> None:
    """Create a folder with this mode and its parents with default rights, and sync each new name to disk.

    Raises OSError.
    """
    if folder.is_dir():
        return
    if folder.parent != folder:
        make_folder(folder.parent, 0o777)
    folder.mkdir(mode, exist_ok=True)
    try:
        make_lasting(folder.parent)
    except OSError:  # the next attempt must sync the parent again
        with suppress(OSError):
            folder.rmdir()
        raise


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files that a killed process has left in a folder and its subfolders."""
    with suppress(OSError):
        for path in folder.rglob("*~"):
            path.unlink()


@contextmanager
def locked(path: Path, problem: str) -> Iterator[None]:
    """Hold the lock of a file.

    Raises UsageError with the text `problem` if the file is already locked.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(problem) from error
        yield
    finally:
        os.close(file)


LONGEST_NAME = 96
"""Maximum length (bytes) of a file name in a command, including the terminating zero byte."""
_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,63}")
_MOST_PARTS = 4
_KEPT_ENDINGS = 64
_FREE_BYTES = 64 << 20
"""Free disk space (bytes) that received files must not use."""
_COPY_FREE_BYTES = 1 << 20
"""Free disk space (bytes) that a selected copy must not use. It is smaller than `_FREE_BYTES`, so that a
received file can be selected while the disk has too little space for further files."""
_LONGEST_RECORD = 4 << 20
"""Maximum length (bytes) of a stored record. The record of a 64 MiB file of which every second segment is
missing needs less than 1 MB."""

_Entity = Annotated[int, Meta(ge=0, le=(1 << 16) - 1)]
_Long = Annotated[int, Meta(ge=0, le=HIGHEST_NUMBER)]
_Stretch = tuple[_Long, _Long]
T = TypeVar("T")


class FileError(KnightCubeError):
    """Raised if a file operation or transfer is not possible. The error text states the reason."""


class Ranges:
    """Set of byte offsets in a file, stored as sorted, disjoint, half-open ranges."""

    def __init__(self, pairs: Iterable[tuple[int, int]] = ()) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []
        for begin, end in pairs:
            self.add(begin, end)

    def __bool__(self) -> bool:
        return bool(self._begins)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Byte ranges (begin, end) in ascending order."""
        return list(zip(self._begins, self._ends, strict=True))

    @property
    def total(self) -> int:
        """Total number of bytes in all ranges."""
        return sum(self._ends) - sum(self._begins)

    def cover(self, size: int) -> bool:
        """Return whether the set contains all byte offsets below `size`."""
        return size == 0 or (bool(self._begins) and self._begins[0] == 0 and self._ends[0] >= size)

    @property
    def end(self) -> int:
        """End of the last byte range, 0 for an empty set."""
        return self._ends[-1] if self._ends else 0

    def add(self, begin: int, end: int) -> None:
        """Add a byte range and merge it with overlapping or adjacent ranges."""
        if begin >= end:
            return
        first = bisect_left(self._ends, begin)
        last = bisect_right(self._begins, end)
        if first < last:
            begin, end = min(begin, self._begins[first]), max(end, self._ends[last - 1])
        self._begins[first:last], self._ends[first:last] = [begin], [end]

    def take(self, most: int) -> tuple[int, int]:
        """Remove and return at most `most` bytes of the first range. Raises IndexError for an empty set."""
        begin, end = self._begins[0], min(self._ends[0], self._begins[0] + most)
        self._begins[0] = end
        if end == self._ends[0]:
            del self._begins[0], self._ends[0]
        return begin, end

    def gaps(self, begin: int, size: int, most: int) -> list[tuple[int, int]]:
        """Return the first `most` byte ranges between `begin` and `size` that are missing from the set."""
        found: list[tuple[int, int]] = []
        index = bisect_right(self._ends, begin)
        while begin < size and len(found) < most:
            known = index < len(self._begins)
            end = min(self._begins[index], size) if known else size
            if begin < end:
                found.append((begin, end))
            begin = self._ends[index] if known else size
            index += 1
        return found


class Outgoing(msgspec.Struct, frozen=True):
    """State of an outgoing transfer of file `path`, sent as `name`; `origin` identifies the command."""

    number: _Long
    destination: _Entity
    path: str
    name: str
    size: _Long
    modified_ns: int
    kind: Annotated[int, Meta(ge=0, le=15)]
    checksum: _Long | None = None
    origin: tuple[int, int, int, int] = (0, 0, 0, 0)
    suspended: bool = False


class Incoming(msgspec.Struct, frozen=True):
    """Stored state of an incoming transfer: received metadata and EOF, byte ranges on disk, and result."""

    source: _Entity
    number: _Long
    name: str | None = None
    size: _Long = 0
    kind: int = 0
    end: _Stretch | None = None
    ranges: tuple[_Stretch, ...] = ()
    finished: tuple[int, bool, int] | None = None
    suspended: bool = False


class Ending(msgspec.Struct, frozen=True):
    """Result of an ended incoming transfer, stored to answer PDUs that the sender repeats."""

    source: _Entity
    number: _Long
    condition: int
    complete: bool
    kept: int


class _Numbers(msgspec.Struct, frozen=True):
    last: _Long = 0
    endings: tuple[Ending, ...] = ()


def problem_of_name(name: str) -> str:
    """Return why a name is not allowed, or ""; an allowed name stays in the folder of received files."""
    parts = name.split("/")
    if len(name.encode(errors="replace")) >= LONGEST_NAME:
        return f"{name[:LONGEST_NAME]!r} is too long: a name has fewer than {LONGEST_NAME} bytes"
    if len(parts) > _MOST_PARTS:
        return f"{name!r} has {len(parts)} parts: the name of a file has at most {_MOST_PARTS}"
    if not all(_PART.fullmatch(part) for part in parts):
        return f"{name!r} is not an allowed name: use letters, digits and . _ + -, but no leading . + -"
    return ""


def files_folder(keys: Path) -> Path:
    """Return the satellite's folder for transferred files, which is a sibling of the folder of keys."""
    return keys.absolute().parent / "files"


class Store:
    """Folder with the state of one CFDP entity. Only one process may use the folder.

    Attributes:
        received: folder of received files.
        last: last assigned transaction number.
        endings: results of ended incoming transfers, oldest first.
    """

    def __init__(self, folder: Path) -> None:
        """Create the folder if it does not exist. Raises UsageError if it cannot be created."""
        self._folder = folder / "transfers"
        self.received = folder / "received"
        try:
            for path in (self._folder, self.received):
                make_folder(path)
            # The inode number of a folder is constant on each file system only while the folder is open.
            self._open = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise UsageError(f"{folder}: cannot be made: {error.strerror or error}") from error
        weakref.finalize(self, os.close, self._open)
        numbers = _read(self._folder / "numbers.json", _Numbers) or _Numbers()
        self.last, self.endings = numbers.last, numbers.endings

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Lock the folder against a second process. Raises UsageError if another process has locked it."""
        with locked(self._folder / "owner", f"{self._folder}: another process transfers these files"):
            remove_unfinished(self._folder)
            yield

    def new_number(self, utc_ns: int) -> int:
        """Reserve and store a new transaction number.

        The number is at least the UTC in seconds, so that it is new even if the last number was lost.
        """
        seconds = (
            max(utc_ns, 0) // 10**9 & HIGHEST_NUMBER
        )  # a wrong clock can show a time after the year 2106
        self._write_numbers(max(self.last + 1, seconds) & HIGHEST_NUMBER or 1, self.endings)
        return self.last

    def add_ending(self, ending: Ending) -> None:
        """Keep the result of an ended incoming transfer, and store it if the disk can be written."""
        self.endings = (*self.endings, ending)[-_KEPT_ENDINGS:]
        with suppress(FileError):  # an error here would hold up all other transfers
            self._write_numbers(self.last, self.endings)

    def outgoing(self) -> list[Outgoing]:
        """Return the open outgoing transfers, ignoring damaged records and a folder that cannot be listed."""
        return self._records("out-*.json", Outgoing)

    def incoming(self) -> list[Incoming]:
        """Return the open incoming transfers, ignoring damaged records and a folder that cannot be listed."""
        return self._records("in-*.json", Incoming)

    def save(self, record: Outgoing | Incoming) -> None:
        """Store a record durably. Raises FileError if the disk cannot be written."""
        self._write(self._path(record), record)

    def remove(self, record: Outgoing | Incoming) -> None:
        """Remove a record and, for an incoming transfer, first the received data.

        Received data without a record would stay on the disk, because nothing refers to the file.
        """
        with suppress(OSError):
            if isinstance(record, Incoming):
                self.part(record).unlink(missing_ok=True)
            self._path(record).unlink(missing_ok=True)

    def part(self, record: Incoming) -> Path:
        """Return the path of the data of an incomplete incoming file."""
        return self._path(record).with_suffix(".part")

    def has_file(self, record: Incoming) -> bool:
        """Return whether the file of a complete transfer is on the disk.

        Returns True also if failing accesses to the disk prevent the check.
        """
        for path in (self.part(record), self.received / str(record.name)):
            try:
                path.stat()
            except FileNotFoundError:
                continue
            except OSError:
                return True
            return True
        return False

    def place(self, record: Incoming) -> None:
        """Move a completely received file to its final path, or sync the path if the file was moved before.

        Raises FileError if the file cannot be moved; a further call repeats the failed operation.
        """
        assert record.name is not None
        target, problem = self.received / record.name, "cannot be placed"
        try:
            make_folder(target.parent)
            try:
                os.replace(self.part(record), target)
            except FileNotFoundError:
                target.stat()
            problem = "is stored, but a power loss may remove it"
            make_lasting(target.parent)
        except OSError as error:
            raise FileError(f"{record.name}: {problem}: {error.strerror or error}") from error

    def room(self, copy: bool = False) -> int:
        """Return the disk space (bytes) available for a received file, or for its selected copy if `copy`."""
        return max(0, shutil.disk_usage(self._folder).free - (_COPY_FREE_BYTES if copy else _FREE_BYTES))

    def _records(self, pattern: str, shape: type[T]) -> list[T]:
        for _ in range(_TRIES):
            with suppress(OSError):
                found = (_read(path, shape) for path in sorted(self._folder.glob(pattern)))
                return [record for record in found if record is not None]
        return []  # a damaged folder must not keep the link from starting

    def _path(self, record: Outgoing | Incoming) -> Path:
        if isinstance(record, Outgoing):
            return self._folder / f"out-{record.number:010d}.json"
        return self._folder / f"in-{record.source:05d}-{record.number:010d}.json"

    def _write_numbers(self, last: int, endings: tuple[Ending, ...]) -> None:
        self._write(self._folder / "numbers.json", _Numbers(last, endings))
        self.last, self.endings = last, endings

    def _write(self, path: Path, values: msgspec.Struct) -> None:
        """Store values as a record. Raises FileError if the disk cannot be written.

        A folder that was mounted later belongs to other transfers, whose records must not be replaced.
        """
        try:
            if not os.path.samestat(self._folder.stat(), os.fstat(self._open)):
                raise FileError(f"{self._folder}: another folder is mounted there: restart this program")
        except OSError as error:
            raise FileError(f"{path}: cannot be written: {error.strerror or error}") from error
        write_whole(path, to_record(msgspec.json.encode(values)))


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file atomically and durably. Raises FileError if the disk cannot be written.

    A failure leaves no incomplete file, which would occupy the rest of a full disk.
    """
    beside = path.with_name(path.name + "~")
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
        make_lasting(path.parent)
    except OSError as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise FileError(f"{path}: cannot be written: {error.strerror or error}") from error


def _read(path: Path, shape: type[T]) -> T | None:
    """Return the record stored in a file, or None if the file is missing or damaged."""
    try:
        line = line_of(read_regular(path, _LONGEST_RECORD) or b"")
        return None if line is None else msgspec.json.decode(line, type=shape)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
