"""The age of the inertial unit's samples at their stamp: a constant that the filter estimates.

The line, a driver's buffer or the unit's own filters make a sample older than its stamp. Treated as new,
samples during a slew lag behind the model, and the loop behind the body. A sample of some age has turned less
by rate times age, and its rate differs by acceleration times age, so the innovations depend on the age.

Attitudes estimate the age. The acceleration at a rate sample comes mostly from the coils, which respond to
the noise of earlier samples: correlating both would be identification in closed loop, and in a hold the age
would drift with the noise. For rates the age is therefore considered (Schmidt 1966), not estimated: its
variance and correlations enter the gains of all other states.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import DISTURBANCE, LATENCY, PARAMETERS
from knightcube.gnc.estimation.rigid_body import Accelerated
from knightcube.gnc.estimation.turn import Vector

LONGEST_LATENCY = 0.25
"""s: the largest plausible latency."""

_PUSHES = slice(DISTURBANCE.start, PARAMETERS.stop)
_BY_PUSHES: FloatArray = np.eye(3, 6)


class Motion(NamedTuple):
    """The change of the rate around the time of a sample.

    `acceleration` rad/s^2; `uncertainty` (3, 3) rad^2/s^2 of the rate, from effects not linear in the age.
    """

    acceleration: Vector
    uncertainty: FloatArray


def motion(before: Accelerated, after: Accelerated, disturbance: Vector, covariance: FloatArray) -> Motion:
    """Return how the rate changes with the age, from the model one sigma of the age to either side.

    A command that begins or ends between them makes a bend, half of whose difference is treated as noise; so
    is the product of the errors of age and acceleration.
    """
    pairs = zip(before.acceleration, after.acceleration, disturbance, strict=True)
    x, y, z = (0.5 * (a + b) + d for a, b, d in pairs)
    rows = _BY_PUSHES.copy()
    rows[:, 3:] = before.by_parameters
    if after is not before:
        rows[:, 3:] = 0.5 * (rows[:, 3:] + after.by_parameters)
    spread = rows.dot(covariance[_PUSHES, _PUSHES]).dot(rows.T)
    if after is not before:
        bend = 0.5 * (np.array(after.acceleration) - before.acceleration)
        spread += bend[:, np.newaxis] * bend
    spread *= covariance[LATENCY, LATENCY]
    return Motion((x, y, z), spread)


def aged(more: float, change: Vector, value: Vector, rows: FloatArray) -> tuple[Vector, FloatArray]:
    """Return innovation and rows, corrected for age, of a quantity that changes by `change` per second.

    `more` is the estimated age now less the age already subtracted from the sample's stamp, s.
    """
    x, y, z = change
    rows = rows.copy()
    rows[:, LATENCY] = -x, -y, -z
    return (value[0] + more * x, value[1] + more * y, value[2] + more * z), rows


def considered(gain: FloatArray) -> FloatArray:
    """Return the gain of a measurement that does not estimate the age."""
    gain = gain.copy()
    gain[LATENCY] = 0.0
    return gain
