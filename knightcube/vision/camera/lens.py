"""Camera models: pinhole, lens with distortion, mounted camera, and the uncertainties of a camera.

In the camera frame, the boresight is +z, x points right along the rows and y down along the columns; pixel
(0, 0) is the centre of the top-left pixel. The pinhole camera follows Sease, eq. (2.1) to (2.4), except that
stars behind the camera are dropped and pixel coordinates start at 0.

The lens projects a direction with tangents u = (x/z, y/z) onto the pixel f A d + centre with the distorted
tangents d = u (1 + k1 |u|^2 + k2 |u|^4) + (2 p1 u_x u_y + p2 (|u|^2 + 2 u_x^2), p1 (|u|^2 + 2 u_y^2) + 2 p2
u_x u_y) (Brown 1966, radial and tangential terms). The matrix A = ((1 + aspect, shear), (shear, 1 - aspect))
describes pixels that are not square. Beyond the field angle at which the distorted radius reaches its
maximum, the distortion polynomial folds back: two field angles give the same pixel. A `Lens` images no
direction beyond the fold of its distortion, and raises LensError if the fold lies within the detector. A
`DistortedPinhole` has the same image as a `Lens`, and also the derivatives of the distortion along the paths
of stars.

The class `Exposures` computes the exposure time at which streaks are long enough for an accurate rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from knightcube.astro.arrays import (
    BoolArray,
    FloatArray,
    Image,
    brief,
    check_numbers,
    checked_deviation,
    checked_number,
    finite_array,
    float_rows,
    unit_quaternion,
)
from knightcube.astro.quaternion import attitude_matrix
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import ArgumentError, KnightCubeError
from knightcube.vision.frame import grey_image


class LensError(KnightCubeError):
    """Error raised for a lens with invalid detector size, focal length or distortion parameters.

    The constructors `Lens` and `Pinhole` raise it, with the value and its range.
    """


_MOST_PIXELS = 1 << 24  # largest number of rows or columns


def _check_detector(camera: Pinhole | Lens) -> None:
    """Raise LensError unless the numbers of pixels are positive integers and the focal length is positive.

    Raises ArgumentError for values that are not numbers. Numbers such as 512.0 are converted to integers.
    """
    columns, rows, focal_length = camera.columns, camera.rows, camera.focal_length
    if not (_is_count(columns) and _is_count(rows) and isinstance(focal_length, float)):
        check_numbers(columns=columns, rows=rows, focal_length=focal_length)
    if not all(0 < count <= _MOST_PIXELS and count % 1 == 0 for count in (columns, rows)):
        raise LensError(f"{columns} x {rows} pixels: give positive whole numbers, {_MOST_PIXELS} at most")
    for name, count in (("columns", columns), ("rows", rows)):
        object.__setattr__(camera, name, int(count))
    if not 0.0 < focal_length < math.inf:
        raise LensError(f"focal length {focal_length} px: must be positive and finite")


def _is_count(value: object) -> bool:
    """Return whether a value is an integer that floats represent exactly."""
    return isinstance(value, int) and abs(value) < 1 << 53


@dataclass(frozen=True, slots=True)
class Pinhole:
    """An ideal camera without distortion.

    Attributes:
        columns, rows: number of pixels.
        focal_length: focal length, px.

    Raises:
        LensError: unless the numbers of pixels are positive integers and the focal length is positive.
    """

    columns: int
    rows: int
    focal_length: float

    def __post_init__(self) -> None:
        _check_detector(self)

    @classmethod
    def from_field_of_view(cls, columns: int, rows: int, field_of_view: float) -> Pinhole:
        """Return the camera whose image width spans `field_of_view`, rad, edge to edge (Sease, eq. (2.4)).

        Raises LensError unless the field of view lies between 0 and pi rad.
        """
        if not (_is_count(columns) and isinstance(field_of_view, float)):
            check_numbers(columns=columns, field_of_view=field_of_view)
        if not 0.0 < field_of_view < math.pi:
            degrees = math.pi <= field_of_view < 180.0
            hint = f"; {field_of_view:g} deg are {math.radians(field_of_view):.4g} rad" if degrees else ""
            raise LensError(f"field of view {field_of_view:g} rad: must be between 0 and pi rad{hint}")
        return cls(columns, rows, 0.5 * columns / np.tan(0.5 * field_of_view))

    @property
    def ideal(self) -> Pinhole:
        """The pinhole camera itself, because it has no distortion."""
        return self

    def rescaled(self, factor: float) -> Pinhole:
        """Return the camera with its focal length multiplied by `factor`."""
        check_numbers(factor=factor)
        return replace(self, focal_length=self.focal_length * factor)

    def binned(self, columns: int, rows: int, size: int) -> Pinhole:
        """Return the camera of `columns` x `rows` bins of `size` x `size` px, centred in the image."""
        return Pinhole(columns, rows, self.focal_length / checked_number("size", size, "pixels"))

    @property
    def centre(self) -> tuple[float, float]:
        """The pixel (x, y) on the boresight: (columns - 1)/2, (rows - 1)/2."""
        return 0.5 * (self.columns - 1), 0.5 * (self.rows - 1)

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; directions with z <= 0 give NaN."""
        v = float_rows("vectors", vectors, 3)
        z = np.where(v[..., 2:] > 0.0, v[..., 2:], np.nan)
        return np.asarray(self.focal_length * v[..., :2] / z + np.array(self.centre))

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) to pixels (n, 2), in the camera frame (Sease, eq. (3.20), (3.21))."""
        offset = (float_rows("points", points, 2) - np.array(self.centre)) / self.focal_length
        v = np.ones((*offset.shape[:-1], 3))
        v[..., :2] = offset
        v /= np.sqrt(np.einsum("...i,...i", v, v))[..., None]
        return v

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixel positions (n, 2) lie on the detector, widened by `margin` px; False for NaN."""
        check_numbers(margin=margin)
        points = float_rows("points", points, 2)
        x, y = points[..., 0], points[..., 1]
        inside_x = (x >= -0.5 - margin) & (x <= self.columns - 0.5 + margin)
        inside_y = (y >= -0.5 - margin) & (y <= self.rows - 0.5 + margin)
        return np.asarray(inside_x & inside_y)

    @property
    def half_diagonal(self) -> float:
        """The angle from the boresight to a corner of the detector, rad."""
        return float(np.arctan(0.5 * np.hypot(self.columns, self.rows) / self.focal_length))


