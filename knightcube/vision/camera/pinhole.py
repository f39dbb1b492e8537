"""Pinhole camera geometry: unit vectors in the camera frame to pixels and back.

Camera frame: boresight +z, x along columns to the right, y along rows down; pixel (0, 0) is the centre of
the top-left pixel. Sease 2.1-2.4 corrected (stars behind the camera dropped, 0-based pixel offset).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Pinhole:
    """An ideal camera: `columns` x `rows` pixels, focal length in pixels."""

    columns: int
    rows: int
    focal_length: float

    @classmethod
    def from_field_of_view(cls, columns: int, rows: int, field_of_view: float) -> Pinhole:
        """Return the camera whose columns span `field_of_view` rad, edge to edge (Sease 2.4)."""
        return cls(columns, rows, 0.5 * columns / np.tan(0.5 * field_of_view))

    @property
    def ideal(self) -> Pinhole:
        """The camera itself, which has no distortion."""
        return self

    def rescaled(self, factor: float) -> Pinhole:
        """Return the camera with its focal length multiplied by `factor`."""
        return Pinhole(self.columns, self.rows, self.focal_length * factor)

    @property
    def centre(self) -> tuple[float, float]:
        """The pixel (x, y) on the boresight: (columns - 1)/2, (rows - 1)/2."""
        return 0.5 * (self.columns - 1), 0.5 * (self.rows - 1)

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; those with z <= 0 become NaN."""
        v = np.asarray(vectors, dtype=float)
        z = np.where(v[..., 2:] > 0.0, v[..., 2:], np.nan)
        return np.asarray(self.focal_length * v[..., :2] / z + np.array(self.centre))

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) in the camera frame of pixels (n, 2) (Sease 3.20, 3.21)."""
        offset = (np.asarray(points, dtype=float) - np.array(self.centre)) / self.focal_length
        v = np.concatenate([offset, np.ones((*offset.shape[:-1], 1))], axis=-1)
        return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Tell which pixels (n, 2) lie on the detector, widened by `margin` pixels; NaN does not."""
        x, y = points[..., 0], points[..., 1]
        inside_x = (x >= -0.5 - margin) & (x <= self.columns - 0.5 + margin)
        inside_y = (y >= -0.5 - margin) & (y <= self.rows - 0.5 + margin)
        return np.asarray(inside_x & inside_y)

    @property
    def half_diagonal(self) -> float:
        """The angle in rad from the boresight to the detector's corner."""
        return float(np.arctan(0.5 * np.hypot(self.columns, self.rows) / self.focal_length))
