"""Measure the planner: `python -m tests.bench.plan [--runs N] [--seed S] [--json]`.

Random slews over the testbed's range (tests.guidance.problems): solve time, how many horizons were
stretched, largest current between nodes, and the cost against the collocation oracle at the same horizon.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

import numpy as np

from flight.errors import PlanningError
from flight.guidance.vmc import Plan, PlanStatus
from tests.guidance.oracle import solve
from tests.guidance.problems import THESIS, Problem, random_problems


def measure(runs: int, seed: int, compared: int) -> dict[str, Any]:
    """Return the figures of `runs` slews, the first `compared` of them against the oracle."""
    problems = random_problems(runs, seed)
    THESIS.planned()  # fills the caches, as the worker's first plan does
    plans: list[tuple[Problem, Plan]] = []
    spans, failed = [], 0
    for problem in problems:
        begun = time.perf_counter()
        try:
            plans.append((problem, problem.planned()))
        except PlanningError:
            failed += 1
        spans.append(1e3 * (time.perf_counter() - begun))
    ratios = []
    for problem, found in plans[:compared]:
        optimum = solve(problem.slew(found.horizon))
        if optimum is not None:
            ratios.append(found.energy / optimum.energy)
    peaks = [
        float(np.abs(problem.plant.currents(*found.path.motion(np.linspace(0.0, found.horizon, 1000)))).max())
        / problem.plant.current_limit
        for problem, found in plans
    ]
    return {
        "runs": runs,
        "seed": seed,
        "failed": failed,
        "stretched": sum(found.status == PlanStatus.STRETCHED for _, found in plans),
        "median_ms": float(np.median(spans)),
        "p99_ms": float(np.quantile(spans, 0.99)),
        "max_ms": max(spans),
        "median_evaluations": float(np.median([found.evaluations for _, found in plans])),
        "worst_current_ratio": max(peaks),
        "compared": len(ratios),
        "median_cost_ratio": float(np.median(ratios)),
        "worst_cost_ratio": max(ratios),
    }


def main(arguments: list[str]) -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.plan", description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--compare", type=int, default=100, help="how many to solve by collocation too")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    options = parser.parse_args(arguments)
    if options.runs < 1 or options.compare < 1:
        parser.error("--runs and --compare must be at least 1")
    figures = measure(options.runs, options.seed, options.compare)
    if options.json:
        sys.stdout.write(json.dumps(figures) + "\n")
    else:
        sys.stdout.writelines(f"{name:22s} {value:.6g}\n" for name, value in figures.items())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