_MOST_STEPS, _LAST_STEP = 60, 1e-8
"""Maximum number of Newton steps that invert the distortion, and tangent step below which they end."""
_NO_FOLD = 1e-12
"""Minimum denominator in the formula for the tangent at which the distortion folds the image back.

Folds at tangents above 1e6 are ignored.
"""


SHAPE_TERMS = ("aspect", "shear", "p1", "p2")
"""Names of the lens parameters that are not symmetric about the optical axis."""
_MOST_SHAPE = 0.3
"""Largest magnitude of aspect and shear."""
_MOST_TANGENTIAL, _TANGENTIAL_STEPS = 0.5, 40
"""Largest derivative of the tangential distortion at a corner, and maximum number of inversion iterations."""


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
        """The pinhole camera of the same focal length with its optical axis in the image centre."""

    def rescaled(self, factor: float) -> Self:
        """Return the camera with its focal length multiplied by `factor`."""

    def binned(self, columns: int, rows: int, size: int) -> Self:
        """Return the camera of `columns` x `rows` bins of `size` x `size` px, centred in the image."""

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; directions not imaged give NaN."""

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return the unit vectors (n, 3) from the camera to pixels (n, 2), in the camera frame."""

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixel positions (n, 2) lie on the detector, widened by `margin` px."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera of `columns` x `rows` pixels with distortion and pixels that need not be square.

    Attributes:
        focal_length: focal length on the axis, px.
        centre: pixel (x, y) of the optical axis.
        k1, k2: radial distortion coefficients of the second and the fourth power of the undistorted tangent.
        aspect, shear: half the relative difference between the image scales along x and y, and shear of the
            pixels.
        p1, p2: tangential distortion coefficients along y and along x.
        reach: largest undistorted tangent that is imaged; infinite if the distortion never folds back.

    Raises:
        LensError: if the distortion cannot be inverted over the whole detector.
    """

    columns: int
    rows: int
    focal_length: float
    centre: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    aspect: float = 0.0
    shear: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    reach: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _check_detector(self)
        if not (isinstance(self.centre, list | tuple | np.ndarray) and len(self.centre) == 2):
            raise ArgumentError("centre", f"{brief(self.centre)}: give the pixel (x, y) of the optical axis")
        x, y = self.centre
        given = {"centre[0]": x, "centre[1]": y, "k1": self.k1, "k2": self.k2}
        given |= {name: getattr(self, name) for name in SHAPE_TERMS}
        if not all(isinstance(value, float) for value in given.values()):
            check_numbers(**given)
        # Python floats are used, because numpy takes ten times as long for single numbers.
        if not all(map(math.isfinite, (*self.centre, self.k1, self.k2))):
            raise LensError(f"centre {self.centre}, k1 {self.k1}, k2 {self.k2}: must be finite")
        if not (abs(self.aspect) < _MOST_SHAPE and abs(self.shear) < _MOST_SHAPE):
            text = f"aspect {self.aspect}, shear {self.shear}"
            raise LensError(f"{text}: must be between -{_MOST_SHAPE} and {_MOST_SHAPE}")
        if not (math.isfinite(self.p1) and math.isfinite(self.p2)):
            raise LensError(f"p1 {self.p1}, p2 {self.p2}: must be finite")
        object.__setattr__(self, "reach", fold_of(self.k1, self.k2))
        corner = self._corner()
        if corner >= self._limit():
            raise LensError(
                f"k1 {self.k1}, k2 {self.k2}: distortion folds the image back at"
                f" {self._limit() * self.focal_length:.0f} px from the axis, but the detector extends to"
                f" {corner * self.focal_length:.0f} px"
            )
        if 6.0 * math.hypot(self.p1, self.p2) * corner > _MOST_TANGENTIAL:
            raise LensError(f"p1 {self.p1}, p2 {self.p2}: the distortion cannot be inverted at the corners")

    @classmethod
    def of(cls, camera: CameraModel) -> Lens:
        """Return a camera as a `Lens`; a pinhole camera becomes a lens without distortion."""
        check_camera(camera)
        if isinstance(camera, Lens):
            return camera
        return cls(camera.columns, camera.rows, camera.focal_length, camera.centre)

    def to_mapping(self) -> dict[str, int | float | list[float]]:
        """Return the parameters of the lens as plain numbers for a YAML file, with lengths in pixels."""
        return {
            "columns": int(self.columns),
            "rows": int(self.rows),
            "focal_length": float(self.focal_length),
            "centre": [float(x) for x in self.centre],
            "k1": float(self.k1),
            "k2": float(self.k2),
            **{name: float(value) for name in SHAPE_TERMS if (value := getattr(self, name)) != 0.0},
        }

    @property
    def ideal(self) -> Pinhole:
        """The pinhole camera of the same focal length with its optical axis in the image centre."""
        return Pinhole(self.columns, self.rows, self.focal_length)

    def rescaled(self, factor: float) -> Lens:
        """Return the camera with its focal length multiplied by `factor`."""
        check_numbers(factor=factor)
        return replace(self, focal_length=self.focal_length * factor)

    def binned(self, columns: int, rows: int, size: int) -> Lens:
        """Return the camera of `columns` x `rows` bins of `size` x `size` px, centred in the image."""
        check_numbers(columns=columns, rows=rows, size=checked_number("size", size, "pixels"))
        (x, y), focal_length = self.ideal.centre, self.focal_length / size
        x, y = (self.centre[0] - x) / size, (self.centre[1] - y) / size
        centre = x + 0.5 * (columns - 1), y + 0.5 * (rows - 1)
        return replace(self, columns=columns, rows=rows, focal_length=focal_length, centre=centre)

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; directions not imaged give NaN."""
        v = float_rows("vectors", vectors, 3)
        z = v[..., 2:]
        tangent = v[..., :2] / np.where(z > 0.0, z, np.nan)
        square = np.sum(tangent**2, axis=-1, keepdims=True)
        square = np.where(square <= self.reach**2, square, np.nan)
        stretched = tangent * (1.0 + square * (self.k1 + square * self.k2))
        if self.p1 != 0.0 or self.p2 != 0.0:
            stretched = stretched + self._tangential(tangent)
        if self.aspect != 0.0 or self.shear != 0.0:
            stretched = stretched @ self._pixels()
        return np.asarray(self.focal_length * stretched + np.array(self.centre))

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return the unit vectors (n, 3) of the rays through pixels (n, 2), in the camera frame.

        A pixel beyond the fold of the distortion gives NaN.
        """
        stretched = (float_rows("points", points, 2) - np.array(self.centre)) / self.focal_length
        if self.aspect != 0.0 or self.shear != 0.0:
            stretched = stretched @ np.linalg.inv(self._pixels())
        if self.p1 == self.p2 == 0.0:
            return self._radial_rays(stretched)
        rays = self._radial_rays(stretched)
        # Each step multiplies the error by at most the largest derivative of the tangential distortion.
        for _ in range(_TANGENTIAL_STEPS):
            before, rays = (
                rays,
                self._radial_rays(stretched - self._tangential(rays[..., :2] / rays[..., 2:])),
            )
            if not np.any(np.abs(rays - before) > _LAST_STEP**2):
                break
        return rays

    def _tangential(self, tangent: FloatArray) -> FloatArray:
        """Return the tangential distortion (..., 2) at undistorted normalised image coordinates (..., 2)."""
        x, y = tangent[..., 0], tangent[..., 1]
        cross, square = 2.0 * x * y, x * x + y * y
        right = self.p1 * cross + self.p2 * (square + 2.0 * x * x)
        return np.stack([right, self.p1 * (square + 2.0 * y * y) + self.p2 * cross], axis=-1)

    def _pixels(self) -> FloatArray:
        """Return the symmetric matrix A (2, 2) of pixels that are not square."""
        return np.array([[1.0 + self.aspect, self.shear], [self.shear, 1.0 - self.aspect]])

    def _radial_rays(self, stretched: FloatArray) -> FloatArray:
        """Return unit vectors (..., 3) of distorted tangents (..., 2) that contain only radial distortion."""
        radius = np.hypot(stretched[..., :1], stretched[..., 1:])
        square = self._undistorted(radius) ** 2
        v = np.empty((*stretched.shape[:-1], 3))
        v[..., :2] = stretched / (1.0 + square * (self.k1 + square * self.k2))
        v[..., 2] = 1.0
        return np.asarray(v / np.sqrt(1.0 + square))

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """Return which pixel positions (n, 2) lie on the detector, widened by `margin` px; False for NaN."""
        return Pinhole(self.columns, self.rows, self.focal_length).contains(points, margin)

    @property
    def half_diagonal(self) -> float:
        """The angle from the boresight to the farthest corner of the detector, rad."""
        if self.p1 == self.p2 == self.aspect == self.shear == 0.0:
            return math.atan(float(self._undistorted(np.array([self._corner()]))[0]))
        return float(np.arccos(np.min(self.unit_vectors(_corners(self.columns, self.rows))[:, 2])))

    def _corner(self) -> float:
        """Return the largest distance of a corner of the detector from the axis, in focal lengths."""
        x, y = self.centre
        across, down = (
            max(place + 0.5, side - 0.5 - place) for place, side in ((x, self.columns), (y, self.rows))
        )
        return math.hypot(across, down) / self.focal_length

    def _limit(self) -> float:
        """Return the distorted tangent of the field angle whose undistorted tangent is `reach`."""
        square = self.reach**2
        return self.reach * (1.0 + square * (self.k1 + square * self.k2)) if square < np.inf else np.inf

    def _undistorted(self, stretched: FloatArray) -> FloatArray:
        """Return the undistorted tangents of distorted tangents (...), or NaN beyond the fold."""
        if self.k1 == self.k2 == 0.0:
            return stretched
        flat = np.ascontiguousarray(stretched).ravel()
        found = _undistorted(flat, float(self.k1), float(self.k2), float(self._limit()))
        return found.reshape(stretched.shape)


def _undistorted_numpy(stretched: FloatArray, k1: float, k2: float, limit: float) -> FloatArray:
    """Return the undistorted tangents of distorted tangents (n,); tangents of at least `limit` give NaN.

    Newton's method starts at the distorted tangent, or at the inflection point of the distortion curve if
    that is nearer to the axis. From both initial values, Newton's method overshoots the root at most once and
    then converges from one side.
    """
    seen = stretched < limit
    # NaN is replaced by 0, because NaN would keep the iteration from converging.
    target = np.where(seen, stretched, 0.0)
    inflection = np.sqrt(-0.3 * k1 / k2) if k1 * k2 < 0.0 else np.inf
    radius = np.minimum(target, inflection)
    slope1, slope2 = 3.0 * k1, 5.0 * k2
    for _ in range(_MOST_STEPS):
        square = radius * radius
        value = radius * (1.0 + square * (k1 + square * k2)) - target
        step = value / (1.0 + square * (slope1 + square * slope2))
        # A Newton step from the inflection point may lead below zero, but the root is not negative.
        radius = np.maximum(radius - step, 0.0)
        if np.vdot(step, step) < _LAST_STEP**2:
            break
    return np.where(seen, radius, np.nan)


@compiled_form_of(_undistorted_numpy)
def _undistorted(stretched: FloatArray, k1: float, k2: float, limit: float) -> FloatArray:
    """See `_undistorted_numpy`."""
    out = np.full(len(stretched), np.nan)
    inflection = math.sqrt(-0.3 * k1 / k2) if k1 * k2 < 0.0 else np.inf
    for k in range(len(stretched)):
        if stretched[k] < limit:
            radius = min(stretched[k], inflection)
            for _ in range(_MOST_STEPS):
                square = radius * radius
                value = radius * (1.0 + square * (k1 + square * k2)) - stretched[k]
                step = value / (1.0 + square * (3.0 * k1 + square * 5.0 * k2))
                radius = max(radius - step, 0.0)
                if step * step < _LAST_STEP**2:
                    break
            out[k] = radius
    return out


def fold_of(k1: float, k2: float) -> float:
    """Return the smallest tangent r of a field angle at which the distorted radius has a maximum.

    The tangent r is the smallest positive root of 1 + 3 k1 r^2 + 5 k2 r^4 = 0, or infinite without a root.
    """
    discriminant = 9.0 * k1 * k1 - 20.0 * k2
    if discriminant < 0.0 or (k1 >= 0.0 and k2 >= 0.0):
        return math.inf
    # This formula for the smaller positive root r^2 avoids cancellation and is also valid for k2 = 0.
    denominator = -3.0 * k1 + math.sqrt(discriminant)
    return math.sqrt(2.0 / denominator) if denominator > _NO_FOLD else math.inf


# Largest change (px) in the last iteration that inverts the distortion, and maximum number of iterations.
_LAST_CHANGE = 1e-9
_MOST_INVERSIONS = 60

_Terms = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""Terms of the image errors of a `DistortedPinhole`, with lengths in px.

The terms are: image centre (x, y), displaced centre (x, y), `scale`, coefficients of the second and fourth
power of the distance, square of the distance of the fold, p1 and p2 divided by the focal length, aspect, and
shear.
"""


