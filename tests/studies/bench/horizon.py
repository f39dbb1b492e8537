"""Time and accuracy of nadir from frames of the Earth's limb: `python -m tests.studies.bench horizon`.

The frames of the campaign `nadir`, each timed `--repeats` times on one core by processor time, the least
taken: what the method needs, without what others on the machine do to its caches. The stages are the parts
of one look.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.horizon.edges import find_edges, observe
from knightcube.vision.horizon.nadir import find_nadir
from sim_hal.earth_camera import nadir, render
from tests.sim_hal.earth_camera.scenes import random_scene
from tests.studies.campaigns.nadir import VIEWS
from tests.support.limb_frames import camera_model, coarse_knowledge, finder_settings

BUDGET_MS = 5.0
_SEED = 606

Result = TypeVar("Result")


def least(job: Callable[[], Result], repeats: int) -> tuple[float, Result]:
    """Return the least ms of processor time that `job` took, and what it returned."""
    spent = []
    for _ in range(repeats):
        begun = time.process_time()
        result = job()
        spent.append(1e3 * (time.process_time() - begun))
    return min(spent), result


def measure(view: str, frames: int, repeats: int, seed: int) -> FloatArray:
    """Return for each frame (frames, 4): ms of edges, of their rays, of the whole; error in deg or NaN."""
    model = camera_model()
    settings = finder_settings(model, "known")
    found = []
    for frame in range(frames):
        generator = np.random.default_rng((seed, VIEWS.index(view), frame))
        scene = random_scene(generator, model, view)  # type: ignore[arg-type]  # one of VIEWS
        pixels = render(model, scene, generator)
        knowledge = coarse_knowledge(scene, generator)
        edges_ms, (edges, lines) = least(partial(find_edges, pixels, settings.edges), repeats)
        rays_ms, _ = least(partial(observe, edges, lines, model.lens), repeats)
        whole_ms, solution = least(partial(find_nadir, pixels, model.lens, knowledge, settings), repeats)
        error = np.nan
        if solution.nadir is not None:
            error = float(np.degrees(np.arccos(min(1.0, float(solution.nadir.direction @ nadir(scene))))))
        found.append((edges_ms, rays_ms, whole_ms, error))
    return np.array(found)


def main() -> int:
    """Print the table; return 1 when the median frame is over budget."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40, help="of each view (default %(default)s)")
    parser.add_argument("--repeats", type=int, default=5, help="of each frame (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    sys.stdout.write(
        f"{options.frames} frames a view, seed {options.seed}; ms of processor, least of {options.repeats}\n"
        "view         edges   rays  whole: median    p95    max   answers  rms deg\n"
    )
    medians = []
    for view in VIEWS:
        table = measure(view, options.frames, options.repeats, options.seed)
        edges, rays, whole = np.median(table[:, :3], axis=0)
        p95, most = np.quantile(table[:, 2], [0.95, 1.0])
        errors = table[np.isfinite(table[:, 3]), 3]
        sys.stdout.write(
            f"{view:11} {edges:6.2f} {rays:6.2f} {whole:14.2f} {p95:6.2f} {most:6.2f} {len(errors):9d}"
            f"  {np.sqrt(np.mean(errors**2)):.4f}\n"
        )
        sys.stdout.flush()
        medians.append(whole)
    return 0 if max(medians) <= BUDGET_MS else 1


if __name__ == "__main__":
    sys.exit(main())
