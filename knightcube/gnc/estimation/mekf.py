"""Multiplicative extended Kalman filter: corrections by measurements, and replay of earlier measurements.

The attitude error is a small rotation about the body axes (Lefferts, Markley and Shuster 1982). Each
correction applies the estimated error to the quaternion and then rotates the covariance to the corrected axes
(the reset of Markley and Crassidis 2014, section 6.2.4). The rate is a state of the filter and is propagated
by Euler's equation, because the plant model predicts the rate more accurately than the gyro measures it. Past
attitudes that later measurements need are appended to the state (stochastic cloning, Roumeliotis and Burdick
2002).

The filter estimates the age of the inertial unit's samples. The age is the delay between measurement and time
stamp, which the serial line, the driver's buffer and the filters inside the inertial unit cause. Between
sample and time stamp, the attitude changes by rate times age, and the rate changes by acceleration times age.
Only attitude samples correct the estimated age. The acceleration is mostly caused by the coils, which respond
to the noise of earlier samples. An estimate of the age from rate samples would be a closed-loop
identification and would drift with the noise while the attitude is held. A rate sample therefore treats the
age as a considered parameter (Schmidt 1966): its variance and correlations enter the gains of all other
states.

The class `Replay` applies measurements in order of time. After a late measurement is inserted, all later
measurements are applied again. Applying the measurements of one second takes longer than a control cycle. The
replay can therefore be distributed over several cycles, during which the filter continues without the late
measurement.
"""

from __future__ import annotations

import bisect
import functools
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray, IntArray, tangent_basis
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
from knightcube.gnc.estimation.error_state import direction_error, reset, updated, weigh, widen
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    BIAS,
    FIELD_BIAS,
    LATENCY,
    RATE,
    SIZE,
    AttitudeMeasurement,
    DirectionMeasurement,
    Estimate,
    FieldMeasurement,
    FilterState,
    MeanRateMeasurement,
    Measurement,
    Parameters,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import (
    ProcessNoise,
    RateChange,
    RigidBody,
    Torquing,
    propagate,
    rate_change,
)

