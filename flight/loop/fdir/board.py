"""Reads a Linux board's resources from /proc and /sys: the `ResourceReader` of real-time flights."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

from flight.loop.fdir.resources import ResourceSample

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


class Board:
    """Reads resources from the kernel; values that the kernel does not provide are NaN."""

    def __init__(self, log_folder: Path, proc: Path = Path("/proc"), thermal: Path | None = None) -> None:
        """Take the flight log's folder, and the kernel's folders of processes and thermal zones."""
        self._folder = log_folder
        self._proc = proc
        self._thermal = thermal or Path("/sys/class/thermal")

    def __call__(self, now_ns: int) -> ResourceSample:
        """Return the board's resources now."""
        process = os.getpid()
        members = [process, *self._below(process)]
        return ResourceSample(
            now_ns,
            self._cpu(process),
            self._resident(process),
            math.fsum(self._proportional(member) for member in members),
            self._disk_free(),
            self._temperature(),
        )

    def _below(self, parent: int) -> Iterator[int]:
        """Yield all descendants of `parent`, its workers."""
        for task in sorted((self._proc / str(parent) / "task").glob("*/children")):
            for word in _read(task).split():
                yield int(word)
                yield from self._below(int(word))

    def _cpu(self, process: int) -> float:
        # The name in brackets may hold any character; user and system time are fields 14 and 15 (proc(5)).
        words = _read(self._proc / str(process) / "stat").rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / _TICKS if len(words) > 12 else math.nan

    def _resident(self, process: int) -> float:
        words = _read(self._proc / str(process) / "statm").split()
        return float(words[1]) * _PAGE if len(words) > 1 else math.nan

    def _proportional(self, process: int) -> float:
        """Return the proportional set size in bytes; 0 for a process that has ended, waited for or not."""
        for line in _read(self._proc / str(process) / "smaps_rollup").splitlines():
            if line.startswith("Pss:"):
                return float(line.split()[1]) * 1024.0
        state = _read(self._proc / str(process) / "stat").rpartition(")")[2].split()[:1]
        return 0.0 if state in ([], ["Z"], ["X"]) else math.nan

    def _disk_free(self) -> float:
        try:
            room = os.statvfs(self._folder)
        except OSError:
            return math.nan
        return float(room.f_bavail) * room.f_frsize

    def _temperature(self) -> float:
        found = []
        for zone in sorted(self._thermal.glob("thermal_zone*/temp")):
            word = _read(zone).strip()
            if word.lstrip("-").isdigit():
                found.append(int(word) * 1e-3)
        return max(found, default=math.nan)


def _read(path: Path) -> str:
    """Return the content of a kernel file; empty when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
