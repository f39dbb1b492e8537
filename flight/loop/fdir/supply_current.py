"""Faults of the coils in the supply current: prediction, hypotheses, and the search for a stuck leg.

The supply current of each hypothesis (healthy, or one fault on one axis) is predicted from the commands.
Input A of a bridge is pulsed for a positive current, B for a negative one. A leg that is stuck high drives
its coil continuously; a pulse on the other input cancels the drive for its duration.

A stuck leg is found by setting the coils to zero and braking bridges. Braking (both inputs high) removes the
voltage from any coil, whether its bridge is healthy or not. When the supply current is far too large or too
small, all coils are commanded to zero: a remaining current was not commanded. Then all bridges are braked at
once. If the current stops, they are released one by one: the bridge with which the current returns is broken.
No healthy coil carries current meanwhile. If neither rest nor brakes change the current, as with a shorted
coil or a wrong monitor, the search ends. When commands change all the time, as in B-dot's windows, the
command of a conversion is ambiguous: then there is a rest every few seconds without a suspicion, as a check.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import cache

import numpy as np

from hal.interfaces.devices import PowerReading
from knightcube.astro.arrays import FloatArray

Axes = tuple[bool, bool, bool]
NONE: Axes = (False, False, False)
_SURE = 2
"""Conversions in a row that must agree."""
_PATIENCE = 12
"""Conversions without agreement after which a step is given up."""
_PAUSE = 50
"""Conversions between a rest without a finding and the next rest: control has priority."""
_UNCLEAR = 20
"""Conversions in a row whose command is ambiguous, after which there is a rest as a check."""


@dataclass(frozen=True, slots=True)
class Supplied:
    """A conversion made entirely under the present brakes, and the current that healthy coils would draw.

    Attributes:
        current: A, measured.
        least, most: A, bounds of the total current of healthy coils.
        spread: A, range of the total command in the conversion's window.
        at_rest: the axes that were not driven and have no known fault.
        driven: whether any axis was driven.
    """

    current: float
    least: float
    most: float
    at_rest: Sequence[int]
    driven: bool
    spread: float = 0.0


class _Step(Enum):
    WATCHING = auto()
    RESTING = auto()
    ALL_BRAKED = auto()
    ONE_RELEASED = auto()
    NO_CURE = auto()


class StuckLeg:
    """Searches for a stuck leg: processes ADC samples, requests rest and brakes, and returns an axis.

    Attributes:
        brake: which bridges are to be braked now.
        rest: whether all commands are to be zero now.
        suspicion: why there is a search, empty without a suspicion.
    """

    def __init__(self, excess: float) -> None:
        """Take the excess current, A, that only a fault can draw."""
        self._excess = excess
        self._pause = self._unclear = 0
        self._high = self._short = self._normal = self._looks = 0
        self.reset()

    def reset(self) -> None:
        """Release all bridges and end the search."""
        self._step = _Step.WATCHING
        self._left: list[int] = []
        self._braked: tuple[int, ...] = ()
        self._await()
        self.brake = NONE
        self.rest = False
        self.suspicion = ""

    @property
    def is_searching(self) -> bool:
        """Whether a search is running: coils at rest, and perhaps braked."""
        return self.rest

    def exceeds(self, supplied: Supplied) -> bool:
        """Return whether a conversion is more than healthy coils can draw."""
        return supplied.current > supplied.most + self._excess

    def ask_for_rest(self, why: str) -> None:
        """Request a rest, unless a search is running or the last rest was too recent."""
        if self._step is _Step.WATCHING and not self._pause:
            self._rest(why)

    def look(self, supplied: Supplied) -> int | None:
        """Process a conversion; return the axis of a stuck leg when found."""
        self._pause = max(self._pause - 1, 0)
        if self.rest and supplied.driven:
            return None  # not yet at rest
        high = self.exceeds(supplied)
        short = supplied.current < supplied.least - self._excess
        self._high = self._high + 1 if high else 0
        self._short = self._short + 1 if short else 0
        self._normal = 0 if high or short else self._normal + 1
        self._looks += 1
        if self.is_searching and self._looks > _PATIENCE:
            self._give_up()  # an intermittent current is no stuck leg
            return None
        self._unclear = self._unclear + 1 if supplied.spread > self._excess else 0
        if self._unclear >= _UNCLEAR and self._step is _Step.WATCHING:
            self._rest("")
            return None
        if self._high >= _SURE:
            return self._judge_too_much(supplied)
        if self._short >= _SURE and self._step is _Step.WATCHING:
            self._put_to_rest(supplied)
        elif self._normal >= _SURE:
            self._judge_normal()
        return None

    def _judge_too_much(self, supplied: Supplied) -> int | None:
        match self._step:
            case _Step.WATCHING if supplied.driven:
                self._put_to_rest(supplied)
            case _Step.WATCHING | _Step.RESTING if supplied.at_rest:
                self._brake_all(supplied)
            case _Step.ONE_RELEASED:
                found = self._left[0]
                self.reset()
                return found
            case _:
                self._give_up()
        return None

    def _judge_normal(self) -> None:
        match self._step:
            case _Step.RESTING if not self.suspicion:
                self.reset()
            case _Step.RESTING:
                self._pause = _PAUSE
                self._give_up()
            case _Step.ALL_BRAKED:
                self._release_next()
            case _Step.ONE_RELEASED:
                del self._left[0]
                self._release_next()
            case _Step.NO_CURE:
                self.reset()
            case _Step.WATCHING:
                pass

    def _brake_all(self, supplied: Supplied) -> None:
        self.suspicion = self.suspicion or _reason(supplied)
        self._step, self._left, self._braked = (
            _Step.ALL_BRAKED,
            list(supplied.at_rest),
            tuple(supplied.at_rest),
        )
        self.brake, self.rest = _only(supplied.at_rest), True
        self._await()

    def _put_to_rest(self, supplied: Supplied) -> None:
        if self._pause:
            self._give_up()
            return
        self._rest(_reason(supplied))

    def _rest(self, why: str) -> None:
        self.suspicion = self.suspicion or why
        self._step = _Step.RESTING
        self.brake, self.rest = NONE, True
        self._await()

    def _release_next(self) -> None:
        """Release the next bridge; end the search when none is left."""
        if not self._left:
            self.reset()
            return
        self._step = _Step.ONE_RELEASED
        self.brake = _only([axis for axis in self._braked if axis != self._left[0]])
        self._await()

    def _give_up(self) -> None:
        """End the search until the current is normal again."""
        self.reset()
        self._step = _Step.NO_CURE

    def _await(self) -> None:
        self._high = self._short = self._normal = self._looks = 0


def _reason(supplied: Supplied) -> str:
    due = f"{1e3 * max(supplied.least, 0.0):.0f} to {1e3 * supplied.most:.0f} mA"
    return f"supply current {1e3 * supplied.current:.0f} mA where {due} are due"


def _only(axes: Sequence[int]) -> Axes:
    return 0 in axes, 1 in axes, 2 in axes


_PROOFS = 2
"""Conversions in a row that must agree."""


class BrakeProof:
    """Collects conversions made under brakes that are not confirmed yet."""

    def __init__(self) -> None:
        self._axes: set[int] = set()
        self._exceeds: deque[bool] = deque(maxlen=_PROOFS)

    def __bool__(self) -> bool:
        """Return whether any brake is unconfirmed."""
        return bool(self._axes)

    def add(self, axis: int) -> None:
        """Add an axis that is braked on a verdict alone."""
        self._axes.add(axis)

    def discard(self, axis: int) -> None:
        """Remove an axis."""
        self._axes.discard(axis)

    def ingest(self, exceeds: bool) -> frozenset[int]:
        """Note whether a conversion shows current despite the brakes; return the axes braked wrongly."""
        self._exceeds.append(exceeds)
        if len(self._exceeds) < _PROOFS:
            return frozenset()
        wrong = frozenset(self._axes) if all(self._exceeds) else frozenset()
        if len(set(self._exceeds)) == 1:
            self._axes.clear()
            self._exceeds.clear()
        return wrong


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
