"""The body rate from the magnetometer, by an extended Kalman filter.

Relative to a rotating body, the field direction moves on a cone about the rate vector. The motion of the
field direction therefore gives all three components of the rate, including the component along the field. A
spin exactly along the field is observable only after the field direction has changed. In a polar orbit, the
field direction rotates by about two revolutions per orbit. A gyro sample shows a spin along the field
immediately. The states, in body axes, are the rate w, the field B, the inertial time derivative v of the
field, the errors j of the six elements of the inertia tensor, the bias b of the magnetometer, and the matrix
C from the commanded to the actual dipole moment of the coils. In a fast tumble, an error of a few per cent of
the inertia is the largest error of the torque model. The equations of motion are

    J(j) w' = C m x B - w x J(j) w,    B' = v - w x B,    v' = -w x v,    j' = 0,    b' = 0,    C' = 0.

The commanded dipole moment m is known, so the coils may be driven between field measurements. The matrix C
shows weak, dead and reversed coils. The bias is observable while the body rotates, because the field rotates
in body axes and the bias does not. The filter also integrates the rotation since its start, so the initial
body axes can serve as an inertial frame.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    check_finite,
    check_type,
    checked_number,
    finite_array,
    float_rows,
)
from knightcube.astro.inertia import checked_inertia
from knightcube.astro.quaternion import (
    Matrix,
    Quaternion,
    Vector,
    added,
    compose,
    cross,
    exponential,
    matrix,
    rows_of,
    skew,
    times,
)
from knightcube.compiled import compiled_floats, loop_helper
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.error_state import Weighed, check_amounts, slices, updated, weigh
from knightcube.gnc.estimation.estimate import check_span
from knightcube.gnc.estimation.rigid_body import (
    BodyErrors,
    by_inertia,
    by_matrix,
    inertia_covariance,
    tensor,
)

SIZES = {"rate": 3, "field": 3, "change": 3, "inertia": 6, "bias": 3, "coils": 9}
"""Number of elements of each block of states by name, in order."""
RATE, FIELD, CHANGE, INERTIA, BIAS, COILS = slices(SIZES)
SIZE = COILS.stop
LARGEST_ROTATION = 0.15
"""Largest rotation (rad) of the body in one integration step."""
LONGEST_PROPAGATION = 600.0
"""Longest time (s) over which the rate is propagated without a measurement."""
COVARIANCE_STEP, COVARIANCE_ROTATION = 0.1, 0.03
"""Longest time (s) and largest rotation (rad) of the body in one propagation step of the covariance."""
_LINEARISED = 0.2
"""Noise of the gyroscopic torque, as a fraction of the uncertainty of this torque due to the inertia, while
the rate is known. The noise represents products of errors, which the linearised filter neglects."""
_AGREEING = 3
"""Number of consecutive consistent field samples that start the filter."""
_SPINS = ((0.0, 0.5), (-1.5, 0.25), (1.5, 0.25))
"""Initial spins about the field, and their probabilities. The first value of each pair is s |s| / v, with the
spin s and the prior variance v of the spin. Together with `_SPIN_VARIANCE`, the initial estimates have the
mean and variance of the normally distributed prior."""
_SPIN_VARIANCE = 0.25
"""Spin variance of each initial estimate, as a fraction of the prior variance of the spin."""
_TEMPER = 4.0
"""Divisor of the log-likelihoods from which the probabilities of the estimates are computed. A filter that is
linearised about a wrong estimate has correlated innovations, so its likelihoods overstate the evidence."""
_EQUAL = 0.1
"""Normalised square of the difference of two rates below which the less probable estimate is discarded."""
_CURVATURE = 1.0
"""Correlation time (s) of the gyroscopic acceleration that is of second order in the error of the rate."""
_NOISE_STEPS = 0.2, 0.02
"""Changes of the logarithm of the estimated field noise by the first sample, and by each sample after many
samples. The changes decrease from the first to the second value, about inversely to the number of samples."""
_NOISIER = 1.2
"""Least ratio of the estimated to the configured field noise at which the estimate is used."""
_NOISE_RESTART = 2.0
"""Ratio of the estimated field noise to its value at the start of the filter above which the filter restarts.
The covariances of a filter that assumed too little noise are too small."""
_IMPROBABLE = 25.0
"""Largest difference of two estimates' log-likelihoods at which the less probable estimate is kept."""
_EYE: FloatArray = np.eye(SIZE)
_BY_FIELD: FloatArray = _EYE[FIELD] + _EYE[BIAS]
"""Jacobian (3, 27) of a field measurement."""
_NONE: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldRateSettings:
    """Noise of the filter.

    Attributes:
        inertia: assumed inertia tensor (3, 3) in body axes, kg m^2.
        field_sigma: standard deviation of the noise of a field measurement, T per axis. A larger standard
            deviation is used if the strength of consecutive samples varies more than this.
        rate_start: initial standard deviation of the rate along the field, rad/s.
        change_start: initial standard deviation of the field's inertial time derivative, T/s.
        change_walk: random walk of the field's inertial time derivative, T/s per sqrt(s).
        torque_walk: random walk of the rate per axis due to unmodelled torques, rad/s per sqrt(s).
        errors: largest errors of the body's description; only the errors of the inertia are used.
        inertia_walk: random walk of the inertia, relative to its trace, per sqrt(s).
        bias: initial standard deviation (T per axis) and random walk (T per sqrt(s)) of the magnetometer's
            bias.
        coils: initial standard deviation and random walk per sqrt(s) of each element of the matrix from the
            commanded to the actual dipole. The standard deviation covers coils that are dead or reversed.
        gate_sigma: gate threshold in standard deviations; a measurement is rejected if its innovation is less
            probable than a one-dimensional deviation of this size.
        refusals: number of consecutively rejected measurements after which the filter restarts (field
            measurements) or the gyro is excluded (gyro measurements).
        gyro_sigma: assumed bound of the gyro bias per axis, rad/s.
        longest_gap: longest time between two of the samples that start the filter, s. It is so short that no
            fast spin remains undetected.
    """

    inertia: FloatArray
    field_sigma: float
    rate_start: float = 0.3
    change_start: float = 8e-8
    change_walk: float = 4e-9
    torque_walk: float
    errors: BodyErrors = dataclasses.field(default_factory=BodyErrors)
    inertia_walk: float = 1e-5
    bias: tuple[float, float] = (2e-6, 1e-9)
    coils: tuple[float, float] = (0.4, 3e-3)
    gate_sigma: float = 5.0
    refusals: int = 5
    longest_gap: float = 0.2
    gyro_sigma: float = 1e-3

    def __post_init__(self) -> None:
        """Raise ArgumentError for an impossible inertia tensor, and for a value out of its range."""
        checked_inertia("inertia", self.inertia)
        check_amounts(self, "field_sigma", "gate_sigma", "refusals", "longest_gap", "gyro_sigma")
        check_type("errors", self.errors, BodyErrors)