LONGEST_LATENCY = 0.25
"""Largest plausible age (s) of the inertial unit's samples."""

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
    # A suspended body has no attitude variance about x and z, so directions and fields need no projection.
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
    # For p below 0.03 rad, the factor 1/p^2 - (1 + cos p) / (2 p sin p) is within 1e-6 of its limit 1/12.
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
    first, second = direction_error(measurement.observed, np.array(expected), across).tolist()
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
    """The result of a correction; state and covariance are unchanged if the measurement is rejected.

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
    """Correct a state by an innovation if its normalised square is at most `gate`.

    Above `rate_gate`, only the rate is corrected. If `considers_age` is true, the age of the inertial unit's
    samples is not corrected. The gain may then differ from the optimal gain, because the covariance update is
    valid for any gain.
    """
    value, rows, noise = found
    return _correction(
        state, _corrected(covariance, np.array(value), rows, noise, gate, rate_gate, considers_age)
    )


def correct_about_thread(
    state: FilterState,
    covariance: FloatArray,
    measurement: AttitudeMeasurement | RateMeasurement,
    change: RateChange | None = None,
    gate: float = math.inf,
    rate_gate: float = math.inf,
) -> tuple[Correction, float]:
    """Return the correction of a suspended body by a measured attitude or rate, and the innovation.

    This function is faster than `correct` applied to the result of `innovation`, and returns the same result.
    The argument `change` is needed for rate samples whose age is estimated, and such samples do not correct
    the age.
    """
    variance, latency, speed = measurement.covariance.item(4), measurement.latency, 0.0
    if isinstance(measurement, RateMeasurement):
        value = measurement.rate.item(1) - state.rate[1] - state.bias[1]
        if latency is not None and change is not None:
            speed = change.acceleration[1]
            variance += change.uncertainty.item(4)
    else:
        a, b, c, d = measurement.quaternion.tolist()
        value = twist(compose((a, b, c, d), inverse(state.quaternion)))
        if latency is not None:
            speed = state.rate[1]
    if latency is not None:
        value += (state.latency - latency) * speed
    is_rate, is_aged = isinstance(measurement, RateMeasurement), change is not None
    found = _corrected_about_thread(covariance, is_rate, value, speed, variance, gate, rate_gate, is_aged)
    return _correction(state, found), value


_Corrected = tuple[bool, float, FloatArray, FloatArray, FloatArray]


def _correction(state: FilterState, found: _Corrected) -> Correction:
    """Return the `Correction` of a state from the result of `_corrected`."""
    used, square, error, covariance, spread = found
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
) -> _Corrected:
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
) -> _Corrected:
    """See `_corrected_numpy`."""
    return _corrected_loops(covariance, value, rows, noise, gate, rate_gate, considers_age)


def _corrected_about_thread_numpy(
    covariance: FloatArray,
    is_rate: bool,
    value: float,
    speed: float,
    variance: float,
    gate: float,
    rate_gate: float,
    considers_age: bool,
) -> _Corrected:
    """Return the result of `_corrected` for an innovation about the thread.

    The innovation `value` of an angle or a rate with the time derivative `speed` has the variance `variance`.
    The states 1, 4 and 7 are angle, rate and gyro bias about the suspension thread.
    """
    rows = np.zeros((1, len(covariance)))
    rows[0, [4, 7] if is_rate else 1] = 1.0
    rows[0, LATENCY] = -speed
    values, noise = np.array((value,)), np.array(((variance,),))
    return _corrected_numpy(covariance, values, rows, noise, gate, rate_gate, considers_age)


@compiled_form_of(_corrected_about_thread_numpy)
def _corrected_about_thread(
    covariance: FloatArray,
    is_rate: bool,
    value: float,
    speed: float,
    variance: float,
    gate: float,
    rate_gate: float,
    considers_age: bool,
) -> _Corrected:
    """See `_corrected_about_thread_numpy`."""
    rows, values, noise = np.zeros((1, len(covariance))), np.empty(1), np.empty((1, 1))
    values[0], noise[0, 0] = value, variance
    if is_rate:
        rows[0, 4], rows[0, 7] = 1.0, 1.0
    else:
        rows[0, 1] = 1.0
    rows[0, 15] = -speed
    return _corrected_loops(covariance, values, rows, noise, gate, rate_gate, considers_age)


@loop_helper
def _corrected_loops(
    covariance: FloatArray,
    value: FloatArray,
    rows: FloatArray,
    noise: FloatArray,
    gate: float,
    rate_gate: float,
    considers_age: bool,
) -> _Corrected:
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
    for k in range(len(spread)):
        for m in range(len(spread)):
            s[k, m] = spread[k, m]
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
    """Return state and covariance with a copy of the present attitude, because an exposure begins now."""
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


_EVER_NS = -(1 << 63)
"""Time (ns) before all measurements, from which the oldest stored command applies."""


_BIASES = np.arange(BIAS.start, BIAS.stop)
_GYRO_DOUBTS = 8
"""Number of stored times at which the gyro bias may have changed."""


class CommandHistory:
    """The recent coil commands in order of time.

    Before the first command, no coil is driven, and `idle` contains the dipole moment and the magnetic field.
    """

    def __init__(self, body: RigidBody, history_ns: int) -> None:
        self._body = body
        self.idle = body.torquing(np.zeros(3))
        self._history_ns = history_ns
        self._times, self._torquings = [_EVER_NS], [self.idle]
        self._gyro_doubts: deque[int] = deque(maxlen=_GYRO_DOUBTS)

    def record(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None, known: bool = True
    ) -> None:
        """Record the coil currents (3,), A, from `time_ns` on, and the field (3,), T, in reference axes."""
        torquing = self._body.torquing(currents, field, known)
        if self._torquings[-1] == torquing:
            return
        self._times.append(time_ns)
        self._torquings.append(torquing)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # commands are deleted in batches, not in each cycle
            del self._times[:oldest], self._torquings[:oldest]
            self._times[0] = _EVER_NS

    def mark_unknown(self, since_ns: int, *, gyro: bool = False) -> None:
        """Treat the coil currents since `since_ns` as unknown, and the gyro bias too if `gyro` is true."""
        if gyro:
            self._gyro_doubts.append(since_ns)
        first = bisect.bisect_left(self._times, since_ns)
        if first == len(self._times) or self._times[first] > since_ns:
            self._torquings.insert(first, self.at(since_ns))
            self._times.insert(first, since_ns)
        self._torquings[first:] = [torquing._replace(known=False) for torquing in self._torquings[first:]]

    def doubts_gyro(self, from_ns: int, to_ns: int) -> bool:
        """Return whether the gyro bias may have changed between two times."""
        return any(from_ns <= time_ns < to_ns for time_ns in self._gyro_doubts)

    def at(self, time_ns: int) -> Torquing:
        """Return the coils' dipole and field at a time, as `Torquing`."""
        return self._torquings[bisect.bisect_right(self._times, time_ns) - 1]

    def spans(self, from_ns: int, to_ns: int) -> Iterator[tuple[Torquing, int]]:
        """Yield each coil command between two times, and the command's duration (ns), in order of time."""
        if to_ns <= from_ns:
            return
        first, last = bisect.bisect_right(self._times, from_ns), bisect.bisect_left(self._times, to_ns)
        bounds = [from_ns, *self._times[first:last], to_ns]
        for torquing, (begin_ns, end_ns) in zip(
            self._torquings[first - 1 : last], pairwise(bounds), strict=True
        ):
            if begin_ns < end_ns:
                yield torquing, end_ns - begin_ns


