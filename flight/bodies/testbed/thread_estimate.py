"""The estimate of the turn about the thread, from the estimate of the whole body."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.gnc.estimation.estimate import PARAMETERS, Estimate
from flight.gnc.estimation.rigid_body import NOMINAL, Parameters
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import angle_about_axis_y

LEAST_GAIN, MOST_GAIN = 0.5, 2.0
"""An estimated coil gain beyond these is that of a filter that has not converged: it is clipped."""


@dataclass(frozen=True, slots=True, eq=False)
class ThreadEstimate:
    """Angle, rate and disturbance about the thread at `time_ns`: rad, rad/s, rad/s^2; covariance (3, 3).

    `measured_ns` is the time of the newest measurement in it: its age says whether to trust it.
    """

    time_ns: int
    angle: float
    rate: float
    disturbance: float
    covariance: FloatArray
    measured_ns: int

    @property
    def q2(self) -> float:
        """The second quaternion component."""
        return math.sin(0.5 * self.angle)


def about_thread(estimate: Estimate, believed: Parameters = NOMINAL) -> ThreadEstimate:
    """Return the turn about the thread; exact for a suspended body.

    The disturbance is the part that a plant with the `believed` parameters does not explain: the current by
    which that plant would hold the body against it is the current that does hold it.
    """
    angle, rate = angle_about_axis_y(estimate.quaternion), float(estimate.rate[1])
    torsion, damping, gain = estimate.parameters
    scale = believed.gain / min(max(gain, LEAST_GAIN), MOST_GAIN)
    torque = scale * (float(estimate.disturbance[1]) - torsion * angle - damping * rate)
    rows = np.zeros((3, len(estimate.covariance)))
    rows[0, 1] = rows[1, 4] = 1.0
    rows[2, 10] = scale
    rows[2, 1], rows[2, 4] = believed.torsion - scale * torsion, believed.damping - scale * damping
    rows[2, PARAMETERS] = -scale * angle, -scale * rate, -torque * scale / believed.gain
    return ThreadEstimate(
        estimate.time_ns,
        angle,
        rate,
        torque + believed.torsion * angle + believed.damping * rate,
        rows @ estimate.covariance @ rows.T,
        estimate.measured_ns,
    )


class ThreadReader:
    """Reads the turn about the thread out of an estimate, once for each estimate."""

    def __init__(self, believed: Parameters) -> None:
        self._believed = believed
        self._last: tuple[Estimate, ThreadEstimate] | None = None

    def read(self, estimate: Estimate) -> ThreadEstimate:
        """Return the turn about the thread."""
        if self._last is None or self._last[0] is not estimate:
            self._last = estimate, about_thread(estimate, self._believed)
        return self._last[1]
