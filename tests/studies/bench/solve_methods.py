"""Attitude solvers and centroid methods on the same frames.

The frames show real stars to V 8.5 at rest (1024 x 1024, 12 deg, 0.2 s). With each centroid method the stars
are identified once. Each attitude solver of `flight solve --attitude` and Delabie's image matching (AIM) then
use the same positions. The lens is known. The table has the errors across and about the boresight (arcsec rms
per axis), the NEES of three axes divided by three (1 if the covariance is correct), and the processor times
(ms) of finding and measuring the stars, and of identification, image fit and solver.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import numpy as np

from ground.campaigns.runner import show
from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.attitude.wahba import Solver
from knightcube.astro.quaternion import conjugate, multiply, normalise, to_rotation_vector
from knightcube.reference.star_identification import match_images
from knightcube.vision.startracker.detect import detect
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.solve import SolveSettings, solve_points
from knightcube.vision.startracker.survey import CENTROIDS, DetectionSettings
from sim_hal.star_camera import StarCameraModel
from tests.studies.command import Json, Seed, command
from tests.support.scenes import YEAR, exposed

_SEED = 41_207
_FIELD = np.radians(12.0)
_EXPOSURE = 0.2
_IMAGE = "image"
_SOLVERS: dict[str, Solver] = {**SOLVERS, "aim": match_images}
_ARCSECONDS = float(np.degrees(3600.0))


@dataclass(frozen=True, slots=True)
class Row:
    """Results of one attitude solver with one centroid method."""

    centroid: str
    attitude: str
    frames: int
    solved: int
    across: float
    about: float
    nees: float
    solve_ms: float
    detect_ms: float


def compare(frames: int, seed: int) -> list[Row]:
    """Return a row for each centroid method and solver, over the same frames."""
    camera, sky = StarCameraModel(field_of_view=_FIELD), default_index().at(YEAR)
    turns: defaultdict[tuple[str, str], list[FloatArray]] = defaultdict(list)
    nees: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    spent: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    for frame in range(frames):
        generator = np.random.default_rng((seed, frame))
        scene = exposed(camera, normalise(generator.normal(size=4)), np.zeros(3), _EXPOSURE, generator)
        for centroid in CENTROIDS:
            detection = DetectionSettings(method=centroid)
            begin = time.process_time()
            found = detect(scene.pixels, detection).stars()
            spent[centroid, ""].append(time.process_time() - begin)
            for attitude in (_IMAGE, *_SOLVERS):
                settings = replace(SolveSettings(detection=detection), attitude=_SOLVERS.get(attitude))
                begin = time.process_time()
                solution = solve_points(found, camera.pinhole, (1.0, 1.0), sky, settings)
                spent[centroid, attitude].append(time.process_time() - begin)
                if solution.fix is not None:
                    turn = to_rotation_vector(
                        multiply(solution.fix.quaternion, conjugate(scene.attitudes[0]))
                    )
                    turns[centroid, attitude].append(turn)
                    squared = float(turn @ np.linalg.solve(solution.fix.covariance, turn))
                    nees[centroid, attitude].append(squared / 3.0)
    rows = []
    for key in ((centroid, attitude) for centroid in CENTROIDS for attitude in (_IMAGE, *_SOLVERS)):
        if key in turns:
            rms = _ARCSECONDS * np.sqrt(np.mean(np.square(turns[key]), axis=0))
            across, about = float(np.sqrt(0.5 * (rms[0] ** 2 + rms[1] ** 2))), float(rms[2])
            ms = [1e3 * float(np.median(spent[each])) for each in (key, (key[0], ""))]
            rows.append(Row(*key, frames, len(turns[key]), across, about, float(np.mean(nees[key])), *ms))
    return rows


@command
def main(*, frames: Annotated[int, "of each method"] = 60, seed: Seed = _SEED, json: Json = False) -> int:
    """Print the table."""
    rows = [asdict(row) for row in compare(frames, seed)]
    show({"frames": frames, "seed": seed, "rows": rows}, json)
    return 0
