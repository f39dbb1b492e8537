"""The recent coil commands with their times; a replay of late measurements reads them again."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.rigid_body import RigidBody, Torquing


class CommandHistory:
    """The recent commands in order of time; before the first no coil is driven.

    Attributes:
        idle: the torquing of coils that are not driven.
    """

    def __init__(self, body: RigidBody, history_ns: int) -> None:
        self._body = body
        self.idle = body.torquing(np.zeros(3))
        self._history_ns = history_ns
        self._times: list[int] = []
        self._torquings: list[Torquing] = []

    def __len__(self) -> int:
        return len(self._times)

    def record(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None, known: bool = True
    ) -> None:
        """Record the coil currents (3,) A in force from `time_ns` on, in the field (3,) T, reference axes."""
        torquing = self._body.torquing(currents, field, known)
        if self._torquings and self._torquings[-1] == torquing:
            return
        self._times.append(time_ns)
        self._torquings.append(torquing)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # in batches, not each cycle
            del self._times[:oldest], self._torquings[:oldest]

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the currents in force from `since_ns` on as unknown."""
        first = bisect.bisect_left(self._times, since_ns)
        if self._torquings and (first == len(self._times) or self._times[first] > since_ns):
            self._torquings.insert(first, self.at(since_ns))
            self._times.insert(first, since_ns)
        self._torquings[first:] = [replace(torquing, known=False) for torquing in self._torquings[first:]]

    def at(self, time_ns: int) -> Torquing:
        """Return the torquing in force at a time."""
        index = max(bisect.bisect_right(self._times, time_ns) - 1, 0)
        return self._torquings[index] if self._torquings else self.idle

    def spans(self, from_ns: int, to_ns: int) -> Iterator[tuple[Torquing, int]]:
        """Yield each torquing in force between two times and its duration in ns, in order of time."""
        time_ns = from_ns
        index = max(bisect.bisect_right(self._times, from_ns) - 1, 0)
        while time_ns < to_ns:
            torquing = self._torquings[index] if self._torquings else self.idle
            more = index + 1 < len(self._torquings)
            until_ns = min(to_ns, self._times[index + 1]) if more else to_ns
            if until_ns > time_ns:
                yield torquing, until_ns - time_ns
                time_ns = until_ns
            index += more
