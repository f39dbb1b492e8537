"""The correction of a multiplicative extended Kalman filter by one measurement.

The attitude error is a small rotation about the body axes (Lefferts, Markley and Shuster 1982). Each
correction applies the estimated error to the quaternion and then rotates the covariance to the corrected axes
(the reset of Markley and Crassidis 2014, section 6.2.4). The rate is a state of the filter that is propagated
by Euler's equation, because the plant model predicts the rate more accurately than the gyro measures it. Past
attitudes that later measurements need are appended to the state (stochastic cloning, Roumeliotis and Burdick
2002).

The filter estimates the age that the inertial unit's samples have at their time stamps, because of the delays
of the serial line, the driver's buffer and the filters inside the inertial unit. Between sample and time
stamp, the attitude changes by rate times age, and the rate changes by acceleration times age. Only attitude
samples correct the estimated age. The acceleration is mostly caused by the coils, which respond to the noise
of earlier samples. An estimate of the age from rate samples would be a closed-loop identification and would
drift with the noise while the attitude is held. A rate sample therefore treats the age as a considered
parameter (Schmidt 1966): its variance and correlations enter the gains of all other states.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.quaternion import (
    Vector,
    compose,
    exponential,
    inverse,
    logarithm,
    matrix,
    skew,
    times,
    twist,
)
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.gnc.estimation.error_state import reset, updated, weigh
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    FIELD_BIAS,
    LATENCY,
    RATE,
    SIZE,
    AttitudeMeasurement,
    DirectionMeasurement,
    FieldMeasurement,
    FilterState,
    MeanRateMeasurement,
    Measurement,
    Parameters,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import RateChange

LONGEST_LATENCY = 0.25
"""Largest plausible age (s) of an inertial unit's sample at its time stamp."""

_EYE: FloatArray = np.eye(3)


def aged(more: float, change: Vector, value: Vector, rows: FloatArray) -> tuple[Vector, FloatArray]:
    """Return innovation and Jacobian, corrected for age, of a quantity with the time derivative `change`.

    The argument `more`, s, is the estimated age minus the age subtracted from the time stamp.
    """
    x, y, z = change
    rows = rows.copy()
    rows[:, LATENCY] = -x, -y, -z
    return (value[0] + more * x, value[1] + more * y, value[2] + more * z), rows


class Innovation(NamedTuple):
    """An innovation y = H e + n, with `value` y, Jacobian `rows` H and the covariance `noise` of n."""

    value: tuple[float, ...]
    rows: FloatArray
    noise: FloatArray


def innovation(
    state: FilterState, measurement: Measurement, suspended: bool, change: RateChange | None = None
) -> Innovation:
    """Return the innovation of `measurement`; for a suspended body, only its component about the thread.

    The innovation of a direction lies in the plane normal to the direction. The innovation of a magnetic
    field has three components, because the field strength also depends on the magnetometer's bias. The
    argument `change` is needed for rate samples whose age is estimated.
    """
    size, noise = SIZE + 3 * len(state.kept), measurement.covariance
    # Directions and fields need no projection, as a suspended body has no attitude variance about x and z.
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
    """Return innovation and Jacobian of the mean rate between the stored and the present attitude.

    The rotation vector p between the stored and the present attitude changes by Jr^-1(p) (e - A e_0), where e
    and e_0 are the errors of the present and the stored attitude.
    """
    span = (measurement.time_ns - measurement.since_ns) * 1e-9
    index = state.kept_index(measurement)
    between = compose(state.quaternion, inverse(state.kept[index][1]))
    px, py, pz = logarithm(between)
    x, y, z = measurement.rate.tolist()
    square = px * px + py * py + pz * pz
    angle = math.sqrt(square)
    # The factor 1/p^2 - (1 + cos p) / (2 p sin p) is within 1e-6 of its limit 1/12 below 0.03 rad.
    second = 1.0 / 12.0 if angle < 0.03 else 1.0 / square - 0.5 / (angle * math.tan(0.5 * angle))
    by_error = np.array(skew((px, py, pz)))
    by_error = (_EYE + 0.5 * by_error + second * (by_error @ by_error)) / span
    rows = np.zeros((3, size))
    rows[:, ATTITUDE] = by_error
    first = SIZE + 3 * index
    rows[:, first : first + 3] = -by_error @ np.array(matrix(between))
    return (x - px / span, y - py / span, z - pz / span), rows


