"""The state on disk: two copies, each with a generation number and a CRC, each replaced atomically.

A copy is one line of JSON and a line with the CRC-32 of the first. Both are written each time, one after the
other, so that one copy survives a crash or damage to the other.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from flight.link import events
from flight.link.events import EventKind
from flight.loop.state.content import StoredState, check
from flight.loop.state.files import LARGEST_FILE, Files, LinuxFiles, replace_file

COPIES = ("state-a.json", "state-b.json")

Report = Callable[[EventKind, str], None]
"""Reports an event: kind and text."""


class _Copy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of one file."""

    generation: Annotated[int, Meta(ge=1, le=2**62)]
    state: StoredState


@dataclass(frozen=True, slots=True)
class _Read:
    """One file as read; `problem` is empty when the copy is valid, or missing."""

    name: str
    copy: _Copy | None
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

    def _read(self, name: str) -> _Read:
        try:
            data = self._files.read(self._folder / name)
        except OSError as error:
            return _Read(name, None, f"cannot be read: {error.strerror or error}")
        if data is None:
            return _Read(name, None, "")
        try:
            return _Read(name, decode(data), "")
        except ValueError as error:
            return _Read(name, None, str(error))


def encode(generation: int, state: StoredState) -> bytes:
    """Return the bytes of one copy. Raises ValueError for a state that `decode` would reject."""
    check(state)
    line = msgspec.json.encode(_Copy(generation, state)) + b"\n"
    data = line + b"%08x\n" % zlib.crc32(line)
    decode(data)
    return data


def decode(data: bytes) -> _Copy:
    """Return the content of one copy. Raises ValueError for anything that `encode` does not produce."""
    if len(data) > LARGEST_FILE:
        raise ValueError(f"{len(data)} bytes are too many")
    line, end, crc = data.partition(b"\n")
    if crc != b"%08x\n" % zlib.crc32(line + end):
        raise ValueError(f"torn or corrupt, {len(data)} bytes")
    try:
        copy = msgspec.json.decode(line, type=_Copy)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"holds another kind of state: {str(error)!r}") from error
    check(copy.state)
    return copy