@dataclass(frozen=True, slots=True)
class DistortedPinhole(Pinhole):
    """A pinhole camera with the image errors of a lens: a point u of the ideal image moves to A d(u).

    Unlike a `Lens`, the camera has derivatives of the distortion, and images all directions in front of it.
    The distorted point is d(u) = u (1 + scale + cubic s + fourth s^2) + t(u), where u is the position
    relative to the image centre and s is the square of the ratio of |u| to the distance of the image corners.
    The matrix A and the tangential distortion t are those of `Lens`. Beyond the fold, at which the distorted
    distance has a maximum, the radial distortion is that of the fold, so that stars far outside the image do
    not appear in the image.

    Attributes:
        shift: displacement (x, y) of the image centre, px.
        scale: relative error of the focal length.
        cubic, fourth: relative displacement of the corner by the two terms of the radial distortion.
        tangential: coefficients (p1, p2) of the tangential distortion.
        shape: aspect and shear of the pixels.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    scale: float = 0.0
    cubic: float = 0.0
    fourth: float = 0.0
    tangential: tuple[float, float] = (0.0, 0.0)
    shape: tuple[float, float] = (0.0, 0.0)
    _terms: _Terms = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        Pinhole.__post_init__(self)
        (x, y), (right, down) = self.centre, self.shift
        square = x * x + y * y
        fold = fold_of(self.cubic / (1.0 + self.scale), self.fourth / (1.0 + self.scale)) ** 2 * square
        radial = self.scale, self.cubic / square, self.fourth / square**2, fold
        p1, p2 = (each / self.focal_length for each in self.tangential)
        terms = x, y, x + right, y + down, *radial, p1, p2, *self.shape
        object.__setattr__(self, "_terms", tuple(map(float, terms)))

    @classmethod
    def of(cls, camera: Pinhole | Lens) -> DistortedPinhole:
        """Return the `DistortedPinhole` that forms the same image as `camera`."""
        if isinstance(camera, DistortedPinhole):
            return camera
        if isinstance(camera, Pinhole):
            return cls(camera.columns, camera.rows, camera.focal_length)
        middle = camera.ideal.centre
        square = (math.hypot(*middle) / camera.focal_length) ** 2
        return cls(
            camera.columns,
            camera.rows,
            camera.focal_length,
            shift=(camera.centre[0] - middle[0], camera.centre[1] - middle[1]),
            cubic=camera.k1 * square,
            fourth=camera.k2 * square**2,
            tangential=(camera.p1, camera.p2),
            shape=(camera.aspect, camera.shear),
        )

    def binned(self, columns: int, rows: int, size: int) -> DistortedPinhole:
        """Return the camera of `columns` x `rows` bins of `size` x `size` px, centred in the image."""
        shift = self.shift[0] / size, self.shift[1] / size
        focal_length = self.focal_length / size
        return replace(self, columns=columns, rows=rows, focal_length=focal_length, shift=shift)

    @property
    def ideal(self) -> Pinhole:
        """The pinhole camera without the image errors."""
        return Pinhole(self.columns, self.rows, self.focal_length)

    @property
    def half_diagonal(self) -> float:
        """The angle from the axis to the farthest corner of the detector, rad."""
        away = self.undistorted(_corners(self.columns, self.rows)) - np.array(self.centre)
        return float(np.arctan(np.hypot(*away.T).max() / self.focal_length))

    def project(self, vectors: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of directions (n, 3) in the camera frame; directions with z <= 0 give NaN."""
        return self.distorted(Pinhole.project(self, vectors))

    def unit_vectors(self, points: FloatArray) -> FloatArray:
        """Return unit vectors (n, 3) to pixels (n, 2), in the camera frame."""
        return Pinhole.unit_vectors(self, self.undistorted(np.asarray(points, dtype=float)))

    def distorted(self, points: FloatArray) -> FloatArray:
        """Return the image positions (..., 2), px, with lens distortion, of ideal `points` (..., 2), px."""
        return _distorted(_rows(points), self._terms).reshape(points.shape)

    def undistorted(self, points: FloatArray) -> FloatArray:
        """Return the ideal positions (..., 2), px, of image `points` (..., 2), px, with lens distortion."""
        return _ideal_points(_rows(points), self._terms).reshape(points.shape)

    def image_motion(
        self, points: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the image positions, velocities and accelerations of ideal points, each (m, 2) px."""
        return _image_motion(_rows(points), _rows(velocity), _rows(acceleration), self._terms)

    def jacobian(self, points: FloatArray) -> FloatArray:
        """Return the Jacobian (m, 2, 2) of the lens distortion at ideal `points` (m, 2) px."""
        still = np.zeros(points.shape)
        columns = [self.image_motion(points, still + axis, still)[1] for axis in np.eye(2)]
        return np.stack(columns, axis=-1)


def _rows(points: FloatArray) -> FloatArray:
    """Return points (..., 2) as a contiguous array (m, 2), for compiled functions."""
    return np.ascontiguousarray(points, dtype=float).reshape(-1, 2)


def _radial_numpy(away: FloatArray, terms: _Terms) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return relative radial displacements (m, 1) at points (m, 2), px, and two derivatives of them.

    The points are relative to the image centre. The derivatives are the first and second with respect to the
    square of the distance from the centre.
    """
    scale, cubic, fourth, fold = terms[4:8]
    whole = np.einsum("ij,ij->i", away, away)[:, None]
    square = whole if fold == np.inf else np.minimum(whole, fold)
    growth, slope, change = (
        scale + square * (cubic + square * fourth),
        cubic + 2.0 * fourth * square,
        2.0 * fourth,
    )
    if fold == np.inf:
        return growth, slope, np.array(change)
    inside = whole < fold
    return growth, slope * inside, change * inside


def _tangential_numpy(one: FloatArray, other: FloatArray, terms: _Terms) -> FloatArray:
    """Return the symmetric bilinear form (m, 2), px, of the tangential distortion for two vectors (m, 2), px.

    Without tangential distortion, the result is a single zero.
    """
    if terms[8] == terms[9] == 0.0:
        return np.zeros(1)
    across = one[:, :1] * other[:, 1:] + one[:, 1:] * other[:, :1]
    own, cross, squares = np.array(terms[9:7:-1]), np.array(terms[8:10]), one * other
    return np.asarray(own * (np.sum(squares, axis=1, keepdims=True) + 2.0 * squares) + cross * across)


def _pixels_numpy(terms: _Terms) -> FloatArray:
    """Return the matrix A (2, 2) of pixels that are not square."""
    aspect, shear = terms[10:]
    return np.array([[1.0 + aspect, shear], [shear, 1.0 - aspect]])


def _distorted_numpy(points: FloatArray, terms: _Terms) -> FloatArray:
    away = points - np.array(terms[:2])
    moved = away * (1.0 + _radial_numpy(away, terms)[0]) + _tangential_numpy(away, away, terms)
    return np.asarray(moved @ _pixels_numpy(terms) + np.array(terms[2:4]))


@compiled_form_of(_distorted_numpy)
def _distorted(points: FloatArray, terms: _Terms) -> FloatArray:
    image = np.empty_like(points)
    for k in range(len(points)):
        x, y = points[k, 0] - terms[0], points[k, 1] - terms[1]
        growth, _, _ = _radial(x, y, terms)
        right, down = _tangential(x, y, x, y, terms)
        _set_point(image, k, x * (1.0 + growth) + right, y * (1.0 + growth) + down, terms)
        image[k, 0] += terms[2]
        image[k, 1] += terms[3]
    return image


def _image_motion_numpy(
    points: FloatArray, velocity: FloatArray, acceleration: FloatArray, terms: _Terms
) -> tuple[FloatArray, FloatArray, FloatArray]:
    away, pixels = points - np.array(terms[:2]), _pixels_numpy(terms)
    growth, slope, change = _radial_numpy(away, terms)
    whole = 1.0 + growth
    image = (whole * away + _tangential_numpy(away, away, terms)) @ pixels + np.array(terms[2:4])

    def along(step: FloatArray) -> FloatArray:
        """Return the directional derivative (m, 2) of the distortion for the displacements `step` (m, 2)."""
        closing = np.einsum("ij,ij->i", away, step)[:, None]
        radial = whole * step + 2.0 * slope * closing * away
        return np.asarray(radial + 2.0 * _tangential_numpy(away, step, terms))

    closing = np.einsum("ij,ij->i", away, velocity)[:, None]
    square = np.einsum("ij,ij->i", velocity, velocity)[:, None]
    bent = 2.0 * slope * (2.0 * closing * velocity + square * away) + 4.0 * change * closing**2 * away
    bent += 2.0 * _tangential_numpy(velocity, velocity, terms) + along(acceleration)
    return image, along(velocity) @ pixels, bent @ pixels


@compiled_form_of(_image_motion_numpy)
def _image_motion(
    points: FloatArray, velocity: FloatArray, acceleration: FloatArray, terms: _Terms
) -> tuple[FloatArray, FloatArray, FloatArray]:
    image, pace, bent = np.empty_like(points), np.empty_like(points), np.empty_like(points)
    for k in range(len(points)):
        x, y = points[k, 0] - terms[0], points[k, 1] - terms[1]
        u, v, a, b = velocity[k, 0], velocity[k, 1], acceleration[k, 0], acceleration[k, 1]
        growth, slope, change = _radial(x, y, terms)
        whole, closing, gained = 1.0 + growth, x * u + y * v, 2.0 * slope * (x * a + y * b)
        right, down = _tangential(x, y, x, y, terms)
        _set_point(image, k, whole * x + right, whole * y + down, terms)
        image[k, 0] += terms[2]
        image[k, 1] += terms[3]
        right, down = _tangential(x, y, u, v, terms)
        turned = 2.0 * slope * closing
        _set_point(pace, k, whole * u + turned * x + 2.0 * right, whole * v + turned * y + 2.0 * down, terms)
        outward = gained + 2.0 * slope * (u * u + v * v) + 4.0 * change * closing * closing
        right, down = _tangential(u, v, u, v, terms)
        right_too, down_too = _tangential(x, y, a, b, terms)
        bent_x = whole * a + outward * x + 2.0 * turned * u + 2.0 * (right + right_too)
        bent_y = whole * b + outward * y + 2.0 * turned * v + 2.0 * (down + down_too)
        _set_point(bent, k, bent_x, bent_y, terms)
    return image, pace, bent


def _ideal_points_numpy(points: FloatArray, terms: _Terms) -> FloatArray:
    shifted = points - np.array(terms[2:4])
    if terms[10] != 0.0 or terms[11] != 0.0:
        shifted = shifted @ np.linalg.inv(_pixels_numpy(terms))
    away = shifted
    for _ in range(_MOST_INVERSIONS):
        before = away
        moved = shifted - _tangential_numpy(before, before, terms)
        away = moved / (1.0 + _radial_numpy(before, terms)[0])
        if not np.any(np.abs(away - before) > _LAST_CHANGE):
            break
    return np.asarray(away + np.array(terms[:2]))


@compiled_form_of(_ideal_points_numpy)
def _ideal_points(points: FloatArray, terms: _Terms) -> FloatArray:
    out = np.empty_like(points)
    aspect, shear = terms[10], terms[11]
    scale = 1.0 / (1.0 - aspect * aspect - shear * shear)
    for k in range(len(points)):
        right, down = points[k, 0] - terms[2], points[k, 1] - terms[3]
        first = scale * ((1.0 - aspect) * right - shear * down)
        second = scale * ((1.0 + aspect) * down - shear * right)
        x, y = first, second
        for _ in range(_MOST_INVERSIONS):
            growth, _, _ = _radial(x, y, terms)
            along, across = _tangential(x, y, x, y, terms)
            before_x, before_y = x, y
            x, y = (first - along) / (1.0 + growth), (second - across) / (1.0 + growth)
            if not (abs(x - before_x) > _LAST_CHANGE or abs(y - before_y) > _LAST_CHANGE):
                break
        out[k, 0], out[k, 1] = x + terms[0], y + terms[1]
    return out


@loop_helper
def _radial(x: float, y: float, terms: _Terms) -> tuple[float, float, float]:
    """Return the values of `_radial_numpy` at one distance."""
    square, fold = x * x + y * y, terms[7]
    if square >= fold:
        return terms[4] + fold * (terms[5] + fold * terms[6]), 0.0, 0.0
    growth = terms[4] + square * (terms[5] + square * terms[6])
    return growth, terms[5] + 2.0 * terms[6] * square, 2.0 * terms[6]


@loop_helper
def _tangential(x: float, y: float, u: float, v: float, terms: _Terms) -> tuple[float, float]:
    """Return the values of `_tangential_numpy` for the vectors (x, y) and (u, v)."""
    p1, p2 = terms[8], terms[9]
    across, total = x * v + y * u, x * u + y * v
    return p2 * (total + 2.0 * x * u) + p1 * across, p1 * (total + 2.0 * y * v) + p2 * across


@loop_helper
def _set_point(points: FloatArray, k: int, x: float, y: float, terms: _Terms) -> None:
    """Set row k of `points` to A (x, y)."""
    aspect, shear = terms[10], terms[11]
    points[k, 0] = (1.0 + aspect) * x + shear * y
    points[k, 1] = shear * x + (1.0 - aspect) * y


def streak_camera(camera: CameraModel) -> Pinhole:
    """Return the model of `camera` for paths of stars: a lens becomes a `DistortedPinhole`."""
    return camera if isinstance(camera, Pinhole) else DistortedPinhole.of(Lens.of(camera))


def _corners(columns: int, rows: int) -> FloatArray:
    """Return the positions (4, 2), px, of the corners of a detector."""
    right, bottom = columns - 0.5, rows - 0.5
    return np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])


