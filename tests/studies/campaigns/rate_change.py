"""Campaign `rate-change`: frames in which the rate changes by up to 200 % of its mean, and by more.

The fields are random, theta is 0 to 90 deg, streaks have 16 to 90 px, exposures are 0.2 and 1 s. The rate
changes linearly along its axis by 0 to 200 % of its mean, up or down; in a third of the frames the change is
200 %, so the motion starts or ends at rest.

Half as many additional frames have rotations that reverse within the exposure: 220 to 400 % in half of them,
and up to 4,000 % in the other half, over paths of the same lengths. The model does not include reversals, so
a refusal is correct. Beyond 4,000 % both directions of the path coincide to a pixel, and no frame
distinguishes the rotation from one that begins at rest.

The frames are summed instant by instant (`row_exposure`), not by the estimator's model. A result is right if
its error is within 6 claimed standard deviations, or within 1 % of the rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.streaks.scenes import turn_of
from tests.support.row_exposure import row_scene
from tests.support.scenes import FIELD

EXPOSURES = (0.2, 1.0)
LENGTHS = (16.0, 90.0)
FROM_REST = 2.0
FROM_REST_SHARE = 1 / 3
WRONG_SIGMAS = 6.0
WRONG_SHARE = 0.01
# Upper limits of the classes of rate change (% of the mean rate).
CHANGES = (50, 100, 150, 199, 200, 300, 400, 4000)
# Smallest rate change, relative to the mean rate, with which the rotation visibly reverses, and the largest
# changes in the two halves of the frames with a reversal.
REVERSING = (2.2, 4.0, 40.0)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` random motions; the sky is drawn when one is run."""
    found = []
    for run in range(runs):
        draw = np.random.default_rng((seed, run, 0))
        change = FROM_REST if draw.uniform() < FROM_REST_SHARE else draw.uniform(0.0, FROM_REST)
        parameters = {
            "theta": float(np.rad2deg(draw.uniform(0.0, 0.5 * np.pi))),
            "length": float(np.exp(draw.uniform(*np.log(LENGTHS)))),
            "exposure": float(draw.choice(EXPOSURES)),
            "change": float(change * draw.choice([-1.0, 1.0])),
        }
        found.append(Case(str(run), (seed, run, 1), parameters))
    return found + [_reversing(run, seed) for run in range(runs // 2)]


def _reversing(run: int, seed: int) -> Case:
    draw = np.random.default_rng((seed, run, 2))
    change = float(np.exp(draw.uniform(*np.log(REVERSING[:2] if run % 2 else REVERSING[1:]))))
    path = float(np.exp(draw.uniform(*np.log(LENGTHS))))
    parameters = {
        "theta": float(np.rad2deg(draw.uniform(0.0, 0.5 * np.pi))),
        # This is the length (px) of a streak at the mean rate. It is chosen so that the longer part of the
        # path, before or after the reversal, is `path` px long.
        "length": path / (0.5 * change * (0.5 + 1.0 / change) ** 2),
        "exposure": float(draw.choice(EXPOSURES)),
        "change": change * float(draw.choice([-1.0, 1.0])),
    }
    return Case(f"back-{run}", (seed, run, 3), parameters)


def run(case: Case) -> Result:
    """Estimate one frame's motion."""
    given, generator = case.parameters, np.random.default_rng(case.seed)
    camera = StarCameraModel(field_of_view=FIELD)
    roll, exposure = generator.uniform(0.0, 2.0 * np.pi), given["exposure"]
    rate = turn_of(np.deg2rad(given["theta"]), given["length"], roll, camera) / exposure

    def turns(times: FloatArray) -> FloatArray:
        return np.asarray((times + 0.5 * given["change"] * times**2 / exposure)[:, None] * rate)

    scene = row_scene(camera, turns, exposure, generator)
    settings = LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, line_time=0.0)
    found = estimate_motion(scene.pixels, camera.pinhole, exposure, settings, rate, 0.0)
    result: Result = {**given, "status": found.status.value, "nees": None}
    if found.rate is not None and found.covariance is not None:
        error = found.rate - rate
        result["nees"] = float(error @ np.linalg.solve(found.covariance, error))
        result["vector"] = float(np.linalg.norm(error) / np.linalg.norm(rate))
    return result


def summarise(results: Sequence[Result], out: Path) -> Summary:
    """Return a row for each class of the change, and one for all."""
    del out
    rows = []
    for low, high in pairwise((0, *CHANGES)):
        here = [one for one in results if low <= 100.0 * abs(one["change"]) - 1e-6 < high]
        if here:
            rows.append({"change": f"to {high} %", **_row(here)})
    rows.append({"change": "all", **_row(results)})
    return summary({"rows": rows})


def _row(results: Sequence[Result]) -> dict[str, Any]:
    answers = [one for one in results if one["nees"] is not None]
    beyond = [one["nees"] > WRONG_SIGMAS**2 for one in answers]
    wrong = [far and one["vector"] > WRONG_SHARE for far, one in zip(beyond, answers, strict=True)]
    return {
        "frames": len(results),
        "answers": len(answers),
        "right": len(answers) - sum(wrong),
        "beyond_sigmas": sum(beyond),
        "nees": float(np.mean([one["nees"] for one in answers])) if answers else None,
        "worst": max((one["vector"] for one in answers), default=0.0),
    }


RATE_CHANGE = Campaign(
    "rate-change",
    "frames over which the rate changes, or reverses: right, refused, beyond 6 sigma",
    cases,
    run,
    summarise,
    200,
)