_RATE_ONLY = {size: chi_square.bound(0.025, size) for size in (1, 3)}
"""Normalised squared innovation, by number of axes, above which a gyro sample corrects only the rate.
Normally a gyro sample also corrects angle, disturbance and coil gain, by their correlations with the rate.
Before a broken coil is detected, the correlations with the rate cause wrong corrections of angle, disturbance
and coil gain. Without the limit, the angle error reached 40 standard deviations although the rate was
correct. In a consistent filter, one gyro sample in forty exceeds the limit."""


@dataclass(slots=True, eq=False)
class Checkpoint:
    """A measurement, whether it passed the gate, and the state of the filter after its application.

    For the first checkpoint, the innovation (in the unit of the measurement) is empty, and the variance of
    the innovation is None.
    """

    measurement: Measurement
    used: bool
    state: FilterState
    covariance: FloatArray
    nis: float = math.nan
    innovation: tuple[float, ...] = ()
    variance: FloatArray | None = None

    @property
    def time_ns(self) -> int:
        """Time of the measurement."""
        return self.measurement.time_ns


class _Step(NamedTuple):
    """A propagation step under a single coil command, with the state and covariance after the step."""

    state: FilterState
    covariance: FloatArray
    torquing: Torquing
    span_ns: int
    result: tuple[FilterState, FloatArray]


