"""Campaign `worlds`: runs of the same craft in the project's world and in Basilisk.

In the cases `detumble/`, the KnightCube is detumbled as in the campaign `detumble`, alternately by two laws.
In the cases `nadir/`, 3U and KnightCube alternately hold nadir as in the campaign `orbit-pointing`, at SHARE
of the worst torques. Only the worlds differ. Basilisk has no day bulge, no ring current and no random walks
of air density and dipole, so these effects are off in both worlds. The field of Basilisk is WMM2025, and that
of this project IGRF-14. Times, errors and coil energies of both worlds should agree within 20 % in the
median. The campaign needs the extra `worlds`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from sim_hal.worlds.basilisk.world import BasiliskWorld
from tests.studies.campaigns import detumble, free_flight, orbit_pointing

WORLDS = ("free_body", "basilisk")
LAWS = ("magnetometer", "attitude")
"""Control laws of the campaign `detumble` that are simulated in both worlds."""
WITHIN = 0.2
SHARE = 0.3
FIGURES = {"detumble": ("seconds",), "nadir": ("nadir_rms", "knowledge_rms", "mean_square")}
"""Compared results of each kind of flight: time (s); angle (deg) from nadir; attitude error (deg); squared
dipole (A^2 m^4) of the coils.
"""
_FLY = {"detumble": detumble.run, "nadir": orbit_pointing.run}


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each kind in each world."""
    braked = [
        case
        for case in detumble.cases((runs + 1) // 2, seed)
        if case.parameters["craft"] == "knightcube"
        and case.parameters["law"] in LAWS
        and case.parameters["orbit"] == ("sso", "iss")[case.seed[1] % 2]
    ]
    held = [
        case
        for run in range(runs)
        for case in orbit_pointing.cases(runs, seed)
        if case.key == f"hold/{('cubesat_3u', 'knightcube')[run % 2]}/{SHARE}/{run}"
    ]
    return [
        Case(
            f"{kind}/{case.key}/{world}",
            case.seed,
            {**case.parameters, "still": True, "kind": kind, "world": world, "flight": case.key},
        )
        for kind, flights in (("detumble", braked[:runs]), ("nadir", held))
        for case in flights
        for world in WORLDS
    ]


def run(case: Case) -> Result:
    """Fly one case in its world."""
    fly = _FLY[case.parameters["kind"]]
    if case.parameters["world"] == "free_body":
        return fly(case)
    with mock.patch.object(free_flight, "FreeBody", BasiliskWorld):
        return fly(case)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return each flight's results in both worlds, and their comparison."""
    facts: dict[str, Any] = {"lost": sum(result["lost"] for result in results)}
    for kind, figures in FIGURES.items():
        for figure in figures:
            found = _compared([r for r in results if r["kind"] == kind and figure in r], figure)
            if found["flights"]:
                facts[f"{kind}/{figure}"] = found
    facts["within"] = all(found["within"] for found in facts.values() if isinstance(found, dict))
    return summary(facts)


def _compared(results: Sequence[Result], figure: str) -> dict[str, Any]:
    """Return the comparison of one result over the flights of both worlds."""
    values: dict[str, dict[str, float]] = {}
    for result in results:
        values.setdefault(result["flight"], {})[result["world"]] = result[figure]
    both = {flight: found for flight, found in values.items() if len(found) == len(WORLDS)}
    ratios = np.array([found["basilisk"] / found["free_body"] for found in both.values()])
    if not both:
        return {"flights": 0}
    median = float(np.median(ratios))
    widest = float(np.maximum(ratios, 1.0 / ratios).max())
    within = abs(median - 1.0) <= WITHIN
    return {"flights": len(both), "median_ratio": median, "widest_ratio": widest, "within": within}
