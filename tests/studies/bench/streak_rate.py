"""Time and accuracy of the streak rate per length of streak: `python -m tests.studies.bench.streak_rate`.

Random star fields on the demonstration's camera (1024 x 1024, 20 deg, 1 s). Two errors are printed: of the
rate's magnitude, the thesis's rate metric (Table 3.1: 0.69 % at 102 px), and of the whole vector, which at
theta = 90 deg is larger, the boresight component being weak. Seeds of its own.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.streaks.corners.rate_fit import fit_rotation
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streak_rate import estimate_rate
from knightcube.vision.streaks.corners.streaks import measure_streaks, segment_frame
from knightcube.vision.streaks.streak_result import StreakStatus
from tests.knightcube.vision.streaks.frames import Camera, rate_at, star_camera, star_frame

_SEED = 27_182
_EXPOSURE = 1.0
_LENGTHS = (25.0, 50.0, 102.4, 200.0)


def stage_times(pixels: Image, camera: Camera, settings: StreakSettings) -> FloatArray:
    """Return seconds (4,) for segmentation, endpoints, fit, and the whole of `estimate_rate`."""
    marks = [time.perf_counter()]
    segmented = segment_frame(pixels, settings)
    marks.append(time.perf_counter())
    streaks = measure_streaks(segmented, settings)
    marks.append(time.perf_counter())
    fit_rotation(streaks.endpoints, streaks.sigma, camera.pinhole, settings)
    marks.append(time.perf_counter())
    estimate_rate(pixels, camera.pinhole, _EXPOSURE, settings)
    marks.append(time.perf_counter())
    return np.diff(marks)


def measure(camera: Camera, theta: float, length: float, frames: int, seed: int) -> str:
    """Return one row of the table: `frames` random frames with streaks of about `length` px."""
    settings = StreakSettings()
    times, errors, nees, used = [], [], [], []
    for frame in range(frames):
        roll = float(np.random.default_rng([seed, frame]).uniform(0.0, 2.0 * np.pi))
        rate = rate_at(theta, length / camera.pinhole.focal_length / np.sin(theta) / _EXPOSURE, roll)
        pixels = star_frame(camera, rate, _EXPOSURE, seed + frame)
        times.append(stage_times(pixels, camera, settings))
        result = estimate_rate(pixels, camera.pinhole, _EXPOSURE, settings, rate, 0.0)
        if result.status is not StreakStatus.RATE or result.rate is None or result.covariance is None:
            continue
        error, speed = result.rate - rate, np.linalg.norm(rate)
        errors.append((np.linalg.norm(result.rate) / speed - 1.0, np.linalg.norm(error) / speed))
        nees.append(error @ np.linalg.solve(result.covariance, error))
        used.append(result.used_count)
    magnitude, vector = 100.0 * np.sqrt(np.mean(np.square(errors), axis=0))
    stages = " ".join(f"{1e3 * t:6.1f}" for t in np.median(times, axis=0))
    return (
        f"{np.rad2deg(theta):5.0f} {length:6.1f} {len(errors):4d}/{frames:<3d} {np.mean(used):5.1f}"
        f"  {magnitude:8.3f} {vector:8.3f} {np.mean(nees):6.2f}   {stages}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10, help="frames per row (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    options = parser.parse_args()
    sys.stdout.write(
        f"{options.frames} frames a row, seed {options.seed}\n"
        "                           rms error, % of |w|        median ms of\n"
        "theta  px/exp  rates   used  magnitude  vector  NEES   segment  ends   fit  whole\n"
    )
    camera = star_camera()
    for theta in (90.0, 60.0, 30.0):
        for length in _LENGTHS:
            sys.stdout.write(measure(camera, np.deg2rad(theta), length, options.frames, options.seed) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
