"""Wide cameras by size: cost of a frame, the Sun found in it: `python -m tests.studies.bench wide_camera`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import numpy as np

from knightcube.vision.sun import SunSettings, find_sun
from sim_hal.earth_camera import EarthCameraModel, render
from tests.sim_hal.earth_camera.scenes import random_sun_scene
from tests.support.earth_truth import sun_direction

SIZES = (256, 384, 512)


def figures(size: int, frames: int, seed: int) -> tuple[float, float, int, float]:
    """Return CPU s to render and to search a frame, how many showed the Sun, and the median error, rad."""
    model, generator = EarthCameraModel.fuga15d(rows=size, columns=size), np.random.default_rng(seed)
    rendered = searched = 0.0
    errors = []
    for _ in range(frames):
        scene = random_sun_scene(generator, model)
        begin = time.process_time()
        frame = render(model, scene, generator)
        middle = time.process_time()
        solution = find_sun(frame, model.lens, SunSettings())
        rendered += middle - begin
        searched += time.process_time() - middle
        if solution.status.value == "found" and solution.sun is not None:
            errors.append(float(np.hypot(*(solution.sun.basis @ sun_direction(scene)))))
    return rendered / frames, searched / frames, len(errors), float(np.median(errors or [np.nan]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each size; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench wide_camera", description=__doc__)
    parser.add_argument("--frames", type=int, default=25, help="of each size, %(default)s by default")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    for size in SIZES:
        render_s, find_s, found, error = figures(size, options.frames, options.seed)
        sys.stdout.write(
            f"{size} x {size}: {1e3 * render_s:.0f} ms to simulate, {1e3 * find_s:.0f} ms to search, "
            f"{found} of {options.frames} found, median error {np.degrees(error):.4f} deg\n"
        )
    return 0
