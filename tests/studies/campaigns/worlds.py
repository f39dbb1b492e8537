"""Campaign `worlds`: the same craft detumbles in our own world and in Basilisk, flight by flight.

The campaign `detumble` is flown in both; only the world is another. Basilisk has no day bulge, no ring
current and no walks, and its field is WMM2025. Wanted: times within 20 % in the median. Needs the extra
`worlds`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from sim_hal.worlds.basilisk.world import BasiliskWorld
from tests.studies.campaigns import detumble, free_flight
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary

WORLDS = ("free_body", "basilisk")
WITHIN = 0.2


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of the KnightCube in each world, by the two laws in turns."""
    flights = [
        case for case in detumble.cases((runs + 1) // 2, seed) if case.parameters["craft"] == "knightcube"
    ]
    return [
        Case(f"{case.key}/{world}", case.seed, {**case.parameters, "world": world, "flight": case.key})
        for case in flights[:runs]
        for world in WORLDS
    ]


def run(case: Case) -> Result:
    """Fly one case in its world."""
    if case.parameters["world"] == "free_body":
        return detumble.run(case)
    with mock.patch.object(free_flight, "FreeBody", BasiliskWorld):
        return detumble.run(case)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return each flight's times in both worlds, and how they compare."""
    times: dict[str, dict[str, float]] = {}
    for result in results:
        times.setdefault(result["flight"], {})[result["world"]] = result["seconds"]
    lines, ratios = [f"{'flight':32}{'free_body':>10}{'basilisk':>10}   s"], []
    for flight, found in times.items():
        if len(found) == len(WORLDS):
            ratios.append(found["basilisk"] / found["free_body"])
            lines.append(f"{flight:32}{found['free_body']:10.0f}{found['basilisk']:10.0f}")
    facts: dict[str, Any] = {
        "flights": len(ratios),
        "lost": sum(result["lost"] for result in results),
        "median_ratio": float(np.median(ratios or [np.nan])),
        "widest_ratio": float(max((max(r, 1.0 / r) for r in ratios), default=np.nan)),
        "within": bool(ratios) and abs(float(np.median(ratios)) - 1.0) <= WITHIN,
    }
    lines.append(
        f"median ratio {facts['median_ratio']:.3f}, widest {facts['widest_ratio']:.3f}, {facts['lost']} lost"
    )
    return Summary("\n".join(lines) + "\n", facts)


WORLD_COMPARISON = Campaign(
    "worlds", "detumbling in our own world and in Basilisk, flight by flight", cases, run, summarise, 10
)
