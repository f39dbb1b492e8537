"""Campaign `first-orbits`: initial orbit determination from single passes, with errors and claimed sigmas.

Observer and object move in two random low orbits, which are integrated by DOP853. The object passes at a
distance of 100 to 3,000 km, and in the middle of the pass the line of sight rotates at 0.05 to 0.6 deg/s.
There is a sighting every two seconds, with an error of 0.1 px (in a camera with 1024 px over 20 deg). The
simulation includes light time and the motion of the Earth around the Sun.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.first_orbit import ArcError, Bearings, first_orbit
from tests.studies.campaigns.statistics import grouped, squared_sigmas
from tests.support.short_arcs import LIGHT, circular, flown_states, passing_object

SIGMA = float(0.1 * np.radians(20.0) / 1024)
ARCS = (60.0, 120.0, 240.0)
PERIOD = 2.0
SUNWARD = np.array([0.0, 29_780.0, 0.0])


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` passes for each arc length."""
    return [
        Case(f"{run}/{arc:g}", (seed, run), {"arc": arc, "period": PERIOD})
        for arc in ARCS
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Determine one orbit."""
    rng = np.random.default_rng(case.seed)
    times = np.arange(0.0, case.parameters["arc"] + 0.5, case.parameters["period"])
    middle = len(times) // 2
    own, other = _pass(rng)
    observer, true = (flown_states(state, times, middle) for state in (own, other))
    way = true[:, :3] - observer[:, :3]
    late = np.linalg.norm(way, axis=1, keepdims=True) / LIGHT
    way = way - late * (true[:, 3:] + SUNWARD)
    seen = way / np.linalg.norm(way, axis=1, keepdims=True) + SIGMA * rng.normal(size=way.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    distance = float(np.linalg.norm(true[middle, :3] - observer[middle, :3]))
    result: Result = {**case.parameters, "distance_m": distance}
    try:
        found = first_orbit(Bearings(times, seen, np.full(len(times), SIGMA), observer, SUNWARD))
    except ArcError as error:
        return result | {"refused": str(error)}
    off = found.state - true[middle]
    return result | {
        "refused": None,
        "nees": squared_sigmas(off, found.covariance),
        "covered": bool(found.interval[0] < distance < found.interval[1]),
        "distance_error": found.distance / distance - 1.0,
        "place_error_m": float(np.linalg.norm(off[:3])),
        "speed_error_m_s": float(np.linalg.norm(off[3:])),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each arc length: number of orbits, mean NEES, coverage, and median errors."""
    return summary({"arcs": {arc: _row(own) for arc, own in grouped(results, "arc").items()}})


def _row(results: list[Result]) -> Result:
    made = [result for result in results if result["refused"] is None]
    row: Result = {"passes": len(results), "orbits": len(made)}
    if not made:
        return row
    spread = 2.576 * float(np.sqrt(12.0 / len(made)))
    return row | {
        "nees": float(np.mean([result["nees"] for result in made])),
        "nees_99": [max(6.0 - spread, 0.0), 6.0 + spread],
        "covered": float(np.mean([result["covered"] for result in made])),
        "distance": float(np.median([abs(result["distance_error"]) for result in made])),
        "place_km": float(np.median([1e-3 * result["place_error_m"] for result in made])),
    }


def _pass(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return the states (6,) of observer and object in the middle of a pass."""
    while True:
        own = circular(rng, rng.normal(size=3), float(rng.uniform(6.75e6, 7.6e6)), 1.0)
        direction, away, other = passing_object(rng, own)
        relative = other[3:] - own[3:]
        rate = np.degrees(np.linalg.norm(np.cross(direction, relative))) / away
        if 6.7e6 < np.linalg.norm(other[:3]) < 9e6 and 0.05 < rate < 0.6:
            return own, other
