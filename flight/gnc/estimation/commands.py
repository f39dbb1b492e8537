"""What the coils were commanded, and from when on: read again when a measurement comes late."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from flight.gnc.estimation.rigid_body import RigidBody, Torquing
from flight.gnc.math.arrays import FloatArray


class CommandHistory:
    """The recent commands in order of time; before the first one nothing is driven."""

    def __init__(self, body: RigidBody, history_ns: int) -> None:
        self._body = body
        self._idle = body.torquing(np.zeros(3))
        self._history_ns = history_ns
        self._times: list[int] = []
        self._torquings: list[Torquing] = []

    def __len__(self) -> int:
        return len(self._times)

    def note(self, time_ns: int, currents: FloatArray, field: FloatArray | None, known: bool = True) -> None:
        """Note the coil currents (3,) A in force from `time_ns` on, in the field (3,) T, reference axes."""
        torquing = self._body.torquing(currents, field, known)
        if self._torquings and self._torquings[-1] == torquing:
            return
        self._times.append(time_ns)
        self._torquings.append(torquing)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # now and then, not each cycle
            del self._times[:oldest], self._torquings[:oldest]

    def doubt(self, since_ns: int) -> None:
        """Take nothing that was noted for the time from `since_ns` on for known."""
        first = bisect.bisect_left(self._times, since_ns)
        if self._torquings and (first == len(self._times) or self._times[first] > since_ns):
            self._torquings.insert(first, self.at(since_ns))
            self._times.insert(first, since_ns)
        self._torquings[first:] = [replace(torquing, known=False) for torquing in self._torquings[first:]]

    def at(self, time_ns: int) -> Torquing:
        """Return what the coils do at a time."""
        index = max(bisect.bisect_right(self._times, time_ns) - 1, 0)
        return self._torquings[index] if self._torquings else self._idle

    def spans(self, from_ns: int, to_ns: int) -> Iterator[tuple[Torquing, int]]:
        """Yield what is in force between two times and for how many ns, piece by piece, forward only."""
        time_ns = from_ns
        index = max(bisect.bisect_right(self._times, from_ns) - 1, 0)
        while time_ns < to_ns:
            torquing = self._torquings[index] if self._torquings else self._idle
            more = index + 1 < len(self._torquings)
            until_ns = min(to_ns, self._times[index + 1]) if more else to_ns
            if until_ns > time_ns:
                yield torquing, until_ns - time_ns
                time_ns = until_ns
            index += more
