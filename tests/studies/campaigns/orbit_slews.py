"""Campaign `orbit-slews`: slews in three axes by coils alone, the attitude estimated, all disturbances.

A 3U turns by 30 to 180 deg in 600 to 1,200 s, the KnightCube in 300 s, among the stars, by the laws of
`orbit_slews_flight` on the same seeds. `share` multiplies the worst cases of drag, sunlight and the turn of
the principal axes, which the filter estimates; all other disturbances are whole. The optimum is the heat of
the planned path.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.orbit_slews_flight import HORIZON, SlewFlight

CELLS = (
    ("path", 0.1),
    ("blind", 0.1),
    ("eigen-axis", 0.1),
    ("projected", 0.1),
    ("path", 0.3),
    ("path", 1.0),
)
"""Law and share."""
WANTED = {"knightcube": 2.0, "cubesat_3u": 0.5}
"""deg at the end, of issue 16."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` slews of each craft, in the two orbits by turns, by each law and share."""
    return [
        Case(
            f"{craft}/{run}/{law}/{share}",
            (seed, run),
            {"craft": craft, "orbit": ("sso", "iss")[run % 2], "law": law, "share": share},
        )
        for run in range(runs)
        for craft in HORIZON
        for law, share in CELLS
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
    """Return errors at the end and heat by craft and law."""
    facts: dict[str, Any] = {}
    heads = ("runs", "refused", "median", "worst", "within", "heat", "worst")
    lines = [f"{'craft, law, share':28}" + "".join(f"{head:>9}" for head in heads)]
    for craft in HORIZON:
        for law, share in CELLS:
            mine = [r for r in results if (r["craft"], r["law"], r["share"]) == (craft, law, share)]
            flown = [r for r in mine if "off" in r]
            if not flown:
                continue
            off = np.array([r["off"] for r in flown])
            heat = np.array([r["heat"] / r["optimum"] for r in flown])
            found = {
                "runs": len(mine),
                "refused": len(mine) - len(flown),
                "median": float(np.median(off)),
                "worst": float(off.max()),
                "within": float(np.mean(off <= WANTED[craft])),
                "heat": float(np.median(heat)),
                "worst_heat": float(heat.max()),
            }
            facts[f"{craft}/{law}/{share}"] = found
            row = "".join(f"{value:9.3g}" for value in found.values())
            lines.append(f"{f'{craft}, {law}, {share}':28}{row}")
    lines.append("deg off the target at the end, the share within that wanted, heat over that planned")
    return Summary("\n".join(lines) + "\n", facts)


ORBIT_SLEWS = Campaign(
    "orbit-slews", "slews in three axes by coils alone, all disturbances", cases, run, summarise, 40
)
