"""Maximum-likelihood fit of the plant's constants and the noise levels to a record of the motion.

The equation of motion, divided by the inertia, is theta'' = g I cos(theta) - kappa theta - delta theta' + d
(Sease 2013, eq. 5.4, with the thread). Each change of the current I takes effect after the delay tau. The
measured quantities are the angle theta and the biased rate theta' + b. The actual current differs from the
commanded current, so an active coil adds process noise. The predictor is therefore the extended Kalman filter
of angle and rate (prediction-error method: Ljung 1999, System Identification, sections 7.2 and 10.2). An
output-error fit would treat the accumulated process noise as signal. Between events the state is propagated
by a Taylor series whose error is a ten-thousandth of the noise. The derivatives with respect to the constants
treat the filter gains as fixed, so that the expected gradient at the true constants is zero.

Constants and noise levels are estimated alternately, because the information matrix has no cross terms
between constants and noise levels. The constants are estimated from the whitened innovations, and the noise
levels by Fisher scoring. The priors are wide and affect only values that the record does not determine. The
prior of the delay is about 20 ms, and the prior noise levels are uncertain by a factor of 3. Events that
noise cannot explain, such as the release, a jolt or an outlier, restart the filter.

If the innovations are white (test of Ljung and Box 1978), the covariance is the inverse of the information.
The inertial unit's attitude filter or air currents can make the innovations correlated, that is, not white.
If the innovations are not white, each standard deviation is at least the sandwich estimate (Huber 1967) over
segments of the record.

Motion under a known current determines g = n A B / J, k / J and c / J, but not the inertia J itself. For
example, a body with twice the inertia in twice the field on a thread of twice the stiffness has the same
motion. The absolute values follow from prior values of the inertia J, the dipole per ampere n A, and the
field B. The field B is also measured by the magnetometer. The priors are Gaussian in the logarithms of the
values. The measured gain g relates inertia, dipole and field by the constraint
ln n A + ln B - ln J - ln g = 0, which is applied as an error-free measurement, and corrects inertia, dipole
and field.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import msgspec
import numpy as np
from scipy.special import gammaincc

from flight.schema import reader as configuration
from flight.schema.bodies import Plant, Step, TestbedConfig
from flight.schema.document import to_yaml
from ground.identification.record import HorizontalField, IdentificationError, Record, Timeline
from knightcube.astro.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class MotionConstants:
    """Constants of the equation of motion, divided by the inertia.

    Attributes:
        gain: torque per current and inertia, g = n A B / J, rad/s^2/A.
        torsion: thread stiffness divided by the inertia, kappa = k / J, 1/s^2.
        damping: damping coefficient divided by the inertia, delta = c / J, 1/s.
        disturbance: constant angular acceleration d, rad/s^2, including kappa theta_0 for the thread's rest
            angle theta_0.
        bias: gyro bias b, rad/s.
        delay: delay tau, s, from the control cycle that wrote a current until the current flows.
    """

    gain: float
    torsion: float
    damping: float
    disturbance: float = 0.0
    bias: float = 0.0
    delay: float = 0.0

    def to_array(self) -> FloatArray:
        """Return the constants as an array (6,) in the order of the dataclass fields."""
        return np.array([getattr(self, name) for name in NAMES])

    @classmethod
    def of(cls, values: FloatArray) -> MotionConstants:
        """Return the constants from an array (6,)."""
        return cls(*(float(value) for value in values))


NAMES = tuple(field.name for field in fields(MotionConstants))
UNITS = dict(zip(NAMES, ("rad/s^2/A", "1/s^2", "1/s", "rad/s^2", "rad/s", "s"), strict=True))
_BIAS, _DELAY = NAMES.index("bias"), NAMES.index("delay")

_PRIOR_SIGMA = np.array([math.inf, math.inf, math.inf, 1.0, 0.1, 0.02])
"""Standard deviations of the zero-mean priors of the constants, in the order of `NAMES`."""
_NOISE_PRIOR = math.log(3.0)  # prior standard deviation of the logarithms of the noise levels
_MAX_DELAY = 0.1
_CONVERGED = 0.01  # step size (standard deviations) below which the fit has converged
_MAX_ROUNDS = 50
_NOISE_STEP = 0.02
_NOISE_CONVERGED = 0.01
_GATES = (30.0, 8.0, 8.0)
"""Outlier gates in standard deviations of the innovations, first with assumed, then with estimated noise."""
_MAX_RESTARTS = 0.02  # largest fraction of samples at which the filter may restart
_LAGS = 20  # number of lags of the whiteness test
_SEGMENTS = 40  # number of segments of the record for the sandwich estimate
_MIN_PROBABILITY = 1e-3
"""Probability below which the whiteness test rejects the hypothesis that the innovations are white."""
_MAX_GAIN_ERROR = 0.25  # largest accepted relative standard deviation of the gain


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """Standard deviations of an active coil's current (A), of the angle (rad) and of the rate (rad/s)."""

    current: float
    angle: float
    rate: float

    def to_logarithms(self) -> FloatArray:
        """Return the logarithms (3,) of the noise levels."""
        return np.log([self.current, self.angle, self.rate])

    @classmethod
    def of_logarithms(cls, values: FloatArray) -> MotionNoise:
        """Return the noise levels from their logarithms (3,)."""
        return cls(*(float(value) for value in np.exp(values)))


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """Innovations of one filter pass over a record of n samples; the first sample starts the filter.

    Attributes:
        error: measured minus predicted angle and rate (n - 1, 2).
        covariance: covariances (n - 1, 2, 2) of the errors.
        gradient: derivatives (n - 1, 2, 6) of the predictions with respect to the constants, or an empty
            array (0, 2, 6) if the derivatives were not requested.
        taken: indices (n - 1,) of the samples that have an innovation.
        restarts: indices of the samples at which the filter restarted and which have no innovation.
    """

    error: FloatArray
    covariance: FloatArray
    gradient: FloatArray
    taken: IntArray
    restarts: frozenset[int]

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """Return `vectors` (n - 1, 2, k) multiplied by the inverse Cholesky factors of the covariances."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.covariance), vectors))

    @property
    def whitened(self) -> FloatArray:
        """Whitened innovations (n - 1, 2), of unit variance if the model is correct."""
        return self.whiten(self.error[..., None])[..., 0]


def innovations(
    record: Record,
    constants: MotionConstants,
    noise: MotionNoise,
    restarts: frozenset[int] = frozenset(),
    gate: float = math.inf,
    with_gradient: bool = True,
) -> Innovations:
    """Run the filter over a record and return the innovations.

    The filter restarts at the samples `restarts`, and after an innovation that exceeds `gate` standard
    deviations.
    """
    angle, rate = record.angle.tolist(), record.rate.tolist()
    predictor = _Predictor(constants, noise, record.period, with_gradient)
    predictor.start(angle[0], rate[0])
    made = []
    restarted = set(restarts)
    timeline = Timeline.of(record, constants.delay)
    columns = (timeline.span, timeline.current, timeline.variance, timeline.sample, timeline.jump)
    for span, current, variance, sample, jump in zip(*(column.tolist() for column in columns), strict=True):
        if span > 0.0:
            predictor.propagate(span, current, variance)
        if sample >= 0:
            if sample in restarted or predictor.distance(angle[sample], rate[sample]) > gate:
                restarted.add(sample)
                predictor.start(angle[sample], rate[sample])
            else:
                gradient = predictor.gradient() if with_gradient else ()
                made.append((*predictor.update(angle[sample], rate[sample]), gradient, sample))
        if jump and with_gradient:
            predictor.note_switch(jump)
    errors, covariances, gradients, taken = zip(*made, strict=True)
    covariance = np.array(covariances).reshape(-1, 2, 2)
    by = np.array(gradients if with_gradient else ()).reshape(-1, 2, len(NAMES))
    return Innovations(np.array(errors), covariance, by, np.array(taken), frozenset(restarted))


class _Predictor:
    """Extended Kalman filter of angle and rate, and derivatives of both with respect to the constants."""

    def __init__(
        self, constants: MotionConstants, noise: MotionNoise, period: float, with_gradient: bool
    ) -> None:
        self._constants = constants
        self._walk = (constants.gain * noise.current) ** 2 * period
        self._r_angle, self._r_rate = noise.angle**2, noise.rate**2
        self._with_gradient = with_gradient
        self._bias_row = np.zeros(len(NAMES))
        self._bias_row[_BIAS] = 1.0

    def start(self, angle: float, rate: float) -> None:
        """Start or restart the filter from a sample."""
        self._angle, self._rate = angle, rate - self._constants.bias
        self._paa, self._pab, self._pbb = self._r_angle, 0.0, self._r_rate
        self._by_angle, self._by_rate = np.zeros(len(NAMES)), -self._bias_row

    def distance(self, angle: float, rate: float) -> float:
        """Return the larger of the two normalised innovations of angle and rate."""
        by_angle = (angle - self._angle) ** 2 / (self._paa + self._r_angle)
        by_rate = (rate - self._rate - self._constants.bias) ** 2 / (self._pbb + self._r_rate)
        return math.sqrt(max(by_angle, by_rate))

    def propagate(self, span: float, current: float, variance: float) -> None:
        """Propagate the state by `span` s under a current (A) with the relative variance `variance`."""
        c, angle, rate = self._constants, self._angle, self._rate
        cosine = math.cos(angle)
        acceleration = c.gain * current * cosine - c.torsion * angle - c.damping * rate + c.disturbance
        slope = -c.gain * current * math.sin(angle) - c.torsion
        jerk = slope * rate - c.damping * acceleration
        half = 0.5 * span * span
        f11, f12 = 1.0 + half * slope, span - half * c.damping
        f21, f22 = slope * f12, 1.0 - span * c.damping + half * (slope + c.damping * c.damping)
        if self._with_gradient:
            forcing = np.array([current * cosine, -angle, -rate, 1.0, 0.0, 0.0])
            self._by_angle, self._by_rate = (
                f11 * self._by_angle + f12 * self._by_rate + half * forcing,
                f21 * self._by_angle + f22 * self._by_rate + f12 * forcing,
            )
        self._angle = angle + span * rate + half * (acceleration + span * jerk / 3.0)
        self._rate = rate + span * acceleration + half * jerk
        q = self._walk * variance * cosine * cosine
        a1, a2 = f11 * self._paa + f12 * self._pab, f11 * self._pab + f12 * self._pbb
        b1, b2 = f21 * self._paa + f22 * self._pab, f21 * self._pab + f22 * self._pbb
        self._paa = a1 * f11 + a2 * f12 + q * span * half * (2.0 / 3.0)
        self._pab = a1 * f21 + a2 * f22 + q * half
        self._pbb = b1 * f21 + b2 * f22 + q * span

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (6,) of predicted angle and gyro reading with respect to the constants."""
        return self._by_angle, self._by_rate + self._bias_row

    def update(
        self, angle: float, rate: float
    ) -> tuple[tuple[float, float], tuple[float, float, float, float]]:
        """Update the state with a sample and return the innovation and its covariance."""
        error = angle - self._angle, rate - self._rate - self._constants.bias
        paa, pab, pbb = self._paa, self._pab, self._pbb
        saa, sbb = paa + self._r_angle, pbb + self._r_rate
        determinant = saa * sbb - pab * pab
        kaa, kab = (paa * sbb - pab * pab) / determinant, (pab * saa - paa * pab) / determinant
        kba, kbb = (pab * sbb - pbb * pab) / determinant, (pbb * saa - pab * pab) / determinant
        if self._with_gradient:
            by_angle, by_rate = self.gradient()
            self._by_angle = self._by_angle - kaa * by_angle - kab * by_rate
            self._by_rate = self._by_rate - kba * by_angle - kbb * by_rate
        self._angle += kaa * error[0] + kab * error[1]
        self._rate += kba * error[0] + kbb * error[1]
        self._paa = (1.0 - kaa) * paa - kab * pab
        self._pab = (1.0 - kaa) * pab - kab * pbb
        self._pbb = (1.0 - kbb) * pbb - kba * pab
        return error, (saa, pab, pab, sbb)

    def note_switch(self, jump: float) -> None:
        """Update the derivative with respect to the delay at a jump (A) of the current.

        A longer delay extends the effect of the previous current.
        """
        self._by_rate = self._by_rate.copy()
        self._by_rate[_DELAY] -= self._constants.gain * math.cos(self._angle) * jump


