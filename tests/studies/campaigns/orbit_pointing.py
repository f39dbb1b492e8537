"""Campaign `orbit-pointing`: pointing by coils alone, with estimated attitude and all disturbances.

The craft are a 3U and the KnightCube.

Cells `hold` start nadir-pointing along the flight direction without learned parameters, and last at least two
revolutions. The filter estimates the residual dipole and the torques in the first revolution, which is not
evaluated.

Cells `day` are the same over a day, with a quarter of the runs.

Cells `heavy` are the same over half a day with the strong drag of a solar maximum. They count how many star
attitudes the filter rejected, and how many in a row.

Cells `unknown` are holds of a body whose moments, principal axes and coils differ from the configured ones by
up to the default accuracies.

Cells `turn` start 30 to 180 deg off their target (nadir, Sun or an inertial attitude) at a rate of 0.3 deg/s,
and last 100 min. `arrived` counts bodies whose pointing axis comes within ARRIVED deg of the target and stays
there until the end, for at least half a revolution. `lost` counts bodies that are more than LOST deg from the
target at the end. The weight of the rotation about that axis is small (WEIGHTS of `orbit_pointing_flight`),
so only the error of three axes includes it.

`share` multiplies the torques that the coils cannot cancel immediately: drag, sunlight, and the rotation of
the principal axes. The residual dipole always has its full magnitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.rigid_body import BodyErrors
from sim_hal.description_errors import DescriptionErrors
from sim_hal.worlds.free_body import CRAFTS
from tests.studies.campaigns.detumble import description
from tests.studies.campaigns.free_flight import WATTS
from tests.studies.campaigns.orbit_pointing_flight import CYCLE, TARGETS, PointingFlight
from tests.studies.campaigns.statistics import mean, median, rms

REVOLUTION = 5_700.0
LOST = 60.0
"""Angle (deg) from the target above which a body counts as lost, at the end of a cell `turn` or at any time
of a cell `hold`.
"""
ARRIVED = {"cubesat_3u": 2.0, "knightcube": 5.0}
"""Largest angle (deg) from the target at arrival, by craft; issue 19 permits the lighter KnightCube a
larger error.
"""
SPIN = 0.3
"""Initial rate (deg/s) in the cells `turn`."""
HOLDS = (
    ("cubesat_3u", 0.1, 0.4),
    ("cubesat_3u", 0.3, 1.2),
    ("cubesat_3u", 1.0, None),
    ("knightcube", 0.1, 2.0),
    ("knightcube", 0.3, 5.0),
)
"""Craft, share of the worst torques, and required rms error (deg) of issue 19."""
UNKNOWN = {"cubesat_3u": 1.2, "knightcube": 2.0}
"""Required rms error (deg) of an unknown body's nadir axis, for 0.3 of the worst torques (issue 34)."""
DAYS = (("cubesat_3u", 1.0), ("knightcube", 0.3))
"""Craft and share of the cells `day`."""
DAY = 86_400.0
HEAVY = (("iss", 7e-12), ("low", 4e-11))
"""Orbit, and mean atmospheric density (kg/m^3) during half a day at a solar maximum."""
HEAVY_SHARE = 0.3
"""Share of the worst torques in the cells `heavy`: that of a centre of pressure 6 mm from the centre of
mass."""
TURNS = tuple((craft, share) for share in (0.1, 1.0) for craft in ("cubesat_3u", "knightcube"))
"""Craft and share of the cells `turn`."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each group, with the same orbits and initial states; the targets alternate."""
    found = []
    for run in range(runs):
        turn = float(np.random.default_rng([seed, run, 0x7E]).uniform(30.0, 180.0))
        target = list(TARGETS)[run % len(TARGETS)]
        for craft, share, _ in HOLDS:
            same = {"kind": "hold", "craft": craft, "share": share, "target": "nadir"}
            found.append(Case(f"hold/{craft}/{share}/{run}", (seed, run), same))
        for craft, share in DAYS if 4 * run < max(runs, 4) else ():
            same = {"kind": "day", "craft": craft, "share": share, "target": "nadir"}
            found.append(Case(f"day/{craft}/{share}/{run}", (seed, run), same | {"seconds": DAY}))
        for craft in UNKNOWN:
            same = {"kind": "unknown", "craft": craft, "share": 0.3, "target": "nadir"}
            found.append(Case(f"unknown/{craft}/0.3/{run}", (seed, run), same))
        for craft in WATTS:
            for orbit, density in HEAVY:
                same = {"kind": "heavy", "craft": craft, "share": HEAVY_SHARE, "target": "nadir"}
                air = {"orbit": orbit, "density": density, "seconds": 0.5 * DAY}
                found.append(Case(f"heavy/{craft}/{orbit}/{run}", (seed, run), same | air))
        for craft, share in TURNS:
            same = {"kind": "turn", "craft": craft, "share": share, "target": target}
            start = {"turn_deg": turn, "speed_deg": SPIN}
            found.append(Case(f"turn/{craft}/{share}/{run}", (seed, run), same | start))
    return found


