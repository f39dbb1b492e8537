"""The nonlinear programs of virtual motion camouflage (Sease, eqs. (5.8) to (5.14)), solved with SLSQP.

A path has the values q2 = q_r + v (q_p - q_r) on N nodes (Sease, eqs. (5.10) to (5.12)). In the terms of
virtual motion camouflage, q_p is the prey path, which serves as the initial guess, q_r is the reference
point, and v are the path control parameters. A path is the polynomial of degree N - 1 through the values on
the nodes, so q2', q2'' and the current are also exact between nodes. The path control parameter v is 1 at
both ends. The path control parameters v_2 and v_(N-1) follow from the boundary rates by q' = D q, with the
differentiation matrix D (Sease, eq. (5.11), corrected). N - 4 path control parameters are free.

The initial guess q_p is an affine function of the duration T (`horizon`), and for a fixed q_p the path is an
affine function of v - 1. Paths are therefore parametrised as prey(T) + M y with a matrix M and parameters y.
Each column of the matrix M is a change of the path that preserves the values and slopes at both ends. The
changes are combined so that the energy has about a unit Hessian (whitening). Paths are therefore affine
functions of the optimisation variables, and the optimisation is well conditioned.

There are two optimisation problems with the same function of the energy and the same limits: one has a fixed
duration and minimises the energy, the other has a free duration and minimises energy plus time cost. The
limits hold at every time and not only at the nodes. The limits are imposed at those points of a dense grid at
which the previous solution exceeded a limit, until no limit is exceeded (the exchange method of semi-infinite
programming).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import nlopt
import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.gnc.guidance.plant import (
    SQUARE_Q2_WITHOUT_AUTHORITY,
    CubicPrey,
    LglRule,
    PathCost,
    SingleAxisPlant,
    current_and_slopes,
    lgl_rule,
)

DENSE_POINTS = 769


@dataclass(frozen=True, slots=True)
class SamplePoints:
    """Points (m,) with matrices (3, m, N) that map values on the nodes to q2, q2' and q2'' at the points."""

    points: FloatArray
    matrices: FloatArray

    @classmethod
    def at(cls, rule: LglRule, points: FloatArray) -> SamplePoints:
        """Return the matrices for `points` (m,) in [-1, 1] and polynomials on the nodes of `rule`."""
        value = rule.interpolation(points)
        slope = value @ rule.differentiation
        return cls(points, np.stack([value, slope, slope @ rule.differentiation]))

    def take(self, index: IntArray) -> SamplePoints:
        """Return the evaluation matrices at those points that have the indices `index`."""
        return SamplePoints(self.points[index], self.matrices[:, index])


@dataclass(frozen=True, slots=True)
class Discretisation:
    """Matrices of the pseudospectral discretisation, which depend only on the number of nodes.

    Attributes:
        rule: the N nodes.
        cost: evaluation matrices on the 2 N nodes on which the energy is integrated. The quadrature error of
            N nodes would be large, because I^2 has about twice the degree of the path, and the optimiser
            would exploit it.
        cost_weights: quadrature weights (2 N,) of the energy, whose sum is 2.
        dense: evaluation matrices at the points at which limits are checked; like the extrema of polynomials,
            the points are denser towards the ends.
        free: matrix (N, N - 4) that maps changes at the free nodes to changes at all nodes that preserve
            values and slopes at both ends.
    """

    rule: LglRule
    cost: SamplePoints
    cost_weights: FloatArray
    dense: SamplePoints
    free: FloatArray


@lru_cache(maxsize=8)
def discretisation(count: int) -> Discretisation:
    """Return the discretisation on `count` >= 6 nodes."""
    rule = lgl_rule(count)
    fine = lgl_rule(2 * count)
    dense = -np.cos(np.linspace(0.0, np.pi, DENSE_POINTS))
    slopes = rule.differentiation[[0, -1]]
    # The values next to the ends change so that q' at the ends stays constant (Sease, eqs. 5.11, 5.12).
    next_to_ends = np.linalg.solve(slopes[:, [1, -2]], -slopes[:, 2:-2])
    free = np.zeros((count, count - 4))
    free[2:-2] = np.eye(count - 4)
    free[[1, -2]] = next_to_ends
    return Discretisation(
        rule, SamplePoints.at(rule, fine.nodes), fine.weights, SamplePoints.at(rule, dense), free
    )