@dataclass(frozen=True, slots=True, eq=False)
class Whiteness:
    """Whiteness test of the innovations of angle and rate.

    Attributes:
        variance: variance of the whitened innovations.
        probability: probability that white innovations have at least as strong a correlation over 20 lags.
    """

    variance: tuple[float, float]
    probability: tuple[float, float]

    @property
    def passed(self) -> bool:
        """Whether the test accepts the innovations as white."""
        return min(self.probability) > _MIN_PROBABILITY


@dataclass(frozen=True, slots=True, eq=False)
class PlantFit:
    """Fitted constants with their covariance (6, 6), the noise levels, the innovations and their test."""

    constants: MotionConstants
    covariance: FloatArray
    noise: MotionNoise
    innovations: Innovations
    whiteness: Whiteness

    def sigma(self, name: str) -> float:
        """Return the standard deviation of a constant by its name."""
        index = NAMES.index(name)
        return math.sqrt(float(self.covariance[index, index]))


def fit(record: Record, noise: MotionNoise, progress: Callable[[int, float], None] | None = None) -> PlantFit:
    """Fit the constants to a record, beginning with an assumed noise.

    The function `progress` is called with the number of each round and its step in standard deviations.
    Raises IdentificationError if the record does not determine the torque constant, or if the fit fails.
    """
    if not np.any(record.current):
        raise IdentificationError("the coil on x was never driven: the flight does not show its torque")
    try:
        return _fitted(record, noise, progress)
    except (ValueError, OverflowError) as error:
        # A diverging prediction leads to the cosine of infinity or to an indefinite covariance.
        raise IdentificationError("the fit of the constants failed: the prediction diverges") from error


