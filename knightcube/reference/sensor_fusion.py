"""Attitude determination of the ION-F satellites (Meller et al., section 2 and Fig. 3), for comparison.

The directions of Sun and nadir from the cameras give one attitude matrix R^ib (Meller et al. mention the
methods TRIAD and QUEST). The magnetometer gives a second attitude matrix: "When these measurements are
compared with theoretical magnetic field models, a three-dimensional satellite attitude can be determined." A
single field vector, however, determines only two of the three angles. This implementation therefore collects
magnetic field measurements for some minutes, during which the field direction changes along the orbit, and
rotates the measurements into the present body axes with the gyros. Meller et al. do not state how the two
attitude matrices are fused; this implementation weights each matrix by the inverse of its covariance. The
fused matrix and the gyros are the measurements of an extended Kalman filter for attitude and gyro bias. As in
the paper, measurements are not checked for outliers by comparison with the estimate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.attitude.solvers import VectorObservation, weighted_fit
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)

FIELD_EVERY = 60.0
"""Interval (s) between collected magnetic field measurements."""
FIELDS = 10
"""Number of collected field measurements, which span ten minutes or a tenth of an orbit."""
WORST_SIGMA = math.radians(20.0)
"""Largest standard deviation (rad), about the least certain axis, with which an attitude is used."""
_NANOSECOND = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class KnownAttitude:
    """An attitude (quaternion (4,), inertial to body) with its covariance (3, 3), rad^2, in body axes."""

    quaternion: FloatArray = field(default_factory=lambda: np.full(4, np.nan))
    covariance: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))

    @property
    def known(self) -> bool:
        """Whether the attitude is known."""
        return math.isfinite(self.quaternion[0])

    @property
    def sigma(self) -> float:
        """Standard deviation per axis (rad): the root of the mean of the variances of the three axes."""
        return float(np.sqrt(np.trace(self.covariance) / 3.0))


@dataclass(frozen=True, slots=True, eq=False)
class SeparateAttitudes:
    """The attitudes of one update: from cameras, from magnetometer, fused, and filtered with the gyros.

    The estimated gyro bias is `bias` (3,), rad/s.
    """

    cameras: KnownAttitude
    magnetometer: KnownAttitude
    fused: KnownAttitude
    filtered: KnownAttitude
    bias: FloatArray


def attitude_of(directions: list[VectorObservation]) -> KnownAttitude:
    """Return the attitude determined by directions, which is unknown if the directions are not sufficient."""
    if len(directions) < 2:
        return KnownAttitude()
    try:
        fix: AttitudeFix = weighted_fit(directions)
    except (AttitudeError, np.linalg.LinAlgError):
        return KnownAttitude()
    worst = float(np.linalg.eigvalsh(fix.covariance)[-1])
    return KnownAttitude(fix.quaternion, fix.covariance) if worst < WORST_SIGMA**2 else KnownAttitude()


def fuse(first: KnownAttitude, second: KnownAttitude) -> KnownAttitude:
    """Return the mean of two independent attitudes, weighted by the inverses of their covariances."""
    if not (first.known and second.known):
        return first if first.known else second
    between = to_rotation_vector(multiply(second.quaternion, conjugate(first.quaternion)))
    weight = np.linalg.inv(second.covariance)
    covariance = np.linalg.inv(np.linalg.inv(first.covariance) + weight)
    turn = from_rotation_vector(covariance @ weight @ between)
    return KnownAttitude(normalise(multiply(turn, first.quaternion)), covariance)


class GyroBiasFilter:
    """Extended Kalman filter of attitude and gyro bias, whose measurements are attitudes.

    Args:
        noise: noise density of the gyros, rad/s per sqrt(Hz).
        bias: initial standard deviation of the gyro bias, rad/s.
        walk: random walk of the gyro bias, rad/s per sqrt(s).
    """

    def __init__(self, noise: float, bias: float, walk: float) -> None:
        self._noise, self._walk = noise, walk
        self._quaternion = np.full(4, np.nan)
        self._covariance = np.diag([np.nan] * 3 + [bias**2] * 3)
        self.bias: FloatArray = np.zeros(3)

    @property
    def attitude(self) -> KnownAttitude:
        """The estimated attitude."""
        return KnownAttitude(self._quaternion, self._covariance[:3, :3])

    @property
    def bias_sigma(self) -> float:
        """Standard deviation of the gyro bias per axis, rad/s."""
        return float(np.sqrt(np.trace(self._covariance[3:, 3:]) / 3.0))

    def propagate(self, turn: FloatArray, seconds: float) -> None:
        """Rotate the attitude by the quaternion `turn` (4,), measured by the gyros over `seconds`."""
        step = np.eye(6)
        step[:3, :3] = attitude_matrix(turn)
        step[:3, 3:] = -seconds * np.eye(3)
        noise = np.repeat([self._noise**2 * seconds, self._walk**2 * seconds], 3)
        if not self.attitude.known:
            self._covariance[3:, 3:] += np.diag(noise[3:])
            return
        self._quaternion = normalise(multiply(turn, self._quaternion))
        self._covariance = step @ self._covariance @ step.T + np.diag(noise)

    def update(self, measured: KnownAttitude) -> None:
        """Correct attitude and bias by a measured attitude, or start from the first measured attitude."""
        if not measured.known:
            return
        if not self.attitude.known:
            self._quaternion = measured.quaternion
            spread = np.zeros((6, 6))
            spread[:3, :3], spread[3:, 3:] = measured.covariance, self._covariance[3:, 3:]
            self._covariance = spread
            return
        off = to_rotation_vector(multiply(measured.quaternion, conjugate(self._quaternion)))
        cross = self._covariance[:, :3]
        gain = np.linalg.solve(self._covariance[:3, :3] + measured.covariance, cross.T).T
        change = gain @ off
        kept = np.eye(6)
        kept[:, :3] -= gain
        self._covariance = kept @ self._covariance @ kept.T + gain @ measured.covariance @ gain.T
        self._quaternion = normalise(multiply(from_rotation_vector(change[:3]), self._quaternion))
        self.bias = self.bias + change[3:]


class SeparateDetermination:
    """Attitude determination by cameras and magnetometer; the fused attitude is the input of the filter."""

    def __init__(self, filter_: GyroBiasFilter) -> None:
        self._filter = filter_
        self._rates: deque[tuple[int, FloatArray]] = deque(maxlen=4000)
        self._time_ns: int | None = None
        self._fields: deque[VectorObservation] = deque(maxlen=FIELDS)
        self._since_field = math.inf

    def gyro(self, time_ns: int, rate: FloatArray) -> None:
        """Accept the rate (3,), rad/s, body axes, that the gyros measured at `time_ns`."""
        self._rates.append((time_ns, rate))

    def update(
        self,
        time_ns: int,
        sun: VectorObservation | None,
        nadir: VectorObservation | None,
        magnetic: VectorObservation | None,
    ) -> SeparateAttitudes:
        """Return the attitudes at `time_ns` from the directions of Sun, nadir and magnetic field."""
        self._advance(time_ns)
        if magnetic is not None and self._since_field >= FIELD_EVERY:
            self._fields.append(magnetic)
            self._since_field = 0.0
        now = [] if magnetic is None or self._since_field == 0.0 else [magnetic]
        cameras = attitude_of([one for one in (sun, nadir) if one is not None])
        fields = [*self._fields, *now]
        magnetometer = attitude_of(fields)
        # The errors of magnetometer bias and field model are common to all fields and do not average out.
        spread = len(fields) * magnetometer.covariance
        magnetometer = replace(magnetometer, covariance=spread)
        fused = fuse(cameras, magnetometer)
        self._filter.update(fused)
        return SeparateAttitudes(cameras, magnetometer, fused, self._filter.attitude, self._filter.bias)

    def _advance(self, time_ns: int) -> None:
        """Rotate the filter and the collected fields from the last update to `time_ns` with the gyros."""
        since_ns, self._time_ns = self._time_ns, time_ns
        if since_ns is None or time_ns <= since_ns:
            return
        turn, at_ns = np.array([0.0, 0.0, 0.0, 1.0]), since_ns
        rate = np.zeros(3)
        while self._rates and self._rates[0][0] <= time_ns:
            then_ns, rate = self._rates.popleft()
            if then_ns > at_ns:
                step = (then_ns - at_ns) * _NANOSECOND * (rate - self._filter.bias)
                turn, at_ns = multiply(from_rotation_vector(step), turn), then_ns
        rest = (time_ns - at_ns) * _NANOSECOND * (rate - self._filter.bias)
        turn = multiply(from_rotation_vector(rest), turn)
        seconds = (time_ns - since_ns) * _NANOSECOND
        matrix, drift = attitude_matrix(turn), self._filter.bias_sigma
        for number, one in enumerate(self._fields):
            # The gyro bias error is the same in all intervals, so the angle errors of the intervals add up
            # linearly.
            drifted = (len(self._fields) - number) * FIELD_EVERY * drift
            cross = cross_matrices(one.observed[None])[0]
            added = cross @ cross.T * 2.0 * drifted * drift * seconds
            covariance = matrix @ (one.covariance + added) @ matrix.T
            self._fields[number] = replace(one, observed=matrix @ one.observed, covariance=covariance)
        self._filter.propagate(turn, seconds)
        self._since_field += seconds
