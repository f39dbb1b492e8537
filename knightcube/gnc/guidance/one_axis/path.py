"""Paths of the angle in time: Legendre-Gauss-Lobatto polynomials, the prey's cubic, and sampling at 40 Hz.

The pseudospectral discretisation is that of Sease 2013, 5.8. The n nodes are -1, 1 and the roots of P'(x), P
the Legendre polynomial of degree n - 1. Quadrature on the nodes is exact to degree 2n - 3, the
differentiation matrix to degree n - 1.

A path is one polynomial in time of q2, as computed by the planner. Angle, rate and acceleration follow from
q2 exactly (Sease 5.9; 5.13 corrected), so that the limit imposed by the planner also holds between nodes.
After its end a path holds its last attitude, or coasts at its end rate as far as the coil has authority.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev, legendre

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y
from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT, acceleration_of, angle_of, motion_of, rate_of


@dataclass(frozen=True, slots=True)
class LglRule:
    """A set of nodes with its matrices; the arrays are read-only because rules are shared.

    Attributes:
        nodes: (n,) ascending, from -1 to 1.
        weights: (n,) of the quadrature; their sum is 2.
        differentiation: (n, n) from values on the nodes to derivatives on the nodes.
        barycentric: (n,) weights of Lagrange interpolation through the nodes.
    """

    nodes: FloatArray
    weights: FloatArray
    differentiation: FloatArray
    barycentric: FloatArray

    def interpolation(self, points: FloatArray) -> FloatArray:
        """Return the matrix (m, n) from values on the nodes to values at `points` (m,) in [-1, 1]."""
        difference = np.asarray(points, dtype=float)[:, None] - self.nodes
        hit = difference == 0.0
        terms = self.barycentric / np.where(hit, 1.0, difference)
        rows = terms / terms.sum(axis=1, keepdims=True)
        return np.asarray(np.where(hit.any(axis=1, keepdims=True), hit.astype(float), rows))


@lru_cache(maxsize=32)
def lgl_rule(count: int) -> LglRule:
    """Return the rule of `count` >= 2 nodes; raises UsageError below that."""
    if count < 2:
        raise UsageError(f"{count} Legendre-Gauss-Lobatto nodes: at least 2, the ends, are needed")
    degree = count - 1
    series = legendre.Legendre.basis(degree)
    inner = np.sort(np.real(series.deriv().roots()))
    slope, curvature = series.deriv(), series.deriv(2)
    for _ in range(3):  # the companion matrix is good to about 1e-12; Newton refines to rounding
        inner = inner - slope(inner) / curvature(inner)
    nodes = np.concatenate([[-1.0], 0.5 * (inner - inner[::-1]), [1.0]])

    values = series(nodes)
    weights = 2.0 / (degree * (degree + 1) * values**2)
    barycentric = 1.0 / values
    gap = nodes[:, None] - nodes + np.eye(count)
    differentiation = barycentric / barycentric[:, None] / gap
    # The diagonal is minus the sum of its row, so that the derivative of a constant is zero to rounding.
    np.fill_diagonal(differentiation, 0.0)
    np.fill_diagonal(differentiation, -differentiation.sum(axis=1))
    for array in (nodes, weights, differentiation, barycentric):
        array.setflags(write=False)
    return LglRule(nodes, weights, differentiation, barycentric)


@dataclass(frozen=True, slots=True)
class CubicPrey:
    """q_p(t) = C0 + C1 t + C2 t^2 + C3 t^3 for t in s (5.35)."""

    c0: float
    c1: float
    c2: float
    c3: float

    @classmethod
    def between(
        cls, start: float, start_slope: float, end: float, end_slope: float, horizon: float
    ) -> CubicPrey:
        """Return the cubic from `start` to `end` in `horizon` s, slopes q2' in 1/s (5.37, 5.38)."""
        c2 = (3.0 * (end - start) - (2.0 * start_slope + end_slope) * horizon) / horizon**2
        c3 = (end_slope - start_slope - 2.0 * c2 * horizon) / (3.0 * horizon**2)
        return cls(start, start_slope, c2, c3)

    def q2(self, time: FloatArray) -> FloatArray:
        """Return q_p (n,) at `time` (n,) s (5.35)."""
        return np.asarray(self.c0 + time * (self.c1 + time * (self.c2 + time * self.c3)))

    def q2_rate(self, time: FloatArray) -> FloatArray:
        """Return q_p' (n,) in 1/s at `time` (n,) s (5.36)."""
        return np.asarray(self.c1 + time * (2.0 * self.c2 + time * 3.0 * self.c3))


FARTHEST = angle_of(Q2_LIMIT)
"""Largest angle of a coast, rad."""


@dataclass(frozen=True, slots=True)
class PathSample:
    """The commanded motion at one time: theta in rad, theta' in rad/s, theta'' in rad/s^2."""

    angle: float
    rate: float
    acceleration: float

    @property
    def quaternion(self) -> FloatArray:
        """Attitude (4,) of the angle about body y."""
        return about_axis_y(self.angle)

    @property
    def body_rate(self) -> FloatArray:
        """Body rate (3,), rad/s."""
        return np.array([0.0, self.rate, 0.0])


@dataclass(frozen=True, slots=True)
class PolynomialPath:
    """A path that starts at `origin_ns` and lasts `horizon` s.

    Attributes:
        origin_ns: monotonic time of its start.
        horizon: s; zero for a held attitude.
        series: Chebyshev coefficients of (q2, q2' in 1/s, q2'' in 1/s^2), highest degree first.
        end_angle: theta in rad at the horizon.
        end_rate: theta' in rad/s kept after the horizon; zero holds the end.
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
        """Return the polynomial path through q2 (N,) on the N Legendre-Gauss-Lobatto nodes of `horizon` s.

        The path coasts at `end_rate` rad/s after the horizon.
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
        """Return the same path, starting at `origin_ns`."""
        return replace(self, origin_ns=origin_ns)

    def has_ended(self, now_ns: int) -> bool:
        """Return whether the horizon has passed at `now_ns`."""
        return (now_ns - self.origin_ns) * 1e-9 >= self.horizon

    def sample(self, now_ns: int) -> PathSample:
        """Return the commanded motion at `now_ns`: the start before the origin, a coast after the end."""
        elapsed = (now_ns - self.origin_ns) * 1e-9
        if elapsed >= self.horizon:
            return self._coast(elapsed - self.horizon)
        s = 2.0 * max(elapsed, 0.0) / self.horizon - 1.0
        # Clenshaw's recurrence on three series at once; floats are faster than numpy arrays of twenty
        # elements.
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
        """Return theta, theta', theta'' (n,) at `times` (n,) s after the origin, NaN where |q2| > 1."""
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

    def _coast(self, since: float) -> PathSample:
        """Return the motion `since` s after the horizon."""
        angle = self.end_angle + self.end_rate * since
        farthest = max(FARTHEST, abs(self.end_angle))
        if abs(angle) > farthest:
            return PathSample(math.copysign(farthest, angle), 0.0, 0.0)
        return PathSample(angle, self.end_rate, 0.0)


@lru_cache(maxsize=8)
def _chebyshev_fit(count: int) -> FloatArray:
    """Return the matrix (N, N) from values on N nodes to Chebyshev coefficients."""
    return np.asarray(np.linalg.inv(chebyshev.chebvander(lgl_rule(count).nodes, count - 1)), dtype=float)
