"""Faint streaks of the real sky, found and false: `python -m tests.studies.bench endpoints`.

The sky to V 8.5 on the simulator's default camera, theta uniform over 0 to 90 deg, about 20 to 200 px a
frame. Of the stars of magnitude 4 to 6 with whole streaks of 20 to 200 px, twenty a frame are looked for;
found is a streak with both ends within 5 px. False is a streak whose middle lies on no true star's path, of
any magnitude, cut by the border or not; misplaced is one on a star's path whose ends are not that near to any
star's: faint light is known to a few px along its streak, and two stars that overlap are one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.quaternion import normalise
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.streaks.scenes import turn_of
from tests.studies.bench.streaks import estimated
from tests.support.scenes import FIELD, Scene, exposed

EXPOSURE = 0.2
WANTED = 20
_MAGNITUDES = (4.0, 6.0)
_LENGTHS = (20.0, 200.0)
# px: between the ends of a streak found and those of its star, and from a streak's middle to a star's path.
_SAME = 5.0
_ON_PATH = 3.0


def faint_frame(frame: int, seed: int) -> dict[str, Any]:
    """Return how many of 20 faint streaks of one frame of the real sky are found, and how many false."""
    camera = StarCameraModel(field_of_view=FIELD)
    rng = np.random.default_rng((seed, frame, 2))
    theta, length = rng.uniform(0.0, 0.5 * np.pi), rng.uniform(*_LENGTHS)
    rate = turn_of(theta, length, rng.uniform(0.0, 2.0 * np.pi), camera) / EXPOSURE
    while True:
        scene = exposed(camera, normalise(rng.normal(size=4)), rate, EXPOSURE, rng)
        faint = _faint_stars(scene, camera)
        if len(faint) >= WANTED:
            break
    wanted = rng.choice(faint, WANTED, replace=False)
    found = estimated(scene.pixels, rate, EXPOSURE, camera)
    seen = np.concatenate([found.endpoints, found.faint_endpoints])
    true = np.stack([scene.start, scene.end], axis=1)
    worst = np.linalg.norm(seen[:, None] - true, axis=-1).max(axis=-1)
    near = np.where(np.isfinite(worst), worst, np.inf) < _SAME
    missed = wanted[~near[:, wanted].any(axis=0)]
    lit = _on_a_path(seen.mean(axis=1), scene)
    return {
        "theta": float(np.rad2deg(theta)),
        "length": length,
        "status": found.status.value,
        "found": WANTED - len(missed),
        "false": int(np.count_nonzero(~lit & ~near.any(axis=1))),
        "misplaced": int(np.count_nonzero(lit & ~near.any(axis=1))),
        "seen": len(seen),
        "missed": [
            {"magnitude": float(scene.magnitude[k]), "length": float(np.linalg.norm(true[k, 1] - true[k, 0]))}
            for k in missed
        ],
    }


def _on_a_path(points: FloatArray, scene: Scene) -> BoolArray:
    """Return which points (n, 2) px lie on the path of any star."""
    on = np.zeros(len(points), dtype=np.bool_)
    for first, last in ((scene.start, scene.middle), (scene.middle, scene.end)):
        chord = last - first
        part = np.einsum("nmk,mk->nm", points[:, None] - first, chord) / np.sum(chord**2, axis=1)
        nearest = first + np.clip(part, 0.0, 1.0)[..., None] * chord
        # A star behind the camera has NaN, which is near to nothing.
        on |= (np.linalg.norm(points[:, None] - nearest, axis=-1) < _ON_PATH).any(axis=1)
    return on


def _faint_stars(scene: Scene, camera: StarCameraModel) -> IntArray:
    """Return the stars (k,) of magnitude 4 to 6 whose streaks are whole and of the length asked for."""
    pinhole = camera.pinhole
    length = np.linalg.norm(scene.middle - scene.start, axis=1) + np.linalg.norm(
        scene.end - scene.middle, axis=1
    )
    chosen = (scene.magnitude >= _MAGNITUDES[0]) & (scene.magnitude <= _MAGNITUDES[1])
    chosen &= (length >= _LENGTHS[0]) & (length <= _LENGTHS[1])
    for place in (scene.start, scene.middle, scene.end):
        chosen &= pinhole.contains(place, -4.0)
    return np.asarray(np.flatnonzero(chosen))
