"""Prediction of the supply current of healthy and broken coils, and the search for a leg that is stuck high.

The supply current is predicted from the commands for each hypothesis: that all coils are healthy, or that one
axis has one fault. Each H-bridge has two inputs, A and B. The input A is pulsed for positive currents, the
input B for negative currents. If an output leg is stuck high, it drives its coil continuously, except while
the other input is pulsed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import cache

import numpy as np

from hal.interfaces.devices import NO_AXES
from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Supplied:
    """An ADC sample during which the braking did not change, with bounds of the current of healthy coils.

    Attributes:
        current: measured supply current, A.
        least, most: bounds (A) of the total current that healthy coils would draw.
        spread: range (A) of the total commanded current within the time window of the sample.
        at_rest: indices of the axes that were not driven and have no known fault.
        driven: whether any axis was driven during the sample.
    """

    current: float
    least: float
    most: float
    at_rest: Sequence[int]
    driven: bool
    spread: float = 0.0


class CoilFault(Enum):
    """A fault of a coil axis; the values are the texts in the flight log."""

    OPEN = "open: no current when driven"
    SHORTED = "shorted: too much current when driven"
    A_LOW = "input A's leg stuck low: no current in the positive direction"
    B_LOW = "input B's leg stuck low: no current in the negative direction"
    A_HIGH = "input A's leg stuck high: current at zero command"
    B_HIGH = "input B's leg stuck high: current at zero command"
    HIGH = "a leg stuck high: current at zero command, except while its bridge brakes"
    UNCERTAIN = "faulty, with several possible causes"


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
"""Index of each fault variant in a prediction; the variant None is a healthy bridge."""
_SHORTED_FACTORS = np.geomspace(1.6, 20.0, 40)[:, None]
_SHORTED_SLACK = 0.04
_OUTLIERS = 0.15
"""Largest fraction of readings that may contradict a true hypothesis, because they precede the fault."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Error bounds of a predicted supply current.

    Attributes:
        full_current: current (A) of each coil at a duty cycle of one.
        uncertainty: error bound (A) of the current of each driven coil.
        gain: relative error bound due to resistance, supply voltage and sampling of the chopped current.
        noise: error bound (A) of the current monitor.
    """

    full_current: tuple[float, ...]
    uncertainty: float = 3.5e-3
    gain: float = 0.2
    noise: float = 1.5e-3


Commands = FloatArray | Sequence[tuple[float, ...]]
"""Commands (k, n), A, at k times in the time window of a reading."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """Error bounds of a reading of a chopped current that changes within the reading's time window.

    Attributes:
        scatter: error due to chopping, as a fraction of the smaller of two currents: the bridge's current,
            and its difference from the full current. A bridge that is fully on is not chopped.
        range_share: error of the mean, as a fraction of the current's range within the time window.
    """

    scatter: float
    range_share: float


NEWEST = Sampling(0.2, 1.0)
"""Error bounds of one ADC sample at an unknown time in its window. The PWM chopping of the current alone
causes an error of 18 % (`hal.drivers.current_monitors`)."""
MEAN = Sampling(0.02, 0.25)
"""Error bounds of the mean of five ADC samples. A further error of 7 %, which is common to all readings, is
included in `Bounds.gain`."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """A reading (A) of the supply current, and the current (n, v), A, predicted for each axis and variant.

    The prediction consists of the mean over the time window (`mean`), the error bound due to the PWM chopping
    of the coil currents (`chopped`) and the error bound due to all other causes (`slack`). A reading that is
    `clipped` is a lower bound of the current.
    """

    current: float
    mean: FloatArray
    slack: FloatArray
    chopped: FloatArray
    clipped: bool = False


def predict(
    current: float, commands: Commands, bounds: Bounds, sampling: Sampling, clipped: bool = False
) -> Predicted:
    """Predict the current of each axis and variant for the commands (k, n), A, in a reading's time window."""
    full = np.array(bounds.full_current)[:, None]
    drawn = supply_currents(np.asarray(commands).T, full)
    count = len(commands)
    chopped = sampling.scatter * np.minimum(drawn, full[:, None] - drawn).clip(0.0).sum(axis=2) / count
    slack = bounds.uncertainty * ((drawn != 0.0).sum(axis=2) / count)
    slack += sampling.range_share * (drawn.max(axis=2) - drawn.min(axis=2))
    return Predicted(current, drawn.sum(axis=2) / count, slack, chopped, clipped)


