"""The planner: least-energy paths by virtual motion camouflage (Sease 2013, 5.8-5.15 corrected).

NLopt optimises the free path control parameters under |I| <= Imax and |q2| <= a bound at every time. When no
path within the asked horizon keeps the limits, the horizon is stretched to the shortest that does and the
plan's status says so; with a price of time the horizon is optimised too. Energy is the integral of R I^2 in
J, without the factor 1/2 of 5.1.

Pure and deterministic: the same arguments give the same plan, in any process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.lgl import lgl_rule
from knightcube.gnc.guidance.one_axis.limits import Q2_LIMIT
from knightcube.gnc.guidance.one_axis.path import PolynomialPath
from knightcube.gnc.guidance.one_axis.path_cost import PathCost
from knightcube.gnc.guidance.one_axis.plant import SQUARE_Q2_WITHOUT_AUTHORITY, SingleAxisPlant, q2_rate_of
from knightcube.gnc.guidance.one_axis.prey import CubicPrey
from knightcube.gnc.guidance.one_axis.vmc_family import Boundary, Family
from knightcube.gnc.guidance.one_axis.vmc_horizon import ALONG_LIMIT, Search
from knightcube.gnc.guidance.one_axis.vmc_program import Program, Trial

NODES = 24
"""At 24 nodes the cost is within 1e-4 of the true optimum from 1.1 of the shortest horizon on, a stretched
horizon within 1.5 % of the shortest; 16 nodes take half the time and leave 2.5 %."""
FINE_NODES = 40
"""For paths that run along the current's limit about the asked horizon: on 24 nodes they cost up to 0.3 %
more than the optimum, on 40 up to 0.07 %."""
_NEARLY = 1.03
"""Of the asked horizon: up to here, finer nodes may still find a path over the asked horizon."""

REFERENCE = 2.0
MAX_STRETCH = 6.0
NODES_RANGE = (8, 40)
HORIZON_RANGE = (1e-3, 1e5)
FASTEST = 100.0
LEAST_PRICED = 1.0


class PlanStatus(StrEnum):
    """Whether the asked horizon was kept; plans with a price of time are always optimal."""

    OPTIMAL = "optimal"
    STRETCHED = "stretched"


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path and its properties.

    Attributes:
        path: its origin is zero until guidance starts it.
        status: optimal at the asked horizon, or stretched to the shortest feasible one.
        horizon_asked, horizon: s; equal with a price of time.
        energy: integral of R I^2, J.
        supplied: integral of V |I|, J.
        peak_current: largest |I| on a dense grid, A.
        evaluations: number of evaluations of the cost.
        target_q2: q2 at the end.
        nu: (N,) path control parameters against the prey over `horizon`.
        node_times: (N,) s.
        node_q2: (N,).
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

    def spent(self, cost: PathCost) -> float:
        """Return the energy of one kind, J."""
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
    time_price: float | None = None,
    last: PolynomialPath | None = None,
    cost: PathCost = PathCost.HEAT,
) -> Plan:
    """Return the least-energy path between two states in `horizon` s, or in the shortest feasible time.

    Rates are body rates in rad/s. `reference` is q_r, beyond the range of q2 (5.10); `q2_limit` bounds |q2|;
    the horizon is stretched to `max_stretch` times the asked one at most. A stretched horizon lies about
    0.3 % above the shortest of the paths on `nodes` nodes, within 1.5 % of the bang-bang time.

    With `time_price` in W the path minimises energy plus price times horizon, over horizons from LEAST_PRICED
    s to `max_stretch` times `horizon`; `horizon` is then the initial guess. `last` is the path followed until
    now, its origin relative to the new start (so not positive); its remainder is the initial guess of the
    path. `cost` says which energy is the least.

    Raises PlanningError when an argument is not finite or outside its limits, or when no allowed horizon is
    feasible.
    """
    states = {"start_q2": start_q2, "start_rate": start_rate, "end_q2": end_q2, "end_rate": end_rate}
    _check(states, horizon, nodes, reference, q2_limit, max_stretch)
    if time_price is not None and not (math.isfinite(time_price) and time_price > 0.0):
        raise PlanningError(f"time_price is {time_price} W: it must be finite and positive")
    boundary = Boundary(start_q2, q2_rate_of(start_q2, start_rate), end_q2, q2_rate_of(end_q2, end_rate))

    def program_at(time: float, count: int = nodes) -> Program:
        return Program(plant, Family.around(boundary, time, reference, count), q2_limit, time, cost)

    search = Search(program_at, _remains(last, nodes))
    longest = max_stretch * horizon
    if time_price is None:
        program, trial = search.within(horizon, longest)
    else:
        program, trial = search.priced(horizon, min(LEAST_PRICED, longest), longest, time_price)
    if trial is None:
        raise PlanningError(
            f"no path was found from q2 {start_q2:.4f} at {start_rate:.4f} rad/s to {end_q2:.4f} at "
            f"{end_rate:.4f} rad/s with |I| <= {plant.current_limit} A and |q2| <= {q2_limit} over "
            f"{horizon:g} to {longest:.1f} s"
        )
    asked = horizon if time_price is None else trial.horizon
    found = _assemble(program, trial, boundary, reference, asked, search.evaluations, end_rate)
    along_limit = found.peak_current >= ALONG_LIMIT * plant.current_limit
    if time_price is not None or nodes >= FINE_NODES or not along_limit or trial.horizon > _NEARLY * asked:
        return found
    search = Search(
        partial(program_at, count=FINE_NODES), _remains(found.path, FINE_NODES), search.evaluations
    )
    program, trial = search.within(asked, trial.horizon)
    if trial is None:
        return found
    finer = _assemble(program, trial, boundary, reference, asked, search.evaluations, end_rate)
    return min(finer, found, key=lambda one: (one.horizon, one.spent(cost)))


def _remains(last: PolynomialPath | None, nodes: int) -> FloatArray | None:
    """Return the difference (N,) on the nodes between the rest of `last` and its prey; None without a rest.

    Added to another prey, the difference gives a path between that prey's states, which need not lie on
    `last`.
    """
    if last is None:
        return None
    elapsed = -1e-9 * last.origin_ns
    left = last.horizon - elapsed
    if not 0.0 < left <= last.horizon:
        return None
    times = 0.5 * left * (lgl_rule(nodes).nodes + 1.0)
    # Just before the end: at the end itself the coast has begun.
    angle, rate, _ = last.motion(elapsed + times * (1.0 - 1e-12))
    q2 = np.sin(0.5 * angle)
    slope = 0.5 * rate * np.cos(0.5 * angle)
    prey = CubicPrey.between(float(q2[0]), float(slope[0]), float(q2[-1]), float(slope[-1]), left)
    apart = q2 - prey.q2(times)
    return apart if np.isfinite(apart).all() else None


def _assemble(
    program: Program,
    trial: Trial,
    boundary: Boundary,
    reference: float,
    asked: float,
    evaluations: int,
    end_rate: float,
) -> Plan:
    """Return the plan that flies `trial`; raises PlanningError when it is not finite."""
    energy, supplied = (program.spent(trial, cost) for cost in PathCost)
    peak = float(np.abs(program.ratios(trial)[0]).max()) * program.current_limit
    node_q2 = program.family.nodes(trial.parameters, trial.horizon)
    if not (math.isfinite(energy) and math.isfinite(peak) and np.isfinite(node_q2).all()):
        raise PlanningError("the optimiser returned a path that is not finite")
    times = 0.5 * trial.horizon * (program.family.grid.rule.nodes + 1.0)
    prey = boundary.prey(trial.horizon).q2(times)
    kept = trial.horizon <= asked * (1.0 + 1e-9)
    return Plan(
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
    states: dict[str, float],
    horizon: float,
    nodes: int,
    reference: float,
    q2_limit: float,
    max_stretch: float,
) -> None:
    """Raise PlanningError for arguments outside their ranges."""
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
            raise PlanningError(
                f"{name} is {states[name]:g} rad/s: beyond {FASTEST} rad/s nothing can be planned"
            )
    if not HORIZON_RANGE[0] <= horizon <= HORIZON_RANGE[1]:
        raise PlanningError(f"horizon is {horizon} s: it must be {HORIZON_RANGE[0]} to {HORIZON_RANGE[1]} s")
    if not 1.0 <= max_stretch <= 1e3:
        raise PlanningError(f"max_stretch is {max_stretch}: it must be 1 to 1000")
    if not (math.isfinite(reference) and abs(reference) > 1.0):
        raise PlanningError(f"reference is {reference}: it must lie beyond the range of q2, |q_r| > 1 (5.10)")
    if not NODES_RANGE[0] <= nodes <= NODES_RANGE[1]:
        raise PlanningError(f"nodes is {nodes}: it must be {NODES_RANGE[0]} to {NODES_RANGE[1]}")