@dataclass(frozen=True, slots=True)
class BoundaryStates:
    """The boundary states of a path: q2 and q2' (1/s) at both ends."""

    start: float
    start_slope: float
    end: float
    end_slope: float

    def prey(self, horizon: float) -> CubicPrey:
        """Return the cubic initial guess (prey path) between the boundary states over `horizon` s."""
        return CubicPrey.between(self.start, self.start_slope, self.end, self.end_slope, horizon)


@dataclass(frozen=True, slots=True)
class PathFamily:
    """A family of paths between two states, given on N nodes as affine functions of duration and parameters.

    The path of duration T with the parameters y has the values `still` + T `drift` + `basis` y.

    Attributes:
        grid: pseudospectral discretisation of the paths.
        still: values (N,), on the nodes, of the initial guess (prey path) for zero slopes at both ends; these
            values do not depend on the duration.
        drift: change (N,) of the initial guess per second of duration, due to the slopes at both ends.
        basis: change (N, N - 4) of the values on the nodes per unit of each parameter.
    """

    grid: Discretisation
    still: FloatArray
    drift: FloatArray
    basis: FloatArray

    @classmethod
    def around(cls, boundary: BoundaryStates, horizon: float, reference: float, count: int) -> PathFamily:
        """Return the family of paths about the initial guess of `horizon` s, with parameters y = v - 1."""
        grid = discretisation(count)
        fraction = 0.5 * (grid.rule.nodes + 1.0)
        still = CubicPrey.between(boundary.start, 0.0, boundary.end, 0.0, 1.0).q2(fraction)
        drift = CubicPrey.between(0.0, boundary.start_slope, 0.0, boundary.end_slope, 1.0).q2(fraction)
        to_reference = (still + horizon * drift - reference)[2:-2]
        return cls(grid, still, drift, grid.free * to_reference)

    @property
    def size(self) -> int:
        """The number of free path control parameters, N - 4."""
        return int(self.basis.shape[1])

    def nodes(self, parameters: FloatArray, horizon: float) -> FloatArray:
        """Return the values q2 (N,) of a path on the nodes."""
        return np.asarray(self.still + horizon * self.drift + self.basis @ parameters)

    def observed(self, samples: SamplePoints) -> ObservedFamily:
        """Return the family of paths evaluated at the points of `samples`."""
        matrices = samples.matrices
        return ObservedFamily(matrices @ self.still, matrices @ self.drift, matrices @ self.basis)


@dataclass(frozen=True, slots=True)
class ObservedFamily:
    """A family of paths at m points: q2 and the derivatives of q2 with respect to the scaled time."""

    still: FloatArray
    drift: FloatArray
    basis: FloatArray

    def trajectory(self, parameters: FloatArray, horizon: float) -> FloatArray:
        """Return q2, q2' (1/s) and q2'' (1/s^2) of a path at the m points, as an array (3, m)."""
        return time_scale(horizon) * (self.still + horizon * self.drift + self.basis @ parameters)

    def aging(self, trajectory: FloatArray, horizon: float) -> FloatArray:
        """Return the derivative (3, m) of q2, q2' and q2'' with respect to the duration.

        A longer duration changes the initial guess and reduces the factors of `time_scale`.
        """
        slower = np.array([[0.0], [-1.0], [-2.0]]) / (horizon * time_scale(horizon))
        return np.asarray(self.drift + slower * trajectory)


def time_scale(horizon: float) -> FloatArray:
    """Return the factors (3, 1) that convert derivatives with respect to s in [-1, 1] to time derivatives."""
    per_second = 2.0 / horizon
    return np.array([[1.0], [per_second], [per_second * per_second]])


LIMIT_TOLERANCE = 3e-4
"""Largest excess of a path over a limit on the dense grid, as a fraction of the limit. Between the points of
the dense grid, the path then exceeds a limit by less than the fraction 1e-3."""

IMPOSED_MARGIN = 2e-4
"""Fraction by which an imposed limit is tightened, so that peaks between the imposed points do not exceed the
limit. Without this margin, the exchange method converges slowly."""

SOLVER_STOPS = (nlopt.RoundoffLimited, RuntimeError, getattr(nlopt, "runtime_error", RuntimeError))
"""Exceptions that NLopt raises if a run ends without a result. NLopt 2.11 raises `nlopt.runtime_error`, and
older versions raise Python's RuntimeError."""
CONVERGED = (nlopt.SUCCESS, nlopt.FTOL_REACHED, nlopt.XTOL_REACHED)
"""Results of converged runs of NLopt."""
_EXCHANGES = 10
_EVALUATIONS = 300
_FREE_TOLERANCE = 1e-5
_IMPOSE_ABOVE = 0.5
_IMPOSE_EVERY = 16


