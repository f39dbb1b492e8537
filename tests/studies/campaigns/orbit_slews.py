"""Campaign `orbit-slews`: slews in three axes by coils alone, the attitude estimated, all disturbances.

A 3U turns by 30 to 180 deg in 600 to 1,200 s, the KnightCube in 300 s, among the stars
(`orbit_slews_flight`). `share` multiplies the worst cases of drag, sunlight and the turn of
the principal axes, which the filter estimates; all other disturbances are whole. The optimum is the heat of
the planned path.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary, summary
from tests.studies.campaigns.orbit_slews_flight import HORIZON, SlewFlight

SHARES = (0.1, 0.3, 1.0)
WANTED = {"knightcube": 2.0, "cubesat_3u": 0.5}
"""deg at the end, of issue 16."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` slews of each craft, in the two orbits by turns, at each share."""
    return [
        Case(
            f"{craft}/{run}/{share}",
            (seed, run),
            {"craft": craft, "orbit": ("sso", "iss")[run % 2], "share": share},
        )
        for run in range(runs)
        for craft in HORIZON
        for share in SHARES
    ]


def run(case: Case) -> Result:
    """Fly the case."""
    flight = SlewFlight(case.parameters, case.seed[0] * 100_003 + case.seed[1])
    facts: Result = {**case.parameters, "angle": flight.angle, "horizon": flight.horizon}
    try:
        off, heat, planned = flight.fly()
    except LookupError as error:
        return {**facts, "refused": str(error)}
    return {**facts, "off": off, "heat": heat, "optimum": planned}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return deg off the target at the end, the share within that wanted, and heat over that planned."""
    slews: dict[str, Any] = {}
    for craft in HORIZON:
        for share in SHARES:
            mine = [r for r in results if (r["craft"], r["share"]) == (craft, share)]
            if not (flown := [r for r in mine if "off" in r]):
                continue
            off = np.array([r["off"] for r in flown])
            heat = np.array([r["heat"] / r["optimum"] for r in flown])
            slews[f"{craft}/{share}"] = {
                "runs": len(mine),
                "refused": len(mine) - len(flown),
                "median": float(np.median(off)),
                "worst": float(off.max()),
                "within": float(np.mean(off <= WANTED[craft])),
                "heat": float(np.median(heat)),
                "worst_heat": float(heat.max()),
            }
    return summary({"slews": slews})


ORBIT_SLEWS = Campaign(
    "orbit-slews", "slews in three axes by coils alone, all disturbances", cases, run, summarise, 40
)
