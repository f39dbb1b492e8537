"""Whether the body shook during the exposure: what all streaks have in common that a smooth motion has not.

A jitter moves all stars alike. Across their paths it shows as a displacement common to all streaks at one
time, along them as a common change of brightness, where the motion lingers or hurries. Residuals are stacked
over the stars by the time of the exposure; only products of different stars are summed, so that what one star
has of its own, a neighbour hidden in its light, adds nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from knightcube.vision.streaks.maximum_likelihood.left_over import LeftOver
from knightcube.vision.streaks.maximum_likelihood.motion import paths
from knightcube.vision.streaks.maximum_likelihood.scene import Scene
from knightcube.vision.streaks.maximum_likelihood.strips import LINES

_BINS = 48
# What is common must exceed chance by this many deviations to be believed.
_SIGNIFICANT = 4.0


@dataclass(frozen=True, slots=True)
class Shaking:
    """What the streaks have in common beyond a smooth motion, rms; 0 where chance explains it.

    Attributes:
        across: px, displacement across the paths.
        along: relative change of brightness along them.
    """

    across: float = 0.0
    along: float = 0.0


def find_shaking(camera: ExposedCamera, scene: Scene, left: LeftOver) -> Shaking:
    """Return what the trusted streaks of a fit have in common; nothing where none is long."""
    if not len(left.star):
        return Shaking()
    time, star = left.time, left.star
    stars = scene.stars[star]
    velocity = paths(camera.pinhole, scene.motion, np.repeat(stars, LINES, axis=0), time.reshape(-1)).velocity
    tangent = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    light = scene.light[star, None]
    place = np.clip(((time + 0.5) * _BINS).astype(np.int64), 0, _BINS - 1).reshape(-1)
    within = (np.abs(time) < 0.5).reshape(-1)
    owner = np.repeat(star, LINES)
    found = []
    for image, way in ((left.images[:, 1], normal), (left.images[:, 0], tangent)):
        score = (light * np.sum(left.weight * left.residual * image, axis=2)).reshape(-1)
        information = (light**2 * np.sum(left.weight * image * image, axis=2)).reshape(-1)
        cell = (owner * _BINS + place)[within]
        found.append(_common(cell, score[within, None] * way[within], information[within]))
    return Shaking(*found)


def _common(cell: IntArray, score: FloatArray, information: FloatArray) -> float:
    """Return the rms of what all stars ask for in common, 0 when it may be chance.

    `cell` (m,) numbers star and time; `score` (m, 2) and `information` (m,) of lines are summed.
    """
    size = (int(cell.max()) // _BINS + 1) * _BINS if len(cell) else 0
    if size < 2 * _BINS:
        return 0.0
    own = np.stack([np.bincount(cell, score[:, axis], size) for axis in (0, 1)], axis=-1)
    own = own.reshape(-1, _BINS, 2)
    known = np.bincount(cell, information, size).reshape(-1, _BINS)
    # A star by itself says as much as its own scatter allows: its model errors are not noise.
    scatter = np.sum(own**2, axis=(1, 2)) / np.maximum(known.sum(axis=1), 1e-30)
    trust = 1.0 / np.maximum(scatter, 1.0)
    own, known = own * trust[:, None, None], known * trust[:, None]
    square = np.sum(own**2, axis=2)
    common = float(np.sum(np.sum(own, axis=0) ** 2) - square.sum())
    chance = float(np.sqrt(2.0 * np.sum(square.sum(axis=0) ** 2 - np.sum(square**2, axis=0))))
    weight = float(np.sum(known.sum(axis=0) ** 2 - np.sum(known**2, axis=0)))
    if weight <= 0.0 or common <= _SIGNIFICANT * chance:
        return 0.0
    return float(np.sqrt(common / weight))
