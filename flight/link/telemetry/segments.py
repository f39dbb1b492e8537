"""The files of a log: packets appended to numbered segments of bounded size, the oldest dropped over budget.

Appends are unbuffered and of whole packets, so that a process killed at any moment leaves at most one packet
incomplete, the last.
"""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

SUFFIX = ".ccsds"


class SegmentFile(Protocol):
    """The part of an unbuffered binary file that the log uses."""

    def write(self, data: bytes, /) -> int | None:
        """Append bytes; returns how many were taken. Raises OSError."""

    def truncate(self, size: int, /) -> int:
        """Cut the file. Raises OSError."""

    def fileno(self) -> int:
        """Return the descriptor."""

    def close(self) -> None:
        """Close the file. Raises OSError."""


def make_lasting(folder: Path) -> None:
    """Have the names in a folder outlive a loss of power."""
    names = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(names)
    finally:
        os.close(names)


def open_segment(path: Path) -> SegmentFile:
    """Create a segment, never over an existing file, and make its name durable.

    It is opened for appending: after a write that failed half-way and was cut off, the next one follows on
    the last whole packet.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
    file = os.fdopen(os.open(path, flags, 0o644), "wb", buffering=0)
    try:
        make_lasting(path.parent)
    except OSError:  # nothing is left in the way of another try
        file.close()
        path.unlink(missing_ok=True)
        raise
    return file


def find_segments(folder: Path, stem: str) -> list[Path]:
    """Return the segments of a log, oldest first; [] when there is none."""
    pattern = re.compile(re.escape(stem) + r"-(\d+)" + re.escape(SUFFIX))
    matches = ((pattern.fullmatch(path.name), path) for path in folder.glob(f"{stem}-*{SUFFIX}"))
    return [path for _, path in sorted((int(match[1]), path) for match, path in matches if match)]


class SegmentStore:
    """Appends packets to `<stem>-0001.ccsds`, `<stem>-0002.ccsds`, ... in an existing folder.

    The files depend on the packets alone, not on how they were divided among calls.

    Attributes:
        packets: packets wholly written.
        dropped: segments deleted to keep the budget.
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
        """Write packets, turning to a new segment wherever one is full. Raises OSError.

        After a failure `packets` counts the packets kept; the segment ends with the last of them, and may
        be appended to again.
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
        """Return whether the segment was removed from outside. Raises OSError."""
        try:
            os.stat(self._path)
        except FileNotFoundError:
            return True
        return False

    def sync(self) -> None:
        """Make durable what was written. Raises OSError."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Sync and close the segment. Raises OSError."""
        try:
            self.sync()
        finally:
            self._file.close()

    def _open_next(self) -> None:
        """Begin the next segment; a failure leaves the present one as it is."""
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
        """Delete the oldest segments until the budget holds the coming bytes; the newest is never deleted."""
        total = self._size + coming + sum(size for _, size in self._finished)
        while self._finished and total > self._budget_bytes:
            path, size = self._finished.popleft()
            path.unlink(missing_ok=True)
            self.dropped += 1
            total -= size

    def _keep_whole(self, chunk: list[bytes], written: int) -> None:
        """Count the packets of `chunk` that lie within `written` bytes and cut off the rest."""
        whole = 0
        for packet in chunk:
            if whole + len(packet) > written:
                break
            whole += len(packet)
            self.packets += 1
        try:
            self._file.truncate(self._size + whole)
            self._size += whole
        except OSError:  # a reader copes with the stump as well
            self._size += written
