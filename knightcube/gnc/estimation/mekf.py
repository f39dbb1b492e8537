"""The correction of a multiplicative extended Kalman filter, and the past attitudes that it keeps.

The error of the attitude is a small turn about the body's axes (Lefferts, Markley and Shuster 1982), moved
into the quaternion at each correction; the covariance is then rotated to the new axes (Markley and Crassidis
2014, 6.2.4: the reset). The rate is a state driven by Euler's equation instead of the gyro, because the plant
model makes it better than the gyro's. Past attitudes that are still needed are appended to the state
(stochastic cloning, Roumeliotis and Burdick 2002).
"""

from __future__ import annotations

import functools

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import FIELD_BIAS, LATENCY, RATE
from knightcube.gnc.estimation.innovation import Innovation
from knightcube.gnc.estimation.measurements import MeanRateMeasurement
from knightcube.gnc.estimation.rigid_body import Parameters
from knightcube.gnc.estimation.state import SIZE, State, place_of
from knightcube.gnc.estimation.turn import Vector, compose, exponential


def normalised_square(found: Innovation, covariance: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return y^T S^-1 y, a chi-square with the degrees of freedom of y; the gain P H^T S^-1; and S."""
    cross = covariance.dot(found.rows.T)
    spread = found.rows.dot(cross) + found.noise
    weight = _inverted(spread)
    y = np.array(found.value)
    return float(y @ weight @ y), cross.dot(weight), spread


def correct(
    state: State, covariance: FloatArray, found: Innovation, gain: FloatArray
) -> tuple[State, FloatArray]:
    """Return the corrected state and covariance, by Joseph's form, symmetric and positive."""
    # ndarray.dot takes two thirds of the time of @ for matrices as small as these.
    keep = _identity(len(covariance)) - gain.dot(found.rows)
    error = gain.dot(found.value).tolist()
    # The reset: the remaining turn refers to axes turned by half the correction.
    for first in (0, *range(SIZE, len(covariance), 3)):
        x, y, z = error[first : first + 3]
        reset = np.array(((1.0, 0.5 * z, -0.5 * y), (-0.5 * z, 1.0, 0.5 * x), (0.5 * y, -0.5 * x, 1.0)))
        keep[first : first + 3] = reset.dot(keep[first : first + 3])
        gain[first : first + 3] = reset.dot(gain[first : first + 3])
    covariance = keep.dot(covariance).dot(keep.T)
    covariance += gain.dot(found.noise).dot(gain.T)
    covariance = covariance + covariance.T
    covariance *= 0.5
    corrected = State(
        compose(exponential(*error[0:3]), state.quaternion),
        _sum(state.rate, error[3:6]),
        _sum(state.bias, error[6:9]),
        _sum(state.disturbance, error[9:12]),
        Parameters(*_sum(state.parameters, error[12:15])),
        tuple(
            (measurement, compose(exponential(*error[first : first + 3]), quaternion))
            for first, (measurement, quaternion) in zip(range(SIZE, len(error), 3), state.kept, strict=True)
        ),
        state.latency + error[LATENCY],
        _sum(state.field_bias, error[FIELD_BIAS]),
    )
    return corrected, covariance


def of_the_rate_alone(gain: FloatArray) -> FloatArray:
    """Return a gain that corrects the rate and leaves all else as it is; Joseph's form stays right for it."""
    alone = np.zeros_like(gain)
    alone[RATE] = gain[RATE]
    return alone


def keep_attitude(
    state: State, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[State, FloatArray]:
    """Append the present attitude, for the end of the exposure that begins now."""
    pick = [*range(len(covariance)), 0, 1, 2]
    kept = (*state.kept, (measurement, state.quaternion))
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


def release_attitude(
    state: State, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[State, FloatArray]:
    """Remove the attitude that was kept for this exposure."""
    place = place_of(state, measurement)
    first = SIZE + 3 * place
    pick = [*range(first), *range(first + 3, len(covariance))]
    kept = state.kept[:place] + state.kept[place + 1 :]
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


@functools.cache
def _identity(size: int) -> FloatArray:
    return np.eye(size)


def _sum(a: Vector, b: list[float]) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _inverted(s: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric (1, 1), (2, 2) or (3, 3) matrix, by cofactors."""
    if len(s) == 1:
        return np.asarray(1.0 / s)
    if len(s) == 2:
        (a, b), (_, d) = s.tolist()
        scale = 1.0 / (a * d - b * b)
        return np.array(((scale * d, -scale * b), (-scale * b, scale * a)))
    (a, b, c), (_, d, e), (_, _, f) = s.tolist()
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * ca + b * cb + c * cc)
    return np.asarray(np.array(((ca, cb, cc), (cb, cd, ce), (cc, ce, cf))) * scale)