@dataclass(frozen=True, slots=True)
class PropagationModel:
    """The model that propagates a state: body, process noise, coil commands and gate.

    The mapping `gate` assigns the threshold of the normalised squared innovation to each number of measured
    components. After the gyro bias may have changed, it has the covariance `bias_prior` (3, 3). The last
    steps are stored, because the propagation to the next measurement often repeats a step of the previous
    estimate.
    """

    body: RigidBody
    noise: ProcessNoise
    commands: CommandHistory
    gate: Mapping[int, float]
    bias_prior: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    _steps: deque[_Step] = field(default_factory=lambda: deque(maxlen=2), compare=False)

    def propagate(
        self, state: FilterState, covariance: FloatArray, from_ns: int, to_ns: int
    ) -> tuple[FilterState, FloatArray]:
        """Return state and covariance propagated between two times under the recorded coil commands."""
        if self.commands.doubts_gyro(from_ns, to_ns):
            covariance = covariance.copy()
            widen(covariance, _BIASES, self.bias_prior)
        for torquing, span_ns in self.commands.spans(from_ns, to_ns):
            for step in self._steps:
                if (
                    step.covariance is covariance
                    and step.state is state
                    and step.span_ns == span_ns
                    and step.torquing is torquing
                ):
                    state, covariance = step.result
                    break
            else:
                result = propagate(self.body, self.noise, state, covariance, torquing, span_ns * 1e-9)
                self._steps.append(_Step(state, covariance, torquing, span_ns, result))
                state, covariance = result
        return state, covariance

    def estimate(self, then: Checkpoint, time_ns: int, measured_ns: int) -> Estimate:
        """Return the estimate at `time_ns`, propagated from a checkpoint.

        `measured_ns` is the time of the last accepted measurement.
        """
        state, covariance = self.propagate(then.state, then.covariance, then.time_ns, time_ns)
        return Estimate(
            time_ns,
            np.array(state.quaternion),
            np.array(state.rate),
            np.array(state.bias),
            np.array(state.disturbance),
            state.parameters,
            covariance,
            measured_ns,
            state.latency,
            np.array(state.field_bias),
        )

    def rate_change(self, state: FilterState, covariance: FloatArray, time_ns: int) -> RateChange:
        """Return the angular acceleration at the time of a gyro sample whose age is estimated."""
        half_ns = round(0.5e9 * math.sqrt(covariance[LATENCY, LATENCY]))
        first, last = self.commands.at(time_ns - half_ns), self.commands.at(time_ns + half_ns)
        return rate_change(self.body, state, covariance, first, last)

    def correct(
        self, state: FilterState, covariance: FloatArray, measurement: Measurement
    ) -> tuple[Correction, tuple[float, ...]]:
        """Return the correction by a measurement taken at the time of the state, and the innovation."""
        change, rate_gate = None, math.inf
        if isinstance(measurement, RateMeasurement):
            if measurement.latency is not None:
                change = self.rate_change(state, covariance, measurement.time_ns)
            if self.noise.unknown_current:
                rate_gate = _RATE_ONLY[1 if self.body.suspended else 3]
        if self.body.suspended and isinstance(measurement, AttitudeMeasurement | RateMeasurement):
            done, value = correct_about_thread(
                state, covariance, measurement, change, self.gate[1], rate_gate
            )
            return done, (value,)
        found = innovation(state, measurement, self.body.suspended, change)
        gate, is_aged = self.gate[len(found.value)], change is not None
        return correct(state, covariance, found, gate, rate_gate, considers_age=is_aged), found.value

    def apply(self, then: Checkpoint, measurement: Measurement) -> Checkpoint:
        """Return the checkpoint after `then` that includes a later measurement other than a mean rate."""
        state, covariance = self.propagate(then.state, then.covariance, then.time_ns, measurement.time_ns)
        done, value = self.correct(state, covariance, measurement)
        return Checkpoint(
            measurement, done.used, done.state, done.covariance, done.square, value, done.spread
        )


_SINCE = attrgetter("since_ns")


class Replay:
    """A replay of measurements in order of time, with its results in `checkpoints`."""

    def __init__(
        self, model: PropagationModel, start: Checkpoint, measurements: Sequence[Measurement]
    ) -> None:
        self._model = model
        self._state, self._covariance, self._time_ns = start.state, start.covariance, start.time_ns
        self._pending = deque(measurements)
        # The list contains the exposures that have not begun yet, with the next exposure as last element.
        exposures = [m for m in measurements if isinstance(m, MeanRateMeasurement)]
        self._exposures = sorted(exposures, key=_SINCE, reverse=True) if exposures else exposures
        self.checkpoints: list[Checkpoint] = []

    @property
    def done(self) -> bool:
        """Whether all measurements of the replay have been applied."""
        return not self._pending

    def add(self, measurement: Measurement) -> None:
        """Append a measurement that is not older than the previous measurements and is not a mean rate."""
        self._pending.append(measurement)

    def advance(self, maximum: int | None = None) -> None:
        """Apply the next `maximum` measurements, by default all remaining measurements."""
        for _ in range(len(self._pending) if maximum is None else min(maximum, len(self._pending))):
            self._ingest(self._pending.popleft())

    def _ingest(self, measurement: Measurement) -> None:
        while self._exposures and self._exposures[-1].since_ns <= measurement.time_ns:
            exposure = self._exposures.pop()
            self._propagate_to(exposure.since_ns)
            self._state, self._covariance = keep_attitude(self._state, self._covariance, exposure)
        self._propagate_to(measurement.time_ns)
        done, value = self._model.correct(self._state, self._covariance, measurement)
        state, covariance = done.state, done.covariance
        if isinstance(measurement, MeanRateMeasurement):
            state, covariance = release_attitude(state, covariance, measurement)
        self._state, self._covariance = state, covariance
        alone = state._replace(kept=()) if state.kept else state
        own = covariance[:SIZE, :SIZE].copy() if state.kept else covariance
        self.checkpoints.append(
            Checkpoint(measurement, done.used, alone, own, done.square, value, done.spread)
        )

    def _propagate_to(self, time_ns: int) -> None:
        self._state, self._covariance = self._model.propagate(
            self._state, self._covariance, self._time_ns, time_ns
        )
        self._time_ns = time_ns


