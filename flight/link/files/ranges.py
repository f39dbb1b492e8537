"""Stretches of a file: sorted, disjoint, half open."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable


class Ranges:
    """A set of bytes of a file."""

    def __init__(self, pairs: Iterable[tuple[int, int]] = ()) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []
        for begin, end in pairs:
            self.add(begin, end)

    def __bool__(self) -> bool:
        return bool(self._begins)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The stretches, in order."""
        return list(zip(self._begins, self._ends, strict=True))

    @property
    def total(self) -> int:
        """How many bytes are in it."""
        return sum(self._ends) - sum(self._begins)

    @property
    def end(self) -> int:
        """The end of the last stretch, 0 of none."""
        return self._ends[-1] if self._ends else 0

    def add(self, begin: int, end: int) -> None:
        """Add a stretch; what it touches becomes one with it."""
        if begin >= end:
            return
        first = bisect_left(self._ends, begin)
        last = bisect_right(self._begins, end)
        if first < last:
            begin, end = min(begin, self._begins[first]), max(end, self._ends[last - 1])
        self._begins[first:last], self._ends[first:last] = [begin], [end]

    def take(self, most: int) -> tuple[int, int]:
        """Remove and return the first stretch, of `most` bytes at most. Raises IndexError when empty."""
        begin, end = self._begins[0], min(self._ends[0], self._begins[0] + most)
        self._begins[0] = end
        if end == self._ends[0]:
            del self._begins[0], self._ends[0]
        return begin, end

    def gaps(self, size: int) -> list[tuple[int, int]]:
        """Return the stretches of 0 to `size` that are not in it."""
        edges = [0, *(edge for pair in self.pairs for edge in pair), size]
        between = [(edges[i], min(edges[i + 1], size)) for i in range(0, len(edges), 2)]
        return [(begin, end) for begin, end in between if begin < end]
