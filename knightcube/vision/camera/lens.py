"""A calibrated camera: a pinhole with radial distortion about its optical axis.

A direction of tangents u = (x/z, y/z) maps to the pixel f u (1 + k1 |u|^2 + k2 |u|^4) + centre (Brown 1966,
radial terms). Frame and pixels are those of `knightcube.vision.camera.pinhole`. Beyond the tangent where the
distorted radius stops growing the polynomial folds back on itself: nothing is imaged there, and a lens that
folds within its own detector is rejected.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.errors import FlightError
from knightcube.vision.camera.pinhole import Pinhole

_MOST_STEPS = 60
# Newton's error is of the order of its last step's square: 1e-8 in tangent leaves rounding.
_LAST_STEP = 1e-8
# A fold at a tangent of a million is ignored.
_NO_FOLD = 1e-12


class LensError(FlightError):
    """An impossible lens: no size, or a distortion that cannot be inverted."""


class CameraModel(Protocol):
    """The interface of `Pinhole` and `Lens`: directions to pixels and back."""

    @property
    def columns(self) -> int:
        """Pixels in a row."""

    @property
    def rows(self) -> int:
        """Pixels in a column."""

    @property
    def focal_length(self) -> float:
        """Pixels."""

    @property
    def centre(self) -> tuple[float, float]:
        """The pixel (x, y) on the optical axis."""

    @property
    def half_diagonal(self) -> float:
        """The angle in rad from the boresight to the farthest corner."""

    @property
    def ideal(self) -> Pinhole:
        """The pinhole of the same focal length, its axis in the middle."""

    def rescaled(self, factor: float) -> Self:
        """Return the camera with its focal length multiplied by `factor`."""

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; NaN where none is seen."""

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) in the camera frame of pixels (n, 2)."""

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixels (n, 2) lie on the detector, widened by `margin` pixels."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera of `columns` x `rows` pixels with radial distortion.

    Attributes:
        focal_length: px, of the axis.
        centre: the pixel (x, y) of the optical axis.
        k1, k2: of the second and the fourth power of the undistorted tangent.
        reach: the largest tangent that is imaged, infinite where the distortion never folds.

    Raises LensError when the distortion cannot be inverted over the whole detector.
    """

    columns: int
    rows: int
    focal_length: float
    centre: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    reach: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (self.columns > 0 and self.rows > 0 and 0.0 < self.focal_length < np.inf):
            raise LensError(
                f"{self.columns} x {self.rows} pixels, focal length {self.focal_length}: must be positive"
            )
        if not np.all(np.isfinite([*self.centre, self.k1, self.k2])):
            raise LensError(f"centre {self.centre}, k1 {self.k1}, k2 {self.k2}: must be finite")
        object.__setattr__(self, "reach", _reach(self.k1, self.k2))
        corner = float(np.max(np.hypot(*(self._corners() - self.centre).T))) / self.focal_length
        if corner >= self._limit():
            raise LensError(
                f"k1 {self.k1}, k2 {self.k2}: distortion folds the image back at"
                f" {self._limit() * self.focal_length:.0f} px from the axis, within the detector's"
                f" {corner * self.focal_length:.0f} px, and cannot be undone"
            )

    @classmethod
    def of(cls, camera: CameraModel) -> Lens:
        """Return `camera` as a lens; a pinhole becomes one without distortion."""
        if isinstance(camera, Lens):
            return camera
        return cls(camera.columns, camera.rows, camera.focal_length, camera.centre)

    def to_mapping(self) -> dict[str, int | float | list[float]]:
        """Return the lens as plain numbers for a YAML file: pixels, and k1, k2 of tangents."""
        return {
            "columns": int(self.columns),
            "rows": int(self.rows),
            "focal_length": float(self.focal_length),
            "centre": [float(x) for x in self.centre],
            "k1": float(self.k1),
            "k2": float(self.k2),
        }

    @property
    def ideal(self) -> Pinhole:
        """The pinhole of the same focal length, its axis in the middle."""
        return Pinhole(self.columns, self.rows, self.focal_length)

    def rescaled(self, factor: float) -> Lens:
        """Return the camera with its focal length multiplied by `factor`."""
        return replace(self, focal_length=self.focal_length * factor)

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; NaN behind it or beyond reach."""
        v = np.asarray(vectors, dtype=float)
        z = v[..., 2:]
        tangent = v[..., :2] / np.where(z > 0.0, z, np.nan)
        square = np.sum(tangent**2, axis=-1, keepdims=True)
        square = np.where(square <= self.reach**2, square, np.nan)
        stretched = tangent * (1.0 + square * (self.k1 + square * self.k2))
        return np.asarray(self.focal_length * stretched + np.array(self.centre))

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) in the camera frame of pixels (n, 2); NaN beyond the image's edge."""
        stretched = (np.asarray(points, dtype=float) - np.array(self.centre)) / self.focal_length
        radius = np.hypot(stretched[..., :1], stretched[..., 1:])
        square = self._undistorted(radius) ** 2
        v = np.empty((*stretched.shape[:-1], 3))
        v[..., :2] = stretched / (1.0 + square * (self.k1 + square * self.k2))
        v[..., 2] = 1.0
        return np.asarray(v / np.sqrt(1.0 + square))

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixels (n, 2) lie on the detector, widened by `margin` pixels; NaN does not."""
        return Pinhole(self.columns, self.rows, self.focal_length).contains(points, margin)

    @property
    def half_diagonal(self) -> float:
        """The angle in rad from the boresight to the detector's farthest corner."""
        return float(np.arccos(np.min(self.unit_vectors(self._corners())[:, 2])))

    def _corners(self) -> FloatArray:
        right, bottom = self.columns - 0.5, self.rows - 0.5
        return np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])

    def _limit(self) -> float:
        """Return the stretched tangent at the reach: the image's edge."""
        square = self.reach**2
        return self.reach * (1.0 + square * (self.k1 + square * self.k2)) if square < np.inf else np.inf

    def _undistorted(self, stretched: FloatArray) -> FloatArray:
        """Return the undistorted tangents, any shape; NaN beyond the image's edge.

        Newton's method from the distorted tangent, or from the curve's inflection if that is nearer the axis:
        from there it passes the root at most once and then approaches it from one side.
        """
        k1, k2 = self.k1, self.k2
        if k1 == k2 == 0.0:
            return stretched
        seen = stretched < self._limit()
        # A NaN must not affect when the iteration stops.
        target = np.where(seen, stretched, 0.0)
        inflection = np.sqrt(-0.3 * k1 / k2) if k1 * k2 < 0.0 else np.inf
        radius = np.minimum(target, inflection)
        slope1, slope2 = 3.0 * k1, 5.0 * k2
        for _ in range(_MOST_STEPS):
            square = radius * radius
            value = radius * (1.0 + square * (k1 + square * k2)) - target
            step = value / (1.0 + square * (slope1 + square * slope2))
            # No root is below zero, but a step from the inflection may be.
            radius = np.maximum(radius - step, 0.0)
            if np.vdot(step, step) < _LAST_STEP**2:
                break
        return np.where(seen, radius, np.nan)


def _reach(k1: float, k2: float) -> float:
    """Return the least tangent where r (1 + k1 r^2 + k2 r^4) stops growing: 1 + 3 k1 r^2 + 5 k2 r^4 = 0."""
    discriminant = 9.0 * k1 * k1 - 20.0 * k2
    if discriminant < 0.0 or (k1 >= 0.0 and k2 >= 0.0):
        return np.inf
    # The smaller positive root, without cancellation: for k2 = 0 it is -1/(3 k1).
    denominator = -3.0 * k1 + np.sqrt(discriminant)
    return float(np.sqrt(2.0 / denominator)) if denominator > _NO_FOLD else np.inf
