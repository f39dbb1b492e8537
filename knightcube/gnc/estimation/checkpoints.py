"""The filter's recent checkpoints in order of time."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from operator import attrgetter

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.gnc.estimation.measurements import Measurement
from knightcube.gnc.estimation.replay import Checkpoint

_SPARE_NS = 1_000_000_000
"""Kept beyond the history, so that checkpoints are dropped in batches."""
_TIME = attrgetter("time_ns")


class CheckpointHistory:
    """Holds the checkpoints of the last `history_ns`; empty before the filter starts."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._checkpoints: list[Checkpoint] = []

    def __len__(self) -> int:
        return len(self._checkpoints)

    def __getitem__(self, index: int) -> Checkpoint:
        return self._checkpoints[index]

    @property
    def newest(self) -> Checkpoint:
        """The newest checkpoint; raises IndexError without one."""
        return self._checkpoints[-1]

    @property
    def newest_used(self) -> Checkpoint:
        """The newest checkpoint whose measurement passed the gate, else the newest."""
        return next((c for c in reversed(self._checkpoints) if c.used), self._checkpoints[-1])

    def at(self, time_ns: int) -> Checkpoint | None:
        """Return the last checkpoint up to a time, None before the first."""
        index = bisect.bisect_right(self._checkpoints, time_ns, key=_TIME)
        return self._checkpoints[index - 1] if index else None

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s from the last checkpoint up to `begin_ns` on.

        They end with the first from `end_ns` on, or the newest. None where no checkpoint is as old as that.
        """
        first = bisect.bisect_right(self._checkpoints, begin_ns, key=_TIME)
        last = bisect.bisect_left(self._checkpoints, end_ns, key=_TIME)
        spanning = self._checkpoints[first - 1 : last + 1]
        if not first:
            return None
        return np.array([c.time_ns for c in spanning]), np.array([c.state.rate for c in spanning])

    def index_before(self, begin_ns: int) -> int:
        """Return how many checkpoints lie up to `begin_ns`, or up to the start of a mean that spans it."""
        while True:
            index = bisect.bisect_right(self._checkpoints, begin_ns, key=_TIME)
            spanning = [c.measurement.begin_ns for c in self._checkpoints[index:]]
            earliest = min(spanning, default=begin_ns)
            if earliest >= begin_ns:
                return index
            begin_ns = earliest

    def measurements_from(self, index: int) -> list[Measurement]:
        """Return the measurements of the checkpoints from `index` on."""
        return [checkpoint.measurement for checkpoint in self._checkpoints[index:]]

    def extend(self, checkpoints: Sequence[Checkpoint]) -> None:
        """Append checkpoints."""
        self._checkpoints += checkpoints

    def truncate(self, index: int) -> None:
        """Drop the checkpoints from `index` on."""
        del self._checkpoints[index:]

    def replace_after(self, base: Checkpoint, checkpoints: Sequence[Checkpoint]) -> None:
        """Replace the checkpoints after `base` by others."""
        place = next(i for i in range(len(self._checkpoints) - 1, -1, -1) if self._checkpoints[i] is base)
        self._checkpoints[place + 1 :] = checkpoints

    def restart(self, first: Checkpoint | None) -> None:
        """Drop all checkpoints and begin with `first`."""
        self._checkpoints = [] if first is None else [first]

    def forget(self, now_ns: int) -> None:
        """Drop checkpoints that are too old, in batches; keeps the newest."""
        checkpoints = self._checkpoints
        horizon_ns = now_ns - self._history_ns
        if len(checkpoints) > 2 and checkpoints[0].time_ns < horizon_ns - _SPARE_NS:
            keep = bisect.bisect_left(checkpoints, horizon_ns, key=_TIME)
            del checkpoints[: min(keep, len(checkpoints) - 1)]
