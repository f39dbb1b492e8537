"""What the filter hands out: attitude, rate, gyro bias and disturbance with their covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from flight.gnc.estimation.rigid_body import NOMINAL, Parameters
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import angle_about_axis_y

TURN, RATE, BIAS, DISTURBANCE, PARAMETERS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
LATENCY = 15
FIELD_BIAS = slice(16, 19)
"""Where the parts of the error stand in the covariance (19, 19)."""


LEAST_GAIN, MOST_GAIN = 0.5, 2.0
"""An estimate beyond is that of a filter which is still finding itself: no current is reckoned with it."""


@dataclass(frozen=True, slots=True, eq=False)
class ThreadEstimate:
    """The state about the thread at `time_ns`: rad, rad/s, rad/s^2, and its covariance (3, 3).

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


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The state at `time_ns`.

    Attributes:
        quaternion: (4,) reference into body.
        rate: (3,) rad/s, body axes.
        bias: (3,) rad/s, of the gyro.
        disturbance: (3,) rad/s^2, angular acceleration that the model does not account for.
        parameters: of the model: the thread's torsion and damping, the coils' gain.
        covariance: (19, 19) of small turns about the body's axes, rate, and so on (TURN, RATE, ...).
        measured_ns: the time of the newest measurement in it: its age says whether to trust it.
        latency: s, by which the inertial unit's samples are older than they say.
        field_bias: (3,) T, what the magnetometer reads too much, body axes.
    """

    time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    bias: FloatArray
    disturbance: FloatArray
    parameters: Parameters
    covariance: FloatArray
    measured_ns: int
    latency: float = 0.0
    field_bias: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def angle(self) -> float:
        """The turn about the thread, body y, rad."""
        return angle_about_axis_y(self.quaternion)

    @property
    def q2(self) -> float:
        """The second quaternion component of that turn."""
        return math.sin(0.5 * self.angle)

    def about_thread(self, believed: Parameters = NOMINAL) -> ThreadEstimate:
        """Return what it says of the turn about the thread; exact for a body that is suspended.

        The disturbance is what a plant with the `believed` parameters leaves out of a hold: the current by
        which that plant would hold the body against it is the one that does.
        """
        angle, rate = self.angle, float(self.rate[1])
        torsion, damping, gain = self.parameters
        scale = believed.gain / min(max(gain, LEAST_GAIN), MOST_GAIN)
        torque = scale * (float(self.disturbance[1]) - torsion * angle - damping * rate)
        rows = np.zeros((3, len(self.covariance)))
        rows[0, 1] = rows[1, 4] = 1.0
        rows[2, 10] = scale
        rows[2, 1], rows[2, 4] = believed.torsion - scale * torsion, believed.damping - scale * damping
        rows[2, PARAMETERS] = -scale * angle, -scale * rate, -torque * scale / believed.gain
        return ThreadEstimate(
            self.time_ns,
            angle,
            rate,
            torque + believed.torsion * angle + believed.damping * rate,
            rows @ self.covariance @ rows.T,
            self.measured_ns,
        )
