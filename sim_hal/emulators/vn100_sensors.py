"""The VN-100's measurement of a motion (frames, units, noise), and the messages that contain it.

There are two noise profiles. THESIS has uniform bounds on attitude and rate, as Sease 2013 ch. 5 takes them
from the unit's data sheet. DATASHEET has white noise of the published densities at the filter windows of
register 85, an error of the static attitude, and a gyro bias that is drawn at each start. The filters' group
delay (half a window, 12.5 ms at 20 samples) is not modelled. Layout and number formats: VectorNav UM001
v2.43 ch. 4 and 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, from_rotation_vector, multiply, normalise
from sim_hal.worlds.world import STANDARD_GRAVITY, BodyMotion

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
class Vn100Sample:
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

    def measure(self, motion: BodyMotion, windows: tuple[int, ...]) -> Vn100Sample:
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
        return Vn100Sample(
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


GRAVITY_NED: FloatArray = np.array([0.0, 0.0, STANDARD_GRAVITY])


@dataclass(frozen=True, slots=True)
class MessageData:
    """The data of all messages at one time.

    Attributes:
        device_ns: since start.
        measured: the sample.
        status: the VPE status word.
        interval: s, since the previous output of the same kind; delta angle and velocity are of this time.
        temperature: degrees C. pressure: kPa.
    """

    device_ns: int
    measured: Vn100Sample
    status: int
    interval: float
    temperature: float
    pressure: float

    def linear_body(self) -> FloatArray:
        """Return the acceleration (3,) without gravity, body axes."""
        return self.measured.accel + self.measured.matrix @ GRAVITY_NED

    def deltas(self) -> tuple[float, ...]:
        """Return interval in s, delta angle (3) in degrees, delta velocity (3) in m/s."""
        turned = np.degrees(self.measured.rate) * self.interval
        return (self.interval, *turned.tolist(), *(self.measured.accel * self.interval).tolist())


Values = tuple[float, ...]


def _time(now: MessageData) -> Values:
    return (now.device_ns,)


def _zero(_: MessageData) -> Values:
    return (0,)


def _yaw_pitch_roll(now: MessageData) -> Values:
    return now.measured.yaw_pitch_roll


def _quaternion(now: MessageData) -> Values:
    return tuple(now.measured.quaternion.tolist())


def _rate(now: MessageData) -> Values:
    return tuple(now.measured.rate.tolist())


def _mag(now: MessageData) -> Values:
    return tuple(now.measured.mag.tolist())


def _accel(now: MessageData) -> Values:
    return tuple(now.measured.accel.tolist())


def _status(now: MessageData) -> Values:
    return (now.status,)


def _in_ned(vector: FloatArray, now: MessageData) -> Values:
    return tuple((now.measured.matrix.T @ vector).tolist())


# By (group bit, field bit), the numbers of `hal.drivers.vn100.protocol.FIELDS`.
FIELD_VALUES: Mapping[tuple[int, int], Callable[[MessageData], Values]] = {
    (0, 0): _time,
    (0, 2): _zero,
    (0, 3): _yaw_pitch_roll,
    (0, 4): _quaternion,
    (0, 5): _rate,
    (0, 8): _accel,
    (0, 9): lambda now: _accel(now) + _rate(now),
    (0, 10): lambda now: (*_mag(now), now.temperature, now.pressure),
    (0, 11): MessageData.deltas,
    (0, 12): _status,
    (0, 13): _zero,
    (1, 0): _time,
    (1, 4): _zero,
    (1, 7): _zero,
    (1, 8): _zero,
    (2, 0): _zero,
    (2, 1): _mag,
    (2, 2): _accel,
    (2, 3): _rate,
    (2, 4): lambda now: (now.temperature,),
    (2, 5): lambda now: (now.pressure,),
    (2, 6): lambda now: now.deltas()[:4],
    (2, 7): lambda now: now.deltas()[4:],
    (2, 8): _mag,
    (2, 9): _accel,
    (2, 10): _rate,
    (2, 11): _zero,
    (4, 0): _status,
    (4, 1): _yaw_pitch_roll,
    (4, 2): _quaternion,
    (4, 3): lambda now: tuple(now.measured.matrix.flatten(order="F").tolist()),
    (4, 4): lambda now: _in_ned(now.measured.mag, now),
    (4, 5): lambda now: _in_ned(now.measured.accel, now),
    (4, 6): lambda now: tuple(now.linear_body().tolist()),
    (4, 7): lambda now: _in_ned(now.linear_body(), now),
    (4, 8): lambda _: (2.0, 0.5, 0.5),
}


def _print(form: str, values: Iterable[float]) -> list[str]:
    return [form % value for value in values]


def _angles_text(now: MessageData) -> list[str]:
    return _print("%+08.3f", now.measured.yaw_pitch_roll)


def _quaternion_text(now: MessageData) -> list[str]:
    return _print("%+09.6f", _quaternion(now))


def _mag_text(now: MessageData) -> list[str]:
    return _print("%+08.4f", _mag(now))


def _accel_text(now: MessageData) -> list[str]:
    return _print("%+07.3f", _accel(now))


def _rate_text(now: MessageData) -> list[str]:
    return _print("%+010.6f", _rate(now))


def _sensors_text(now: MessageData) -> list[str]:
    return _mag_text(now) + _accel_text(now) + _rate_text(now)


def _deltas_text(now: MessageData) -> list[str]:
    interval, *deltas = now.deltas()
    return [f"{interval:+09.6f}", *_print("%+08.3f", deltas)]


def _linear_text(now: MessageData, key: tuple[int, int]) -> list[str]:
    return _angles_text(now) + _print("%+07.3f", FIELD_VALUES[key](now)) + _rate_text(now)


def _imu_text(now: MessageData) -> list[str]:
    return [*_sensors_text(now), f"{now.temperature:+05.1f}", f"{now.pressure:+010.3f}"]


@dataclass(frozen=True, slots=True)
class AsciiOutput:
    """One kind of ASCII output: header after `$VN`, number in register 6, register that reads it."""

    header: str
    async_type: int
    register: int | None
    text: Callable[[MessageData], list[str]]


REPORTS = (
    AsciiOutput("YPR", 1, 8, _angles_text),
    AsciiOutput("QTN", 2, 9, _quaternion_text),
    AsciiOutput("QMR", 8, 15, lambda now: _quaternion_text(now) + _sensors_text(now)),
    AsciiOutput("DCM", 9, None, lambda now: _print("%+09.6f", now.measured.matrix.flatten().tolist())),
    AsciiOutput("MAG", 10, 17, _mag_text),
    AsciiOutput("ACC", 11, 18, _accel_text),
    AsciiOutput("GYR", 12, 19, _rate_text),
    AsciiOutput("MAR", 13, 20, _sensors_text),
    AsciiOutput("YMR", 14, 27, lambda now: _angles_text(now) + _sensors_text(now)),
    AsciiOutput("YBA", 16, 239, lambda now: _linear_text(now, (4, 6))),
    AsciiOutput("YIA", 17, 240, lambda now: _linear_text(now, (4, 7))),
    AsciiOutput("IMU", 19, 54, _imu_text),
    AsciiOutput("DTV", 30, 80, _deltas_text),
)
OUTPUT_BY_TYPE = {report.async_type: report for report in REPORTS}
OUTPUT_BY_REGISTER = {report.register: report for report in REPORTS if report.register is not None}

_LEVEL = Vn100Sample(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), -GRAVITY_NED)
STILL = MessageData(0, _LEVEL, 0, 0.025, 20.0, 101.325)
"""A level unit at rest, from which sentence lengths are computed."""

SENTENCE_FRAME = len("$VN") + len("*XX\r\n")


def sentence_length(report: AsciiOutput) -> int:
    """Return the bytes of one sentence with an 8-bit checksum."""
    return SENTENCE_FRAME + len(",".join([report.header, *report.text(STILL)]))
