"""The single-axis plant, the power of the coil, and polynomial paths of the angle.

The plant is a rigid body that hangs on a thread and is rotated by one torque coil in a fixed horizontal
field. The equation of motion is Sease 2013, eq. (5.4), with the thread and a constant disturbance d added: J
(w' - d) = n A B I cos(theta) - k theta - c w. The angle theta of the body about the thread defines the
quaternion component q2 = sin(theta/2). Planner, tracker and estimator use the same equations of motion, so
that the tracker can follow the planned path. Functions with singular names (`current`) accept floats and use
`math`, because they run in the 40 Hz control loop. Functions with plural names (`currents`) accept arrays of
equal shape.

The coils are driven by pulse-width modulation with a period of 20 ms (Sease 2013, chapter 5). The time
constant L/R of a coil, 0.1 ms, is short compared with the period, so the coil current is V/R while the
H-bridge drives the coil, and otherwise zero. At a mean coil current I the supply delivers the power V |I|
with V = R Imax. This power is dissipated in the coil. The cost R I^2 of Sease, eq. (5.1), is the heat of a
steady current I, and equals V |I| times the duty cycle.

The motion is discretised by the pseudospectral method of Sease, eq. (5.8). The n nodes are -1, 1 and the
roots of P'(x), where P is the Legendre polynomial of degree n - 1. Quadrature on the nodes is exact for
polynomials of degree 2n - 3, and the differentiation matrix for polynomials of degree n - 1. A path is a
single polynomial q2(t) of time. Angle, rate and acceleration follow exactly from q2 (Sease, eqs. (5.9) and
(5.13), corrected), so the planner's limits also hold between the nodes. After the end of a path, the
commanded motion holds the last attitude, or continues at the end rate up to the angle at which the coil has
no torque.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, legendre

from knightcube.astro.arrays import FloatArray, check_numbers
from knightcube.astro.quaternion import about_axis_y
from knightcube.errors import UsageError


def supply_power(current: FloatArray, voltage: float) -> FloatArray:
    """Return the power V |I|, W, that coils take from the supply for mean currents over a PWM period, A.

    With the voltage across a driven coil (`coils.supply_voltage`) as `voltage`, the result is the power at
    the coils. With the voltage of the bus before the H-bridge, the result is the power taken from the bus.
    """
    return np.asarray(voltage * np.abs(current))


def steady_heat(current: FloatArray, resistance: float | FloatArray) -> FloatArray:
    """Return the heating power R I^2 of steady currents, W; pulse-width modulated coils consume more."""
    return np.asarray(resistance * current * current)


Q2_LIMIT = 0.68
"""Upper bound of |q2| of all paths; at this value cos(theta) is 0.075. At |q2| = 0.707 the coil has no
torque."""


SQUARE_Q2_WITHOUT_AUTHORITY = 0.5
"""Value of q2^2 at which the coil has no torque, because the coil axis is parallel to the field and
cos(theta) = 1 - 2 q2^2 is zero (Sease, eq. (5.15), corrected)."""


@dataclass(frozen=True, slots=True)
class SingleAxisPlant:
    """The parameters of the equation of motion about the suspension thread.

    Attributes:
        inertia: moment of inertia J, kg m^2.
        torque_constant: torque per current of the coil at theta = 0 (n A B), N m/A.
        resistance: resistance of the coil, ohm.
        current_limit: largest absolute value of the coil current, A.
        stiffness: torsional stiffness k of the thread, N m/rad.
        damping: damping c, N m s/rad.
        disturbance: estimated constant angular acceleration d in addition to the modelled torques, rad/s^2.
    """

    inertia: float
    torque_constant: float
    resistance: float
    current_limit: float
    stiffness: float = 0.0
    damping: float = 0.0
    disturbance: float = 0.0

    def __post_init__(self) -> None:
        """Raise UsageError for parameters that are not numbers or are out of range."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        if not all(isinstance(value, float) for value in given.values()):
            check_numbers(**given)
        for name in ("inertia", "torque_constant", "resistance", "current_limit"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"plant {name} is {value}: it must be finite and positive")
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"plant {name} is {value}: it must be finite and not negative")
        if not math.isfinite(self.disturbance):
            raise UsageError(f"plant disturbance is {self.disturbance}: it must be finite")

    def current(self, angle: float, rate: float, acceleration: float) -> float:
        """Return the current (A) for an acceleration (rad/s^2) at an angle (rad) and a rate (rad/s)."""
        torque = (
            self.inertia * (acceleration - self.disturbance) + self.stiffness * angle + self.damping * rate
        )
        return torque / (self.torque_constant * math.cos(angle))

    def acceleration(self, angle: float, rate: float, current: float) -> float:
        """Return the angular acceleration (rad/s^2) under a current (A) (Sease, eq. (5.4))."""
        torque = self.torque_constant * current * math.cos(angle) - self.stiffness * angle
        return (torque - self.damping * rate) / self.inertia + self.disturbance

    def currents(self, angle: FloatArray, rate: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return the currents (n,) in A for arrays (n,) of accelerations, angles and rates."""
        torque = (
            self.inertia * (acceleration - self.disturbance) + self.stiffness * angle + self.damping * rate
        )
        return np.asarray(torque / (self.torque_constant * np.cos(angle)))


def angle_of(q2: float) -> float:
    """Return the angle theta = 2 asin(q2), rad."""
    return 2.0 * math.asin(q2)


def q2_of(angle: float) -> float:
    """Return q2 = sin(theta/2)."""
    return math.sin(0.5 * angle)


def rate_of(q2: float, q2_rate: float) -> float:
    """Return the body rate w = 2 q2' / sqrt(1 - q2^2) in rad/s (Sease, eq. (5.9))."""
    return 2.0 * q2_rate / math.sqrt(1.0 - q2 * q2)


def q2_rate_of(q2: float, rate: float) -> float:
    """Return the derivative q2' = w sqrt(1 - q2^2) / 2 in 1/s (Sease, eq. (5.9))."""
    return 0.5 * rate * math.sqrt(1.0 - q2 * q2)


def acceleration_of(q2: float, q2_rate: float, q2_acceleration: float) -> float:
    """Return the acceleration w' = 2 q2''/u + 2 q2 q2'^2/u^3, rad/s^2, where u = sqrt(1 - q2^2)."""
    square = 1.0 - q2 * q2
    return 2.0 * (q2_acceleration + q2 * q2_rate * q2_rate / square) / math.sqrt(square)


def motion_of(
    q2: FloatArray, q2_rate: FloatArray, q2_acceleration: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return angles, rates and accelerations (n,) from q2 (n,) and the first two time derivatives of q2."""
    square = 1.0 - q2 * q2
    root = np.sqrt(square)
    acceleration = 2.0 * (q2_acceleration + q2 * q2_rate * q2_rate / square) / root
    return 2.0 * np.arcsin(q2), 2.0 * q2_rate / root, acceleration


def current_and_slopes(
    plant: SingleAxisPlant, q2: FloatArray, q2_rate: FloatArray, q2_acceleration: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return currents (n,), A, and their partial derivatives (n,) with respect to q2, q2' and q2''.

    The current follows from Sease, eq. (5.6), but with the exact w' and with the torques of the suspension
    thread and the disturbance.
    """
    square = 1.0 - q2 * q2
    by_acceleration = 2.0 / np.sqrt(square)  # the derivative dw'/dq2'' equals dw/dq2'
    ratio = q2_rate / square
    swing = q2 * ratio
    cosine = 1.0 - 2.0 * q2 * q2
    scale = 1.0 / (plant.torque_constant * cosine)

    acceleration = by_acceleration * (q2_acceleration + q2_rate * swing)
    torque = plant.inertia * (acceleration - plant.disturbance)
    torque_by_q2 = plant.inertia * (
        acceleration * q2 / square + by_acceleration * (q2_rate * ratio * (1.0 + q2 * q2) / square)
    )
    torque_by_rate = plant.inertia * 2.0 * by_acceleration * swing
    if plant.stiffness:
        torque = torque + plant.stiffness * 2.0 * np.arcsin(q2)
        torque_by_q2 = torque_by_q2 + plant.stiffness * by_acceleration
    if plant.damping:
        torque = torque + plant.damping * by_acceleration * q2_rate
        torque_by_q2 = torque_by_q2 + plant.damping * by_acceleration * swing
        torque_by_rate = torque_by_rate + plant.damping * by_acceleration
    current = torque * scale
    by_q2 = torque_by_q2 * scale + current * (4.0 * q2 / cosine)
    return current, by_q2, torque_by_rate * scale, plant.inertia * by_acceleration * scale


_ROUNDED = 0.1
"""Parameter e of the smooth approximation of |I| in the cost, divided by Imax. The cost uses sqrt(I^2 + e^2)
- e instead of |I|, because the slope of |I| is discontinuous."""


class PathCost(StrEnum):
    """The power whose integral is minimised along a path."""

    HEAT = "heat"
    SUPPLY = "supply"

    def power(self, plant: SingleAxisPlant, current: FloatArray) -> FloatArray:
        """Return the power in W for mean currents (m,) in A."""
        if self is PathCost.HEAT:
            return steady_heat(current, plant.resistance)
        return supply_power(current, plant.resistance * plant.current_limit)

    def smooth(self, plant: SingleAxisPlant, current: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the smoothed power, W, for currents (m,), A, and the derivative of the power, W/A."""
        if self is PathCost.HEAT:
            pull = plant.resistance * current
            return pull * current, 2.0 * pull
        voltage, rounding = plant.resistance * plant.current_limit, _ROUNDED * plant.current_limit
        size = np.sqrt(current * current + rounding * rounding)
        return voltage * (size - rounding), voltage * current / size


@dataclass(frozen=True, slots=True)
class LglRule:
    """Legendre-Gauss-Lobatto nodes with quadrature weights and differentiation matrix.

    Attributes:
        nodes: Legendre-Gauss-Lobatto nodes (n,) in ascending order from -1 to 1.
        weights: quadrature weights (n,), whose sum is 2.
        differentiation: matrix (n, n) that maps values on the nodes to derivatives on the nodes.
        barycentric: weights (n,) of barycentric Lagrange interpolation through the nodes.
    """

    nodes: FloatArray
    weights: FloatArray
    differentiation: FloatArray
    barycentric: FloatArray

    def interpolation(self, points: FloatArray) -> FloatArray:
        """Return the matrix (m, n) that maps values on the nodes to values at `points` (m,) in [-1, 1]."""
        difference = np.asarray(points, dtype=float)[:, None] - self.nodes
        hit = difference == 0.0
        terms = self.barycentric / np.where(hit, 1.0, difference)
        rows = terms / terms.sum(axis=1, keepdims=True)
        return np.asarray(np.where(hit.any(axis=1, keepdims=True), hit.astype(float), rows))


@lru_cache(maxsize=32)
def lgl_rule(count: int) -> LglRule:
    """Return the Legendre-Gauss-Lobatto rule with `count` nodes.

    Raises UsageError for fewer than two nodes.
    """
    if count < 2:
        raise UsageError(f"{count} Legendre-Gauss-Lobatto nodes: at least 2, the ends, are needed")
    degree = count - 1
    series = legendre.Legendre.basis(degree)
    inner = np.sort(np.real(series.deriv().roots()))
    slope, curvature = series.deriv(), series.deriv(2)
    # Three Newton steps refine the eigenvalues of the companion matrix, which are accurate to 1e-12.
    for _ in range(3):
        inner = inner - slope(inner) / curvature(inner)
    nodes = np.concatenate([[-1.0], 0.5 * (inner - inner[::-1]), [1.0]])

    values = series(nodes)
    weights = 2.0 / (degree * (degree + 1) * values**2)
    barycentric = 1.0 / values
    gap = nodes[:, None] - nodes + np.eye(count)
    differentiation = barycentric / barycentric[:, None] / gap
    # The elements of each row add up to zero, so that the derivative of a constant is zero.
    np.fill_diagonal(differentiation, 0.0)
    np.fill_diagonal(differentiation, -differentiation.sum(axis=1))
    for array in (nodes, weights, differentiation, barycentric):
        array.setflags(write=False)
    return LglRule(nodes, weights, differentiation, barycentric)


@dataclass(frozen=True, slots=True)
class CubicPrey:
    """A cubic path q_p(t) = C0 + C1 t + C2 t^2 + C3 t^3, with t in s (Sease, eq. (5.35)).

    The cubic is the initial guess of a path (the prey path of virtual motion camouflage).
    """

    c0: float
    c1: float
    c2: float
    c3: float

    @classmethod
    def between(
        cls, start: float, start_slope: float, end: float, end_slope: float, horizon: float
    ) -> CubicPrey:
        """Return the cubic from `start` to `end` in `horizon` s for given slopes q2', 1/s, at both ends."""
        c2 = (3.0 * (end - start) - (2.0 * start_slope + end_slope) * horizon) / horizon**2
        c3 = (end_slope - start_slope - 2.0 * c2 * horizon) / (3.0 * horizon**2)
        return cls(start, start_slope, c2, c3)

    def q2(self, time: FloatArray) -> FloatArray:
        """Return the values q_p (n,) of the cubic at `time` (n,), s (Sease, eq. (5.35))."""
        return np.asarray(self.c0 + time * (self.c1 + time * (self.c2 + time * self.c3)))

    def q2_rate(self, time: FloatArray) -> FloatArray:
        """Return the derivatives q_p' (n,), 1/s, of the cubic at `time` (n,), s (Sease, eq. (5.36))."""
        return np.asarray(self.c1 + time * (2.0 * self.c2 + time * 3.0 * self.c3))


FARTHEST = angle_of(Q2_LIMIT)
"""Largest angle (rad) that the commanded motion reaches at the end rate after the end of a path."""


class PathSample(NamedTuple):
    """The commanded angle (rad), rate (rad/s) and acceleration (rad/s^2) at one time."""

    angle: float
    rate: float
    acceleration: float

    @property
    def quaternion(self) -> FloatArray:
        """Attitude quaternion (4,) of the commanded angle about body y."""
        return about_axis_y(self.angle)

    @property
    def body_rate(self) -> FloatArray:
        """Body rate (3,), rad/s."""
        return np.array([0.0, self.rate, 0.0])


@dataclass(frozen=True, slots=True)
class PolynomialPath:
    """A polynomial path of the angle that starts at `origin_ns` and lasts `horizon` s.

    Attributes:
        origin_ns: monotonic time of the start of the path, ns.
        horizon: duration of the path, s, which is zero for a held attitude.
        series: Chebyshev coefficients of q2, q2' (1/s) and q2'' (1/s^2), highest degree first.
        end_angle: angle at the end of the path, rad.
        end_rate: constant rate after the end of the path, rad/s, which is zero if the end attitude is held.
    """

    origin_ns: int
    horizon: float
    series: tuple[tuple[float, float, float], ...]
    end_angle: float
    end_rate: float = 0.0

    @classmethod
    def through(
        cls, node_q2: FloatArray, horizon: float, origin_ns: int = 0, end_rate: float = 0.0
    ) -> PolynomialPath:
        """Return the polynomial path through the values q2 (N,) on N Legendre-Gauss-Lobatto nodes.

        After `horizon` s, the path continues at `end_rate` rad/s.
        """
        count = node_q2.size
        columns = np.zeros((count, 3))
        columns[:, 0] = _chebyshev_fit(count) @ node_q2
        columns[:-1, 1] = chebyshev.chebder(columns[:, 0], scl=2.0 / horizon)
        columns[:-2, 2] = chebyshev.chebder(columns[:-1, 1], scl=2.0 / horizon)
        series = tuple((q2, rate, acceleration) for q2, rate, acceleration in columns[::-1].tolist())
        return cls(origin_ns, horizon, series, angle_of(float(node_q2[-1])), end_rate)

    @classmethod
    def holding(cls, angle: float, origin_ns: int = 0) -> PolynomialPath:
        """Return the path that holds `angle` rad indefinitely."""
        return cls(origin_ns, 0.0, (), angle)

    def starting_at(self, origin_ns: int) -> PolynomialPath:
        """Return a copy of the path with the start time `origin_ns`."""
        return replace(self, origin_ns=origin_ns)

    def has_ended(self, now_ns: int) -> bool:
        """Return whether the path has ended at `now_ns`."""
        return (now_ns - self.origin_ns) * 1e-9 >= self.horizon

    def sample(self, now_ns: int) -> PathSample:
        """Return the motion at `now_ns`, which is the initial motion before the path and a coast after it."""
        elapsed = (now_ns - self.origin_ns) * 1e-9
        if elapsed >= self.horizon:
            angle = self.end_angle + self.end_rate * (elapsed - self.horizon)
            farthest = max(FARTHEST, abs(self.end_angle))
            if abs(angle) > farthest:
                return PathSample(math.copysign(farthest, angle), 0.0, 0.0)
            return PathSample(angle, self.end_rate, 0.0)
        s = 2.0 * max(elapsed, 0.0) / self.horizon - 1.0
        # Clenshaw's recurrence is faster with Python floats than with numpy arrays of twenty elements.
        twice = 2.0 * s
        a1 = a2 = b1 = b2 = c1 = c2 = 0.0
        for a, b, c in self.series[:-1]:
            a1, a2 = a + twice * a1 - a2, a1
            b1, b2 = b + twice * b1 - b2, b1
            c1, c2 = c + twice * c1 - c2, c1
        a, b, c = self.series[-1]
        q2, q2_rate, q2_acceleration = a + s * a1 - a2, b + s * b1 - b2, c + s * c1 - c2
        return PathSample(angle_of(q2), rate_of(q2, q2_rate), acceleration_of(q2, q2_rate, q2_acceleration))

    def motion(self, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return angle, rate and acceleration (n,) at `times` (n,), s after the start; NaN where |q2| > 1."""
        times = np.asarray(times, dtype=float)
        coasted = self.end_angle + self.end_rate * (times - self.horizon)
        farthest = max(FARTHEST, abs(self.end_angle))
        angle = np.clip(coasted, -farthest, farthest)
        rate = np.where(angle == coasted, self.end_rate, 0.0)
        acceleration = np.zeros(times.shape)
        under_way = times < self.horizon
        if under_way.any():
            s = 2.0 * np.maximum(times[under_way], 0.0) / self.horizon - 1.0
            columns = np.array(self.series[::-1])
            with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
                q2, q2_rate, q2_acceleration = chebyshev.chebval(s, columns)
                moving = motion_of(q2, q2_rate, q2_acceleration)
            angle[under_way], rate[under_way], acceleration[under_way] = moving
        return angle, rate, acceleration


@lru_cache(maxsize=8)
def _chebyshev_fit(count: int) -> FloatArray:
    """Return the matrix (N, N) that maps values on N nodes to Chebyshev coefficients of the polynomial."""
    return np.asarray(np.linalg.inv(chebyshev.chebvander(lgl_rule(count).nodes, count - 1)), dtype=float)
