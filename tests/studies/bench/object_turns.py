"""Detection of objects among long streaks, and its time.

The camera of the simulator rotates by 10 to 30 % of its field within 0.5 s about a random axis. A frame has
no object, or an object of the given magnitude that moves by 9 to 87 px relative to the stars, as in the
campaign `rso-orbits`. The search uses the rotation of the likelihood estimate. Only the search is timed, in
processor time.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.objects.detect import detect
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns.rso import EXPOSURE, FASTEST, MARGIN_PX, MATCH_PX, SLOWEST, Sky, ends_error
from tests.studies.command import Seed, Table, command
from tests.support.scenes import FIELD, SAMPLES

_SEED = 27_182


@dataclass(frozen=True, slots=True)
class Looked:
    """Result of the object search in one frame.

    Attributes:
        error: error (px) of the true object's ends, or None if the object is not found.
        claims: squared errors (2,) of the two ends in claimed standard deviations, or None.
        others: number of false detections in the frame.
        spent: processor time, ms.
    """

    error: float | None
    claims: tuple[float, ...]
    others: int
    spent: float


def drawn(camera: StarCameraModel, generator: np.random.Generator, fraction: float) -> Sky:
    """Return a random pointing of a camera that rotates by `fraction` of its field, and an object in view."""
    pinhole = camera.pinhole
    while True:
        axis = normalise(generator.normal(size=3))
        rate = axis * fraction * camera.field_of_view / EXPOSURE
        times = np.linspace(0.0, EXPOSURE, SAMPLES)
        middle = normalise(generator.normal(size=4))
        since = (times - 0.5 * EXPOSURE)[:, None]
        attitudes = multiply(from_rotation_vector(since * rate), middle)
        place = generator.uniform(MARGIN_PX, camera.columns - MARGIN_PX, (1, 2))
        place = pinhole.unit_vectors(place)[0]
        speed = np.exp(generator.uniform(np.log(SLOWEST), np.log(FASTEST)))
        across = np.cross(place, generator.normal(size=3))
        motion = speed * across / np.linalg.norm(across)
        among_stars = np.swapaxes(attitude_matrix(from_rotation_vector(since * motion)), 1, 2) @ place
        directions = among_stars @ attitude_matrix(middle)
        path = pinhole.project((attitude_matrix(attitudes) @ directions[..., None])[..., 0])
        if np.all(pinhole.contains(path, -MARGIN_PX)):
            return Sky(rate, times, attitudes, directions, path)


def frame(
    camera: StarCameraModel, seed: tuple[int, ...], percent: float, magnitude: float | None
) -> tuple[Image, FloatArray, FloatArray]:
    """Return a frame, the camera's rate (3,), rad/s, and the object's streak ends (2, 2), px."""
    generator = np.random.default_rng(seed)
    sky = drawn(camera, generator, percent / 100.0)
    return sky.frame(camera, magnitude, generator), sky.rate, sky.path[[0, -1]]


def looked(
    camera: StarCameraModel, pixels: Image, rate: FloatArray, ends: FloatArray | None
) -> Looked | None:
    """Return the result of the search of a frame, or None if the frame has no rate estimate."""
    saturation = float(camera.highest_count)
    likelihood = LikelihoodSettings(saturation=saturation, gain=camera.gain, line_time=0.0)
    motion = estimate_motion(pixels, camera.pinhole, EXPOSURE, likelihood, rate, 0.0)
    if motion.rate is None:
        return None
    begun = time.process_time()
    settings = EndpointSettings(gain=camera.gain, saturation=saturation)
    objects = ObjectSettings(gain=camera.gain, saturation=saturation)
    report = detect(pixels, camera.pinhole, motion.rate * EXPOSURE, EXPOSURE, settings, objects)
    spent = 1e3 * (time.process_time() - begun)
    found = () if report is None else report.objects
    errors = [] if ends is None else [ends_error(item.endpoints, ends) for item in found]
    hits = [error for error in errors if error < MATCH_PX]
    claims: tuple[float, ...] = ()
    if ends is not None and hits:
        item = found[int(np.argmin(errors))]
        off = min(
            (np.linalg.norm(item.endpoints - truth, axis=1) for truth in (ends, ends[::-1])), key=np.max
        )
        claims = tuple(((off / item.sigma) ** 2).tolist())
    return Looked(min(hits, default=None), claims, len(found) - min(len(hits), 1), spent)


@command
def main(
    *,
    frames: Annotated[int, "of a row"] = 30,
    seed: Seed = _SEED,
    percent: Annotated[tuple[float, ...], "rotations, % of the field"] = (10.0, 20.0, 30.0),
    magnitude: Annotated[tuple[float, ...], "of the object"] = (4.0, 5.0),
    empty: Annotated[bool, "frames without an object"] = False,
) -> int:
    """Print the table."""
    camera, table = StarCameraModel(field_of_view=FIELD), Table()
    sys.stdout.write(f"{frames} frames a row, seed {seed}\n")
    # One search runs untimed, because the first search of a process also loads compiled code.
    pixels, rate, _ = frame(camera, (seed,), percent[0], None)
    looked(camera, pixels, rate, None)
    for part in percent:
        for size in (None,) if empty else magnitude:
            table.add(**_row(camera, frames, seed, part, size))
    return 0


def _row(
    camera: StarCameraModel, frames: int, seed: int, percent: float, magnitude: float | None
) -> dict[str, Any]:
    """Return the results of frames with one rotation and one magnitude."""
    found = []
    for number in range(frames):
        pixels, rate, ends = frame(camera, (seed, round(percent), number), percent, magnitude)
        one = looked(camera, pixels, rate, None if magnitude is None else ends)
        found += [] if one is None else [one]
    errors = [each.error for each in found if each.error is not None]
    claims = [claim for each in found for claim in each.claims]
    spent = np.array([each.spent for each in found])
    return {
        "%": percent,
        "V": "-" if magnitude is None else magnitude,
        "rates": len(found),
        "found": len(errors),
        "others": sum(each.others for each in found),
        "error_px": float(np.median(errors)) if errors else np.nan,
        "(error/claim)^2": float(np.mean(claims)) if claims else np.nan,
        "median_ms": float(np.median(spent)),
        "95_%_ms": float(np.percentile(spent, 95.0)),
        "largest_ms": float(spent.max()),
    }
