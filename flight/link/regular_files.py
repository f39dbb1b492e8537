"""Reading regular files with a size limit, records with checksums, durable writing and file locks.

A FIFO at the path of an expected file would block the reader, and a huge sparse file would exhaust the
memory.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from knightcube.errors import UsageError


def read_regular(path: Path, most: int) -> bytes | None:
    """Return the content of a file of at most `most` bytes, or None if the file does not exist.

    The file's type and size are checked before reading. Raises OSError for a file longer than `most` bytes
    and for a path that is not a regular file.
    """
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


def overwrite(path: Path, data: bytes) -> bool:
    """Overwrite a file in place and sync it to disk. Return whether the file was written."""
    try:
        new = not path.exists()
        # Without O_NONBLOCK, opening a FIFO at this path would block.
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
        try:
            if os.pwrite(file, data, 0) != len(data):
                return False
            os.ftruncate(file, len(data))
            os.fsync(file)
        finally:
            os.close(file)
        if new:
            make_lasting(path.parent)
    except OSError:
        return False
    return True


@contextmanager
def locked(path: Path, problem: str) -> Iterator[None]:
    """Hold the lock of a file.

    Raises UsageError with the text `problem` if another process holds the lock.
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
