"""Error of the attitude at mid-exposure of a streaked frame, relative to its lower bound.

Row `flight` is the star tracker's result for the first fit, with a rough prior of the pointing. Row `known
sky` is its result for the second fit, in which the light of undetected stars is subtracted
(`knightcube.vision.startracker.catalogue_refit`). The rates of both fits are compared with their bound too.

The bound is the Fisher information of all pixels of the brightest stars, as in `tests.support.streak_bound`.
The directions of the stars are known; their brightness and background are free. Rotation, width of the point
spread function and attitude are common to all stars.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import show
from knightcube.astro.arrays import FloatArray, Image, cross_matrices
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.solve import AttitudePrior, FrameSolution, SolveSettings, solve_motion
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.geometry import CameraMotion
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import MotionResult
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns import streaks as campaign
from tests.studies.command import Json, Seed, command
from tests.support.attitude_errors import attitude_error, error_in_pixels
from tests.support.scenes import FIELD, Scene, noise_floor, slew
from tests.support.streak_bound import star_information

_STARS = 30
# Number of parameters common to all stars: rotation (3) and point spread. Attitude (3) or a star's x and y
# follow.
_SHARED = 4
EXPOSURE = 0.2
SOLUTIONS = ("flight", "known sky")
# Error (rad) about each axis of the prior attitude that the tracker receives, and its standard deviation
# (rad).
_PRIOR_ERROR, _PRIOR_SIGMA = np.array([2e-4, -1e-4, 1e-4]), 3e-4
# Median distance of a point whose two coordinates have an rms of 1 each, divided by the rms distance.
_RAYLEIGH_MEDIAN = float(np.sqrt(np.log(2.0)))


def estimated(pixels: Image, rate: FloatArray, exposure: float, camera: StarCameraModel) -> MotionResult:
    """Return the likelihood estimate of a frame; the true `rate` (3,) is used only for the sign."""
    settings = LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, knowledge=EXACT)
    return estimate_motion(pixels, camera.pinhole, exposure, settings, rate, 0.0)


def scenes(
    camera: StarCameraModel,
    frames: int,
    percent: float,
    thetas: tuple[float, float],
    exposure: float,
    seed: tuple[int, ...],
    faintest: float,
) -> list[Scene]:
    """Return frames with a rotation of `percent` of the field, and theta spread evenly over `thetas` (deg).

    The sky holds stars down to magnitude `faintest`.
    """
    found = []
    for frame in range(frames):
        generator = np.random.default_rng((*seed, round(10.0 * percent), frame))
        # One theta is drawn from each of `frames` equal parts of the range.
        theta = thetas[0] + (thetas[1] - thetas[0]) * (frame + generator.uniform()) / frames
        angle, fraction = float(np.deg2rad(theta)), percent / 100.0
        found.append(slew(generator, angle, fraction, exposure, faintest, camera))
    return found


def _by_attitude(vectors: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return the derivatives (n, 2, 3), px/rad, of the image positions of directions (n, 3).

    They are with respect to a small rotation of the camera.
    """
    x, y, z = vectors.T
    projected = np.zeros((len(vectors), 2, 3))
    projected[:, 0, 0] = projected[:, 1, 1] = 1.0 / z
    projected[:, 0, 2], projected[:, 1, 2] = -x / z**2, -y / z**2
    return np.asarray(pinhole.focal_length * projected @ cross_matrices(vectors))


def across_bound(scene: Scene, camera: StarCameraModel) -> float:
    """Return the lower bound of the rms error (rad) of the boresight direction.

    Raises numpy.linalg.LinAlgError if the stars do not determine it.
    """
    pinhole = camera.pinhole
    seen = np.flatnonzero(
        np.any([pinhole.contains(place) for place in (scene.start, scene.middle, scene.end)], axis=0)
    )
    brightest = seen[np.argsort(-scene.electrons[seen], kind="stable")][:_STARS]
    motion = CameraMotion.steady(scene.rate * scene.exposure)
    floor = noise_floor(camera, scene.exposure)
    total = np.zeros((_SHARED + 3, _SHARED + 3))
    change = _by_attitude(pinhole.unit_vectors(scene.middle[brightest]), pinhole)
    for place, electrons, moved in zip(
        scene.middle[brightest], scene.electrons[brightest], change, strict=True
    ):
        information = star_information(pinhole, motion, place, float(electrons), camera.psf_sigma, floor)
        geometry = slice(None, _SHARED + 2)
        light = slice(_SHARED + 2, None)
        known = np.linalg.pinv(information[light, light], hermitian=True)
        left = information[geometry, geometry] - (
            information[geometry, light] @ known @ information[light, geometry]
        )
        chain = np.zeros((_SHARED + 2, _SHARED + 3))
        chain[:_SHARED, :_SHARED] = np.eye(_SHARED)
        chain[_SHARED:, _SHARED:] = moved
        total += chain.T @ left @ chain
    scale = np.sqrt(np.diag(total))
    if not np.all(scale > 0.0):
        raise np.linalg.LinAlgError("the stars do not fix the attitude")
    covariance = np.linalg.inv(total / np.outer(scale, scale)) / np.outer(scale, scale)
    return float(np.sqrt(covariance[4, 4] + covariance[5, 5]))


