"""Image model of a wide-angle camera that views Earth and Sun from a low orbit.

    model = EarthCameraModel.fuga15d(seed=1)
    scene = EarthScene(position, attitude, sun_position(julian_date))
    frame = render(model, scene, generator)

The unit of radiance is the radiance of a white Lambertian surface with the Sun at the zenith, so the radiance
of the Sun's disc is 46,000.

`sim_hal.earth_light` describes the light of ground and air.

The optics blur the Earth's image by a narrow Gaussian and scatter a little light over the whole frame. The
Sun's disc has limb darkening, can be hidden by the Earth, and is dimmed by the atmosphere. Scattering in the
optics causes the Sun's glare. The detector has a response curve, noise and fixed-pattern noise, and outputs
counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import correlate1d, gaussian_filter

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro import quaternion
from knightcube.astro.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    Image,
    IntArray,
    cross_product,
    tangent_basis,
)
from knightcube.astro.earth.figure import semi_axes
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import CameraModel, Lens, Pinhole
from sim_hal.earth_light import Atmosphere, EarthIntersection, air_tables, intersect, light, map_noise
from sim_hal.star_camera.image import standard_normal

_SCENE = "Earth scene"


@dataclass(frozen=True, slots=True, eq=False)
class EarthScene:
    """Positions and attitudes of camera, Earth and Sun at one instant.

    Attributes:
        position: geocentric position (3,) of the camera, m, ICRS.
        attitude: quaternion (4,) of the camera, ICRS into camera axes.
        sun: geocentric position (3,) of the Sun, m, ICRS.
        pole: unit vector (3,) to the Earth's pole, ICRS. The default is 0.15 deg from the true pole in 2026.
        rotation: rotation angle of the Earth about its pole, rad.
        texture: random seed of the map of land, sea and cloud.
        atmosphere: the air.

    Raises OutOfRange for a camera inside the Earth, and ValueError for arrays that are not finite or have the
    wrong shape.
    """

    position: FloatArray
    attitude: FloatArray
    sun: FloatArray
    pole: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    rotation: float = 0.0
    texture: int = 0
    atmosphere: Atmosphere = field(default_factory=Atmosphere)

    def __post_init__(self) -> None:
        for name, size in (("position", 3), ("attitude", 4), ("sun", 3), ("pole", 3)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (size,) or not np.all(np.isfinite(value)):
                raise ValueError(f"{_SCENE}: {name} = {value}: give ({size},) finite numbers")
            object.__setattr__(self, name, value)
        for name in ("attitude", "pole"):
            length = float(np.linalg.norm(getattr(self, name)))
            if abs(length - 1.0) > 1e-6:
                raise OutOfRange(_SCENE, f"length of {name}", length, 1.0, 1.0, "")
        if not np.isfinite(self.rotation):
            raise OutOfRange(_SCENE, "rotation", self.rotation, -np.inf, np.inf, "rad")
        outside = float(np.linalg.norm(self.in_earth(self.position) / semi_axes()))
        if outside <= 1.0:
            raise OutOfRange(_SCENE, "position in Earth radii", outside, 1.0, np.inf, "")

    @property
    def camera_matrix(self) -> FloatArray:
        """Rotation matrix (3, 3) from ICRS into camera axes."""
        return quaternion.attitude_matrix(self.attitude)

    @property
    def earth_matrix(self) -> FloatArray:
        """Rotation matrix (3, 3) from ICRS into Earth-fixed axes with the pole as third axis."""
        # The coordinate axis farthest from the pole gives the most accurate cross product.
        aside = cross_product(self.pole, np.eye(3)[int(np.argmin(np.abs(self.pole)))])
        first = cross_product(aside / np.linalg.norm(aside), self.pole)
        second = cross_product(self.pole, first)
        cosine, sine = np.cos(self.rotation), np.sin(self.rotation)
        return np.stack([cosine * first + sine * second, cosine * second - sine * first, self.pole])

    def in_earth(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors (..., 3) from ICRS into Earth-fixed axes."""
        return np.asarray(vectors @ self.earth_matrix.T)

    def on_unit_sphere(self) -> tuple[FloatArray, FloatArray]:
        """Return the camera's position (3,) in scaled axes, and the matrix (3, 3) from camera to scaled axes.

        The scaled axes are Earth-fixed axes in which the ellipsoid is the unit sphere.
        """
        axes = semi_axes()
        return self.in_earth(self.position) / axes, ((self.camera_matrix @ self.earth_matrix.T) / axes).T


