"""The planner worker's job: plans a path from one state to one target."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.gnc.guidance.one_axis.path import PolynomialPath
from knightcube.gnc.guidance.one_axis.plant import PathCost, SingleAxisPlant
from knightcube.gnc.guidance.one_axis.vmc import NODES, StepPlan, plan


@dataclass(frozen=True, slots=True)
class PlanJob:
    """Plan from (q2, rad/s) at `origin_ns` to (q2, rad/s) within `horizon` s; `number` counts the jobs.

    With `time_price` in W the planner chooses the horizon and `horizon` is its initial guess. `last` is the
    path followed until now, its origin relative to `origin_ns`.
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
    time_price: float | None = None
    last: PolynomialPath | None = None
    cost: PathCost = PathCost.HEAT


def run(job: PlanJob) -> StepPlan:
    """Return the plan for `job` (module-level, so that a worker can import it); raises PlanningError."""
    return plan(
        job.plant,
        job.start_q2,
        job.start_rate,
        job.end_q2,
        job.end_rate,
        job.horizon,
        nodes=job.nodes,
        max_stretch=max(job.max_horizon / job.horizon, 1.0),
        time_price=job.time_price,
        last=job.last,
        cost=job.cost,
    )
