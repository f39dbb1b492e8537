"""Camera models: the pinhole, the lens with radial distortion, the mounted camera, and their uncertainty.

Camera frame: boresight +z, x along columns to the right, y along rows down; pixel (0, 0) is the centre of
the top-left pixel. The pinhole follows Sease 2.1-2.4, corrected: stars behind the camera are dropped, and
pixel offsets count from 0.

The lens maps a direction with tangents u = (x/z, y/z) to the pixel f u (1 + k1 |u|^2 + k2 |u|^4) + centre
(Brown 1966, radial terms). Beyond the tangent where the distorted radius stops growing the polynomial folds
back on itself. The lens images nothing there, and a lens that folds within its own detector is rejected.

`Exposures` gives the exposure at which streaks are long enough for an accurate rate.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import FlightError


@dataclass(frozen=True, slots=True)
class Pinhole:
    """An ideal camera without distortion.

    Attributes:
        columns, rows: number of pixels.
        focal_length: px. `from_field_of_view` computes it from the field of view.
    """

    columns: int
    rows: int
    focal_length: float

    @classmethod
    def from_field_of_view(cls, columns: int, rows: int, field_of_view: float) -> Pinhole:
        """Return the camera whose columns span `field_of_view`, rad, edge to edge (Sease 2.4)."""
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
        """Return which pixels (n, 2) lie on the detector, widened by `margin` px; NaN does not."""
        x, y = points[..., 0], points[..., 1]
        inside_x = (x >= -0.5 - margin) & (x <= self.columns - 0.5 + margin)
        inside_y = (y >= -0.5 - margin) & (y <= self.rows - 0.5 + margin)
        return np.asarray(inside_x & inside_y)

    @property
    def half_diagonal(self) -> float:
        """The angle from the boresight to a corner of the detector, rad."""
        return float(np.arctan(0.5 * np.hypot(self.columns, self.rows) / self.focal_length))


_MOST_STEPS, _LAST_STEP = 60, 1e-8
"""Largest number of Newton steps, and the last step in tangent: the error is about its square."""
_NO_FOLD = 1e-12
"""Least denominator of a fold: a fold at a tangent of a million is ignored."""


class LensError(FlightError):
    """A lens without size, or with a distortion that cannot be inverted."""


class CameraModel(Protocol):
    """The interface of `Pinhole` and `Lens`, which convert between directions and pixels."""

    @property
    def columns(self) -> int:
        """The number of pixels in a row."""

    @property
    def rows(self) -> int:
        """The number of pixels in a column."""

    @property
    def focal_length(self) -> float:
        """The focal length, px."""

    @property
    def centre(self) -> tuple[float, float]:
        """The pixel (x, y) on the optical axis."""

    @property
    def half_diagonal(self) -> float:
        """The angle from the boresight to the farthest corner, rad."""

    @property
    def ideal(self) -> Pinhole:
        """The pinhole camera of the same focal length with its axis in the image centre."""

    def rescaled(self, factor: float) -> Self:
        """Return the camera with its focal length multiplied by `factor`."""

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; NaN if they are not imaged."""

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) in the camera frame of pixels (n, 2)."""

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixels (n, 2) lie on the detector, widened by `margin` px."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera of `columns` x `rows` pixels with radial distortion.

    Attributes:
        focal_length: focal length on the axis, px.
        centre: pixel (x, y) of the optical axis.
        k1, k2: coefficients of the second and the fourth power of the undistorted tangent.
        reach: largest tangent that is imaged; infinite if the distortion never folds.

    Raises:
        LensError: if the distortion cannot be inverted over the whole detector.
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
        """Return the lens as plain numbers for a YAML file: lengths in pixels, k1 and k2 of tangents."""
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
        """The pinhole camera of the same focal length with its axis in the image centre."""
        return Pinhole(self.columns, self.rows, self.focal_length)

    def rescaled(self, factor: float) -> Lens:
        """Return the camera with its focal length multiplied by `factor`."""
        return replace(self, focal_length=self.focal_length * factor)

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; NaN if they are not imaged."""
        v = np.asarray(vectors, dtype=float)
        z = v[..., 2:]
        tangent = v[..., :2] / np.where(z > 0.0, z, np.nan)
        square = np.sum(tangent**2, axis=-1, keepdims=True)
        square = np.where(square <= self.reach**2, square, np.nan)
        stretched = tangent * (1.0 + square * (self.k1 + square * self.k2))
        return np.asarray(self.focal_length * stretched + np.array(self.centre))

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) in the camera frame of pixels (n, 2); NaN if they are not imaged."""
        stretched = (np.asarray(points, dtype=float) - np.array(self.centre)) / self.focal_length
        radius = np.hypot(stretched[..., :1], stretched[..., 1:])
        square = self._undistorted(radius) ** 2
        v = np.empty((*stretched.shape[:-1], 3))
        v[..., :2] = stretched / (1.0 + square * (self.k1 + square * self.k2))
        v[..., 2] = 1.0
        return np.asarray(v / np.sqrt(1.0 + square))

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixels (n, 2) lie on the detector, widened by `margin` px; NaN does not."""
        return Pinhole(self.columns, self.rows, self.focal_length).contains(points, margin)

    @property
    def half_diagonal(self) -> float:
        """The angle from the boresight to the farthest corner of the detector, rad."""
        return float(np.arccos(np.min(self.unit_vectors(self._corners())[:, 2])))

    def _corners(self) -> FloatArray:
        right, bottom = self.columns - 0.5, self.rows - 0.5
        return np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])

    def _limit(self) -> float:
        """Return the distorted tangent of the edge of the image, where the true tangent is `reach`."""
        square = self.reach**2
        return self.reach * (1.0 + square * (self.k1 + square * self.k2)) if square < np.inf else np.inf

    def _undistorted(self, stretched: FloatArray) -> FloatArray:
        """Return the undistorted tangents (...) of distorted ones; NaN beyond the edge of the image.

        Newton's method starts at the distorted tangent, or at the inflection of the curve if that is nearer
        to the axis: from there it passes the root at most once and then approaches it from one side.
        """
        k1, k2 = self.k1, self.k2
        if k1 == k2 == 0.0:
            return stretched
        seen = stretched < self._limit()
        # A NaN must not affect the end of the iteration.
        target = np.where(seen, stretched, 0.0)
        inflection = np.sqrt(-0.3 * k1 / k2) if k1 * k2 < 0.0 else np.inf
        radius = np.minimum(target, inflection)
        slope1, slope2 = 3.0 * k1, 5.0 * k2
        for _ in range(_MOST_STEPS):
            square = radius * radius
            value = radius * (1.0 + square * (k1 + square * k2)) - target
            step = value / (1.0 + square * (slope1 + square * slope2))
            # A step from the inflection may lead below zero, but the root is not negative.
            radius = np.maximum(radius - step, 0.0)
            if np.vdot(step, step) < _LAST_STEP**2:
                break
        return np.where(seen, radius, np.nan)


