"""Time the star camera's image model: python -m tests.studies.bench.star_camera [--frames N] [--json]."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from knightcube.astro import catalogue, quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.star_camera import StarCameraModel, expected_electrons, render
from sim_hal.star_camera.detector import counts

BUDGET_MS = 60.0
EXPOSURE = 1.0

Result = TypeVar("Result")


def attitudes(rng: np.random.Generator, streak: float, samples: int) -> tuple[FloatArray, FloatArray]:
    """Return times and attitudes of a slew across the boresight that draws streaks of `streak` px."""
    start = quaternion.normalise(rng.standard_normal(4))
    axis = rng.standard_normal(2)
    axis /= np.linalg.norm(axis)
    turn = streak / StarCameraModel().pinhole.focal_length * np.array([axis[0], axis[1], 0.0])
    times = np.linspace(0.0, EXPOSURE, samples)
    eased = 0.7 * times + 0.3 * times**2  # the rate nearly doubles: nothing hangs on its being constant
    return times, quaternion.multiply(quaternion.from_rotation_vector(eased[:, None] * turn), start)


def timed(job: Callable[[], Result]) -> tuple[float, Result]:
    """Return how many ms `job` took and what it returned."""
    start = time.perf_counter()
    result = job()
    return 1e3 * (time.perf_counter() - start), result


def measure(frames: int, streak: float, samples: int, limit: float) -> dict[str, float]:
    """Return the medians in ms of rendering `frames` random fields."""
    model, rng = StarCameraModel(), np.random.default_rng(20)
    reading, stars = timed(catalogue.load)
    stars = stars.brighter_than(limit)
    field = (model, stars.directions_at(2026.0), stars.magnitude)
    cold, _ = timed(partial(render, *field, *attitudes(rng, streak, samples), rng))
    light_ms, noise_ms, frame_ms, lit = [], [], [], []
    for _ in range(frames):
        slew = attitudes(rng, streak, samples)
        spent, light = timed(partial(expected_electrons, *field, *slew))
        light_ms.append(spent)
        lit.append(np.count_nonzero(light > 1.0))
        noise_ms.append(timed(partial(counts, model, light.astype(np.float32), EXPOSURE, rng))[0])
        frame_ms.append(timed(partial(render, *field, *slew, rng))[0])
    return {
        "frames": frames,
        "streak_px": streak,
        "attitude_samples": samples,
        "stars": len(stars),
        "pixels_above_1_e": float(np.median(lit)),
        "catalogue_ms": reading,
        "first_frame_ms": cold,
        "light_ms": float(np.median(light_ms)),
        "noise_and_counts_ms": float(np.median(noise_ms)),
        "frame_ms": float(np.median(frame_ms)),
        "frame_least_ms": float(np.min(frame_ms)),
        "frame_p90_ms": float(np.percentile(frame_ms, 90)),
        "budget_ms": BUDGET_MS,
    }


def main() -> int:
    """Print the stages' medians; return 1 when the frame's is over budget."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench.star_camera", description=__doc__)
    parser.add_argument("--frames", type=int, default=40, help="random fields rendered (default 40)")
    parser.add_argument("--streak", type=float, default=90.0, help="length of the streaks, px (default 90)")
    parser.add_argument("--samples", type=int, default=201, help="attitude samples a frame (default 201)")
    parser.add_argument("--limit", type=float, default=9.0, help="faintest V rendered (default: all, to 8.5)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    result = measure(options.frames, options.streak, options.samples, options.limit)
    if options.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        for name, value in result.items():
            sys.stdout.write(f"{name:22} {value:12,.1f}\n")
    return 0 if result["frame_ms"] <= BUDGET_MS else 1


if __name__ == "__main__":
    sys.exit(main())