def look(scene: EarthScene, rays: npt.NDArray[np.floating[Any]]) -> EarthIntersection:
    """Return the intersections of `rays` (n, 3) of any length, in camera axes, with the Earth."""
    return intersect(rays.T, *scene.on_unit_sphere())


def radiance(scene: EarthScene, rays: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Return the radiance along unit rays (3, n) in camera axes, and whether air above the limb is visible.

    Both results are arrays (n,). The radiance does not include the Sun's disc.
    """
    distance = float(np.linalg.norm(scene.sun))
    sunlight = (ASTRONOMICAL_UNIT / distance) ** 2
    return light(
        rays,
        *scene.on_unit_sphere(),
        semi_axes(),
        scene.in_earth(scene.sun / distance),
        sunlight,
        sunlight * float(scene.atmosphere.phase(np.array(0.0))),
        *air_tables(scene.atmosphere),
        map_noise(scene.texture),
    )


RIM_DARKENING = 0.6
"""Linear coefficient of limb darkening near 550 nm (Cox 2000, Allen's Astrophysical Quantities)."""
_RINGS, _SPOKES = 24, 48
"""Numbers of rings and of radial directions of the sampling points on the Sun's disc."""


def nadir(scene: EarthScene) -> FloatArray:
    """Return the unit vector (3,) from the camera to the Earth's centre, camera axes."""
    return np.asarray(scene.camera_matrix @ (-scene.position / np.linalg.norm(scene.position)))


def towards_sun(scene: EarthScene) -> tuple[FloatArray, float]:
    """Return the unit vector (3,) to the Sun, camera axes, and the Sun's angular radius (rad)."""
    offset = scene.sun - scene.position
    distance = float(np.linalg.norm(offset))
    return scene.camera_matrix @ offset / distance, math.asin(SUN_RADIUS / distance)


def visible_share(scene: EarthScene) -> float:
    """Return the fraction of the Sun's light that reaches the camera past the Earth and through the air."""
    axis, radius = towards_sun(scene)
    share = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(axis)
    rays = axis + math.tan(radius) * (share[:, None, None] * spokes).reshape(-1, 3)
    weights = np.repeat(darkening(share**2), _SPOKES)
    return float(transmission(scene, rays) @ weights / weights.sum())


def darkening(share: FloatArray) -> FloatArray:
    """Return the Sun's brightness (...) relative to the disc's mean, at squared radii from 0 to 1 (limb)."""
    rim = 1.0 - RIM_DARKENING * (1.0 - np.sqrt(np.maximum(1.0 - share, 0.0)))
    return np.asarray(rim / (1.0 - RIM_DARKENING / 3.0))


def transmission(scene: EarthScene, rays: FloatArray) -> FloatArray:
    """Return the fraction (n,) of sunlight that reaches the camera along `rays` (n, 3), camera axes."""
    sight = look(scene, rays)
    through = np.exp(-scene.atmosphere.tangent_depth(sight.heights))
    return np.where(sight.hits, 0.0, through)


DEVICE = "Earth camera model"

# Minimum, maximum and unit of each camera parameter.
_LIMITS: dict[str, tuple[float, float, str]] = {
    "rows": (1, 16_384, "px"),
    "columns": (1, 16_384, "px"),
    "bits": (1, 16, "bit"),
    "decades": (0.1, 12.0, ""),
    "darkest": (1e-6, 1e3, ""),
    "sensitivity": (1e-3, 1e12, "e-"),
    "full_well": (1.0, 1e9, "e-"),
    "gain": (1e-3, 1e5, "e-/count"),
    "read_noise": (0.0, 1e5, "e-"),
    "pedestal": (0.0, 65_535.0, "counts"),
    "noise": (0.0, 1e4, "counts"),
    "fixed_pattern": (0.0, 1e4, "counts"),
    "response_spread": (0.0, 1.0, ""),
    "dead_pixels": (0, 1 << 20, "px"),
    "hot_pixels": (0, 1 << 20, "px"),
    "blur": (0.0, 10.0, "px"),
    "scatter": (0.0, 0.5, ""),
    "scatter_angle": (1e-4, 0.5, "rad"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EarthCameraModel:
    """A wide-angle CMOS camera; a white Lambertian surface with the Sun at the zenith has radiance 1.

    Attributes:
        lens: camera geometry, a `Pinhole` or a `Lens` with distortion.
        rows: number of pixel rows, equal to the rows of `lens`.
        columns: number of pixel columns, equal to the columns of `lens`.
        bits: resolution of the analogue-to-digital converter, bits.
        response: "logarithmic" (counts follow the logarithm of radiance plus `darkest`) or "linear".
        decades: decades of radiance from `darkest` to the highest count, for the logarithmic response.
        darkest: radiance equivalent to the dark current, for the logarithmic response.
        sensitivity: charge per frame at a radiance of 1, e-, for the linear response.
        full_well: charge capacity of a pixel, e-, for the linear response.
        gain: charge per count, e-, for the linear response.
        read_noise: standard deviation of the read noise, e-, for the linear response.
        blooming: whether charge beyond the full well spills along the column, for the linear response.
        pedestal: counts of a pixel without light.
        noise: standard deviation of the temporal noise, counts, for the logarithmic response.
        fixed_pattern: standard deviation of the constant pixel offsets after calibration, counts.
        response_spread: relative standard deviation of the pixels' sensitivities, for the linear response.
        dead_pixels: number of pixels that always read zero.
        hot_pixels: number of pixels that always read a bright value.
        seed: random seed of the fixed pattern and of the dead and hot pixels.
        blur: standard deviation of the optics' Gaussian blur, px.
        scatter: fraction of the light that the optics scatter over wide angles.
        scatter_angle: angle at which the scattered light has half its central radiance, rad.

    Raises OutOfRange for values out of range, and ValueError for a lens whose rows or columns differ from
    those of the model.
    """

    lens: CameraModel
    rows: int = 512
    columns: int = 512
    bits: int = 8
    response: Literal["logarithmic", "linear"] = "logarithmic"
    decades: float = 6.0
    darkest: float = 0.01
    sensitivity: float = 16_000.0
    full_well: float = 20_000.0
    gain: float = 80.0
    read_noise: float = 20.0
    blooming: bool = False
    pedestal: float = 8.0
    noise: float = 0.7
    fixed_pattern: float = 1.0
    response_spread: float = 0.01
    dead_pixels: int = 10
    hot_pixels: int = 10
    seed: int = 0
    blur: float = 0.6
    scatter: float = 0.01
    scatter_angle: float = math.radians(0.5)

    def __post_init__(self) -> None:
        check_limits(DEVICE, self, _LIMITS)
        if self.response not in ("logarithmic", "linear"):
            raise ValueError(f"{DEVICE}: response = {self.response!r}: use logarithmic or linear")
        if (self.lens.rows, self.lens.columns) != (self.rows, self.columns):
            raise ValueError(
                f"{DEVICE}: {self.rows} x {self.columns} pixels behind a lens of "
                f"{self.lens.rows} x {self.lens.columns}: give both the same"
            )
        if self.pedestal >= self.highest_count:
            raise OutOfRange(DEVICE, "pedestal", self.pedestal, 0.0, self.highest_count - 1.0, "counts")
        if self.dead_pixels + self.hot_pixels > self.rows * self.columns:
            raise ValueError(f"{DEVICE}: more dead and hot pixels than pixels")

    @classmethod
    def fuga15d(
        cls, field_of_view: float = math.radians(67.0), k1: float = 0.0, k2: float = 0.0, **numbers: Any
    ) -> Self:
        """Return the camera of Meller et al. with 512 x 512 px, 8 bits, six decades and a field of 67 deg.

        `field_of_view` (rad) is the undistorted field from edge to edge. `k1` and `k2` are the distortion
        coefficients of `knightcube.vision.camera.lens.Lens`. `numbers` sets further attributes of the class,
        such as `response="linear"`.
        """
        rows, columns = int(numbers.get("rows", 512)), int(numbers.get("columns", 512))
        ideal = Pinhole.from_field_of_view(columns, rows, field_of_view)
        lens = Lens(columns, rows, ideal.focal_length, ideal.centre, k1, k2)
        return cls(lens=lens, **numbers)

    @property
    def highest_count(self) -> int:
        """Count at which the analogue-to-digital converter saturates."""
        return (1 << self.bits) - 1

    @property
    def count_type(self) -> type[np.uint8] | type[np.uint16]:
        """Smallest unsigned integer type that holds a count."""
        return np.uint8 if self.bits <= 8 else np.uint16

    @property
    def counts_per_decade(self) -> float:
        """Increase of the counts of the logarithmic camera if the radiance is multiplied by ten."""
        return (self.highest_count - self.pedestal) / self.decades


def pixel_rays(lens: CameraModel) -> FloatArray:
    """Return the unit vectors (rows x columns, 3) of the pixels, camera axes, as a read-only array."""
    return _pixel_rays(Lens.of(lens))


@lru_cache(maxsize=4)
def _pixel_rays(lens: Lens) -> FloatArray:
    rows, columns = np.mgrid[0 : lens.rows, 0 : lens.columns]
    rays = lens.unit_vectors(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    rays.setflags(write=False)
    return rays


@lru_cache(maxsize=4)
def _coarse_rays(lens: Lens) -> Float32Array:
    """Return the `pixel_rays` as an array (3, rows x columns) of 32-bit numbers."""
    return np.ascontiguousarray(pixel_rays(lens).T, dtype=np.float32)


_SUBPIXELS = 6
"""Number of sampling points per pixel along each axis, for the Sun's disc."""


def add_disc(scene: EarthScene, model: EarthCameraModel, image: Float32Array) -> None:
    """Add the blurred radiance of the Sun's disc to `image` (rows, columns)."""
    axis, radius = towards_sun(scene)
    window = _window(model.lens, axis, radius, math.ceil(4.0 * model.blur) + 1)
    if window is None:
        return
    left, top, width, height = window
    grid = (np.arange(max(width, height) * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    x, y = np.meshgrid(left + grid[: width * _SUBPIXELS], top + grid[: height * _SUBPIXELS])
    rays = model.lens.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1))
    # Squared chords are more accurate than cosines for angles as small as the Sun's radius.
    share = np.sum((rays - axis) ** 2, axis=1) / (2.0 * math.sin(0.5 * radius)) ** 2
    fine = np.zeros(len(rays))
    # Rays outside the lens's field are NaN, and a comparison with NaN is false.
    inside = np.flatnonzero(share < 1.0)
    fine[inside] = darkening(share[inside]) * transmission(scene, rays[inside])
    fine *= (1.0 - model.scatter) / math.sin(radius) ** 2
    blurred = gaussian_filter(fine.reshape(x.shape), model.blur * _SUBPIXELS, mode="constant", truncate=4.0)
    patch = blurred.reshape(height, _SUBPIXELS, width, _SUBPIXELS).mean(axis=(1, 3))
    rows = slice(max(top, 0), min(top + height, model.rows))
    columns = slice(max(left, 0), min(left + width, model.columns))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] += patch[
            rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
        ]


def add_glare(scene: EarthScene, model: EarthCameraModel, image: Float32Array) -> None:
    """Add the sunlight that the optics scatter to `image` (rows, columns).

    The scattered radiance decreases from its centre as 1/(1 + (s/s0)^2), where s is the chord between unit
    vectors. This function of s is the Harvey-Shack model for polished optics with a slope of two. The
    fraction `scatter` of the light is scattered over the hemisphere. The lens has no hood, so sunlight
    reaches it from the entire hemisphere in front of the camera.
    """
    axis, _ = towards_sun(scene)
    if axis[2] <= 0.0 or model.scatter == 0.0:
        return
    glare = visible_share(scene) * float(axis[2]) * scatter_centre(model)
    if glare == 0.0:
        return
    _add_halo(_coarse_rays(Lens.of(model.lens)), axis, glare, model.scatter_angle**-2, image.reshape(-1))


def _add_halo_numpy(
    rays: Float32Array, axis: FloatArray, centre: float, sharpness: float, image: Float32Array
) -> None:
    """Add scattered light to `image`, as the numpy form of `_add_halo`."""
    squares = np.zeros(len(image), dtype=np.float32)
    for coordinates, value in zip(rays, axis.astype(np.float32), strict=True):
        offset = coordinates - value
        offset *= offset
        squares += offset
    squares *= np.float32(sharpness)
    squares += 1.0
    image += np.float32(centre) / squares


@compiled_form_of(_add_halo_numpy)
def _add_halo(
    rays: Float32Array, axis: FloatArray, centre: float, sharpness: float, image: Float32Array
) -> None:
    """Add centre / (1 + sharpness s^2) to `image` (n,); s is the chord from `axis` (3,) to a ray (3, n)."""
    peak, factor, one = np.float32(centre), np.float32(sharpness), np.float32(1.0)
    x, y, z = np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2])
    for n in range(len(image)):
        right, down, ahead = rays[0, n] - x, rays[1, n] - y, rays[2, n] - z
        image[n] += peak / (one + factor * (right * right + down * down + ahead * ahead))


def scatter_centre(model: EarthCameraModel) -> float:
    """Return the radiance at the centre of the scattered sunlight.

    The integral of 1/(1 + (s/s0)^2) over the hemisphere is pi s0^2 ln(1 + 2/s0^2), and the solar irradiance
    is pi in the model's units.
    """
    square = model.scatter_angle**2
    return model.scatter / (square * math.log(1.0 + 2.0 / square))


def _window(
    lens: CameraModel, axis: FloatArray, radius: float, margin: int
) -> tuple[int, int, int, int] | None:
    """Return left, top, width and height of the blurred Sun's window, or None if it is outside the frame."""
    angle = np.arange(16) * (np.pi / 8.0)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(axis)
    # A 16-sided polygon contains the disc if its corners are 1/cos(pi/16) times as far from the centre.
    rim = lens.project(axis + math.tan(radius) / math.cos(np.pi / 16.0) * ring)
    rim = rim[~np.isnan(rim[:, 0])]
    if not len(rim):
        return None
    # Image points are clipped before the cast to int, because they overflow near 90 deg off axis.
    outer = np.array([lens.columns, lens.rows]) - 1 + margin
    low = np.maximum(np.floor(rim.min(axis=0)) - margin, -margin)
    high = np.minimum(np.ceil(rim.max(axis=0)) + margin, outer)
    if np.any(low > high):
        return None
    (left, top), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return left, top, width + 1, height + 1


_BIN = 8
"""Edge length (px) of the pixel bins in which scattered light is computed."""


def blurred(model: EarthCameraModel, image: Float32Array) -> Float32Array:
    """Return `image` (rows, columns) after blur and scattering by the optics.

    The image is continued beyond its edges with the values of its edge pixels.
    """
    if not image.any():
        return image
    return _spread(image, _blur_weights(model.blur), 1.0 - model.scatter, _scattered(model, image))


@lru_cache(maxsize=4)
def _blur_weights(sigma: float) -> Float32Array:
    """Return the weights (2 k + 1,) of a Gaussian of standard deviation `sigma`, px, cut off at 4 `sigma`."""
    reach = int(4.0 * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-9)) ** 2)
    return np.asarray(weights / weights.sum()).astype(np.float32)


