"""Campaign `planner-edge`: slews near the ends of the range of q2, where the coil hardly rotates the body.

Start and target are at |q2| of 0.60 to 0.68. The torque of a known thread of 0 to 2e-5 N m/rad is up to ten
times that of the coil. The requested duration is 5 to 60 s. Each slew is planned, and also solved by an
independent collocation (`tests.support.collocation_oracle`). A slew counts as failed if the collocation finds
a path within |q2| <= 0.68 in the requested duration and the planner finds none. It counts as `dear` (costly)
if the planner's path costs more than 1.001 times the collocation's path. It counts as late if the planner
extends the duration although the collocation finds a path without an extension.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.plant import Q2_LIMIT
from tests.support.collocation_oracle import solve
from tests.support.step_problems import KNIGHTCUBE, Problem

INTERVALS = 1200
DEAR = 1.001
PLANT = replace(KNIGHTCUBE, damping=2e-6)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` slews."""
    return [Case(f"{k}", (seed, k), {}) for k in range(runs)]


def problem_of(case: Case) -> Problem:
    """Return the slew of a case."""
    rng = np.random.default_rng(case.seed)
    start, end = (rng.uniform(0.60, Q2_LIMIT, 2) * rng.choice([-1.0, 1.0], 2)).tolist()
    stiffness, horizon = float(rng.uniform(0.0, 2e-5)), float(rng.uniform(5.0, 60.0))
    return Problem(replace(PLANT, stiffness=stiffness), start, 0.0, end, 0.0, horizon)


def run(case: Case) -> Result:
    """Plan one slew and solve it by collocation."""
    problem = problem_of(case)
    result: Result = {
        "start": problem.start_q2,
        "end": problem.end_q2,
        "stiffness": problem.plant.stiffness,
        "asked": problem.horizon,
    }
    begun = time.process_time()
    try:
        found = problem.planned()
        result |= {"horizon": found.horizon, "energy": found.energy}
    except PlanningError:
        result |= {"horizon": None, "energy": None}
    result["cpu_s"] = time.process_time() - begun
    optimum = solve(problem.slew(problem.horizon), INTERVALS)
    # The collocation does not enforce the limit of q2, so a path beyond it counts as none.
    within = optimum is not None and np.abs(np.sin(0.5 * optimum.angle)).max() <= Q2_LIMIT * (1.0 + 1e-9)
    result["optimum"] = optimum.energy if optimum is not None and within else None
    return result


def verdict(result: Result) -> str:
    """Return "failed", "late", "dear" (costly) or "solved", or "unknown" if the collocation finds no path."""
    if result["optimum"] is None:
        return "unknown"
    if result["horizon"] is None:
        return "failed"
    if result["horizon"] > result["asked"] * (1.0 + 1e-9):
        return "late"
    return "dear" if result["energy"] > DEAR * result["optimum"] else "solved"


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Count the results of the slews, and list the slews that were not solved."""
    del folder
    verdicts = [verdict(result) for result in results]
    counts = {name: verdicts.count(name) for name in ("solved", "dear", "late", "failed", "unknown")}
    refused = sum(result["horizon"] is None for result in results)
    ratios = [
        r["energy"] / r["optimum"] for r, v in zip(results, verdicts, strict=True) if v in ("solved", "dear")
    ]
    times = [result["cpu_s"] for result in results]
    facts = {
        **counts,
        "refused": refused,
        "largest_cost_ratio": max(ratios, default=None),
        "cpu_s_median": float(np.median(times)),
        "cpu_s_most": max(times),
    }
    return summary(facts)


PLANNER_EDGE = Campaign(
    "planner-edge",
    "slews near the ends of q2 under a known thread, beside a collocation",
    cases,
    run,
    summarise,
    200,
)