def rate_across(before: FloatArray, after: FloatArray, seconds: float) -> FloatArray:
    """Return the body rate (3,) rad/s that rotated the field `before` into `after`, both (3,) T in body axes.

    The component of the rate along the field is not observable. The returned rate across the field is exact
    for a steady rotation of less than half a revolution, and zero if a field is zero. Raises ArgumentError
    unless the fields are finite and the time is positive.
    """
    checked_number("seconds", seconds, "s")
    check_finite(before=before, after=after)
    rotated = np.cross(after, before)  # in body axes, the field rotates opposite to the body
    length = float(np.linalg.norm(rotated))
    if length == 0.0:
        return np.zeros(3)
    angle = math.atan2(length, float(before @ after))
    return rotated * (angle / (length * seconds))


class FieldRate:
    """The filter of the body rate.

    The filter is linearised about an estimate, and the spin about the field is unknown at first. If it
    started with only one estimate, the filter could therefore converge to a wrong rate that predicts the
    field almost as well as the true rate. The filter begins with three estimates of different spins. An
    estimate is discarded if another estimate predicts the field much better, or if both have converged to the
    same rate. The properties return the most probable estimate, whose covariance includes the differences to
    the other estimates. For a body as slender as a rod whose moments of inertia have the ratio 50, the filter
    may still keep a wrong rate. A gyro rate (`measure_rate`) excludes a wrong rate.

    Attributes:
        restarts: number of restarts after failed predictions or an increase of the field noise.
        revisions: number of times that another estimate became the most probable one.
    """

    def __init__(self, settings: FieldRateSettings) -> None:
        self._settings = settings
        self._gate = (settings.gate_sigma + 1.0) ** 2
        self._unknown = _Estimate(settings, _NONE, _NONE, np.zeros((SIZE, SIZE)), 0.0)
        self.restarts = self.revisions = 0
        self._is_reset = False  # whether the filter is unchanged since the last reset
        self._start_sigma = settings.field_sigma  # noise of the field at the start of the filter
        self._noise = FieldNoise(settings.field_sigma, settings.longest_gap)
        self.restart()

    def restart(self) -> None:
        """Reset the filter without resetting the count of restarts."""
        if self._is_reset:
            return
        self._is_reset = True
        self._waiting: list[tuple[float, FloatArray]] = []
        self._since = 0.0
        self._refused = self._gyro_refused = 0
        self._gyro_used = False
        self._estimates: list[_Estimate] = []  # the most probable one is the first
        self._set_covariance()

    @property
    def started(self) -> bool:
        """Whether a rate is known."""
        return bool(self._estimates)

    @property
    def rate(self) -> FloatArray:
        """Body rate (3,) in body axes, rad/s."""
        return np.array(self._best.rate)

    @property
    def field(self) -> FloatArray:
        """Predicted field (3,) in body axes after the last `advance`, T."""
        return np.array(self._best.field)

    @property
    def change(self) -> FloatArray:
        """Time derivative (3,) of the field relative to inertial space, expressed in body axes, T/s."""
        return np.array(self._best.change)

    @property
    def rotation(self) -> FloatArray:
        """Quaternion (4,) of the rotation from the initial body axes into the present body axes."""
        return np.array(self._best.rotation)

    @property
    def inverse(self) -> FloatArray:
        """Inverse (3, 3) of the estimated inertia tensor, 1/(kg m^2)."""
        return self._best.inverse

    @property
    def momentum(self) -> FloatArray:
        """Angular momentum (3,) N m s, body axes."""
        return np.array(times(self._best.inertia_rows, self._best.rate))

    @property
    def bias(self) -> FloatArray:
        """Estimated bias (3,) of the magnetometer in body axes, T."""
        return self._best.bias

    @property
    def field_sigma(self) -> float:
        """Estimated standard deviation of a field measurement per axis, T."""
        return self._noise.sigma

    @property
    def coil_matrix(self) -> FloatArray:
        """Estimated matrix (3, 3) from the commanded to the actual dipole moment of the coils, body axes."""
        return self._best.coils

    def renew_coils(self) -> None:
        """Forget the estimated matrix of the coils, because the coils or their assumed signs have changed."""
        for estimate in self._estimates:
            estimate.renew_coils()
        self._set_covariance()

    @property
    def covariance(self) -> FloatArray:
        """Covariance (27, 27) of rate, field, field derivative, inertia, magnetometer bias and coil matrix.

        After `advance`, the covariance may be older than the state by up to `COVARIANCE_STEP`.
        """
        return self._covariance

    @property
    def _best(self) -> _Estimate:
        return self._estimates[0] if self._estimates else self._unknown

    def advance(self, dipole: FloatArray, seconds: float) -> None:
        """Propagate the state by `seconds` under a commanded dipole moment (3,), A m^2, body axes.

        After more than `LONGEST_PROPAGATION` s the rate is unknown, and the filter restarts. Raises
        ArgumentError for values that are not finite, and for a negative time.
        """
        dipole = finite_array("dipole", dipole, (3,))
        check_span(seconds)
        if seconds > LONGEST_PROPAGATION:
            self._restart_counted(self._gyro_refused >= self._settings.refusals)
        self._is_reset = False
        self._since += seconds
        self._noise.advance(seconds)
        propagated = [estimate.advance(dipole, seconds) for estimate in self._estimates]
        if any(propagated):
            self._set_covariance()

    def measure(self, field: FloatArray, age: float = 0.0) -> bool:
        """Apply a field (3,), T, measured `age` s ago with coils off, and return whether it passed the gate.

        The measured field is rotated into the present body axes with the body rate. A field that is not
        finite is rejected. Raises ArgumentError for another shape, and for an age that is negative or not
        finite.
        """
        field = float_rows("field", field, 3)
        if field.ndim > 1 or not 0.0 <= age < math.inf:
            raise ArgumentError("field", f"shape {field.shape}, age {age} s: give one field (3,) and its age")
        if not np.all(np.isfinite(field)):
            return False
        self._is_reset = False
        self._noise.add(math.sqrt(float(field @ field)))
        if self._estimates and self._noise.sigma > _NOISE_RESTART * self._start_sigma:
            self._restart_counted(self._gyro_refused >= self._settings.refusals)
        if not self._estimates:
            self._start(field)
            return True
        if self._apply(_BY_FIELD, self._noise.sigma, lambda estimate: estimate.turned(field, age)):
            self._refused = 0
            return True
        self._refused += 1
        if self._refused >= self._settings.refusals:
            self._restart_counted(self._gyro_used or self._gyro_refused >= self._settings.refusals)
        return False

    def measure_rate(self, rate: FloatArray) -> None:
        """Apply the present gyro rate (3,), rad/s, if the gyro is more accurate than the filter.

        The error of the gyro is mostly a bias, and frequent use of the gyro would reduce the standard
        deviation of the rate below that bias. A gyro that contradicts the filter several times in a row is
        excluded until `restart`. The gyro is also excluded if the field predictions fail after a gyro rate
        was used. If the gyro contradicts an estimate that used the gyro, the filter restarts.
        """
        settings, rate = self._settings, float_rows("rate", rate, 3)
        self._is_reset = False
        if not self._estimates or self._gyro_refused >= settings.refusals or not np.all(np.isfinite(rate)):
            return
        for estimate in self._estimates:
            estimate.propagate_covariance()
        self._set_covariance()
        is_better = float(self._covariance.diagonal()[RATE].max()) > settings.gyro_sigma**2
        if not self._apply(_EYE[RATE], settings.gyro_sigma, lambda _: rate, corrects=is_better):
            self._gyro_refused += 1
            if self._gyro_used and self._gyro_refused >= settings.refusals:
                self._restart_counted(exclude_gyro=True)
            return
        self._gyro_refused = 0
        self._gyro_used |= is_better

    def _apply(
        self,
        rows: FloatArray,
        sigma: float,
        value_for: Callable[[_Estimate], FloatArray],
        *,
        corrects: bool = True,
    ) -> bool:
        """Apply a measurement with the Jacobian `rows` (3, 27), and return whether an estimate agrees.

        The measurement (3,), which `value_for` returns in the present axes of an estimate, has the standard
        deviation `sigma` per axis. Unless `corrects` is true, the measurement is only compared with the
        estimates.
        """
        noise = sigma**2 * np.eye(3)
        innovations, weights = [], []
        for estimate in self._estimates:
            estimate.propagate_covariance()
            innovations.append(value_for(estimate) - rows @ estimate.state)
            weights.append(weigh(estimate.covariance, innovations[-1], rows, noise))
        agree = [weighed.square <= self._gate for weighed in weights]
        if not any(agree):
            self._set_covariance()
            return False
        if corrects:
            for estimate, innovation, weighed, agrees in zip(
                self._estimates, innovations, weights, agree, strict=True
            ):
                determinant = float(np.linalg.slogdet(weighed.spread)[1])
                estimate.log_likelihood -= 0.5 * (min(weighed.square, self._gate) + determinant)
                if agrees:
                    estimate.correct(weighed, innovation)
            self._discard()
        self._set_covariance()
        return True

    def _discard(self) -> None:
        """Discard the estimates that are improbable or equal to a more probable one."""
        if len(self._estimates) == 1:
            return
        first = self._best
        kept: list[_Estimate] = []
        for estimate in sorted(self._estimates, key=lambda each: -each.log_likelihood):
            improbable = bool(kept) and kept[0].log_likelihood - estimate.log_likelihood > _IMPROBABLE
            if not improbable and not any(estimate.equals(other) for other in kept):
                kept.append(estimate)
        self._estimates = kept
        self.revisions += self._best is not first

    def _set_covariance(self) -> None:
        """Set the covariance of the error of the most probable estimate."""
        best = self._best
        self._covariance = best.covariance
        if len(self._estimates) > 1:
            weights = np.exp(
                [(each.log_likelihood - best.log_likelihood) / _TEMPER for each in self._estimates]
            )
            apart = [each.state - best.state for each in self._estimates]
            self._covariance = sum(
                (
                    weight * (each.covariance + np.outer(difference, difference))
                    for weight, each, difference in zip(
                        weights / weights.sum(), self._estimates, apart, strict=True
                    )
                ),
                np.zeros((SIZE, SIZE)),
            )

    def _restart_counted(self, exclude_gyro: bool) -> None:
        """Restart the filter, and count the restart."""
        self.restart()
        self._is_reset = False
        self._gyro_refused = self._settings.refusals if exclude_gyro else 0
        self.restarts += 1

    def _start(self, field: FloatArray) -> None:
        """Add a field sample, and start the filter if the last three samples agree."""
        settings, field_sigma = self._settings, self._noise.sigma
        if self._since > settings.longest_gap:
            self._waiting.clear()
        self._waiting.append((self._since, field))
        self._since = 0.0
        if len(self._waiting) < _AGREEING:
            return
        self._start_sigma = field_sigma
        (_, first), (span_a, middle), (span_b, last) = self._waiting
        self._waiting.pop(0)
        square = float(last @ last)
        if min(span_a, span_b) <= 0.0 or square == 0.0:  # a failed sensor may read zero
            return
        strength = math.sqrt(square)
        noise = settings.gate_sigma * math.sqrt(2.0) * field_sigma
        if max(abs(math.sqrt(float(b @ b)) - strength) for b in (first, middle)) > noise:
            return
        rates = rate_across(first, middle, span_a), rate_across(middle, last, span_b)
        apart, speed = (float(np.linalg.norm(v)) for v in (rates[0] - rates[1], rates[1]))
        if apart > 2.0 * noise / (strength * min(span_a, span_b)) + 0.3 * speed:
            return
        span = span_a + span_b
        rate = 0.5 * (rates[0] + rates[1])
        across = 2.0 * (field_sigma / span) ** 2 / square + settings.torque_walk**2 * span
        # Between the samples, the spin about the field rotates the perpendicular rate component in body axes.
        across += (float(rate @ rate) * span) ** 2
        along = settings.rate_start**2 + float(rate @ rate)
        axis = last / strength
        covariance = np.zeros((SIZE, SIZE))
        covariance[RATE, RATE] = across * np.eye(3) + _SPIN_VARIANCE * along * np.outer(axis, axis)
        covariance[FIELD, FIELD] = (field_sigma**2 + settings.bias[0] ** 2) * np.eye(3)
        covariance[BIAS, BIAS] = settings.bias[0] ** 2 * np.eye(3)
        covariance[FIELD, BIAS] = covariance[BIAS, FIELD] = -covariance[BIAS, BIAS]
        covariance[COILS, COILS] = settings.coils[0] ** 2 * np.eye(9)
        covariance[CHANGE, CHANGE] = settings.change_start**2 * np.eye(3)
        covariance[INERTIA, INERTIA] = inertia_covariance(np.asarray(settings.inertia), settings.errors)
        for square, probability in _SPINS:
            spin = math.copysign(math.sqrt(abs(square) * along), square)
            self._estimates.append(
                _Estimate(
                    settings, _floats(rate + spin * axis), _floats(last), covariance, math.log(probability)
                )
            )
        self._set_covariance()


