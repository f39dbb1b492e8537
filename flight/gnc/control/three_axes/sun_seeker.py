"""Turns an axis of the body to the Sun by solar strings, gyro and magnetometer alone: no attitude is needed.

In body axes the Sun's direction s and the field B are measured, and carried on between measurements by the
gyro. The wanted torque J (w^2 e - 2 w rate), e the turn from the axis to the Sun, is made as far as it lies
across the field (Lovera & Astolfi 2004, Automatica 40(8)); the rest follows as field and body turn. While the
Sun is not seen the last direction is carried on for `MEMORY` s; without one the body is only held still. The
coils pause while the field is measured. One field starts nothing: two pauses in a row must agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.gnc.control.detumble import WindowSchedule
from flight.gnc.control.three_axes.momentum import cross_product
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector

MEMORY = 600.0
"""s for which a direction is carried on by the gyro, whose bias turns it by some ten degrees meanwhile."""
AGREES = 0.2
"""Share of the field by which two pauses may differ, the turn between them taken out."""
ROLL = 10.0
"""By how much a torque about the Sun is cheaper than another."""
FASTEST = 7e-3
"""rad/s: a faster body is only braked, wherever the Sun is."""
FASTEST_ROLL = 4e-3
"""rad/s about the Sun, from which on it is not cheaper."""
SHARE = 0.1
_FIELD = 3e-5
"""T, in a low orbit."""
_SECOND = 1e-9
_NO_DIPOLE: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seeking:
    """The law's constants.

    Attributes:
        inertia: (3,) kg m^2 of the body axes.
        axis: (3,) body axis that turns to the Sun.
        limit: A m^2 of each coil.
    """

    inertia: FloatArray
    axis: FloatArray
    limit: float

    @property
    def speed(self) -> float:
        """The law's w, rad/s: a radian off the Sun takes `SHARE` of the coils' torque."""
        return math.sqrt(SHARE * self.limit * _FIELD / float(self.inertia.max()))


class SunSeeker:
    """Owns the knowledge of Sun and field.

    Takes each reading of the inertial unit and each Sun; returns the dipole each cycle, in order of time.
    """

    def __init__(self, schedule: WindowSchedule, seeking: Seeking) -> None:
        self._schedule, self._seeking = schedule, seeking
        self._sun: FloatArray | None = None
        self._seen_ns = 0
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Begin the first pause with no knowledge of the field."""
        self._begun_ns = self._time_ns = now_ns
        self._field: FloatArray | None = None
        self._agrees = False
        self._rate = _NO_DIPOLE
        self._samples: list[FloatArray] = []

    @property
    def field(self) -> FloatArray | None:
        """The field (3,) T in body axes at the last reading; None before it is known."""
        return self._field

    @property
    def sun(self) -> FloatArray | None:
        """The Sun's direction (3,) in body axes at the last reading; None where it is not known."""
        return self._sun

    def see(self, time_ns: int, sun: FloatArray) -> None:
        """Accept the direction (3,) of the Sun, body axes, of a time just past."""
        self._sun, self._seen_ns = sun, time_ns

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T, of use in pauses alone, and a gyro's rate (3,) rad/s, both of `time_ns`."""
        if time_ns <= self._time_ns or not np.all(np.isfinite(np.concatenate([field, rate]))):
            return
        turned = attitude_matrix(from_rotation_vector((time_ns - self._time_ns) * _SECOND * rate))
        self._time_ns, self._rate = time_ns, rate
        if self._sun is not None:
            self._sun = turned @ self._sun if (time_ns - self._seen_ns) * _SECOND <= MEMORY else None
        if self._field is not None:
            self._field = turned @ self._field
        schedule = self._schedule
        phase_ns = (time_ns - self._begun_ns) % schedule.period_ns
        if schedule.settle_ns <= phase_ns < schedule.settle_ns + schedule.measure_ns:
            self._samples = [*(turned @ sample for sample in self._samples), field]
        elif self._samples:
            self._close(turned)

    def dipole(self, now_ns: int) -> FloatArray:
        """Return the dipole (3,) A m^2 now: zero while the field is measured or not known."""
        schedule, seeking, field = self._schedule, self._seeking, self._field
        phase_ns = (now_ns - self._begun_ns) % schedule.period_ns
        if phase_ns < schedule.settle_ns + schedule.measure_ns or field is None or not self._agrees:
            return _NO_DIPOLE
        speed, sun = seeking.speed, self._sun
        torque = -2.0 * speed * seeking.inertia * self._rate
        if sun is not None and float(self._rate @ self._rate) < FASTEST**2:
            torque = torque + speed**2 * seeking.inertia * _turn(seeking.axis, sun)
            # What the coils can not make along the field they make up about the Sun, where it does least.
            cheap = 1.0 + (ROLL - 1.0) * math.exp(-((float(self._rate @ sun) / FASTEST_ROLL) ** 2))
            spread = field + (cheap - 1.0) * float(sun @ field) * sun
            torque = torque - spread * (float(field @ torque) / float(field @ spread))
        dipole = cross_product(field, torque) / float(field @ field)
        largest = float(np.abs(dipole).max())
        return dipole if largest <= seeking.limit else dipole * (seeking.limit / largest)

    def _close(self, turned: FloatArray) -> None:
        """End a pause: the median of its samples is the field, whatever one of them says."""
        found = np.median([turned @ sample for sample in self._samples], axis=0)
        self._samples = []
        strength = math.sqrt(float(found @ found))
        if strength == 0.0:
            self._field, self._agrees = None, False
            return
        before = self._field
        self._agrees = before is not None and float(np.linalg.norm(found - before)) < AGREES * strength
        self._field = found


def _turn(axis: FloatArray, sun: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) that turns a body's axis to the Sun, both unit vectors."""
    across = cross_product(axis, sun)
    sine = math.sqrt(float(across @ across))
    cosine = float(axis @ sun)
    if sine < 1e-6:
        other = cross_product(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        return _NO_DIPOLE if cosine > 0.0 else math.pi * other / math.sqrt(float(other @ other))
    return across * (math.atan2(sine, cosine) / sine)
