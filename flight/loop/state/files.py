"""Replaces a small file atomically: a crash at any moment leaves either the old or the new content.

The order is that of Pillai et al., "All File Systems Are Not Created Equal" (OSDI 2014), section 2: write a
temporary file, sync it, rename it over the old one, sync the folder. Each call goes through `Files`, so that
a test can simulate a power loss before any of them.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Protocol

from flight.link.regular_files import read_regular
from flight.link.telemetry.segments import make_lasting

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
        """Open an empty file for writing, replacing an old one, also one that is no regular file."""
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
