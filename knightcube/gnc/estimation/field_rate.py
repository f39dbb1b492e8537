"""The body's rate from the magnetometer: an extended Kalman filter of rate, field and its change.

A body that turns in a field sees the field turn on a cone about its rate, so the field's direction over time
gives all three components, the one along the field too; only a spin exactly along the field shows nothing,
until the field has turned (by about two turns an orbit). A gyro, where there is one, shows it at once. The
states are in body axes: rate w, field B, and the field's change v with respect to the stars; and a small turn
a of the principal axes from those of the believed inertia, because at a fast spin of a long body the
gyroscopic torque of 2 deg is the model's largest error:

    J(a) w' = m x B - w x J(a) w,    B' = v - w x B,    v' = -w x v,    a' = 0.

The dipole m of the coils is known, so the coils may act between measurements. The filter keeps the turn since
its start, which serves as an inertial frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.turn import (
    Matrix,
    Quaternion,
    Vector,
    compose,
    cross,
    exponential,
    matrix,
    skew,
    times,
)

RATE, FIELD, CHANGE, AXES = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
SIZE = 12
LARGEST_TURN = 0.15
"""rad, of a step of integration."""
_AGREEING = 3
"""Samples that start the filter."""
_EYE: FloatArray = np.eye(SIZE)
_NONE: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldRateSettings:
    """Noise of the filter.

    Attributes:
        inertia: (3, 3) kg m^2, body axes.
        field_sigma: T of an axis of a measurement, constant errors of the magnetometer included.
        rate_start: rad/s, of the rate along the field at the start.
        change_start: T/s, of the field's change with respect to the stars.
        change_walk: T/s per sqrt(s), its random walk.
        torque_walk: rad/s per sqrt(s) of an axis, from torques that are not modelled.
        axes_sigma: rad, by which the principal axes are turned from those of `inertia`, at the start.
        inertia_error: share of the gyroscopic torque that no turn of the axes explains, once that is known.
        gate_sigma: a measurement less likely than this many sigma of one component is refused.
        refusals: this many in a row, and the filter starts again; of a gyro, and it is not asked again.
        gyro_sigma: rad/s of an axis, the bound of a gyro's bias.
        longest_gap: s, between the samples that start it: longer gaps hide fast spins.
    """

    inertia: FloatArray
    field_sigma: float
    rate_start: float = 0.3
    change_start: float = 8e-8
    change_walk: float = 4e-9
    torque_walk: float
    axes_sigma: float = 0.03
    inertia_error: float = 0.003
    gate_sigma: float = 5.0
    refusals: int = 5
    longest_gap: float = 0.2
    gyro_sigma: float = 1e-3


def rate_across(before: FloatArray, after: FloatArray, seconds: float) -> FloatArray:
    """Return the rate (3,) across the field, rad/s, that turned `before` into `after` (3,) T in the body.

    Exact for a steady rotation across the field by less than half a turn. Zero without a field.
    """
    turned = np.cross(after, before)  # -w x B: the field turns opposite to the body
    length = float(np.linalg.norm(turned))
    if length == 0.0:
        return np.zeros(3)
    angle = math.atan2(length, float(before @ after))
    return turned * (angle / (length * seconds))


class FieldRate:
    """The filter; `restarts` counts how often it began again because its predictions failed.

    Longer than 200 lines because start, steps and both measurements act on the one state.
    """

    def __init__(self, settings: FieldRateSettings) -> None:
        self._settings = settings
        inertia = np.asarray(settings.inertia, dtype=float)
        self._inverse = np.linalg.inv(inertia)
        self._inertia_rows, self._inverse_rows = _rows(inertia), _rows(self._inverse)
        moments = np.linalg.eigvalsh(inertia)
        self._differences = float(moments[-1] - moments[0]) / np.diag(inertia)
        # As rare as `gate_sigma` of one component, by the tail's exponential part.
        self._gate = (settings.gate_sigma + 1.0) ** 2
        self.restarts = 0
        self.restart()

    def restart(self) -> None:
        """Forget all but how often the predictions failed."""
        self._waiting: list[tuple[float, FloatArray]] = []
        self._since = 0.0
        self._refused = self._gyro_refused = 0
        self._gyro_used = False
        self._turn: Quaternion = (0.0, 0.0, 0.0, 1.0)
        self._rate: Vector | None = None
        self._field = self._change = _NONE
        self._turn_axes(np.asarray(self._settings.inertia, dtype=float), (0.0, 0.0, 0.0))
        self._covariance = np.zeros((SIZE, SIZE))

    @property
    def started(self) -> bool:
        """Whether there is a rate."""
        return self._rate is not None

    @property
    def rate(self) -> FloatArray:
        """The rate (3,) rad/s, body axes."""
        return np.array(self._rate or _NONE)

    @property
    def field(self) -> FloatArray:
        """The field (3,) T, body axes, at the end of the last `advance`."""
        return np.array(self._field)

    @property
    def change(self) -> FloatArray:
        """The field's change (3,) T/s with respect to the stars, in body axes."""
        return np.array(self._change)

    @property
    def turn(self) -> FloatArray:
        """The rotation (4,) since the start, from the body's axes then into those of now."""
        return np.array(self._turn)

    @property
    def inverse(self) -> FloatArray:
        """The inverse (3, 3) of the inertia about the principal axes as they are estimated."""
        return self._inverse

    @property
    def momentum(self) -> FloatArray:
        """The angular momentum (3,) N m s, body axes."""
        return np.array(times(self._inertia_rows, self._rate or _NONE))

    @property
    def covariance(self) -> FloatArray:
        """The covariance (12, 12) of rate, field, change and axes (RATE, FIELD, ...)."""
        return self._covariance

    def advance(self, dipole: FloatArray, seconds: float) -> None:
        """Propagate by `seconds` under a dipole (3,) A m^2, body axes."""
        self._since += seconds
        if self._rate is None:
            return
        speed = math.sqrt(sum(w * w for w in self._rate))
        steps = max(1, math.ceil(speed * seconds / LARGEST_TURN))
        mx, my, mz = dipole.tolist()
        for _ in range(steps):
            self._step((mx, my, mz), seconds / steps)

    def measure(self, field: FloatArray, age: float = 0.0) -> bool:
        """Accept the field (3,) T measured `age` s ago with the coils off; return whether it was plausible.

        The body's rate carries it on to now.
        """
        if not np.all(np.isfinite(field)):
            return False
        if self._rate is None:
            self._start(field)
            return True
        if age:
            x, y, z = self._rate
            field = np.array(matrix(exponential(age * x, age * y, age * z))) @ field
        covariance = self._covariance
        spread = covariance[FIELD, FIELD] + self._settings.field_sigma**2 * np.eye(3)
        gain = np.linalg.solve(spread, covariance[FIELD]).T
        innovation = field - self._field
        if not float(innovation @ np.linalg.solve(spread, innovation)) <= self._gate:
            self._refused += 1
            if self._refused >= self._settings.refusals:
                self._begin_again(self._gyro_used or self._gyro_refused >= self._settings.refusals)
            return False
        self._refused = 0
        self._correct(np.asarray(gain), innovation, FIELD)
        return True

    def measure_rate(self, rate: FloatArray) -> None:
        """Accept a gyro's rate (3,) rad/s of now where it says more than the filter knows.

        Its error is a bias: used more often it would narrow the filter's claim to less than that bias. One
        that contradicts the filter several times in a row, or after which the field's predictions failed, is
        not used again before `restart`. Where it contradicts what it has taught, the filter begins again.
        """
        settings, covariance = self._settings, self._covariance
        if self._rate is None or self._gyro_refused >= settings.refusals or not np.all(np.isfinite(rate)):
            return
        spread = covariance[RATE, RATE] + settings.gyro_sigma**2 * np.eye(3)
        innovation = rate - np.array(self._rate)
        if not float(innovation @ np.linalg.solve(spread, innovation)) <= self._gate:
            self._gyro_refused += 1
            if self._gyro_used and self._gyro_refused >= settings.refusals:
                self._begin_again(misled=True)
            return
        self._gyro_refused = 0
        if float(covariance.diagonal()[RATE].max()) > settings.gyro_sigma**2:
            self._gyro_used = True
            self._correct(np.asarray(np.linalg.solve(spread, covariance[RATE]).T), innovation, RATE)

    def _begin_again(self, misled: bool) -> None:
        """Begin again, and count it; `misled`: by the gyro, which is not asked again."""
        self.restart()
        self._gyro_refused = self._settings.refusals if misled else 0
        self.restarts += 1

    def _correct(self, gain: FloatArray, innovation: FloatArray, measured: slice) -> None:
        """Correct the state by a gain (12, 3) and an innovation (3,) of the states `measured`."""
        assert self._rate is not None
        change = (gain @ innovation).tolist()
        self._rate = _sum(self._rate, change[RATE])
        self._field = _sum(self._field, change[FIELD])
        self._change = _sum(self._change, change[CHANGE])
        self._turn_axes(self._inertia, change[AXES])
        covariance = self._covariance - gain @ self._covariance[measured]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._look_at_axes()

    def _look_at_axes(self) -> None:
        """Take for unexplained, of the gyroscopic torque, the doubt of the axes that can be seen.

        The filter is linear: what it takes from turns that it hardly knows it would believe too firmly. The
        axes' worst direction is left out, as a turn about a symmetric body's axis shows nothing.
        """
        unknown = float(np.linalg.eigvalsh(self._covariance[AXES, AXES])[1])
        self._unexplained = max(self._settings.inertia_error, math.sqrt(unknown))

    def _start(self, field: FloatArray) -> None:
        """Begin with the rate across the field from three samples in a row that agree; else wait for more."""
        settings = self._settings
        if self._since > settings.longest_gap:
            self._waiting.clear()
        self._waiting.append((self._since, field))
        self._since = 0.0
        if len(self._waiting) < _AGREEING:
            return
        (_, first), (span_a, middle), (span_b, last) = self._waiting
        self._waiting.pop(0)
        if min(span_a, span_b) <= 0.0:
            return
        strength = math.sqrt(float(last @ last))
        noise = settings.gate_sigma * math.sqrt(2.0) * settings.field_sigma
        if max(abs(math.sqrt(float(b @ b)) - strength) for b in (first, middle)) > noise:
            return
        rates = rate_across(first, middle, span_a), rate_across(middle, last, span_b)
        apart, speed = (float(np.linalg.norm(v)) for v in (rates[0] - rates[1], rates[1]))
        if apart <= 2.0 * noise / (strength * min(span_a, span_b)) + 0.3 * speed:
            self._begin(rates, span_a + span_b, last)

    def _begin(self, rates: tuple[FloatArray, FloatArray], span: float, field: FloatArray) -> None:
        """Begin from the rates across the field in the halves of a span, s, at whose end it is `field`."""
        settings = self._settings
        rate = 0.5 * (rates[0] + rates[1])
        square = float(field @ field)
        self._rate, self._field, self._change = _floats(rate), _floats(field), _NONE
        along = np.outer(field, field) / square
        across = 2.0 * (settings.field_sigma / span) ** 2 / square + settings.torque_walk**2 * span
        # The rate changes meanwhile: in body axes it turns about the field.
        across += (float(rate @ rate) * span) ** 2
        self._covariance[RATE, RATE] = (
            across * np.eye(3) + (settings.rate_start**2 + float(rate @ rate)) * along
        )
        self._covariance[FIELD, FIELD] = settings.field_sigma**2 * np.eye(3)
        self._covariance[CHANGE, CHANGE] = settings.change_start**2 * np.eye(3)
        self._covariance[AXES, AXES] = settings.axes_sigma**2 * np.eye(3)
        self._look_at_axes()

    def _turn_axes(self, inertia: FloatArray, turn: Sequence[float]) -> None:
        """Turn the principal axes of `inertia` by a rotation vector (3,) rad."""
        x, y, z = turn
        rotation = np.array(matrix(exponential(x, y, z))).T
        self._inertia = rotation @ inertia @ rotation.T
        self._inverse = np.linalg.inv(self._inertia)
        self._inertia_rows, self._inverse_rows = _rows(self._inertia), _rows(self._inverse)

    def _step(self, dipole: Vector, dt: float) -> None:
        """One step of the midpoint rule, and of the covariance."""
        assert self._rate is not None
        rate, field, change = self._rate, self._field, self._change
        acceleration = self._acceleration(rate, field, dipole)
        middle = _moved(rate, acceleration, 0.5 * dt)
        half = _moved(field, _difference(change, cross(rate, field)), 0.5 * dt)
        acceleration = self._acceleration(middle, half, dipole)
        flow = self._flow(middle, half, change, dipole, dt)
        turned = exponential(dt * middle[0], dt * middle[1], dt * middle[2])
        rotation = matrix(turned)
        self._rate = _moved(rate, acceleration, dt)
        # The turn of the field is exact: over an hour the midpoint rule would let its length grow.
        self._field = _moved(times(rotation, field), times(rotation, change), dt)
        self._change = times(rotation, change)
        self._turn = compose(turned, self._turn)
        transition = _EYE + flow + 0.5 * (flow @ flow)
        covariance = transition @ self._covariance @ transition.T
        settings = self._settings
        # The gyroscopic error turns with the body: it lasts for the time of a radian.
        speed = math.sqrt(middle[0] ** 2 + middle[1] ** 2 + middle[2] ** 2)
        walks = covariance.reshape(-1)[:: SIZE + 1]
        gyroscopic = self._unexplained * self._differences
        walks[RATE] += dt * (settings.torque_walk**2 + speed**3 * gyroscopic**2)
        walks[CHANGE] += dt * settings.change_walk**2
        self._covariance = covariance

    def _acceleration(self, rate: Vector, field: Vector, dipole: Vector) -> Vector:
        momentum = times(self._inertia_rows, rate)
        return times(self._inverse_rows, _difference(cross(dipole, field), cross(rate, momentum)))

    def _flow(self, rate: Vector, field: Vector, change: Vector, dipole: Vector, dt: float) -> FloatArray:
        """Return the derivative (12, 12) of the states' change over dt by the states."""
        turning = np.array(skew(rate))
        momentum = times(self._inertia_rows, rate)
        torque = _difference(cross(dipole, field), cross(rate, momentum))
        flow = np.zeros((SIZE, SIZE))
        gyroscopic = np.array(skew(momentum))
        flow[RATE, RATE] = self._inverse @ (gyroscopic - turning @ self._inertia)
        # A small turn d changes J w by d x J w - J (d x w), and the inverse likewise.
        by_turn = self._inverse @ (np.array(skew(torque)) - turning @ (self._inertia @ turning - gyroscopic))
        flow[RATE, AXES] = by_turn - skew(times(self._inverse_rows, torque))
        flow[RATE, FIELD] = self._inverse @ np.array(skew(dipole))
        flow[FIELD, RATE] = skew(field)
        flow[FIELD, FIELD] = flow[CHANGE, CHANGE] = -turning
        flow[FIELD, CHANGE] = np.eye(3)
        flow[CHANGE, RATE] = skew(change)
        return np.asarray(dt * flow)


def _moved(v: Vector, change: Vector, dt: float) -> Vector:
    return v[0] + dt * change[0], v[1] + dt * change[1], v[2] + dt * change[2]


def _difference(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _sum(a: Vector, b: list[float]) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _floats(array: FloatArray) -> Vector:
    x, y, z = array.tolist()
    return x, y, z


def _rows(array: FloatArray) -> Matrix:
    a, b, c = (tuple(row) for row in array.tolist())
    return a, b, c
