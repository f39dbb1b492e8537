"""Frames of stars with foregrounds or defects, and the solutions of the star tracker for them."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.images import read_image
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.solve import SolveSettings
from tests.knightcube.vision.startracker.frames import sky, sky_frame
from tests.knightcube.vision.startracker.spoilers import spoilt
from tests.support.photographs import FIELD_SHARE, NARROW_DEG, RIGHT_ARCSEC, angle_arcsec, believed, centre_of

_SEED = 14_009


_EXPOSURE = 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame with its true boresight (3,) and field of view in degrees."""

    source: str
    pixels: Image
    boresight: FloatArray
    field_deg: float


def rendered(frames: int, streak_px: float) -> Iterator[Scene]:
    """Yield random frames of the simulated camera with streaks of `streak_px` px (0 px are points)."""
    for number in range(frames):
        scene = sky_frame(np.random.default_rng([_SEED, number]), streak_px, _EXPOSURE)
        boresight = attitude_matrix(scene.attitude)[2]
        yield Scene("streaks" if streak_px else "rendered", scene.pixels, boresight, NARROW_DEG)


def photographed(folder: Path) -> Iterator[Scene]:
    """Yield the photographs in a folder with their true pointing."""
    for name, truth in json.loads((folder / "truth.json").read_text()).items():
        yield Scene("photographs", read_image(folder / name), centre_of(truth), truth["fov"])


def spoilt_scene(scene: Scene, kind: str, number: int) -> Scene:
    """Return a frame with the foreground or defect `kind`, whose random seed is `number`."""
    rng = np.random.default_rng([_SEED, number, zlib.crc32(kind.encode())])
    return Scene(scene.source, spoilt(scene.pixels, kind, rng), scene.boresight, scene.field_deg)


def found_boresight(scene: Scene) -> FloatArray | None:
    """Return the boresight (3,) that the star tracker finds, or None if it refuses the frame."""
    field = scene.field_deg
    camera, scale = believed(scene.pixels, field, field * (1.0 - FIELD_SHARE), field * (1.0 + FIELD_SHARE))
    found = solve_frame(scene.pixels, camera, scale, _EXPOSURE, sky(), SolveSettings())
    return None if found.fix is None else attitude_matrix(found.fix.quaternion)[2]


def is_right(scene: Scene, boresight: FloatArray) -> bool:
    return angle_arcsec(boresight, scene.boresight) <= RIGHT_ARCSEC