def check_camera(camera: CameraModel) -> None:
    """Raise ArgumentError unless `camera` is a `Pinhole` or a `Lens`."""
    if not isinstance(camera, Pinhole | Lens):
        raise ArgumentError("camera", f"{brief(camera)}: give a Pinhole or a Lens")


def image_of_camera(image: Image, camera: CameraModel) -> Image:
    """Return an image of a camera as grey values (rows, columns), as `grey_image` does.

    Raises ArgumentError unless the image has the size of the camera, and finite real numbers as pixels.
    """
    check_camera(camera)
    image = grey_image(image)
    check_shape(image, camera)
    return image


def check_shape(image: Image, camera: CameraModel, name: str = "image") -> None:
    """Raise ArgumentError unless the array `name` has the shape (rows, columns) of a camera."""
    if image.shape != (camera.rows, camera.columns):
        raise ArgumentError(
            name,
            f"an array of shape {image.shape}, but the camera has {camera.columns} x {camera.rows} pixels: "
            f"give ({camera.rows}, {camera.columns}) {'grey values' if name == 'image' else 'values'}",
        )


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A camera model and the attitude of the camera in the body.

    Attributes:
        lens: the camera model.
        mounting: unit quaternion (4,) from body axes to camera axes.
        to_camera: rotation matrix (3, 3) from body axes to camera axes.
    """

    lens: CameraModel
    mounting: FloatArray
    to_camera: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mounting", unit_quaternion("mounting", self.mounting))
        object.__setattr__(self, "to_camera", attitude_matrix(self.mounting))

    def in_camera(self, directions: FloatArray) -> FloatArray:
        """Transform directions (..., 3) from body axes to camera axes."""
        return np.asarray(directions @ self.to_camera.T)

    def in_body(self, rays: FloatArray) -> FloatArray:
        """Transform rays (..., 3) from camera axes to body axes."""
        return np.asarray(rays @ self.to_camera)


UNSTATED = 30e-6
"""Standard deviation (s) of an unknown line time of a rolling shutter, for a typical readout time of 30 ms.
"""


@dataclass(frozen=True, slots=True)
class CameraKnowledge:
    """Standard deviations of the stated parameters of a camera; 0 for parameters that are exact.

    The defaults hold for an uncalibrated camera whose stated field of view is correct.

    Attributes:
        focal_length: relative standard deviation of the focal length.
        centre: standard deviation of the optical axis's position along x and along y, px.
        distortion: standard deviation of the distortion at an image corner, relative to half the diagonal.
        line_time: standard deviation of the delay between the exposures of successive rows, s. A `line_time`
            of None means 0 if the camera's line time is stated, otherwise `UNSTATED`.
        covariance: covariance (5, 5) of the lens parameters if they were estimated from frames: relative
            focal length, optical axis along x and y, distortion, and line time, in the units of the other
            attributes. If the covariance is None, the errors are independent.
        psf_sigma: standard deviation of the width of the point spread function, px.
    """

    focal_length: float = 0.0
    centre: float = 2.0
    distortion: float = 0.005
    line_time: float | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    psf_sigma: float = 0.0

    def binned(self, size: int) -> CameraKnowledge:
        """Return the standard deviations for images that are binned by `size` px."""
        covariance = self.covariance
        if covariance is not None:
            unit = np.array([1.0, 1.0 / size, 1.0 / size, 1.0, size])
            covariance = tuple(map(tuple, (np.array(covariance) * np.outer(unit, unit)).tolist()))
        line_time = None if self.line_time is None else self.line_time * size
        centre, psf_sigma = self.centre / size, self.psf_sigma / size
        return replace(self, centre=centre, line_time=line_time, covariance=covariance, psf_sigma=psf_sigma)


_DEVIATIONS = {"focal_length": "(relative)", "centre": "px", "distortion": "(relative)"}
_DEVIATIONS |= {"line_time": "s", "psf_sigma": "px"}
"""Units of the standard deviations in `CameraKnowledge`, by the name of the attribute."""


def check_knowledge(name: str, knowledge: object) -> None:
    """Raise ArgumentError unless the argument `name` is a `CameraKnowledge` with valid deviations."""
    if not isinstance(knowledge, CameraKnowledge):
        text = f"{brief(knowledge)}: give a CameraKnowledge, as CameraKnowledge(**accuracy)"
        raise ArgumentError(name, text)
    for each, unit in _DEVIATIONS.items():
        if (value := getattr(knowledge, each)) is not None:
            checked_deviation(f"{name}.{each}", value, unit)
    if knowledge.covariance is not None:
        finite_array(f"{name}.covariance", knowledge.covariance, (5, 5))


EXACT = CameraKnowledge(centre=0.0, distortion=0.0, line_time=0.0)
"""Standard deviations of a camera whose parameters are exact, such as an emulated camera."""


_STREAK = 20.0
"""Desired streak length (px).

Rates are inaccurate below 5 px, and faint stars are undetectable above 100 px.
"""
_POINT = 1.0
"""Motion (px) of a star during the usual exposure time below which the star is treated as a point."""


@dataclass(frozen=True, slots=True)
class Exposures:
    """The exposure times of a camera.

    Attributes:
        usual: exposure time while stars appear as points, s.
        least, most: shortest and longest exposure time while stars appear as streaks, s.
        scale: image scale at the boresight, px/rad.
    """

    usual: float
    least: float
    most: float
    scale: float

    def at(self, rate: float) -> float:
        """Return the exposure time, s, for an angular `rate`, rad/s, about axes normal to the boresight."""
        speed = rate * self.scale
        if speed * self.usual < _POINT:
            return self.usual
        return min(max(_STREAK / speed, self.least), self.most)