def _fitted(record: Record, noise: MotionNoise, progress: Callable[[int, float], None] | None) -> PlantFit:
    constants, assumed, share, before = first_guess(record), noise, 1.0, np.zeros(len(NAMES))
    restarts: frozenset[int] = frozenset()
    gates = list(_GATES)
    for count in range(_MAX_ROUNDS):
        passed = innovations(record, constants, noise, restarts)
        step, information = _step(passed, constants)
        # The likelihood has kinks as a function of the delay, so a step in the reverse direction is halved.
        share *= 0.5 if step @ information @ before < 0.0 and count > 3 else 1.0
        before = step
        step = share * step
        largest = float(np.max(np.abs(step) * np.sqrt(np.diag(information))))
        values = constants.to_array() + step
        values[_DELAY] = min(max(values[_DELAY], -_MAX_DELAY), _MAX_DELAY)
        constants = MotionConstants.of(values)
        if progress is not None:
            progress(count, largest)
        if largest > 3.0 and count < 2:
            continue
        if len(gates) == len(_GATES):
            restarts = _gated(record, constants, noise, gates.pop(0))
        likelier = _noise(record, constants, noise, assumed, restarts)
        settled = float(np.max(np.abs(likelier.to_logarithms() - noise.to_logarithms()))) < _NOISE_CONVERGED
        noise = likelier
        if settled and largest < _CONVERGED:
            # Samples that the gate rejected with earlier constants may pass it with the present constants.
            gated = _gated(record, constants, noise, gates.pop(0)) if gates else restarts
            if gated == restarts:
                return _finished(record, constants, noise, restarts)
            restarts, share = gated, 1.0
    raise IdentificationError(
        f"the fit of the constants failed: in iteration {_MAX_ROUNDS} they still changed by "
        f"{largest:.2g} standard deviations"
    )