def _spread_numpy(
    image: Float32Array, weights: Float32Array, share: float, bins: Float32Array
) -> Float32Array:
    """Return the blurred image, as the numpy form of `_spread`."""
    rows, columns = image.shape
    narrow: Float32Array = correlate1d(
        correlate1d(image, weights, 0, mode="nearest"), weights, 1, mode="nearest"
    )
    narrow *= np.float32(share)
    narrow += _interpolation(len(bins), rows) @ bins @ _interpolation(bins.shape[1], columns).T
    return narrow


@compiled_form_of(_spread_numpy)
def _spread(image: Float32Array, weights: Float32Array, share: float, bins: Float32Array) -> Float32Array:
    """Return a blurred image (rows, columns) with added scattered light.

    Args:
        image: radiance (rows, columns), which continues with its edge pixels beyond the edges.
        weights: weights (2 k + 1,) of the blur along each axis.
        share: factor by which the blurred image is multiplied.
        bins: scattered light at the centres of bins of `_BIN` x `_BIN` px, for linear interpolation.
    """
    (rows, columns), (down, across) = image.shape, bins.shape
    reach, factor = len(weights) // 2, np.float32(share)
    result = np.empty((rows, columns), np.float32)
    line, coarse = np.empty(columns + 2 * reach, np.float32), np.empty(across, np.float32)
    for row in range(rows):
        _add_rows(image, row, weights, line[reach : reach + columns])
        line[:reach], line[reach + columns :] = line[reach], line[reach + columns - 1]
        place = min(max((row + 0.5) / _BIN - 0.5, 0.0), down - 1.0)
        above = int(place)
        below, step = min(above + 1, down - 1), np.float32(place - above)
        for n in range(across):
            coarse[n] = bins[above, n] + step * (bins[below, n] - bins[above, n])
        target = result[row]
        for n in range(across + 1):
            left, right = coarse[max(n - 1, 0)], coarse[min(n, across - 1)]
            slope = (right - left) / np.float32(_BIN)
            first = _BIN * n - _BIN // 2
            for column in range(max(first, 0), min(first + _BIN, columns)):
                target[column] = left + slope * (np.float32(column - first) + np.float32(0.5))
        for k in range(len(weights)):
            _add(factor * weights[k], line[k : k + columns], target)
    return result


