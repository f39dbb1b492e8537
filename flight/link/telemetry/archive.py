"""Storage of logs: segment files of bounded size, and one folder per run of the board.

Packets are appended to numbered segments without buffering, so that a process killed at any moment leaves
at most one incomplete packet, the last. The oldest segments are deleted if a log exceeds its budget.

Each boot creates the folder of a new run, such as `run-000042`; a run's folder is never written by a second
boot. Runs are ordered by number, because the wall clock of a board may be wrong. The oldest runs are
deleted to keep a budget and to free a full disk, but never the last run. If nothing can be written, the
flight continues without a log.
"""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from knightcube.errors import UsageError

SUFFIX = ".ccsds"


class SegmentFile(Protocol):
    """Interface of an unbuffered binary file, as the log uses it."""

    def write(self, data: bytes, /) -> int | None:
        """Append bytes and return the number of bytes written. Raises OSError."""

    def truncate(self, size: int, /) -> int:
        """Truncate the file to `size` bytes. Raises OSError."""

    def fileno(self) -> int:
        """Return the file descriptor."""

    def close(self) -> None:
        """Close the file. Raises OSError."""


def make_lasting(folder: Path) -> None:
    """Sync a folder, so that the names of its files survive a loss of power. Raises OSError."""
    names = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(names)
    finally:
        os.close(names)


def open_segment(path: Path) -> SegmentFile:
    """Create a segment and make its name durable. Raises OSError, also if the file exists.

    The segment is opened for appending, so that a write after a truncation follows the last whole packet.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
    file = os.fdopen(os.open(path, flags, 0o644), "wb", buffering=0)
    try:
        make_lasting(path.parent)
    except OSError:  # the file is removed, so that the next attempt can create it
        file.close()
        path.unlink(missing_ok=True)
        raise
    return file


def find_segments(folder: Path, stem: str) -> list[Path]:
    """Return the segments of a log, oldest first, or an empty list if there is none."""
    pattern = re.compile(re.escape(stem) + r"-(\d+)" + re.escape(SUFFIX))
    matches = ((pattern.fullmatch(path.name), path) for path in folder.glob(f"{stem}-*{SUFFIX}"))
    return [path for _, path in sorted((int(match[1]), path) for match, path in matches if match)]


class SegmentStore:
    """Appends packets to `<stem>-0001.ccsds`, `<stem>-0002.ccsds`, ... in an existing folder.

    The content of the files depends on the packets only, not on their division among calls.

    Attributes:
        packets: number of packets written completely.
        dropped: number of segments deleted to keep the budget.
    """

    def __init__(
        self,
        folder: Path,
        stem: str,
        segment_bytes: int,
        budget_bytes: int,
        opener: Callable[[Path], SegmentFile] = open_segment,
    ) -> None:
        """Create the first segment. Raises OSError."""
        self._folder = folder
        self._stem = stem
        self._segment_bytes = segment_bytes
        self._budget_bytes = budget_bytes
        self._opener = opener
        self._finished: deque[tuple[Path, int]] = deque()  # with their sizes, oldest first
        self._number = 0
        self.packets = 0
        self.dropped = 0
        self._open_next()

    def append(self, packets: Sequence[bytes]) -> None:
        """Write packets, and begin a new segment whenever one is full. Raises OSError.

        After a failure `packets` counts the packets written completely. The segment ends with the last of
        them, and `append` may be called again.
        """
        chunk: list[bytes] = []
        size = self._size
        for packet in packets:
            if size and size + len(packet) > self._segment_bytes:
                self._write(chunk)
                self._turn()
                chunk, size = [], 0
            chunk.append(packet)
            size += len(packet)
        self._write(chunk)

    def removed(self) -> bool:
        """Return whether another process has removed the segment. Raises OSError."""
        try:
            os.stat(self._path)
        except FileNotFoundError:
            return True
        return False

    def sync(self) -> None:
        """Make the written packets durable. Raises OSError."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Sync and close the segment. Raises OSError."""
        try:
            self.sync()
        finally:
            self._file.close()

    def _open_next(self) -> None:
        """Begin the next segment; after a failure the current segment remains in use."""
        path = self._folder / f"{self._stem}-{self._number + 1:04d}{SUFFIX}"
        self._file = self._opener(path)
        self._path = path
        self._number += 1
        self._size = 0

    def _turn(self) -> None:
        """Finish the segment and begin the next."""
        self.sync()
        old, finished = self._file, (self._path, self._size)
        self._open_next()
        self._finished.append(finished)
        old.close()

    def _write(self, chunk: list[bytes]) -> None:
        data = b"".join(chunk)
        self._make_room(len(data))
        written = 0
        try:
            while written < len(data):
                written += self._file.write(data[written:]) or 0
        except OSError:
            self._keep_whole(chunk, written)
            raise
        self._size += len(data)
        self.packets += len(chunk)

    def _make_room(self, coming: int) -> None:
        """Delete the oldest segments, except the newest, until `coming` bytes fit into the budget."""
        total = self._size + coming + sum(size for _, size in self._finished)
        while self._finished and total > self._budget_bytes:
            path, size = self._finished.popleft()
            path.unlink(missing_ok=True)
            self.dropped += 1
            total -= size

    def _keep_whole(self, chunk: list[bytes], written: int) -> None:
        """Count the packets of `chunk` within `written` bytes, and truncate the file after them."""
        whole = 0
        for packet in chunk:
            if whole + len(packet) > written:
                break
            whole += len(packet)
            self.packets += 1
        try:
            self._file.truncate(self._size + whole)
            self._size += whole
        except OSError:  # readers skip the incomplete packet
            self._size += written


