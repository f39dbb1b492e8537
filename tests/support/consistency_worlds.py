"""Two simulated worlds for tests of the filter's covariance: sim_hal's testbed, and a free body in orbit.

Both worlds have errors that the filter does not model: a uniform random error of the coil currents in each
cycle in which the coils are driven, and an unknown torque. The motion of the free body is integrated by the
classical Runge-Kutta method on Euler's equation with matrices, independently of the flight code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import about_axis_y, normalise
from knightcube.gnc.estimation.attitude_filter import AttitudeFilterSettings
from knightcube.gnc.estimation.estimate import Parameters
from sim_hal.worlds.testbed import Testbed, TestbedModel

CYCLE_NS = 25_000_000
INERTIA: FloatArray = np.diag([1.10e-3, 1.05e-3, 0.99e-3])
DIPOLE = 80 * 0.0081
TESTBED_FIELD: FloatArray = np.array([0.0, 0.0, -4.5e-4])
ORBIT_FIELD = 4.5e-5
FIELD_TURN = 2.2e-3
"""Rotation rate (rad/s) of the field's direction in a low polar orbit: two revolutions per orbit."""
CURRENT_BOUND = 3.5e-3
GAIN_SIGMA = 0.1
"""Standard deviation of the coils' torque relative to its nominal value."""
MOST_STIFFNESS, MOST_DAMPING = 2e-5, 4e-6
"""Largest stiffness (N m/rad) and damping (N m s/rad) of the suspension thread."""


@dataclass(frozen=True, slots=True)
class Push:
    """Random walk of torque / inertia: initial sigma (rad/s^2) and growth (rad/s^2 per sqrt(s))."""

    start: float
    walk: float


KNOWN_PLANT = AttitudeFilterSettings(
    current_noise=0.0,
    control_period=CYCLE_NS * 1e-9,
    disturbance_walk=0.0,
    bias_start=1e-3,
    torsion_start=0.0,
    damping_start=0.0,
    gain_start=0.0,
    latency_start=0.0,
    latency_walk=0.0,
    gate_sigma=5.0,
    history_ns=6_000_000_000,
)
"""Filter settings without estimation of plant parameters."""

DRAUGHT = Push(1e-3, 5e-5)
"""Disturbance torque of the air around the testbed: 1e-6 N m."""
DRAG = Push(1e-4, 1e-5)
"""Disturbance torque of the free body: 1e-7 N m of drag and residual dipole."""


class World(Protocol):
    """Interface of a simulated world."""

    suspended: bool
    attitude: FloatArray
    rate: FloatArray
    disturbance: FloatArray
    parameters: Parameters

    def field(self) -> FloatArray:
        """Return the present field (3,), T, in reference axes."""

    def command(self, currents: FloatArray) -> None:
        """Drive the coils with the currents (3,), A, plus noise."""

    def advance(self, span_ns: int) -> None:
        """Advance the time."""


class SuspendedWorld:
    """The testbed of sim_hal, with an air torque and a suspension thread that the filter does not know.

    The torque of the air acts as an additional coil current that causes the same torque.
    """

    suspended = True

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        stiffness, damping = rng.uniform(0.0, MOST_STIFFNESS), rng.uniform(0.0, MOST_DAMPING)
        about_y = float(INERTIA[1, 1])
        self.parameters = Parameters(
            stiffness / about_y, damping / about_y, 1.0 + rng.normal(0.0, GAIN_SIGMA)
        )
        self._draught = rng.normal(0.0, DRAUGHT.start)
        self._currents: FloatArray = np.zeros(3)
        model = TestbedModel(
            inertia=float(INERTIA[1, 1]),
            dipole_per_ampere=DIPOLE * self.parameters.gain,
            field=float(-TESTBED_FIELD[2]),
            stiffness=stiffness,
            damping=damping,
            resistance=(23.0, 23.0, 23.0),
            supply_voltage=3.4,
        )
        self.testbed = Testbed(model, rng.normal(0.0, 0.3), rng.normal(0.0, 0.05), self._acting)
        self.testbed.release_at(0)
        self.advance(1)
        self._follow()

    def field(self) -> FloatArray:
        """Return the field of the Helmholtz coils."""
        return TESTBED_FIELD

    def command(self, currents: FloatArray) -> None:
        """Drive the coils."""
        self._currents = _actual(currents, self._rng)

    def advance(self, span_ns: int) -> None:
        """Advance the time."""
        self.testbed.advance_to(self.testbed.time_ns + span_ns)
        self._draught += DRAUGHT.walk * np.sqrt(span_ns * 1e-9) * self._rng.standard_normal()
        self._follow()

    def _acting(self) -> FloatArray:
        torque = INERTIA[1, 1] * self._draught
        per_ampere = DIPOLE * self.parameters.gain * -TESTBED_FIELD[2] * np.cos(self.testbed.angle)
        return np.asarray(self._currents + np.array([torque / per_ampere, 0.0, 0.0]))

    def _follow(self) -> None:
        angle, rate = self.testbed.angle, self.testbed.rate
        self.attitude = about_axis_y(angle)
        self.rate = np.array([0.0, rate, 0.0])
        self.disturbance = np.array([0.0, self._draught, 0.0])