def first_guess(record: Record) -> MotionConstants:
    """Return gain, torsion, damping and disturbance by regression of the rate changes over each second.

    The regression ignores the noise and needs no initial values.
    """
    spans = np.diff(record.time)
    at = np.searchsorted(record.switch_time, record.time[:-1], side="right")
    current = np.append(0.0, record.current)[at]
    middle = 0.5 * (record.angle[1:] + record.angle[:-1])
    mean_rate = 0.5 * (record.rate[1:] + record.rate[:-1])
    sums = np.cumsum(
        [spans * c for c in (current * np.cos(middle), -middle, -mean_rate, np.ones(len(spans)))], 1
    )
    edges = np.unique(np.searchsorted(record.time, np.arange(record.time[0], record.time[-1])))[1:]
    changes = np.diff(record.rate[edges])
    found = np.linalg.lstsq(np.diff(sums[:, edges - 1], axis=1).T, changes, rcond=None)[0]
    return MotionConstants(*(float(value) for value in found))


def _gated(record: Record, constants: MotionConstants, noise: MotionNoise, gate: float) -> frozenset[int]:
    """Return the indices of the samples at which the filter restarts, because they lie beyond the gate.

    Raises IdentificationError if there are too many such samples.
    """
    passed = innovations(record, constants, noise, gate=gate, with_gradient=False)
    if len(passed.restarts) > _MAX_RESTARTS * len(record.time):
        raise IdentificationError(
            f"the fit of the constants failed: {len(passed.restarts)} of {len(record.time)} samples differ "
            f"by more than {gate:g} standard deviations from the predicted motion"
        )
    return passed.restarts


