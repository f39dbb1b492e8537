"""A slew as a nonlinear program, discretised by collocation and solved by an interior point method.

The motion is discretised by separated Hermite-Simpson collocation, which is of fourth order (Betts, Practical
Methods for Optimal Control, 2010, section 4.5). The dipole is linear on each interval, so a dipole that
satisfies the limits at all nodes satisfies the limits at all times. The unknowns are the states at nodes and
midpoints of the intervals, and the dipoles at the nodes.

The vector of unknowns and Lagrange multipliers has 31 elements per interval: the state (7) and the dipole (3)
of the first node, the multipliers of the midpoint's equations (7), the state of the midpoint (7) and the
multipliers of the equations at the end of the interval (7). The multipliers of the start conditions precede
all intervals, and the multipliers of the end conditions follow all intervals. Each equation involves only
neighbouring elements of this vector, so the Newton matrix is banded and is factored by LAPACK. LAPACK is
imported only when a program is solved, because the control process imports this module but plans no slews.

The vector of inequalities g >= 0 contains the lower and upper limits of the dipoles (2, k + 1, 3), followed
by the exclusion cones (cones, 2 k), for k intervals. The interior point method is that of Wachter and Biegler
(Mathematical Programming 106, 2006) with second-order corrections. The curvature test of Chiang and Zavala
(Mathematical Programming, 2016) replaces the usual count of the negative eigenvalues of the Newton matrix.
Without inequalities, the interior point method reduces to Newton's method. Far from a feasible point, the
second derivatives of the equations would cause unsuitable steps and are omitted (Gauss-Newton method).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.slew_model import (
    ConeConstraints,
    EndConditions,
    EndLaw,
    EnvironmentAt,
    SlewCraft,
    SlewDynamics,
    mean_squares,
)

STEP = 31
"""Number of elements (unknowns and multipliers) of one interval."""
WIDE = STEP + 10
"""Number of elements on which the equations of one interval depend, including the state and the dipole of the
next node."""
EQUATIONS: IntArray = np.r_[10:17, 24:31]
"""Indices of the 14 multipliers of an interval among the 31 elements of the interval."""
_BAND = 33
_ROWS = 3 * _BAND + 1  # rows of LAPACK's band storage, including fill-in by pivoting


@dataclass(frozen=True, slots=True, eq=False)
class BandLayout:
    """Indices of states, dipoles and multipliers of a slew in the vector of unknowns and in the band matrix.

    Attributes:
        states: indices (2 k + 1, 7) of the states at nodes and midpoints of k intervals.
        dipoles: indices (k + 1, 3) of the dipoles at the nodes.
        equations: indices (k, 14) of the multipliers of the collocation equations of the intervals.
        start: indices (7,) of the multipliers of the start conditions.
        end: indices (ends,) of the multipliers of the end conditions.
        begins: indices (k + 1,) of the first element of each interval and of the last node.
        places: indices, in the flattened band matrix, of the elements to which the intervals contribute.
        entries: indices, in an interval's flattened matrix block, of the elements that are copied to
            `places`.
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
        """Return the band matrix of the `blocks` (k, WIDE, WIDE), one for each interval, and of the `tail`.

        The block `tail` is for the state and the dipole of the last node, and for the end conditions. The
        given blocks are overwritten.
        """
        # The contributions of two neighbouring blocks to their common node are summed in the second block.
        blocks[1:, :10, :10] += blocks[:-1, STEP:, STEP:]
        tail[:10, :10] += blocks[-1, STEP:, STEP:]
        filled = np.zeros(self.size * _ROWS)
        filled[self.places] = blocks.reshape(len(blocks), -1)[:, self.entries]
        band = filled.reshape(self.size, _ROWS)
        row, column = np.indices(tail.shape)
        band[int(self.begins[-1]) + column, 2 * _BAND + row - column] = tail
        for k in range(7):  # the start conditions depend only on the first state
            band[k, 2 * _BAND + 7] = band[k + 7, 2 * _BAND - 7] = 1.0
        return band.T


