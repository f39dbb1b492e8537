"""Alignment of a body axis with the Sun by solar cells, gyro and magnetometer, without an attitude.

The direction of the Sun s and the field B are measured in body axes, and propagated between measurements by
the gyro. Only the component across the field of the wanted torque J (w^2 e - 2 z w rate), e the rotation from
the axis to the Sun, can be made (Lovera & Astolfi 2004, Automatica 40(8)). The component along the field is
therefore cancelled by a torque about the Sun, which moves the axis off the Sun least. If the field is not
normal to the Sun, both axes that matter are controlled at once, and the body rolls. The faster the roll, the
less torque about the Sun is used.

A Sun that is not visible is propagated through an eclipse (`PropagatedSun`); without a known Sun the body is
only damped. The residual dipole, the largest torque on a light body, is estimated and cancelled
(`ResidualDipole`). The coils pause while the field is measured. The coils act only after the fields of two
consecutive pauses agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.gnc.control.detumble import WindowSchedule

MEMORY = 2400.0
"""Time (s) for which a direction is propagated: the longest eclipse of a low orbit, and some minutes."""
SMOOTHED, DRIFT = 10.0, 6.5e-4
"""Time (s) over which directions are averaged, and gain (rad/s^2) from a direction error to the gyro bias."""
JUMP = 0.5
"""Sine of the smallest difference at which a measured direction replaces the propagated one."""
LARGEST_BIAS = 3e-3
"""Largest gyro bias per axis, rad/s."""
LONGEST_DELAY = 0.5
"""Longest time (s) since the last gyro reading at which propagated and measured direction are compared."""
LONGEST_GAP = 3.0
"""Longest gyro gap (s) over which the direction can be propagated."""
_SECOND = 1e-9


class PropagatedSun:
    """The Sun's direction in body axes, propagated by a gyro, and the gyro bias that its drift shows.

    Between measurements the gyro rotates the direction with the body. The difference from the measurements is
    the gyro bias, except for its component about the Sun, which does not move the direction: a Sun that is no
    longer visible can be propagated through an eclipse. This is a complementary filter (Mahony, Hamel &
    Pflimlin 2008, IEEE Trans. Autom. Control 53(5)) of one direction.
    """

    def __init__(self) -> None:
        self.direction: FloatArray | None = None
        """Direction (3,) in body axes at the last reading; None if unknown."""
        self.bias: FloatArray = np.zeros(3)
        """Gyro bias (3,), rad/s."""
        self._measured_ns = self._propagated_ns = 0

    def propagate(self, time_ns: int, rotation: FloatArray) -> None:
        """Propagate the direction to `time_ns` by the body's rotation (3, 3) since the last reading."""
        if self.direction is not None:
            gap = (time_ns - max(self._propagated_ns, self._measured_ns)) * _SECOND
            known = gap <= LONGEST_GAP and (time_ns - self._measured_ns) * _SECOND <= MEMORY
            self.direction = rotation @ self.direction if known else None
        self._propagated_ns = time_ns

    def measure(self, time_ns: int, sun: FloatArray) -> None:
        """Accept the direction (3,) of the Sun, body axes, measured at a time just past."""
        predicted, since = self.direction, (time_ns - self._measured_ns) * _SECOND
        if (time_ns - self._propagated_ns) * _SECOND > LONGEST_DELAY:
            predicted = None
        self._measured_ns = time_ns
        off = np.zeros(3) if predicted is None else cross_product(sun, predicted)
        if predicted is None or float(sun @ predicted) <= 0.0 or float(off @ off) > JUMP**2:
            self.direction = sun
            return
        since = min(max(since, 0.0), SMOOTHED)
        mixed = predicted + (since / SMOOTHED) * (sun - predicted)
        self.direction = mixed / math.sqrt(float(mixed @ mixed))
        self.bias = np.clip(self.bias - (DRIFT * since) * off, -LARGEST_BIAS, LARGEST_BIAS)


RATE_GAIN, DIPOLE_GAIN = 0.1, 8e-4
"""Gains of the residual dipole observer, 1/s and 1/s^2: time constants of ten seconds and two minutes."""
LONGEST_INTERVAL = 1.0
"""Longest time (s) between readings; after a longer one the observer restarts from the measured rate."""