def _finished(
    record: Record, constants: MotionConstants, noise: MotionNoise, restarts: frozenset[int]
) -> PlantFit:
    """Return the fit with its covariance. Raises IdentificationError if the gain is uncertain or negative."""
    passed = innovations(record, constants, noise, restarts)
    covariance = _inverse(_step(passed, constants)[1])
    whiteness = _whiteness(passed.whitened)
    if not whiteness.passed:
        scores = np.einsum("nik,ni->nk", passed.whiten(passed.gradient), passed.whitened)
        segments = np.array([np.sum(part, axis=0) for part in np.array_split(scores, _SEGMENTS)])
        sandwich = covariance @ (segments.T @ segments) @ covariance
        wider = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(covariance), 1.0))
        covariance = np.asarray(covariance * np.outer(wider, wider))
    made = PlantFit(constants, covariance, noise, passed, whiteness)
    sigma = made.sigma("gain")
    gain = f"{constants.gain:.3g} +- {sigma:.2g} rad/s^2/A"
    if sigma > _MAX_GAIN_ERROR * abs(constants.gain):
        raise IdentificationError(
            f"this flight does not determine the torque constant ({gain}): fly longer or with more current"
        )
    if constants.gain < 0.0:
        raise IdentificationError(
            f"the coil on x rotates the body in the opposite direction ({gain}): "
            "check the `sign` of `coils.windings` and the direction of the field"
        )
    return made


