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

from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.controllers import CONTROLLERS
from tests.studies.campaigns.step_robust import draw, fly_world

COMPARED = ("this loop", "thesis", "pid", "adaptive")
FIGURES = (
    ("steady_state_deg", "steady, deg"),
    ("excursion_deg", "excursion, deg"),
    ("settling_s", "settling, s"),
    ("overshoot_percent", "overshoot, %"),
)
_ROW = "{:12}{:>8}{:>6}{:>12}" + "{:>30}" * len(FIGURES)


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
    head = (f"{label}: median, 95 %" for _, label in FIGURES)
    lines = [_ROW.format("", "worlds", "lost", "R I^2, mW", *head)]
    for name in COMPARED:
        mine = [result for result in results if result["controller"] == name]
        if not mine:
            continue
        found: dict[str, Any] = {
            "worlds": len(mine),
            "lost": sum(result["lost"] for result in mine),
            "heat_w": float(np.mean([result["heat_w"] for result in mine])),
        }
        cells = []
        for key, _label in FIGURES:
            values = np.array([result[key] for result in mine])
            levels = [float(np.quantile(values, level, method="lower")) for level in (0.5, 0.95)]
            found[key] = [level if math.isfinite(level) else None for level in levels]
            cells.append(f"{levels[0]:.3f}, {levels[1]:.3f}")
        facts[name] = found
        heat = f"{1e3 * found['heat_w']:.2f}"
        lines.append(_ROW.format(name, found["worlds"], found["lost"], heat, *cells))
    return Summary("\n".join(lines) + "\n", facts)


ROBUST_CONTROLLERS = Campaign(
    "robust-controllers",
    "the tuned controllers in worlds unlike the loop's belief, the same for all",
    cases,
    run,
    summarise,
    20,
)