@dataclass(frozen=True, slots=True)
class Trial:
    """A point of the search space: the parameters (N - 4,) of a path and the duration (s) of the path."""

    parameters: FloatArray
    horizon: float


@dataclass(frozen=True, slots=True)
class FreeHorizon:
    """Settings for the optimisation of the duration: bounds of the duration (s) and time cost (W)."""

    shortest: float
    longest: float
    time_cost: float


@dataclass(frozen=True, slots=True)
class ImposedLimits:
    """The m imposed limits: index of the grid point, sign, and whether q2 or the current is limited."""

    index: IntArray
    sign: FloatArray
    is_q2: BoolArray

    @classmethod
    def at(cls, chosen: BoolArray, ratios: FloatArray) -> ImposedLimits:
        """Return the limits to impose at the points that the mask `chosen` (2, dense) selects.

        The first row of the mask selects limits of the current, and the second row selects limits of q2. The
        signs of `ratios` (2, dense) determine whether the upper or the lower limit is imposed.
        """
        row, index = np.nonzero(chosen)
        return cls(index, np.sign(ratios[row, index]), row == 1)


class PathProgram:
    """The nonlinear program for a plant and a family of paths between two states, with cost and limits.

    Attributes:
        family: paths between the two states, with parameters whitened about the initial guess.
        evaluations: number of evaluations of the cost, over all solutions.
        bang_power: power R Imax^2 of the coil at the current limit, W.
    """

    def __init__(
        self, plant: SingleAxisPlant, family: PathFamily, q2_limit: float, horizon: float, cost: PathCost
    ) -> None:
        self.plant, self._cost = plant, cost
        # The margin to the limit of q2 is smaller if a given end of the path is close to the limit.
        self._q2_limit = max(q2_limit, (1.0 + IMPOSED_MARGIN) * float(np.abs(family.still[[0, -1]]).max()))
        # Intermediate paths of the optimiser may exceed |q2| = 0.707, at which the current is infinite.
        # A value of q2 above the limit is clamped, so that the current stays finite.
        self._q2_cap = 0.5 * (q2_limit + math.sqrt(SQUARE_Q2_WITHOUT_AUTHORITY))
        self._weights = 0.5 * family.grid.cost_weights
        self.bang_power = plant.resistance * plant.current_limit**2
        # The family is rescaled so that the energy has a unit Gauss-Newton Hessian.
        # SLSQP starts with a unit Hessian, so its first step from the initial guess is a Gauss-Newton step.
        observed = family.observed(family.grid.cost)
        prey = observed.trajectory(np.zeros(family.size), horizon)
        _, slopes = self._current(prey, horizon)
        root_weights = np.sqrt(2.0 * self.plant.resistance * horizon * self._weights)
        jacobian = root_weights[:, None] * _contract(slopes, observed.basis)
        self.family = replace(family, basis=family.basis @ np.linalg.inv(np.linalg.qr(jacobian, mode="r")))
        self._cost_points = self.family.observed(family.grid.cost)
        self.evaluations = 0

    def prey(self, horizon: float) -> Trial:
        """Return the initial guess of `horizon` s, for which all path control parameters are one."""
        return Trial(np.zeros(self.family.size), horizon)

    def _current(self, trajectory: FloatArray, horizon: float) -> tuple[FloatArray, FloatArray]:
        """Return currents (m,), and their derivatives (3, m) with respect to q2, dq2/ds and d2q2/ds2."""
        q2 = trajectory[0]
        held = np.minimum(np.maximum(q2, -self._q2_cap), self._q2_cap)
        current, *slopes = current_and_slopes(self.plant, held, trajectory[1], trajectory[2])
        stacked = np.array(slopes)
        stacked[0] *= held == q2
        stacked *= time_scale(horizon)
        return current, stacked

    def energy(self, trial: Trial) -> tuple[float, FloatArray, float]:
        """Return the energy (J), its gradient (N - 4,), and its derivative with respect to the duration.

        For heat, the energy is the integral of Sease, eq. (5.8), without the factor 1/2 of eq. (5.1).
        """
        points, horizon = self._cost_points, trial.horizon
        trajectory = points.trajectory(trial.parameters, horizon)
        current, slopes = self._current(trajectory, horizon)
        power, by_current = self._cost.smooth(self.plant, current)
        energy = horizon * float(self._weights @ power)
        pull = (horizon * self._weights * by_current) * slopes
        gradient = pull.ravel() @ points.basis.reshape(-1, points.basis.shape[2])
        by_horizon = energy / horizon + float(np.sum(pull * points.aging(trajectory, horizon)))
        return energy, gradient, by_horizon

    def spent(self, trial: Trial, cost: PathCost) -> float:
        """Return the integral of a power along a path, J."""
        trajectory = self._cost_points.trajectory(trial.parameters, trial.horizon)
        power = cost.power(self.plant, self._current(trajectory, trial.horizon)[0])
        return trial.horizon * float(self._weights @ power)

    def excess(
        self, limits: ImposedLimits, points: ObservedFamily, trial: Trial
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the excesses (m,) over limits at m points, and the derivatives of the excesses.

        The derivatives are (m, N - 4) with respect to the parameters and (m,) with respect to the duration.
        """
        trajectory = points.trajectory(trial.parameters, trial.horizon)
        current, slopes = self._current(trajectory, trial.horizon)
        value = np.where(limits.is_q2, trajectory[0] / self._q2_limit, current / self.plant.current_limit)
        slopes /= self.plant.current_limit
        slopes[:, limits.is_q2] = np.array([[1.0 / self._q2_limit], [0.0], [0.0]])
        slopes *= limits.sign
        aged = np.sum(slopes * points.aging(trajectory, trial.horizon), axis=0)
        return limits.sign * value - 1.0, _contract(slopes, points.basis), aged

    def ratios(self, trial: Trial) -> FloatArray:
        """Return current and q2 on the dense grid, divided by the limits, as an array (2, dense)."""
        nodes = self.family.nodes(trial.parameters, trial.horizon)
        trajectory = time_scale(trial.horizon) * (self.family.grid.dense.matrices @ nodes)
        current, _ = self._current(trajectory, trial.horizon)
        return np.stack([current / self.plant.current_limit, trajectory[0] / self._q2_limit])

    def beside_prey(self, apart: FloatArray, horizon: float) -> Trial:
        """Return the path that differs by `apart` (N,), on the nodes, from the initial guess."""
        return Trial(np.asarray(np.linalg.solve(self.family.basis[2:-2], apart[2:-2]), dtype=float), horizon)

    def from_prey(self, trial: Trial) -> FloatArray:
        """Return the difference (N,) on the nodes between a path and the initial guess of its duration."""
        return np.asarray(self.family.basis @ trial.parameters)

    def unlimited(self, start: Trial) -> Trial | None:
        """Return the minimum-energy path without limits that has the duration of `start`.

        The result is None if no path is found.
        """
        trial, converged = self._minimise(start, None, None)
        if converged:
            return trial
        # If the start is already the optimum, NLopt reports limited progress due to rounding errors. This
        # report is not a failure if a further Newton step would reduce the energy only a little. The
        # reduction is estimated as half the squared gradient with respect to the whitened parameters.
        _, gradient, _ = self.energy(trial)
        return trial if 0.5 * float(gradient @ gradient) <= self._energy_tolerance(trial.horizon) else None

    def limited(self, start: Trial, free: FreeHorizon | None = None) -> Trial | None:
        """Return the minimum-energy path within the limits, found from `start`, or None if none is found.

        If `free` is given, the duration is also optimised, and the time cost is added to the energy.
        """
        ratios = self.ratios(start)
        every = np.arange(ratios.shape[1]) % _IMPOSE_EVERY == _IMPOSE_EVERY // 2
        chosen = (np.abs(ratios) > _IMPOSE_ABOVE) & every | _peaks(ratios)
        trial = start
        for _ in range(_EXCHANGES):
            limits = ImposedLimits.at(chosen, ratios)
            trial, converged = self._minimise(trial, limits, free)
            latest = self.ratios(trial)
            worst = float(np.abs(latest).max())
            if worst <= 1.0 + LIMIT_TOLERANCE:
                return trial if converged else None
            if not math.isfinite(worst) or np.any(np.abs(latest[chosen]) > 1.0 + LIMIT_TOLERANCE):
                return None  # the run violated an imposed limit
            added = _peaks(latest) & ~chosen
            ratios = np.where(added, latest, ratios)
            chosen = chosen | added
        return None

    def _energy_tolerance(self, horizon: float) -> float:
        """Return the tolerance of the energy (J): 1e-8 of the energy at the largest current."""
        return 1e-8 * self.bang_power * horizon

    def _minimise(
        self, start: Trial, limits: ImposedLimits | None, free: FreeHorizon | None
    ) -> tuple[Trial, bool]:
        """Run SLSQP once from `start`, and return the final point and whether the run converged."""
        variables = _Variables(start, self.family.size, free)
        size, time_cost = variables.size, variables.time_cost
        last = variables.first

        def objective(x: FloatArray, gradient: FloatArray) -> float:
            nonlocal last
            last = x.copy()
            self.evaluations += 1
            trial = variables.trial(x)
            energy, by_parameters, by_horizon = self.energy(trial)
            if gradient.size:
                gradient[:size] = by_parameters
                if free:
                    gradient[size] = variables.root * trial.horizon * (by_horizon + time_cost)
            return energy + time_cost * trial.horizon

        solver = nlopt.opt(nlopt.LD_SLSQP, last.size)
        solver.set_min_objective(objective)
        # A relative tolerance of 1e-5 of the objective determines a free duration to 0.01 % or better.
        origin = variables.origin
        solver.set_ftol_abs(_FREE_TOLERANCE * time_cost * origin if free else self._energy_tolerance(origin))
        solver.set_maxeval(_EVALUATIONS)
        variables.bound(solver)
        if limits is not None and limits.index.size:
            self._impose(solver, limits, variables)
        try:
            found = np.asarray(solver.optimize(last))
        except SOLVER_STOPS:
            # NLopt raises an exception after a negligible line search, for trivial and infeasible problems.
            return variables.trial(last), False
        return variables.trial(found), solver.last_optimize_result() in CONVERGED

    def _impose(self, solver: nlopt.opt, limits: ImposedLimits, variables: _Variables) -> None:
        points = self.family.observed(self.family.grid.dense.take(limits.index))
        size = variables.size

        def constraints(result: FloatArray, x: FloatArray, gradient: FloatArray) -> None:
            trial = variables.trial(x)
            value, by_parameters, by_horizon = self.excess(limits, points, trial)
            result[:] = value + IMPOSED_MARGIN
            if gradient.size:
                gradient[:, :size] = by_parameters
                if variables.free:
                    gradient[:, size] = variables.root * trial.horizon * by_horizon

        solver.add_inequality_mconstraint(constraints, np.full(limits.index.size, 1e-6))


class _Variables:
    """The optimisation variables: path parameters and, if free, the scaled logarithm of the duration.

    The logarithm log(T/T0) is scaled so that the time cost, like the energy, has a curvature of about one.

    Attributes:
        first: initial values of the variables.
        root: change of log(T/T0) per unit of the variable of a free duration T; zero for a fixed duration.
    """

    def __init__(self, start: Trial, size: int, free: FreeHorizon | None) -> None:
        self.size, self.origin, self.free = size, start.horizon, free
        self.time_cost = free.time_cost if free else 0.0
        self.root = 1.0 / math.sqrt(free.time_cost * self.origin) if free else 0.0
        self.first = np.append(start.parameters, 0.0) if free else start.parameters

    def trial(self, x: FloatArray) -> Trial:
        """Return the parameters and the duration of the path that the variables `x` describe."""
        horizon = self.origin * math.exp(self.root * x[self.size]) if self.free else self.origin
        return Trial(x[: self.size].copy(), horizon)

    def bound(self, solver: nlopt.opt) -> None:
        """Set the bounds of a free duration in the optimiser `solver`."""
        if self.free is not None:
            bounds = self.free.shortest, self.free.longest
            low, high = (math.log(bound / self.origin) / self.root for bound in bounds)
            solver.set_lower_bounds(np.append(np.full(self.size, -np.inf), low))
            solver.set_upper_bounds(np.append(np.full(self.size, np.inf), high))
            self.first[self.size] = min(max(0.0, low), high)


def _contract(slopes: FloatArray, basis: FloatArray) -> FloatArray:
    """Return the gradients (m, n) of functions of q2, q2' and q2'' at m points, by the chain rule.

    The array `slopes` (3, m) contains the derivatives of the functions with respect to q2, q2' and q2''. The
    array `basis` (3, m, n) contains the derivatives of q2, q2' and q2'' with respect to n parameters.
    """
    return np.asarray((slopes[:, :, None] * basis).sum(axis=0))


def _peaks(ratios: FloatArray) -> BoolArray:
    """Return a mask (2, m) of those local maxima of |ratios| (2, m) along each row which exceed one."""
    size = np.abs(ratios)
    peak = size > 1.0
    peak[:, 1:] &= size[:, 1:] >= size[:, :-1]
    peak[:, :-1] &= size[:, :-1] >= size[:, 1:]
    return np.asarray(peak)
