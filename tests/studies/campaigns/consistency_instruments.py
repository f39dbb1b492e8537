"""What looks at the worlds of the campaign `consistency`, and what steers them.

The VN-100 is sim_hal's own sensors, the star camera is drawn from its accuracy: tens of microradians across
the boresight, ten times that about it.
"""

from __future__ import annotations

import numpy as np

from flight.bodies.testbed.control import about_thread
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import IDENTITY, NED_TO_TESTBED, attitude_map, from_rotation_vector, multiply
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from sim_hal.emulators.vn100_sensors import NoiseProfile, Sensors
from sim_hal.worlds.world import BodyMotion
from tests.support.consistency_worlds import CYCLE_NS, DIPOLE, INERTIA, TESTBED_FIELD, World

QUATERNION_BOUND, RATE_BOUND = 1.75e-3, 1.75e-4
EXPOSURE, CAMERA_PERIOD = 40, 200
"""Cycles."""
LEAST_STREAK = 1.0e-3
"""rad: three px of a 20 deg field, less is no streak."""
RATE_SIGMAS: FloatArray = np.array([1.5e-5, 1.5e-5, 1.5e-4])
TRACKER_SIGMAS: FloatArray = np.array([5e-5, 5e-5, 5e-4])


class Unit:
    """The emulated VN-100's sensors, aligned with the body, in the testbed's place.

    `claimed` is what its variances are said to be over what they are.
    """

    def __init__(self, rng: np.random.Generator, bias: FloatArray, claimed: float = 1.0) -> None:
        profile = NoiseProfile(attitude_bound=QUATERNION_BOUND, rate_bound=RATE_BOUND)
        self._sensors = Sensors(rng, profile, IDENTITY, NED_TO_TESTBED, bias)
        self._map = attitude_map(IDENTITY, NED_TO_TESTBED)
        self._attitude_covariance = np.eye(3) * claimed * (2.0 * QUATERNION_BOUND) ** 2 / 3.0
        self._rate_covariance = np.eye(3) * claimed * RATE_BOUND**2 / 3.0

    def sample(self, now_ns: int, world: World) -> tuple[AttitudeMeasurement, RateMeasurement]:
        """Return what the unit says of now."""
        motion = BodyMotion(now_ns, world.attitude, world.rate, np.zeros(3), np.zeros(3))
        said = self._sensors.measure(motion, (1, 1, 1))
        return (
            AttitudeMeasurement(now_ns, self._map @ said.quaternion, self._attitude_covariance),
            RateMeasurement(now_ns, said.rate, self._rate_covariance),
        )


class Camera:
    """A star camera mounted anyhow, whose results come late."""

    def __init__(self, rng: np.random.Generator, tracks: bool) -> None:
        self._rng = rng
        self._tracks = tracks
        self._axes = random_axes(rng)
        self._started: FloatArray = IDENTITY
        self._late: list[tuple[int, str, Measurement]] = []

    def due(self, cycle: int, world: World) -> list[tuple[str, Measurement]]:
        """Expose, and return the results that have come by `cycle`."""
        phase = cycle % CAMERA_PERIOD
        if phase == 1:
            self._started = world.attitude
        elif phase == 1 + EXPOSURE // 2 and self._tracks:
            error, covariance = seen_from(self._axes, TRACKER_SIGMAS, self._rng)
            seen = multiply(from_rotation_vector(error), world.attitude)
            measured = AttitudeMeasurement(cycle * CYCLE_NS, seen, covariance)
            self._send(cycle + EXPOSURE // 2, "star tracker", measured)
        elif phase == 1 + EXPOSURE:
            begin_ns, span = (cycle - EXPOSURE) * CYCLE_NS, EXPOSURE * CYCLE_NS * 1e-9
            rate = mean_rate(self._started, world.attitude, span)
            if np.linalg.norm(rate) * span > LEAST_STREAK:
                error, covariance = seen_from(self._axes, RATE_SIGMAS, self._rng)
                measured_rate = MeanRateMeasurement(begin_ns, cycle * CYCLE_NS, rate + error, covariance)
                self._send(cycle, "streaks", measured_rate)
        come = [(kind, m) for at, kind, m in self._late if at <= cycle]
        self._late = [entry for entry in self._late if entry[0] > cycle]
        return come

    def _send(self, end: int, kind: str, measurement: Measurement) -> None:
        self._late.append((end + int(self._rng.integers(8, 25)), kind, measurement))


class Pilot:
    """Steers by the estimate: steps of q2 on the thread; free, currents that excite all axes."""

    def __init__(self, rng: np.random.Generator, suspended: bool) -> None:
        self._suspended = suspended
        self._targets = rng.uniform(-0.6, 0.6, 64)
        self._frequency, self._phase = rng.uniform(0.1, 0.6, 3), rng.uniform(0.0, 6.28, 3)

    def currents(self, cycle: int, estimate: Estimate) -> FloatArray:
        """Return the coil currents (3,) in A."""
        if not self._suspended:
            swing = np.sin(self._frequency * cycle * CYCLE_NS * 1e-9 + self._phase)
            return np.asarray(0.1 * swing)
        now = about_thread(estimate)
        wanted = 0.5 * (self._targets[(cycle // 800) % 64] - now.angle) - 1.2 * now.rate - now.disturbance
        gain = DIPOLE * -TESTBED_FIELD[2] * np.cos(now.angle) / INERTIA[1, 1]
        return np.array([np.clip(wanted / gain, -0.148, 0.148), 0.0, 0.0])


def mean_rate(start: FloatArray, end: FloatArray, span: float) -> FloatArray:
    """Return the constant rate (3,) that turns attitude `start` into `end` within `span` s, by Rodrigues."""
    vector = np.array(
        [
            start[3] * end[0] - end[3] * start[0] - (end[2] * start[1] - end[1] * start[2]),
            start[3] * end[1] - end[3] * start[1] - (end[0] * start[2] - end[2] * start[0]),
            start[3] * end[2] - end[3] * start[2] - (end[1] * start[0] - end[0] * start[1]),
        ]
    )
    scalar = start @ end
    sine = float(np.linalg.norm(vector))
    angle = 2.0 * np.arctan2(sine, abs(scalar)) * np.sign(scalar)
    return np.asarray(vector / max(sine, 1e-300) * angle / span)


def seen_from(
    axes: FloatArray, sigmas: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return an error (3,) and its covariance (3, 3), of `sigmas` (3,) along the columns of `axes`."""
    return axes @ (sigmas * rng.standard_normal(3)), (axes * sigmas**2) @ axes.T


def random_axes(rng: np.random.Generator) -> FloatArray:
    """Return three orthogonal directions (3, 3): a camera mounted anyhow."""
    return np.asarray(np.linalg.qr(rng.standard_normal((3, 3)))[0])
