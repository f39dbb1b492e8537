"""Campaign `ionf`: the three satellites of Meller et al. in the loop, with separate attitudes.

Each run flies one satellite pointing at nadir in sunlight, with four or three cameras at 2 Hz. The paper's
four attitudes (cameras, magnetometer, fused, filtered) and the attitude that the flight uses are compared
with the truth.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import FOLDER
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from ground.telemetry import Run
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector
from sim_hal.settings import Simulation
from tests.support.flights import fly

SATELLITES = {"uw": "ionf", "vt": "ionf_vt", "usu": "ionf_usu"}
METHODS = ("cameras", "magnetometer", "fused", "filtered", "flown")
SETTLED = 30.0
"""Time (s) after which attitudes are evaluated."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each satellite."""
    return [
        Case(f"{name}/{run}", (seed, run), {"name": name, "seconds": 120.0})
        for run in range(runs)
        for name in SATELLITES
    ]


def run(case: Case) -> Result:
    """Fly one satellite."""
    given, path = case.parameters, FOLDER / f"{SATELLITES[case.parameters['name']]}.yaml"
    config = configuration.replace(configuration.load(path), duration=given["seconds"])
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    seed = int(np.random.default_rng(case.seed).integers(1, 2**31))
    with tempfile.TemporaryDirectory() as place:
        flown = fly(config, Path(place) / "run", section=configuration.replace(section, seed=seed))
    return {**given, **judged(flown, SETTLED)}


def judged(flown: Run, since: float) -> Result:
    """Return each attitude's share of frames, rms error and claimed sigma per axis (deg), and NEES."""
    rows, truth = flown["separate_attitudes"], flown["truth"]
    rows = rows[rows["middle_ns"] > since * 1e9]
    seen = flown["directions"]
    found: dict[str, Any] = {
        "rounds": len(rows),
        "sun": float(np.mean(seen["sun_cameras"] > 0)),
        "horizon": float(np.mean(seen["nadir_cameras"] > 0)),
    }
    true = np.stack(
        [np.interp(rows["middle_ns"], truth["time_ns"], truth["quaternion"][:, k]) for k in range(4)], axis=1
    )
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    for name in METHODS:
        known = np.isfinite(rows[name][:, 0])
        pairs = zip(rows[name][known], true[known], strict=True)
        squares = [float(np.sum(to_rotation_vector(multiply(a, conjugate(b))) ** 2)) / 3.0 for a, b in pairs]
        claims = rows[f"{name}_sigma"][known].astype(float) ** 2
        found[name] = {
            "share": float(np.mean(known)) if len(known) else 0.0,
            "rms_deg": math.degrees(math.sqrt(np.mean(squares))) if squares else None,
            "claim_deg": math.degrees(math.sqrt(np.mean(claims))) if squares else None,
            "nees": float(np.mean(squares / claims)) if squares else None,
        }
    return found


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return a table of the results of each satellite."""
    del folder
    return summary({name: [one for one in results if one["name"] == name] for name in SATELLITES})


IONF = Campaign(
    "ionf",
    "attitudes of the ION-F satellites by cameras, magnetometer, fusion and filter, in the loop",
    cases,
    run,
    summarise,
    3,
)