def _step(passed: Innovations, constants: MotionConstants) -> tuple[FloatArray, FloatArray]:
    j = passed.whiten(passed.gradient).reshape(-1, len(NAMES))
    prior = _PRIOR_SIGMA**-2.0
    information = j.T @ j + np.diag(prior)
    right = j.T @ passed.whitened.reshape(-1) - np.where(prior > 0.0, prior * constants.to_array(), 0.0)
    return _inverse(information) @ right, information


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix. Raises IdentificationError for a singular matrix."""
    scale = 1.0 / np.sqrt(np.diag(information))
    correlation = information * np.outer(scale, scale)
    if not np.all(np.isfinite(correlation)) or np.linalg.cond(correlation) > 1e12:
        raise IdentificationError("the constants cannot be separated: the body hardly moved")
    return np.asarray(np.linalg.inv(correlation) * np.outer(scale, scale))


def _noise(
    record: Record,
    constants: MotionConstants,
    noise: MotionNoise,
    assumed: MotionNoise,
    restarts: frozenset[int],
) -> MotionNoise:
    """Return the noise levels after one step of Fisher scoring."""
    at = noise.to_logarithms()
    here = innovations(record, constants, noise, restarts, with_gradient=False)
    inverse = np.linalg.inv(here.covariance)
    weighted = np.einsum("nij,nj->ni", inverse, here.error)
    error_by, relative, score = [], [], []
    for index in range(len(at)):
        moved = at.copy()
        moved[index] += _NOISE_STEP
        there = innovations(
            record, constants, MotionNoise.of_logarithms(moved), restarts, with_gradient=False
        )
        error_by.append((there.error - here.error) / _NOISE_STEP)
        change = (there.covariance - here.covariance) / _NOISE_STEP
        relative.append(inverse @ change)
        quadratic = np.einsum("ni,nij,nj->", weighted, change, weighted)
        trace = np.einsum("nii->", relative[-1])
        score.append(0.5 * (quadratic - trace) - np.sum(weighted * error_by[-1]))
    information = np.array(
        [
            [
                0.5 * np.einsum("nij,nji->", relative[i], relative[k])
                + np.einsum("ni,nij,nj->", error_by[i], inverse, error_by[k])
                for k in range(len(at))
            ]
            for i in range(len(at))
        ]
    )
    right = np.array(score) - (at - assumed.to_logarithms()) / _NOISE_PRIOR**2
    step = np.linalg.solve(information + np.eye(len(at)) / _NOISE_PRIOR**2, right)
    return MotionNoise.of_logarithms(at + np.clip(step, -1.0, 1.0))


def _whiteness(whitened: FloatArray) -> Whiteness:
    """Apply the test of Ljung and Box to each column of innovations (n, 2)."""
    count = len(whitened)
    variance = np.mean(whitened**2, axis=0)
    lags = np.arange(1, _LAGS + 1)
    products = np.array([np.sum(whitened[lag:] * whitened[:-lag], axis=0) for lag in lags.tolist()])
    correlation = products / (count * variance)
    q = count * (count + 2.0) * np.sum(correlation**2 / (count - lags)[:, None], axis=0)
    angle, rate = gammaincc(0.5 * _LAGS, 0.5 * q).tolist()
    return Whiteness((float(variance[0]), float(variance[1])), (angle, rate))


INERTIA_ERROR = 0.1
DIPOLE_ERROR = 0.05
FIELD_ERROR = 0.1
MAGNETOMETER_ERROR = 0.02
"""Prior relative errors of inertia, dipole per ampere, field, and the magnetometer's scale factor."""
DURATION = 200.0
"""Default duration (s) of the flight, in which all pauses and each manoeuvre in both directions take
place."""
_MOTION = tuple(NAMES.index(name) for name in ("gain", "torsion", "damping"))
_TIE = np.array([-1.0, 1.0, 1.0, -1.0, 0.0, 0.0])
"""Coefficients of ln J, ln n A, ln B, ln g, kappa and delta in the constraint."""


@dataclass(frozen=True, slots=True)
class PriorValue:
    """A prior value and its relative standard deviation."""

    value: float
    error: float


@dataclass(frozen=True, slots=True)
class PlantPrior:
    """Prior values of inertia (kg m^2), dipole per ampere of the coil on x (m^2) and field (T).

    The value `magnetometer_error` is the relative standard deviation of the magnetometer's scale factor.
    """

    inertia: PriorValue
    dipole: PriorValue
    field: PriorValue
    magnetometer_error: float