class FieldNoise:
    """The noise of the magnetometer, estimated from the field strength, which is independent of rotations.

    The strength changes slowly, so the second differences of consecutive samples contain only noise. Their
    median is followed, because outliers hardly affect it.
    """

    def __init__(self, sigma: float, longest_gap: float) -> None:
        """Begin with the configured standard deviation `sigma`, T per axis.

        Samples that follow each other within `longest_gap` s are compared.
        """
        self._configured, self._longest_gap = sigma, longest_gap
        self._ratio = 1.0  # ratio of the estimated to the configured noise
        self._number = 0  # number of second differences
        self._since = 0.0
        self._strengths: list[float] = []

    @property
    def sigma(self) -> float:
        """Standard deviation of a sample, T per axis."""
        return self._configured * (self._ratio if self._ratio > _NOISIER else 1.0)

    def advance(self, seconds: float) -> None:
        """Add `seconds` to the time since the last sample."""
        self._since += seconds

    def add(self, strength: float) -> None:
        """Add the strength of a field sample, T."""
        if self._since > self._longest_gap:
            self._strengths.clear()
        self._since = 0.0
        self._strengths = [*self._strengths[-2:], strength]
        if len(self._strengths) == 3:
            first, middle, last = self._strengths
            median = 0.6745 * math.sqrt(6.0) * self._configured
            is_larger = abs(first - 2.0 * middle + last) > self._ratio * median
            first_step, last_step = _NOISE_STEPS
            step = max(last_step, first_step / (1.0 + first_step * self._number))
            self._number += 1
            self._ratio = max(1.0, self._ratio * math.exp(step if is_larger else -step))


