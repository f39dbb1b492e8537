"""A slew as a nonlinear program: collocation of the motion, and a primal-dual interior point method.

The equations are Hermite-Simpson collocation in its separated form, of the fourth order (Betts, Practical
Methods for Optimal Control, 2010, 4.5). The dipole is linear on each interval, so that it keeps a limit
everywhere if it keeps the limit at the nodes. States stand at nodes and midpoints.

Each interval has the state (7) and the dipole (3) of its first node, the equation of its midpoint (7), the
state of the midpoint (7) and the equation of its end (7). The equations of the start precede all intervals,
those of the end follow them. Each equation thus involves its neighbours only, and LAPACK factors the band
matrix. LAPACK is imported where it is used, because the control process names the job but does not run it.

The limits, as inequalities g >= 0, form one vector: the lower and upper limits of the dipoles (2, k + 1, 3),
then the cones (cones, 2 k). The interior point method is that of Wachter and Biegler, Math. Program. 106
(2006), with the curvature test of Chiang and Zavala (Math. Program. 2016) in place of a count of eigenvalues,
and with second-order corrections. Without limits it is Newton's method. Far from a feasible point the
curvature of the equations is omitted (Gauss-Newton), because it misleads the steps there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.three_axes.slew_model import EnvironmentAt, SlewCraft, SlewDynamics
from knightcube.gnc.guidance.three_axes.slew_task import ConeConstraints, EndConditions, EndLaw

STEP = 31
"""Unknowns of an interval."""
WIDE = STEP + 10
"""Unknowns that an interval's equations touch: its own, and the next node's."""
EQUATIONS: IntArray = np.r_[10:17, 24:31]
"""Places of an interval's equations among its unknowns."""
_BAND = 33
_ROWS = 3 * _BAND + 1  # LAPACK's, with room for the pivots


@dataclass(frozen=True, slots=True, eq=False)
class BandLayout:
    """Where each unknown stands among all of a slew.

    Attributes:
        states: (2 k + 1, 7) at nodes and midpoints; dipoles: (k + 1, 3); equations: (k, 14); start: (7,);
            end: (ends,).
        begins: (k + 1,) the first unknown of each interval, and of the last node.
        places, entries: of the band, the places that intervals' blocks fill, and with which of their entries.
    """

    states: IntArray
    dipoles: IntArray
    equations: IntArray
    start: IntArray
    end: IntArray
    begins: IntArray
    places: IntArray
    entries: IntArray

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return int(self.end[-1]) + 1

    def band(self, blocks: FloatArray, tail: FloatArray) -> FloatArray:
        """Return the band of intervals' `blocks` (k, WIDE, WIDE), in part overwritten, and of the `tail`.

        The tail holds the last node's state and dipole and the end's equations.
        """
        # The corner that two intervals share belongs to the second.
        blocks[1:, :10, :10] += blocks[:-1, STEP:, STEP:]
        tail[:10, :10] += blocks[-1, STEP:, STEP:]
        filled = np.zeros(self.size * _ROWS)
        filled[self.places] = blocks.reshape(len(blocks), -1)[:, self.entries]
        band = filled.reshape(self.size, _ROWS)
        row, column = np.indices(tail.shape)
        band[int(self.begins[-1]) + column, 2 * _BAND + row - column] = tail
        for k in range(7):  # the start's equations are the first state itself
            band[k, 2 * _BAND + 7] = band[k + 7, 2 * _BAND - 7] = 1.0
        return band.T


@lru_cache(maxsize=16)
def layout(count: int, ends: int) -> BandLayout:
    """Return the layout of a slew in `count` intervals with `ends` equations at its end."""
    begins = 7 + STEP * np.arange(count + 1)
    states = np.empty((2 * count + 1, 7), dtype=np.int64)
    states[::2] = begins[:, None] + np.arange(7)
    states[1::2] = begins[:-1, None] + 17 + np.arange(7)
    row, column = np.divmod(np.arange(WIDE * WIDE), WIDE)
    own = (np.minimum(row, column) < STEP) & (np.abs(row - column) <= _BAND)
    rows, columns = (begins[:-1, None] + index[own] for index in (row, column))
    return BandLayout(
        states,
        begins[:, None] + 7 + np.arange(3),
        begins[:-1, None] + EQUATIONS,
        np.arange(7),
        int(begins[-1]) + 10 + np.arange(ends),
        begins,
        columns * _ROWS + 2 * _BAND + rows - columns,
        np.flatnonzero(own),
    )


