"""Alignment of a body axis with the Sun by solar cells, gyro and magnetometer, without an attitude estimate.

The direction s of the Sun and the field B are measured in body axes, and propagated between measurements with
the gyro rate. The control law demands the torque J (w^2 e - 2 z w rate), with bandwidth w, damping ratio z,
and the rotation e from the body axis to the Sun. The coils can produce only the component of the demanded
torque across the field (Lovera & Astolfi 2004, Automatica 40(8)). A torque about the direction of the Sun is
therefore added so that the total torque has no component along the field. A torque about the Sun direction
disturbs the pointing of the body axis least. Unless the field is normal to the Sun direction, both axes
normal to this direction are controlled simultaneously, while the body may roll about the Sun direction. The
added torque about the direction of the Sun is reduced if the body rolls fast. The direction of the Sun is
propagated through an eclipse (`PropagatedSun`). If the direction of the Sun is unknown, or if the body is too
fast, the rotation is only damped. The residual dipole moment, which causes the largest torque on a light
body, is estimated and cancelled (`ResidualDipole`). The coils are off while the field is measured. The coils
are driven only after the fields measured in two consecutive pauses agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_product, finite_array, unit_vector
from knightcube.astro.inertia import checked_inertia
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.gnc.control.coil_map import limited
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.estimation.error_state import check_amounts

MEMORY = 2400.0
"""Longest time (s) over which the Sun direction is propagated, enough for the longest eclipse of a low
orbit."""
SMOOTHED, DRIFT = 10.0, 6.5e-4
"""Averaging time (s) of measured directions (first value), and gain (1/s^2) with which a direction error
changes the estimated gyro bias (second value)."""
JUMP = 0.5
"""Sine of the angle between propagated and measured direction above which the measurement replaces the
propagated direction."""
LARGEST_BIAS = 3e-3
"""Largest estimated gyro bias per axis, rad/s."""
LONGEST_DELAY = 0.5
"""Longest age (s) of the last gyro reading at which a measured direction is compared with the propagated
direction."""
LONGEST_GAP = 3.0
"""Longest gap (s) between gyro readings over which the directions of Sun and field can be propagated."""
_SECOND = 1e-9


class PropagatedSun:
    """An estimate of the Sun's direction in body axes and of the gyro bias.

    Between measurements the direction is propagated with the gyro rate. The gyro bias follows from the drift
    of the propagated direction relative to the measured direction. The bias component about the Sun's
    direction causes no drift and need not be known. The direction can therefore be propagated through an
    eclipse. The estimator is a complementary filter of one direction (Mahony, Hamel & Pflimlin 2008, IEEE
    Transactions on Automatic Control 53(5)).
    """

    def __init__(self) -> None:
        self.direction: FloatArray | None = None
        """Direction (3,) of the Sun in body axes at the last gyro reading, or None if unknown."""
        self.bias: FloatArray = np.zeros(3)
        """Gyro bias (3,), rad/s."""
        self._measured_ns = self._propagated_ns = 0

    def propagate(self, time_ns: int, rotation: FloatArray) -> None:
        """Propagate the direction to `time_ns` by the rotation (3, 3) of the body since the last reading."""
        if self.direction is not None:
            gap = (time_ns - max(self._propagated_ns, self._measured_ns)) * _SECOND
            known = gap <= LONGEST_GAP and (time_ns - self._measured_ns) * _SECOND <= MEMORY
            self.direction = rotation @ self.direction if known else None
        self._propagated_ns = time_ns

    def measure(self, time_ns: int, sun: FloatArray) -> None:
        """Accept a direction (3,) of the Sun in body axes, measured a short time ago."""
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
"""Gains (1/s and 1/s^2) of the residual dipole observer, for time constants of 10 s and 2 min."""
LONGEST_INTERVAL = 1.0
"""Longest gap (s) between rate measurements; after a longer gap the observer restarts from the measured
rate."""


class ResidualDipole:
    """An estimate of the residual dipole moment from the body rate, the field and the dipole of the coils.

    A Luenberger observer predicts the rate from the dipole moments of coils and body, and corrects the
    prediction by the measured rate. The difference between measured and predicted rate is attributed to a
    residual dipole moment across the field. The component along the field becomes observable when the field
    rotates in body axes. Gravity-gradient and aerodynamic torques across the field are also attributed to the
    residual dipole moment, and are therefore cancelled as well.
    """

    def __init__(self, inertia: FloatArray, bound: float | FloatArray) -> None:
        """Create an observer for an inertia tensor (3, 3) kg m^2.

        Each component of the estimated dipole moment is limited to +-`bound`, A m^2. The bound is equal for
        all axes or has shape (3,).
        """
        self._inertia, self._bound = checked_inertia("inertia", inertia), bound
        self._inverse: FloatArray = np.asarray(np.linalg.inv(inertia), dtype=float)
        self._rate: FloatArray | None = None
        self.dipole: FloatArray = np.zeros(3)
        """Residual dipole moment (3,) in body axes, A m^2."""

    def restart(self) -> None:
        """Set the predicted rate to the next measured rate, and keep the estimated dipole moment."""
        self._rate = None

    def follow(self, seconds: float, rate: FloatArray, field: FloatArray, coils: FloatArray) -> None:
        """Accept a rate (3,) rad/s measured `seconds` after the previous rate.

        In the interval since the previous rate, the dipole moment of the coils was `coils` (3,), A m^2, and
        the magnetic field was `field` (3,), T.
        """
        square = float(field @ field)
        if self._rate is None or seconds > LONGEST_INTERVAL or square == 0.0:
            self._rate = rate
            return
        error = rate - self._rate
        across = cross_product(field, self._inertia @ error) / square
        self.dipole = np.clip(self.dipole + (DIPOLE_GAIN * seconds) * across, -self._bound, self._bound)
        torque = cross_product(coils + self.dipole, field) - cross_product(rate, self._inertia @ rate)
        change = seconds * (self._inverse @ torque)
        self._rate = self._rate + min(1.0, RATE_GAIN * seconds) * error + change


AGREES = 0.2
"""Largest difference between the magnetic fields measured in two successive coil pauses, corrected for the
body's rotation, as a fraction of the field strength."""
ROLL = 150.0
"""Ratio of the cost of a torque normal to the Sun direction to the cost of a torque about that direction."""
FASTEST, FASTEST_ACROSS = 0.0165, 0.010
"""Total rate (rad/s, first value) and rate (rad/s) across the Sun direction (second value) above which the
body is only damped. The two rate limits are below the rates at which the flight software starts
detumbling."""
FASTEST_ROLL = 0.0105
"""Roll rate (rad/s) about the Sun direction at which the extra cost of torques normal to this direction falls
to 1/e."""
BANDWIDTH, DAMPING, SHARE = 0.0105, 0.65, 0.6
"""Bandwidth w (rad/s) and damping ratio z of the Sun pointing law. At one radian from the Sun, the pointing
law demands at most the fraction `SHARE` of the torque that the coils can produce."""
BRAKING = 4.4e-3
"""Gain (1/s) of the torque that only damps the rotation, twice the rotation rate of the field in a polar
orbit. With a higher gain, the momentum aligns with the field, about which the coils cause no torque
(`share_in_rotating_field`)."""
RESIDUAL = 0.05
"""Largest estimated residual dipole moment, as a fraction of the coils' limit."""
_FIELD = 3e-5
"""Typical strength of the Earth's magnetic field in a low orbit, T."""
_NO_DIPOLE: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SunAcquisitionSettings:
    """Settings of Sun acquisition.

    The inertia tensor (3, 3), kg m^2, and the unit vector `axis` (3,) to align with the Sun are in body axes.
    The dipole limit, A m^2, is one number for all axes or an array (3,).
    """

    inertia: FloatArray
    axis: FloatArray
    limit: float | FloatArray

    def __post_init__(self) -> None:
        """Raise ArgumentError for an impossible inertia tensor, axis or dipole limit."""
        checked_inertia("inertia", self.inertia)
        object.__setattr__(self, "axis", unit_vector("axis", self.axis))
        check_amounts(self, "limit")

    @property
    def speed(self) -> float:
        """Bandwidth w of the Sun pointing law for this body, rad/s."""
        largest = float(np.linalg.eigvalsh(self.inertia).max())
        return min(BANDWIDTH, math.sqrt(SHARE * float(np.min(self.limit)) * _FIELD / largest))


