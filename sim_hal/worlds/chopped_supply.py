"""The chopped current that three bridges draw from their supply, integrated exactly over any window.

A bridge draws its coil's current while its inputs differ and its enable input is high, none otherwise.
A coil's L/R of 0.1 ms is neglected beside the PWM's period of 20 ms (SN754410 and PCA9685 data sheets).
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import NamedTuple

from hal.drivers.pca9685 import COUNTS

Pulse = tuple[int, int]
"""When in a period an output is high: (first count, how many counts)."""

_HISTORY_NS = 500_000_000


class Bridge(NamedTuple):
    """The pulses on inputs A and B of a bridge, and on its enable input."""

    a: Pulse
    b: Pulse
    enable: Pulse

    def net_counts(self) -> int:
        """Return for how many counts of a period, signed, the coil is driven; both inputs high brake."""
        if self.enable[1] == COUNTS:
            return self.a[1] - self.b[1]
        return common_counts(self.a, self.enable) - common_counts(self.b, self.enable)

    def driven(self) -> list[tuple[int, int]]:
        """Return the spans of counts [begin, end) in which the coil is driven either way."""
        if self.a == self.b:
            return []
        pulses = (self.a, self.b, self.enable)
        edges = {0, COUNTS}
        for first, length in pulses:
            edges |= {first, (first + length) % COUNTS}
        ordered = sorted(edges)
        spans = []
        for begin, end in pairwise(ordered):
            a, b, enabled = ((begin - first) % COUNTS < length for first, length in pulses)
            if enabled and a != b:
                spans.append((begin, end))
        return spans


class Chopping(NamedTuple):
    """The supply's current from `since_ns` on.

    Attributes:
        since_ns: when these outputs began.
        origin_ns: when the PWM counter was zero.
        period_ns: of the PWM.
        drawn: of each bridge the pulses, and the current in A while it is driven.
    """

    since_ns: int
    origin_ns: int
    period_ns: float
    drawn: tuple[tuple[Bridge, float], ...]

    def charge(self, start_ns: int, end_ns: int) -> float:
        """Return the charge drawn between two times, in A ns."""
        periods = [divmod((time_ns - self.origin_ns) / self.period_ns, 1.0) for time_ns in (start_ns, end_ns)]
        (whole_0, part_0), (whole_1, part_1) = periods
        total = 0.0
        for bridge, current in self.drawn:
            for begin, end in bridge.driven() if current else ():
                at_0, at_1 = (min(max(part * COUNTS - begin, 0.0), end - begin) for part in (part_0, part_1))
                total += current * ((whole_1 - whole_0) * (end - begin) + at_1 - at_0)
        return total * self.period_ns / COUNTS


class ChoppedSupply:
    """The supply's current over the last half second."""

    def __init__(self) -> None:
        self._history: deque[Chopping] = deque()

    def note(self, chopping: Chopping) -> None:
        """Note that the outputs changed."""
        self._history.append(chopping)
        while len(self._history) > 1 and self._history[1].since_ns < chopping.since_ns - _HISTORY_NS:
            self._history.popleft()

    def charge(self, start_ns: int, end_ns: int) -> float:
        """Return the charge drawn between two times, in A ns; none before the history begins."""
        total, until_ns = 0.0, end_ns
        for chopping in reversed(self._history):
            begin_ns = max(chopping.since_ns, start_ns)
            if begin_ns < until_ns:
                total += chopping.charge(begin_ns, until_ns)
                until_ns = begin_ns
            if chopping.since_ns <= start_ns:
                break
        return total


def common_counts(a: Pulse, b: Pulse) -> int:
    """Return for how many counts of a period two pulses are high together."""
    lag = (b[0] - a[0]) % COUNTS
    # b's pulse as a sees it starts at lag, and what runs over the period's end comes back at its beginning.
    first = min(a[1], lag + b[1]) - lag
    wrapped = min(a[1], lag + b[1] - COUNTS)
    return max(0, first) + max(0, wrapped)
