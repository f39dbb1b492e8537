"""Detection of objects among long streaks, and its time: `python -m tests.studies.bench.object_turns`.

The camera of the simulator rotates by 10 to 30 % of its field within 0.5 s about a random axis. A frame has
no object, or one of the given magnitude that moves by 9 to 87 px relative to the stars, as in the campaign
`rso-orbits`. The search uses the rotation of the likelihood estimate. Only the search is timed, in processor
time.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.objects.detect import detect
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.settings import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns.rso import (
    EXPOSURE,
    FASTEST,
    MARGIN_PX,
    MATCH_PX,
    SLOWEST,
    Sky,
    ends_error,
)
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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=30, help="frames per row (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--percent", type=float, nargs="+", default=[10.0, 20.0, 30.0], help="of the field")
    parser.add_argument("--magnitude", type=float, nargs="+", default=[4.0, 5.0], help="of the object")
    parser.add_argument("--empty", action="store_true", help="frames without an object")
    options = parser.parse_args()
    camera, out = StarCameraModel(field_of_view=FIELD), sys.stdout
    out.write(f"{options.frames} frames a row, seed {options.seed}\n")
    out.write("  %    V   rates  found  others  error px  (error/claim)^2  CPU ms: median  95 %     max\n")
    # One search runs untimed, because the first search of a process also loads compiled code.
    pixels, rate, _ = frame(camera, (options.seed,), options.percent[0], None)
    looked(camera, pixels, rate, None)
    for percent in options.percent:
        for magnitude in [None] if options.empty else options.magnitude:
            seen = []
            for number in range(options.frames):
                seed = (options.seed, round(percent), number)
                pixels, rate, ends = frame(camera, seed, percent, magnitude)
                seen.append(looked(camera, pixels, rate, None if magnitude is None else ends))
            rates = [each for each in seen if each is not None]
            errors = [each.error for each in rates if each.error is not None]
            claims = [claim for each in rates for claim in each.claims]
            spent = np.array([each.spent for each in rates])
            out.write(
                f"{percent:3.0f} {'-' if magnitude is None else f'{magnitude:.1f}':>4s} {len(rates):7d}"
                f" {len(errors):6d} {sum(each.others for each in rates):7d}"
                f" {np.median(errors) if errors else np.nan:9.2f}"
                f" {np.mean(claims) if claims else np.nan:16.1f} {np.median(spent):15.0f}"
                f" {np.percentile(spent, 95.0):5.0f} {spent.max():7.0f}\n"
            )
            out.flush()


if __name__ == "__main__":
    main()
