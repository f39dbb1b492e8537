"""A free satellite for campaigns: the simulated world, a random orbit, and sensors with noise.

Without executive and emulated devices, a flight takes only the processor time of the simulated world. Control
rates are lower than 40 Hz.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from sim_hal.description_errors import NO_ERRORS, DescriptionErrors
from sim_hal.settings import Disturbances, FreeBodySection, OrbitSection, TipOff
from sim_hal.worlds.free_body import CRAFTS, FreeBody

SECOND = 1_000_000_000
CRAFT = {"knightcube": 0.0959, "cubesat_3u": 0.2}
"""Largest dipole moment (A m^2) of each coil, by craft."""
WATTS = {"knightcube": 54.8, "cubesat_3u": 5.0}
"""Power of the coils per squared dipole moment, W/(A m^2)^2, by craft."""
ORBITS = {"sso": (500e3, 97.4), "iss": (420e3, 51.6), "low": (300e3, 51.6), "equator": (500e3, 0.0)}
"""Altitude (m) and inclination (deg) of each orbit."""
UTC = "2026-11-23T00:00:00Z"
FIELD_NOISE, HARD_IRON = 1e-7, 1.5e-7
"""Magnetometer of a VN-100: noise (T) at 40 Hz, and bias (T) of an axis after calibration."""
GYRO_NOISE, GYRO_BIAS, GYRO_BIAS_WALK = 6.1e-5, 5e-4, 2e-6
"""Noise (rad/s per sqrt(Hz)), bias (rad/s), and random walk of the bias (rad/s per sqrt(s)) of a VN-100's
gyro.
"""
FIX_SIGMA, FIX_VELOCITY_SIGMA = 10.0, 0.05
"""Standard deviations of a GPS fix: position (m) and velocity (m/s)."""
STILL = {"ring_current": 0.0, "day_bulge": 0.0, "walks": 0.0}
"""Settings that switch off the disturbances that other simulators do not model."""
_STREAM = 0xF11


class FreeFlight:
    """True states of a satellite under commanded dipoles; a seed determines all random draws."""

    def __init__(
        self,
        craft: str,
        seed: int,
        orbit: str,
        release: TipOff,
        disturbances: Disturbances | None = None,
        description: DescriptionErrors = NO_ERRORS,
    ) -> None:
        """Release the craft at time 0 on `orbit`; the seed determines node and phase.

        The true body differs from the configured craft by the errors `description`.
        """
        self.generator = np.random.default_rng([seed, _STREAM])
        altitude, inclination = ORBITS[orbit]
        node, anomaly = self.generator.uniform(0.0, 360.0, 2).tolist()
        section = FreeBodySection(
            craft=craft,  # type: ignore[arg-type]  # a name that a test has checked
            orbit=OrbitSection(
                altitude=altitude,
                inclination_deg=inclination,
                ascending_node_deg=node,
                true_anomaly_deg=anomaly,
            ),
            release=release,
            disturbances=disturbances or Disturbances(),
        )
        self._currents: FloatArray = np.zeros(3)
        self.body = FreeBody(section, lambda: self._currents, seed=seed, utc=UTC, description=description)
        self.body.release_at(0)
        shape = CRAFTS[craft]
        self.inertia: FloatArray = shape.inertia
        self.limit = CRAFT[craft]
        self.dipole_per_ampere = float(shape.dipoles[0, 0])
        self.time_ns = 0
        self.square = 0.0
        """Integral (A^2 m^4 s) of the squared commanded dipole."""
        self.hard_iron = HARD_IRON * self.generator.standard_normal(3)
        self.gyro_bias = GYRO_BIAS * self.generator.standard_normal(3)
        self.field_error: FloatArray = np.zeros(3)
        """Error (3,), T, ICRS, that is added to the field of the world."""
        self.coil_noise = 0.0
        """Standard deviation (A m^2) of each axis of a commanded dipole."""

    def act(self, dipole: FloatArray) -> None:
        """Command a dipole (3,), A m^2, until the next command."""
        if self.coil_noise and dipole.any():
            dipole = dipole + self.coil_noise * self.generator.standard_normal(3)
        self._currents = dipole / self.dipole_per_ampere

    def advance(self, time_ns: int) -> None:
        """Advance the simulation to `time_ns`."""
        seconds = (time_ns - self.time_ns) / SECOND
        dipole = self._currents * self.dipole_per_ampere
        self.square += seconds * float(dipole @ dipole)
        self.gyro_bias = self.gyro_bias + GYRO_BIAS_WALK * np.sqrt(seconds) * self.generator.standard_normal(
            3
        )
        self.motion = self.body.motion(time_ns)
        self.time_ns = time_ns

    def field(self, samples: int = 1) -> FloatArray:
        """Return the mean (3,), T, of magnetometer samples at the present time; the coils must be off."""
        noise = FIELD_NOISE / np.sqrt(samples) * self.generator.standard_normal(3)
        astray = attitude_matrix(self.motion.quaternion) @ self.field_error
        return np.asarray(self.motion.field_body + self.hard_iron + astray + noise)

    def attitude(self, sigma: float) -> FloatArray:
        """Return the present attitude (4,) with a random error of `sigma` (rad) per axis."""
        error = from_rotation_vector(sigma * self.generator.standard_normal(3))
        return multiply(error, self.motion.quaternion)

    def ephemeris(self, duration: float) -> Ephemeris:
        """Return the flight software's orbit prediction over `duration` s from a present GPS fix."""
        truth = self.body.orbit_truth()
        position = truth.position + FIX_SIGMA * self.generator.standard_normal(3)
        velocity = truth.velocity + FIX_VELOCITY_SIGMA * self.generator.standard_normal(3)
        return predict(OrbitState(truth.utc, position, velocity, FIX_SIGMA), duration)
