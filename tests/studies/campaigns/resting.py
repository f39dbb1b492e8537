"""Campaigns `resting` and `streaked`: attitudes from frames of cameras that differ from the model.

The frames of `resting` have each of `imperfections.IMPERFECTIONS`, and streaks of 0, 1 and 3 px. Exposures
last 0.2 s, and the priors are those of a flight. The frames of `streaked` have streaks of 10, 20 and 40 px in
the centre, and the rotation about the boresight is at most the rotation across it. Their additional cameras
have rolling shutters of 0, 20 and 30 us per row, with known and unknown line time. `supersampled` renders the
frames.

The error of an attitude is given in claimed standard deviations (the square root of its NEES). An error of
more than 6 counts as confidently wrong. A displaced optical axis, or a point spread function with a displaced
centroid, rotates all attitudes by the same angle. A flight calibrates this rotation, as part of its mounting,
with the same stars. In these rows (`SHIFTED`) the median error is subtracted, and the prior includes the
displaced axis. The row `none` has an exactly known lens; all other rows have the default uncertainty of an
uncalibrated lens.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.vision.camera.lens import EXACT, CameraKnowledge
from knightcube.vision.frame_job import FrameJob, TrackerSettings
from knightcube.vision.frame_job import run as look
from knightcube.vision.startracker.solve import AttitudePrior, RatePrior, SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns.imperfections import IMPERFECTIONS, Imperfection
from tests.studies.campaigns.mismatch import WRONG_SIGMAS, detected
from tests.studies.campaigns.statistics import grouped, largest, mean, rms, squared_sigmas
from tests.support.scenes import FIELD, catalogue
from tests.support.supersampled import Sky, light

EXPOSURE = 0.2
TRAILS, STREAKS = (0.0, 1.0, 3.0), (10.0, 20.0, 40.0)
"""Lengths (px) of the streaks of `resting` and of `streaked`."""
ROLLING = (0.0, 20e-6, 30e-6)
"""Line times (s) of the additional cameras of `streaked`."""
SHUTTERS = {
    f"rolling {1e6 * line_time:.0f} us, {'stated' if stated else 'unstated'}": Imperfection(
        line_time=line_time, known={"line_time": line_time if stated else None}
    )
    for line_time in ROLLING
    for stated in (True, False)
}
_PRIOR = 1e-4
"""Standard deviations (rad and rad/s) of the predicted attitude and rate."""
SHIFTED = ("coma", "axis 5 px off")
CAMERA = StarCameraModel(columns=512, rows=512, field_of_view=FIELD)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` frames of each imperfection and length."""
    return _cases(IMPERFECTIONS, TRAILS, runs, seed)


