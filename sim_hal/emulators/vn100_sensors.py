"""The VN-100's measurement of a motion: frames, units, noise.

Two profiles. THESIS: uniform bounds on attitude and rate as Sease 2013 ch. 5 takes them from the unit's data
sheet. DATASHEET: white noise of the published densities at the filter windows of register 85, an error of the
static attitude and a gyro bias drawn at each start. The filters' group delay (half a window, 12.5 ms at 20
samples) is not modelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, from_rotation_vector, multiply, normalise
from sim_hal.worlds.motion import STANDARD_GRAVITY, Motion

IMU_RATE_HZ = 800
GAUSS_PER_TESLA = 1e4
_ROOT_BANDWIDTH = math.sqrt(0.5 * IMU_RATE_HZ)  # white noise sampled at 800 Hz fills 400 Hz

_LOST_DRIFT = 0.01
"""rad a sample, of an attitude without gravity."""

ProfileName = Literal["thesis", "datasheet", "none"]


@dataclass(frozen=True, slots=True)
class NoiseProfile:
    """Bounds of uniform noise, densities of white noise, and errors constant until the next start.

    Attributes:
        attitude_bound: of each component of the vector part of a small rotation in body axes.
        rate_bound: rad/s.
        rate_density, field_density, acceleration_density: rad/s, T, m/s^2 per sqrt(Hz).
        static_attitude: (3,) rad, standard deviations about north, east and down.
        gyro_bias: rad/s, standard deviation of each axis.
    """

    attitude_bound: float = 0.0
    rate_bound: float = 0.0
    rate_density: float = 0.0
    field_density: float = 0.0
    acceleration_density: float = 0.0
    static_attitude: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_bias: float = 0.0


_FIELD_DENSITY = 140e-6 / GAUSS_PER_TESLA
_ACCELERATION_DENSITY = 0.14e-3 * STANDARD_GRAVITY

PROFILES: dict[ProfileName, NoiseProfile] = {
    "none": NoiseProfile(),
    "thesis": NoiseProfile(
        attitude_bound=1.75e-3,
        rate_bound=1.75e-4,
        field_density=_FIELD_DENSITY,
        acceleration_density=_ACCELERATION_DENSITY,
    ),
    "datasheet": NoiseProfile(
        rate_density=math.radians(0.0035),
        field_density=_FIELD_DENSITY,
        acceleration_density=_ACCELERATION_DENSITY,
        static_attitude=(math.radians(0.5), math.radians(0.5), math.radians(2.0)),
        gyro_bias=math.radians(6.0) / 3600.0,
    ),
}


@dataclass(frozen=True, slots=True)
class Measured:
    """One sample, in the unit's own axes and units.

    Attributes:
        quaternion: (4,) NED into sensor: the unit's q0..q3.
        rate: (3,) rad/s.
        mag: (3,) gauss.
        accel: (3,) m/s^2, specific force.
    """

    quaternion: FloatArray
    rate: FloatArray
    mag: FloatArray
    accel: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """The direction cosines (3, 3), NED into sensor."""
        return attitude_matrix(self.quaternion)

    @property
    def yaw_pitch_roll(self) -> tuple[float, float, float]:
        """The 3-2-1 Euler angles in degrees."""
        a = self.matrix
        yaw = math.atan2(a[0, 1], a[0, 0])
        pitch = -math.asin(min(1.0, max(-1.0, a[0, 2])))
        return math.degrees(yaw), math.degrees(pitch), math.degrees(math.atan2(a[1, 2], a[2, 2]))


class Sensors:
    """The unit's sensors: from a motion of the body to a sample."""

    def __init__(
        self,
        rng: np.random.Generator,
        profile: NoiseProfile,
        mounting: FloatArray,
        reference: FloatArray,
        gyro_bias: FloatArray,
        free_fall: bool = False,
    ) -> None:
        """Take quaternions, sensor into body and NED into reference frame, and a bias (3,) rad/s.

        In `free_fall` the unit has no down to find: its own attitude drifts about without meaning.
        """
        self._rng = rng
        self._profile = profile
        self._to_sensor = attitude_matrix(conjugate(mounting))
        # conj(mounting) (small q) reference is linear in q and in small: as a table it costs two products.
        body = multiply(np.eye(4)[None, :], np.eye(4)[:, None])
        self._table = multiply(multiply(conjugate(mounting), body), reference).reshape(4, 16)
        self._fixed_bias = gyro_bias
        self._static: FloatArray | None = None
        self._bias = gyro_bias
        self._free_fall = free_fall
        self._scales: dict[tuple[int, ...], FloatArray] = {}

    def restart(self) -> None:
        """Draw the errors that are constant until the next start."""
        draws = self._rng.standard_normal(6)
        self._bias = self._fixed_bias + self._profile.gyro_bias * draws[:3]
        static = np.array(self._profile.static_attitude)
        self._static = from_rotation_vector(static * draws[3:]) if static.any() else None
        if self._free_fall:
            self._static = normalise(self._rng.standard_normal(4))

    def measure(self, motion: Motion, windows: tuple[int, ...]) -> Measured:
        """Return one sample; `windows` are the filter lengths of magnetometer, accelerometer and gyro."""
        profile = self._profile
        bounded = 2.0 * self._rng.random(6) - 1.0
        white = self._scale(windows) * (self._rng.standard_normal(9) * _ROOT_BANDWIDTH)
        x, y, z = (profile.attitude_bound * bounded[:3]).tolist()
        small = np.array([x, y, z, math.sqrt(1.0 - x * x - y * y - z * z)])
        q = small @ (motion.quaternion @ self._table).reshape(4, 4)
        if self._free_fall and self._static is not None:
            drift = from_rotation_vector(_LOST_DRIFT * self._rng.standard_normal(3))
            self._static = normalise(multiply(drift, self._static))
        if self._static is not None:
            q = multiply(q, self._static)
        turn = self._to_sensor
        return Measured(
            quaternion=q,
            rate=turn @ (motion.rate + profile.rate_bound * bounded[3:]) + self._bias + white[:3],
            mag=GAUSS_PER_TESLA * (turn @ motion.field_body + white[3:6]),
            accel=turn @ motion.specific_force_body + white[6:],
        )

    def _scale(self, windows: tuple[int, ...]) -> FloatArray:
        """Return the noise densities (9,) of gyro, magnetometer and accelerometer behind their filters."""
        if windows not in self._scales:
            mag, accel, gyro = (math.sqrt(max(1, window)) for window in windows)
            profile = self._profile
            of_each = (
                profile.rate_density / gyro,
                profile.field_density / mag,
                profile.acceleration_density / accel,
            )
            self._scales[windows] = np.repeat(of_each, 3)
        return self._scales[windows]