def _reach(k1: float, k2: float) -> float:
    """Return the least tangent at which the distorted one stops growing: 1 + 3 k1 r^2 + 5 k2 r^4 = 0."""
    discriminant = 9.0 * k1 * k1 - 20.0 * k2
    if discriminant < 0.0 or (k1 >= 0.0 and k2 >= 0.0):
        return np.inf
    # The smaller positive root, without cancellation: for k2 = 0 it is -1/(3 k1).
    denominator = -3.0 * k1 + np.sqrt(discriminant)
    return float(np.sqrt(2.0 / denominator)) if denominator > _NO_FOLD else np.inf


def check_image(image: Image, camera: CameraModel) -> None:
    """Raise ValueError unless an image has the size (rows, columns) of a camera and finite pixels."""
    if image.shape != (camera.rows, camera.columns):
        size = " x ".join(str(number) for number in reversed(image.shape))
        raise ValueError(
            f"an image of {size} pixels, but the camera has {camera.columns} x {camera.rows}: "
            "give (rows, columns) of its size"
        )
    if image.dtype.kind == "f" and not np.all(np.isfinite(image)):
        raise ValueError("an image with pixels that are not finite")


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A lens and its mounting.

    Attributes:
        lens: the camera model.
        mounting: attitude of the camera (4,), body into camera axes.
        to_camera: its rotation matrix (3, 3).
    """

    lens: CameraModel
    mounting: FloatArray
    to_camera: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mounting", np.asarray(self.mounting, dtype=float))
        object.__setattr__(self, "to_camera", attitude_matrix(self.mounting))

    def in_camera(self, directions: FloatArray) -> FloatArray:
        """Return directions (..., 3), given in body axes, in camera axes."""
        return np.asarray(directions @ self.to_camera.T)

    def in_body(self, rays: FloatArray) -> FloatArray:
        """Return rays (..., 3), given in camera axes, in body axes."""
        return np.asarray(rays @ self.to_camera)


UNSTATED = 30e-6
"""Standard deviation (s) of the line time of a shutter without a description: 1,000 rows in 30 ms are
common."""


@dataclass(frozen=True, slots=True)
class CameraKnowledge:
    """Standard deviations of the true camera from its description; 0 if the description is exact.

    The defaults hold for a camera without calibration whose field of view is correct.

    Attributes:
        focal_length: relative standard deviation of the focal length.
        centre: standard deviation of the optical axis along x and along y, px.
        distortion: standard deviation of the displacement of a corner, relative to its radius.
        line_time: standard deviation of the delay between the exposures of successive rows, s. None: 0 if
            the delay is stated, otherwise `UNSTATED`.
    """

    focal_length: float = 0.0
    centre: float = 2.0
    distortion: float = 0.005
    line_time: float | None = None


EXACT = CameraKnowledge(centre=0.0, distortion=0.0, line_time=0.0)
"""Knowledge of a camera that equals its description, such as an emulated camera."""


_STREAK = 20.0
"""Desired streak length (px): rates are poor below 5 px, and faint stars are lost above 100 px."""
_POINT = 1.0
"""Motion in the usual exposure (px) below which a star is a point."""


@dataclass(frozen=True, slots=True)
class Exposures:
    """The exposure times of a camera.

    Attributes:
        usual: exposure for points, s.
        least, most: range of the exposures for streaks, s.
        scale: scale of the image, px per rad.
    """

    usual: float
    least: float
    most: float
    scale: float

    def at(self, rate: float) -> float:
        """Return the exposure, s, at an angular rate, rad/s, across the boresight."""
        speed = rate * self.scale
        if speed * self.usual < _POINT:
            return self.usual
        return min(max(_STREAK / speed, self.least), self.most)