@dataclass(frozen=True, slots=True)
class ScaledValue:
    """An estimated value, its standard deviation, and the contribution of its own prior.

    The attribute `own_prior` is the derivative of the value's logarithm with respect to the logarithm of its
    prior. The derivative is 1 if the motion added no information. The attribute `own_prior` is None for a
    value without a prior.
    """

    value: float
    sigma: float
    own_prior: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePlant:
    """Absolute constants of the plant in `knightcube.gnc.guidance.plant`, with uncertainties.

    Attributes:
        inertia: kg m^2.
        dipole: dipole per commanded ampere, n A, m^2.
        field: T.
        torque_constant: torque per current, n A B, N m/A, at theta = 0.
        stiffness: N m/rad.
        damping: N m s/rad.
        field_measured: whether the magnetometer contributed to the field.
        covariance: covariance (6, 6) of ln inertia, ln dipole, ln field, ln gain, torsion and damping; the
            fit determines the last three.
    """

    inertia: ScaledValue
    dipole: ScaledValue
    field: ScaledValue
    torque_constant: ScaledValue
    stiffness: ScaledValue
    damping: ScaledValue
    field_measured: bool
    covariance: FloatArray

    def sources(self) -> dict[str, str]:
        """Return a text about the sources of each constant, by the name of the constant."""
        ratio = "from the motion, multiplied by the inertia"
        found = {"torque_constant": ratio, "stiffness": ratio, "damping": ratio}
        prior = "magnetometer and prior" if self.field_measured else "prior"
        for name, own, others in (
            ("inertia", "prior", "dipole and field"),
            ("dipole", "prior", "inertia and field"),
            ("field", prior, "inertia and dipole"),
        ):
            share = 100.0 * (getattr(self, name).own_prior or 0.0)
            found[name] = f"{share:.0f} % {own}, {100.0 - share:.0f} % motion with {others}"
        return found


def absolute(found: PlantFit, prior: PlantPrior, measured: HorizontalField | None) -> AbsolutePlant:
    """Return the plant from a fit, prior values and the measured field."""
    values = prior.inertia, prior.dipole, _field(prior, measured)
    fitted = found.constants
    mean = np.array(
        [*(math.log(one.value) for one in values), math.log(fitted.gain), fitted.torsion, fitted.damping]
    )
    per_unit = np.array([1.0 / fitted.gain, 1.0, 1.0])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([one.error**2 for one in values])
    covariance[3:, 3:] = found.covariance[np.ix_(_MOTION, _MOTION)] * np.outer(per_unit, per_unit)
    spread = float(_TIE @ covariance @ _TIE)
    correction = covariance @ _TIE / spread
    mean = mean - correction * float(_TIE @ mean)
    shares = [1.0 - float(covariance[i, i]) / spread for i in range(3)]
    covariance = covariance - np.outer(correction, _TIE @ covariance)
    inertia, dipole, strength = (float(value) for value in np.exp(mean[:3]))
    torsion, damping = float(mean[4]), float(mean[5])
    sigma = [math.sqrt(float(covariance[i, i])) for i in range(3)]

    def scaled(value: float, gradient: dict[int, float]) -> ScaledValue:
        by = np.zeros(len(covariance))
        by[list(gradient)] = list(gradient.values())
        return ScaledValue(value, math.sqrt(float(by @ covariance @ by)))

    return AbsolutePlant(
        inertia=ScaledValue(inertia, inertia * sigma[0], shares[0]),
        dipole=ScaledValue(dipole, dipole * sigma[1], shares[1]),
        field=ScaledValue(strength, strength * sigma[2], shares[2]),
        torque_constant=scaled(dipole * strength, {1: dipole * strength, 2: dipole * strength}),
        stiffness=scaled(inertia * torsion, {0: inertia * torsion, 4: inertia}),
        damping=scaled(inertia * damping, {0: inertia * damping, 5: inertia}),
        field_measured=measured is not None,
        covariance=covariance,
    )