@loop_helper
def _add_rows(image: Float32Array, row: int, weights: Float32Array, total: Float32Array) -> None:
    """Store the weighted sum of the rows around `row` of an image in `total` (columns,)."""
    reach, bottom = len(weights) // 2, len(image) - 1
    total[:] = np.float32(0.0)
    for k in range(len(weights)):
        _add(weights[k], image[min(max(row + k - reach, 0), bottom)], total)


@loop_helper
def _add(factor: np.float32, values: Float32Array, total: Float32Array) -> None:
    """Add `factor` times `values` (n,) to `total` (n,)."""
    for n in range(len(total)):
        total[n] += factor * values[n]


def _scattered(model: EarthCameraModel, image: Float32Array) -> Float32Array:
    """Return the scattered light (rows / `_BIN`, columns / `_BIN`) at the centres of the bins."""
    rows, columns = image.shape
    if rows % _BIN or columns % _BIN:
        image = np.pad(image, ((0, -rows % _BIN), (0, -columns % _BIN)), mode="edge")
    down, across = image.shape[0] // _BIN, image.shape[1] // _BIN
    if model.scatter == 0.0:
        return np.zeros((down, across), dtype=np.float32)
    # Two sums are several times faster than a mean over two axes.
    bins = image.reshape(down, _BIN, -1).sum(axis=1).reshape(down, across, _BIN).sum(axis=2) / _BIN**2
    kernel, shape = _kernel(down, across, model.scatter, model.scatter_angle, model.lens.focal_length)
    spread = irfft2(rfft2(bins, shape) * kernel, shape)[:down, :across]
    return np.ascontiguousarray(spread, dtype=np.float32)


