"""B-dot detumbling with the magnetometer alone, which measures the field while the coils are off.

The field of the coils disturbs the magnetometer, so time is divided into windows. In each window the coils
are first off to let the field settle, then the field is measured and averaged, and then the coils are driven.
The rate is computed from the mean fields of two consecutive windows. A field that is constant in inertial
axes changes in body axes by B' = -w x B. The component of the rate across the field is therefore w_p = B' x B
/ B^2. The dipole moment m = (k / B^2) w_p x B reduces the rate, because its torque m x B is -k w_p for any
direction of the field (B-dot control: Wertz 1978, section 18.3, and Avanzini and Giulietti 2012, Journal of
Guidance, Control, and Dynamics 35(4)). The gain k is chosen so that in one window the torque k w_p removes
the fraction `share` of the momentum J w_p, where J is the smallest moment of inertia. While the coils are
driven, the measured field is rotated with the last rate, so that the torque does not accelerate a fast body.
The rate is unambiguous if the body rotates by less than half a revolution per window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, check_finite, checked_number
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.errors import UsageError
from knightcube.gnc.estimation.error_state import check_amounts
from knightcube.gnc.estimation.field_rate import rate_across

MAXIMUM_SHARE = 0.5
_SECOND = 1e-9
_REACHED_NS = 50_000_000
"""Largest delay (ns) between a command and its effect on the coils, equal to two control cycles."""
_NO_CURRENT: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True)
class WindowSchedule:
    """Durations (ns) of the phases of a window: settle and measure (coils off), act (coils on).

    The field of the coils decays while they settle, and each window needs a magnetometer sample while they
    measure.
    """

    settle_ns: int
    measure_ns: int
    act_ns: int

    def __post_init__(self) -> None:
        """Raise ArgumentError for a window without time to measure the field or to drive the coils.

        The durations must be whole numbers.
        """
        check_amounts(self, "measure_ns", "act_ns")

    @property
    def period_ns(self) -> int:
        """Duration of a window, ns."""
        return self.settle_ns + self.measure_ns + self.act_ns

    def calm(self, begin_ns: int, length_ns: int) -> int:
        """Return the first time (ns) from `begin_ns` after which no coil switches for `length_ns`.

        Windows follow each other without gaps from time zero. If neither the phase with coils off nor the
        phase with coils on is long enough, `begin_ns` is returned.
        """
        phase_ns, pause_ns = begin_ns % self.period_ns, self.settle_ns + self.measure_ns
        later_ns = self.period_ns + pause_ns
        parts = (0, pause_ns), (pause_ns, self.period_ns), (self.period_ns, later_ns)
        for first_ns, last_ns in (*parts, (later_ns, 2 * self.period_ns)):
            from_ns = max(phase_ns, first_ns + _REACHED_NS)
            if from_ns + length_ns <= last_ns:
                return begin_ns - phase_ns + from_ns
        return begin_ns


@dataclass(frozen=True, slots=True)
class DetumblerSettings:
    """Settings of the B-dot detumbler.

    Attributes:
        inertia: smallest principal moment of inertia, kg m^2.
        dipole_per_ampere: dipole moment per current of each coil (turns times area), m^2.
        current_limit: current limit of each coil, A.
        share: fraction (below 1) of the rate across the field that is removed in one window.
    """

    inertia: float
    dipole_per_ampere: float
    current_limit: float
    share: float

    def __post_init__(self) -> None:
        """Raise UsageError for settings out of range."""
        check_amounts(self, "inertia", "dipole_per_ampere", "current_limit", "share")
        if self.share >= 1.0:
            raise UsageError(
                f"detumble share is {self.share}: the fraction of the rate to remove in a window must be "
                "below 1"
            )


def share_in_rotating_field(field_rate: float, schedule: WindowSchedule) -> float:
    """Return the best setting `share` for a free body in a field that rotates at `field_rate` rad/s.

    The rate along the field can be removed only while the field rotates. With a gain above k = 2 Omega J,
    where Omega is the rotation rate of the field, the spin aligns with the field, about which the coils cause
    no torque (Avanzini and Giulietti 2012). Along an orbit the field rotates about twice per revolution of
    the satellite.
    """
    return min(2.0 * field_rate * schedule.period_ns * _SECOND, MAXIMUM_SHARE)


def braking_current(
    braking: DetumblerSettings, rate: FloatArray, field: FloatArray, act_time: float
) -> FloatArray:
    """Return the currents (3,), A, that reduce a rate (3,), rad/s, across a field (3,), T, in `act_time` s.

    If a coil would exceed its current limit, one factor scales all currents to preserve the direction. Raises
    ArgumentError unless rate and field are finite and the time is positive.
    """
    check_finite(rate=rate, field=field)
    checked_number("act_time", act_time, "s")
    square = float(field @ field)
    if square == 0.0:
        return np.zeros(3)
    gain = braking.share * braking.inertia / (act_time * square)
    current = np.cross(rate, field) * (gain / braking.dipole_per_ampere)
    largest = float(np.abs(current).max())
    return current * min(1.0, braking.current_limit / largest) if largest > 0.0 else current


class Detumbler:
    """A B-dot detumbler that accepts magnetometer samples and returns the coil currents of each cycle.

    The coils must be off while the field is measured: apply the result of `current` in every cycle. The rate
    along the field cannot be reduced.
    """

    def __init__(self, schedule: WindowSchedule, braking: DetumblerSettings) -> None:
        self._schedule = schedule
        self._braking = braking
        self._begun_ns = 0
        self._samples: list[tuple[int, FloatArray]] = []
        self._window = self._closed = -1
        self._before: tuple[int, FloatArray] | None = None
        self._field: tuple[int, FloatArray] | None = None
        self._rate: FloatArray | None = None

    def begin(self, now_ns: int) -> None:
        """Begin the first window without knowledge of the field."""
        self._begun_ns = now_ns
        self._samples.clear()
        self._window = self._closed = -1
        self._before = self._field = self._rate = None

    def listens(self, time_ns: int) -> bool:
        """Return whether the coils were off and their field had decayed at `time_ns`."""
        schedule = self._schedule
        phase_ns = (time_ns - self._begun_ns) % schedule.period_ns
        inside = schedule.settle_ns <= phase_ns < schedule.settle_ns + schedule.measure_ns
        return time_ns >= self._begun_ns and inside

    def sample(self, time_ns: int, field: FloatArray) -> None:
        """Accept a field (3,), T, measured at `time_ns`.

        The sample is ignored unless it is finite, the coils were off and their field had decayed.
        """
        if not self.listens(time_ns) or not np.isfinite(field).all():
            return
        window = (time_ns - self._begun_ns) // self._schedule.period_ns
        if window <= self._closed:
            return  # the mean field of this window is already computed
        if window != self._window:
            self._samples.clear()
            self._window = window
        self._samples.append((time_ns, field))

    def current(self, now_ns: int) -> FloatArray:
        """Return the present currents (3,) A, zero while the field is measured or the rate is unknown."""
        schedule = self._schedule
        phase_ns = (now_ns - self._begun_ns) % schedule.period_ns
        if phase_ns < schedule.settle_ns + schedule.measure_ns:
            return _NO_CURRENT
        self._close_window()
        window = (now_ns - self._begun_ns) // schedule.period_ns
        field = self.field(now_ns)
        if self._rate is None or field is None or window != self._closed:
            return _NO_CURRENT  # the field of an earlier window is too old
        return braking_current(self._braking, self._rate, field, schedule.act_ns * _SECOND)

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,), T, in body axes at `now_ns`, or None before a rate is known."""
        if self._rate is None or self._field is None:
            return None
        since = (now_ns - self._field[0]) * _SECOND
        return np.asarray(attitude_matrix(from_rotation_vector(self._rate * since)) @ self._field[1])

    @property
    def rate(self) -> FloatArray | None:
        """Rate (3,), rad/s, across the field from the last two windows, body axes, or None if unknown."""
        return self._rate

    def _close_window(self) -> None:
        """Average the samples of a window, and compute the rate from the last two mean fields."""
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
            if span_ns < 2 * self._schedule.period_ns:  # after longer gaps, the rate is unknown
                self._rate = rate_across(self._before[1], field, span_ns * _SECOND)
