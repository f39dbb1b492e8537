"""The age that the inertial unit's samples have at their stamp: a constant that the filter estimates.

A line, a driver's buffer or the unit's own filters make a sample older than it says. Held for new, samples
of a slew lag behind the model, and the loop behind the body. What is older by an age has turned less by rate
times age, and its rate is off by acceleration times age: so the age shows in the innovations.

Attitudes estimate it. A rate sample's acceleration is mostly the coils', which answer to the noise of the
samples before: to correlate the one with the other would be to identify in closed loop, and in a hold the
age would walk off with the noise. So by rates it is considered (Schmidt 1966), not estimated: its doubt and
its correlations count in the gain of all else.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flight.gnc.estimation.estimate import DISTURBANCE, LATENCY, PARAMETERS
from flight.gnc.estimation.rigid_body import Linearised
from flight.gnc.estimation.turn import Vector
from flight.gnc.math.arrays import FloatArray

LONGEST_LATENCY = 0.25
"""s: an estimate beyond it is no latency."""

_PUSHES = slice(DISTURBANCE.start, PARAMETERS.stop)


class Motion(NamedTuple):
    """How the rate changes about the time of a sample.

    `acceleration` rad/s^2; `uncertainty` (3, 3) rad^2/s^2 of the rate, from what is not linear in the age.
    """

    acceleration: Vector
    uncertainty: FloatArray


def motion(before: Linearised, after: Linearised, disturbance: Vector, covariance: FloatArray) -> Motion:
    """Return how the rate changes with the age, from the model one sigma of the age to either side.

    A command that begins or ends between them makes a bend, of which half the difference is taken for noise;
    so is age times acceleration where neither is known.
    """
    pairs = zip(before.acceleration, after.acceleration, disturbance, strict=True)
    x, y, z = (0.5 * (a + b) + d for a, b, d in pairs)
    bend = 0.5 * (np.array(after.acceleration) - before.acceleration)
    by_parameters = 0.5 * (np.array(before.by_parameters) + after.by_parameters)
    rows = np.hstack([np.eye(3), by_parameters])
    doubt = rows @ covariance[_PUSHES, _PUSHES] @ rows.T
    return Motion((x, y, z), covariance[LATENCY, LATENCY] * (doubt + np.outer(bend, bend)))


def aged(more: float, change: Vector, value: Vector, rows: FloatArray) -> tuple[Vector, FloatArray]:
    """Return innovation and rows of a sample of what changes by `change` a second.

    `more` is by how many s the age believed now differs from that made up for in the sample's time.
    """
    x, y, z = change
    rows = rows.copy()
    rows[:, LATENCY] = -x, -y, -z
    return (value[0] + more * x, value[1] + more * y, value[2] + more * z), rows


def considered(gain: FloatArray) -> FloatArray:
    """Return the gain of a measurement that is not to estimate the age."""
    gain = gain.copy()
    gain[LATENCY] = 0.0
    return gain
