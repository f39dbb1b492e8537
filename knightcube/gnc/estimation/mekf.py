"""The correction of a multiplicative extended Kalman filter by one measurement.

The attitude error is a small rotation about the body axes (Lefferts, Markley and Shuster 1982), moved into
the quaternion at each correction; the covariance is then rotated to the new axes (Markley and Crassidis 2014,
6.2.4: the reset). The rate is a state driven by Euler's equation, because the plant model predicts it more
accurately than the gyro measures it. Past attitudes that later measurements need are appended to the state
(stochastic cloning, Roumeliotis and Burdick 2002).

The age of the inertial unit's samples at their time stamp is a constant that the filter estimates. The line,
a driver's buffer or the unit's own filters make a sample older than its stamp. An attitude sample of some age
lacks rate times age of rotation, and a rate sample acceleration times age; the innovations therefore depend
on the age. Attitudes estimate the age. The acceleration at a rate sample is mostly that of the coils, which
respond to the noise of earlier samples: an estimate from rates would be identification in closed loop, and
the age would drift with the noise while the attitude is held. For rates the age is therefore considered
(Schmidt 1966) and not estimated: its variance and correlations enter the gains of all other states.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    DISTURBANCE,
    FIELD_BIAS,
    LATENCY,
    PARAMETERS,
    SIZE,
    FilterState,
    Parameters,
)
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    DirectionMeasurement,
    FieldMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import Accelerated
from knightcube.gnc.estimation.rotation import (
    Vector,
    added,
    compose,
    exponential,
    inverse,
    logarithm,
    matrix,
    skew,
    times,
    twist,
)

LONGEST_LATENCY = 0.25
"""Largest plausible latency, s."""

_ACCELERATIONS = slice(DISTURBANCE.start, PARAMETERS.stop)
_BY_ACCELERATIONS: FloatArray = np.eye(3, 6)
_EYE: FloatArray = np.eye(3)


class RateChange(NamedTuple):
    """The change of the rate around the time of a sample.

    `acceleration` is in rad/s^2. `uncertainty` (3, 3) rad^2/s^2 is the covariance of the rate by effects that
    are not linear in the age.
    """

    acceleration: Vector
    uncertainty: FloatArray


def rate_change(
    before: Accelerated, after: Accelerated, disturbance: Vector, covariance: FloatArray
) -> RateChange:
    """Return the change of the rate with the age, from the model one sigma of the age before and after.

    Half the difference of the two accelerations, as by a command that begins or ends between them, is treated
    as noise. So is the product of the errors of age and acceleration.
    """
    pairs = zip(before.acceleration, after.acceleration, disturbance, strict=True)
    x, y, z = (0.5 * (a + b) + d for a, b, d in pairs)
    rows = _BY_ACCELERATIONS.copy()
    rows[:, 3:] = before.by_parameters
    if after is not before:
        rows[:, 3:] = 0.5 * (rows[:, 3:] + after.by_parameters)
    spread = rows.dot(covariance[_ACCELERATIONS, _ACCELERATIONS]).dot(rows.T)
    if after is not before:
        bend = 0.5 * (np.array(after.acceleration) - before.acceleration)
        spread += bend[:, np.newaxis] * bend
    spread *= covariance[LATENCY, LATENCY]
    return RateChange((x, y, z), spread)


def aged(more: float, change: Vector, value: Vector, rows: FloatArray) -> tuple[Vector, FloatArray]:
    """Return innovation and rows, corrected for age, of a quantity that changes by `change` per second.

    `more` is the difference between the estimated age and the age subtracted from the time stamp, s.
    """
    x, y, z = change
    rows = rows.copy()
    rows[:, LATENCY] = -x, -y, -z
    return (value[0] + more * x, value[1] + more * y, value[2] + more * z), rows


class Innovation(NamedTuple):
    """The innovation y = H error + noise: `value` y, `rows` H, `noise` its covariance R."""

    value: tuple[float, ...]
    rows: FloatArray
    noise: FloatArray


def innovation(
    state: FilterState, measurement: Measurement, suspended: bool, change: RateChange | None = None
) -> Innovation:
    """Return the innovation of `measurement`; for a suspended body, only its component about the thread.

    A direction is compared in the plane across it: its covariance along the direction has no effect. A field
    is compared as a vector, because its strength depends on the magnetometer's bias too. `change` is needed
    for a rate whose age is estimated.
    """
    size, noise = SIZE + 3 * len(state.kept), measurement.covariance
    # Rotations of a suspended body about x and z have no variance, so whole directions and fields apply too.
    if isinstance(measurement, DirectionMeasurement):
        return _direction(state, measurement, size)
    if isinstance(measurement, FieldMeasurement):
        return _field(state, measurement, size)
    if isinstance(measurement, RateMeasurement):
        x, y, z = measurement.rate.tolist()
        (wx, wy, wz), (bx, by, bz) = state.rate, state.bias
        value: Vector = (x - wx - bx, y - wy - by, z - wz - bz)
        rows = _rows((3, 6), size)
        if measurement.latency is not None and change is not None:
            more = state.latency - measurement.latency
            value, rows = aged(more, change.acceleration, value, rows)
            noise = noise + change.uncertainty
    elif isinstance(measurement, AttitudeMeasurement):
        a, b, c, d = measurement.quaternion.tolist()
        between = compose((a, b, c, d), inverse(state.quaternion))
        value = (0.0, twist(between), 0.0) if suspended else logarithm(between)
        rows = _rows((0,), size)
        if measurement.latency is not None:
            value, rows = aged(state.latency - measurement.latency, state.rate, value, rows)
    else:
        value, rows = _mean_rate(state, measurement, size)
    if suspended:
        return Innovation(value[1:2], rows[1:2], noise[1:2, 1:2])
    return Innovation(value, rows, noise)


def _mean_rate(state: FilterState, measurement: MeanRateMeasurement, size: int) -> tuple[Vector, FloatArray]:
    """Return innovation and rows of the mean rate between the kept attitude and the present one.

    The rotation vector p from one to the other changes by Jr^-1(p) (e - A e_0), where e and e_0 are the
    errors of the present and the kept attitude.
    """
    span = (measurement.time_ns - measurement.since_ns) * 1e-9
    index = state.kept_index(measurement)
    between = compose(state.quaternion, inverse(state.kept[index][1]))
    px, py, pz = logarithm(between)
    x, y, z = measurement.rate.tolist()
    square = px * px + py * py + pz * pz
    angle = math.sqrt(square)
    # 1/p^2 - (1 + cos p) / (2 p sin p) tends to 1/12, and differs by less than 1e-6 below 0.03 rad.
    second = 1.0 / 12.0 if angle < 0.03 else 1.0 / square - 0.5 / (angle * math.tan(0.5 * angle))
    by_error = np.array(skew((px, py, pz)))
    by_error = (_EYE + 0.5 * by_error + second * (by_error @ by_error)) / span
    rows = np.zeros((3, size))
    rows[:, ATTITUDE] = by_error
    first = SIZE + 3 * index
    rows[:, first : first + 3] = -by_error @ np.array(matrix(between))
    return (x - px / span, y - py / span, z - pz / span), rows


def _direction(state: FilterState, measurement: DirectionMeasurement, size: int) -> Innovation:
    """Return innovation and rows of a direction.

    With the estimated attitude A and its error e, b is A r - e x A r: in the plane across A r, b - A r is
    [A r x] e.
    """
    rx, ry, rz = measurement.reference.tolist()
    expected = times(matrix(state.quaternion), (rx, ry, rz))
    across = tangent_basis(expected)
    rows = np.zeros((2, size))
    rows[:, ATTITUDE] = across @ np.array(skew(expected))
    first, second = (across @ measurement.observed).tolist()
    return Innovation((first, second), rows, across @ measurement.covariance @ across.T)


def _field(state: FilterState, measurement: FieldMeasurement, size: int) -> Innovation:
    """Return innovation and rows of a magnetometer reading: m - A B - bias."""
    bx, by, bz = measurement.reference.tolist()
    expected = times(matrix(state.quaternion), (bx, by, bz))
    rows = np.zeros((3, size))
    rows[:, ATTITUDE] = skew(expected)
    rows[:, FIELD_BIAS] = _EYE
    (mx, my, mz), (ex, ey, ez), (hx, hy, hz) = measurement.field.tolist(), expected, state.field_bias
    return Innovation((mx - ex - hx, my - ey - hy, mz - ez - hz), rows, measurement.covariance)


@functools.cache
def _rows(firsts: tuple[int, ...], size: int) -> FloatArray:
    """Return the rows (3, size) of a sum of parts of the error state, given by their first indices."""
    rows = np.zeros((3, size))
    for first in firsts:
        rows[:, first : first + 3] += _EYE
    return rows


def normalised_square(found: Innovation, covariance: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return y^T S^-1 y, a chi-square with the degrees of freedom of y; the gain P H^T S^-1; and S."""
    cross = covariance.dot(found.rows.T)
    spread = found.rows.dot(cross) + found.noise
    weight = _inverted(spread)
    y = np.array(found.value)
    return float(y @ weight @ y), cross.dot(weight), spread


