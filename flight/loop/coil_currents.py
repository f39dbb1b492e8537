"""Prediction of the supply current of healthy and broken coils.

The supply current is predicted from the commands for each hypothesis: that all coils are healthy, or that one
axis has one fault. Each H-bridge has two inputs, A and B. The input A is pulsed for positive currents, the
input B for negative currents. If an output leg is stuck high, it drives its coil continuously, except while
the other input is pulsed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np

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
"""Index of each fault variant in a prediction, where the variant None is a healthy bridge."""
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
        gain: relative error bound that is common to all readings.
        noise: error bound (A) of the current monitor.
    """

    full_current: tuple[float, ...]
    uncertainty: float
    gain: float
    noise: float


@dataclass(frozen=True, slots=True)
class Sampling:
    """Error bounds of a reading of a chopped current that changes within the reading's time window.

    Attributes:
        scatter: error due to chopping, as a fraction of the bridge's current or, if smaller, of the
            difference from the full current. A bridge that is fully on is not chopped.
        range_share: error of the mean, as a fraction of the current's range within the time window.
    """

    scatter: float
    range_share: float


NEWEST = Sampling(0.2, 1.0)
"""Error bounds of one ADC sample at an unknown time in its window. The PWM chopping of the current alone
causes an error of 18 % (`hal.drivers.current_monitors`).
"""
MEAN = Sampling(0.02, 0.25)
"""Error bounds of the mean of five ADC samples.

An error of 7 % that is common to all readings is part of the gain error instead.
"""


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
    current: float, commands: FloatArray, bounds: Bounds, sampling: Sampling, clipped: bool = False
) -> Predicted:
    """Predict the current of each variant for the commands (k, n), A, in the time window of a reading."""
    full = np.array(bounds.full_current)[:, None]
    drawn = supply_currents(commands.T, full)
    count = len(commands)
    chopped = sampling.scatter * np.minimum(drawn, full[:, None] - drawn).clip(0.0).sum(axis=2) / count
    slack = bounds.uncertainty * ((drawn != 0.0).sum(axis=2) / count)
    slack += sampling.range_share * (drawn.max(axis=2) - drawn.min(axis=2))
    return Predicted(current, drawn.sum(axis=2) / count, slack, chopped, clipped)


def supply_currents(commands: FloatArray, full: FloatArray) -> FloatArray:
    """Return the supply currents (n, v, k), A, of n bridges in v variants for the commands (n, k), A.

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


@cache
def _scales(gain: float) -> FloatArray:
    """Return nine equally spaced factors (9, 1, 1) from the lower to the upper bound of the gain error."""
    return np.linspace(1.0 - gain, 1.0 + gain, 9)[:, None, None]