MOST_RUNS = 1000
"""Maximum number of runs. A board that crashes at every start would create many small runs."""

LEAST_FREE_BYTES = 64 << 20
"""Free disk space (bytes) at the start of a run, enough for hours of packets."""

DISK_TROUBLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS})
"""Errors of a full or failing disk. Other errors indicate a wrong path."""

_NAME = re.compile(r"run-(\d{6,})")


@dataclass(frozen=True, slots=True)
class NewRun:
    """Folder of a new run, which is missing if the disk cannot be written, and the number of dropped runs."""

    folder: Path
    dropped: int


def find_runs(archive: Path) -> list[Path]:
    """Return the folders of an archive's runs, oldest first, or an empty list if there is none."""
    return [path for _, path in _numbered(archive) if path.is_dir() and not path.is_symlink()]


def begin_run(archive: Path, budget_bytes: int, coming_bytes: int) -> NewRun:
    """Create the folder of the next run, and free `coming_bytes`, the maximum size of the run.

    Only folders of runs are removed. Raises UsageError if the budget is smaller than the new run or if the
    path is wrong. A failing disk is reported by the log that writes to it.
    """
    if coming_bytes > budget_bytes:
        raise UsageError(
            f"archive budget of {budget_bytes} bytes: it must hold the logs of one run, {coming_bytes} bytes"
        )
    runs, taken = find_runs(archive), _numbered(archive)
    folder = archive / f"run-{taken[-1][0] + 1 if taken else 1:06d}"
    dropped = _make_room(runs, budget_bytes - coming_bytes)
    while dropped < len(runs) - 1 and _free(archive) < LEAST_FREE_BYTES:
        _drop(runs[dropped])
        dropped += 1
    try:
        folder.mkdir(parents=True)
        make_lasting(archive)
    except OSError as error:
        if error.errno not in DISK_TROUBLE:
            raise UsageError(f"{archive}: no run can be begun there: {error.strerror or error}") from error
    return NewRun(folder, dropped)


def _free(archive: Path) -> float:
    """Return the free space (bytes) of the archive's disk, infinity if it is unknown."""
    try:
        disk = os.statvfs(archive)
    except OSError:
        return math.inf
    return float(disk.f_bavail * disk.f_frsize)


def _drop(run: Path) -> None:
    """Remove a run; files that cannot be removed now are removed at the next boot."""
    shutil.rmtree(run, ignore_errors=True)


def _numbered(archive: Path) -> list[tuple[int, Path]]:
    """Return all paths that have the name of a run, with their numbers, in order."""
    matches = ((_NAME.fullmatch(path.name), path) for path in archive.glob("run-*"))
    return sorted((int(match[1]), path) for match, path in matches if match)


def _make_room(runs: list[Path], room_bytes: int) -> int:
    """Drop the oldest runs until the others fit into the room; return the number of dropped runs."""
    sizes = [_size(run) for run in runs]
    total, dropped = sum(sizes), 0
    while dropped < len(runs) and (total > room_bytes or len(runs) - dropped >= MOST_RUNS):
        _drop(runs[dropped])
        total -= sizes[dropped]
        dropped += 1
    return dropped


def _size(folder: Path) -> int:
    """Return the size (bytes) of all files below a folder; files that vanish meanwhile are not counted."""
    total = 0
    for path in folder.rglob("*"):
        try:
            if path.is_file() and not path.is_symlink():
                total += path.stat().st_size
        except OSError:
            continue
    return total