def run(case: Case) -> Result:
    """Fly the case."""
    wanted = case.parameters
    turns = wanted["kind"] == "turn"
    seed = case.seed[0] * 100_003 + case.seed[1]
    errors = {"description": unknown_body(wanted["craft"], seed)} if wanted["kind"] == "unknown" else {}
    flight = PointingFlight({**wanted, **errors}, seed)
    seconds = wanted.get("seconds", 6_000.0 if turns else 2.5 * REVOLUTION)
    for cycle in range(round(seconds / CYCLE)):
        flight.cycle(cycle * CYCLE)
        if not turns and flight.notes and off_goal(np.array(flight.notes[-1:])[:, 1:4])[0] > LOST:
            break
    notes = np.array(flight.notes)
    facts = {**wanted, "hours": float(notes[-1, 0] / 3600.0), **_stars(flight.passed)}
    return facts | (_arrival(wanted, notes) if turns else _hold(notes, seconds))


def unknown_body(craft: str, seed: int) -> DescriptionErrors:
    """Return random errors of the configured inertia, and of the gain and axis of each coil."""
    generator, bounds = np.random.default_rng([seed, 0xC011]), BodyErrors()
    coils = np.eye(3) + bounds.coil_axes * generator.uniform(-1.0, 1.0, (3, 3))
    np.fill_diagonal(coils, 1.0 + bounds.coil_gain * generator.uniform(-1.0, 1.0, 3))
    return replace(description("inertia", seed, CRAFTS[craft].inertia), coils=coils)


def _stars(passed: Sequence[bool]) -> Result:
    """Return the numbers of all and of rejected star attitudes, and the largest number rejected in a row."""
    longest = row = 0
    for one in passed:
        row = 0 if one else row + 1
        longest = max(longest, row)
    return {"stars": len(passed), "rejected": len(passed) - sum(passed), "rejected_in_a_row": longest}


def _hold(notes: FloatArray, seconds: float) -> Result:
    """Return rms errors (deg) after the first revolution, and the power of the coils."""
    turns, off = np.degrees(notes[:, 1:4]), off_goal(notes[:, 1:4])
    facts: Result = {"lost": bool(off[-1] > LOST)}
    later = notes[:, 0] > min(REVOLUTION, 0.5 * seconds)
    if not later.any():
        return facts
    judged, turns, off, lit = notes[later], turns[later], off[later], notes[later, 7] > 0.5
    return facts | {
        "rms": float(np.sqrt(np.mean(np.sum(turns**2, axis=1)))),
        "nadir_rms": float(np.sqrt(np.mean(off**2))),
        "nadir_worst": float(off.max()),
        "worst": float(np.linalg.norm(turns, axis=1).max()),
        "knowledge_rms": float(np.degrees(np.sqrt(np.mean(judged[:, 4] ** 2)))),
        "nees": float(np.mean(judged[:, 5])),
        "dipole_missing": [rms(judged[at, 6]) for at in (lit, ~lit)],
        "mean_square": float(np.mean(judged[:, 8])),
    }


