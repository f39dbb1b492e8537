"""Steps of the satellite's attitude filter, and propagation of its estimate from the end of the last step.

A step contains the coil commands and the readings between two times.
"""

from __future__ import annotations

import bisect
import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray, IntArray, cross_matrix
from knightcube.astro.quaternion import (
    Matrix,
    Quaternion,
    Vector,
    added,
    attitude_matrix,
    compose,
    cross,
    exponential,
    matrix,
    rows_of,
    skew,
    times,
)
from knightcube.compiled import compiled_floats, compiled_form_of, loop_helper
from knightcube.gnc.estimation import estimate as form
from knightcube.gnc.estimation import free_filter as states
from knightcube.gnc.estimation.estimate import FIELD_BIAS, Estimate, Measurement, Parameters
from knightcube.gnc.estimation.free_filter import FilterEnvironment, FreeFilter, FreeMemory, FreeMotion

Floats = tuple[float, float, float]
_NOTHING: Floats = (0.0, 0.0, 0.0)


class DipoleHistory:
    """Record of the commanded dipoles, in order of time."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._times: list[int] = []
        self._dipoles: list[Floats] = []
        self._sums: list[Floats] = []  # integral of the dipole up to each time, A m^2 ns
        self.unknown_ns = -1
        """Last time (ns) at which the dipole was unknown; -1 if it was always known. While the dipole is
        unknown, this is the time of the newest command."""
        self.is_known = True  # whether the dipole is known now

    def record(self, time_ns: int, dipole: Floats, known: bool) -> None:
        """Record the dipole (A m^2) that is in force from `time_ns` on; calls must be in order of time."""
        if not (known and self.is_known):
            self.unknown_ns = max(self.unknown_ns, time_ns)
        self.is_known = known
        if self._dipoles and dipole == self._dipoles[-1]:
            return
        time_ns = max(time_ns, self._times[-1]) if self._times else time_ns
        self._sums.append(self._sum(time_ns))
        self._times.append(time_ns)
        self._dipoles.append(dipole)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # discard the oldest entries in batches
            del self._times[:oldest], self._dipoles[:oldest], self._sums[:oldest]

    def total(self, time_ns: int) -> FloatArray:
        """Return the integral (3,), A m^2 s, of the dipole up to a time, from an arbitrary origin."""
        return np.array(self._sum(time_ns)) / SECOND_NS

    def mean(self, from_ns: int, to_ns: int) -> FloatArray:
        """Return the mean dipole (3,), A m^2, between two times; it is zero before the first record."""
        if to_ns <= from_ns:
            return np.array(self._dipoles[-1] if self._dipoles else _NOTHING)
        (a, b, c), (x, y, z), span = self._sum(to_ns), self._sum(from_ns), to_ns - from_ns
        return np.array(((a - x) / span, (b - y) / span, (c - z) / span))

    def impulse(self, from_ns: int, to_ns: int) -> FloatArray:
        """Return the mean over t of the integral (3,), A m^2 s, of the dipole from a time t to `to_ns`.

        The mean is taken over all times t from `from_ns` to `to_ns`. The cross product of the result and the
        magnetic field is the angular momentum at `to_ns` minus the mean angular momentum from `from_ns` to
        `to_ns`.
        """
        first, last = bisect.bisect_right(self._times, from_ns), bisect.bisect_left(self._times, to_ns)
        knots = np.array([from_ns, *self._times[first:last], to_ns])
        sums = np.array([self._sum(time_ns) for time_ns in knots.tolist()])
        mean = np.diff(knots) @ (0.5 * (sums[1:] + sums[:-1])) / (to_ns - from_ns)
        return np.asarray((sums[-1] - mean) / SECOND_NS)

    def at_rest_since(self) -> int | None:
        """Return the time (ns) since which the dipole has been zero, or None if it is not zero."""
        if not self._dipoles:
            return 0
        return self._times[-1] if self._dipoles[-1] == _NOTHING else None

    def _sum(self, time_ns: int) -> Floats:
        place = bisect.bisect_right(self._times, time_ns) - 1
        if place < 0:
            return self._sums[0] if self._sums else _NOTHING
        since = time_ns - self._times[place]
        (a, b, c), (x, y, z) = self._sums[place], self._dipoles[place]
        return a + since * x, b + since * y, c + since * z


class RateByField(NamedTuple):
    """The body rate (3,), rad/s, estimated from the magnetometer, with its covariance (3, 3), rad^2/s^2."""

    rate: FloatArray
    covariance: FloatArray


@dataclass(slots=True, eq=False)
class FilterStep:
    """Coil commands and measurements between two times.

    Attributes:
        dipole: mean commanded dipole (3,), A m^2.
        doubt: standard deviation (A m^2 per axis) of the error of `dipole`, without the error of the coils'
            matrix; zero if three coils have a known dipole.
        gyro: mean angular rate (3,), rad/s, of `samples` gyro readings with the mean time `gyro_ns`. Without
            a gyro reading, `gyro` is the rate at the end of the step, estimated from the magnetometer, and
            `spread` is the covariance (3, 3), rad^2/s^2, of this rate.
        impulse: time integral (3,), A m^2 s, of the dipole from a gyro reading to the end of the step,
            averaged over the readings.
        field: mean magnetic field (3,), T, of `fields` readings around `field_ns`, or None if there are none.
        late: measurements whose time lies in the step, oldest first.
        before: the estimate at the beginning of the step, or None if there was none.
        doubts_gyro: whether the gyro bias may have changed during the step.
    """

    begin_ns: int
    end_ns: int
    dipole: FloatArray
    doubt: float
    around: FilterEnvironment
    gyro: FloatArray
    gyro_ns: int
    samples: int
    impulse: FloatArray
    field: FloatArray | None
    field_ns: int
    fields: int
    spread: FloatArray | None = None
    late: list[Measurement] = dataclasses.field(default_factory=list)
    before: FreeMemory | None = None
    doubts_gyro: bool = False

    @property
    def seconds(self) -> float:
        """Length of the step (s)."""
        return (self.end_ns - self.begin_ns) / SECOND_NS


class OpenStep:
    """Collects the readings of the present, incomplete filter step."""

    def __init__(self, begin_ns: int, acts: bool) -> None:
        """Start a step at a time. The flag `acts` states whether the coils carry current during the step."""
        self.begin_ns = self.end_ns = begin_ns
        self._acts = acts
        self._rates: list[FloatArray] = []
        self._totals: list[FloatArray] = []
        self._total: FloatArray = np.zeros(3)
        self._fields: list[FloatArray] = []
        self._rates_ns = self._fields_ns = 0

    def add(self, reading: ImuReading, total: FloatArray, listens: bool) -> None:
        """Add a reading, with the integral `total` (3,), A m^2 s, of the dipole up to the reading.

        The flag `listens` states whether the magnetic field of the reading is valid.
        """
        since = reading.time_ns - self.begin_ns
        self.end_ns, self._total = reading.time_ns, total
        if reading.has_rate:
            self._rates.append(reading.rate)
            self._totals.append(total)
            self._rates_ns += since
        if listens:
            self._fields.append(reading.field)
            self._fields_ns += since

    def is_over(self, acts: bool, longest_ns: int) -> bool:
        """Return whether the step has reached its full length, or the coils were switched on or off."""
        return acts != self._acts or self.end_ns - self.begin_ns >= longest_ns

    def close(
        self, dipole: FloatArray, doubt: float, around: FilterEnvironment, by_field: RateByField
    ) -> FilterStep:
        """Return the finished step; if it has no gyro reading, its rate is that from the magnetometer."""
        samples, fields = len(self._rates), len(self._fields)
        rate, spread = (np.mean(self._rates, axis=0), None) if samples else by_field
        return FilterStep(
            self.begin_ns,
            self.end_ns,
            dipole,
            doubt,
            around,
            rate,
            self.begin_ns + self._rates_ns // samples if samples else self.end_ns,
            samples,
            self._total - np.mean(self._totals, axis=0) if samples else np.zeros(3),
            np.mean(self._fields, axis=0) if fields else None,
            self.begin_ns + self._fields_ns // max(fields, 1),
            fields,
            spread,
        )


_EYE: FloatArray = np.eye(3)
_FROM = np.r_[states.ATTITUDE, states.RATE, states.GYRO, states.MAGNET]
_TO = np.r_[form.ATTITUDE, form.RATE, form.BIAS, form.FIELD_BIAS]
_MOVING = np.r_[states.ATTITUDE, states.RATE, states.COILS, states.CAMERA, states.VARIATION]
_MOVED, _CAMERA, _VARIATION = np.ix_(_MOVING, _MOVING), slice(15, 18), slice(18, 21)
_SIZE = FIELD_BIAS.stop
_PARAMETERS, _NONE = Parameters(), np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class _Beginning:
    """An estimate at the end of a step, with terms that are computed once for all its propagations.

    Attributes:
        motion: equation of motion with the estimated inertia.
        inertia, inverse: rows of the inertia tensor, kg m^2, and of its inverse.
        coils: rows of the matrix from the commanded to the estimated dipole of the coils.
        quaternion, rate: attitude, and body rate, rad/s.
        field, residual: magnetic field, T, and the satellite's residual dipole, A m^2, in body axes.
    """

    around: FilterEnvironment
    memory: FreeMemory
    motion: FreeMotion
    inertia: Matrix
    inverse: Matrix
    coils: Matrix
    quaternion: Quaternion
    rate: Vector
    field: Vector
    residual: Vector


class _Motion(NamedTuple):
    """The motion from the beginning of a propagation to its end.

    Attributes:
        seconds: duration, s.
        dipole: mean commanded dipole, A m^2, body axes.
        rotation: quaternion from the body axes at the beginning into the body axes at the end.
        rate: body rate at the end, rad/s.
        middle, field: body rate, rad/s, and magnetic field, T, in body axes, at the middle of the
            propagation.
    """

    seconds: float
    dipole: Vector
    rotation: Quaternion
    rate: Vector
    middle: Vector
    field: Vector


_Moved = tuple[float, Vector, Quaternion, Vector, Vector, Vector]
"""The fields of `_Motion` as a plain tuple, for compiled functions."""


class PropagatedEstimate(Estimate):
    """An estimate whose covariance (19, 19) is computed when it is first read or copied."""

    __slots__ = ("_known",)
    _known: FloatArray | Callable[[], FloatArray]

    def __init__(self, covariance: FloatArray | Callable[[], FloatArray], **values: Any) -> None:
        """`covariance` is a matrix or a function that returns it; `values` are the other attributes."""
        for name, value in {**values, "_known": covariance}.items():
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[type[Estimate], tuple[Any, ...]]:
        """Copy and pickle this object as a plain `Estimate`, because a function cannot be pickled."""
        return Estimate, tuple(getattr(self, one.name) for one in fields(self))

    @property
    def covariance(self) -> FloatArray:
        """Covariance (19, 19) of the error state, whose attitude error is a rotation vector in body axes."""
        known = self._known
        if callable(known):
            known = known()
            object.__setattr__(self, "_known", known)
        return known


class EstimatePropagation:
    """Propagates estimates to times within a step; covariances are computed only if they are read."""

    def __init__(self, free: FreeFilter) -> None:
        self._free = free
        self._newest: _Beginning | None = None
        self._changes = -1

    def now(
        self, time_ns: int, seconds: float, dipole: FloatArray, around: FilterEnvironment, measured_ns: int
    ) -> Estimate:
        """Return the newest estimate, propagated by `seconds` under a dipole (3,), A m^2."""
        free, newest = self._free, self._newest
        if newest is None or self._changes != free.changes or newest.around is not around:
            newest = self._beginning(free.memory(), around)
            self._newest, self._changes = newest, free.changes
        return self._propagated(newest, time_ns, seconds, dipole, measured_ns)

    def then(
        self, memory: FreeMemory, time_ns: int, seconds: float, dipole: FloatArray, around: FilterEnvironment
    ) -> Estimate:
        """Return an earlier estimate, propagated by `seconds` under a dipole (3,), A m^2."""
        return self._propagated(self._beginning(memory, around), time_ns, seconds, dipole, time_ns)

    def _beginning(self, memory: FreeMemory, around: FilterEnvironment) -> _Beginning:
        constants = memory.constants
        motion = copy.copy(self._free.motion)  # a copy, which later corrections of the inertia do not change
        x, y, z = (constants[states.DIPOLE] + around.sunlit * constants[states.SUNLIT]).tolist()
        a, b, c, d = memory.quaternion.tolist()
        u, v, w = memory.rate.tolist()
        e, f, g = (attitude_matrix(memory.quaternion) @ around.field).tolist()
        return _Beginning(
            around,
            memory,
            motion,
            rows_of(motion.inertia),
            rows_of(motion.inverse),
            rows_of(_EYE + constants[states.COILS].reshape(3, 3) + np.diag(constants[states.VARIATION])),
            (a, b, c, d),
            (u, v, w),
            (e, f, g),
            (x, y, z),
        )

    def camera_covariance(self, seconds: float, dipole: FloatArray, around: FilterEnvironment) -> FloatArray:
        """Return the attitude covariance (3, 3), rad^2, of the star camera, propagated by `seconds`."""
        begun = self._beginning(self._free.memory(), around)
        moved = _moved(begun, seconds, dipole)
        rows = _transition(begun.motion.inertia, begun.motion.inverse, moved)[0:3]
        rows[:, _CAMERA] += _EYE
        moving = begun.memory.covariance[_MOVED]
        return np.asarray(rows @ moving @ rows.T + seconds**2 / 3.0 * self._grown(begun, moved))

    def _covariance(self, begun: _Beginning, moved: _Motion) -> FloatArray:
        """Return the covariance (19, 19) at the end of a motion, in the state order of `Estimate`."""
        motion = begun.motion
        # numba accepts a tuple faster than a NamedTuple.
        grown = self._grown(begun, moved)
        return _spread(
            begun.memory.covariance,
            motion.inertia,
            motion.inverse,
            moved[:],
            grown,
            _MOVING,
            _FROM,
            _TO,
            _SIZE,
        )

    def _grown(self, begun: _Beginning, moved: _Motion) -> FloatArray:
        """Return the covariance (3, 3), rad^2/s^2, of the rate due to noise during a propagation."""
        dipole = np.array(moved.dipole)
        noise = self._free.rate_noise(dipole, begun.around, then=begun.memory, motion=begun.motion)
        return moved.seconds * noise

    def _propagated(
        self, begun: _Beginning, time_ns: int, seconds: float, dipole: FloatArray, measured_ns: int
    ) -> Estimate:
        moved = _moved(begun, seconds, dipole)
        return PropagatedEstimate(
            lambda: self._covariance(begun, moved),
            time_ns=time_ns,
            quaternion=np.array(compose(moved.rotation, begun.quaternion)),
            rate=np.array(moved.rate),
            bias=begun.memory.constants[states.GYRO],
            disturbance=_NONE,
            parameters=_PARAMETERS,
            measured_ns=measured_ns,
            latency=0.0,
            field_bias=begun.memory.constants[states.MAGNET],
        )


def _moved(begun: _Beginning, seconds: float, dipole: FloatArray) -> _Motion:
    """Return the motion during `seconds` under a dipole (3,), A m^2, by the midpoint rule."""
    x, y, z = dipole.tolist()
    one = begun
    return _Motion(
        seconds,
        (x, y, z),
        *_rotated(seconds, (x, y, z), one.coils, one.residual, one.inertia, one.inverse, one.rate, one.field),
    )


@compiled_floats
def _rotated(
    seconds: float,
    dipole: Vector,
    coils: Matrix,
    residual: Vector,
    inertia: Matrix,
    inverse: Matrix,
    rate: Vector,
    field: Vector,
) -> tuple[Quaternion, Vector, Vector, Vector]:
    """Return rotation, rate at the end, middle rate and middle field of a `_Motion`; see `_Beginning`."""
    half = 0.5 * seconds
    whole = added(times(coils, dipole), residual)
    first = _acceleration(inertia, inverse, rate, whole, field)
    middle = _ahead(rate, half, first)
    a, b, c = _scaled(half, _ahead(rate, 0.5 * half, first))
    between = times(matrix(exponential(a, b, c)), field)
    second = _acceleration(inertia, inverse, middle, whole, between)
    after = _ahead(rate, seconds, second)
    a, b, c = cross(rate, after)
    u, v, w = first[0] + 2.0 * second[0], first[1] + 2.0 * second[1], first[2] + 2.0 * second[2]
    mean = _ahead(rate, seconds / 6.0, (u + 0.5 * a, v + 0.5 * b, w + 0.5 * c))
    a, b, c = _scaled(seconds, mean)
    return exponential(a, b, c), after, middle, between


@loop_helper
def _acceleration(inertia: Matrix, inverse: Matrix, rate: Vector, dipole: Vector, field: Vector) -> Vector:
    """Return the angular acceleration, rad/s^2, at a rate, rad/s, with a dipole, A m^2, in a field, T."""
    gyroscopic = cross(times(inertia, rate), rate)
    return times(inverse, added(cross(dipole, field), gyroscopic))


@loop_helper
def _ahead(vector: Vector, seconds: float, slope: Vector) -> Vector:
    """Return `vector` + `seconds` * `slope`."""
    return vector[0] + seconds * slope[0], vector[1] + seconds * slope[1], vector[2] + seconds * slope[2]


@loop_helper
def _scaled(factor: float, vector: Vector) -> Vector:
    """Return `factor` * `vector`."""
    return factor * vector[0], factor * vector[1], factor * vector[2]


def _transition(inertia: FloatArray, inverse: FloatArray, moved: _Moved) -> FloatArray:
    """Return the transition matrix (6, 21) of the errors of attitude and rate for a motion.

    The columns are the states `_MOVING`. `inverse` (3, 3) is the inverse of the inertia tensor (3, 3).
    """
    seconds, dipole, rotation, _, middle, field = moved
    found = np.zeros((6, len(_MOVING)))
    found[0:3, 0:3], found[0:3, 3:6] = matrix(rotation), seconds * _EYE
    rate = np.array(middle)
    by_rate = inverse @ (cross_matrix(inertia @ rate) - cross_matrix(rate) @ inertia)
    found[3:6, 3:6] = _EYE + seconds * by_rate
    by_dipole = -seconds * (inverse @ np.array(skew(field)))
    found[3:6, 6:15] = (by_dipole[:, :, None] * dipole).reshape(3, 9)
    found[3:6, _VARIATION] = by_dipole * dipole
    found[0:3, 6:] = 0.5 * seconds * found[3:6, 6:]
    return found


def _spread_numpy(
    before: FloatArray,
    inertia: FloatArray,
    inverse: FloatArray,
    moved: _Moved,
    grown: FloatArray,
    moving: IntArray,
    picked: IntArray,
    placed: IntArray,
    size: int,
) -> FloatArray:
    """Return the covariance (size, size) after a motion, with the states in the order of `Estimate`.

    The filter's states have the covariance `before` (n, n) before the motion. The noise during the motion
    increases the covariance of the rate by `grown` (3, 3). Attitude and rate depend on the states with the
    indices `moving` (21,). The states with the indices `picked` (k,), which begin with attitude and rate, get
    the indices `placed` (k,) in the result. See `_transition` for the other arguments.
    """
    seconds, transition = moved[0], _transition(inertia, inverse, moved)
    spread = np.zeros((size, size))
    spread[np.ix_(placed, placed)] = before[np.ix_(picked, picked)]
    among = transition @ before[np.ix_(moving, moving)] @ transition.T
    among[0:3, 0:3] += seconds**2 / 3.0 * grown
    among[3:6, 3:6] += grown
    spread[np.ix_(placed[:6], placed[:6])] = among
    return spread


@loop_helper
def _transition_by_loops(inertia: FloatArray, inverse: FloatArray, moved: _Moved) -> FloatArray:
    """See `_transition`."""
    seconds, dipole, rotation, _, middle, field = moved
    (a, b, c), (d, e, f), (g, h, i) = inertia[0], inertia[1], inertia[2]
    turned, across, by_field = matrix(rotation), skew(middle), skew(field)
    gyroscopic = skew(times(((a, b, c), (d, e, f), (g, h, i)), middle))
    found = np.zeros((6, 21))
    for j in range(3):
        for k in range(3):
            by_rate = by_dipole = 0.0
            for m in range(3):
                changed = gyroscopic[m][k]
                for n in range(3):
                    changed -= across[m][n] * inertia[n, k]
                by_rate += inverse[j, m] * changed
                by_dipole -= seconds * inverse[j, m] * by_field[m][k]
            found[j, k], found[3 + j, 3 + k] = turned[j][k], seconds * by_rate
            for m in range(3):
                found[3 + j, 6 + 3 * k + m] = by_dipole * dipole[m]
            found[3 + j, 18 + k] = by_dipole * dipole[k]
        found[j, 3 + j] = seconds
        found[3 + j, 3 + j] += 1.0
        for k in range(6, 21):
            found[j, k] = 0.5 * seconds * found[3 + j, k]
    return found


@compiled_form_of(_spread_numpy)
def _spread(
    before: FloatArray,
    inertia: FloatArray,
    inverse: FloatArray,
    moved: _Moved,
    grown: FloatArray,
    moving: IntArray,
    picked: IntArray,
    placed: IntArray,
    size: int,
) -> FloatArray:
    """See `_spread_numpy`."""
    transition, seconds = _transition_by_loops(inertia, inverse, moved), moved[0]
    half, spread = np.zeros((6, 21)), np.zeros((size, size))
    for j in range(6):
        for k in range(21):
            for m in range(21):
                half[j, m] += transition[j, k] * before[moving[k], moving[m]]
    for j in range(len(picked)):
        for k in range(len(picked)):
            spread[placed[j], placed[k]] = before[picked[j], picked[k]]
    for j in range(6):
        for k in range(6):
            among = 0.0
            for m in range(21):
                among += half[j, m] * transition[k, m]
            if j // 3 == k // 3:
                among += grown[j % 3, k % 3] * (1.0 if j > 2 else seconds**2 / 3.0)
            spread[placed[j], placed[k]] = among
    return spread
