"""Measurements of an emulated VN-100 (frames, units, noise), and the contents of its messages.

The main noise profiles are "thesis" and "datasheet". The profile "thesis" has uniform noise of attitude and
rate with the bounds of Sease 2013, chapter 5. The profile "datasheet" has white noise with the densities of
the data sheet and the filter windows of register 85, a static attitude error, and a gyro bias that is drawn
at each start. The group delay of the filters (half a window, 12.5 ms for 20 samples) is not modelled. The
layouts and number formats follow VectorNav UM001 v2.43, chapters 4 and 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    IDENTITY,
    Quaternion,
    attitude_matrix,
    compose,
    conjugate,
    exponential,
    from_rotation_vector,
    normalise,
)
from sim_hal.worlds.world import STANDARD_GRAVITY, BodyMotion

IMU_RATE_HZ = 800
GAUSS_PER_TESLA = 1e4
_ROOT_BANDWIDTH = math.sqrt(0.5 * IMU_RATE_HZ)  # white noise sampled at 800 Hz has a bandwidth of 400 Hz

_DRIFT_WITHOUT_GRAVITY = 0.01
"""Standard deviation (rad per sample) of the attitude's random drift in free fall."""

ProfileName = Literal["thesis", "datasheet", "none"]


@dataclass(frozen=True, slots=True)
class NoiseProfile:
    """Sensor errors: uniform noise, white noise, and errors that are constant until the unit's next start.

    Attributes:
        attitude_bound: bound of the uniform noise of each vector component of the error quaternion, body
            axes.
        rate_bound: bound of the uniform rate noise, rad/s.
        rate_density, field_density, acceleration_density: white noise densities, rad/s, T and m/s^2 per
            sqrt(Hz).
        static_attitude: standard deviations (3,) of the static attitude error about north, east and down,
            rad.
        gyro_bias: standard deviation of the gyro bias on each axis, rad/s.
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
class Vn100Sample:
    """One sample of the unit, in sensor axes and the unit's own units.

    Attributes:
        quaternion: attitude (4,), NED into sensor, with the elements that the unit calls q0 to q3.
        rate: rotation rate (3,), rad/s.
        mag: magnetic field (3,), gauss.
        accel: specific force (3,), m/s^2.
    """

    quaternion: FloatArray
    rate: FloatArray
    mag: FloatArray
    accel: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """Direction cosine matrix (3, 3), NED into sensor."""
        return attitude_matrix(self.quaternion)

    @property
    def yaw_pitch_roll(self) -> tuple[float, float, float]:
        """Yaw, pitch and roll (3-2-1 Euler angles), deg."""
        a = self.matrix
        yaw = math.atan2(a[0, 1], a[0, 0])
        pitch = -math.asin(min(1.0, max(-1.0, a[0, 2])))
        return math.degrees(yaw), math.degrees(pitch), math.degrees(math.atan2(a[1, 2], a[2, 2]))


class Sensors:
    """Sensors of the unit, which measure the motion of the body."""

    def __init__(
        self,
        rng: np.random.Generator,
        profile: NoiseProfile,
        mounting: FloatArray,
        reference: FloatArray,
        gyro_bias: FloatArray,
        free_fall: bool = False,
    ) -> None:
        """Create the sensors of a unit.

        `mounting` is the quaternion from sensor to body axes, and `reference` is the quaternion from NED to
        the reference frame. `gyro_bias` (3,) is in rad/s. In `free_fall` the unit cannot measure the
        vertical, so its attitude drifts at random.
        """
        self._rng, self._profile = rng, profile
        # One matrix maps rate, field and specific force in body axes to sensor axes and the unit's own units.
        turn: FloatArray = attitude_matrix(conjugate(mounting))
        self._map: FloatArray = np.asarray(
            np.kron(np.diag([1.0, GAUSS_PER_TESLA, 1.0]), turn), dtype=np.float64
        )
        self._vectors: FloatArray = np.empty(9)
        self._to_sensor, self._reference = _floats(conjugate(mounting)), _floats(reference)
        self._fixed_bias = gyro_bias
        self._static: Quaternion = _floats(IDENTITY)
        self._from_ned = self._reference
        self._biases: FloatArray = np.array([*gyro_bias, *np.zeros(6)])
        self._free_fall = free_fall
        self._scales: dict[tuple[int, ...], FloatArray] = {}

    def restart(self) -> None:
        """Draw the errors that are constant until the next start of the unit."""
        draws = self._rng.standard_normal(6)
        self._biases[:3] = self._fixed_bias + self._profile.gyro_bias * draws[:3]
        self._static = _floats(from_rotation_vector(np.array(self._profile.static_attitude) * draws[3:]))
        if self._free_fall:
            self._static = _floats(normalise(self._rng.standard_normal(4)))
        self._from_ned = compose(self._reference, self._static)

    def measure(self, motion: BodyMotion, windows: tuple[int, ...]) -> Vn100Sample:
        """Return one sample for the filter lengths `windows` of magnetometer, accelerometer and gyro."""
        rng, profile = self._rng, self._profile
        a, b, c, *spun = rng.random(6).tolist()
        noise = rng.standard_normal(9)
        scales = self._scales.get(windows)
        if scales is None:
            scales = self._scales[windows] = self._noise_scales(windows)
        noise *= scales
        noise += self._biases
        q = _floats(motion.quaternion)
        if bound := profile.attitude_bound:
            x, y, z = bound * (2.0 * a - 1.0), bound * (2.0 * b - 1.0), bound * (2.0 * c - 1.0)
            q = compose((x, y, z, math.sqrt(1.0 - x * x - y * y - z * z)), q)
        if self._free_fall:
            x, y, z = rng.standard_normal(3).tolist()
            drift = _DRIFT_WITHOUT_GRAVITY
            self._static = compose(exponential(drift * x, drift * y, drift * z), self._static)
            self._from_ned = compose(self._reference, self._static)
        vectors = self._vectors
        vectors[:3], vectors[3:6], vectors[6:] = motion.rate, motion.field_body, motion.specific_force_body
        if profile.rate_bound:
            vectors[:3] += [profile.rate_bound * (2.0 * share - 1.0) for share in spun]
        values: FloatArray = self._map.dot(vectors)
        values += noise
        attitude = np.array(compose(compose(self._to_sensor, q), self._from_ned))
        return Vn100Sample(quaternion=attitude, rate=values[:3], mag=values[3:6], accel=values[6:])

    def _noise_scales(self, windows: tuple[int, ...]) -> FloatArray:
        """Return the standard deviations (9,) of rate, field and specific force for filter lengths (3,)."""
        mag, accel, gyro = (math.sqrt(max(1, window)) for window in windows)
        profile = self._profile
        densities = profile.rate_density, profile.field_density, profile.acceleration_density
        scales = np.array(densities) / (gyro, mag, accel) * (1.0, GAUSS_PER_TESLA, 1.0)
        return np.repeat(scales * _ROOT_BANDWIDTH, 3)


def _floats(q: FloatArray) -> Quaternion:
    """Return a quaternion (4,) as a tuple of floats."""
    x, y, z, w = q.tolist()
    return x, y, z, w


GRAVITY_NED: FloatArray = np.array([0.0, 0.0, STANDARD_GRAVITY])
Values = Sequence[float]
Reader = Callable[["MessageData"], Values]
"""Function that returns the values of a quantity."""


class MessageData(NamedTuple):
    """Data for all messages of one sampling time.

    Attributes:
        device_ns: time of the unit's clock since the unit's start, ns.
        sample: measured sample.
        status: status word of the attitude filter (VPE).
        interval: time since the previous output of the same kind, s, the integration time of delta angles and
            delta velocities.
        temperature: reported temperature, degrees C.
        pressure: reported pressure, kPa.
    """

    device_ns: int
    sample: Vn100Sample
    status: int
    interval: float
    temperature: float
    pressure: float

    def text(self, names: str) -> list[str]:
        """Return the values of named quantities as text in the format of the VN-100."""
        quantities = (_QUANTITIES[name] for name in names.split())
        pairs = [(form, value) for read, form in quantities for value in read(self)]
        # Zero padding would turn NaN into the text +0000nan, which cannot be parsed.
        return [form % value if math.isfinite(value) else f"{value:+}" for form, value in pairs]

    def linear_acceleration(self) -> FloatArray:
        """Return the acceleration (3,) without gravity, body axes."""
        return self.sample.accel + self.sample.matrix @ GRAVITY_NED


def _vector(read: Callable[[MessageData], FloatArray]) -> Reader:
    return lambda now: read(now).tolist()


_QUANTITIES: Mapping[str, tuple[Reader, str]] = {
    "zero": (lambda _: (0,), ""),
    "time": (lambda now: (now.device_ns,), ""),
    "status": (lambda now: (now.status,), ""),
    "temperature": (lambda now: (now.temperature,), "%+05.1f"),
    "pressure": (lambda now: (now.pressure,), "%+010.3f"),
    "interval": (lambda now: (now.interval,), "%+09.6f"),
    "uncertainty": (lambda _: (2.0, 0.5, 0.5), ""),
    "angles": (lambda now: now.sample.yaw_pitch_roll, "%+08.3f"),
    "quaternion": (_vector(lambda now: now.sample.quaternion), "%+09.6f"),
    "matrix": (_vector(lambda now: now.sample.matrix.flatten()), "%+09.6f"),
    "matrix_by_columns": (_vector(lambda now: now.sample.matrix.flatten(order="F")), ""),
    "rate": (_vector(lambda now: now.sample.rate), "%+010.6f"),
    "mag": (_vector(lambda now: now.sample.mag), "%+08.4f"),
    "accel": (_vector(lambda now: now.sample.accel), "%+07.3f"),
    "linear": (_vector(lambda now: now.linear_acceleration()), "%+07.3f"),
    "mag_ned": (_vector(lambda now: now.sample.matrix.T @ now.sample.mag), ""),
    "accel_ned": (_vector(lambda now: now.sample.matrix.T @ now.sample.accel), ""),
    "linear_ned": (_vector(lambda now: now.sample.matrix.T @ now.linear_acceleration()), "%+07.3f"),
    "delta_angle": (_vector(lambda now: np.degrees(now.sample.rate) * now.interval), "%+08.3f"),
    "delta_velocity": (_vector(lambda now: now.sample.accel * now.interval), "%+08.3f"),
}
"""Read function and ASCII format of each quantity; delta angles in deg, delta velocities in m/s."""


BINARY_FIELDS: Mapping[tuple[int, int], str] = {
    (0, 0): "time", (0, 2): "zero", (0, 3): "angles", (0, 4): "quaternion", (0, 5): "rate", (0, 8): "accel",
    (0, 9): "accel rate", (0, 10): "mag temperature pressure", (0, 11): "interval delta_angle delta_velocity",
    (0, 12): "status", (0, 13): "zero",
    (1, 0): "time", (1, 4): "zero", (1, 7): "zero", (1, 8): "zero",
    (2, 0): "zero", (2, 1): "mag", (2, 2): "accel", (2, 3): "rate", (2, 4): "temperature", (2, 5): "pressure",
    (2, 6): "interval delta_angle", (2, 7): "delta_velocity", (2, 8): "mag", (2, 9): "accel", (2, 10): "rate",
    (2, 11): "zero",
    (4, 0): "status", (4, 1): "angles", (4, 2): "quaternion", (4, 3): "matrix_by_columns", (4, 4): "mag_ned",
    (4, 5): "accel_ned", (4, 6): "linear", (4, 7): "linear_ned", (4, 8): "uncertainty",
}  # fmt: skip
"""Quantities by group bit and field bit, as in `hal.drivers.vn100_protocol.FIELDS`."""


def readers(fields: Iterable[tuple[int, int]]) -> tuple[Reader, ...]:
    """Return the functions that read the quantities of binary fields, given their group and field bits."""
    return tuple(_QUANTITIES[name][0] for field in fields for name in BINARY_FIELDS[field].split())


@dataclass(frozen=True, slots=True)
class AsciiOutput:
    """An ASCII output.

    Attributes:
        header: name of the sentence after `$VN`.
        async_type: value of register 6 that selects this output.
        register: number of the register with the same data, or None.
        quantities: names of the quantities in the sentence.
    """

    header: str
    async_type: int
    register: int | None
    quantities: str

    def length(self) -> int:
        """Return the length (bytes) of a sentence of this output with an 8-bit checksum."""
        return len("$VN") + len(",".join([self.header, *_AT_REST.text(self.quantities)])) + len("*XX\r\n")


REPORTS = (
    AsciiOutput("YPR", 1, 8, "angles"),
    AsciiOutput("QTN", 2, 9, "quaternion"),
    AsciiOutput("QMR", 8, 15, "quaternion mag accel rate"),
    AsciiOutput("DCM", 9, None, "matrix"),
    AsciiOutput("MAG", 10, 17, "mag"),
    AsciiOutput("ACC", 11, 18, "accel"),
    AsciiOutput("GYR", 12, 19, "rate"),
    AsciiOutput("MAR", 13, 20, "mag accel rate"),
    AsciiOutput("YMR", 14, 27, "angles mag accel rate"),
    AsciiOutput("YBA", 16, 239, "angles linear rate"),
    AsciiOutput("YIA", 17, 240, "angles linear_ned rate"),
    AsciiOutput("IMU", 19, 54, "mag accel rate temperature pressure"),
    AsciiOutput("DTV", 30, 80, "interval delta_angle delta_velocity"),
)
OUTPUT_BY_TYPE = {output.async_type: output for output in REPORTS}
OUTPUT_BY_REGISTER = {output.register: output for output in REPORTS if output.register is not None}

_AT_REST = MessageData(
    0,
    Vn100Sample(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), -GRAVITY_NED),
    0,
    0.025,
    20.0,
    101.325,
)
"""Data of a level unit at rest, from which the lengths of sentences are computed."""