def _field(prior: PlantPrior, measured: HorizontalField | None) -> PriorValue:
    """Return the field as the weighted mean of its prior value and the magnetometer's value."""
    own = prior.field
    if measured is None or measured.magnitude <= 0.0:
        return own
    error = math.hypot(prior.magnetometer_error, measured.sigma / measured.magnitude)
    weights = np.array([own.error, error]) ** -2.0
    logarithm = weights @ np.log([own.value, measured.magnitude]) / np.sum(weights)
    return PriorValue(float(np.exp(logarithm)), float(np.sum(weights) ** -0.5))


def excitation_config(config: TestbedConfig, duration: float) -> TestbedConfig:
    """Return `config` changed for identification: `duration` s of excitation, without camera and paths."""
    return configuration.replace(
        config,
        name=f"identify {config.name}"[:64],
        camera=None,
        guidance=configuration.replace(config.guidance, strategy="step"),
        control=configuration.replace(config.control, tracker="excitation"),
        steps=(Step(at=0.0, q2=0.0),),
        duration=duration,
    )


def config_text(config: TestbedConfig) -> str:
    """Return a configuration as text for `flight.schema.reader`."""
    return to_yaml(msgspec.to_builtins(config))


def prior_of(config: TestbedConfig) -> PlantPrior:
    """Return the prior values of a configuration with their errors."""
    plant = config.plant
    return PlantPrior(
        inertia=PriorValue(plant.inertia, INERTIA_ERROR),
        dipole=PriorValue(plant.coil_turns * plant.coil_area, DIPOLE_ERROR),
        field=PriorValue(plant.field, FIELD_ERROR),
        magnetometer_error=MAGNETOMETER_ERROR,
    )


def configured_constants(config: TestbedConfig) -> MotionConstants:
    """Return the configured constants of the motion, each divided by the configured inertia."""
    plant = config.plant
    gain = plant.coil_turns * plant.coil_area * plant.field / plant.inertia
    stiffness, damping = plant.thread_stiffness / plant.inertia, plant.thread_damping / plant.inertia
    return MotionConstants(gain, stiffness, damping)


def noise_of(config: TestbedConfig) -> MotionNoise:
    """Return the noise levels from a configuration, which are the initial values of a fit."""
    unit = config.inertial_unit
    return MotionNoise(max(config.estimation.current_noise, 1e-4), unit.angle_noise, unit.rate_noise)


def plant_section(plant: AbsolutePlant, coil_turns: int) -> Plant:
    """Return the section `plant` of a configuration. Negative stiffness or damping is set to zero."""
    return Plant(
        inertia=plant.inertia.value,
        coil_turns=coil_turns,
        coil_area=plant.dipole.value / coil_turns,
        field=plant.field.value,
        thread_stiffness=max(plant.stiffness.value, 0.0),
        thread_damping=max(plant.damping.value, 0.0),
    )


def plant_text(plant: AbsolutePlant, coil_turns: int, origin: str) -> str:
    """Return the section `plant` as YAML text with uncertainties, sources and the flight `origin`."""
    section, sources = plant_section(plant, coil_turns), plant.sources()
    area = replace(plant.dipole, sigma=plant.dipole.sigma / coil_turns)
    text = [f"# Made by `knightcube identify` from {origin}; +- is 1 sigma.", "plant:"]
    for name, found, unit, source in (
        ("inertia", plant.inertia, "kg m^2", sources["inertia"]),
        ("coil_turns", None, "", ""),
        ("coil_area", area, "m^2", sources["dipole"]),
        ("field", plant.field, "T", sources["field"]),
        ("thread_stiffness", plant.stiffness, "N m/rad", sources["stiffness"]),
        ("thread_damping", plant.damping, "N m s/rad", sources["damping"]),
    ):
        value = getattr(section, name)
        if found is None:
            number, comment = str(value), "from the configuration"
        elif found.value < 0.0:
            number = f"{value:.6e}"
            comment = f"{unit}: the fit gives {found.value:.2g} +- {found.sigma:.2g}, set to zero"
        else:
            number, comment = f"{value:.6e}", f"{unit} +- {found.sigma:.2g}: {source}"
        text.append(f"  {name + ': ' + number:34s}# {comment}")
    return "\n".join(text) + "\n"