def correct(
    state: FilterState, covariance: FloatArray, found: Innovation, gain: FloatArray
) -> tuple[FilterState, FloatArray]:
    """Return the corrected state and covariance, by Joseph's form, symmetric and positive."""
    # ndarray.dot takes two thirds of the time of @ for small matrices.
    keep = _identity(len(covariance)) - gain.dot(found.rows)
    error = gain.dot(found.value).tolist()
    # The reset: the remaining error refers to axes rotated by half the correction.
    for first in (0, *range(SIZE, len(covariance), 3)):
        x, y, z = error[first : first + 3]
        reset = np.array(((1.0, 0.5 * z, -0.5 * y), (-0.5 * z, 1.0, 0.5 * x), (0.5 * y, -0.5 * x, 1.0)))
        keep[first : first + 3] = reset.dot(keep[first : first + 3])
        gain[first : first + 3] = reset.dot(gain[first : first + 3])
    covariance = keep.dot(covariance).dot(keep.T)
    covariance += gain.dot(found.noise).dot(gain.T)
    covariance = covariance + covariance.T
    covariance *= 0.5
    corrected = FilterState(
        compose(exponential(*error[0:3]), state.quaternion),
        added(state.rate, error[3:6]),
        added(state.bias, error[6:9]),
        added(state.disturbance, error[9:12]),
        Parameters(*added(state.parameters, error[12:15])),
        tuple(
            (measurement, compose(exponential(*error[first : first + 3]), quaternion))
            for first, (measurement, quaternion) in zip(range(SIZE, len(error), 3), state.kept, strict=True)
        ),
        state.latency + error[LATENCY],
        added(state.field_bias, error[FIELD_BIAS]),
    )
    return corrected, covariance


def keep_attitude(
    state: FilterState, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[FilterState, FloatArray]:
    """Return state and covariance with the present attitude appended, for the exposure that begins now."""
    pick = [*range(len(covariance)), 0, 1, 2]
    kept = (*state.kept, (measurement, state.quaternion))
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


def release_attitude(
    state: FilterState, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[FilterState, FloatArray]:
    """Return state and covariance without the attitude that was kept for an exposure."""
    index = state.kept_index(measurement)
    first = SIZE + 3 * index
    pick = [*range(first), *range(first + 3, len(covariance))]
    kept = state.kept[:index] + state.kept[index + 1 :]
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


@functools.cache
def _identity(size: int) -> FloatArray:
    return np.eye(size)


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
