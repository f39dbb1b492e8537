"""Detumbling by the magnetometer alone: B-dot, the field taken while the coils are off.

The coils' own field swamps the magnetometer, so time is cut into windows: the coils are off and settle, the
field is averaged, then the coils act on what two windows in a row say. Seen from the body a field that stands
still turns by B' = -w x B, which shows the rate across the field, w_p = B' x B / B^2. The dipole moment
m = (k / B^2) w_p x B brakes it: its torque m x B is -k w_p, however the field stands, and nothing along it
(B-dot: Wertz 1978, 18.3; Avanzini and Giulietti 2012, J. Guid. Control Dyn. 35(4)). The gain follows from the
window: in the time that the coils act, k w_p is to take `share` of J w_p, J the smallest moment of inertia.
Between windows the field is carried on by the rate just found, so that a fast body is braked, not pushed.
The rate is right while the body turns by less than half a turn from window to window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.gnc.errors import UsageError
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector

MOST_SHARE = 0.5
_SECOND = 1e-9
_NO_CURRENT: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True)
class WindowSchedule:
    """One window: coils off to settle, off to measure, then on; all in ns."""

    settle_ns: int
    measure_ns: int
    act_ns: int

    def __post_init__(self) -> None:
        """Refuse a window without measurement or action; raises UsageError."""
        if self.settle_ns < 0 or self.measure_ns <= 0 or self.act_ns <= 0:
            raise UsageError(f"detumble window {self}: measuring and acting need time")

    @property
    def period_ns(self) -> int:
        """From window to window."""
        return self.settle_ns + self.measure_ns + self.act_ns


@dataclass(frozen=True, slots=True)
class Braking:
    """The law's constants.

    Attributes:
        inertia: smallest principal moment, kg m^2.
        dipole_per_ampere: n A of each coil, m^2.
        current_limit: of each coil, A.
        share: of the rate across the field that is to go in one window, below 1.
    """

    inertia: float
    dipole_per_ampere: float
    current_limit: float
    share: float

    def __post_init__(self) -> None:
        """Refuse constants that do not brake; raises UsageError."""
        for name in ("inertia", "dipole_per_ampere", "current_limit", "share"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"detumble {name} is {value}: it must be finite and positive")
        if self.share >= 1.0:
            raise UsageError(
                f"detumble share is {self.share}: from 1 on the rate would change sign each window"
            )


def share_in_turning_field(turn: float, schedule: WindowSchedule) -> float:
    """Return the best `share` for a body in three axes where the field's direction turns by `turn` rad/s.

    Only the field's turn brings the rate along it within reach; with more gain than k = 2 Omega J the spin
    locks to the field and stays (Avanzini and Giulietti 2012). In an orbit the field turns about twice
    a round.
    """
    return min(2.0 * turn * schedule.period_ns * _SECOND, MOST_SHARE)


def rate_across(before: FloatArray, after: FloatArray, seconds: float) -> FloatArray:
    """Return the rate (3,) across the field, rad/s, that turned `before` into `after` (3,) T in the body.

    Exact for a steady turn across the field by less than half a turn. Zero where there is no field.
    """
    turned = np.cross(after, before)  # -w x B: the field goes the other way round than the body
    length = float(np.linalg.norm(turned))
    if length == 0.0:
        return np.zeros(3)
    angle = math.atan2(length, float(before @ after))
    return turned * (angle / (length * seconds))


def braking_current(braking: Braking, rate: FloatArray, field: FloatArray, act_time: float) -> FloatArray:
    """Return currents (3,) A that brake `rate` (3,) rad/s across `field` (3,) T, acting for `act_time` s.

    One scale for all three keeps the direction where a coil would be beyond its limit.
    """
    square = float(field @ field)
    if square == 0.0:
        return np.zeros(3)
    gain = braking.share * braking.inertia / (act_time * square)
    current = np.cross(rate, field) * (gain / braking.dipole_per_ampere)
    largest = float(np.abs(current).max())
    return current * min(1.0, braking.current_limit / largest) if largest > 0.0 else current


class Detumbler:
    """Runs the windows: told of each magnetometer sample, asked for currents each cycle."""

    def __init__(self, schedule: WindowSchedule, braking: Braking) -> None:
        self._schedule = schedule
        self._braking = braking
        self._begun_ns = 0
        self._samples: list[tuple[int, FloatArray]] = []
        self._window = self._closed = -1
        self._before: tuple[int, FloatArray] | None = None
        self._field: tuple[int, FloatArray] | None = None
        self._rate: FloatArray | None = None

    def begin(self, now_ns: int) -> None:
        """Begin a first window; nothing is known of the field."""
        self._begun_ns = now_ns
        self._samples.clear()
        self._window = self._closed = -1
        self._before = self._field = self._rate = None

    def listens(self, time_ns: int) -> bool:
        """Tell whether a sample taken at `time_ns` is of a time at which the coils were off and settled."""
        schedule = self._schedule
        phase_ns = (time_ns - self._begun_ns) % schedule.period_ns
        inside = schedule.settle_ns <= phase_ns < schedule.settle_ns + schedule.measure_ns
        return time_ns >= self._begun_ns and inside

    def sample(self, time_ns: int, field: FloatArray) -> None:
        """Take in a field (3,) T measured at `time_ns`; outside the windows it is not used."""
        if not self.listens(time_ns):
            return
        window = (time_ns - self._begun_ns) // self._schedule.period_ns
        if window <= self._closed:
            return  # it came too late for its window
        if window != self._window:
            self._samples.clear()
            self._window = window
        self._samples.append((time_ns, field))

    def current(self, now_ns: int) -> FloatArray:
        """Return the currents (3,) A for now: zero while the field is measured, or not known well enough."""
        schedule = self._schedule
        phase_ns = (now_ns - self._begun_ns) % schedule.period_ns
        if phase_ns < schedule.settle_ns + schedule.measure_ns:
            return _NO_CURRENT
        self._close_window()
        window = (now_ns - self._begun_ns) // schedule.period_ns
        field = self.field(now_ns)
        if self._rate is None or field is None or window != self._closed:
            return _NO_CURRENT  # no field of this window: an old one says nothing of now
        return braking_current(self._braking, self._rate, field, schedule.act_ns * _SECOND)

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes now, as the last windows let it be carried on; None before."""
        if self._rate is None or self._field is None:
            return None
        since = (now_ns - self._field[0]) * _SECOND
        return np.asarray(attitude_matrix(from_rotation_vector(self._rate * since)) @ self._field[1])

    @property
    def rate(self) -> FloatArray | None:
        """The rate (3,) across the field, rad/s, that the last two windows told; None before."""
        return self._rate

    def _close_window(self) -> None:
        """Make one field of the window's samples, and a rate with that of the window before."""
        if not self._samples:
            return
        time_ns = round(sum(time for time, _ in self._samples) / len(self._samples))
        field = np.mean([field for _, field in self._samples], axis=0)
        self._samples.clear()
        self._closed = self._window
        self._before, self._field = self._field, (time_ns, field)
        self._rate = None
        if self._before is not None:
            span_ns = time_ns - self._before[0]
            if span_ns < 2 * self._schedule.period_ns:  # else a window was missed
                self._rate = rate_across(self._before[1], field, span_ns * _SECOND)
