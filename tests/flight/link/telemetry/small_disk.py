"""A disk with little free space, and the bytes that a log has written."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from flight.link.telemetry.log import SegmentFile, find_segments, open_segment


def content(folder: Path, stem: str = "flight") -> bytes:
    """Return the bytes that a log has written to its segments, in order."""
    return b"".join(path.read_bytes() for path in find_segments(folder, stem))


class SmallDisk:
    """A disk with `room` free bytes. The write that fills the disk is incomplete, and later writes fail."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.syncs = 0
        self.refusals = 0

    def open(self, path: Path) -> SegmentFile:
        """Open a segment on this disk."""
        return SmallDiskFile(self, open_segment(path))


class SmallDiskFile:
    """A segment file on a small disk."""

    def __init__(self, disk: SmallDisk, file: SegmentFile) -> None:
        self._disk = disk
        self._file = file

    def write(self, data: bytes, /) -> int | None:
        """Write as many bytes as fit on the disk."""
        if self._disk.room == 0 and data:
            self._disk.refusals += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fits = data[: self._disk.room]
        self._disk.room -= len(fits)
        return self._file.write(fits)

    def truncate(self, size: int, /) -> int:
        """Truncate the file."""
        return self._file.truncate(size)

    def fileno(self) -> int:
        """Count a sync, and return the file descriptor."""
        self._disk.syncs += 1
        return self._file.fileno()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
