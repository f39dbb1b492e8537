"""Likelihood fit relative to the Cramer-Rao bound, and its time.

The frames show random fields of the real sky through the simulator's default camera (1024 x 1024, 20 deg). A
ratio is the rms error divided by the bound of the 20 brightest stars, which ignores that stars overlap. The
table has the ratios of the whole rate vector, of the rate's magnitude, and of the mid-exposure positions of
the eight brightest stars. The NEES is 1 if the covariance is correct. No other study uses these seeds.

With `--known-sky` the stars are identified after the first fit, without prior attitude. The streaks are then
fitted again with all stars of the catalogue, as in flight; the results and times are those of the second fit.
"""

from __future__ import annotations

import sys
import time
from itertools import product
from typing import Annotated, Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.solve import SolveSettings, solve_motion
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.geometry import positions
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, Scene, real_sky
from tests.studies.command import Seed, Table, command

_SEED = 31_415
_SETTINGS = LikelihoodSettings(saturation=SATURATION, line_time=0.0)
_BRIGHT = 8


def estimated(scene: Scene, known_sky: bool) -> MotionResult:
    """Return the estimated motion of a frame; the true rate determines its sign.

    With `known_sky` the result is that of the second fit.
    """
    found = estimate_motion(scene.pixels, CAMERA.pinhole, scene.exposure, _SETTINGS, scene.rate, 0.0)
    if not known_sky or found.rate is None:
        return found
    sky, settings = default_index(), SolveSettings(likelihood=_SETTINGS)
    solution = solve_motion(found, CAMERA.pinhole, (1.0, 1.0), sky, settings)
    return refit_with_catalogue(scene.pixels, solution, sky, settings, _SETTINGS).motion or found


def rate_row(
    theta: float, length: float, exposure: float, frames: int, seed: int, faintest: float, known_sky: bool
) -> dict[str, Any]:
    """Return one row of the table of rates."""
    vector, magnitude, nees, places, times = [], [], [], [], []
    for frame in range(frames):
        scene = real_sky(seed + frame, theta, length, exposure, faintest=faintest)
        start = time.process_time()
        found = estimated(scene, known_sky)
        times.append(1e3 * (time.process_time() - start))
        if found.rate is None or found.covariance is None:
            continue
        bound, error = scene.bound(), found.rate - scene.rate
        axis = scene.rate / np.linalg.norm(scene.rate)
        vector.append(float(error @ np.linalg.solve(bound.covariance, error)) / 3.0)
        magnitude.append(float((error @ axis) ** 2 / (axis @ bound.covariance @ axis)))
        nees.append(float(error @ np.linalg.solve(found.covariance, error)) / 3.0)
        places.extend(_place_errors(found.stars, scene, bound.positions))
    rms = [float(np.sqrt(np.mean(values))) for values in (vector, magnitude, places)]
    return {
        "theta": float(np.rad2deg(theta)),
        "px": length,
        "s": exposure,
        "rates": f"{len(vector)}/{frames}",
        **dict(zip(("vector", "magnitude", "place"), rms, strict=True)),
        "median_place": float(np.sqrt(np.median(places) / np.log(2.0))),
        "NEES": float(np.mean(nees)),
        "median_ms": float(np.median(times)),
        "largest_ms": float(np.max(times)),
    }


def _place_errors(stars: FloatArray, scene: Scene, bounds: FloatArray) -> list[float]:
    """Return squared position errors of the brightest stars, divided by their bounds; 1 is expected.

    Streaks with both ends outside the image are omitted, because their position along the streak is
    undetermined.
    """
    out = []
    bright = scene.stars[:_BRIGHT]
    motion = CameraMotion.steady(scene.rate * scene.exposure)
    ended = np.zeros(len(bright), dtype=np.bool_)
    for end in (-0.5, 0.5):
        there = positions(CAMERA.pinhole, motion, bright, np.full(len(bright), end))
        ended |= CAMERA.pinhole.contains(there)
    for place, covariance in zip(bright[ended], bounds[:_BRIGHT][ended], strict=True):
        off = stars[np.argmin(np.linalg.norm(stars - place, axis=1))] - place
        if np.hypot(*off) < 5.0:
            out.append(float(off @ np.linalg.solve(covariance, off)) / 2.0)
    return out


@command
def main(
    *,
    frames: Annotated[int, "of a row"] = 10,
    seed: Seed = _SEED,
    faintest: Annotated[float, "magnitude V of the faintest stars in the sky"] = 8.5,
    theta: Annotated[tuple[float, ...], "deg"] = (90.0, 45.0, 10.0, 0.0),
    length: Annotated[tuple[float, ...], "px"] = (51.0, 102.0, 205.0, 512.0),
    exposure: Annotated[tuple[float, ...], "s"] = (0.2, 1.0),
    known_sky: Annotated[bool, "identify the stars and fit again"] = False,
) -> int:
    """Print the table."""
    sys.stdout.write(
        f"{frames} frames a row, seed {seed}, stars to V {faintest}; errors over the bound, rms\n"
    )
    table = Table()
    for each in product(np.deg2rad(theta).tolist(), length, exposure):
        table.add(**rate_row(*each, frames, seed, faintest, known_sky))
    return 0