class Factors:
    """The factors of a band, for as many right sides as are wanted."""

    def __init__(self, band: FloatArray) -> None:
        """Factor a `band` in its place. Raises PlanningError where it is singular."""
        from scipy.linalg.lapack import dgbtrf  # noqa: PLC0415 - see the top

        self._factors, self._pivots, info = dgbtrf(band, _BAND, _BAND, overwrite_ab=1)
        if info:
            raise PlanningError("the equations of a slew are singular")

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution (size,) of a right side (size,). Raises PlanningError without any."""
        from scipy.linalg.lapack import dgbtrs  # noqa: PLC0415 - see the top

        found, _ = dgbtrs(self._factors, _BAND, _BAND, right[:, None], self._pivots)
        if not np.isfinite(found).all():
            raise PlanningError("the equations of a slew are singular")
        return np.asarray(found[:, 0])


_EYE7: FloatArray = np.eye(7)
_AXIS = np.arange(3)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """States (2 k + 1, 7) at nodes and midpoints, and dipoles (k + 1, 3) at nodes.

    Times are counted in horizons, dipoles in the unit of the slew's motion.
    """

    states: FloatArray
    dipoles: FloatArray

    def all_dipoles(self) -> FloatArray:
        """Return the dipoles (2 k + 1, 3) at nodes and midpoints."""
        result = np.empty((len(self.states), 3))
        result[::2] = self.dipoles
        result[1::2] = 0.5 * (self.dipoles[1:] + self.dipoles[:-1])
        return result


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedEquations:
    """The equations around a trajectory: what remains of them, and their derivatives.

    Attributes:
        between: (k, 14); jacobian: (k, 14, WIDE), by what they touch.
        begun: (7,), ended: (ends,); ending: (ends, 7), by the last state.
    """

    at: Trajectory
    between: FloatArray
    begun: FloatArray
    ended: FloatArray
    jacobian: FloatArray
    ending: FloatArray


class Transcription:
    """The equations of a slew from a state (7,) over `scale` s, the unit of its times, on `count` intervals.

    `unit` A m^2 is that of the dipoles; `weights` (3,) are those of the dipoles' squares in the cost.
    """

    def __init__(
        self,
        craft: SlewCraft,
        unit: float,
        along: EnvironmentAt,
        start: FloatArray,
        end: EndLaw,
        count: int,
        scale: float,
        weights: FloatArray,
    ) -> None:
        self.start, self.end = start, end(scale)
        self._ending = EndConditions(self.end, scale)
        self.weights, self.count, self.scale = weights, count, scale
        self.times = np.linspace(0.0, scale, 2 * count + 1)
        self.around = along(self.times)
        self.motion = SlewDynamics(craft, scale, unit, self.around)
        self.layout = layout(count, self._ending.count)
        self._step = 1.0 / count

    def cost(self, at: Trajectory) -> float:
        """Return the integral of the weighted square of the dipole, exactly."""
        left, right = at.dipoles[:-1], at.dipoles[1:]
        squares = left * left + left * right + right * right
        return self._step / 3.0 * float(np.sum(squares @ self.weights))

    def remainders(self, at: Trajectory) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what remains of the intervals' equations (k, 14), the start's (7,) and the end's."""
        x, h = at.states, self._step
        flow = self.motion.flow(x, at.all_dipoles())
        a, c, b = flow[:-1:2], flow[1::2], flow[2::2]
        left, middle, right = x[:-1:2], x[1::2], x[2::2]
        half = middle - 0.5 * (left + right) - h / 8.0 * (a - b)
        whole = right - left - h / 6.0 * (a + 4.0 * c + b)
        return np.concatenate([half, whole], axis=1), *self.ends_missed(at)

    def ends_missed(self, at: Trajectory) -> tuple[FloatArray, FloatArray]:
        """Return what remains of the equations of the start (7,) and of the end."""
        return at.states[0] - self.start, self._ending.miss(at.states[-1])

    def linear(self, at: Trajectory) -> LinearisedEquations:
        """Return the equations around a trajectory."""
        h = self._step
        slopes = self.motion.slopes(at.states, at.all_dipoles())
        by_state, by_dipole = slopes[:, :, :7], slopes[:, :, 7:]
        jacobian = np.zeros((self.count, 14, WIDE))
        a, c, b = by_state[:-1:2], by_state[1::2], by_state[2::2]
        jacobian[:, :7, :7] = -0.5 * _EYE7 - h / 8.0 * a
        jacobian[:, 7:, :7] = -_EYE7 - h / 6.0 * a
        jacobian[:, :7, 17:24] = _EYE7
        jacobian[:, 7:, 17:24] = -4.0 * h / 6.0 * c
        jacobian[:, :7, 31:38] = -0.5 * _EYE7 + h / 8.0 * b
        jacobian[:, 7:, 31:38] = _EYE7 - h / 6.0 * b
        a, c, b = by_dipole[:-1:2], by_dipole[1::2], by_dipole[2::2]
        jacobian[:, :7, 7:10] = -h / 8.0 * a
        jacobian[:, 7:, 7:10] = -h / 6.0 * a - h / 3.0 * c
        jacobian[:, :7, 38:41] = h / 8.0 * b
        jacobian[:, 7:, 38:41] = -h / 6.0 * b - h / 3.0 * c
        ending = self._ending.slope(at.states[-1])
        return LinearisedEquations(at, *self.remainders(at), jacobian, ending)

    def slope(self, linear: LinearisedEquations, price: FloatArray) -> FloatArray:
        """Return the derivative (size,) of cost plus `price` (size,) times the equations.

        In the equations' places stands what remains of them; only there `price` counts.
        """
        at, place = linear.at, self.layout
        result = np.zeros(place.size)
        pulled = (price[place.equations][:, None, :] @ linear.jacobian)[:, 0]
        first = place.begins[:-1, None]
        result[first + np.arange(STEP)] = pulled[:, :STEP]
        result[first + STEP + np.arange(10)] += pulled[:, STEP:]
        result[place.states[0]] += price[place.start]
        result[place.states[-1]] += price[place.end] @ linear.ending
        m = at.dipoles
        heat = np.zeros_like(m)
        heat[:-1] += 2.0 * m[:-1] + m[1:]
        heat[1:] += 2.0 * m[1:] + m[:-1]
        result[place.dipoles] += self._step / 3.0 * heat * self.weights
        result[place.equations] = linear.between
        result[place.start], result[place.end] = linear.begun, linear.ended
        return result

    def band(
        self, linear: LinearisedEquations, price: FloatArray, state_part: FloatArray, dipole_part: FloatArray
    ) -> FloatArray:
        """Return the band of the derivatives of `slope`.

        `state_part` (2 k + 1, 7, 7) and `dipole_part` (k + 1, 3) are added to the curvature by states and by
        dipoles: the parts of barriers and of convexity.
        """
        h = self._step
        bend = self._bend(linear, price[self.layout.equations])
        bend[:, :7, :7] += state_part
        nodes = bend[::2]
        heat = np.full(self.count + 1, 4.0 * h / 3.0)
        heat[[0, -1]] *= 0.5
        nodes[:, 7 + _AXIS, 7 + _AXIS] += heat[:, None] * self.weights + dipole_part
        block = np.zeros((self.count, WIDE, WIDE))
        block[:, :10, :10] = nodes[:-1]
        block[:, 17:24, 17:24] = bend[1::2, :7, :7]
        cross = 0.5 * bend[1::2, :7, 7:]
        for column in (7, 38):
            block[:, 17:24, column : column + 3] = cross
            block[:, column : column + 3, 17:24] = cross.transpose(0, 2, 1)
        block[:, 7 + _AXIS, 38 + _AXIS] = block[:, 38 + _AXIS, 7 + _AXIS] = h / 3.0 * self.weights
        block[:, EQUATIONS] += linear.jacobian
        block[:, :, EQUATIONS] += linear.jacobian.transpose(0, 2, 1)
        tail = np.zeros((10 + len(linear.ended),) * 2)
        tail[:10, :10] = nodes[-1]
        tail[:4, :4] += self._ending.curvature(price[self.layout.end])
        tail[10:, :7], tail[:7, 10:] = linear.ending, linear.ending.T
        return self.layout.band(block, tail)

    def _bend(self, linear: LinearisedEquations, price: FloatArray) -> FloatArray:
        """Return the curvature (2 k + 1, 10, 10) of the equations times their `price` (k, 14)."""
        at, h = linear.at, self._step
        half, whole = price[:, :7], price[:, 7:]
        y = np.zeros_like(at.states)
        y[:-1:2] += -h / 8.0 * half - h / 6.0 * whole
        y[2::2] += h / 8.0 * half - h / 6.0 * whole
        y[1::2] = -4.0 * h / 6.0 * whole
        return self.motion.curvature(at.states, at.all_dipoles(), y)


