"""Rates and objects in frames of calibrated lenses with strong distortion.

The independent renderer (`tests/support/supersampled.py`) draws real stars without objects, at exposures of
0.4 s and rotations of 10 and 30 % of the field. Each frame is evaluated with two lenses: the true lens with
the stated accuracy of a calibration, and the pinhole camera of the same field of view.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import Case
from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import CameraKnowledge, CameraModel, Lens
from knightcube.vision.objects.detect import detect_objects
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.estimate import estimate_rate
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns.imperfections import Imperfection
from tests.studies.campaigns.mismatch import TURNS, expose
from tests.studies.campaigns.statistics import squared_sigmas
from tests.studies.command import Seed, Table, command
from tests.support.scenes import FIELD
from tests.support.supersampled import Optics, gaussian

_EXPOSURE = 0.4
_CALIBRATED = CameraKnowledge(focal_length=2e-4, centre=0.2, distortion=2e-4)


def lens_of(camera: StarCameraModel, optics: Optics) -> Lens:
    """Return the lens model that is equivalent to the optics of the renderer."""
    pinhole = camera.pinhole
    square = (math.hypot(*pinhole.centre) / pinhole.focal_length) ** 2
    centre = pinhole.centre[0] + optics.offset[0], pinhole.centre[1] + optics.offset[1]
    return Lens(pinhole.columns, pinhole.rows, pinhole.focal_length, centre, optics.distortion / square)


def frame(optics: Optics, seed: int, number: int) -> tuple[Image, FloatArray]:
    """Return a frame with random pointing and axis, and its true rate (3,), rad/s."""
    theta = float(np.rad2deg(np.random.default_rng((seed, number)).uniform(0.0, 0.5 * np.pi)))
    parameters = {"theta": theta, "exposure": _EXPOSURE, "percent": TURNS[number % len(TURNS)]}
    return expose(Case(str(number), (seed, number, 1), parameters), Imperfection(optics))


def row(
    drawn: list[tuple[Image, FloatArray]], camera: CameraModel, settings: LikelihoodSettings
) -> dict[str, Any]:
    """Return availability, errors and false objects of the frames, evaluated with a camera model."""
    search = ObjectSettings(gain=settings.gain, saturation=settings.saturation)
    errors, claims, squares, objects = [], [], [], 0
    for image, rate in drawn:
        found = estimate_rate(image, camera, _EXPOSURE, prior_rate=rate, settings=settings)
        if found.rate is None or found.covariance is None:
            continue
        size = float(np.linalg.norm(rate))
        errors.append(float(np.linalg.norm(found.rate - rate)) / size)
        claims.append(math.sqrt(float(np.trace(found.covariance))) / size)
        squares.append(squared_sigmas(found.rate - rate, found.covariance))
        objects += len(detect_objects(image, camera, found.rate, _EXPOSURE, search).objects)
    return {
        "rates": len(errors),
        "error_%": 100.0 * float(np.median(errors)) if errors else math.nan,
        "claim_%": 100.0 * float(np.median(claims)) if errors else math.nan,
        "NEES": float(np.mean(squares)) if errors else math.nan,
        "largest_sigma": math.sqrt(max(squares, default=math.nan)),
        "false_objects": objects,
    }


@command
def main(
    *,
    frames: Annotated[int, "of a row"] = 20,
    seed: Seed = 5,
    distortion: Annotated[tuple[float, ...], "displacement of the corner, %"] = (-10.0, -4.0, 0.0, 4.0, 10.0),
    offset: Annotated[float, "of the optical axis along x and y, px"] = 10.0,
) -> int:
    """Print the table."""
    camera, table = StarCameraModel(field_of_view=FIELD), Table()
    settings = LikelihoodSettings(gain=camera.gain, saturation=float(camera.highest_count), line_time=0.0)
    sys.stdout.write(f"{frames} frames a row, seed {seed}\n")
    for percent in distortion:
        optics = Optics((gaussian(camera.psf_sigma),), distortion=0.01 * percent, offset=(offset, offset))
        drawn = [frame(optics, seed, number) for number in range(frames)]
        calibrated = replace(settings, knowledge=_CALIBRATED)
        lens = lens_of(camera, optics)
        table.add(**{"%": percent, "camera": "lens", **row(drawn, lens, calibrated)})
        table.add(**{"%": percent, "camera": "pinhole", **row(drawn, camera.pinhole, settings)})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
