"""Predicts the supply current for each coil fault, and tests which fault explains the readings.

Input A of a bridge is pulsed for a positive current, B for a negative one. A leg that is stuck high drives
its coil continuously; a pulse on the other input cancels the drive for its duration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from flight.gnc.math.arrays import FloatArray


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
_PLACE = {fault: place for place, fault in enumerate(_VARIANTS)}
_SHORTED_FACTORS = np.geomspace(1.6, 20.0, 40)
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
        scatter: relative error caused by chopping.
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
    """A reading in A, and the prediction of each axis (rows) under each variant: mean and slack (3, v) A."""

    current: float
    mean: FloatArray
    slack: FloatArray
    scatter: float


def predict(current: float, commands: FloatArray, bounds: Bounds, sampling: Sampling) -> Predicted:
    """Predict the current of each variant under the commands (k, 3) A of a reading's window."""
    drawn = np.empty((3, len(_VARIANTS), len(commands)))
    for axis in range(3):
        for place, fault in enumerate(_VARIANTS):
            drawn[axis, place] = supply_current(commands[:, axis], fault, bounds.full_current[axis])
    driven = np.count_nonzero(drawn, axis=2) / len(commands)
    slack = bounds.uncertainty * driven + sampling.range_share * np.ptp(drawn, axis=2)
    return Predicted(current, drawn.mean(axis=2), slack, sampling.scatter)


def supply_current(command: FloatArray, fault: CoilFault | None, full: float) -> FloatArray:
    """Return the supply current of a bridge for commands (k,) A, `full` A when fully on.

    For a shorted coil, return that of a healthy coil.
    """
    nothing = np.zeros_like(command)
    match fault:
        case CoilFault.OPEN:
            return nothing
        case CoilFault.A_LOW:
            return np.maximum(-command, nothing)
        case CoilFault.B_LOW:
            return np.maximum(command, nothing)
        case CoilFault.A_HIGH:
            return np.maximum(full - np.maximum(-command, nothing), nothing)
        case CoilFault.B_HIGH:
            return np.maximum(full - np.maximum(command, nothing), nothing)
        case _:
            return np.abs(command)


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
    mean, slack = np.zeros(len(evidence)), np.full(len(evidence), bounds.noise)
    free = np.zeros(len(evidence))  # current that an axis of unknown state may add
    own = np.zeros(len(evidence))
    for number, variant in enumerate(variants):
        if variant is CoilFault.UNCERTAIN or (variant is CoilFault.SHORTED and number != axis):
            free += bounds.full_current[number]
            continue
        place = _PLACE.get(variant, 0)
        part = np.array([one.mean[number, place] for one in evidence])
        slack += np.array([one.slack[number, place] for one in evidence])
        if variant is CoilFault.SHORTED:
            own = part
        else:
            mean += part
    factors = _SHORTED_FACTORS if own.any() else np.ones(1)
    scales = np.linspace(1.0 - bounds.gain, 1.0 + bounds.gain, 9)
    explained = scales[:, None, None] * mean + factors[None, :, None] * own
    scatter = np.array([one.scatter for one in evidence])
    spare = slack + scatter * explained + _SHORTED_SLACK * factors[None, :, None] * own
    inside = (current >= explained - spare) & (current <= explained + spare + free)
    misses = len(evidence) - int(inside.sum(axis=2).max())
    return misses <= _OUTLIERS * len(evidence)
