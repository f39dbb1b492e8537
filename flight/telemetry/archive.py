"""The runs of a board: a folder for each boot under one roof, the oldest dropped to keep a budget.

A service restarts into the same place, and a run's folder is never written twice: `begin_run` makes the next,
`run-000042`. Runs are in the order of their numbers: a board's wall clock may be wrong.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from flight.errors import UsageError

MOST_RUNS = 1000
"""A board that crashes at every start makes many runs of a few kilobytes: they are bounded by number too."""

_NAME = re.compile(r"run-(\d{6,})")


@dataclass(frozen=True, slots=True)
class NewRun:
    """A run's new folder, and how many old ones went to make room for it."""

    folder: Path
    dropped: int


def find_runs(archive: Path) -> list[Path]:
    """Return the folders of an archive's runs, oldest first; [] when it holds none."""
    return [path for _, path in _numbered(archive) if path.is_dir() and not path.is_symlink()]


def begin_run(archive: Path, budget_bytes: int, coming_bytes: int) -> NewRun:
    """Make the folder of the next run, and room for `coming_bytes`, all that it may come to hold.

    Nothing but the folders of runs is ever removed. Raises UsageError when the budget holds not even the
    coming run, or when the archive cannot be written.
    """
    if coming_bytes > budget_bytes:
        raise UsageError(
            f"archive budget of {budget_bytes} bytes: it must hold the logs of one run, {coming_bytes} bytes"
        )
    try:
        archive.mkdir(parents=True, exist_ok=True)
        runs, taken = find_runs(archive), _numbered(archive)
        folder = archive / f"run-{taken[-1][0] + 1 if taken else 1:06d}"
        folder.mkdir()
    except OSError as error:
        raise UsageError(f"{archive}: no run can be begun there: {error.strerror or error}") from error
    return NewRun(folder, _make_room(runs, budget_bytes - coming_bytes))


def _numbered(archive: Path) -> list[tuple[int, Path]]:
    """Return whatever has the name of a run, with its number, in order."""
    matches = ((_NAME.fullmatch(path.name), path) for path in archive.glob("run-*"))
    return sorted((int(match[1]), path) for match, path in matches if match)


def _make_room(runs: list[Path], room_bytes: int) -> int:
    """Drop the oldest runs until the others fit; returns how many went."""
    sizes = [_size(run) for run in runs]
    total, dropped = sum(sizes), 0
    while dropped < len(runs) and (total > room_bytes or len(runs) - dropped >= MOST_RUNS):
        shutil.rmtree(runs[dropped], ignore_errors=True)  # what cannot go now is tried again at the next boot
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
