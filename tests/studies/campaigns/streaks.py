"""Campaigns `streaks` and `streaks-thesis`: five estimators as in Table 3.1 and Figures 3.7-3.10.

A cell is one theta (axis to boresight) and one rotation in percent of the field (3.28). All estimators get
the same frames. The error of the magnitude is the thesis's metric for the rate. The error of the vector has
its own column; it is larger, because the component about the boresight is poorly determined. The attitude at
an end of the exposure is computed by ESOQ2 with the true identifications. Its error is given in px (eq.
3.29), across the boresight and in total.

`streaks-thesis` has the thesis's camera, bilinear spots and uniform noise (2.5-2.11). The bound, given for
comparison, is that of a camera with Poisson noise. As in the thesis (3.28), the camera rotates at 0.05 rad/s,
and the exposure determines the length of the streaks. The biases of the detected ends are those of the
thesis's spots (`measured_bias`). The sky has the 7,000 brightest stars. With the whole catalogue, streaks
would cross at rotations of 50 % of the field, which would displace ends by up to 1 px.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import KnightCubeError
from knightcube.reference.corner_streak_rate import attitudes_of_ends, cornerness, estimate_rate
from knightcube.reference.corner_streaks import DETECTOR_NAMES, DetectorName, StreakSettings
from knightcube.vision.camera.lens import EXACT
from knightcube.vision.objects.streak_ends import measure_streaks, segment_frame
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings, StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns.statistics import mean, median, rms, squared_sigmas
from tests.support.attitude_errors import attitude_error, error_in_pixels
from tests.support.scenes import BRIGHTEST, FIELD, Scene, faintest, noise_floor, slew, usable
from tests.support.streak_bound import rate_bound

THETAS_DEG = (0, 3, 10, 20, 30, 45, 60, 75, 90)
PERCENTS = (5, 10, 20, 30, 50)
EXPOSURE = 0.2
STAR_LIMIT = 8.5
LIKELIHOOD = "likelihood"
NO_BIAS: Mapping[str, float] = {}
THESIS_CAMERA = StarCameraModel(field_of_view=FIELD, psf="bilinear", noise="uniform")
THESIS_RATE = 0.05
"""Rate (rad/s) of the thesis's camera (chapter 4); it determines the exposure for a rotation."""
THESIS_BIAS: dict[str, float] = {
    "harris": -0.07,
    "minimum-eigenvalue": 0.36,
    "trajkovic-4": 1.21,
    "trajkovic-8": 0.92,
}
"""Inward displacement (px) of the ends of the thesis's streaks [measured_bias, 16 frames, seed 5]."""
ESTIMATORS = (*DETECTOR_NAMES, LIKELIHOOD)
BOUND_STARS = 30
MATCH_PX = 6.0
WRONG = 25.9
# Table 3.1 of the thesis, by estimator: rate errors (%) at rotations of 10 and 50 % of the field, attitude
# errors (px) at the same rotations, smallest theta (deg).
THESIS = {
    "harris": (0.69, 0.07, 0.10, 0.10, 20),
    "minimum-eigenvalue": (1.20, 0.19, 0.19, 0.20, 30),
    "trajkovic-4": (2.44, 0.38, 0.39, 0.37, 30),
    "trajkovic-8": (3.49, 0.47, 0.55, 0.29, 30),
}


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` frames for each cell."""
    return [
        Case(f"{theta}/{percent}/{run}", (seed, theta, percent, run), {"theta": theta, "percent": percent})
        for run in range(runs)
        for theta in THETAS_DEG
        for percent in PERCENTS
    ]


def run(case: Case) -> Result:
    """Run every estimator on one frame."""
    return see(case, StarCameraModel(field_of_view=FIELD))


def thesis_run(case: Case) -> Result:
    """Run every estimator on one frame of the thesis's camera."""
    exposure = case.parameters["percent"] / 100.0 * FIELD / THESIS_RATE
    return see(case, THESIS_CAMERA, exposure, THESIS_BIAS, faintest(BRIGHTEST))


def see(
    case: Case,
    camera: StarCameraModel,
    exposure: float = EXPOSURE,
    biases: Mapping[str, float] = NO_BIAS,
    limit: float = STAR_LIMIT,
) -> Result:
    """Run every estimator on one frame of a camera; `biases` (px) replace those of the detectors."""
    generator = np.random.default_rng(case.seed)
    theta, fraction = np.deg2rad(case.parameters["theta"]), case.parameters["percent"] / 100.0
    scene = slew(generator, float(theta), fraction, exposure, limit, camera)
    saturation = float(camera.highest_count)
    result: Result = {**case.parameters, "usable": len(usable(scene, camera)), "bound": _bound(scene, camera)}
    for name in DETECTOR_NAMES:
        bias = {"endpoint_bias": biases[name]} if name in biases else {}
        settings = StreakSettings.of(name, saturation=saturation, **bias)
        found = estimate_rate(scene.pixels, camera.pinhole, exposure, settings, scene.rate, 0.0)
        result[name] = _errors(found, scene, camera)
    likelihood = LikelihoodSettings(saturation=saturation, gain=camera.gain, knowledge=EXACT)
    motion = estimate_motion(scene.pixels, camera.pinhole, exposure, likelihood, scene.rate, 0.0)
    result[LIKELIHOOD] = _errors(motion, scene, camera)
    return result


def measured_bias(
    name: DetectorName, frames: int, seed: int, camera: StarCameraModel = THESIS_CAMERA
) -> float:
    """Return the median inward displacement (px) of a detector's streak ends at rotations of 10 and 20 %."""
    settings = StreakSettings.of(name, saturation=float(camera.highest_count))
    inward: list[float] = []
    for frame in range(frames):
        percent, theta = (10, 20)[frame % 2], float(np.deg2rad((30, 45, 60, 90)[frame // 2 % 4]))
        generator = np.random.default_rng((seed, frame))
        exposure = percent / 100.0 * camera.field_of_view / THESIS_RATE
        scene = slew(generator, theta, percent / 100.0, exposure, faintest(BRIGHTEST), camera)
        ends = measure_streaks(segment_frame(scene.pixels, settings), settings, cornerness).endpoints
        true = np.stack([scene.start, scene.end], axis=1)
        distance, star = _nearest(ends, np.concatenate([true, true[:, ::-1]]))
        known = distance < MATCH_PX
        lengths = [np.linalg.norm(each[:, 1] - each[:, 0], axis=-1) for each in (true, ends[known])]
        inward += (0.5 * (lengths[0][star[known] % len(true)] - lengths[1])).tolist()
    return float(np.median(inward))


def _nearest(ends: FloatArray, true: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return distance (n,), px, and index of the nearest of the `true` streaks for each streak (n, 2, 2)."""
    distance = np.linalg.norm(true[None] - ends[:, None], axis=-1).max(axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    star = distance.argmin(axis=1)
    return distance[np.arange(len(ends)), star], star


def _bound(scene: Scene, camera: StarCameraModel) -> list[float] | None:
    """Return the relative bounds (1 sigma) of the rate's magnitude and vector, or None if undetermined."""
    pinhole = camera.pinhole
    places = (scene.start, scene.middle, scene.end)
    seen = np.flatnonzero(np.any([pinhole.contains(place) for place in places], axis=0))
    brightest = seen[np.argsort(-scene.electrons[seen])][:BOUND_STARS]
    try:
        covariance = rate_bound(
            pinhole,
            scene.middle[brightest],
            scene.electrons[brightest],
            scene.rate,
            scene.exposure,
            camera.psf_sigma,
            noise_floor(camera, scene.exposure),
        ).covariance
    except np.linalg.LinAlgError:
        return None
    size = float(np.linalg.norm(scene.rate))
    axis = scene.rate / size
    return [float(np.sqrt(axis @ covariance @ axis)) / size, float(np.sqrt(np.trace(covariance))) / size]


def _errors(found: Any, scene: Scene, camera: StarCameraModel) -> Result:
    """Return status and relative errors of one estimate."""
    if found.status is not StreakStatus.RATE:
        return {"status": found.status.value}
    size = float(np.linalg.norm(scene.rate))
    error = found.rate - scene.rate
    whole, across = _attitude(found, scene, camera)
    return {
        "status": "rate",
        "magnitude": float(np.linalg.norm(found.rate)) / size - 1.0,
        "vector": float(np.linalg.norm(error)) / size,
        "nees": squared_sigmas(error, found.covariance),
        "whole_px": whole,
        "across_px": across,
    }


def _attitude(found: Any, scene: Scene, camera: StarCameraModel) -> tuple[float | None, float | None]:
    """Return the mean attitude error of the two ends, px (3.29): in total, and across the boresight.

    None without an attitude.
    """
    ends = found.endpoints[found.used]
    true = np.stack([scene.start, scene.end], axis=1)
    distance, star = _nearest(ends, true)
    known = distance < MATCH_PX
    try:
        fixes = attitudes_of_ends(
            ends[known],
            scene.directions[star[known]],
            np.ones(int(known.sum())),
            camera.pinhole,
            scene.exposure,
        )
    except KnightCubeError:
        return None, None
    pairs = zip((fixes.start, fixes.end), scene.attitudes, strict=True)
    errors = np.mean([attitude_error(fix.quaternion, truth) for fix, truth in pairs], axis=0)
    resolution = camera.columns
    whole, across = (error_in_pixels(float(e), resolution, camera.field_of_view) for e in errors)
    return whole, across


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the table by cell and estimator, the table of the thesis, and Figures 3.7 to 3.10."""
    cells = []
    for theta in THETAS_DEG:
        for percent in PERCENTS:
            here = [r for r in results if r["theta"] == theta and r["percent"] == percent]
            cells.append({"theta": theta, "percent": percent, "frames": len(here), **_cell(here)})
    overall = _overall(results)
    table = _table_3_1(results)
    return summary({"cells": cells, "overall": overall, "table_3_1": table, "exposure_s": EXPOSURE})


def _cell(results: Sequence[Result]) -> dict[str, Any]:
    bounds = np.array([r["bound"] for r in results if r["bound"] is not None]).reshape(-1, 2)
    row: dict[str, Any] = {"bound_magnitude": rms(bounds[:, 0]), "bound_vector": rms(bounds[:, 1])}
    for name in ESTIMATORS:
        good = [r for r in results if r[name]["status"] == "rate" and r["bound"] is not None]
        own = np.array([r["bound"] for r in good]).reshape(-1, 2)
        row[name] = {
            "rates": len(good),
            "magnitude": rms(np.array([r[name]["magnitude"] for r in good])),
            "vector": rms(np.array([r[name]["vector"] for r in good])),
            "ratio_magnitude": _ratio([r[name]["magnitude"] for r in good], own[:, 0]),
            "ratio_vector": _ratio([r[name]["vector"] for r in good], own[:, 1]),
            "nees": mean([r[name]["nees"] for r in good]),
            "across_px": mean([r[name]["across_px"] for r in good if r[name]["across_px"] is not None]),
            "whole_px": mean([r[name]["whole_px"] for r in good if r[name]["whole_px"] is not None]),
        }
    return row


def _overall(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return the likelihood estimator's results by rotation, over all theta.

    A rate is wrong if its normalised squared error exceeds the 1 - 1e-5 quantile (chi-square of 3 degrees of
    freedom).
    """
    rows = []
    for percent in PERCENTS:
        here = [r for r in results if r["percent"] == percent and r["bound"] is not None]
        good = [r[LIKELIHOOD] for r in here if r[LIKELIHOOD]["status"] == "rate"]
        pixels = [one["across_px"] for one in good if one["across_px"] is not None]
        row = {"percent": percent, "frames": len(here), "wrong": sum(one["nees"] > WRONG for one in good)}
        rows.append({**row, **_cell(here)[LIKELIHOOD], "across_px_median": median(pixels)})
    return rows


def _ratio(errors: Sequence[float], bound: FloatArray) -> float | None:
    """Return the rms of the ratios of errors to their bounds."""
    return rms(np.array(errors) / bound) if len(errors) else None


def _table_3_1(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return Table 3.1: the largest mean errors in the thesis and here, for each estimator.

    Errors at a smaller theta than the thesis's limit for the estimator are not included.

    Rate errors are fractions here and percentages in the thesis. Attitude errors are in px.
    """
    rows = []
    for name in ESTIMATORS:
        *thesis, least = THESIS.get(name, (None, None, None, None, 0))
        row: dict[str, Any] = {"estimator": name, "theta_from": least}
        asked = [(key, percent) for key in ("magnitude", "across_px") for percent in (10, 50)]
        for (key, percent), printed in zip(asked, thesis, strict=True):
            row[f"{key} {percent} %"] = _worst_mean(results, name, percent, least, key)
            row[f"{key} {percent} %, thesis"] = printed
        rows.append(row)
    return rows


def _worst_mean(results: Sequence[Result], name: str, percent: int, least: int, key: str) -> float | None:
    means = []
    for theta in THETAS_DEG:
        values = [
            abs(r[name][key])
            for r in results
            if r["theta"] == theta and r["percent"] == percent and r[name].get(key) is not None
        ]
        if theta >= least and values:
            means.append(float(np.mean(values)))
    return max(means, default=None)