class FreeWorld:
    """A free body that rotates about all axes under a torque with a random walk."""

    suspended = False

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._currents: FloatArray = np.zeros(3)
        self._time = 0.0
        self._field_axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        self.parameters = Parameters(gain=1.0 + rng.normal(0.0, GAIN_SIGMA))
        self.attitude = normalise(rng.standard_normal(4))
        self.rate = rng.normal(0.0, 0.02, 3)
        self.disturbance = rng.normal(0.0, DRAG.start, 3)

    def field(self) -> FloatArray:
        """Return a field that rotates in a plane."""
        angle = FIELD_TURN * self._time
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        return np.asarray(ORBIT_FIELD * (self._field_axes @ along))

    def command(self, currents: FloatArray) -> None:
        """Drive the coils."""
        self._currents = _actual(currents, self._rng)

    def advance(self, span_ns: int) -> None:
        """Integrate the motion by one Runge-Kutta step, and then update the random walk of the torque."""
        dt = span_ns * 1e-9
        field = self.field()
        x = np.concatenate([self.attitude, self.rate])
        k1 = self._flow(x, field)
        k2 = self._flow(x + 0.5 * dt * k1, field)
        k3 = self._flow(x + 0.5 * dt * k2, field)
        k4 = self._flow(x + dt * k3, field)
        x = x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self.attitude, self.rate = normalise(x[:4]), x[4:]
        self.disturbance = self.disturbance + DRAG.walk * np.sqrt(dt) * self._rng.standard_normal(3)
        self._time += dt

    def _flow(self, x: FloatArray, field: FloatArray) -> FloatArray:
        """Return d(q, w)/dt by q' = Omega(w) q / 2 and Euler's equation.

        The field is rotated by Rodrigues' formula.
        """
        vector, scalar, rate = x[:3], x[3], x[4:]
        q_dot = 0.5 * np.append(scalar * rate - cross_product(rate, vector), -rate @ vector)
        field_body = (
            (scalar**2 - vector @ vector) * field
            + 2.0 * (vector @ field) * vector
            - 2.0 * scalar * cross_product(vector, field)
        )
        torque = cross_product(DIPOLE * self.parameters.gain * self._currents, field_body) - cross_product(
            rate, INERTIA @ rate
        )
        return np.concatenate([q_dot, np.linalg.solve(INERTIA, torque) + self.disturbance])


def _actual(currents: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the coil currents, with a uniform random error if the coils are driven."""
    noise = rng.uniform(-CURRENT_BOUND, CURRENT_BOUND, 3)
    return np.asarray(np.where(currents != 0.0, currents + noise, 0.0))


def band(degrees: int, share: float = 0.95) -> tuple[float, float]:
    """Return the limits that contain the central fraction `share` of chi-square / degrees of freedom."""
    tail = 0.5 * (1.0 - share)
    return float(chi2.ppf(tail, degrees)) / degrees, float(chi2.isf(tail, degrees)) / degrees