def tracked(
    found: MotionResult, scene: Scene, camera: StarCameraModel, truth: FloatArray
) -> tuple[FrameSolution, FrameSolution]:
    """Return the star tracker's solutions for the fit, and for a second fit with all stars known."""
    settings = SolveSettings(
        likelihood=LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, line_time=0.0)
    )
    prior = AttitudePrior(multiply(from_rotation_vector(_PRIOR_ERROR), truth), _PRIOR_SIGMA)
    first = solve_motion(found, camera.pinhole, (1.0, 1.0), default_index(), settings, prior)
    return first, refit_with_catalogue(scene.pixels, first, default_index(), settings, settings.likelihood)


def attitude_rows(
    percent: float, frames: int, seed: int, faintest: float, exposure: float
) -> list[dict[str, Any]]:
    """Return each solution's errors across the boresight at mid-exposure, in px and relative to the bound."""
    camera = StarCameraModel(field_of_view=FIELD)
    figures: list[list[tuple[float, float, float]]] = []
    bounds: list[float] = []
    for scene in scenes(camera, frames, percent, (0.0, 90.0), exposure, (seed, 3), faintest):
        found = estimated(scene.pixels, scene.rate, exposure, camera)
        least = campaign._bound(scene, camera)
        if found.rate is None or least is None:
            continue
        truth = multiply(from_rotation_vector(0.5 * scene.rate * scene.exposure), scene.attitudes[0])
        size = float(np.linalg.norm(scene.rate))
        bounds.append(across_bound(scene, camera))
        row = []
        for one in tracked(found, scene, camera, truth):
            off = rate = claim = np.nan
            if one.fix is not None:
                off, claim = (
                    attitude_error(one.fix.quaternion, truth)[1],
                    float(np.sqrt(np.trace(one.fix.covariance[:2, :2]))),
                )
            if one.motion is not None and one.motion.rate is not None:
                rate = float(np.linalg.norm(one.motion.rate - scene.rate)) / size / least[1]
            row.append((off, off / claim, rate))
        figures.append(row)
    table = np.array(figures).reshape(-1, len(SOLUTIONS), 3)
    pixel = error_in_pixels(1.0, camera.columns, camera.field_of_view)
    return [
        {
            "percent": percent,
            "solution": name,
            "frames": frames,
            "bound_px": _root_mean_square(pixel * np.array(bounds)),
            **_figures(table[:, k, 0], np.array(bounds), pixel),
            "over_claimed": _root_mean_square(table[:, k, 1]),
            "rate_over_bound": _root_mean_square(table[:, k, 2]),
        }
        for k, name in enumerate(SOLUTIONS)
    ]


def _figures(angles: FloatArray, least: FloatArray, pixel: float) -> dict[str, Any]:
    """Return the number of attitudes, and their errors in px and relative to the bound `least`.

    The errors `angles` (n,), rad, are NaN for frames without an attitude.
    """
    there = np.isfinite(angles)
    if not there.any():
        return {"attitudes": 0}
    ratio = angles[there] / least[there]
    pixels = pixel * angles[there]
    return {
        "attitudes": int(np.count_nonzero(there)),
        "rms_px": float(np.sqrt(np.mean(pixels**2))),
        "median_px": float(np.median(pixels)),
        "largest_px": float(pixels.max()),
        "over_bound": float(np.sqrt(np.mean(ratio**2))),
        "over_bound_median": float(np.median(ratio) / _RAYLEIGH_MEDIAN),
    }


def _root_mean_square(values: FloatArray) -> float | None:
    """Return the root mean square of the values that are not NaN, or None without such values."""
    there = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(there)))) if len(there) else None


@command
def main(
    *,
    frames: Annotated[int, "for each rotation"] = 20,
    percent: Annotated[tuple[float, ...], "rotations, % of the field"] = (10.0, 20.0, 35.0, 50.0),
    faintest: Annotated[float, "magnitude of the faintest star"] = 8.5,
    exposure: Annotated[float, "s"] = EXPOSURE,
    seed: Seed = 14_142,
    json: Json = False,
) -> int:
    """Print the table, or one JSON object; return the exit status."""
    rows = [row for part in percent for row in attitude_rows(part, frames, seed, faintest, exposure)]
    show({"seed": seed, "exposure": exposure, "attitude": rows}, json)
    return 0