class ResidualDipole:
    """The residual dipole of a body, from its rate under the known torque of the coils in a measured field.

    A Luenberger observer: the rate by coils and residual dipole follows the measured one, and the difference
    is attributed to a dipole across the field. The component along the field becomes observable when the
    field rotates in body axes. Torques of gravity and air across the field are attributed to the dipole too,
    and are cancelled with it.
    """

    def __init__(self, inertia: FloatArray, bound: float) -> None:
        """Use the moments (3,) kg m^2 about the body axes; `bound` A m^2 limits the dipole per axis."""
        self._inertia, self._bound = inertia, bound
        self._rate: FloatArray | None = None
        self.dipole: FloatArray = np.zeros(3)
        """Residual dipole (3,) A m^2, body axes."""

    def restart(self) -> None:
        """Keep the dipole and start from the next rate."""
        self._rate = None

    def follow(self, seconds: float, rate: FloatArray, field: FloatArray, coils: FloatArray) -> None:
        """Accept a rate (3,) rad/s, `seconds` after the last one.

        In between the dipole `coils` (3,) A m^2 acted in the field (3,) T.
        """
        square = float(field @ field)
        if self._rate is None or seconds > LONGEST_INTERVAL or square == 0.0:
            self._rate = rate
            return
        error = rate - self._rate
        across = cross_product(field, self._inertia * error) / square
        self.dipole = np.clip(self.dipole + (DIPOLE_GAIN * seconds) * across, -self._bound, self._bound)
        torque = cross_product(coils + self.dipole, field) - cross_product(rate, self._inertia * rate)
        self._rate = self._rate + min(1.0, RATE_GAIN * seconds) * error + seconds * torque / self._inertia


AGREES = 0.2
"""Largest relative difference of the fields of two pauses, after correction for the rotation between them."""
ROLL = 150.0
"""Ratio of the cost of other torques to that of a torque about the Sun."""
FASTEST, FASTEST_ACROSS = 0.0165, 0.010
"""Total rate, and rate across the Sun (rad/s), above which the body is only damped; lower than the rates at
which the flight mode detumbles."""
FASTEST_ROLL = 0.0105
"""Rate (rad/s) about the Sun above which a torque about the Sun is no longer preferred."""
BANDWIDTH, DAMPING, SHARE = 0.0105, 0.65, 0.6
"""Bandwidth w (rad/s) and damping z of the law. At one radian from the Sun the law uses at most `SHARE` of
the coils' torque."""
RESIDUAL = 0.05
"""Largest residual dipole, as a fraction of the coils' limit."""
_FIELD = 3e-5
"""Field strength in a low orbit, T."""
_NO_DIPOLE: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SunAcquisitionSettings:
    """Settings of Sun acquisition.

    Attributes:
        inertia: (3,) kg m^2 of the body axes.
        axis: (3,) body axis to align with the Sun.
        limit: A m^2 of each coil.
    """

    inertia: FloatArray
    axis: FloatArray
    limit: float

    @property
    def speed(self) -> float:
        """Bandwidth w of the law, rad/s."""
        return min(BANDWIDTH, math.sqrt(SHARE * self.limit * _FIELD / float(self.inertia.max())))


