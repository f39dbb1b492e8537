"""Predicts the supply current of healthy and faulty coils, and tests which fault explains the readings.

Input A of a bridge is pulsed for a positive current, B for a negative one. A leg that is stuck high drives
its coil continuously; a pulse on the other input cancels the drive for its duration.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np

from flight.loop.fdir.stuck_leg import NONE, Axes, Supplied
from hal.interfaces.devices import PowerReading
from knightcube.astro.arrays import FloatArray


class CoilFault(Enum):
    """The fault of an axis; the values are the log's texts."""

    OPEN = "open: no current when driven"
    SHORTED = "shorted: too much current when driven"
    A_LOW = "input A's leg stuck low: no current in the positive direction"
    B_LOW = "input B's leg stuck low: no current in the negative direction"
    A_HIGH = "input A's leg stuck high: current at zero command"
    B_HIGH = "input B's leg stuck high: current at zero command"
    HIGH = "a leg stuck high: current at zero command, gone while its bridge is braked"
    REVERSED = "reversed: it turns the body the wrong way"
    UNCERTAIN = "broken in one of several ways"


ELECTRICAL = (
    CoilFault.OPEN,
    CoilFault.SHORTED,
    CoilFault.A_LOW,
    CoilFault.B_LOW,
    CoilFault.A_HIGH,
    CoilFault.B_HIGH,
)
_VARIANTS: tuple[CoilFault | None, ...] = (None, *ELECTRICAL)
PLACE = {fault: place for place, fault in enumerate(_VARIANTS)}
"""Of each variant in a prediction; None is a healthy bridge."""
_SHORTED_FACTORS = np.geomspace(1.6, 20.0, 40)[:, None]
_SHORTED_SLACK = 0.04
_OUTLIERS = 0.15
"""Fraction of the readings that a hypothesis may miss: those whose window contains the fault's onset."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of the error of a predicted reading.

    Attributes:
        full_current: A, of a coil that is fully on.
        uncertainty: A, for each driven coil.
        gain: relative, common to all readings.
        noise: A, of the monitor.
    """

    full_current: tuple[float, float, float]
    uncertainty: float
    gain: float
    noise: float


@dataclass(frozen=True, slots=True)
class Sampling:
    """Error bounds of a reading of a chopped current that changes within the reading's window.

    Attributes:
        scatter: error caused by chopping, of a bridge's current or of what lacks to its full current,
            whichever is smaller: a bridge that is fully on is not chopped.
        range_share: error of the mean, as a fraction of the range in the window.
    """

    scatter: float
    range_share: float


NEWEST = Sampling(0.2, 1.0)
"""A single conversion, at an unknown time in its window; 18 % (`hal.drivers.ina219`)."""
MEAN = Sampling(0.02, 0.25)
"""The mean of five conversions; the remaining 7 % are in the gain, common to readings in a row."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """A reading in A, and the prediction of each axis (rows) under each variant (3, v), A.

    `mean` of the window, `slack`, and `chopped`, the error by chopping. A `clipped` reading may be smaller
    than the current.
    """

    current: float
    mean: FloatArray
    slack: FloatArray
    chopped: FloatArray
    clipped: bool = False


def predict(
    current: float, commands: FloatArray, bounds: Bounds, sampling: Sampling, clipped: bool = False
) -> Predicted:
    """Predict the current of each variant under the commands (k, 3) A of a reading's window."""
    full = np.array(bounds.full_current)[:, None]
    drawn = supply_currents(commands.T, full)
    count = len(commands)
    chopped = sampling.scatter * np.minimum(drawn, full[:, None] - drawn).clip(0.0).sum(axis=2) / count
    slack = bounds.uncertainty * ((drawn != 0.0).sum(axis=2) / count)
    slack += sampling.range_share * (drawn.max(axis=2) - drawn.min(axis=2))
    return Predicted(current, drawn.sum(axis=2) / count, slack, chopped, clipped)


def supply_currents(commands: FloatArray, full: FloatArray) -> FloatArray:
    """Return the supply currents (n, v, k) of n bridges under each variant for commands (n, k) A.

    `full` (n, 1) A is drawn when fully on. A shorted coil's are those of a healthy coil.
    """
    forward, backward = np.maximum(commands, 0.0), np.maximum(-commands, 0.0)
    drawn = np.empty((len(commands), len(_VARIANTS), commands.shape[1]))
    drawn[:, PLACE[None]] = drawn[:, PLACE[CoilFault.SHORTED]] = forward + backward
    drawn[:, PLACE[CoilFault.OPEN]] = 0.0
    drawn[:, PLACE[CoilFault.A_LOW]] = backward
    drawn[:, PLACE[CoilFault.B_LOW]] = forward
    drawn[:, PLACE[CoilFault.A_HIGH]] = np.maximum(full - backward, 0.0)
    drawn[:, PLACE[CoilFault.B_HIGH]] = np.maximum(full - forward, 0.0)
    return drawn


def fits(
    evidence: Sequence[Predicted],
    bounds: Bounds,
    known: Mapping[int, CoilFault],
    axis: int | None = None,
    fault: CoilFault | None = None,
) -> bool:
    """Return whether `fault` on `axis`, together with the known faults, explains nearly all readings."""
    variants: list[CoilFault | None] = [known.get(number) for number in range(3)]
    if axis is not None:
        variants[axis] = fault
    current = np.array([one.current for one in evidence])
    means, slacks = np.array([one.mean for one in evidence]), np.array([one.slack for one in evidence])
    chops = np.array([one.chopped for one in evidence])
    mean, own, chopped, own_chopped = np.zeros((4, len(evidence)))
    slack: FloatArray = np.full(len(evidence), bounds.noise)
    free = 0.0  # current that axes of unknown state may add
    for number, variant in enumerate(variants):
        if variant is CoilFault.UNCERTAIN or (variant is CoilFault.SHORTED and number != axis):
            free += bounds.full_current[number]
            continue
        place = PLACE.get(variant, 0)
        slack += slacks[:, number, place]
        if variant is CoilFault.SHORTED:
            own, own_chopped = means[:, number, place], chops[:, number, place]
        else:
            mean += means[:, number, place]
            chopped += chops[:, number, place]
    scales = _scales(bounds.gain)
    explained, spare = scales * mean, slack + scales * chopped
    if own.any():
        explained = explained + _SHORTED_FACTORS * own
        spare = spare + _SHORTED_FACTORS * (own_chopped + _SHORTED_SLACK * own)
    clipped = np.array([one.clipped for one in evidence])
    inside = (clipped | (current >= explained - spare)) & (current <= explained + spare + free)
    misses = len(evidence) - int(inside.sum(axis=2).max())
    return misses <= _OUTLIERS * len(evidence)


@cache
def _scales(gain: float) -> FloatArray:
    """Return factors (9, 1, 1) over the range of the gain error."""
    return np.linspace(1.0 - gain, 1.0 + gain, 9)[:, None, None]


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