@dataclass(frozen=True, slots=True, eq=False)
class SlewLimits:
    """The limits; `dipole` (3,) is in the unit of the motion, None for a slew without such a limit."""

    equations: Transcription
    dipole: FloatArray | None
    cones: ConeConstraints

    def values(self, at: Trajectory) -> FloatArray:
        """Return by how much every limit is kept."""
        found: list[FloatArray] = [np.zeros(0)]
        if self.dipole is not None:
            found += [(at.dipoles + self.dipole).ravel(), (self.dipole - at.dipoles).ravel()]
        if self.cones.count:
            found.append(self.cones.values(at.states[1:, :4]).ravel())
        return np.concatenate(found)

    def pull(self, at: Trajectory, weights: FloatArray) -> FloatArray:
        """Return the derivative (size,) of `weights` times the limits."""
        place = self.equations.layout
        result = np.zeros(place.size)
        dipoles, cones = self._parts(weights, at)
        if self.dipole is not None:
            result[place.dipoles] = dipoles[0] - dipoles[1]
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            result[place.states[1:, :4]] = np.einsum("cn,cnj->nj", cones, slopes)
        return result

    def along(self, at: Trajectory, change: FloatArray) -> FloatArray:
        """Return the change of every limit's value along a step (size,), linearly."""
        place = self.equations.layout
        found: list[FloatArray] = [np.zeros(0)]
        if self.dipole is not None:
            found += [change[place.dipoles].ravel(), -change[place.dipoles].ravel()]
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            found.append(np.einsum("cnj,nj->cn", slopes, change[place.states[1:, :4]]).ravel())
        return np.concatenate(found)

    def stiffness(self, at: Trajectory, stiff: FloatArray, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the limits add to the curvature by states (2 k + 1, 7, 7) and by dipoles (k + 1, 3).

        `stiff` are the squares' weights, `bent` those of the limits' own curvature.
        """
        dipoles, cones = self._parts(stiff, at)
        _, weights = self._parts(bent, at)
        states = np.zeros((len(at.states), 7, 7))
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            states[1:, :4, :4] = np.einsum("cn,cni,cnj->nij", cones, slopes, slopes)
            states[1:, :4, :4] -= np.einsum("cn,cnij->nij", weights, self.cones.curvatures)
        heavy = np.zeros_like(at.dipoles) if self.dipole is None else dipoles.sum(axis=0)
        return states, heavy

    def _parts(self, values: FloatArray, at: Trajectory) -> tuple[FloatArray, FloatArray]:
        """Split values of all limits into those of the dipoles and of the cones."""
        nodes = 0 if self.dipole is None else 2 * at.dipoles.size
        dipoles = values[:nodes].reshape(2, -1, 3) if nodes else values[:0]
        return dipoles, values[nodes:].reshape(self.cones.count, len(at.states) - 1)


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
class Iterate:
    """An iterate.

    Attributes:
        linear: the equations around its trajectory.
        price: (size,) the equations' multipliers, in their places.
        slack, dual: of every limit.
        slope: (size,) of the Lagrangian without the limits' part, equations in their places.
    """

    linear: LinearisedEquations
    price: FloatArray
    slack: FloatArray
    dual: FloatArray
    slope: FloatArray

    @property
    def at(self) -> Trajectory:
        """The trajectory."""
        return self.linear.at


@dataclass(frozen=True, slots=True, eq=False)
class NewtonStep:
    """A Newton step: of all unknowns (size,) and of the limits' duals; `off` is what the slacks lack.

    `factors` are those of its equations.
    """

    change: FloatArray
    dual: FloatArray
    off: FloatArray
    factors: Factors


class SlewProgram:
    """Least cost within limits."""

    def __init__(self, equations: Transcription, limits: SlewLimits) -> None:
        self.equations, self._limits = equations, limits
        place = equations.layout
        self._equal = np.concatenate([place.equations.ravel(), place.start, place.end])
        self._primal = np.concatenate([place.states.ravel(), place.dipoles.ravel()])
        self.steps = 0

    def factors(self, point: Iterate) -> Factors:
        """Return the factors that lead to the least change that mends equations. Raises PlanningError.

        With the curvature of the equations in them, the way to a flat optimum's other side would be one, too.
        """
        states, heavy = self._limits.stiffness(point.at, point.dual / point.slack, np.zeros_like(point.dual))
        stiff = states + _DAMPED * _EYE7, heavy + _DAMPED
        return Factors(self.equations.band(point.linear, np.zeros_like(point.price), *stiff))

    def begin(self, guess: Trajectory, price: FloatArray | None, barrier: float) -> Iterate:
        """Return a guess as an iterate of Newton's method."""
        slack = np.maximum(self._limits.values(guess), min(1e-2, 10.0 * barrier))
        price = np.zeros(self.equations.layout.size) if price is None else price
        return self._point(guess, price, slack, barrier / slack)

    def lack(self, point: Iterate) -> tuple[float, float]:
        """Return the sum of all equations' violations, and of what the limits' slacks are off."""
        off = self._limits.values(point.at) - point.slack
        return float(np.abs(point.slope[self._equal]).sum()), float(np.abs(off).sum())

    def _point(self, at: Trajectory, price: FloatArray, slack: FloatArray, dual: FloatArray) -> Iterate:
        equations = self.equations
        linear = equations.linear(at)
        return Iterate(linear, price, slack, dual, equations.slope(linear, price))

    def error(self, point: Iterate, barrier: float) -> float:
        """Return the largest remainder of the equations of optimality at a barrier."""
        worst = float(np.abs(point.slope - self._limits.pull(point.at, point.dual)).max())
        if point.slack.size:
            worst = max(worst, float(np.abs(self._limits.values(point.at) - point.slack).max()))
            worst = max(worst, float(np.abs(point.slack * point.dual - barrier).max()))
        return worst

    def moved(
        self, point: Iterate, barrier: float, convex: float, error: float
    ) -> tuple[Iterate | None, float]:
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

    def _newton(self, point: Iterate, barrier: float, convex: float, band: FloatArray) -> NewtonStep | None:
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
        return NewtonStep(change, toward - stiff * limits.along(at, change) - point.dual, off, factors)

    def _searched(self, point: Iterate, step: NewtonStep, barrier: float, error: float) -> Iterate | None:
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

    def _shifted(self, point: Iterate, change: FloatArray, off: FloatArray) -> tuple[Trajectory, FloatArray]:
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


class NewtonRun:
    """Newton's method under way from a guess: it can be left and gone on with.

    Attributes:
        point: the newest iterate.
        is_over: there is an optimum, or no way on.
    """

    def __init__(
        self,
        program: SlewProgram,
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

    def run(self, most: int) -> Iterate | None:
        """Return the optimum found within `most` more steps, None when there is none."""
        if self.is_over:
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # a step too long is shortened
            return self._run(most)

    def _run(self, most: int) -> Iterate | None:
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
