"""Newton's method on a slew's equations, with barriers for its limits: a primal-dual interior point method.

Wachter and Biegler, Math. Program. 106 (2006), with the curvature test of Chiang and Zavala (Math. Program.
2016) in place of a count of eigenvalues, and second-order corrections. Without limits it is Newton's method
itself. Far from the equations, their curvature is left out (Gauss and Newton): it misleads there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.three_axes.slew_band import Factors
from knightcube.gnc.guidance.three_axes.slew_limits import Limits
from knightcube.gnc.guidance.three_axes.slew_transcription import Linear, Trajectory, Transcription

_EYE7: FloatArray = np.eye(7)
_TOLERANCE = 1e-6
_TO_BOUNDARY = 0.995
_HALVINGS = 7
_CORRECTED, _CORRECTIONS = 4, 2
"""The first halvings are corrected, so often each."""
_HEAVIER = 1.2
"""The merit's weight of the equations over their largest multiplier."""
_FAR = 0.03
"""Sum of all equations' violations beyond which their curvature is left out."""
_DAMPED = 3e-3
"""Of that sum up to one, the convexity that such a step has at least: without it the step is too long."""
_CONVEX = 1e-3, 1e4
FIRST_BARRIER = 1e-3


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
    """A Newton step: of all unknowns (size,) and of the limits' duals; `off` is what the slacks lack.

    `factors` are those of its equations.
    """

    change: FloatArray
    dual: FloatArray
    off: FloatArray
    factors: Factors


class Program:
    """Least cost within limits."""

    def __init__(self, equations: Transcription, limits: Limits) -> None:
        self.equations, self._limits = equations, limits
        place = equations.layout
        self._equal = np.concatenate([place.equations.ravel(), place.start, place.end])
        self._primal = np.concatenate([place.states.ravel(), place.dipoles.ravel()])
        self.steps = 0

    def factors(self, point: Point) -> Factors:
        """Return the factors that lead to the least change that mends equations. Raises PlanningError.

        With the curvature of the equations in them, the way to a flat optimum's other side would be one, too.
        """
        states, heavy = self._limits.stiffness(point.at, point.dual / point.slack, np.zeros_like(point.dual))
        stiff = states + _DAMPED * _EYE7, heavy + _DAMPED
        return Factors(self.equations.band(point.linear, np.zeros_like(point.price), *stiff))

    def begin(self, guess: Trajectory, price: FloatArray | None, barrier: float) -> Point:
        """Return a guess as an iterate of Newton's method."""
        slack = np.maximum(self._limits.values(guess), min(1e-2, 10.0 * barrier))
        price = np.zeros(self.equations.layout.size) if price is None else price
        return self._point(guess, price, slack, barrier / slack)

    def lack(self, point: Point) -> tuple[float, float]:
        """Return the sum of all equations' violations, and of what the limits' slacks are off."""
        off = self._limits.values(point.at) - point.slack
        return float(np.abs(point.slope[self._equal]).sum()), float(np.abs(off).sum())

    def _point(self, at: Trajectory, price: FloatArray, slack: FloatArray, dual: FloatArray) -> Point:
        equations = self.equations
        linear = equations.linear(at)
        return Point(linear, price, slack, dual, equations.slope(linear, price))

    def error(self, point: Point, barrier: float) -> float:
        """Return the largest remainder of the equations of optimality at a barrier."""
        worst = float(np.abs(point.slope - self._limits.pull(point.at, point.dual)).max())
        if point.slack.size:
            worst = max(worst, float(np.abs(self._limits.values(point.at) - point.slack).max()))
            worst = max(worst, float(np.abs(point.slack * point.dual - barrier).max()))
        return worst

    def moved(self, point: Point, barrier: float, convex: float, error: float) -> tuple[Point | None, float]:
        """Return the next iterate, None without one, and the convexity that it took."""
        lack = self.lack(point)[0]
        is_far = lack > _FAR
        least = _DAMPED * min(1.0, lack) if is_far else 0.0
        bent = np.zeros_like(point.dual) if is_far else point.dual
        stiffness = self._limits.stiffness(point.at, point.dual / point.slack, bent)
        price = np.zeros_like(point.price) if is_far else point.price
        states, heavy = stiffness
        for _ in range(10):
            more = max(convex, least)
            stiff = states + more * _EYE7, heavy + more
            step = self._newton(point, barrier, more, self.equations.band(point.linear, price, *stiff))
            if step is not None:
                moved = self._searched(point, step, barrier, error)
                if moved is not None:
                    return moved, (0.25 * convex if convex > _CONVEX[0] else 0.0)
            convex = max(5.0 * more, _CONVEX[0])
            if convex > _CONVEX[1]:
                break
        return None, convex

    def _newton(self, point: Point, barrier: float, convex: float, band: FloatArray) -> Step | None:
        """Return the Newton step of a `band` with `convex` added; None where the curvature stays concave."""
        limits, at = self._limits, point.at
        stiff = point.dual / point.slack
        off = limits.values(at) - point.slack
        # The limits' duals after the step, were it to move nothing.
        toward = barrier / point.slack - stiff * off
        right = limits.pull(at, toward) - point.slope
        factors = Factors(band)
        change = factors.solve(right)
        # d.H.d, from the equations just solved: H d = right - C' dl, C d = right.
        equal, primal = self._equal, self._primal
        bend = right[primal] @ change[primal] - right[equal] @ change[equal]
        if bend <= 1e-8 * min(convex, 1.0) * float(change[primal] @ change[primal]):
            return None
        return Step(change, toward - stiff * limits.along(at, change) - point.dual, off, factors)

    def _searched(self, point: Point, step: Step, barrier: float, error: float) -> Point | None:
        """Return the point along a step that lowers the error, or the merit; None without one."""
        equal, missed = self._equal, point.slope[self._equal]
        size = _share(point.slack, self._limits.along(point.at, step.change) + step.off)
        dual = point.dual + _share(point.dual, step.dual) * step.dual
        weight = _HEAVIER * float(np.abs(point.price[equal] + step.change[equal]).max())
        before = self._merit(point.at, point.slack, barrier, weight, missed)
        violation = float(np.abs(missed).sum() + np.abs(step.off).sum())
        left = missed
        for attempt in range(_HALVINGS):
            lower = before - 1e-5 * size * weight * violation
            change = size * step.change
            for correction in range(_CORRECTIONS + 1 if attempt < _CORRECTED else 1):
                if correction:
                    # What the curvature of the equations adds is taken back by the same factors.
                    back = np.zeros(len(change))
                    back[equal] = (1.0 - size) * missed - left
                    change = change + step.factors.solve(back)
                there, slack = self._shifted(point, change, size * step.off)
                if slack.size and float((slack - (1.0 - _TO_BOUNDARY) * point.slack).min()) < 0.0:
                    break
                left = self._violations(there)
                lowered = self._merit(there, slack, barrier, weight, left) < lower
                if lowered or (attempt == 0 and correction == _CORRECTIONS):
                    price = point.price.copy()
                    price[equal] += size * step.change[equal]
                    moved = self._point(there, price, slack, dual)
                    if lowered or self.error(moved, barrier) < 0.9 * error:
                        return moved
            size *= 0.5
        return None

    def _shifted(self, point: Point, change: FloatArray, off: FloatArray) -> tuple[Trajectory, FloatArray]:
        """Return the trajectory and the slacks after a change (size,); the slacks mend `off`, too."""
        at, place = point.at, self.equations.layout
        there = Trajectory(at.states + change[place.states], at.dipoles + change[place.dipoles])
        return there, point.slack + self._limits.along(at, change) + off

    def _violations(self, at: Trajectory) -> FloatArray:
        """Return what remains of all equations."""
        return np.concatenate([part.ravel() for part in self.equations.remainders(at)])

    def _merit(
        self, at: Trajectory, slack: FloatArray, barrier: float, weight: float, missed: FloatArray
    ) -> float:
        """Return cost and barriers plus `weight` times the violation of all equations."""
        violation = float(np.abs(missed).sum() + np.abs(self._limits.values(at) - slack).sum())
        return self.equations.cost(at) + weight * violation - barrier * float(np.log(slack).sum())