@lru_cache(maxsize=16)
def band_layout(count: int, ends: int) -> BandLayout:
    """Return the layout of the unknowns of `count` intervals with `ends` end conditions."""
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
    """LU factors of a band matrix, which solve systems of equations with several right-hand sides."""

    def __init__(self, band: FloatArray) -> None:
        """Factor the matrix `band` in place. Raises PlanningError if the matrix is singular."""
        from scipy.linalg.lapack import dgbtrf  # noqa: PLC0415 - see the top

        self._factors, self._pivots, info = dgbtrf(band, _BAND, _BAND, overwrite_ab=1)
        if info:
            raise PlanningError("the equations of the slew are singular")

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution (size,) for a right-hand side (size,).

        Raises PlanningError if the solution is not finite.
        """
        from scipy.linalg.lapack import dgbtrs  # noqa: PLC0415 - see the top

        found, _ = dgbtrs(self._factors, _BAND, _BAND, right[:, None], self._pivots)
        if not np.isfinite(found).all():
            raise PlanningError("the equations of the slew are singular")
        return np.asarray(found[:, 0])


_EYE7: FloatArray = np.eye(7)
_AXIS = np.arange(3)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """States (2 k + 1, 7) at nodes and midpoints, and dipoles (k + 1, 3) at nodes.

    The unit of time is the slew's duration, and dipoles have the unit of `SlewDynamics`.
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
    """The residuals of a slew's equations at a trajectory, and the derivatives of the residuals.

    Attributes:
        at: the trajectory about which the equations are linearised.
        between: residuals (k, 14) of the collocation equations on k intervals.
        begun: residuals (7,) of the start conditions, which fix the state at the start.
        ended: residuals (ends,) of the end conditions: attitude and rate errors at the end of the slew.
        jacobian: derivatives (k, 14, WIDE) of the collocation equations of each interval with respect to its
            unknowns.
        ending: derivatives (ends, 7) of the end conditions with respect to the state at the end.
    """

    at: Trajectory
    between: FloatArray
    begun: FloatArray
    ended: FloatArray
    jacobian: FloatArray
    ending: FloatArray