def streaked_cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` frames for each camera of `streaked` and each streak length."""
    return _cases(SHUTTERS | IMPERFECTIONS, STREAKS, runs, seed)


def _cases(rows: Iterable[str], lengths: Sequence[float], runs: int, seed: int) -> list[Case]:
    return [
        Case(f"{name} {length:g} {run}", (seed, cell, run), {"row": name, "trail": length})
        for cell, (name, length) in enumerate(product(rows, lengths))
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Solve one frame of an imperfect camera, and evaluate its attitude."""
    return look_at(case, IMPERFECTIONS[case.parameters["row"]], 0.0)


def streaked_run(case: Case) -> Result:
    """Solve one frame of streaks, and evaluate its attitude."""
    return look_at(case, (SHUTTERS | IMPERFECTIONS)[case.parameters["row"]], 1.0)


def look_at(case: Case, imperfection: Imperfection, about: float) -> Result:
    """Solve one frame in which stars at the centre move by `trail` px, and evaluate its attitude.

    The rotation about the boresight is up to `about` times the rotation across it.
    """
    rng, trail = np.random.default_rng(case.seed), case.parameters["trail"]
    middle, way = normalise(rng.normal(size=4)), rng.uniform(0.0, 2.0 * np.pi)
    roll = rng.uniform(-about, about) if about else 0.0
    turn = np.array([np.cos(way), np.sin(way), roll]) * trail / CAMERA.pinhole.focal_length
    pixels = expose(imperfection, middle, turn, rng)
    solution = look(job(pixels, imperfection, middle, turn, rng)).solution
    result: Result = {**case.parameters, "kind": None, "error": None}
    if solution is None or solution.fix is None:
        return result
    error = to_rotation_vector(multiply(solution.fix.quaternion, conjugate(middle)))
    return result | {
        "kind": solution.kind.value,
        "stars": len(solution.matched),
        "error": error.tolist(),
        "covariance": solution.fix.covariance.tolist(),
    }


def expose(
    imperfection: Imperfection, middle: FloatArray, turn: FloatArray, rng: np.random.Generator
) -> Image:
    """Return a frame with mid-exposure attitude `middle` (4,) and a rotation `turn` (3,), rad."""
    stars, directions = catalogue(8.5)
    near = np.flatnonzero(
        directions @ attitude_matrix(middle)[2] > np.cos(CAMERA.pinhole.half_diagonal + 0.02)
    )
    sky = Sky(directions[near], CAMERA.electrons(stars.magnitude[near], EXPOSURE))
    electrons = light(
        CAMERA.pinhole,
        imperfection.optics,
        sky,
        lambda times: multiply(from_rotation_vector(times[:, None] * turn), middle),
        4.0 + 1.3 * CAMERA.pinhole.focal_length * float(np.linalg.norm(turn)),
        imperfection.line_time / EXPOSURE,
        rng,
    )
    return detected(electrons, imperfection, CAMERA, EXPOSURE, rng)


def job(
    pixels: Image, imperfection: Imperfection, middle: FloatArray, turn: FloatArray, rng: np.random.Generator
) -> FrameJob:
    """Return a flight's job with the model's camera; the errors of its priors have the claimed sigma."""
    known: dict[str, Any] = {"gain": CAMERA.gain, "psf_sigma": CAMERA.psf_sigma, "line_time": 0.0}
    known |= {"saturation": imperfection.top} | imperfection.known
    detection = DetectionSettings(
        psf_sigma=known["psf_sigma"], gain=known["gain"], saturation=imperfection.top
    )
    lens = EXACT if imperfection is IMPERFECTIONS["none"] else CameraKnowledge()
    off, faster = rng.normal(scale=_PRIOR, size=(2, 3))
    x, y = imperfection.optics.offset
    # the prior includes the displaced axis, because a flight calibrates it as part of the mounting
    off = off + np.array([y, -x, 0.0]) / CAMERA.pinhole.focal_length
    return FrameJob(
        pixels,
        CAMERA.pinhole,
        EXPOSURE,
        LikelihoodSettings(**known),
        TrackerSettings(SolveSettings(detection=detection, lens=lens), (1.0, 1.0)),
        RatePrior(turn / EXPOSURE + faster, _PRIOR),
        AttitudePrior(multiply(from_rotation_vector(off), middle), _PRIOR),
    )


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return attitudes and errors of each row, and of all rows."""
    judged = [one for own in grouped(results, "row").values() for one in _judged(own)]
    rows = {name: _figures(own) for name, own in grouped(judged, "row", "trail").items()}
    return summary({"rows": rows, "all": _figures(judged)})


def _judged(results: Sequence[Result]) -> list[Result]:
    """Return a row's results with NEES, and error and claimed sigma across the boresight (px per axis)."""
    errors = np.array([result["error"] for result in results if result["error"] is not None])
    shift = np.zeros(3)
    if len(errors) and results[0]["row"] in SHIFTED:
        shift = np.median(errors, axis=0)
    judged = []
    for result in results:
        figures: Result = {"nees": None}
        if result["error"] is not None:
            off, covariance = np.array(result["error"]) - shift, np.array(result["covariance"])
            across = CAMERA.pinhole.focal_length / np.sqrt(2.0)
            figures = {
                "nees": squared_sigmas(off, covariance),
                "off": float(np.linalg.norm(off[:2])) * across,
                "claim": float(np.sqrt(np.trace(covariance[:2, :2]))) * across,
            }
        judged.append({"row": result["row"], "trail": result["trail"], **figures})
    return judged


def _figures(results: Sequence[Result]) -> Result:
    answers = [result for result in results if result["nees"] is not None]
    nees = np.array([result["nees"] for result in answers])
    return {
        "frames": len(results),
        "attitudes": len(answers),
        "nees": mean(nees),
        "worst": largest(np.sqrt(nees)),
        "beyond": int(np.count_nonzero(nees > WRONG_SIGMAS**2)),
        **{name: rms([result[name] for result in answers]) for name in ("off", "claim")},
    }