def _direction(state: FilterState, measurement: DirectionMeasurement, size: int) -> Innovation:
    """Return the innovation of a direction.

    For the estimated attitude A with the error e, the observed direction is b = A r - e x A r. In the plane
    normal to A r, the innovation b - A r is therefore [A r x] e.
    """
    rx, ry, rz = measurement.reference.tolist()
    expected = times(matrix(state.quaternion), (rx, ry, rz))
    across = tangent_basis(expected)
    rows = np.zeros((2, size))
    rows[:, ATTITUDE] = across @ np.array(skew(expected))
    first, second = (across @ measurement.observed).tolist()
    return Innovation((first, second), rows, across @ measurement.covariance @ across.T)


def _field(state: FilterState, measurement: FieldMeasurement, size: int) -> Innovation:
    """Return the innovation m - A B - bias of a magnetometer reading m."""
    bx, by, bz = measurement.reference.tolist()
    expected = times(matrix(state.quaternion), (bx, by, bz))
    rows = np.zeros((3, size))
    rows[:, ATTITUDE] = skew(expected)
    rows[:, FIELD_BIAS] = _EYE
    (mx, my, mz), (ex, ey, ez), (hx, hy, hz) = measurement.field.tolist(), expected, state.field_bias
    return Innovation((mx - ex - hx, my - ey - hy, mz - ez - hz), rows, measurement.covariance)


@functools.cache
def _rows(firsts: tuple[int, ...], size: int) -> FloatArray:
    """Return the Jacobian (3, size) of a sum of three-element states with the first indices `firsts`."""
    rows = np.zeros((3, size))
    for first in firsts:
        rows[:, first : first + 3] += _EYE
    return rows


class Correction(NamedTuple):
    """The result of a correction, without changes of state and covariance if the measurement is rejected.

    `square` is the normalised squared innovation, `spread` (k, k) is the covariance of the innovation, and
    the flag `used` is whether the measurement passed the gate.
    """

    state: FilterState
    covariance: FloatArray
    square: float
    spread: FloatArray
    used: bool


def correct(
    state: FilterState,
    covariance: FloatArray,
    found: Innovation,
    gate: float = math.inf,
    rate_gate: float = math.inf,
    *,
    considers_age: bool = False,
) -> Correction:
    """Correct a state by an innovation whose normalised square is at most `gate`.

    Above `rate_gate`, only the rate is corrected. If `considers_age` is true, the age of the inertial unit's
    samples is not corrected. The gain may then differ from the optimal gain, because the covariance update is
    valid for any gain.
    """
    value, rows, noise = found
    used, square, error, covariance, spread = _corrected(
        covariance, np.array(value), rows, noise, gate, rate_gate, considers_age
    )
    if used:
        state = _moved(state, error.tolist())
    return Correction(state, covariance, square, spread, used)


def _moved(state: FilterState, error: list[float]) -> FilterState:
    """Return the state corrected by an estimated error (n,)."""
    q, (wx, wy, wz), (bx, by, bz), (dx, dy, dz), (torsion, damping, gain), kept, age, (fx, fy, fz) = state
    if kept:
        turns = (exponential(*error[first : first + 3]) for first in range(SIZE, len(error), 3))
        kept = tuple((m, compose(turn, then)) for turn, (m, then) in zip(turns, kept, strict=True))
    e = error
    return FilterState(
        compose(exponential(e[0], e[1], e[2]), q),
        (wx + e[3], wy + e[4], wz + e[5]),
        (bx + e[6], by + e[7], bz + e[8]),
        (dx + e[9], dy + e[10], dz + e[11]),
        Parameters(torsion + e[12], damping + e[13], gain + e[14]),
        kept,
        age + e[15],
        (fx + e[16], fy + e[17], fz + e[18]),
    )


def _corrected_numpy(
    covariance: FloatArray,
    value: FloatArray,
    rows: FloatArray,
    noise: FloatArray,
    gate: float,
    rate_gate: float,
    considers_age: bool,
) -> tuple[bool, float, FloatArray, FloatArray, FloatArray]:
    """Return whether the innovation passed the gate, its normalised square, the error, and two covariances.

    The error (n,) and the covariance (n, n) are those of the states; the other covariance (k, k) is that of
    the innovation. The error is zero if the innovation did not pass. The arguments are those of `correct`.
    """
    square, gain, cross, spread = weigh(covariance, value, rows, noise)
    if not 0.0 <= square <= gate:  # a NaN does not pass
        return False, square, np.zeros(len(covariance)), covariance, spread
    if square > rate_gate:
        rate_gain = np.zeros_like(gain)
        rate_gain[RATE] = gain[RATE]
        gain = rate_gain
    elif considers_age:
        gain[LATENCY] = 0.0
    error = gain.dot(value)
    covariance = updated(covariance, gain, cross, spread)
    for first in (0, *range(SIZE, len(covariance), 3)):
        reset(covariance, slice(first, first + 3), error[first : first + 3].tolist())
    return True, square, error, covariance, spread