@lru_cache(maxsize=4)
def _interpolation(bins: int, pixels: int) -> Float32Array:
    """Return the matrix (pixels, bins) that interpolates linearly from bin centres to pixels."""
    place = np.clip((np.arange(pixels) + 0.5) / _BIN - 0.5, 0.0, bins - 1.0)
    return np.maximum(1.0 - np.abs(place[:, None] - np.arange(bins)), 0.0).astype(np.float32)


@lru_cache(maxsize=4)
def _kernel(
    down: int, across: int, scatter: float, angle: float, focal_length: float
) -> tuple[npt.NDArray[np.complex64], tuple[int, int]]:
    """Return the Fourier transform of the scattering kernel between bins, and the padded array shape.

    The kernel has the radial profile of `add_glare`; angles are image distances divided by the focal length.
    """
    shape = (next_fast_len(2 * down), next_fast_len(2 * across))
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) * (_BIN / focal_length) for n in shape)
    # Within a bin, the mean squared distance of two points is a third of the squared bin width.
    squares = y[:, None] ** 2 + x**2 + (_BIN / focal_length) ** 2 / 3.0
    share = scatter / (math.pi * angle**2 * math.log(1.0 + 2.0 / angle**2))
    kernel = share * (_BIN / focal_length) ** 2 / (1.0 + squares / angle**2)
    return rfft2(kernel.astype(np.float32)), shape


