"""The runs of a board: a folder for each boot under one roof, the oldest dropped to keep a budget.

A full disk does not keep a satellite from flying: the oldest runs go until there is room, but never the last,
which holds the history; where nothing can be written the flight goes on without a log.

A service restarts into the same place, and a run's folder is never written twice: `begin_run` makes the next,
`run-000042`. Runs are in the order of their numbers: a board's wall clock may be wrong.
"""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from flight.link.telemetry.segments import make_lasting
from knightcube.errors import UsageError

MOST_RUNS = 1000
"""A board that crashes at every start makes many runs of a few kilobytes: they are bounded by number too."""

LEAST_FREE_BYTES = 64 << 20
"""On the disk, for a run to begin with: hours of packets."""

DISK_TROUBLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS})
"""Errors of a full or failing disk; other errors are mistakes in the path."""

_NAME = re.compile(r"run-(\d{6,})")


@dataclass(frozen=True, slots=True)
class NewRun:
    """A run's new folder, not yet there on a disk that takes nothing, and how many old ones went for it."""

    folder: Path
    dropped: int


def find_runs(archive: Path) -> list[Path]:
    """Return the folders of an archive's runs, oldest first; [] when it holds none."""
    return [path for _, path in _numbered(archive) if path.is_dir() and not path.is_symlink()]


def begin_run(archive: Path, budget_bytes: int, coming_bytes: int) -> NewRun:
    """Make the folder of the next run, and room for `coming_bytes`, all that it may come to hold.

    Nothing but the folders of runs is ever removed. Raises UsageError when the budget holds not even the
    coming run, or when the path is wrong; a failing disk is reported by the log that writes to it.
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
    """Return the bytes that may yet be written to the archive's disk, infinity when it does not say."""
    try:
        disk = os.statvfs(archive)
    except OSError:
        return math.inf
    return float(disk.f_bavail * disk.f_frsize)


def _drop(run: Path) -> None:
    """Remove a run; what cannot go now is tried again at the next boot."""
    shutil.rmtree(run, ignore_errors=True)


def _numbered(archive: Path) -> list[tuple[int, Path]]:
    """Return whatever has the name of a run, with its number, in order."""
    matches = ((_NAME.fullmatch(path.name), path) for path in archive.glob("run-*"))
    return sorted((int(match[1]), path) for match, path in matches if match)


def _make_room(runs: list[Path], room_bytes: int) -> int:
    """Drop the oldest runs until the others fit; returns how many went."""
    sizes = [_size(run) for run in runs]
    total, dropped = sum(sizes), 0
    while dropped < len(runs) and (total > room_bytes or len(runs) - dropped >= MOST_RUNS):
        _drop(runs[dropped])
        total -= sizes[dropped]
        dropped += 1
    return dropped


def _size(folder: Path) -> int:
    """Return the bytes of all files below a folder; what vanishes meanwhile has none."""
    total = 0
    for path in folder.rglob("*"):
        try:
            if path.is_file() and not path.is_symlink():
                total += path.stat().st_size
        except OSError:
            continue
    return total