_SPARE_NS = 1_000_000_000
"""Largest excess (ns) of the age of the oldest checkpoint over `history_ns`. If the excess is larger, all
checkpoints older than `history_ns` are dropped."""
_TIME = attrgetter("time_ns")


class CheckpointHistory:
    """The checkpoints of the last `history_ns` nanoseconds; there are none before the filter starts."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._checkpoints: list[Checkpoint] = []

    def __len__(self) -> int:
        return len(self._checkpoints)

    def __getitem__(self, index: int) -> Checkpoint:
        return self._checkpoints[index]

    @property
    def newest(self) -> Checkpoint:
        """The newest checkpoint. Raises IndexError if the history is empty."""
        return self._checkpoints[-1]

    @property
    def newest_used(self) -> Checkpoint:
        """The newest checkpoint whose measurement passed the gate; if none passed, the newest checkpoint."""
        newest = self._checkpoints[-1]
        if newest.used:  # nearly always
            return newest
        return next((c for c in reversed(self._checkpoints) if c.used), newest)

    def at(self, time_ns: int) -> Checkpoint | None:
        """Return the last checkpoint up to a time, or None for a time before the first checkpoint."""
        index = bisect.bisect_right(self._checkpoints, time_ns, key=_TIME)
        return self._checkpoints[index - 1] if index else None

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s of the checkpoints that enclose an interval.

        If no checkpoint is at or after `end_ns`, the rates end with the newest checkpoint. Return None if no
        checkpoint is as old as `begin_ns`.
        """
        first = bisect.bisect_right(self._checkpoints, begin_ns, key=_TIME)
        last = bisect.bisect_left(self._checkpoints, end_ns, key=_TIME)
        if not first:
            return None
        spanning = self._checkpoints[first - 1 : last + 1]
        return np.array([c.time_ns for c in spanning]), np.array([c.state.rate for c in spanning])

    def index_before(self, begin_ns: int) -> int:
        """Return the number of checkpoints up to `begin_ns`.

        If `begin_ns` is within the exposure of a mean rate, count up to the start of that exposure.
        """
        while True:
            index = bisect.bisect_right(self._checkpoints, begin_ns, key=_TIME)
            spanning = [c.measurement.begin_ns for c in self._checkpoints[index:]]
            earliest = min(spanning, default=begin_ns)
            if earliest >= begin_ns:
                return index
            begin_ns = earliest

    def measurements_from(self, index: int) -> list[Measurement]:
        """Return the measurements of the checkpoints from the index `index` on."""
        return [checkpoint.measurement for checkpoint in self._checkpoints[index:]]

    def replace_from(self, index: int, checkpoints: Sequence[Checkpoint]) -> None:
        """Replace the checkpoints from the index `index` on."""
        self._checkpoints[index:] = checkpoints

    def index_of(self, checkpoint: Checkpoint) -> int:
        """Return the index of `checkpoint` in the history."""
        return next(k for k in range(len(self) - 1, -1, -1) if self._checkpoints[k] is checkpoint)

    def restart(self, first: Checkpoint | None) -> None:
        """Drop all checkpoints, and begin a new history with `first` unless it is None."""
        self._checkpoints = [] if first is None else [first]

    def forget(self, now_ns: int) -> None:
        """Drop checkpoints that are too old, in batches, but always keep the newest checkpoint."""
        checkpoints = self._checkpoints
        horizon_ns = now_ns - self._history_ns
        if len(checkpoints) > 2 and checkpoints[0].time_ns < horizon_ns - _SPARE_NS:
            keep = bisect.bisect_left(checkpoints, horizon_ns, key=_TIME)
            del checkpoints[: min(keep, len(checkpoints) - 1)]
