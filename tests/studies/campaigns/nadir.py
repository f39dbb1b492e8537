"""Campaign `nadir`: nadir from random frames of the Earth's limb, in daylight and with the terminator.

Positions, attitudes, Sun directions and ground are random. Altitudes are uniform over 200 to 2,000 km
(`tests.sim_hal.earth_camera.scenes`). The camera is the logarithmic Fuga 15d with a field of 67 deg,
distortion, noise and blemishes. The prior knowledge is the position (GPS), the directions of Sun and magnetic
field from models, and coarse measurements of both in camera axes (solar cells to 5 deg per axis, magnetometer
to 2 deg). Each view is rendered with a known atmosphere, whose limb height is known to 1 km, and with an
unknown atmosphere of random scale height and haze.

Errors are angles between true and measured nadir (both axes together). The NEES of the two axes is 2 if the
covariance is correct. An accepted result with an error of more than half a degree is wrong. Refused and
ambiguous frames count as unanswered.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.vision.horizon.nadir import HorizonStatus, find_nadir
from sim_hal.earth_camera import nadir, render
from tests.pace import warm_call
from tests.sim_hal.earth_camera.scenes import random_scene
from tests.studies.campaigns.statistics import grouped, largest, mean, rms, squared_sigmas
from tests.support.limb_frames import camera_model, coarse_knowledge, finder_settings, random_air

VIEWS = ("sunlit", "terminator")
AIRS = ("known", "unknown")
WRONG_DEG = 0.5
RIGHT, WRONG = "right", "wrong"


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` frames of each view with each atmosphere."""
    return [
        Case(f"{view}-{air}-{run}", (seed, number, run), {"view": view, "air": air})
        for air in AIRS
        for number, view in enumerate(VIEWS)
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Find nadir in one frame, and evaluate the result."""
    model = camera_model()
    generator = np.random.default_rng(case.seed)
    scene = random_scene(generator, model, case.parameters["view"])
    air = case.parameters["air"]
    if air == "unknown":
        scene = replace(scene, atmosphere=random_air(generator))
    frame = render(model, scene, generator)
    knowledge, settings = coarse_knowledge(scene, generator), finder_settings(model, air)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found, spent = warm_call("nadir", lambda: find_nadir(frame, model.lens, knowledge, settings))
    result: Result = {
        **case.parameters,
        "seed": list(case.seed),
        "altitude_km": 1e-3 * (float(np.linalg.norm(scene.position)) - 6_371e3),
        "status": found.status.value,
        "reason": found.reason,
        "milliseconds": 1e3 * spent,
        "pixels_read": found.pixels_read,
        "warnings": sorted({f"{Path(w.filename).name}:{w.lineno} {w.message}" for w in caught}),
    }
    truth = nadir(scene)
    if found.nadir is None:
        nearest = max((float(each.direction @ truth) for each in found.candidates), default=None)
        off = None if nearest is None else float(np.degrees(np.arccos(min(1.0, nearest))))
        return {**result, "verdict": found.status.value, "error_deg": None, "nees": None, "nearest_deg": off}
    error = found.nadir.basis @ truth
    return {
        **result,
        "error_deg": (size := float(np.degrees(np.linalg.norm(error)))),
        "verdict": WRONG if size > WRONG_DEG or found.nadir.direction @ truth < 0.0 else RIGHT,
        "nees": squared_sigmas(error, found.nadir.tangent_covariance),
        "sigma_deg": float(np.degrees(found.nadir.sigma)),
        "edges": found.nadir.used,
        "residual_px": found.nadir.residual,
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the table of both views with both atmospheres, and the list of notable frames."""
    views = {name: row(own) for name, own in grouped(results, "view", "air").items()}
    notable = [r for r in results if r["verdict"] != RIGHT or r["nees"] > 20.0 or r["warnings"]]
    return summary({"views": views, "to_look_at": notable})


def row(results: Sequence[Result]) -> dict[str, Any]:
    """Return counts, errors, NEES and times of a set of frames."""
    verdicts = Counter(r["verdict"] for r in results)
    answers = [r for r in results if r["nees"] is not None]
    errors = np.array([r["error_deg"] for r in answers])
    spent = np.array([r["milliseconds"] for r in results])
    return {
        "frames": len(results),
        **{kind: verdicts[kind] for kind in (RIGHT, WRONG)},
        **{kind.value: verdicts[kind.value] for kind in HorizonStatus if kind is not HorizonStatus.FOUND},
        "rms_deg": rms(errors),
        "p99_deg": float(np.quantile(errors, 0.99)) if answers else None,
        "worst_deg": largest(errors),
        "nees": mean([r["nees"] for r in answers]),
        "median_ms": float(np.median(spent)),
        "p95_ms": float(np.quantile(spent, 0.95)),
        "most_ms": float(spent.max()),
        "pixels_read": float(np.mean([r["pixels_read"] for r in results])),
    }
