"""The recent coil commands, and the supply current that a healthy circuit would draw for them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from flight.loop.fdir.coils.hypotheses import NEWEST, Bounds, CoilFault
from flight.loop.fdir.coils.stuck_leg import NONE, Axes, Supplied
from hal.interfaces.readings import PowerReading
from knightcube.astro.arrays import FloatArray

_SAMPLES_NS = 25_000_000
_NOTED_LATE_NS = 25_000_000
"""A command is noted one cycle after it was written."""


class CoilCommands:
    """Commanded currents and brakes with their times; `braked` holds which bridges are braked now."""

    def __init__(self, reach_ns: int) -> None:
        """Keep the commands of the last `reach_ns`."""
        self._reach_ns = reach_ns
        self._commands: deque[tuple[int, tuple[float, ...]]] = deque()
        self._braked_ns = 0
        self.braked = NONE

    def __bool__(self) -> bool:
        """Return whether a command was noted yet."""
        return bool(self._commands)

    @property
    def newest_ns(self) -> int:
        """Time of the newest command."""
        return self._commands[-1][0]

    def note(self, time_ns: int, currents: tuple[float, ...], braked: Axes) -> None:
        """Note the currents (3,) A and brakes in force from `time_ns` on."""
        if braked != self.braked:
            self._braked_ns, self.braked = time_ns, braked
        self._commands.append((time_ns, currents))
        horizon = time_ns - self._reach_ns
        while len(self._commands) > 1 and self._commands[1][0] <= horizon:
            self._commands.popleft()

    def is_known_since(self, time_ns: int) -> bool:
        """Return whether all commands since `time_ns` are known and made under the present brakes."""
        return time_ns >= max(self._braked_ns, self._commands[0][0])

    def window(self, begin_ns: int, end_ns: int) -> FloatArray:
        """Return the commands (k, 3) A that may have been in force between two times, evenly sampled."""
        later = iter(self._commands)
        _, currents = next(later)
        following = next(later, None)
        sampled: list[tuple[float, ...]] = []
        for time_ns in range(begin_ns, end_ns + _NOTED_LATE_NS + 1, _SAMPLES_NS):
            while following is not None and following[0] <= time_ns:
                currents, following = following[1], next(later, None)
            sampled.append(currents)
        return np.array(sampled)

    def supplied(self, reading: PowerReading, bounds: Bounds, known: Mapping[int, CoilFault]) -> Supplied:
        """Return the newest conversion with the bounds of the current that healthy coils would draw.

        `known` holds the known faults by axis.
        """
        sizes = np.abs(self.window(reading.newest_since_ns, reading.time_ns))
        free = [axis for axis, fault in known.items() if fault in {CoilFault.SHORTED, CoilFault.UNCERTAIN}]
        unsure = [axis for axis, fault in known.items() if fault is not CoilFault.SHORTED]
        driven: list[bool] = [any(column) for column in sizes.T.tolist()]
        total = sizes.sum(axis=1)
        sure = np.delete(sizes, unsure, axis=1).sum(axis=1) if unsure else total
        slack = sum(driven) * bounds.uncertainty + bounds.noise
        error = bounds.gain + NEWEST.scatter
        lowest, highest = float(total.min()), float(total.max())
        return Supplied(
            reading.newest,
            least=float(sure.min()) * (1.0 - error) - slack,
            most=highest * (1.0 + error) + slack + sum(bounds.full_current[axis] for axis in free),
            at_rest=[axis for axis in range(3) if not driven[axis] and axis not in known],
            driven=any(driven),
            spread=highest - lowest,
        )
