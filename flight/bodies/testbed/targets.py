"""The commanded attitudes over mission time: the steps of a demonstration."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

COMMANDED = 1000
"""Slews that are commanded are numbered from here on."""
KEPT = 65535
"""The number of an attitude that is only held."""


@dataclass(frozen=True, slots=True)
class Target:
    """From mission time `at_ns` on reach `q2` at `rate` rad/s and keep that rate: zero holds the attitude."""

    index: int
    at_ns: int
    q2: float
    rate: float = 0.0


class TargetSequence:
    """Targets in order of time."""

    def __init__(self, steps: Sequence[tuple[float, float, float]]) -> None:
        """Take (mission time in s, q2, rate in rad/s) of each step; the first stands at 0."""
        self._targets = [Target(i, round(at * 1e9), q2, rate) for i, (at, q2, rate) in enumerate(steps)]
        self._times = [target.at_ns for target in self._targets]

    def at(self, mission_time_ns: int) -> Target:
        """Return the target in force."""
        return self._targets[max(bisect.bisect_right(self._times, mission_time_ns) - 1, 0)]
