"""Sample pictures as inputs of other commands. The simulator renders each picture from known parameters.

The pictures are rendered on demand, because 12-bit noise cannot be compressed, and because stored pictures
would be outdated after a change of the simulator. Pictures rendered with the same seed are identical.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.catalogue import load
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix, from_matrix, from_rotation_vector, multiply
from knightcube.errors import UsageError, reason_of
from knightcube.vision.camera.images import write_picture
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.sky_map import Pointing
from sim_hal import earth_camera, star_camera

PIXELS, FIELD_DEG = 768, 15.0
YEAR = 2026.5
STILL_S, TURNING_S = 0.5, 0.4
RATE = (0.035, -0.02, 0.015)
"""Rotation rate (rad/s) of the camera in camera axes, which makes streaks of 47 px."""
ORION = Pointing(math.radians(83.8), math.radians(-1.2), math.radians(20.0))
EARTH_PIXELS, EARTH_FIELD_DEG, ALTITUDE_KM = 512, 67.0, 515.0


@dataclass(frozen=True, slots=True, eq=False)
class SamplePicture:
    """A sample image, its true parameters, and an example command; `{}` stands for the image file."""

    name: str
    pixels: Image
    truth: dict[str, Any]
    words: str


def write_samples(
    folder: Path, seed: int, progress: Callable[[str], None]
) -> list[tuple[Path, SamplePicture]]:
    """Render all samples into an existing folder and return the files. Raises UsageError."""
    written = []
    for number, (name, make) in enumerate(_MAKERS.items()):
        progress(name)
        sample = make(name, np.random.default_rng([seed, number]))
        written.append((folder / f"{name}.png", sample))
        write_picture(written[-1][0], sample.pixels)
    return written


def _stars(name: str, generator: np.random.Generator) -> SamplePicture:
    return _sky(name, generator, ORION.quaternion(), np.zeros(3), STILL_S)


def _night(name: str, generator: np.random.Generator) -> SamplePicture:
    """Render stars at a random attitude, for the calibration command."""
    attitude = generator.standard_normal(4)
    return _sky(name, generator, attitude / np.linalg.norm(attitude), np.zeros(3), STILL_S)


def _streaks(name: str, generator: np.random.Generator) -> SamplePicture:
    """Render Orion with a rotating camera, and a satellite that moves among the stars."""
    satellite = _satellite(ORION.quaternion())
    sample = _sky(name, generator, ORION.quaternion(), np.array(RATE), TURNING_S, [satellite])
    prior = " ".join(f"{component:g}" for component in RATE)
    words = f"rate {{}} --fov {FIELD_DEG:g} --exposure {TURNING_S:g} --prior {prior}"
    return replace(sample, words=words)


def _limb(name: str, generator: np.random.Generator) -> SamplePicture:
    """Render the Earth's limb by day from a low orbit, with the boresight 8 deg below the limb."""
    lens = Pinhole.from_field_of_view(EARTH_PIXELS, EARTH_PIXELS, math.radians(EARTH_FIELD_DEG))
    model = earth_camera.EarthCameraModel(
        lens=lens, rows=EARTH_PIXELS, columns=EARTH_PIXELS, response="linear", seed=1
    )
    radius = SEMI_MAJOR_AXIS + 1e3 * ALTITUDE_KM
    zenith, ahead = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.8, 0.6])
    angle = math.asin(SEMI_MAJOR_AXIS / radius) - math.radians(8.0)
    boresight = -math.cos(angle) * zenith + math.sin(angle) * ahead
    across = np.cross(-zenith, boresight)
    across /= np.linalg.norm(across)
    attitude = from_matrix(np.stack([across, np.cross(boresight, across), boresight]))
    turned = multiply(from_rotation_vector(np.array([0.0, 0.0, 0.2])), attitude)
    sun = ASTRONOMICAL_UNIT * np.array([0.8, -0.6, 0.0])
    scene = earth_camera.EarthScene(radius * zenith, turned, sun, texture=3)
    pixels = earth_camera.render(model, scene, generator)
    truth = {"nadir_camera": earth_camera.nadir(scene).tolist(), "altitude_km": ALTITUDE_KM}
    words = f"horizon {{}} --fov {EARTH_FIELD_DEG:g} --altitude {ALTITUDE_KM:g}"
    return SamplePicture(name, pixels, truth, words)


_MAKERS: dict[str, Callable[[str, np.random.Generator], SamplePicture]] = {
    "stars": _stars,
    "streaks": _streaks,
    "limb": _limb,
    **{f"night-{number}": _night for number in range(1, 5)},
}


def _sky(
    name: str,
    generator: np.random.Generator,
    attitude: FloatArray,
    rate: FloatArray,
    exposure: float,
    extra: list[star_camera.SourceTrack] | None = None,
) -> SamplePicture:
    """Return the sky with `attitude` (4,) at mid-exposure and a rate (3,), rad/s."""
    times = np.linspace(0.0, exposure, 41)
    turns = from_rotation_vector((times[:, None] - 0.5 * exposure) * rate)
    stars, attitudes = load(), multiply(turns, attitude)
    model = star_camera.StarCameraModel(columns=PIXELS, rows=PIXELS, field_of_view=math.radians(FIELD_DEG))
    sky = stars.directions_at(YEAR), stars.magnitude
    pixels = star_camera.render(model, *sky, times, attitudes, generator, extra or [])
    truth = sky_truth(rate, exposure, attitude, model.pinhole.focal_length)
    return SamplePicture(name, pixels, truth, f"solve {{}} --fov {FIELD_DEG:g}")


def _satellite(attitude: FloatArray) -> star_camera.SourceTrack:
    """Return an object of magnitude 3 near the image centre that moves by 25 mrad/s among the stars."""
    seen = np.array([[0.03, 0.02, 1.0], [0.03, 0.03, 1.0]])
    directions = seen @ attitude_matrix(attitude)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return star_camera.SourceTrack(np.array([0.0, TURNING_S]), directions, 3.0)


def sky_truth(rate: FloatArray, exposure: float, attitude: FloatArray, focal_length: float) -> dict[str, Any]:
    """Return the true parameters of a frame as plain numbers for a JSON file.

    The camera rotates at `rate` (3,), rad/s, in camera axes. The attitude (4,) from ICRS to the camera is
    that at mid-exposure. The focal length is in px.
    """
    pointing = Pointing.of(attitude)
    return {
        "rate_rad_s": [float(component) for component in rate],
        "exposure_s": exposure,
        "attitude": [float(component) for component in attitude],
        "right_ascension_deg": math.degrees(pointing.right_ascension),
        "declination_deg": math.degrees(pointing.declination),
        "roll_deg": math.degrees(pointing.roll),
        "streak_px": float(np.hypot(rate[0], rate[1])) * exposure * focal_length,
    }


def write_truth(path: Path, truth: dict[str, Any]) -> None:
    """Write the true parameters of a picture as JSON. Raises UsageError if the file cannot be written."""
    try:
        path.write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {reason_of(error)}") from error