class Transcription:
    """The collocation equations of a slew of `scale` s from a start state (7,) on `count` intervals.

    The unit of dipoles is `unit` A m^2, and the unit of time is `scale` s. The cost is the integral of m' W m
    for dipoles m and the matrix W of `weights` (3, 3).
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
        self.layout = band_layout(count, self._ending.count)
        self._step = 1.0 / count

    def cost(self, at: Trajectory) -> float:
        """Return the cost, which is the exact integral of the weighted squares of the dipoles."""
        return self._step * float(np.sum(mean_squares(at.dipoles, self.weights)))

    def remainders(self, at: Trajectory) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the residuals of collocation (k, 14), start conditions (7,) and end conditions (ends,)."""
        x, h = at.states, self._step
        flow = self.motion.flow(x, at.all_dipoles())
        a, c, b = flow[:-1:2], flow[1::2], flow[2::2]
        left, middle, right = x[:-1:2], x[1::2], x[2::2]
        half = middle - 0.5 * (left + right) - h / 8.0 * (a - b)
        whole = right - left - h / 6.0 * (a + 4.0 * c + b)
        return np.concatenate([half, whole], axis=1), *self.ends_missed(at)

    def ends_missed(self, at: Trajectory) -> tuple[FloatArray, FloatArray]:
        """Return the residuals of the start conditions (7,) and of the end conditions (ends,)."""
        return at.states[0] - self.start, self._ending.miss(at.states[-1])

    def linear(self, at: Trajectory) -> LinearisedEquations:
        """Return the equations linearised about a trajectory."""
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

    def slope(self, linear: LinearisedEquations, multipliers: FloatArray) -> FloatArray:
        """Return the derivative (size,) of the Lagrangian with respect to all unknowns and multipliers.

        The Lagrangian is the cost plus the equations weighted by `multipliers`, so the derivatives with
        respect to the multipliers are the residuals of the equations. The elements of `multipliers` (size,)
        at the indices of unknowns are ignored.
        """
        at, layout = linear.at, self.layout
        result = np.zeros(layout.size)
        pulled = (multipliers[layout.equations][:, None, :] @ linear.jacobian)[:, 0]
        first = layout.begins[:-1, None]
        result[first + np.arange(STEP)] = pulled[:, :STEP]
        result[first + STEP + np.arange(10)] += pulled[:, STEP:]
        result[layout.states[0]] += multipliers[layout.start]
        result[layout.states[-1]] += multipliers[layout.end] @ linear.ending
        m = at.dipoles
        heat = np.zeros_like(m)
        heat[:-1] += 2.0 * m[:-1] + m[1:]
        heat[1:] += 2.0 * m[1:] + m[:-1]
        result[layout.dipoles] += self._step / 3.0 * heat @ self.weights
        result[layout.equations] = linear.between
        result[layout.start], result[layout.end] = linear.begun, linear.ended
        return result

    def band(
        self,
        linear: LinearisedEquations,
        multipliers: FloatArray,
        state_part: FloatArray,
        dipole_part: FloatArray,
    ) -> FloatArray:
        """Return the Newton matrix (the second derivatives of the Lagrangian) as a band matrix.

        The barrier and convexification terms are added: `state_part` (2 k + 1, 7, 7) to the second
        derivatives with respect to states, and `dipole_part` (k + 1, 3) to those with respect to dipoles.
        """
        at, h = linear.at, self._step
        half, whole = np.split(multipliers[self.layout.equations], 2, axis=1)
        y = np.zeros_like(at.states)
        y[:-1:2] += -h / 8.0 * half - h / 6.0 * whole
        y[2::2] += h / 8.0 * half - h / 6.0 * whole
        y[1::2] = -4.0 * h / 6.0 * whole
        bend = self.motion.curvature(at.states, at.all_dipoles(), y)
        bend[:, :7, :7] += state_part
        nodes = bend[::2]
        heat = np.full(self.count + 1, 4.0 * h / 3.0)
        heat[[0, -1]] *= 0.5
        nodes[:, 7:, 7:] += heat[:, None, None] * self.weights
        nodes[:, 7 + _AXIS, 7 + _AXIS] += dipole_part
        block = np.zeros((self.count, WIDE, WIDE))
        block[:, :10, :10] = nodes[:-1]
        block[:, 17:24, 17:24] = bend[1::2, :7, :7]
        cross = 0.5 * bend[1::2, :7, 7:]
        for column in (7, 38):
            block[:, 17:24, column : column + 3] = cross
            block[:, column : column + 3, 17:24] = cross.transpose(0, 2, 1)
        block[:, 7:10, 38:41] = block[:, 38:41, 7:10] = h / 3.0 * self.weights
        block[:, EQUATIONS] += linear.jacobian
        block[:, :, EQUATIONS] += linear.jacobian.transpose(0, 2, 1)
        tail = np.zeros((10 + len(linear.ended),) * 2)
        tail[:10, :10] = nodes[-1]
        tail[:4, :4] += self._ending.curvature(multipliers[self.layout.end])
        tail[10:, :7], tail[:7, 10:] = linear.ending, linear.ending.T
        return self.layout.band(block, tail)


