"""The VN-100's messages: values of binary fields, text of ASCII sentences.

Layout and number formats: VectorNav UM001 v2.43 ch. 4 and 5.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.vn100_sensors import Measured
from sim_hal.worlds.motion import STANDARD_GRAVITY

GRAVITY_NED: FloatArray = np.array([0.0, 0.0, STANDARD_GRAVITY])


@dataclass(frozen=True, slots=True)
class Instant:
    """The data of all messages at one time.

    Attributes:
        device_ns: since start.
        measured: the sample.
        status: the VPE status word.
        interval: s, since the previous output of the same kind; delta angle and velocity are of this time.
        temperature: degrees C. pressure: kPa.
    """

    device_ns: int
    measured: Measured
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


def _time(now: Instant) -> Values:
    return (now.device_ns,)


def _zero(_: Instant) -> Values:
    return (0,)


def _yaw_pitch_roll(now: Instant) -> Values:
    return now.measured.yaw_pitch_roll


def _quaternion(now: Instant) -> Values:
    return tuple(now.measured.quaternion.tolist())


def _rate(now: Instant) -> Values:
    return tuple(now.measured.rate.tolist())


def _mag(now: Instant) -> Values:
    return tuple(now.measured.mag.tolist())


def _accel(now: Instant) -> Values:
    return tuple(now.measured.accel.tolist())


def _status(now: Instant) -> Values:
    return (now.status,)


def _in_ned(vector: FloatArray, now: Instant) -> Values:
    return tuple((now.measured.matrix.T @ vector).tolist())


# By (group bit, field bit), the numbers of `hal.drivers.vn100.protocol.FIELDS`.
FIELD_VALUES: Mapping[tuple[int, int], Callable[[Instant], Values]] = {
    (0, 0): _time,
    (0, 2): _zero,
    (0, 3): _yaw_pitch_roll,
    (0, 4): _quaternion,
    (0, 5): _rate,
    (0, 8): _accel,
    (0, 9): lambda now: _accel(now) + _rate(now),
    (0, 10): lambda now: (*_mag(now), now.temperature, now.pressure),
    (0, 11): Instant.deltas,
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


def _angles_text(now: Instant) -> list[str]:
    return _print("%+08.3f", now.measured.yaw_pitch_roll)


def _quaternion_text(now: Instant) -> list[str]:
    return _print("%+09.6f", _quaternion(now))


def _mag_text(now: Instant) -> list[str]:
    return _print("%+08.4f", _mag(now))


def _accel_text(now: Instant) -> list[str]:
    return _print("%+07.3f", _accel(now))


def _rate_text(now: Instant) -> list[str]:
    return _print("%+010.6f", _rate(now))


def _sensors_text(now: Instant) -> list[str]:
    return _mag_text(now) + _accel_text(now) + _rate_text(now)


def _deltas_text(now: Instant) -> list[str]:
    interval, *deltas = now.deltas()
    return [f"{interval:+09.6f}", *_print("%+08.3f", deltas)]


def _linear_text(now: Instant, key: tuple[int, int]) -> list[str]:
    return _angles_text(now) + _print("%+07.3f", FIELD_VALUES[key](now)) + _rate_text(now)


def _imu_text(now: Instant) -> list[str]:
    return [*_sensors_text(now), f"{now.temperature:+05.1f}", f"{now.pressure:+010.3f}"]


@dataclass(frozen=True, slots=True)
class Report:
    """One kind of ASCII output: header after `$VN`, number in register 6, register that reads it."""

    header: str
    async_type: int
    register: int | None
    text: Callable[[Instant], list[str]]


REPORTS = (
    Report("YPR", 1, 8, _angles_text),
    Report("QTN", 2, 9, _quaternion_text),
    Report("QMR", 8, 15, lambda now: _quaternion_text(now) + _sensors_text(now)),
    Report("DCM", 9, None, lambda now: _print("%+09.6f", now.measured.matrix.flatten().tolist())),
    Report("MAG", 10, 17, _mag_text),
    Report("ACC", 11, 18, _accel_text),
    Report("GYR", 12, 19, _rate_text),
    Report("MAR", 13, 20, _sensors_text),
    Report("YMR", 14, 27, lambda now: _angles_text(now) + _sensors_text(now)),
    Report("YBA", 16, 239, lambda now: _linear_text(now, (4, 6))),
    Report("YIA", 17, 240, lambda now: _linear_text(now, (4, 7))),
    Report("IMU", 19, 54, _imu_text),
    Report("DTV", 30, 80, _deltas_text),
)
REPORT_BY_TYPE = {report.async_type: report for report in REPORTS}
REPORT_BY_REGISTER = {report.register: report for report in REPORTS if report.register is not None}

_LEVEL = Measured(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), -GRAVITY_NED)
STILL = Instant(0, _LEVEL, 0, 0.025, 20.0, 101.325)
"""A level unit at rest, from which sentence lengths are computed."""

SENTENCE_FRAME = len("$VN") + len("*XX\r\n")


def report_length(report: Report) -> int:
    """Return the bytes of one sentence with an 8-bit checksum."""
    return SENTENCE_FRAME + len(",".join([report.header, *report.text(STILL)]))
