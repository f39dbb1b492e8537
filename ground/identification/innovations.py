"""Innovations of a record under assumed constants, with their derivatives by the constants.

The motion per inertia is theta'' = g I cos(theta) - kappa theta - delta theta' + d, each change of the
current late by tau; measured are theta and theta' + b (Sease 2013, 5.4 with the thread). The current on the
wire is not quite the one in the coil: a coil that is on adds process noise, a coil that is off adds none. So
the predictor is the extended Kalman filter of the two states (the prediction-error method, Ljung 1999, System
Identification, 7.2 and 10.2): an output-error fit would take that noise, summed up in flight, for signal.

Between events angle and rate are carried by their Taylor series; what that leaves out is a ten-thousandth of
the noise. The derivatives follow the filter through prediction and update with its gains held: that those
depend on the constants too leaves the expectation of the gradient at zero.

What no noise explains - the hand that lets the body go, a jolt, a wild sample - is skipped: there the
filter restarts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ground.identification.constants import NAMES, Constants, Noise
from ground.identification.record import Record
from ground.identification.timeline import Timeline
from knightcube.astro.arrays import FloatArray, IntArray

_BIAS, _DELAY = NAMES.index("bias"), NAMES.index("delay")
_Pair = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """One pass over a record of n samples; the first starts the filter and has no innovation.

    Attributes:
        error: (n - 1, 2), measured less predicted angle and rate.
        covariance: (n - 1, 2, 2) of them.
        gradient: (n - 1, 2, 6), of the prediction by the constants; (0, 2, 6) when not asked for.
        taken: (n - 1,) indices of the samples they are of.
        restarts: indices of the samples at which the filter restarted, without an innovation.
    """

    error: FloatArray
    covariance: FloatArray
    gradient: FloatArray
    taken: IntArray
    restarts: frozenset[int]

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """Return `vectors` (n - 1, 2, k) in units in which the innovations should be white, of variance 1."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.covariance), vectors))

    @property
    def whitened(self) -> FloatArray:
        """The innovations (n - 1, 2) in those units."""
        return self.whiten(self.error[..., None])[..., 0]


def innovations(
    record: Record,
    constants: Constants,
    noise: Noise,
    restarts: frozenset[int] = frozenset(),
    gate: float = math.inf,
    with_gradient: bool = True,
) -> Innovations:
    """Run the filter over `record` with `constants` and `noise` believed true.

    It restarts at the samples `restarts`, and where an innovation is beyond `gate` standard deviations.
    """
    angle, rate = record.angle.tolist(), record.rate.tolist()
    predictor = _Predictor(constants, noise, record.period, with_gradient)
    predictor.start(angle[0], rate[0])
    made = []
    gone_over = set(restarts)
    for span, current, variance, sample, jump in _rows(Timeline.of(record, constants.delay)):
        if span > 0.0:
            predictor.carry(span, current, variance)
        if sample >= 0:
            if sample in gone_over or predictor.distance(angle[sample], rate[sample]) > gate:
                gone_over.add(sample)
                predictor.start(angle[sample], rate[sample])
            else:
                gradient = predictor.gradient() if with_gradient else ()
                made.append((*predictor.take(angle[sample], rate[sample]), gradient, sample))
        if jump and with_gradient:
            predictor.note_switch(jump)
    errors, covariances, gradients, taken = zip(*made, strict=True)
    return Innovations(
        np.array(errors),
        np.array(covariances).reshape(-1, 2, 2),
        np.array(gradients if with_gradient else ()).reshape(-1, 2, len(NAMES)),
        np.array(taken),
        frozenset(gone_over),
    )


def _rows(timeline: Timeline) -> Iterator[tuple[float, float, float, int, float]]:
    return zip(
        timeline.span.tolist(),
        timeline.current.tolist(),
        timeline.variance.tolist(),
        timeline.sample.tolist(),
        timeline.jump.tolist(),
        strict=True,
    )


class _Predictor:
    """Angle and rate, their covariance, and their derivatives by the constants."""

    def __init__(self, constants: Constants, noise: Noise, period: float, with_gradient: bool) -> None:
        self._constants = constants
        self._walk = (constants.gain * noise.current) ** 2 * period
        self._r_angle, self._r_rate = noise.angle**2, noise.rate**2
        self._with_gradient = with_gradient
        self._bias_row = np.zeros(len(NAMES))
        self._bias_row[_BIAS] = 1.0

    def start(self, angle: float, rate: float) -> None:
        """Start, or restart, from a sample."""
        self._angle, self._rate = angle, rate - self._constants.bias
        self._paa, self._pab, self._pbb = self._r_angle, 0.0, self._r_rate
        self._by_angle, self._by_rate = np.zeros(len(NAMES)), -self._bias_row

    def distance(self, angle: float, rate: float) -> float:
        """Return how far a sample is from its prediction, in standard deviations of the farther reading."""
        by_angle = (angle - self._angle) ** 2 / (self._paa + self._r_angle)
        by_rate = (rate - self._rate - self._constants.bias) ** 2 / (self._pbb + self._r_rate)
        return math.sqrt(max(by_angle, by_rate))

    def carry(self, span: float, current: float, variance: float) -> None:
        """Predict `span` s on, under `current` A whose variance is `variance` times the usual."""
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
        """Return the derivatives (6,) of the predicted angle and of the predicted reading of the gyro."""
        return self._by_angle, self._by_rate + self._bias_row

    def take(self, angle: float, rate: float) -> tuple[_Pair, tuple[float, float, float, float]]:
        """Take a sample; return its innovation and that one's covariance."""
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
        """Let the rate depend on the delay: had the current changed later, the old one had acted longer."""
        self._by_rate = self._by_rate.copy()
        self._by_rate[_DELAY] -= self._constants.gain * math.cos(self._angle) * jump