class Descent:
    """Newton's method under way from a guess: it can be left and gone on with.

    Attributes:
        point: the newest iterate.
        is_over: there is an optimum, or no way on.
    """

    def __init__(
        self,
        program: Program,
        guess: Trajectory,
        price: FloatArray | None = None,
        first: float = FIRST_BARRIER,
        last: float = 1e-8,
    ) -> None:
        """Costs should be about one. `price` (size,) multiplies the equations; barriers fall to `last`."""
        self.program, self._first, self._last, self.is_over = program, first, last, False
        self.point = program.begin(guess, price, first)
        self._barrier, self._convex = (first if self.point.slack.size else 0.0), 0.0

    @property
    def lack(self) -> float:
        """The sum of all violations; zero from where the barriers have begun to fall."""
        return 0.0 if 0.0 < self._barrier < self._first else self.missed

    @property
    def missed(self) -> float:
        """The sum of all violations."""
        return sum(self.program.lack(self.point))

    def run(self, most: int) -> Point | None:
        """Return the optimum found within `most` more steps, None when there is none."""
        if self.is_over:
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # a step too long is shortened
            return self._run(most)

    def _run(self, most: int) -> Point | None:
        program, last = self.program, self._last
        for _ in range(most):
            error = program.error(self.point, self._barrier)
            while error < 10.0 * self._barrier and self._barrier > last:
                self._barrier = max(last, min(0.2 * self._barrier, self._barrier**1.5))
                error = program.error(self.point, self._barrier)
            self.is_over = error < max(_TOLERANCE, 10.0 * last)
            if self.is_over:
                return self.point
            program.steps += 1
            try:
                moved, self._convex = program.moved(self.point, self._barrier, self._convex, error)
            except PlanningError:
                moved = None
            if moved is None:
                self.is_over = True
                return None
            self.point = moved
        return None


def _share(values: FloatArray, change: FloatArray) -> float:
    """Return the largest share of a change, up to one, that leaves positive values positive."""
    falling = change < 0.0
    if not falling.any():
        return 1.0
    return min(1.0, _TO_BOUNDARY * float((values[falling] / -change[falling]).min()))