def counts(model: EarthCameraModel, radiance: Float32Array, generator: np.random.Generator) -> Image:
    """Return the frame (rows, columns), counts, for `radiance` (rows, columns)."""
    offsets, spread, dead, hot, hot_counts = _pattern(model)
    if model.response == "logarithmic":
        signal = radiance * np.float32(1.0 / model.darkest)
        signal += np.float32(1.0)
        np.log10(signal, out=signal)
        signal *= np.float32(model.counts_per_decade)
        signal += _normal(model, model.noise, generator)
    else:
        charge = radiance * np.float32(model.sensitivity) * (1.0 + spread)
        if model.blooming:
            spill(charge, model.full_well)
        charge += np.sqrt(charge) * _normal(model, 1.0, generator)
        np.clip(charge, 0.0, model.full_well, out=charge)
        charge += _normal(model, model.read_noise, generator)
        signal = charge / np.float32(model.gain)
    signal += offsets + np.float32(model.pedestal)
    # Dead and hot pixels have no noise.
    flat = signal.reshape(-1)
    flat[dead] = 0.0
    flat[hot] = hot_counts
    signal += np.float32(0.5)  # adding 0.5 makes the truncation round to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def spill(charge: Float32Array, full_well: float) -> None:
    """Spread charge beyond the full well along the columns of `charge` (rows, columns).

    Half of the excess moves up and half moves down. Each pixel fills up before the next pixel receives
    charge, and charge that reaches an edge of the detector is lost.
    """
    for column in np.flatnonzero(np.any(charge > full_well, axis=0)):
        line = charge[:, column]
        over = np.maximum(line - full_well, 0.0)
        np.minimum(line, full_well, out=line)
        for way in (slice(None), slice(None, None, -1)):
            pixels, carried = line[way], 0.0
            for row, excess in enumerate((0.5 * over[way]).tolist()):
                carried += excess
                if carried > 0.0:
                    taken = min(carried, full_well - float(pixels[row]))
                    pixels[row] += taken
                    carried -= taken


