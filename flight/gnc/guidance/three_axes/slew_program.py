"""Newton's method on a slew's equations, with barriers for its limits: a primal-dual interior point method.

Wachter and Biegler, Math. Program. 106 (2006), with the curvature test of Chiang and Zavala (Math. Program.
2016) in place of a count of eigenvalues. Without limits it is Newton's method itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.errors import PlanningError
from flight.gnc.guidance.three_axes.slew_band import solve
from flight.gnc.guidance.three_axes.slew_limits import Limits
from flight.gnc.guidance.three_axes.slew_transcription import Linear, Trajectory, Transcription
from flight.gnc.math.arrays import FloatArray

_TOLERANCE = 1e-6
_TO_BOUNDARY = 0.995
_HALVINGS = 7
_CONVEX = 1e-3, 1e4


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """An iterate.

    Attributes:
        linear: the equations around its trajectory.
        price: (size,) the equations' multipliers, in their places.
        slack, dual: of every limit.
        slope: (size,) of the Lagrangian without the limits' part, equations in their places.
    """

    linear: Linear
    price: FloatArray
    slack: FloatArray
    dual: FloatArray
    slope: FloatArray

    @property
    def at(self) -> Trajectory:
        """The trajectory."""
        return self.linear.at


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A Newton step: of all unknowns (size,), and of the limits' slacks and duals."""

    change: FloatArray
    slack: FloatArray
    dual: FloatArray


class Program:
    """Least cost within limits."""

    def __init__(self, equations: Transcription, limits: Limits) -> None:
        self._equations, self._limits = equations, limits
        place = equations.layout
        self._equal = np.concatenate([place.equations.ravel(), place.start, place.end])
        self._primal = np.concatenate([place.states.ravel(), place.dipoles.ravel()])
        self.steps = 0

    def minimise(
        self,
        guess: Trajectory,
        price: FloatArray | None = None,
        barrier: float = 1e-3,
        last: float = 1e-8,
        most: int = 60,
    ) -> Point | None:
        """Return the optimum found from a guess within `most` steps, None when there is none.

        Barriers fall from `barrier` to `last`. Costs should be about one. `price` (size,) are multipliers of
        the equations.
        """
        values = self._limits.values(guess)
        slack = np.maximum(values, 1e-2)
        price = np.zeros(self._equations.layout.size) if price is None else price
        point = self._point(guess, price, slack, barrier / slack)
        barrier, convex = (barrier if slack.size else 0.0), 0.0
        for _ in range(most):
            error = self._error(point, barrier)
            while error < 10.0 * barrier and barrier > last:
                barrier = max(last, min(0.2 * barrier, barrier**1.5))
                error = self._error(point, barrier)
            if error < max(_TOLERANCE, 10.0 * last):
                return point
            self.steps += 1
            try:
                moved, convex = self._moved(point, barrier, convex, error)
            except PlanningError:
                return None
            if moved is None:
                return None
            point = moved
        return None

    def _point(self, at: Trajectory, price: FloatArray, slack: FloatArray, dual: FloatArray) -> Point:
        equations = self._equations
        linear = equations.linear(at)
        return Point(linear, price, slack, dual, equations.slope(linear, price))

    def _error(self, point: Point, barrier: float) -> float:
        """Return the largest remainder of the equations of optimality at a barrier."""
        worst = float(np.abs(point.slope - self._limits.pull(point.at, point.dual)).max())
        if point.slack.size:
            worst = max(worst, float(np.abs(self._limits.values(point.at) - point.slack).max()))
            worst = max(worst, float(np.abs(point.slack * point.dual - barrier).max()))
        return worst

    def _moved(self, point: Point, barrier: float, convex: float, error: float) -> tuple[Point | None, float]:
        """Return the next iterate, None without one, and the convexity that it took."""
        stiffness = self._limits.stiffness(point.at, point.dual, point.slack)
        for _ in range(10):
            step = self._newton(point, barrier, convex, stiffness)
            if step is not None:
                moved = self._searched(point, step, barrier, error)
                if moved is not None:
                    return moved, (0.25 * convex if convex > _CONVEX[0] else 0.0)
            convex = max(5.0 * convex, _CONVEX[0])
            if convex > _CONVEX[1]:
                break
        return None, convex

    def _newton(
        self, point: Point, barrier: float, convex: float, stiffness: tuple[FloatArray, FloatArray]
    ) -> Step | None:
        """Return the Newton step with `convex` added to the curvature; None where that stays concave."""
        limits, at, (states, heavy) = self._limits, point.at, stiffness
        stiff = point.dual / point.slack
        off = limits.values(at) - point.slack
        # The limits' duals after the step, were it to move nothing.
        toward = barrier / point.slack - stiff * off
        band = self._equations.band(point.linear, point.price, states + convex * np.eye(7), heavy + convex)
        right = limits.pull(at, toward) - point.slope
        change = solve(band, right[:, None])[:, 0]
        # d.H.d, from the equations just solved: H d = right - C' dl, C d = right.
        equal, primal = self._equal, self._primal
        bend = right[primal] @ change[primal] - right[equal] @ change[equal]
        if bend <= 1e-8 * min(convex, 1.0) * float(change[primal] @ change[primal]):
            return None
        along = limits.along(at, change)
        return Step(change, along + off, toward - stiff * along - point.dual)

    def _searched(self, point: Point, step: Step, barrier: float, error: float) -> Point | None:
        """Return the point along a step that lowers the error, or the merit; None without one."""
        equal, at, place = self._equal, point.at, self._equations.layout
        size = _share(point.slack, step.slack)
        dual = point.dual + _share(point.dual, step.dual) * step.dual
        weight = 2.0 * float(np.abs(point.price[equal] + step.change[equal]).max())
        before, violation = self._merit(at, point.slack, barrier, weight)
        for attempt in range(_HALVINGS):
            there = Trajectory(
                at.states + size * step.change[place.states],
                at.dipoles + size * step.change[place.dipoles],
            )
            slack = point.slack + size * step.slack
            after, _ = self._merit(there, slack, barrier, weight)
            lowered = after < before - 1e-5 * size * weight * violation
            if lowered or attempt == 0:
                price = point.price.copy()
                price[equal] += size * step.change[equal]
                moved = self._point(there, price, slack, dual)
                if lowered or self._error(moved, barrier) < 0.9 * error:
                    return moved
            size *= 0.5
        return None

    def _merit(self, at: Trajectory, slack: FloatArray, barrier: float, weight: float) -> tuple[float, float]:
        """Return cost and barriers plus `weight` times the violation of all equations, and that violation."""
        violation = sum(float(np.abs(part).sum()) for part in self._equations.remainders(at))
        violation += float(np.abs(self._limits.values(at) - slack).sum())
        barriers = barrier * float(np.log(slack).sum())
        return self._equations.cost(at) + weight * violation - barriers, violation


def _share(values: FloatArray, change: FloatArray) -> float:
    """Return the largest share of a change, up to one, that leaves positive values positive."""
    falling = change < 0.0
    if not falling.any():
        return 1.0
    return min(1.0, _TO_BOUNDARY * float((values[falling] / -change[falling]).min()))