class SunAcquisition:
    """Estimates Sun and field and computes the dipole.

    It takes each reading of the inertial unit and each direction of the Sun, and returns the dipole of each
    cycle, in order of time.
    """

    def __init__(self, schedule: WindowSchedule, seeking: SunAcquisitionSettings) -> None:
        self._schedule, self._seeking = schedule, seeking
        self._sun = PropagatedSun()
        self._residual = ResidualDipole(seeking.inertia, RESIDUAL * seeking.limit)
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Begin the first pause without knowledge of the field."""
        self._begun_ns = self._time_ns = now_ns
        self._field: FloatArray | None = None
        self._agrees = False
        self._rate = self._acts = _NO_DIPOLE
        self._samples: list[FloatArray] = []
        self._residual.restart()

    @property
    def field(self) -> FloatArray | None:
        """Field (3,) T in body axes at the last reading; None before it is known."""
        return self._field

    @property
    def sun(self) -> FloatArray | None:
        """Direction (3,) of the Sun in body axes at the last reading; None if unknown."""
        return self._sun.direction

    def update_sun(self, time_ns: int, sun: FloatArray) -> None:
        """Accept a direction (3,) of the Sun, body axes, measured at `time_ns`."""
        self._sun.measure(time_ns, sun)

    def acts(self, dipole: FloatArray) -> None:
        """Report a dipole (3,) A m^2 that acts instead of the commanded one until the next command."""
        self._acts = dipole

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T and a gyro rate (3,) rad/s of `time_ns`; the field is used in pauses only."""
        if time_ns <= self._time_ns or not np.all(np.isfinite(np.concatenate([field, rate]))):
            return
        rate = rate - self._sun.bias
        seconds = (time_ns - self._time_ns) * _SECOND
        rotated = attitude_matrix(from_rotation_vector(seconds * rate))
        self._time_ns, self._rate = time_ns, rate
        self._sun.propagate(time_ns, rotated)
        if self._field is not None:
            self._field = rotated @ self._field
            self._residual.follow(seconds, rate, self._field, self._acts)
        schedule = self._schedule
        phase_ns = (time_ns - self._begun_ns) % schedule.period_ns
        if schedule.settle_ns <= phase_ns < schedule.settle_ns + schedule.measure_ns:
            self._samples = [*(rotated @ sample for sample in self._samples), field]
        elif self._samples:
            self._close(rotated)

    def dipole(self, now_ns: int) -> FloatArray:
        """Return the dipole (3,) A m^2 now: zero while the field is measured or unknown."""
        schedule, seeking, field = self._schedule, self._seeking, self._field
        phase_ns = (now_ns - self._begun_ns) % schedule.period_ns
        if phase_ns < schedule.settle_ns + schedule.measure_ns or field is None or not self._agrees:
            self._acts = _NO_DIPOLE
            return _NO_DIPOLE
        dipole = cross_product(field, self._torque(field)) / float(field @ field) - self._residual.dipole
        largest = float(np.abs(dipole).max())
        self._acts = dipole if largest <= seeking.limit else dipole * (seeking.limit / largest)
        return self._acts

    def _torque(self, field: FloatArray) -> FloatArray:
        """Return the commanded torque (3,) N m in a field (3,) T, normal to it while the Sun is tracked."""
        seeking, sun, rate = self._seeking, self._sun.direction, self._rate
        speed = seeking.speed
        torque: FloatArray = -2.0 * DAMPING * speed * seeking.inertia * rate
        if sun is None:
            return torque
        square, roll = float(rate @ rate), float(rate @ sun)
        if square > FASTEST**2 or square - roll**2 > FASTEST_ACROSS**2:
            return torque
        torque = torque + speed**2 * seeking.inertia * _rotation_to_sun(seeking.axis, sun)
        # Cancel the component along the field by a torque about the Sun, which disturbs the axis least.
        cheap = 1.0 + (ROLL - 1.0) * math.exp(-((roll / FASTEST_ROLL) ** 2))
        spread = field + (cheap - 1.0) * float(sun @ field) * sun
        return torque - spread * (float(field @ torque) / float(field @ spread))

    def _close(self, rotated: FloatArray) -> None:
        """End a pause: the median of its samples is the field, which is robust to single outliers."""
        found = np.median([rotated @ sample for sample in self._samples], axis=0)
        self._samples = []
        strength = math.sqrt(float(found @ found))
        if strength == 0.0:
            self._field, self._agrees = None, False
            return
        before = self._field
        self._agrees = before is not None and float(np.linalg.norm(found - before)) < AGREES * strength
        self._field = found


def _rotation_to_sun(axis: FloatArray, sun: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), at most one radian, from an axis to the Sun, both unit vectors."""
    across = cross_product(axis, sun)
    sine = math.sqrt(float(across @ across))
    cosine = float(axis @ sun)
    if sine < 1e-6:
        other = cross_product(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        return _NO_DIPOLE if cosine > 0.0 else other / math.sqrt(float(other @ other))
    return across * (min(1.0, math.atan2(sine, cosine)) / sine)
