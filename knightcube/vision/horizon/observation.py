"""One picture's edges as directions, and samples of where it is bright."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import CameraModel, Lens
from knightcube.vision.horizon.consensus import EdgeRays
from knightcube.vision.horizon.edges import Edges, ScanLines

_RIGHT: FloatArray = np.array([1.0, 0.0])
_DOWN: FloatArray = np.array([0.0, 1.0])
_SAMPLE = 32
"""px between samples along a line."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Pixels on the lines that were read: directions (m, 3), and whether they are bright (m,)."""

    rays: FloatArray
    bright: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Edges and samples as seen from the camera.

    Attributes:
        space: px between the lines that were read.
        edges: in pixels.
        rays: the same as directions.
        across, down: (n, 3) the ray's change over a pixel to the right, and downwards.
        samples: where it is bright.
    """

    space: float
    edges: Edges
    rays: EdgeRays
    across: FloatArray
    down: FloatArray
    samples: Samples


def observe(
    edges: Edges, lines: ScanLines, camera: CameraModel, samples: Samples | None = None
) -> Observation:
    """Return edges and samples as directions; edges outside the lens's image are excluded.

    `samples` replace those of the lines.
    """
    count = len(edges)
    rays = camera.unit_vectors(np.concatenate([edges.points, edges.points + _RIGHT, edges.points + _DOWN]))
    here = rays[:count]
    across, down = rays[count : 2 * count] - here, rays[2 * count :] - here
    seen = np.isfinite(here[:, 0]) & np.isfinite(across[:, 0]) & np.isfinite(down[:, 0])
    if not seen.all():
        edges, here, across, down = edges.chosen(seen), here[seen], across[seen], down[seen]
    brighter = edges.towards[:, :1] * across + edges.towards[:, 1:] * down
    return Observation(
        lines.space,
        edges,
        EdgeRays(here, brighter, np.sqrt(np.einsum("ij,ij->i", brighter, brighter))),
        across,
        down,
        _samples(lines, camera) if samples is None else samples,
    )


def _samples(lines: ScanLines, camera: CameraModel) -> Samples:
    bright = []
    for binary in (lines.column_bright, lines.row_bright):
        bright.append(binary[:, _along(binary.shape[1])].ravel())
    rays, imaged = _sample_rays(Lens.of(camera), tuple(lines.columns.tolist()), tuple(lines.rows.tolist()))
    return Samples(rays, np.concatenate(bright)[imaged])


def _along(size: int) -> IntArray:
    """Return the places of the samples along a line of `size` px."""
    return np.arange(_SAMPLE // 2, size, _SAMPLE * max(1, size // 512))


@lru_cache(maxsize=8)
def _sample_rays(
    camera: Lens, columns: tuple[int, ...], rows: tuple[int, ...]
) -> tuple[FloatArray, BoolArray]:
    """Return directions (m, 3) of the samples on those lines, and which of all of them the lens images.

    They are the same in frame after frame.
    """
    x, y = np.meshgrid(columns, _along(camera.rows), indexing="ij")
    other_y, other_x = np.meshgrid(rows, _along(camera.columns), indexing="ij")
    points = np.concatenate(
        [np.stack([x.ravel(), y.ravel()], axis=1), np.stack([other_x.ravel(), other_y.ravel()], axis=1)]
    )
    rays = camera.unit_vectors(points.astype(float))
    imaged = np.isfinite(rays[:, 0])
    return rays[imaged], imaged
