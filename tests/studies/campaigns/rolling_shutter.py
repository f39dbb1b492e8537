"""Campaign `rolling-shutter`: the rate from frames whose rows are exposed in sequence, with known line time.

The fields are random, theta is 0 to 90 deg, streaks have 20 to 300 px, exposures are 0.2 and 1 s, and line
times 10 to 50 us. Each frame is estimated twice: with a prior, which gives the direction of time, and without
one. The frames are summed row by row (`row_exposure`), not by the estimator's model. A result without a prior
may have the opposite sign; its covariance must include both directions. The Cramer-Rao bound is that of a
global shutter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.streaks.scenes import turn_of
from tests.support.row_exposure import RowScene, row_scene
from tests.support.scenes import FIELD, noise_floor
from tests.support.streak_bound import rate_bound

EXPOSURES = (0.2, 1.0)
LENGTHS = (20.0, 300.0)
LINE_TIMES = (1e-5, 5e-5)
BOUND_STARS = 20
WRONG_SIGMAS = 6.0
PRIOR, ALONE = "prior", "alone"


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` random motions; the sky is drawn when one is run."""
    found = []
    for run in range(runs):
        draw = np.random.default_rng((seed, run, 0))
        parameters = {
            "theta": float(np.rad2deg(draw.uniform(0.0, 0.5 * np.pi))),
            "length": float(np.exp(draw.uniform(*np.log(LENGTHS)))),
            "exposure": float(draw.choice(EXPOSURES)),
            "line_time": float(draw.uniform(*LINE_TIMES)),
        }
        found.append(Case(str(run), (seed, run, 1), parameters))
    return found


def run(case: Case) -> Result:
    """Estimate one frame's motion with and without a prior."""
    given, generator = case.parameters, np.random.default_rng(case.seed)
    camera = replace(StarCameraModel(field_of_view=FIELD), line_time=given["line_time"])
    roll = generator.uniform(0.0, 2.0 * np.pi)
    rate = turn_of(np.deg2rad(given["theta"]), given["length"], roll, camera) / given["exposure"]
    scene = row_scene(camera, lambda times: times[:, None] * rate, given["exposure"], generator)
    settings = LikelihoodSettings(
        saturation=float(camera.highest_count), gain=camera.gain, line_time=camera.line_time
    )
    seen = scene.pixels, camera.pinhole, given["exposure"], settings
    bound = _bound(scene, camera, rate, given["exposure"])
    return {
        **given,
        PRIOR: _judged(estimate_motion(*seen, rate, 0.0), rate, bound),
        ALONE: _judged(estimate_motion(*seen), rate, bound),
    }


def _bound(scene: RowScene, camera: StarCameraModel, rate: FloatArray, exposure: float) -> FloatArray:
    bright = slice(BOUND_STARS)
    floor = noise_floor(camera, exposure)
    light = scene.electrons[bright]
    return rate_bound(
        camera.pinhole, scene.stars[bright], light, rate, exposure, camera.psf_sigma, floor
    ).covariance


def _judged(found: MotionResult, rate: FloatArray, bound: FloatArray) -> Result:
    """Return status, NEES, ratio of the squared error to its bound, and error relative to the rate."""
    if found.rate is None or found.covariance is None:
        return {"status": found.status.value}
    error = found.rate - rate
    if found.status is StreakStatus.AMBIGUOUS and found.rate @ rate < 0.0:
        error = found.rate + rate
    return {
        "status": found.status.value,
        "nees": float(error @ np.linalg.solve(found.covariance, error)),
        "over_bound": float(error @ np.linalg.solve(bound, error)) / len(error),
        "vector": float(np.linalg.norm(error) / np.linalg.norm(rate)),
    }


def summarise(results: Sequence[Result], out: Path) -> Summary:
    """Return a row with a prior and one without."""
    del out
    facts = {name: _row([one[name] for one in results]) for name in (PRIOR, ALONE)}
    return summary(facts)


def _row(judged: Sequence[Result]) -> dict[str, Any]:
    answers = [one for one in judged if "nees" in one]
    nees, over, vector = (
        np.array([one[key] for one in answers] or [np.nan]) for key in ("nees", "over_bound", "vector")
    )
    return {
        "frames": len(judged),
        "answers": len(answers),
        "beyond_sigmas": int(np.count_nonzero(nees > WRONG_SIGMAS**2)),
        "nees": float(np.mean(nees)),
        "over_bound": float(np.sqrt(np.mean(over))),
        # The median of chi-square with 3 degrees of freedom, divided by 3, is 0.789.
        "median_over_bound": float(np.sqrt(np.median(over) / 0.789)),
        "worst": float(np.max(vector)),
    }


ROLLING_SHUTTER = Campaign(
    "rolling-shutter",
    "frames read row by row, line time known, with a prior and without: NEES, and the error over its bound",
    cases,
    run,
    summarise,
    200,
)