class _Estimate:
    """An estimate of the states, with the log-likelihood of the measurements.

    Attributes:
        rate: body rate, rad/s, body axes.
        field: field, T, body axes.
        change: inertial time derivative of the field, T/s, body axes.
        rotation: quaternion of the rotation since the start.
        covariance: covariance (27, 27) of the states.
        log_likelihood: logarithm of the probability density of the measurements, without constant terms.
        inverse: inverse (3, 3) of the estimated inertia tensor, 1/(kg m^2).
        inertia_rows: rows of the estimated inertia tensor, kg m^2.
        bias: estimated bias (3,) of the magnetometer, T.
        coils: estimated matrix (3, 3) from the commanded to the actual dipole moment.
    """

    def __init__(
        self,
        settings: FieldRateSettings,
        rate: Vector,
        field: Vector,
        covariance: FloatArray,
        log_likelihood: float,
    ) -> None:
        self._settings = settings
        self._assumed = np.asarray(settings.inertia, dtype=float)
        self._trace = float(np.trace(self._assumed))
        self._quadratic = _quadratic(self._assumed)
        self.rate, self.field, self.change = rate, field, _NONE
        self.rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)
        self.bias: FloatArray = np.zeros(3)
        self.coils: FloatArray = np.eye(3)
        self._set_inertia(np.zeros(6))
        self.covariance = covariance
        self.log_likelihood = log_likelihood
        self._update_unexplained()
        self._pending = 0.0  # time (s) from the covariance to the state
        # Integral of the commanded dipole since the time of the covariance, A m^2 s.
        self._pending_impulse = np.zeros(3)
        # Rate, field and field derivative at the time of the covariance.
        self._pending_start = _NONE, _NONE, _NONE

    @property
    def state(self) -> FloatArray:
        """The states (27,)."""
        coils = (self.coils - np.eye(3)).ravel()
        return np.array([*self.rate, *self.field, *self.change, *self._error, *self.bias, *coils])

    def advance(self, dipole: FloatArray, seconds: float) -> bool:
        """Propagate the state by `seconds`, and return whether the covariance was propagated, too.

        The commanded dipole moment of the coils is `dipole` (3,), A m^2, body axes.
        """
        speed = math.sqrt(sum(w * w for w in self.rate))
        steps = max(1, math.ceil(speed * seconds / LARGEST_ROTATION))
        mx, my, mz = (self.coils @ dipole).tolist()
        if not self._pending:
            self._pending_start = self.rate, self.field, self.change
        self._pending += seconds
        self._pending_impulse = self._pending_impulse + seconds * dipole
        for _ in range(steps):
            self._step((mx, my, mz), seconds / steps)
        if self._pending >= COVARIANCE_STEP or speed * self._pending >= COVARIANCE_ROTATION:
            self.propagate_covariance()
            return True
        return False

    def turned(self, field: FloatArray, age: float) -> FloatArray:
        """Return a field (3,) T, measured `age` s ago, in the present body axes."""
        if not age:
            return field
        x, y, z = self.rate
        return np.array(matrix(exponential(age * x, age * y, age * z))) @ field

    def renew_coils(self) -> None:
        """Reset the matrix of the coils and its covariance to their initial values."""
        self.propagate_covariance()
        self.coils = np.eye(3)
        self.covariance[COILS] = self.covariance[:, COILS] = 0.0
        self.covariance[COILS, COILS] = self._settings.coils[0] ** 2 * np.eye(9)

    def equals(self, other: _Estimate) -> bool:
        """Return whether the rate equals the rate of another estimate within its uncertainty."""
        apart = np.subtract(self.rate, other.rate)
        return float(apart @ np.linalg.solve(other.covariance[RATE, RATE], apart)) < _EQUAL

    def correct(self, weighed: Weighed, innovation: FloatArray) -> None:
        """Correct the state by an innovation (3,) with its optimal gain."""
        change = (weighed.gain @ innovation).tolist()
        self.rate = added(self.rate, change[RATE])
        self.field = added(self.field, change[FIELD])
        self.change = added(self.change, change[CHANGE])
        self._set_inertia(self._error + np.array(change[INERTIA]))
        self.bias = self.bias + change[BIAS]
        self.coils = self.coils + np.reshape(change[COILS], (3, 3))
        self.covariance = updated(self.covariance, weighed.gain, weighed.cross, weighed.spread)
        self._update_unexplained()

    def _update_unexplained(self) -> None:
        """Set the fractional uncertainty of the gyroscopic torque from the uncertainty of the inertia.

        Without noise for this torque, the covariance of the linearised filter would become too small while
        the inertia is poorly known. The least certain combination of the tensor's elements is omitted: it is
        the common scale, which does not affect the gyroscopic acceleration.
        """
        unknown = float(np.linalg.eigvalsh(self.covariance[INERTIA, INERTIA])[-2])
        self._unexplained = math.sqrt(max(unknown, 0.0)) * self._trace / np.diag(self._inertia)

    def _set_inertia(self, error: FloatArray) -> None:
        """Set the errors (6,) of the elements of the assumed inertia tensor, relative to its trace."""
        self._error = error
        self._inertia = self._assumed + self._trace * tensor(error)
        self.inverse: FloatArray = np.asarray(np.linalg.inv(self._inertia), dtype=float)
        self.inertia_rows, self._inverse_rows = rows_of(self._inertia), rows_of(self.inverse)

    def _step(self, dipole: Vector, dt: float) -> None:
        """Propagate the state by one step of the midpoint rule."""
        self.rate, self.field, self.change, self.rotation = _stepped(
            self.rate,
            self.field,
            self.change,
            self.rotation,
            dipole,
            self.inertia_rows,
            self._inverse_rows,
            dt,
        )

    def propagate_covariance(self) -> None:
        """Propagate the covariance to the time of the state, linearised at the middle of the interval."""
        dt = self._pending
        if not dt:
            return
        starts, ends = self._pending_start, (self.rate, self.field, self.change)
        middle, half, change = (
            _moved(start, _difference(end, start), 0.5) for start, end in zip(starts, ends, strict=True)
        )
        dipole = self._pending_impulse / dt
        self._pending, self._pending_impulse = 0.0, np.zeros(3)
        flow = self._flow(middle, half, change, dipole, dt)
        transition = _EYE + flow + 0.5 * (flow @ flow)
        covariance = transition @ self.covariance @ transition.T
        settings = self._settings
        # The gyroscopic torque error is correlated until the body has rotated by about one radian.
        speed = math.sqrt(middle[0] ** 2 + middle[1] ** 2 + middle[2] ** 2)
        walks = covariance.reshape(-1)[:: SIZE + 1]
        # The filter is linearised, so products of the errors of rate, inertia and field change act as noise.
        spread = float(walks[RATE].sum())
        products = speed * (_LINEARISED**2 * speed**2 + spread)
        unknown_change = min(float(walks[CHANGE].max()), settings.change_start**2)
        walks[RATE] += dt * (settings.torque_walk**2 + products * self._unexplained**2)
        if spread < 2.0 * (settings.rate_start**2 + speed**2):  # the uncertainty must not grow without limit
            product = self._quadratic @ covariance[RATE, RATE]
            squares = product.reshape(3, 9) @ product.transpose(0, 2, 1).reshape(3, 9).T
            covariance[RATE, RATE] += 4.0 * dt * _CURVATURE * squares
        walks[CHANGE] += dt * (settings.change_walk**2 + math.sqrt(spread) * unknown_change)
        walks[INERTIA] += dt * settings.inertia_walk**2
        walks[BIAS] += dt * settings.bias[1] ** 2
        walks[COILS] += dt * settings.coils[1] ** 2
        self.covariance = covariance

    def _flow(
        self, rate: Vector, field: Vector, change: Vector, commanded: FloatArray, dt: float
    ) -> FloatArray:
        """Return the linearised change (27, 27) of the states during `dt`."""
        cross_rate, dipole = np.array(skew(rate)), _floats(self.coils @ commanded)
        momentum = times(self.inertia_rows, rate)
        torque = _difference(cross(dipole, field), cross(rate, momentum))
        flow = np.zeros((SIZE, SIZE))
        gyroscopic = np.array(skew(momentum))
        flow[RATE, RATE] = self.inverse @ (gyroscopic - cross_rate @ self._inertia)
        acceleration = np.array(times(self._inverse_rows, torque))
        changed = by_inertia(acceleration) + cross_rate @ by_inertia(np.array(rate))
        flow[RATE, INERTIA] = -self._trace * self.inverse @ changed
        flow[RATE, FIELD] = self.inverse @ np.array(skew(dipole))
        flow[RATE, COILS] = -self.inverse @ np.array(skew(field)) @ by_matrix(commanded)
        flow[FIELD, RATE] = skew(field)
        flow[FIELD, FIELD] = flow[CHANGE, CHANGE] = -cross_rate
        flow[FIELD, CHANGE] = np.eye(3)
        flow[CHANGE, RATE] = skew(change)
        return np.asarray(dt * flow)


