"""Processor time of a rendered frame of a horizon camera.

The camera is that of `config/orbit.yaml` (512 x 512 px, field of 92 deg). Positions, attitudes and Sun
directions are random; `in_view` is the fraction of frames that show the sunlit Earth. Two processes render
the same frames: one with the numpy forms, and one with the compiled forms (`knightcube.compiled`). `changed`
is the number of pixels per million whose counts differ from those of the numpy forms.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Annotated, Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.compiled import use_numpy_forms
from sim_hal.earth_camera import EarthCameraModel, EarthScene, expected_radiance, render
from tests.studies.command import Seed, Table, command

_SEED = 30_214
_ALTITUDE = 500e3


@dataclass(frozen=True, slots=True)
class Rendered:
    """Frames, fraction of frames that show the sunlit Earth, and processor time (ms) per frame."""

    frames: list[Image]
    in_view: float
    ms: float


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def scene_of(generator: np.random.Generator) -> EarthScene:
    """Return a scene with random position, attitude, Sun direction and rotation of the Earth."""
    position = (SEMI_MAJOR_AXIS + _ALTITUDE) * _unit(generator.standard_normal(3))
    attitude = _unit(generator.standard_normal(4))
    sun = ASTRONOMICAL_UNIT * _unit(generator.standard_normal(3))
    return EarthScene(position, attitude, sun, rotation=generator.uniform(0.0, 2.0 * np.pi))


def rendered(count: int, seed: int, field_deg: float) -> Rendered:
    """Render `count` random frames."""
    model = EarthCameraModel.fuga15d(field_of_view=np.radians(field_deg))
    generator = np.random.default_rng(seed)
    scenes = [scene_of(generator) for _ in range(count)]
    lit = [bool(expected_radiance(model, scene).max() > 1e-3) for scene in scenes]
    begin = time.process_time()
    frames = [render(model, scene, np.random.default_rng(number)) for number, scene in enumerate(scenes)]
    spent = time.process_time() - begin
    return Rendered(frames, float(np.mean(lit)), 1e3 * spent / count)


def rows(count: int, seed: int, field_deg: float) -> list[dict[str, Any]]:
    """Return the rows of the table, one for each form; each form runs in a process of its own."""
    found = []
    for name, prepare in (("numpy", use_numpy_forms), ("compiled", None)):
        with ProcessPoolExecutor(1, get_context("spawn"), prepare) as pool:
            found.append((name, pool.submit(rendered, count, seed, field_deg).result()))
    reference = np.stack(found[0][1].frames)
    return [
        {
            "form": name,
            "frames": count,
            "in_view": each.in_view,
            "ms": each.ms,
            "changed": 1e6 * float(np.mean(np.stack(each.frames) != reference)),
        }
        for name, each in found
    ]


@command
def main(
    *,
    frames: Annotated[int, "of each form"] = 60,
    seed: Seed = _SEED,
    field: Annotated[float, "field of view, deg"] = 92.0,
) -> int:
    """Print the table."""
    table = Table()
    for row in rows(frames, seed, field):
        table.add(**row)
    return 0
