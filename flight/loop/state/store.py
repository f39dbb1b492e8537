"""The state on disk: two copies, each with a generation number and a CRC, each replaced atomically.

A copy is one line of JSON and a line with the CRC-32 of the first. Both copies are written each time, one
after the other, so that one copy survives a crash or damage to the other.

A file is replaced atomically: a crash at any moment leaves either the old or the new content. The order is
that of Pillai et al., "All File Systems Are Not Created Equal" (OSDI 2014), section 2: write a temporary
file, sync it, rename it over the old one, sync the folder. Each call goes through `Files`, so that a test can
simulate a power loss before any of them.

The number of each boot is also noted in the state's folder and in the folder of its run. Intact copies may
still be old, after the repair of a file system or from a backup: a state that counts fewer boots than a note
is recognised.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

import msgspec
from msgspec import Meta

from flight.link import events
from flight.link.events import EventKind
from flight.link.regular_files import read_regular
from flight.link.telemetry.archive import make_lasting
from flight.loop.state.content import StoredState, check

LARGEST_FILE = 1 << 20
"""Bytes of the largest file that is read."""


class Files(Protocol):
    """The file system calls that are used; each raises OSError."""

    def read(self, path: Path) -> bytes | None:
        """Return a file's content, None when there is no such file."""

    def create(self, path: Path) -> int:
        """Open an empty file for writing, replacing an old one; return its descriptor."""

    def write(self, file: int, data: bytes) -> int:
        """Write at most all of `data`; return how many bytes were written."""

    def sync(self, file: int) -> None:
        """Make the file's content durable."""

    def close(self, file: int) -> None:
        """Close a descriptor."""

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file atomically, replacing a file of the new name."""

    def sync_folder(self, folder: Path) -> None:
        """Make the names in a folder durable."""


class LinuxFiles:
    """The calls of the operating system."""

    def read(self, path: Path) -> bytes | None:
        """Return the content of a regular file of at most `LARGEST_FILE`, None when there is no such file."""
        return read_regular(path, LARGEST_FILE)

    def create(self, path: Path) -> int:
        """Open an empty file for writing, replacing an old one, also one that is not a regular file."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)

    def write(self, file: int, data: bytes) -> int:
        """Write at most all of `data`."""
        return os.write(file, data)

    def sync(self, file: int) -> None:
        """Make the file's content durable."""
        os.fsync(file)

    def close(self, file: int) -> None:
        """Close a descriptor."""
        os.close(file)

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file atomically."""
        os.rename(old, new)

    def sync_folder(self, folder: Path) -> None:
        """Make the names in a folder durable."""
        make_lasting(folder)


def replace_file(files: Files, path: Path, data: bytes) -> None:
    """Replace the file's content, durably. Raises OSError; the old content then remains."""
    temporary = path.with_suffix(".tmp")
    file = files.create(temporary)
    try:
        written = 0
        while written < len(data):
            written += files.write(file, data[written:])
        files.sync(file)
    except OSError:
        with contextlib.suppress(OSError):
            files.close(file)
        raise
    files.close(file)
    files.rename(temporary, path)
    files.sync_folder(path.parent)


NOTE = "boots"


def note_boot(folders: Iterable[Path], number: int) -> None:
    """Note the number of a boot in some folders. Never raises."""
    for folder in folders:
        with suppress(OSError):
            replace_file(LinuxFiles(), folder / NOTE, b"%d\n" % number)


def newest_boot(folders: Iterable[Path]) -> int:
    """Return the highest number noted in some folders, 0 where there is none. Never raises."""
    numbers = [0]
    for folder in folders:
        with suppress(OSError):
            text = (LinuxFiles().read(folder / NOTE) or b"").strip()
            if text.isdigit() and len(text) < 16:  # 2^53, the highest count, has 16 digits
                numbers.append(int(text))
    return max(numbers)


COPIES = ("state-a.json", "state-b.json")

Report = Callable[[EventKind, str], None]
"""Reports an event: kind and text."""


class _StateCopy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of one file."""

    generation: Annotated[int, Meta(ge=1, le=2**62)]
    state: StoredState


@dataclass(frozen=True, slots=True)
class _ReadCopy:
    """One file as read; `problem` is empty when the copy is valid, or missing."""

    name: str
    copy: _StateCopy | None
    problem: str


class StateStore:
    """Stores a StoredState in a folder. Not for two processes at once."""

    def __init__(self, folder: Path, report: Report, files: Files | None = None) -> None:
        self._folder = folder
        self._report = report
        self._files = files or LinuxFiles()
        self._generation = 0
        self._order: tuple[str, ...] = COPIES

    def load(self) -> StoredState:
        """Return the newest valid copy; defaults when there is none. Never raises.

        A lost state counts as an unclean shutdown.
        """
        read = [self._read(name) for name in COPIES]
        whole = [r for r in read if r.copy is not None]
        newest = max(whole, key=lambda r: r.copy.generation if r.copy else 0, default=None)
        # A missing copy is written first: only an interrupted first write leaves one copy alone.
        self._order = tuple(r.name for r in sorted(read, key=lambda r: r.copy is not None or bool(r.problem)))
        first = newest is None or newest.copy is None or newest.copy.generation == 1
        problems = ((r.name, r.problem or ("is gone" if r.copy is None and not first else "")) for r in read)
        bad = "; ".join(f"{name}: {problem}" for name, problem in problems if problem)
        if newest is None or newest.copy is None:
            if not bad:
                return StoredState()
            self._report(events.STATE_LOST, f"{bad}: defaults, taken for an unclean shutdown")
            return StoredState(running=True)
        self._generation = newest.copy.generation
        if bad:
            self._report(events.STATE_RECOVERED, f"{bad}: read from {newest.name}")
        return newest.copy.state

    def store(self, state: StoredState) -> bool:
        """Write both copies; return whether at least one is durable. Raises ValueError if invalid."""
        data = encode(self._generation + 1, state)
        failures = []
        for name in self._order:
            try:
                replace_file(self._files, self._folder / name, data)
            except OSError as error:
                failures.append(f"{name}: {error.strerror or error}")
        if failures:
            self._report(events.STATE_UNWRITTEN, "; ".join(failures))
        # A copy whose write failed late may still be on disk: a generation is never used twice.
        self._generation += 1
        return len(failures) < len(COPIES)

    def _read(self, name: str) -> _ReadCopy:
        try:
            data = self._files.read(self._folder / name)
        except OSError as error:
            return _ReadCopy(name, None, f"cannot be read: {error.strerror or error}")
        if data is None:
            return _ReadCopy(name, None, "")
        try:
            return _ReadCopy(name, decode(data), "")
        except ValueError as error:
            return _ReadCopy(name, None, str(error))


def encode(generation: int, state: StoredState) -> bytes:
    """Return the bytes of one copy. Raises ValueError for a state that `decode` would reject."""
    check(state)
    line = msgspec.json.encode(_StateCopy(generation, state)) + b"\n"
    data = line + b"%08x\n" % zlib.crc32(line)
    decode(data)
    return data


def decode(data: bytes) -> _StateCopy:
    """Return the content of one copy. Raises ValueError for anything that `encode` does not produce."""
    if len(data) > LARGEST_FILE:
        raise ValueError(f"{len(data)} bytes are too many")
    line, end, crc = data.partition(b"\n")
    if crc != b"%08x\n" % zlib.crc32(line + end):
        raise ValueError(f"torn or corrupt, {len(data)} bytes")
    try:
        copy = msgspec.json.decode(line, type=_StateCopy)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"holds another kind of state: {str(error)!r}") from error
    check(copy.state)
    return copy