class SunAcquisition:
    """The Sun acquisition law, with estimates of the Sun direction, field and residual dipole moment.

    The law accepts the readings of the inertial unit and the directions of the Sun in order of time, and
    returns the dipole moment of each cycle.
    """

    def __init__(self, schedule: WindowSchedule, seeking: SunAcquisitionSettings) -> None:
        self._schedule, self._seeking = schedule, seeking
        self._sun = PropagatedSun()
        self._residual = ResidualDipole(seeking.inertia, RESIDUAL * seeking.limit)
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Begin the first pause of the coils; no magnetic field has been measured yet."""
        self._begun_ns = self._time_ns = now_ns
        self._field: FloatArray | None = None
        self._agrees = False
        self._rate = self._acts = _NO_DIPOLE
        self._samples: list[FloatArray] = []
        self._residual.restart()

    @property
    def field(self) -> FloatArray | None:
        """Magnetic field (3,) in body axes at the last reading, T, or None while it is unknown."""
        return self._field

    @property
    def sun(self) -> FloatArray | None:
        """Direction (3,) of the Sun in body axes at the last reading, or None if unknown."""
        return self._sun.direction

    def update_sun(self, time_ns: int, sun: FloatArray) -> None:
        """Accept a direction (3,) of the Sun, body axes, measured at `time_ns`.

        The direction is ignored unless it is finite and not zero.
        """
        length = math.sqrt(float(sun @ sun))
        if 0.0 < length < math.inf:
            self._sun.measure(time_ns, sun / length)

    def acts(self, dipole: FloatArray) -> None:
        """Set the dipole moment (3,), A m^2, that actually acts until the next command.

        Raises ArgumentError for a dipole moment that is not finite.
        """
        self._acts = finite_array("dipole", dipole, (3,))

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a gyro rate (3,) rad/s and a field (3,) T; the field is used only in pauses of the coils."""
        if time_ns <= self._time_ns or not np.all(np.isfinite(np.concatenate([field, rate]))):
            return
        rate = rate - self._sun.bias
        seconds = (time_ns - self._time_ns) * _SECOND
        rotated = attitude_matrix(from_rotation_vector(seconds * rate))
        self._time_ns, self._rate = time_ns, rate
        self._sun.propagate(time_ns, rotated)
        if seconds > LONGEST_GAP:
            self._field, self._agrees, self._samples = None, False, []
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
        """Return the present dipole moment (3,) A m^2, zero while the field is measured or unknown."""
        schedule, seeking, field = self._schedule, self._seeking, self._field
        phase_ns = (now_ns - self._begun_ns) % schedule.period_ns
        if phase_ns < schedule.settle_ns + schedule.measure_ns or field is None or not self._agrees:
            self._acts = _NO_DIPOLE
            return _NO_DIPOLE
        dipole = cross_product(field, self._torque(field)) / float(field @ field) - self._residual.dipole
        self._acts = limited(dipole, np.full(3, seeking.limit))
        return self._acts

    def _torque(self, field: FloatArray) -> FloatArray:
        """Return the commanded torque (3,) N m, which is normal to the field while the Sun is tracked."""
        seeking, sun, rate = self._seeking, self._sun.direction, self._rate
        momentum = seeking.inertia @ rate
        if sun is None:
            return -BRAKING * momentum
        square, roll = float(rate @ rate), float(rate @ sun)
        if square > FASTEST**2 or square - roll**2 > FASTEST_ACROSS**2:
            return -BRAKING * momentum
        speed = seeking.speed
        torque = (speed**2 * seeking.inertia) @ _rotation_to_sun(seeking.axis, sun)
        torque -= 2.0 * DAMPING * speed * momentum
        # A torque about the Sun direction cancels the torque along the field.
        cheap = 1.0 + (ROLL - 1.0) * math.exp(-((roll / FASTEST_ROLL) ** 2))
        spread = field + (cheap - 1.0) * float(sun @ field) * sun
        return torque - spread * (float(field @ torque) / float(field @ spread))

    def _close(self, rotated: FloatArray) -> None:
        """End a pause, and estimate the field as the median of the samples, which is robust to outliers."""
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
    """Return the rotation vector (3,) from an axis to the Sun direction, limited to one radian."""
    across = cross_product(axis, sun)
    sine = math.sqrt(float(across @ across))
    cosine = float(axis @ sun)
    if sine < 1e-6:
        other = cross_product(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        return _NO_DIPOLE if cosine > 0.0 else other / math.sqrt(float(other @ other))
    return across * (min(1.0, math.atan2(sine, cosine)) / sine)