@compiled_form_of(_corrected_numpy)
def _corrected(
    covariance: FloatArray,
    value: FloatArray,
    rows: FloatArray,
    noise: FloatArray,
    gate: float,
    rate_gate: float,
    considers_age: bool,
) -> tuple[bool, float, FloatArray, FloatArray, FloatArray]:
    """See `_corrected_numpy`. The states 3 to 5 are the rate, and state 15 is the age."""
    size, count = len(covariance), len(value)
    cross, spread = _weighed(covariance, rows, noise)
    gain, error = np.zeros((size, count)), np.zeros(size)
    weight = _inverse(spread)
    square = 0.0
    for k in range(count):
        for m in range(count):
            square += value[k] * weight[k, m] * value[m]
    if not 0.0 <= square <= gate:
        return False, square, error, covariance.copy(), spread
    for i in range(size):
        if (i != 15 or not considers_age) if square <= rate_gate else 3 <= i < 6:
            for k in range(count):
                for m in range(count):
                    gain[i, k] += cross[i, m] * weight[m, k]
                error[i] += gain[i, k] * value[k]
    return True, square, error, _updated(covariance, gain, cross, spread, error), spread


@loop_helper
def _weighed(covariance: FloatArray, rows: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the elements `cross` and `spread` of the result of `error_state.weigh`."""
    count, size = rows.shape
    cross, spread = np.zeros((size, count)), noise.copy()
    for k in range(count):
        for j in range(size):
            if rows[k, j] != 0.0:
                for i in range(size):
                    cross[i, k] += covariance[i, j] * rows[k, j]
    for k in range(count):
        for m in range(count):
            for j in range(size):
                spread[k, m] += rows[k, j] * cross[j, m]
    return cross, spread


@loop_helper
def _inverse(spread: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix (k, k), where k is at most 3, padded to (3, 3)."""
    s = np.eye(3)
    s[: len(spread), : len(spread)] = spread
    a, b, c, d, e, f = s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2]
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    return np.asarray(np.array(((ca, cb, cc), (cb, cd, ce), (cc, ce, cf))) / (a * ca + b * cb + c * cc))


@loop_helper
def _updated(
    covariance: FloatArray, gain: FloatArray, cross: FloatArray, spread: FloatArray, error: FloatArray
) -> FloatArray:
    """Return the result of `error_state.updated`, and of `error_state.reset` for each attitude error."""
    size, count = gain.shape
    reduced, after = cross.copy(), np.empty((size, size))
    for i in range(size):
        for k in range(count):
            for m in range(count):
                reduced[i, k] -= 0.5 * gain[i, m] * spread[m, k]
    for i in range(size):
        for j in range(i + 1):
            total = 0.5 * (covariance[i, j] + covariance[j, i])
            for k in range(count):
                total -= gain[i, k] * reduced[j, k] + gain[j, k] * reduced[i, k]
            after[i, j] = after[j, i] = total
    for place in range(16, size, 3):  # the present attitude, then the attitudes stored for exposures
        first = place if place >= 19 else 0
        _rotate(after[first : first + 3], error[first : first + 3])
        _rotate(after[:, first : first + 3].T, error[first : first + 3])
    return after


@loop_helper
def _rotate(rows: FloatArray, correction: FloatArray) -> None:
    """Rotate attitude errors `rows` (3, n) in place by half the rotation vector `correction` (3,)."""
    x, y, z = 0.5 * correction[0], 0.5 * correction[1], 0.5 * correction[2]
    for j in range(rows.shape[1]):
        a, b, c = rows[0, j], rows[1, j], rows[2, j]
        rows[0, j], rows[1, j], rows[2, j] = a + z * b - y * c, b - z * a + x * c, c + y * a - x * b


def keep_attitude(
    state: FilterState, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[FilterState, FloatArray]:
    """Return state and covariance extended by a copy of the present attitude, as an exposure begins now."""
    pick = [*range(len(covariance)), 0, 1, 2]
    kept = (*state.kept, (measurement, state.quaternion))
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


def release_attitude(
    state: FilterState, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[FilterState, FloatArray]:
    """Return state and covariance without the attitude that was stored for a finished exposure."""
    index = state.kept_index(measurement)
    first = SIZE + 3 * index
    pick = [*range(first), *range(first + 3, len(covariance))]
    kept = state.kept[:index] + state.kept[index + 1 :]
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]