def _normal(model: EarthCameraModel, sigma: float, generator: np.random.Generator) -> Float32Array:
    noise = standard_normal((model.rows, model.columns), generator)
    noise *= np.float32(sigma)
    return noise


@lru_cache(maxsize=8)
def _pattern(model: EarthCameraModel) -> tuple[Float32Array, Float32Array, IntArray, IntArray, Float32Array]:
    """Return pixel offsets (counts), sensitivity errors, dead pixels, hot pixels and hot pixels' counts."""
    rng = np.random.default_rng(model.seed)
    shape, size = (model.rows, model.columns), model.rows * model.columns
    offsets = rng.standard_normal(shape, dtype=np.float32) * np.float32(model.fixed_pattern)
    spread = rng.standard_normal(shape, dtype=np.float32) * np.float32(model.response_spread)
    blemished = rng.choice(size, size=model.dead_pixels + model.hot_pixels, replace=False)
    bright = rng.uniform(0.3, 1.0, size=model.hot_pixels) * model.highest_count
    dead, hot = blemished[: model.dead_pixels], blemished[model.dead_pixels :]
    return offsets, spread, dead, hot, bright.astype(np.float32)


_WITHIN = np.sqrt(1.0 / 12.0) * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
"""Offsets (4, 2), px, of 2 x 2 Gauss-Legendre points from a pixel's centre."""


