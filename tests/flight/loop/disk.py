"""A disk in memory that can lose power: unsynced data may be present, partly present, or absent."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from flight.loop.state import LinuxFiles

Names = dict[Path, int]


class PowerLostError(BaseException):
    """Simulated power loss. PowerLostError is not an OSError, so that the tested code cannot catch it."""


@dataclass
class _Inode:
    durable: bytes | None
    """Content at the last sync, or None if the file was never synced."""
    cached: bytes


class Disk(LinuxFiles):
    """A file system in which only synced content and names survive a power loss.

    `calls` counts the calls that change the disk. The power fails before call number `stop_before`. If
    `failure` is an errno, the power stays on, but this call and all later calls fail with the errno. The call
    named by `forget` ("sync" or "sync_folder") has no effect.
    """

    def __init__(
        self, stop_before: int | None = None, failure: int = 0, bite: int = 1 << 30, forget: str = ""
    ) -> None:
        self.calls = 0
        self._stop_before = stop_before
        self._failure = failure
        self._bite = bite
        self._forget = forget
        self._inodes: list[_Inode] = []
        self._open: dict[int, int] = {}
        self._names: Names = {}
        self._steps: list[Names] = [{}]
        """Sets of file names that are possible after a power loss: the durable names, and the names after
        each change."""

    def start(self, stop_before: int | None, failure: int = 0) -> None:
        """Reset the count of calls, and set the call that fails, or before which the power fails."""
        self.calls, self._stop_before, self._failure = 0, stop_before, failure

    def read(self, path: Path) -> bytes | None:
        """Return the content that a program reads while the power is on."""
        return self._inodes[self._names[path]].cached if path in self._names else None

    def create(self, path: Path) -> int:
        """Open an empty file."""
        self._count()
        if path in self._names:
            inode = self._names[path]
            self._inodes[inode].cached = b""
        else:
            inode = len(self._inodes)
            self._inodes.append(_Inode(None, b""))
            self._names = {**self._names, path: inode}
            self._steps.append(self._names)
        descriptor = 100 + self.calls
        self._open[descriptor] = inode
        return descriptor

    def write(self, file: int, data: bytes) -> int:
        """Write at most `bite` bytes of the data."""
        self._count()
        taken = data[: self._bite]
        self._inodes[self._open[file]].cached += taken
        return len(taken)

    def sync(self, file: int) -> None:
        """Make the file's content survive a power loss."""
        self._count()
        if self._forget != "sync":
            inode = self._inodes[self._open[file]]
            inode.durable = inode.cached

    def close(self, file: int) -> None:
        """Close a descriptor."""
        del self._open[file]

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file."""
        self._count()
        names = dict(self._names)
        names[new] = names.pop(old)
        self._names = names
        self._steps.append(names)

    def sync_folder(self, folder: Path) -> None:
        """Make the folder's file names survive a power loss."""
        self._count()
        assert folder.name == "state"
        if self._forget != "sync_folder":
            self._steps = [self._names]

    def after_power_loss(self) -> Iterator[Disk]:
        """Yield every disk state that is possible after a power loss."""
        for names in self._steps:
            present = sorted(set(names.values()))
            for contents in product(*(_possible(self._inodes[i]) for i in present)):
                disk = Disk()
                disk._inodes = [_Inode(content, content) for content in contents]
                disk._names = {path: present.index(inode) for path, inode in names.items()}
                disk._steps = [disk._names]
                yield disk

    def _count(self) -> None:
        if self._stop_before is not None and self.calls >= self._stop_before:
            if self._failure:
                raise OSError(self._failure, os.strerror(self._failure))
            raise PowerLostError
        self.calls += 1


NO_SPACE = errno.ENOSPC


def _possible(inode: _Inode) -> list[bytes]:
    """Return the possible contents of a file after power loss.

    Blocks that were not synced are old, new, torn or zero.
    """
    if inode.durable == inode.cached:
        return [inode.cached]
    half = len(inode.cached) // 2
    torn = [
        inode.cached,
        b"",
        inode.cached[:half],
        bytes(len(inode.cached)),
        inode.cached[:half] + bytes(half),
    ]
    return torn if inode.durable is None else [*torn, inode.durable]