def _quadratic(inertia: FloatArray) -> FloatArray:
    """Return the coefficients (3, 3, 3) of the gyroscopic acceleration, which is quadratic in the rate.

    The component k of the acceleration is w A[k] w for the rate w. If w is normally distributed with mean
    zero and covariance P, the covariance of the components k and l is 2 tr(A[k] P A[l] P).
    """
    crossed = np.array([skew(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))])
    coefficients = -np.einsum("kl,ilm,mj->kij", np.linalg.inv(inertia), crossed, inertia)
    return np.asarray(0.5 * (coefficients + coefficients.transpose(0, 2, 1)))


@compiled_floats
def _stepped(
    rate: Vector,
    field: Vector,
    change: Vector,
    rotation: Quaternion,
    dipole: Vector,
    inertia: Matrix,
    inverse: Matrix,
    dt: float,
) -> tuple[Vector, Vector, Vector, Quaternion]:
    """Return the rate, the field, its derivative and the rotation after a step of the midpoint rule."""
    acceleration = _acceleration(inertia, inverse, rate, field, dipole)
    middle = _moved(rate, acceleration, 0.5 * dt)
    half = _moved(field, _difference(change, cross(rate, field)), 0.5 * dt)
    acceleration = _acceleration(inertia, inverse, middle, half, dipole)
    rotated = exponential(dt * middle[0], dt * middle[1], dt * middle[2])
    turn = matrix(rotated)
    # The field is rotated exactly, because the midpoint rule would change its strength within an hour.
    after = _moved(times(turn, field), times(turn, change), dt)
    return _moved(rate, acceleration, dt), after, times(turn, change), compose(rotated, rotation)


@loop_helper
def _acceleration(inertia: Matrix, inverse: Matrix, rate: Vector, field: Vector, dipole: Vector) -> Vector:
    momentum = times(inertia, rate)
    return times(inverse, _difference(cross(dipole, field), cross(rate, momentum)))


@loop_helper
def _moved(v: Vector, change: Vector, dt: float) -> Vector:
    return v[0] + dt * change[0], v[1] + dt * change[1], v[2] + dt * change[2]


@loop_helper
def _difference(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _floats(array: FloatArray) -> Vector:
    x, y, z = array.tolist()
    return x, y, z
