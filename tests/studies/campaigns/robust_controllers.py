"""Campaign `robust-controllers`: the controllers of `controllers` in the worlds of `step-robust`.

Every controller flies the same worlds: this loop, the thesis's behind the same filter, and PID and adaptive
control, tuned in the believed world by one criterion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary, summary
from tests.studies.campaigns.controllers import CONTROLLERS
from tests.studies.campaigns.step_robust import draw, fly_world

COMPARED = ("this loop", "thesis", "pid", "adaptive")
FIGURES = (
    ("steady_state_deg", "steady, deg"),
    ("excursion_deg", "excursion, deg"),
    ("settling_s", "settling, s"),
    ("overshoot_percent", "overshoot, %"),
)


def cases(runs: int, seed: int) -> list[Case]:
    """Return every controller in each of `runs` worlds."""
    return [
        Case(f"{name}/{run}", (seed, run), {"controller": name}) for run in range(runs) for name in COMPARED
    ]


def run(case: Case) -> Result:
    """Fly one world under one controller."""
    name = case.parameters["controller"]
    return {"controller": name, **fly_world(draw(case.seed), CONTROLLERS[name]())}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return median and 95th percentile of each figure by controller."""
    facts: dict[str, Any] = {}
    for name in COMPARED:
        mine = [result for result in results if result["controller"] == name]
        if not mine:
            continue
        found: dict[str, Any] = {
            "worlds": len(mine),
            "lost": sum(result["lost"] for result in mine),
            "heat_w": float(np.mean([result["heat_w"] for result in mine])),
        }
        for key, _label in FIGURES:
            values = np.array([result[key] for result in mine])
            levels = [float(np.quantile(values, level, method="lower")) for level in (0.5, 0.95)]
            found[key] = [level if math.isfinite(level) else None for level in levels]
        facts[name] = found
    return summary(facts)


ROBUST_CONTROLLERS = Campaign(
    "robust-controllers",
    "the tuned controllers in worlds unlike the loop's belief, the same for all",
    cases,
    run,
    summarise,
    20,
)
