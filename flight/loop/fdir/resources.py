"""Monitors processor, memory, disk and temperature of the board, and steps of the wall clock.

A `ResourceReader` takes the samples (`Board` on Linux, a script in tests) on a ticker outside the control
loop, because the kernel may take milliseconds to answer.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from flight.loop.fdir import facts
from flight.loop.fdir.facts import Facts
from flight.schema.sections import Health
from hal.interfaces.wires import Clock

_HOUR = 3600.0
_LEAST_SLOPE_SAMPLES = 8


@dataclass(frozen=True, slots=True)
class ResourceSample:
    """One sample of the board's resources; NaN for values that are not available.

    Attributes:
        time_ns: monotonic.
        cpu: s, processor time of the control process since its start.
        resident: bytes, resident set size of the control process.
        proportional: bytes, proportional set size of all flight processes together.
        disk_free: bytes, free on the flight log's file system.
        temperature: degree C of the warmest zone.
    """

    time_ns: int
    cpu: float
    resident: float
    proportional: float
    disk_free: float
    temperature: float


class ResourceReader(Protocol):
    """Samples the board's resources."""

    def __call__(self, now_ns: int) -> ResourceSample:
        """Return a sample. Must not raise."""


@dataclass(frozen=True, slots=True)
class ResourceState:
    """Values derived from the samples; NaN before there are enough.

    Attributes:
        cpu_share: of one core, between the last two samples.
        memory_slope: bytes/s, by least squares over the window.
    """

    sample: ResourceSample | None = None
    cpu_share: float = math.nan
    memory_slope: float = math.nan


class ResourceMonitor:
    """Keeps the newest samples and updates the facts about resources."""

    def __init__(self, settings: Health) -> None:
        self._settings = settings
        self._warm: deque[ResourceSample] = deque(maxlen=max(round(_HOUR / settings.look_period), 2))
        self._begun_ns: int | None = None
        self.state = ResourceState()

    def adopt(self, settings: Health) -> None:
        """Go on with other bounds."""
        self._settings = settings

    def ingest(self, sample: ResourceSample) -> None:
        """Add a sample."""
        share = math.nan
        if self.state.sample is not None:
            span = (sample.time_ns - self.state.sample.time_ns) * 1e-9
            share = (sample.cpu - self.state.sample.cpu) / span if span > 0.0 else math.nan
        if self._begun_ns is None:
            self._begun_ns = sample.time_ns
        if (sample.time_ns - self._begun_ns) * 1e-9 >= self._settings.warm_up:
            self._warm.append(sample)
        self.state = ResourceState(sample, share, self._slope())

    def report(self, facts_: Facts, now_ns: int) -> None:
        """Update the facts from the newest sample."""
        sample, limits = self.state.sample, self._settings
        if sample is None:
            return
        slope = self.state.memory_slope * _HOUR
        for fact, value, limit, text in (
            (facts.CPU_HIGH, self.state.cpu_share, limits.cpu_share, "{:.2f} of a core, {:g} allowed"),
            (facts.MEMORY_GROWS, slope, limits.memory_slope, "{:.3g} bytes an hour, {:g} allowed"),
            (facts.MEMORY_HIGH, sample.proportional, limits.memory, "{:.4g} bytes, {:g} allowed"),
            (facts.DISK_LOW, -sample.disk_free, -limits.disk_free, "{:.3g} bytes free, {:g} wanted"),
            (facts.HOT, sample.temperature, limits.temperature, "{:.1f} deg C, {:g} is warm"),
            (facts.TOO_HOT, sample.temperature, limits.hottest, "{:.1f} deg C, {:g} allowed"),
        ):
            known = not math.isnan(value)
            facts_.update(fact, value > limit if known else None, now_ns, text.format(abs(value), abs(limit)))

    def _slope(self) -> float:
        if len(self._warm) < _LEAST_SLOPE_SAMPLES:
            return math.nan
        time = np.array([sample.time_ns for sample in self._warm]) * 1e-9
        memory = np.array([sample.proportional for sample in self._warm])
        time -= time.mean()
        if (time[-1] - time[0]) < self._settings.slope_window or not np.isfinite(memory).all():
            return math.nan
        return float(time @ (memory - memory.mean()) / (time @ time))


class ClockWatch:
    """Detects steps of the wall clock by comparing UTC with monotonic time."""

    def __init__(self, clock: Clock, threshold: float) -> None:
        """Watch `clock` for steps larger than `threshold` s."""
        self._clock = clock
        self._threshold_ns = round(threshold * 1e9)
        self._offset_ns: int | None = None
        self.steps = 0

    def look(self) -> float | None:
        """Return the step in s since the last call, None without one; slow drift is followed."""
        offset_ns = self._clock.utc_ns() - self._clock.now_ns()
        before_ns, self._offset_ns = self._offset_ns, offset_ns
        if before_ns is None or abs(offset_ns - before_ns) <= self._threshold_ns:
            return None
        self.steps += 1
        return (offset_ns - before_ns) * 1e-9


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
