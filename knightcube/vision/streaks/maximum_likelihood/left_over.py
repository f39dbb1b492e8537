"""What a fit leaves over on its trusted streaks' pixels, and by how much their ends may be displaced for it.

A point spread that is not the model's, wider along the streak than across it or of another shape, leaves
light over at the ends of all streaks alike, and moves them alike. How much it moves them is not seen; were
all that is left over a displacement, its size in px is what this module gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera, Fit
from knightcube.vision.streaks.maximum_likelihood.normal_equations import shapes
from knightcube.vision.streaks.maximum_likelihood.scene import Scene

# Residuals beyond this many sigmas and this part of their line's brightest pixel are another's light.
_FOREIGN_SIGMAS = 5.0
_FOREIGN_SHARE = 0.6
# Pixels on which an end's displacement shows at least by this part of where it shows most.
_SHOWN = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class LeftOver:
    """The trusted streaks' blocks of pixels, and what the model leaves over there.

    Attributes:
        star: (b,) index into the scene; time: (b, LINES) at which the path crosses the line.
        images: (b, IMAGES, LINES, k); weight, residual: (b, LINES, k).
    """

    star: IntArray
    time: FloatArray
    images: Float32Array
    weight: Float32Array
    residual: Float32Array


def left_over(camera: ExposedCamera, fit: Fit) -> LeftOver:
    """Return what the fit leaves over on the strips of its trusted streaks."""
    scene, windows = fit.scene, fit.windows
    images, spots, _ = shapes(camera.pinhole, camera.shutter, scene, windows)
    of_block = windows.long[windows.strips.star]
    light = images[:, 0] * scene.light[of_block, None, None].astype(np.float32)
    peak = light.max(axis=2, keepdims=True, initial=0.0)
    light += scene.sky[of_block, None, None].astype(np.float32)
    spot_light = spots * scene.light[windows.spot, None, None] + scene.sky[windows.spot, None, None]
    weight, residual = windows.on_strips.residual(windows.total(light, spot_light), 0.0)
    with np.errstate(divide="ignore"):
        foreign = np.abs(residual) > _FOREIGN_SIGMAS / np.sqrt(weight) + _FOREIGN_SHARE * peak
    weight[foreign] = 0.0
    chosen = np.flatnonzero(scene.trusted[of_block])
    return LeftOver(
        of_block[chosen], windows.strips.time[chosen], images[chosen], weight[chosen], residual[chosen]
    )


@dataclass(frozen=True, slots=True)
class Displacement:
    """By how many px something would be displaced were all that is left over about it a displacement, rms.

    Attributes:
        shown: what is left over beyond chance; chance: what may be, beside noise.
    """

    shown: float
    chance: float


def displaced_ends(left: LeftOver, scene: Scene) -> Displacement | None:
    """Return the displacement of the ends along the paths; None where no streak shows an end."""
    change = _light(left, scene) * (left.images[:, 3] + left.images[:, 4])
    near = _shown(left, change)
    elsewhere = (left.weight > 0.0) & ~near
    squares = left.weight * left.residual * left.residual
    usual = float(np.mean(squares[elsewhere], dtype=np.float64)) if elsewhere.any() else 1.0
    return _displacement(left, squares, change, near, min(usual, 1.0))


def displaced_sides(left: LeftOver, scene: Scene) -> Displacement | None:
    """Return the displacement across the paths, away from their ends; None without a streak."""
    light = _light(left, scene)
    change = np.abs(light * left.images[:, 1])
    along = _shown(left, change) & ~_shown(left, light * (left.images[:, 3] + left.images[:, 4]))
    return _displacement(left, left.weight * left.residual * left.residual, change, along, 1.0)


def _light(left: LeftOver, scene: Scene) -> Float32Array:
    return scene.light[left.star, None, None].astype(np.float32)


def _shown(left: LeftOver, change: Float32Array) -> BoolArray:
    """Return on which pixels in use a `change` of the light shows."""
    most = change.max(axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray((left.weight > 0.0) & (change > _SHOWN * most))


def _displacement(
    left: LeftOver, squares: Float32Array, change: Float32Array, on: BoolArray, usual: float
) -> Displacement | None:
    """Return the displacement that the residuals' `squares` on some pixels amount to; `usual` each by noise.

    `change` is that of the light by a px.
    """
    count = int(np.count_nonzero(on))
    information = float(np.sum((left.weight * change * change)[on], dtype=np.float64))
    if not count or information <= 0.0:
        return None
    beyond = float(np.sum(squares[on], dtype=np.float64)) - count * usual
    chance = float(np.sqrt(2.0 * count))
    return Displacement(
        float(np.sqrt(max(beyond - 2.0 * chance, 0.0) / information)),
        float(np.sqrt((max(beyond, 0.0) + chance) / information)),
    )
