"""The planner of minimum-energy paths about one axis by virtual motion camouflage.

The planner uses the method of Sease 2013, eqs. (5.8) to (5.15), with corrections. NLopt optimises the free
path control parameters under the limit |I| <= Imax of the current and an upper bound of |q2| at every time.
If no path of the requested duration satisfies the limits, the duration is extended to the shortest feasible
duration, and the plan has the status STRETCHED. If the duration has a cost, the duration is optimised as
well. Energy is the integral of R I^2 in J, without the factor 1/2 of Sease, eq. (5.1).

Every search for a duration (`horizon`) between a shortest and a longest duration minimises energy plus time
cost times duration. With a time cost far above the power of the coil, and the requested duration as lower
bound, the search returns the requested duration if this duration is feasible, and otherwise the shortest
feasible duration. The planner therefore never has to solve an infeasible nonlinear program.

The planner is deterministic, so that the same arguments give the same plan in any process.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Literal

import numpy as np

from knightcube.astro.arrays import FloatArray, brief, check_numbers, check_type, real_number
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.plant import (
    FARTHEST,
    Q2_LIMIT,
    SQUARE_Q2_WITHOUT_AUTHORITY,
    CubicPrey,
    PathCost,
    PolynomialPath,
    SingleAxisPlant,
    angle_of,
    lgl_rule,
    q2_of,
    q2_rate_of,
    rate_of,
)
from knightcube.gnc.guidance.vmc_program import (
    LIMIT_TOLERANCE,
    BoundaryStates,
    FreeHorizon,
    PathFamily,
    PathProgram,
    Trial,
)

ProgramAt = Callable[[float], PathProgram]
"""Function that returns the nonlinear program for a duration (s). The variables are whitened about the
initial guess of this duration (the prey path of virtual motion camouflage)."""

SHORTEST_COST = 7.0
"""Time cost in the search for the shortest duration, divided by the largest coil power R Imax^2. An infinite
time cost would give the bang-bang path, whose energy is up to 1 % above the optimum for the same duration.
With SHORTEST_COST, the duration is about 0.3 % longer than the shortest duration, and the energy is within
0.25 % of the optimum."""

_SHORTEST_STRETCH = 1.015
"""Largest factor by which a search with SHORTEST_COST may extend a feasible requested duration."""

_START_BELOW = 1.7
_GROW_TO = 1.4
_RETRY = 1.4
ALONG_LIMIT = 0.99
"""Ratio of the current or of |q2| to its limit above which a path counts as reaching the limit."""
_ATTEMPTS = 10
_AT_BOUND = 1e-9
_ANCHORS = (0.85, 0.7, 0.5, 0.35, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)
_STEP, _MINIMUM_STEP = 1.15, 1.01
_MAXIMUM_EVALUATIONS = 3000
_TIME_COST_STEPS = 12
_TIME_COST_CHANGE = 0.03


@dataclass(slots=True)
class HorizonSearch:
    """A search for a path and for the duration of the path.

    Attributes:
        program_at: function that returns the nonlinear program for a duration, s.
        warm: correction (N,), on the nodes, that a warm start adds to the initial guess, or None without a
            warm start. The correction is the difference between an earlier path and its own initial guess.
        evaluations: number of evaluations of the cost so far.
    """

    program_at: ProgramAt
    warm: FloatArray | None = None
    evaluations: int = field(default=0)

    def within(self, asked: float, longest: float) -> tuple[PathProgram, Trial | None]:
        """Return the minimum-energy path over `asked` s, or over the shortest feasible time up to `longest`.

        The current of a rest-to-rest slew of duration T scales with 1/T^2, so solutions without limits give
        an estimate of the shortest feasible duration. The nonlinear program with a free duration starts from
        this estimate. If this program has no solution, the search is repeated from a longer duration.
        """
        if self.warm is not None:
            program = self.program_at(asked)
            trial = self._resumed(program, self.warm, asked, longest)
            self.evaluations += program.evaluations
            if trial is not None:
                return self._at_requested(program, trial, asked)
        time = asked
        for _ in range(_ATTEMPTS):
            program = self.program_at(time)
            relaxed = program.unlimited(program.prey(time))
            trial, growth = None, _RETRY
            if relaxed is not None:
                current, q2 = np.abs(program.ratios(relaxed)).max(axis=1).tolist()
                if time == asked and max(current, q2) <= 1.0 + LIMIT_TOLERANCE:
                    trial = relaxed
                elif current < _START_BELOW or time == longest:
                    trial = self._shortest(program, relaxed, asked, longest)
                else:
                    growth = math.sqrt(current / _GROW_TO)
            self.evaluations += program.evaluations
            if trial is not None or time == longest:
                break
            time = min(longest, time * growth)
        if trial is None:
            return self._continued(program, asked, longest)
        return self._at_requested(program, trial, asked)

    def with_time_cost(
        self, guess: float, shortest: float, longest: float, time_cost: float
    ) -> tuple[PathProgram, Trial | None]:
        """Return the path that minimises energy plus `time_cost` (W) times duration, found from a `guess`, s.

        The derivative of the minimum energy with respect to the duration equals the partial derivative at the
        optimal path (envelope theorem). A tried duration is a lower bound of the optimum if a longer duration
        reduces the total cost, and otherwise an upper bound. The next duration T is chosen as if the energy
        were proportional to 1/T^3, which holds for a slew without limits. Of the solved programs, only the
        last program imposes the limits of current and angle.
        """
        low, high, time = shortest, longest, min(max(guess, shortest), longest)
        time_cost = min(time_cost, SHORTEST_COST * self.program_at(time).bang_power)
        for _ in range(_TIME_COST_STEPS):
            program = self.program_at(time)
            relaxed = program.unlimited(program.prey(time))
            self.evaluations += program.evaluations
            if relaxed is None:
                break
            current = float(np.abs(program.ratios(relaxed)[0]).max())
            _, _, slope = program.energy(relaxed)
            if current > _START_BELOW:
                low, following = time, time * math.sqrt(current / _GROW_TO)
            else:
                low, high = (time, high) if slope < -time_cost else (low, time)
                following = time * min(max(max(-slope / time_cost, 0.0) ** 0.25, 0.5), 2.0)
            if not low < following < high:
                following = math.sqrt(low * high)
            if abs(following - time) <= _TIME_COST_CHANGE * time or high <= low * (1.0 + _TIME_COST_CHANGE):
                spent = program.evaluations
                trial = program.limited(relaxed, FreeHorizon(shortest, longest, time_cost))
                self.evaluations += program.evaluations - spent
                if trial is not None:
                    return program, trial
                break
            time = following
        return self.within(time, longest)

    def _at_requested(self, program: PathProgram, trial: Trial, asked: float) -> tuple[PathProgram, Trial]:
        """Return a path over `asked` s found from a longer path, or the longer path if none is found."""
        if not asked * (1.0 + _AT_BOUND) < trial.horizon <= asked * _SHORTEST_STRETCH:
            return program, trial
        at_asked, found = self.over(asked, program.from_prey(trial))
        return (program, trial) if found is None else (at_asked, found)

    def _continued(
        self, failed: PathProgram, asked: float, longest: float
    ) -> tuple[PathProgram, Trial | None]:
        """Return a path of `asked` s or longer, found from a path of another duration in small steps.

        If the torque of the suspension thread exceeds the torque of the coil, only durations that fit the
        free oscillation of the body are feasible. From a duration with a known path, the duration is changed
        in steps, and the search of each step starts from the last path. Shorter durations are tried first.
        """
        stretched: tuple[PathProgram, Trial] | None = None
        for factor in _ANCHORS:
            if asked * factor > longest or self.evaluations > _MAXIMUM_EVALUATIONS:
                break
            program, trial = self.over(asked * factor, None)
            step = _STEP
            while trial is not None and trial.horizon != asked and step > _MINIMUM_STEP:
                ratio = min(max(asked / trial.horizon, 1.0 / step), step)
                wanted = asked if 1.0 / step < ratio < step else trial.horizon * ratio
                further, found = self.over(wanted, program.from_prey(trial))
                if found is None:
                    step = math.sqrt(step)
                else:
                    program, trial = further, found
                    step = min(step * step, _STEP)
            if trial is not None and trial.horizon == asked:
                return program, trial
            if trial is not None and trial.horizon > asked and stretched is None:
                stretched = program, trial
        return stretched or (failed, None)

    def over(self, time: float, apart: FloatArray | None) -> tuple[PathProgram, Trial | None]:
        """Return the nonlinear program for the duration `time` (s), and a path within the limits or None.

        The search starts from the initial guess plus the difference `apart` (N,) on the nodes, if given.
        """
        program = self.program_at(time)
        trial = None if apart is None else program.limited(program.beside_prey(apart, time))
        if trial is None:
            start = program.prey(time) if apart is None else program.beside_prey(apart, time)
            trial = program.unlimited(start)
            if trial is None or float(np.abs(program.ratios(trial)).max()) > 1.0 + LIMIT_TOLERANCE:
                trial = program.limited(start if trial is None else trial)
        self.evaluations += program.evaluations
        return program, trial

    def _resumed(self, program: PathProgram, warm: FloatArray, asked: float, longest: float) -> Trial | None:
        """Return the path found by a warm start, or None.

        If the warm start itself reaches a limit, no solution without limits is computed.
        """
        start = program.beside_prey(warm, asked)
        worst = float(np.abs(program.ratios(start)).max())
        if not worst < _START_BELOW:
            return None
        if worst > ALONG_LIMIT:
            return self._shortest(program, start, asked, longest)
        trial = program.unlimited(start)
        if trial is None or float(np.abs(program.ratios(trial)).max()) > 1.0 + LIMIT_TOLERANCE:
            return None
        return trial

    def _shortest(self, program: PathProgram, start: Trial, asked: float, longest: float) -> Trial | None:
        """Return the minimum-energy path over `asked` s, or the shortest path if `asked` is infeasible."""
        time_cost = SHORTEST_COST * program.bang_power
        trial = program.limited(start, FreeHorizon(asked, longest, time_cost))
        if trial is None or trial.horizon > asked * (1.0 + _AT_BOUND):
            return trial
        return program.limited(Trial(trial.parameters, asked)) or trial


NODES = 24
"""Number of nodes of a path. With 24 nodes, the relative error of the cost is below 1e-4 for durations above
1.1 times the shortest duration. If the requested duration is too short and is extended, the result is at
most 1.5 % too long. With 16 nodes, planning takes half the time, and the result is at most 2.5 % too long."""
FINE_NODES = 40
"""Number of nodes for paths that reach the current limit near the requested duration. With 24 nodes,
a path at the limit costs up to 0.3 % more than the optimal path, and with 40 nodes up to 0.07 %."""
_NEARLY = 1.03
"""Largest extension factor of a duration with which a path of the requested duration is sought again, on more
nodes."""

REFERENCE = 2.0
MAX_STRETCH = 6.0
NODES_RANGE = (8, 40)
HORIZON_RANGE = (1e-3, 1e5)
FASTEST = 100.0
SHORTEST_WITH_TIME_COST = 1.0


class PlanStatus(StrEnum):
    """Whether a plan has the requested duration (OPTIMAL) or a longer duration (STRETCHED).

    If the duration has a cost, the status is OPTIMAL.
    """

    OPTIMAL = "optimal"
    STRETCHED = "stretched"


@dataclass(frozen=True, slots=True, eq=False)
class StepPlan:
    """A planned path with energy, peak current and status.

    Attributes:
        path: planned path, which starts at time zero until guidance sets the start time.
        status: whether the requested duration was kept or extended to the shortest feasible duration.
        horizon_asked, horizon: requested and planned duration, s, which are equal if the duration has a cost.
        energy: integral of R I^2 along the path, J.
        supplied: energy taken from the supply, which is the integral of V |I| along the path, J.
        peak_current: largest absolute coil current along the path, A.
        evaluations: number of evaluations of the cost.
        target_q2: q2 at the end.
        nu: path control parameters (N,) of virtual motion camouflage, relative to the initial guess (prey
            path) of the duration `horizon`.
        node_times: times of the nodes (N,), s.
        node_q2: values q2 on the nodes (N,).
    """

    path: PolynomialPath
    status: PlanStatus
    horizon_asked: float
    horizon: float
    energy: float
    supplied: float
    peak_current: float
    evaluations: int
    target_q2: float
    nu: FloatArray
    node_times: FloatArray
    node_q2: FloatArray

    def __repr__(self) -> str:
        """Return status, duration, energy and peak current as one line of text."""
        return (
            f"<StepPlan {self.status}: {self.horizon:g} s, heat {1e3 * self.energy:.4g} mJ, "
            f"peak current {1e3 * self.peak_current:.4g} mA>"
        )

    def spent(self, cost: PathCost) -> float:
        """Return the energy of the given kind, J."""
        return self.energy if cost is PathCost.HEAT else self.supplied


def plan(
    plant: SingleAxisPlant,
    start_q2: float,
    start_rate: float,
    end_q2: float,
    end_rate: float,
    horizon: float,
    *,
    nodes: int = NODES,
    reference: float = REFERENCE,
    q2_limit: float = Q2_LIMIT,
    max_stretch: float = MAX_STRETCH,
    time_cost: float | None = None,
    last: PolynomialPath | None = None,
    cost: PathCost = PathCost.HEAT,
) -> StepPlan:
    """Return the minimum-energy path between two states in `horizon` s, or in the shortest feasible time.

    Rates are body rates in rad/s. The argument `reference` is the reference point q_r of Sease, eq. (5.10),
    which must lie beyond the range of q2, and `q2_limit` is the upper bound of |q2|. The duration is extended
    to at most `max_stretch` times the requested duration. An extended duration is about 0.3 % longer than the
    shortest duration on `nodes` nodes, and at most 1.5 % longer than the duration of the bang-bang path.

    If `time_cost`, W, is given, the path minimises energy plus `time_cost` times duration. The optimised
    duration is between SHORTEST_WITH_TIME_COST s and `max_stretch` times `horizon`, which is the initial
    guess. The argument `last` is the path followed until now, with an origin relative to the start of the new
    path. The initial guess is the remaining part of the path `last`. The argument `cost` selects the kind of
    energy.

    Raises PlanningError if an argument is outside its limits, or if no permitted duration is feasible.
    """
    states = {"start_q2": start_q2, "start_rate": start_rate, "end_q2": end_q2, "end_rate": end_rate}
    _check(plant, states, horizon, nodes, reference, q2_limit, max_stretch)
    if time_cost is not None and not 0.0 < real_number(time_cost) < math.inf:
        raise PlanningError(f"time_cost is {brief(time_cost)} W: it must be finite and positive")
    boundary = BoundaryStates(
        start_q2, q2_rate_of(start_q2, start_rate), end_q2, q2_rate_of(end_q2, end_rate)
    )

    def program_at(time: float, count: int = nodes) -> PathProgram:
        return PathProgram(plant, PathFamily.around(boundary, time, reference, count), q2_limit, time, cost)

    search = HorizonSearch(program_at, _remains(last, nodes))
    longest = max_stretch * horizon
    if time_cost is None:
        program, trial = search.within(horizon, longest)
    else:
        program, trial = search.with_time_cost(
            horizon, min(SHORTEST_WITH_TIME_COST, longest), longest, time_cost
        )
    if trial is None and cost is PathCost.SUPPLY:
        # The heat is a smooth function of the current, so a search for the minimum heat finds the shortest
        # duration more often.
        coolest = plan(
            plant,
            start_q2,
            start_rate,
            end_q2,
            end_rate,
            horizon,
            nodes=nodes,
            reference=reference,
            q2_limit=q2_limit,
            max_stretch=max_stretch,
            time_cost=time_cost,
            last=last,
        )
        search = HorizonSearch(program_at, _remains(coolest.path, nodes), search.evaluations)
        program, trial = search.over(coolest.horizon, search.warm)
        if trial is None:
            return coolest
    if trial is None:
        raise PlanningError(
            f"no path was found from {angle_of(start_q2):.4f} rad at {start_rate:.4f} rad/s to "
            f"{angle_of(end_q2):.4f} rad at {end_rate:.4f} rad/s in {horizon:g} to {longest:g} s, with up to "
            f"{angle_of(q2_limit):.4f} rad and {_remedy(plant, boundary, horizon, longest)}"
        )
    asked = horizon if time_cost is None else trial.horizon
    found = _assemble(program, trial, boundary, reference, asked, search.evaluations, end_rate)
    along_limit = found.peak_current >= ALONG_LIMIT * plant.current_limit
    if time_cost is not None or nodes >= FINE_NODES or not along_limit or trial.horizon > _NEARLY * asked:
        return found
    search = HorizonSearch(
        partial(program_at, count=FINE_NODES), _remains(found.path, FINE_NODES), search.evaluations
    )
    program, trial = search.within(asked, trial.horizon)
    if trial is None:
        return found
    finer = _assemble(program, trial, boundary, reference, asked, search.evaluations, end_rate)
    return min(finer, found, key=lambda one: (one.horizon, one.spent(cost)))


_TRIED = 64
"""Number of durations for which the smallest current is computed for the error message."""


def _remedy(plant: SingleAxisPlant, ends: BoundaryStates, horizon: float, longest: float) -> str:
    """Return the current limit, and the remedy if no path of `horizon` to `longest` s is found.

    Without a thread, the current limit must permit a bang-bang path with the torque at the angle zero, which
    is the largest torque. If the coil causes the acceleration a in one part of the time T and -a in the other
    part, it changes the rate by v, and the body moves by s more than T times the mean of both end rates, with
    a T^2 / 4 = |s| + v^2 / (4 a).
    """
    start, end = angle_of(ends.start), angle_of(ends.end)
    rates = rate_of(ends.start, ends.start_slope), rate_of(ends.end, ends.end_slope)
    limit, hold = f"{plant.current_limit:.4g} A", abs(plant.current(end, 0.0, 0.0))
    if hold > plant.current_limit and not rates[1]:
        return (
            f"{limit}: {hold:.3g} A would hold the end angle, which exceeds the limit: use a larger current "
            "limit or another end angle"
        )
    times = np.geomspace(horizon, longest, _TRIED)
    moved = np.abs(end - start - 0.5 * sum(rates) * times)
    changed = rates[1] - rates[0] - plant.disturbance * times
    needed = 2.0 / times**2 * (moved + np.sqrt(moved**2 + 0.25 * (changed * times) ** 2))
    current = float(needed.min()) * plant.inertia / plant.torque_constant
    if current > plant.current_limit and not (plant.stiffness or plant.damping):
        return (
            f"{limit}: every path of these durations needs at least about {current:.3g} A: use a larger "
            "current limit, a longer horizon or a smaller step"
        )
    # If the body moves at an end, it may also need a shorter horizon to stay within the range of angles.
    return f"{limit}: use {'another' if any(rates) else 'a longer'} horizon or a larger current limit"


def _remains(last: PolynomialPath | None, nodes: int) -> FloatArray | None:
    """Return the difference (N,), on the nodes, between the rest of the path `last` and its initial guess.

    The initial guess is the cubic with the same end states as the rest of the path. The result is None if the
    path `last` has ended.

    Adding the difference to the initial guess of another path does not change the boundary states of that
    path.
    """
    if last is None:
        return None
    elapsed = -1e-9 * last.origin_ns
    left = last.horizon - elapsed
    if not 0.0 < left <= last.horizon:
        return None
    times = 0.5 * left * (lgl_rule(nodes).nodes + 1.0)
    # The last sample is taken just before the end of the path, because the coast begins exactly at the end.
    angle, rate, _ = last.motion(elapsed + times * (1.0 - 1e-12))
    q2 = np.sin(0.5 * angle)
    slope = 0.5 * rate * np.cos(0.5 * angle)
    prey = CubicPrey.between(float(q2[0]), float(slope[0]), float(q2[-1]), float(slope[-1]), left)
    apart = q2 - prey.q2(times)
    return apart if np.isfinite(apart).all() else None


def _assemble(
    program: PathProgram,
    trial: Trial,
    boundary: BoundaryStates,
    reference: float,
    asked: float,
    evaluations: int,
    end_rate: float,
) -> StepPlan:
    """Return the plan for a solution `trial` of the optimiser, or raise PlanningError if it is not finite."""
    energy, supplied = (program.spent(trial, cost) for cost in PathCost)
    peak = float(np.abs(program.ratios(trial)[0]).max()) * program.plant.current_limit
    node_q2 = program.family.nodes(trial.parameters, trial.horizon)
    if not (math.isfinite(energy) and math.isfinite(peak) and np.isfinite(node_q2).all()):
        raise PlanningError("the optimiser returned a path that is not finite")
    times = 0.5 * trial.horizon * (program.family.grid.rule.nodes + 1.0)
    prey = boundary.prey(trial.horizon).q2(times)
    kept = trial.horizon <= asked * (1.0 + 1e-9)
    return StepPlan(
        path=PolynomialPath.through(node_q2, trial.horizon, end_rate=end_rate),
        status=PlanStatus.OPTIMAL if kept else PlanStatus.STRETCHED,
        horizon_asked=asked,
        horizon=trial.horizon,
        energy=energy,
        supplied=supplied,
        peak_current=peak,
        evaluations=evaluations,
        target_q2=boundary.end,
        nu=(node_q2 - reference) / (prey - reference),
        node_times=times,
        node_q2=node_q2,
    )


def _check(
    plant: SingleAxisPlant,
    states: dict[str, float],
    horizon: float,
    nodes: int,
    reference: float,
    q2_limit: float,
    max_stretch: float,
) -> None:
    """Raise PlanningError for arguments outside their ranges, and ArgumentError for another type."""
    check_type("plant", plant, SingleAxisPlant)
    check_numbers(**states, horizon=horizon, max_stretch=max_stretch)
    for name, value in states.items():
        if not math.isfinite(value):
            raise PlanningError(f"{name} is {value}: a path needs finite states")
    if not (q2_limit > 0.0 and q2_limit**2 < SQUARE_Q2_WITHOUT_AUTHORITY):
        raise PlanningError(
            f"q2_limit is {q2_limit}: it must lie between 0 and 0.707, where the coil has no torque"
        )
    for name in ("start_q2", "end_q2"):
        if abs(states[name]) > q2_limit:
            raise PlanningError(f"{name} is {states[name]:.4f}: beyond the limit of {q2_limit}")
    for name in ("start_rate", "end_rate"):
        if abs(states[name]) > FASTEST:
            raise PlanningError(f"{name} is {states[name]:g} rad/s: it must lie within +-{FASTEST} rad/s")
    if not HORIZON_RANGE[0] <= horizon <= HORIZON_RANGE[1]:
        raise PlanningError(f"horizon is {horizon} s: it must be {HORIZON_RANGE[0]} to {HORIZON_RANGE[1]} s")
    if not 1.0 <= max_stretch <= 1e3:
        raise PlanningError(f"max_stretch is {max_stretch}: it must be 1 to 1000")
    if not (math.isfinite(reference) and abs(reference) > 1.0):
        raise PlanningError(f"reference is {reference}: it must lie beyond the range of q2, |q_r| > 1")
    if not (isinstance(nodes, (int, np.integer)) and NODES_RANGE[0] <= nodes <= NODES_RANGE[1]):
        raise PlanningError(
            f"nodes is {brief(nodes)}: it must be an integer from {NODES_RANGE[0]} to {NODES_RANGE[1]}"
        )


@dataclass(frozen=True, slots=True)
class PlanJob:
    """A planning job for a path of `horizon` s between two states, which consist of q2 and rate (rad/s).

    The attribute `number` identifies the job, and the path starts at `origin_ns`. The attribute `last` is the
    path followed until now, with an origin relative to `origin_ns`. The other attributes are arguments of
    `plan`.
    """

    number: int
    origin_ns: int
    plant: SingleAxisPlant
    start_q2: float
    start_rate: float
    end_q2: float
    end_rate: float
    horizon: float
    max_horizon: float
    nodes: int = NODES
    time_cost: float | None = None
    last: PolynomialPath | None = None
    cost: PathCost = PathCost.HEAT


def run(job: PlanJob) -> StepPlan:
    """Return the plan for `job`.

    Raises PlanningError as `plan` does. The function is at module level, so that a worker process can import
    it.
    """
    return plan(
        job.plant,
        job.start_q2,
        job.start_rate,
        job.end_q2,
        job.end_rate,
        job.horizon,
        nodes=job.nodes,
        max_stretch=max(job.max_horizon / job.horizon, 1.0),
        time_cost=job.time_cost,
        last=job.last,
        cost=job.cost,
    )


def _q2_at(name: str, angle: float) -> float:
    """Return q2 at an angle (rad), the argument `name`. Raises PlanningError for an angle out of range."""
    check_numbers(**{name: angle})
    if not abs(angle) <= FARTHEST:
        in_degrees = abs(angle) > 2.0 * math.pi and abs(math.radians(angle)) <= FARTHEST
        raise PlanningError(
            f"{name} is {angle:.6g} rad: must be {-FARTHEST:.4f} to {FARTHEST:.4f} rad, beyond which the "
            "coil has almost no torque, and angles do not wrap"
            + (f"; {angle:g} deg would be {math.radians(angle):.4f} rad" if in_degrees else "")
        )
    return q2_of(angle)


def _cost(minimise: str) -> PathCost:
    """Return the kind of energy with the name `minimise`. Raises PlanningError for an unknown name."""
    names = [cost.value for cost in PathCost]
    if not (isinstance(minimise, str) and minimise in names):
        raise PlanningError(f"minimise is {brief(minimise)}: give {' or '.join(map(repr, names))}")
    return PathCost(minimise)


def plan_step(
    plant: SingleAxisPlant,
    *,
    start_angle: float,
    end_angle: float,
    horizon: float,
    start_rate: float = 0.0,
    end_rate: float = 0.0,
    time_cost: float | None = None,
    minimise: Literal["heat", "supply"] = "heat",
    nodes: int = NODES,
    max_stretch: float = MAX_STRETCH,
) -> StepPlan:
    """Return the minimum-energy path of a body that one torque coil rotates about one axis.

    The path is optimised by virtual motion camouflage (Sease 2013, eqs. (5.8) to (5.15)) with NLopt's SLSQP.
    The path satisfies the current limit and |angle| <= 1.4955 rad at every time; at larger angles the coil
    has almost no torque. Angles do not wrap. If no path of the requested duration satisfies the limits, the
    duration is extended to the shortest feasible duration ("stretched"). A plan takes about 2 ms.

    The method `plan.path.motion(times)` returns angle, rate and acceleration at times (n,), s after the
    start. The method `plant.currents` returns the coil currents for this motion.

    Args:
        plant: model with inertia, torque constant, coil and thread.
        start_angle: angle at the start, -1.4955 to 1.4955 rad; at zero, the torque is largest.
        end_angle: angle at the end, -1.4955 to 1.4955 rad.
        horizon: duration, s, or the initial guess of the duration if `time_cost` is given.
        start_rate: body rate at the start, rad/s.
        end_rate: body rate at the end, rad/s.
        time_cost: cost of the duration, W, added to the energy, or None to use `horizon` if possible.
        minimise: "heat" for the integral of R I^2, or "supply" for the supply energy, the integral of V |I|.
        nodes: number of nodes of the path, 8 to 40.
        max_stretch: largest ratio of the duration to `horizon`.

    Raises:
        PlanningError: if an argument is not finite or out of range, or if no path is found.
    """
    return plan(
        plant,
        _q2_at("start_angle", start_angle),
        start_rate,
        _q2_at("end_angle", end_angle),
        end_rate,
        horizon,
        nodes=nodes,
        max_stretch=max_stretch,
        time_cost=time_cost,
        cost=_cost(minimise),
    )