def supply_currents(commands: FloatArray, full: FloatArray) -> FloatArray:
    """Return the supply currents (n, v, k), A, of n bridges in v fault variants for k commands (n, k), A.

    The current of each coil at a duty cycle of one is `full` (n, 1), A. Short circuits are not modelled: for
    the variant of a shorted coil, the current of a healthy coil is returned.
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
    """Return whether a hypothetical `fault` on `axis`, besides the known faults, fits nearly all readings."""
    variants: list[CoilFault | None] = [known.get(number) for number in range(len(bounds.full_current))]
    if axis is not None:
        variants[axis] = fault
    current = np.array([one.current for one in evidence])
    means, slacks = np.array([one.mean for one in evidence]), np.array([one.slack for one in evidence])
    chops = np.array([one.chopped for one in evidence])
    mean, own, chopped, own_chopped = np.zeros((4, len(evidence)))
    slack: FloatArray = np.full(len(evidence), bounds.noise)
    free = 0.0  # largest current (A) of the axes whose current is not predicted
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


def is_healthy_current(
    current: float, commands: Commands, bounds: Bounds, sampling: Sampling, clipped: bool = False
) -> bool:
    """Return whether a reading agrees with healthy coils.

    The arguments are those of `predict`. The result equals that of `fits` for the predicted current, but is
    computed in less time.
    """
    values, count = [value for currents in commands for value in currents], len(commands)
    mean = sum(map(abs, values)) / count
    slack = bounds.noise + bounds.uncertainty * (len(values) - values.count(0.0)) / count
    if abs(current - mean) <= slack:
        return True  # all other error bounds would only widen the interval
    drawn = np.abs(commands)
    rest = np.minimum(drawn, np.array(bounds.full_current) - drawn)
    chopped = sampling.scatter * float(np.maximum(rest, 0.0).sum()) / count
    slack += sampling.range_share * float((drawn.max(axis=0) - drawn.min(axis=0)).sum())
    return any(
        (clipped or current >= scale * (mean - chopped) - slack)
        and current <= scale * (mean + chopped) + slack
        for scale in _scales(bounds.gain).ravel().tolist()
    )


@cache
def _scales(gain: float) -> FloatArray:
    """Return nine equally spaced factors (9, 1, 1) from the lower to the upper bound of the gain error."""
    return np.linspace(1.0 - gain, 1.0 + gain, 9)[:, None, None]


_SURE = 2
"""Number of consecutive ADC samples that must agree in a step of the search for a stuck leg."""
_PATIENCE = 12
"""Number of ADC samples without agreement after which a step of the search is abandoned."""
_PAUSE = 50
"""Minimum number of ADC samples between a check at zero current that finds no fault and the next check."""
_UNCLEAR = 20
"""Number of consecutive ADC samples with ambiguous commands after which a check at zero current begins."""


class _Step(Enum):
    WATCHING = auto()
    RESTING = auto()
    ALL_BRAKED = auto()
    ONE_RELEASED = auto()
    NO_CURE = auto()


class StuckLeg:
    """Searches for an output leg that is stuck high by commanding zero currents and braking the bridges.

    Attributes:
        brake: indices of the bridges that must be braked now.
        rest: whether all currents must be commanded to zero now.
        suspicion: reason for the search; empty if there is no search.
    """

    def __init__(self, excess: float) -> None:
        """Set the smallest `excess` of the supply current (A) that indicates a fault."""
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
        self.brake = NO_AXES
        self.rest = False
        self.suspicion = ""

    @property
    def is_searching(self) -> bool:
        """Whether a search is running.

        In a search, all coils are commanded to zero, and bridges may be braked.
        """
        return self.rest

    def exceeds(self, supplied: Supplied) -> bool:
        """Return whether an ADC sample exceeds the current that healthy coils would draw."""
        return supplied.current > supplied.most + self._excess

    def ask_for_rest(self, why: str) -> None:
        """Request zero currents in all coils, unless a search is running or a recent check found no fault."""
        if self._step is _Step.WATCHING and not self._pause:
            self._rest(why)

    def look(self, supplied: Supplied) -> int | None:
        """Process an ADC sample, and return the axis with a stuck leg once it is identified."""
        self._pause = max(self._pause - 1, 0)
        if self.rest and supplied.driven:
            return None  # the commanded zero currents are not yet in force
        high = self.exceeds(supplied)
        short = supplied.current < supplied.least - self._excess
        self._high = self._high + 1 if high else 0
        self._short = self._short + 1 if short else 0
        self._normal = 0 if high or short else self._normal + 1
        self._looks += 1
        if self.is_searching and self._looks > _PATIENCE:
            self._give_up()  # a stuck leg would not draw an intermittent current
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
        self._step = _Step.ALL_BRAKED
        self._left, self._braked = list(supplied.at_rest), tuple(supplied.at_rest)
        self.brake, self.rest = frozenset(supplied.at_rest), True
        self._await()

    def _put_to_rest(self, supplied: Supplied) -> None:
        if self._pause:
            self._give_up()
            return
        self._rest(_reason(supplied))

    def _rest(self, why: str) -> None:
        self.suspicion = self.suspicion or why
        self._step = _Step.RESTING
        self.brake, self.rest = NO_AXES, True
        self._await()

    def _release_next(self) -> None:
        """Release the next bridge; end the search after the last bridge."""
        if not self._left:
            self.reset()
            return
        self._step = _Step.ONE_RELEASED
        self.brake = frozenset(self._braked) - {self._left[0]}
        self._await()

    def _give_up(self) -> None:
        """Suspend the search until the supply current is normal again."""
        self.reset()
        self._step = _Step.NO_CURE

    def _await(self) -> None:
        self._high = self._short = self._normal = self._looks = 0


def _reason(supplied: Supplied) -> str:
    due = f"{1e3 * max(supplied.least, 0.0):.0f} to {1e3 * supplied.most:.0f} mA"
    return f"supply current {1e3 * supplied.current:.0f} mA, expected {due}"


_PROOFS = 2
"""Number of consecutive ADC samples that must agree before braking is confirmed or refuted."""


class BrakeProof:
    """Confirms from ADC samples that the braked bridges have a leg stuck high."""

    def __init__(self) -> None:
        self._axes: set[int] = set()
        self._exceeds: deque[bool] = deque(maxlen=_PROOFS)

    def __bool__(self) -> bool:
        """Return whether the diagnosis of any braked bridge is not yet confirmed."""
        return bool(self._axes)

    def add(self, axis: int) -> None:
        """Add an axis that is braked because of a diagnosis that is not yet confirmed."""
        self._axes.add(axis)

    def discard(self, axis: int) -> None:
        """Remove an axis."""
        self._axes.discard(axis)

    def ingest(self, exceeds: bool) -> frozenset[int]:
        """Process an ADC sample, and return the axes whose coils carry a current although they are braked."""
        self._exceeds.append(exceeds)
        if len(self._exceeds) < _PROOFS:
            return frozenset()
        wrong = frozenset(self._axes) if all(self._exceeds) else frozenset()
        if len(set(self._exceeds)) == 1:
            self._axes.clear()
            self._exceeds.clear()
        return wrong


_MOST_EVIDENCE, _MOST_SEGMENTS = 40, 4
"""Maximum number of predictions in a segment, and maximum number of segments."""
_TELLING = 4.0
"""Smallest expected current from which the monitor's gain is computed, as a multiple of a coil's error
bound."""


class Evidence:
    """Predictions for the readings since a fault was suspected. Each probe begins a new segment.

    A hypothesis must explain the readings of each segment. Without segments, the few readings of a probe that
    contradict a hypothesis would be treated as outliers, because the many other readings agree with every
    hypothesis.
    """

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._segments: deque[deque[Predicted]] = deque(maxlen=_MOST_SEGMENTS)
        self.clear()

    def __len__(self) -> int:
        """Return the number of predictions."""
        return sum(len(segment) for segment in self._segments)

    def clear(self) -> None:
        """Discard all predictions."""
        self._segments.clear()
        self.begin_segment()

    def begin_segment(self) -> None:
        """Begin a new segment for the readings from now on."""
        self._segments.append(deque(maxlen=_MOST_EVIDENCE))

    def add(self, predictions: Sequence[Predicted]) -> None:
        """Append the predictions of a reading to the newest segment."""
        self._segments[-1].extend(predictions)

    def readings(self) -> list[Predicted]:
        """Return all predictions in order of time."""
        return [one for segment in self._segments for one in segment]

    @property
    def is_driven(self) -> bool:
        """Whether a coil was driven during any reading."""
        return any(one.mean[:, 0].any() for one in self.readings())

    def monitor_gain(self, known: Mapping[int, CoilFault]) -> float | None:
        """Return the gain of a current monitor that measures all currents with a common error, or None.

        With this gain, the readings of each segment agree with coils that have the `known` faults only. In
        each segment, the ratio of measured to expected current must be closer to this gain than to 1. At
        least two coils must have been driven, because a fault of the only driven coil would explain the
        readings too.
        """
        coils = range(len(self._bounds.full_current))
        if any(PLACE.get(fault) is None or fault is CoilFault.SHORTED for fault in known.values()):
            return None  # the current of a coil is unknown
        driven = {
            axis for one in self.readings() for axis in coils if axis not in known and one.mean[axis, 0]
        }
        ratios = [self._ratios(segment, known) for segment in self._segments if segment]
        every = [ratio for segment in ratios for ratio in segment]
        gain = float(np.median(every)) if every else 1.0
        if len(driven) < 2 or abs(gain - 1.0) <= self._bounds.gain or not 0.2 <= gain <= 5.0:
            return None
        if any(abs(math.log(np.median(one) / gain)) > abs(math.log(np.median(one))) for one in ratios if one):
            return None
        scaled = [[replace(one, current=one.current / gain) for one in part] for part in self._segments]
        return gain if all(fits(part, self._bounds, known) for part in scaled if part) else None

    def _ratios(self, segment: Iterable[Predicted], known: Mapping[int, CoilFault]) -> list[float]:
        """Return the ratios of measured to expected currents of a segment's readings of driven coils."""
        places = [PLACE[known.get(axis)] for axis in range(len(self._bounds.full_current))]
        pairs = [(one.current, float(one.mean[range(len(places)), places].sum())) for one in segment]
        least = _TELLING * self._bounds.uncertainty
        return [max(current, self._bounds.noise) / due for current, due in pairs if due > least]

    def possible_faults(self, known: Mapping[int, CoilFault]) -> list[tuple[int, CoilFault]]:
        """Return the pairs of axis and fault that, besides the known faults, explain the readings."""
        segments = [segment for segment in self._segments if segment]
        return [
            (axis, fault)
            for axis in range(len(self._bounds.full_current))
            if axis not in known
            for fault in ELECTRICAL
            if all(fits(segment, self._bounds, known, axis, fault) for segment in segments)
        ]

    def shows_working_monitor(self, known: Mapping[int, CoilFault]) -> bool:
        """Return whether a probe showed a healthy coil's current, which proves that the monitor works."""
        return any(
            fits(segment, self._bounds, known) and any(one.mean[:, 0].any() for one in segment)
            for segment in list(self._segments)[1:]
            if segment
        )

    def rejects_healthy_now(self, known: Mapping[int, CoilFault]) -> bool:
        """Return whether the readings of the newest segment contradict healthy coils."""
        newest = self._segments[-1]
        return bool(newest) and not fits(newest, self._bounds, known)

    def is_normal_again(
        self, known: Mapping[int, CoilFault], possible: Sequence[tuple[int, CoilFault]]
    ) -> bool:
        """Return whether the newest readings agree with healthy coils.

        Unless all coils were commanded to zero, the newest readings must also contradict each of the
        `possible` faults. Coils at zero current show no fault, and their currents are known.
        """
        newest = self.readings()[-8:]
        if not fits(newest, self._bounds, known):
            return False
        if not any(one.mean[:, 0].any() for one in newest):
            return True
        return not any(fits(newest, self._bounds, known, axis, fault) for axis, fault in possible)