@dataclass(frozen=True, slots=True, eq=False)
class SlewLimits:
    """The dipole limits and the exclusion cones of a slew.

    The dipole limit `dipole` (3,) is in units of `SlewDynamics`, or None for a slew without a dipole limit.
    """

    equations: Transcription
    dipole: FloatArray | None
    cones: ConeConstraints

    def values(self, at: Trajectory) -> FloatArray:
        """Return the values of all inequalities g >= 0. A negative value means that the limit is violated."""
        found: list[FloatArray] = [np.zeros(0)]
        if self.dipole is not None:
            found += [(at.dipoles + self.dipole).ravel(), (self.dipole - at.dipoles).ravel()]
        if self.cones.count:
            found.append(self.cones.values(at.states[1:, :4]).ravel())
        return np.concatenate(found)

    def pull(self, at: Trajectory, weights: FloatArray) -> FloatArray:
        """Return the derivative (size,) of the weighted sum of the values g of all inequalities."""
        layout = self.equations.layout
        result = np.zeros(layout.size)
        dipoles, cones = self._parts(weights, at)
        if self.dipole is not None:
            result[layout.dipoles] = dipoles[0] - dipoles[1]
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            result[layout.states[1:, :4]] = np.einsum("cn,cnj->nj", cones, slopes)
        return result

    def along(self, at: Trajectory, change: FloatArray) -> FloatArray:
        """Return the change of every inequality g, to first order, for a `change` (size,) of the unknowns."""
        layout = self.equations.layout
        found: list[FloatArray] = [np.zeros(0)]
        if self.dipole is not None:
            found += [change[layout.dipoles].ravel(), -change[layout.dipoles].ravel()]
        if self.cones.count:
            slopes = self.cones.slopes(at.states[1:, :4])
            found.append(np.einsum("cnj,nj->cn", slopes, change[layout.states[1:, :4]]).ravel())
        return np.concatenate(found)

    def stiffness(self, at: Trajectory, stiff: FloatArray, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the second derivatives of the barrier with respect to states and with respect to dipoles.

        The shapes are (2 k + 1, 7, 7) for the states and (k + 1, 3) for the dipoles. The second derivatives
        of the barrier are sums over the inequalities g. The products of the first derivatives of g are added
        with the weights `stiff`, and the second derivatives of g are subtracted with the weights `bent`.
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
        """Return the elements of `values` for the dipole limits, and the elements for the exclusion cones."""
        nodes = 0 if self.dipole is None else 2 * at.dipoles.size
        dipoles = values[:nodes].reshape(2, -1, 3) if nodes else values[:0]
        return dipoles, values[nodes:].reshape(self.cones.count, len(at.states) - 1)


_TOLERANCE = 1e-6
_TO_BOUNDARY = 0.995
_HALVINGS = 7
_CORRECTED, _CORRECTIONS = 4, 2
"""Number of step halvings that include second-order corrections, and number of corrections per halving."""
_HEAVIER = 1.2
"""Weight of the constraint violation in the merit function, divided by the largest Lagrange multiplier."""
_FAR = 0.03
"""Sum of the constraint violations above which the second derivatives of the equations are omitted."""
_DAMPED = 3e-3
"""Minimum convexification far from a feasible point, which prevents excessive steps. The value applies to a
constraint violation of one and above; for smaller violations, the minimum is proportional to the
violation."""
_CONVEX = 1e-3, 1e4
FIRST_BARRIER = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Iterate:
    """An iterate of the interior point method.

    The array `multipliers` (size,) contains the Lagrange multipliers of the equations at the indices that the
    layout assigns to them. The slack and dual variables belong to the inequalities g >= 0. The attribute
    `slope` is the derivative (size,) of the Lagrangian without the inequalities, with respect to all unknowns
    and multipliers.
    """

    linear: LinearisedEquations
    multipliers: FloatArray
    slack: FloatArray
    dual: FloatArray
    slope: FloatArray

    @property
    def at(self) -> Trajectory:
        """The trajectory."""
        return self.linear.at


@dataclass(frozen=True, slots=True, eq=False)
class NewtonStep:
    """A Newton step: the changes of unknowns and multipliers (`change`) and of the dual variables (`dual`).

    The attribute `off` contains the residuals of the inequalities (g minus slack), and `factors` contains the
    factors of the Newton matrix.
    """

    change: FloatArray
    dual: FloatArray
    off: FloatArray
    factors: Factors


class SlewProgram:
    """The nonlinear program of a slew: minimise the cost subject to the collocation equations and limits."""

    def __init__(self, equations: Transcription, limits: SlewLimits) -> None:
        self.equations, self._limits = equations, limits
        layout = equations.layout
        self._equal = np.concatenate([layout.equations.ravel(), layout.start, layout.end])
        self._primal = np.concatenate([layout.states.ravel(), layout.dipoles.ravel()])
        self.steps = 0

    def factors(self, point: Iterate) -> Factors:
        """Return the factorised Newton matrix for removing all residuals of a path by the smallest change.

        The matrix omits the second derivatives of the equations, because a matrix with these derivatives
        would permit large steps near a flat optimum. Raises PlanningError if the matrix is singular.
        """
        states, heavy = self._limits.stiffness(point.at, point.dual / point.slack, np.zeros_like(point.dual))
        stiff = states + _DAMPED * _EYE7, heavy + _DAMPED
        return Factors(self.equations.band(point.linear, np.zeros_like(point.multipliers), *stiff))

    def begin(self, guess: Trajectory, multipliers: FloatArray | None, barrier: float) -> Iterate:
        """Return an initial guess as an iterate of the interior point method."""
        slack = np.maximum(self._limits.values(guess), min(1e-2, 10.0 * barrier))
        multipliers = np.zeros(self.equations.layout.size) if multipliers is None else multipliers
        return self._point(guess, multipliers, slack, barrier / slack)

    def lack(self, point: Iterate) -> tuple[float, float]:
        """Return the sums of the absolute residuals of the equations and of the inequalities."""
        off = self._limits.values(point.at) - point.slack
        return float(np.abs(point.slope[self._equal]).sum()), float(np.abs(off).sum())

    def _point(self, at: Trajectory, multipliers: FloatArray, slack: FloatArray, dual: FloatArray) -> Iterate:
        equations = self.equations
        linear = equations.linear(at)
        return Iterate(linear, multipliers, slack, dual, equations.slope(linear, multipliers))

    def error(self, point: Iterate, barrier: float) -> float:
        """Return the largest residual of the optimality conditions for a given barrier parameter."""
        worst = float(np.abs(point.slope - self._limits.pull(point.at, point.dual)).max())
        if point.slack.size:
            worst = max(worst, float(np.abs(self._limits.values(point.at) - point.slack).max()))
            worst = max(worst, float(np.abs(point.slack * point.dual - barrier).max()))
        return worst

    def moved(
        self, point: Iterate, barrier: float, convex: float, error: float
    ) -> tuple[Iterate | None, float]:
        """Return the next iterate, or None if no step is found, and the next convexification."""
        lack = self.lack(point)[0]
        is_far = lack > _FAR
        minimum = _DAMPED * min(1.0, lack) if is_far else 0.0
        bent = np.zeros_like(point.dual) if is_far else point.dual
        states, heavy = self._limits.stiffness(point.at, point.dual / point.slack, bent)
        multipliers = np.zeros_like(point.multipliers) if is_far else point.multipliers
        for _ in range(10):
            more = max(convex, minimum)
            stiff = states + more * _EYE7, heavy + more
            step = self._newton(point, barrier, more, self.equations.band(point.linear, multipliers, *stiff))
            if step is not None:
                moved = self._searched(point, step, barrier, error)
                if moved is not None:
                    return moved, (0.25 * convex if convex > _CONVEX[0] else 0.0)
            convex = max(5.0 * more, _CONVEX[0])
            if convex > _CONVEX[1]:
                break
        return None, convex

    def _newton(self, point: Iterate, barrier: float, convex: float, band: FloatArray) -> NewtonStep | None:
        """Return the Newton step for the matrix `band`, or None if the curvature is not positive."""
        limits, at = self._limits, point.at
        stiff = point.dual / point.slack
        off = limits.values(at) - point.slack
        # The dual variables are estimated for unchanged states and dipoles.
        toward = barrier / point.slack - stiff * off
        right = limits.pull(at, toward) - point.slope
        factors = Factors(band)
        change = factors.solve(right)
        # The step d satisfies H d + C' l = a and C d = b, so its curvature d.H.d equals a.d - b.l.
        equal, primal = self._equal, self._primal
        bend = right[primal] @ change[primal] - right[equal] @ change[equal]
        if bend <= 1e-8 * min(convex, 1.0) * float(change[primal] @ change[primal]):
            return None
        return NewtonStep(change, toward - stiff * limits.along(at, change) - point.dual, off, factors)

    def _searched(self, point: Iterate, step: NewtonStep, barrier: float, error: float) -> Iterate | None:
        """Return an iterate, along a Newton step, that reduces the error or the merit function, or None."""
        equal, missed, layout = self._equal, point.slope[self._equal], self.equations.layout
        size = _share(point.slack, self._limits.along(point.at, step.change) + step.off)
        dual = point.dual + _share(point.dual, step.dual) * step.dual
        weight = _HEAVIER * float(np.abs(point.multipliers[equal] + step.change[equal]).max())
        before = self._merit(point.at, point.slack, barrier, weight, missed)
        violation = float(np.abs(missed).sum() + np.abs(step.off).sum())
        left = missed
        for attempt in range(_HALVINGS):
            lower = before - 1e-5 * size * weight * violation
            change = size * step.change
            for correction in range(_CORRECTIONS + 1 if attempt < _CORRECTED else 1):
                if correction:
                    # The second-order correction reduces the residuals due to the curvature of the equations.
                    back = np.zeros(len(change))
                    back[equal] = (1.0 - size) * missed - left
                    change = change + step.factors.solve(back)
                there = Trajectory(
                    point.at.states + change[layout.states], point.at.dipoles + change[layout.dipoles]
                )
                slack = point.slack + self._limits.along(point.at, change) + size * step.off
                if slack.size and float((slack - (1.0 - _TO_BOUNDARY) * point.slack).min()) < 0.0:
                    break
                left = np.concatenate([part.ravel() for part in self.equations.remainders(there)])
                lowered = self._merit(there, slack, barrier, weight, left) < lower
                if lowered or (attempt == 0 and correction == _CORRECTIONS):
                    multipliers = point.multipliers.copy()
                    multipliers[equal] += size * step.change[equal]
                    moved = self._point(there, multipliers, slack, dual)
                    if lowered or self.error(moved, barrier) < 0.9 * error:
                        return moved
            size *= 0.5
        return None

    def _merit(
        self, at: Trajectory, slack: FloatArray, barrier: float, weight: float, missed: FloatArray
    ) -> float:
        """Return the merit function: cost plus barriers plus `weight` times the constraint violation."""
        violation = float(np.abs(missed).sum() + np.abs(self._limits.values(at) - slack).sum())
        return self.equations.cost(at) + weight * violation - barrier * float(np.log(slack).sum())


class NewtonRun:
    """An interior point iteration that starts from an initial guess, and can be interrupted and resumed.

    The newest iterate is `point`. The iteration `is_over` at an optimum or if no further step is possible.
    """

    def __init__(
        self,
        program: SlewProgram,
        guess: Trajectory,
        multipliers: FloatArray | None = None,
        first: float = FIRST_BARRIER,
        last: float = 1e-8,
    ) -> None:
        """Start from the trajectory `guess` with Lagrange `multipliers` (size,), or zeros if None is given.

        The equations should be scaled so that the cost is of the order of one. The barrier parameter
        decreases from `first` to `last`.
        """
        self.program, self._first, self._last, self.is_over = program, first, last, False
        self.point = program.begin(guess, multipliers, first)
        self._barrier, self._convex = (first if self.point.slack.size else 0.0), 0.0

    @property
    def lack(self) -> float:
        """The constraint violation, or zero once the barrier parameter is below its initial value."""
        return 0.0 if 0.0 < self._barrier < self._first else self.missed

    @property
    def missed(self) -> float:
        """The constraint violation at the newest iterate."""
        return sum(self.program.lack(self.point))

    def run(self, maximum: int) -> Iterate | None:
        """Return the optimum found within `maximum` more Newton steps, or None if no optimum was found."""
        if self.is_over:
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow only shortens the step
            return self._run(maximum)

    def _run(self, maximum: int) -> Iterate | None:
        program, last = self.program, self._last
        for _ in range(maximum):
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
    """Return the largest fraction, at most one, of `change` that leaves the positive `values` positive."""
    falling = change < 0.0
    if not falling.any():
        return 1.0
    return min(1.0, _TO_BOUNDARY * float((values[falling] / -change[falling]).min()))
