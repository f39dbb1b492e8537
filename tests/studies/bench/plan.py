"""Measure the planner against the optimum.

The slews are random over the testbed's range, with thread stiffness, disturbance and moving end points
(tests.support.step_problems). Slews of the first set last 1.1 to 2.5 times their shortest feasible duration.
The durations of the second set are too short, and the planner extends them. Solve times are processor times
of this process. The cost is compared with the collocation oracle's cost for the same duration. Limits are
checked at 4001 points of the path.
"""

from __future__ import annotations

import sys
import time
from typing import Annotated, Any

import numpy as np

from knightcube.errors import PlanningError, UsageError
from knightcube.gnc.guidance.vmc import PlanStatus
from tests.studies.command import Json, Seed, command, say
from tests.support.collocation_oracle import solve
from tests.support.step_problems import STEPS, THESIS, Problem, feasible_problems, largest_ratio

FEASIBLE = (1.1, 2.5)
TOO_SHORT = (0.6, 0.99)


def measure(problems: list[tuple[Problem, float]]) -> dict[str, Any]:
    """Return statistics of planned slews; each problem comes with its shortest feasible duration (s)."""
    spans, costs, passed, beyond, failed, unsolved = [], [], [], [], 0, 0
    stretched = 0
    for problem, shortest in problems:
        begun = time.process_time()
        try:
            found = problem.planned()
        except PlanningError:
            failed += 1
            continue
        spans.append(1e3 * (time.process_time() - begun))
        stretched += found.status is PlanStatus.STRETCHED
        passed.append(largest_ratio(problem, found))
        beyond.append(found.horizon / shortest)
        optimum = solve(problem.slew(found.horizon))
        if optimum is None:
            unsolved += 1
        else:
            costs.append(found.energy / optimum.energy)
    return {
        "runs": len(problems),
        "failed": failed,
        "stretched": stretched,
        "median_ms": float(np.median(spans)),
        "p99_ms": float(np.quantile(spans, 0.99)),
        "max_ms": max(spans),
        "compared": len(costs),
        "oracle_failed": unsolved,
        "median_cost_ratio": float(np.median(costs)),
        "worst_cost_ratio": max(costs),
        "worst_limit_ratio": max(passed),
        "worst_horizon_over_shortest": max(beyond),
    }


def warm_gain(problems: list[tuple[Problem, float]]) -> dict[str, float]:
    """Return the mean numbers of evaluations that the planner needs to plan again after a third of a slew.

    The second planning is done once with the first plan as initial guess, and once without it.
    """
    cold, warm = [], []
    for problem, _ in problems:
        first = problem.planned()
        elapsed_ns = round(first.horizon * 1e9 / 3.0)
        at = first.path.sample(elapsed_ns)
        rest = Problem(
            problem.plant,
            float(np.sin(0.5 * at.angle)) + 1e-4,
            at.rate + 1e-4,
            problem.end_q2,
            problem.end_rate,
            first.horizon - elapsed_ns * 1e-9,
        )
        cold.append(rest.planned().evaluations)
        warm.append(rest.planned(last=first.path.starting_at(-elapsed_ns)).evaluations)
    return {"cold_evaluations": float(np.mean(cold)), "warm_evaluations": float(np.mean(warm))}


@command
def main(*, runs: Annotated[int, "of feasible durations"] = 500, seed: Seed = 1, json: Json = False) -> int:
    """Print the results."""
    if runs < 1:
        raise UsageError("--runs must be at least 1")
    THESIS.planned()  # fills the caches, as the first plan of a worker does
    STEPS[0].planned()
    feasible = feasible_problems(runs, seed, FEASIBLE)
    short = feasible_problems(max(1, runs // 5), seed + 1, TOO_SHORT)
    figures = {"feasible": measure(feasible) | warm_gain(feasible[:100]), "too_short": measure(short)}
    if json:
        say(seed=seed, **figures)
        return 0
    for name, found in figures.items():
        sys.stdout.write(f"{name.replace('_', ' ')} horizons\n")
        sys.stdout.writelines(f"  {key:28s} {value:.6g}\n" for key, value in found.items())
    return 0