def off_goal(turns: FloatArray) -> FloatArray:
    """Return the angles (n,), deg, between body z and its target, from the rotations (n, 3), rad."""
    angle = np.linalg.norm(turns, axis=1)
    share = turns[:, 2] / np.maximum(angle, 1e-12)
    cosine = np.cos(angle) + (1.0 - np.cos(angle)) * share**2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _arrival(wanted: dict[str, Any], notes: FloatArray) -> Result:
    """Return the time (s) from which the axis stays at the target, or None, and its last error (deg)."""
    off = off_goal(notes[:, 1:4])
    near = ARRIVED[wanted["craft"]]
    beyond = np.nonzero(off > near)[0]
    at = float(notes[beyond[-1], 0]) if len(beyond) else 0.0
    stayed = notes[-1, 0] - at >= 0.5 * REVOLUTION
    return {
        "arrived": at if stayed else None,
        "first": next((float(t) for t, a in zip(notes[:, 0], off, strict=True) if a <= near), None),
        "lost": bool(off[-30:].min() > LOST),
        "end_rms": float(np.sqrt(np.mean(off[-180:] ** 2))),
        "mean_square": float(np.mean(notes[:, 8])),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return pointing errors and arrivals by craft and share."""
    facts: dict[str, Any] = {"hold": {}, "heavy": {}, "turn": {}}
    held = [("hold", *cell) for cell in HOLDS] + [("day", *cell, None) for cell in DAYS]
    held += [("unknown", craft, 0.3, wanted) for craft, wanted in UNKNOWN.items()]
    for kind, craft, share, wanted in held:
        mine = _of(results, kind, craft, share)
        if judged := [r for r in mine if "rms" in r]:
            facts["hold"][f"{kind}/{craft}/{share}"] = {**_held(mine, judged, WATTS[craft]), "wanted": wanted}
    for craft in WATTS:
        for orbit in dict(HEAVY):
            mine = [r for r in _of(results, "heavy", craft, HEAVY_SHARE) if r["orbit"] == orbit]
            if mine:
                facts["heavy"][f"heavy/{craft}/{orbit}"] = _in_heavy_air(mine)
    for craft, share in TURNS:
        if mine := _of(results, "turn", craft, share):
            facts["turn"][f"turn/{craft}/{share}"] = _turned(mine, WATTS[craft])
    return summary(facts)


def _of(results: Sequence[Result], *cell: Any) -> list[Result]:
    """Return the results of a cell: its kind, craft and share."""
    return [r for r in results if (r["kind"], r["craft"], r["share"]) == cell]


def _held(mine: Sequence[Result], judged: Sequence[Result], watts: float) -> dict[str, Any]:
    """Return the pointing and attitude errors (deg), and the residual dipole's error (A m^2) in sunlight."""
    rms = [r["rms"] for r in judged]
    return {
        "runs": len(mine),
        "lost": sum(r["lost"] for r in mine),
        "median": float(np.median(rms)),
        "worst_run": float(max(rms)),
        "nadir": float(np.median([r["nadir_rms"] for r in judged])),
        "nadir_worst_run": float(max(r["nadir_rms"] for r in judged)),
        "nadir_most": float(max(r["nadir_worst"] for r in judged)),
        "largest": float(max(r["worst"] for r in judged)),
        "known": float(np.median([r["knowledge_rms"] for r in judged])),
        "nees": float(np.mean([r["nees"] for r in judged])),
        "dipole": float(np.median([r["dipole_missing"][0] for r in judged if r["dipole_missing"][0]])),
        "milliwatts": 1e3 * watts * float(np.median([r["mean_square"] for r in judged])),
    }


def _in_heavy_air(mine: Sequence[Result]) -> dict[str, Any]:
    """Return the numbers of flights, losses and rejected star attitudes, the errors (deg) and the NEES."""
    judged = [r for r in mine if "rms" in r]
    return {
        "runs": len(mine),
        "lost": sum(r["lost"] for r in mine),
        "stars": sum(r["stars"] for r in mine),
        "rejected": sum(r["rejected"] for r in mine),
        "in_a_row": max(r["rejected_in_a_row"] for r in mine),
        "known": median([r["knowledge_rms"] for r in judged]),
        "nees": mean([r["nees"] for r in judged]),
        "nadir": median([r["nadir_rms"] for r in judged]),
        "nadir_worst_run": max((r["nadir_rms"] for r in judged), default=None),
    }


def _turned(mine: Sequence[Result], watts: float) -> dict[str, Any]:
    """Return the arrival times (s) of the axis, and the rms error (deg) of the last half hour."""
    times = [r["arrived"] for r in mine if r["arrived"] is not None]
    return {
        "runs": len(mine),
        "lost": sum(r["lost"] for r in mine),
        "arrived": len(times),
        "median": median(times),
        "worst": max(times, default=None),
        "end": float(np.median([r["end_rms"] for r in mine])),
        "milliwatts": 1e3 * watts * float(np.median([r["mean_square"] for r in mine])),
    }
