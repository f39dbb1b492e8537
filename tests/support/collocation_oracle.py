"""Independent optimum of a single-axis slew by direct collocation and an interior-point solver.

The method is independent of the planner. The states of the method are theta and omega, and the planner's
state is q2. The method discretises by the trapezoidal rule on some hundreds of intervals, and the planner by
a polynomial. The method solves the banded optimality system by a primal-dual interior-point method, and the
planner uses SLSQP. The discretisation error is of second order in the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True)
class Slew:
    """A slew between two states (rad, rad/s), with plant parameters in SI, and a disturbance in rad/s^2."""

    start_angle: float
    start_rate: float
    end_angle: float
    end_rate: float
    horizon: float
    inertia: float
    torque_constant: float
    resistance: float
    current_limit: float
    stiffness: float = 0.0
    damping: float = 0.0
    disturbance: float = 0.0


@dataclass(frozen=True)
class Optimum:
    """Smallest integral of R I^2 (J), with theta (rad) and I (A) on the grid (m + 1,)."""

    energy: float
    angle: FloatArray
    current: FloatArray


def solve(slew: Slew, intervals: int = 400, tolerance: float = 1e-9, iterations: int = 80) -> Optimum | None:
    """Return the optimum, or None if the iteration fails, for example because the slew is infeasible."""
    point = _InteriorPoint(slew, intervals)
    for _ in range(iterations):
        if point.residual() < tolerance and point.barrier <= 1e-9:
            energy = slew.resistance * slew.current_limit**2 * float(point.weights @ point.u**2)
            return Optimum(energy, point.theta, point.u * slew.current_limit)
        if not point.step():
            return None
    return None


class _InteriorPoint:
    """Minimisation of sum w u^2 for |u| <= 1 and zero trapezoidal defects, where u is current / limit.

    The unknowns are ordered by grid point: theta, omega, u, and the two multipliers of the following
    interval. In this order, the Newton matrix is banded, with four diagonals on either side.
    """

    def __init__(self, slew: Slew, intervals: int) -> None:
        self.n = intervals + 1
        self.h = slew.horizon / intervals
        self.gain = slew.torque_constant * slew.current_limit / slew.inertia
        self.spring = slew.stiffness / slew.inertia
        self.drag = slew.damping / slew.inertia
        self.constant = slew.disturbance
        self.weights = np.full(self.n, self.h)
        self.weights[[0, -1]] *= 0.5
        time = np.linspace(0.0, slew.horizon, self.n)
        # The first guess of theta is a cubic that satisfies the boundary states. No step changes the boundary
        # states.
        change = np.array(
            [
                slew.end_angle - slew.start_angle - slew.start_rate * slew.horizon,
                slew.end_rate - slew.start_rate,
            ]
        )
        c2, c3 = np.linalg.solve(
            [[slew.horizon**2, slew.horizon**3], [2 * slew.horizon, 3 * slew.horizon**2]], change
        )
        self.theta = slew.start_angle + slew.start_rate * time + c2 * time**2 + c3 * time**3
        self.omega = slew.start_rate + 2 * c2 * time + 3 * c3 * time**2
        self.u = np.clip((2 * c2 + 6 * c3 * time) / (self.gain * np.cos(self.theta)), -0.8, 0.8)
        self.multipliers = np.zeros((self.n - 1, 2))
        self.barrier = 0.1
        self.lower = self.barrier / (1.0 + self.u)
        self.upper = self.barrier / (1.0 - self.u)

    def _acceleration(self) -> FloatArray:
        return np.asarray(
            self.gain * self.u * np.cos(self.theta)
            - self.spring * self.theta
            - self.drag * self.omega
            + self.constant
        )

    def _defects(self) -> FloatArray:
        a = self._acceleration()
        first = np.diff(self.theta) - 0.5 * self.h * (self.omega[1:] + self.omega[:-1])
        second = np.diff(self.omega) - 0.5 * self.h * (a[1:] + a[:-1])
        return np.stack([first, second], axis=1)

    def _gradient(self) -> FloatArray:
        """Return the Lagrangian's gradient (n, 3) in theta, omega and u, without the terms of the bounds."""
        cos, sin = np.cos(self.theta), np.sin(self.theta)
        difference = np.zeros((self.n, 2))  # derivative of x_(k+1) - x_k times the multipliers
        difference[1:] += self.multipliers
        difference[:-1] -= self.multipliers
        mean = self._neighbour_sum() * (0.5 * self.h)
        by_theta = difference[:, 0] - mean[:, 1] * (-self.gain * self.u * sin - self.spring)
        by_omega = difference[:, 1] - mean[:, 0] + mean[:, 1] * self.drag
        by_u = 2 * self.weights * self.u - mean[:, 1] * self.gain * cos
        return np.stack([by_theta, by_omega, by_u], axis=1)

    def _neighbour_sum(self) -> FloatArray:
        total = np.zeros((self.n, 2))
        total[1:] += self.multipliers
        total[:-1] += self.multipliers
        return total

    def residual(self) -> float:
        """Return the largest violation of the optimality conditions, including complementarity."""
        gradient = self._gradient()
        gradient[:, 2] += self.upper - self.lower
        gradient[[0, -1], :2] = 0.0
        gaps = np.concatenate([self.lower * (1 + self.u), self.upper * (1 - self.u)]) - self.barrier
        return float(max(np.abs(gradient).max(), np.abs(self._defects()).max(), np.abs(gaps).max()))

    def step(self) -> bool:
        """Take one Newton step of the perturbed conditions; return False if the step fails."""
        rhs = np.zeros((self.n, 5))
        rhs[:, :3] = -self._gradient()
        rhs[:, 2] += self.barrier / (1 + self.u) - self.barrier / (1 - self.u)
        rhs[:-1, 3:] = -self._defects()
        rhs[[0, -1], :2] = 0.0
        change = solve_banded((4, 4), self._matrix(), rhs.ravel()).reshape(self.n, 5)
        if not np.isfinite(change).all():
            return False
        du = change[:, 2]
        d_lower = self.barrier / (1 + self.u) - self.lower - self.lower / (1 + self.u) * du
        d_upper = self.barrier / (1 - self.u) - self.upper + self.upper / (1 - self.u) * du
        primal = min(_reach(1 + self.u, du), _reach(1 - self.u, -du))
        dual = min(_reach(self.lower, d_lower), _reach(self.upper, d_upper))
        self.theta = self.theta + primal * change[:, 0]
        self.omega = self.omega + primal * change[:, 1]
        self.u = self.u + primal * du
        self.multipliers = self.multipliers + primal * change[:-1, 3:]
        self.lower = self.lower + dual * d_lower
        self.upper = self.upper + dual * d_upper
        if self.residual() < 10 * self.barrier:
            self.barrier = max(1e-10, min(0.2 * self.barrier, self.barrier**1.5))
        # The iteration fails if a variable reaches its bound or passes the singularity.
        return bool(np.abs(self.u).max() < 1.0 - 1e-13 and np.abs(self.theta).max() < 1.6)

    def _matrix(self) -> FloatArray:
        """Return the Newton matrix (9, 5 n) in the diagonal ordered form of solve_banded."""
        band = np.zeros((9, self.n, 5))

        def put(row: int, column: int, values: FloatArray | float, ahead: int = 0) -> None:
            """Set the entry (row of point k, column of point k + ahead) for all k for which it exists."""
            stop = self.n - ahead
            band[4 + row - column - 5 * ahead, ahead : ahead + stop, column] = np.broadcast_to(
                values, self.n
            )[:stop]

        cos, sin = np.cos(self.theta), np.sin(self.theta)
        mean = self._neighbour_sum()[:, 1] * (0.5 * self.h)
        inner = np.ones(self.n)
        inner[[0, -1]] = 0.0
        put(0, 0, np.where(inner > 0, mean * self.gain * self.u * cos, 1.0))
        put(0, 2, inner * mean * self.gain * sin)
        put(2, 0, mean * self.gain * sin)
        put(1, 1, 1.0 - inner)
        put(2, 2, 2 * self.weights + self.lower / (1 + self.u) + self.upper / (1 - self.u))
        by_theta = 0.5 * self.h * (-self.gain * self.u * sin - self.spring)
        by_u = 0.5 * self.h * self.gain * cos
        half, drag = 0.5 * self.h, 0.5 * self.h * self.drag
        last = np.ones(self.n)
        # no interval follows the last point, so its multiplier rows are rows of the unit matrix
        last[-1] = 0.0
        # Derivatives of the defects of interval k with respect to the states of points k and k + 1.
        put(3, 0, -last)
        put(3, 1, -half * last)
        put(4, 0, -by_theta * last)
        put(4, 1, (drag - 1.0) * last)
        put(4, 2, -by_u * last)
        put(3, 3, 1.0 - last)
        put(4, 4, 1.0 - last)
        put(3, 0, 1.0, 1)
        put(3, 1, -half, 1)
        put(4, 0, -by_theta[np.r_[1 : self.n, 0]], 1)
        put(4, 1, 1.0 + drag, 1)
        put(4, 2, -by_u[np.r_[1 : self.n, 0]], 1)
        # Transposed derivatives: the state rows with respect to the multipliers of the next and of the
        # previous interval.
        first = inner * last
        put(0, 3, -first)
        put(0, 4, -by_theta * first)
        put(1, 3, -half * first)
        put(1, 4, (drag - 1.0) * first)
        put(2, 4, -by_u * last)
        self._put_before(band, 0, 3, inner)
        self._put_before(band, 0, 4, -by_theta * inner)
        self._put_before(band, 1, 3, -half * inner)
        self._put_before(band, 1, 4, (1.0 + drag) * inner)
        self._put_before(band, 2, 4, -by_u)
        return band.reshape(9, 5 * self.n)

    def _put_before(self, band: FloatArray, row: int, column: int, values: FloatArray) -> None:
        """Set the entry (row of point k, column of point k - 1) for each k >= 1."""
        band[4 + row - column + 5, :-1, column] = values[1:]


def _reach(distance: FloatArray, change: FloatArray) -> float:
    """Return the largest step <= 1 for which distance + step * change is at least 0.5 % of distance."""
    shrinking = change < 0
    if not shrinking.any():
        return 1.0
    return float(min(1.0, 0.995 * np.min(-distance[shrinking] / change[shrinking])))