def render(model: EarthCameraModel, scene: EarthScene, generator: np.random.Generator) -> Image:
    """Return the camera's frame (rows, columns) as uint8 for up to 8 bits, else as uint16.

    The noise of the frame is drawn from `generator`.
    """
    return counts(model, _light(model, scene), generator)


def expected_radiance(model: EarthCameraModel, scene: EarthScene) -> FloatArray:
    """Return the noise-free radiance (rows, columns) on the detector, including blur and glare."""
    return _light(model, scene).astype(np.float64)


def _light(model: EarthCameraModel, scene: EarthScene) -> Float32Array:
    image = blurred(model, _earth(model, scene))
    add_disc(scene, model, image)
    add_glare(scene, model, image)
    return image


def _earth(model: EarthCameraModel, scene: EarthScene) -> Float32Array:
    """Return the Earth's radiance (rows, columns), averaged within the pixels that the limb crosses."""
    rays = _coarse_rays(Lens.of(model.lens))
    image, above = radiance(scene, rays)
    if above.any():
        # A pixel with its centre on the ground may extend beyond the limb, so neighbours are included.
        at_limb = _with_neighbours(above.reshape(model.rows, model.columns))
        fine, _ = radiance(scene, _rays_within(rays, at_limb, model.columns))
        image[at_limb] = fine.reshape(len(_WITHIN), -1).mean(axis=0)
    return image.reshape(model.rows, model.columns)


def _with_neighbours(pixels: BoolArray) -> IntArray:
    """Return the indices of the set pixels (rows, columns) and of all pixels next to them."""
    wide = pixels.copy()
    wide[1:] |= pixels[:-1]
    wide[:-1] |= pixels[1:]
    high = wide.copy()
    wide[:, 1:] |= high[:, :-1]
    wide[:, :-1] |= high[:, 1:]
    return np.flatnonzero(wide)


def _rays_within(rays: Float32Array, pixels: IntArray, columns: int) -> Float32Array:
    """Return the rays (3, 4 n) through 2 x 2 points within each of the n pixels with the indices `pixels`.

    The rays are interpolated linearly from the rays (3, rows x columns) of the pixel centres. The error of a
    ray is below 0.3/f^2 + 2e-7 rad, where f is the focal length in px.
    """
    centre = rays.take(pixels, axis=1)
    slopes = []
    for place, size, stride in (
        (pixels % columns, columns, 1),
        (pixels // columns, rays.shape[1] // columns, columns),
    ):
        before, after = np.minimum(place, 1), np.minimum(size - 1 - place, 1)
        span = rays.take(pixels + stride * after, axis=1) - rays.take(pixels - stride * before, axis=1)
        slopes.append(span / np.maximum(before + after, 1).astype(np.float32))
    within = [centre + np.float32(x) * slopes[0] + np.float32(y) * slopes[1] for x, y in _WITHIN]
    return np.concatenate(within, axis=1)
