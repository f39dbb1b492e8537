"""Image model of a wide-angle camera that views Earth and Sun from a low orbit.

    model = EarthCameraModel.fuga15d(seed=1)
    scene = EarthScene(position, attitude, sun_position(julian_date))
    frame = render(model, scene, generator)

The unit of radiance is the radiance of a white Lambertian surface with the Sun at the zenith, so the radiance
of the Sun's disc is 46,000.

The air density decreases exponentially with height. Single scattering of sunlight in the air produces the
soft limb, twilight, and haze over the ground. The optical depth along an oblique path is the vertical optical
depth times Chapman's function. For a scale height far below the Earth's radius, Chapman's function is sqrt(pi
X/2) exp(X mu^2/2) erfc(mu sqrt(X/2)), where X is the ratio of Earth radius to scale height and mu the cosine
of the zenith angle (Huestis 2001, J. Quant. Spectrosc. Radiat. Transfer 69, 709). Huestis's formula is also
valid for a Sun below the horizon. The model omits refraction (which raises the apparent limb by 0.2 km, or
0.004 deg), ozone, and clouds above the limb.

Lines of sight are intersected exactly with the WGS 84 ellipsoid, in axes that are scaled so that the
ellipsoid is the unit sphere. The ground is Lambertian. Direct sunlight is attenuated by the air on the way to
the ground and again on the way to the camera. Land, sea and cloud are noise with a power-law spectrum,
sampled on a sphere in a periodic volume at two scales: continents and weather, and coasts and single clouds.
The map does not show the real Earth, but has bright edges inside the limb, which disturb a horizon detector.

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
from scipy.ndimage import gaussian_filter
from scipy.special import erfcx, ndtri

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
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, semi_axes
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS
from knightcube.vision.camera.lens import CameraModel, Lens, Pinhole

_DEEPEST = -9.0
"""Smallest argument of erfcx (optical depth 1e35); smaller arguments are clipped to this value."""


@dataclass(frozen=True, slots=True)
class Atmosphere:
    """Exponential air.

    Attributes:
        scale_height: m.
        optical_depth: vertical optical depth, by default of Rayleigh scattering at 550 nm (Bucholtz 1995,
            Appl. Opt. 34).
        multiple: ratio of all scattered light to singly scattered light.
    """

    scale_height: float = 8000.0
    optical_depth: float = 0.097
    multiple: float = 1.5

    def __post_init__(self) -> None:
        depth, multiple = (0.011, 10.0, ""), (0.0, 4.0, "")
        limits = {"scale_height": (100.0, 50e3, "m"), "optical_depth": depth, "multiple": multiple}
        check_limits("atmosphere", self, limits)

    @property
    def _ratio(self) -> float:
        return SEMI_MAJOR_AXIS / self.scale_height

    @property
    def limb_depth(self) -> float:
        """Optical depth of a line of sight that touches the ground, about 70 times `optical_depth`."""
        return self.optical_depth * math.sqrt(2.0 * math.pi * self._ratio)

    @property
    def apparent_limb_height(self) -> float:
        """Tangent height (m) at which a sunlit limb has half its full brightness.

        At this height 1 - exp(-depth) is 1/2, with the depth `limb_depth` * exp(-height / scale height).
        """
        return self.scale_height * math.log(self.limb_depth / math.log(2.0))

    def tangent_depth(self, heights: Float32Array) -> Float32Array:
        """Return the optical depth of complete lines of sight with tangent heights (...), m."""
        return np.asarray(self.limb_depth * np.exp(-heights / self.scale_height))

    def slant_depth(self, cosines: Float32Array) -> Float32Array:
        """Return the optical depth from the ground to space at zenith-angle cosines (...) of either sign."""
        root = math.sqrt(0.5 * self._ratio)
        argument = np.maximum(cosines * root, _DEEPEST)
        return np.asarray(self.optical_depth * math.sqrt(math.pi) * root * erfcx(argument))

    def scattered(self, depth: Float32Array, bottom: Float32Array, sunward: Float32Array) -> Float32Array:
        """Return the fraction of sunlight scattered along lines of sight, without the phase function.

        `depth` (...) is the optical depth along the line of sight. `bottom` (...) is the air density at the
        line's lowest point, divided by the density at the ground. `sunward` (...) is the optical depth
        towards the Sun, from the ground below the line of sight. The scattered light comes from the air above
        the point where the optical depth along the line reaches one. The transmission of sunlight is averaged
        over the scattering air.
        """
        x = np.maximum(sunward * bottom / (1.0 + depth), 1e-6)
        return np.asarray(np.expm1(-depth) * np.expm1(-x) / x)

    def phase(self, cosines: Float32Array) -> Float32Array:
        """Return the radiance of optically thick sunlit air at cosines (...) of the scattering angle.

        The radiance is a quarter of the Rayleigh phase function times `multiple`.
        """
        return np.asarray(self.multiple * 0.1875 * (1.0 + cosines * cosines))


_SCENE = "Earth scene"


@dataclass(frozen=True, slots=True, eq=False)
class EarthScene:
    """Positions and attitudes of camera, Earth and Sun at one instant.

    Attributes:
        position: geocentric position (3,) of the camera, m, ICRS.
        attitude: quaternion (4,) of the camera, ICRS into camera axes.
        sun: geocentric position (3,) of the Sun, m, ICRS.
        pole: unit vector (3,) to the Earth's pole, ICRS, whose default is 0.15 deg from the true pole in
            2026.
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
        """Return the camera's position (3,), and the matrix (3, 3) from camera axes, in the scaled axes.

        The scaled axes are Earth-fixed axes in which the ellipsoid is the unit sphere.
        """
        axes = semi_axes()
        return self.in_earth(self.position) / axes, ((self.camera_matrix @ self.earth_matrix.T) / axes).T


OCEAN, LAND, CLOUD = 0.06, 0.22, 0.65
"""Albedo of sea (0.05 to 0.1 in visible light), land (0.1 to 0.3) and cloud (up to 0.8)."""
LAND_SHARE, CLOUD_SHARE = 0.29, 0.55
"""Fractions of the Earth covered by land and by cloud."""

_CELLS = 96
"""Edge length (grid cells) of the periodic noise volume."""
_SLOPE = -2.3
"""Exponent of the noise amplitude as a power of the wave number, as for the spectrum of clouds."""
_RADIUS = 0.42 * _CELLS
"""Radius (grid cells) of the Earth's sphere in the noise volume."""
_MAGNIFICATION, _FINE = 11.0, 0.5
"""Magnification of the coordinates, and amplitude, of the fine noise relative to the coarse noise."""
_SOFT = 0.1
"""Width of the transition at a coast or a cloud edge, in standard deviations of the noise."""


def albedo(directions: FloatArray | Float32Array, seed: int) -> Float32Array:
    """Return the ground's albedo (n,) below Earth-fixed unit directions (n, 3)."""
    places = np.ascontiguousarray(directions.T, dtype=np.float32)
    places *= np.float32(_RADIUS)
    places += np.float32(0.5 * _CELLS)
    heights = _read(_noise(seed), places * np.float32(_MAGNIFICATION))
    heights *= np.float32(_FINE)
    heights += _read(_noise(seed), places)
    heights /= np.float32(math.hypot(1.0, _FINE))
    land, cloud = _covered(heights.real, LAND_SHARE), _covered(heights.imag, CLOUD_SHARE)
    ground = OCEAN + (LAND - OCEAN) * land
    return np.asarray(ground + (CLOUD - ground) * cloud)


def _covered(heights: Float32Array, share: float) -> Float32Array:
    """Return the cover (n,), from 0 to 1 with mean `share`, by land or cloud for noise values (n,)."""
    above = (heights - np.float32(ndtri(1.0 - share))) / np.float32(_SOFT) + np.float32(0.5)
    return np.asarray(np.clip(above, 0.0, 1.0))


def _read(noise: npt.NDArray[np.complex64], places: Float32Array) -> npt.NDArray[np.complex64]:
    """Return the periodic noise (n,), linearly interpolated, at `places` (3, n), in grid cells."""
    low = np.floor(places)
    along, across, up = places - low
    i, j, k = low.astype(np.int32) % _CELLS
    rows = [column % _CELLS * _CELLS for column in (j, j + 1)]
    layers = [layer % _CELLS * _CELLS**2 for layer in (i, i + 1)]
    after = (k + 1) % _CELLS

    def line(layer: IntArray, row: IntArray) -> npt.NDArray[np.complex64]:
        base = layer + row
        return _between(noise.take(base + k), noise.take(base + after), up)

    faces = [_between(line(layer, rows[0]), line(layer, rows[1]), across) for layer in layers]
    return _between(faces[0], faces[1], along)


def _between(
    before: npt.NDArray[np.complex64], after: npt.NDArray[np.complex64], share: Float32Array
) -> npt.NDArray[np.complex64]:
    """Return the linear interpolation (n,) between values `before` and `after` (n,), overwriting `after`."""
    after -= before
    after *= share
    after += before
    return after


@lru_cache(maxsize=4)
def _noise(seed: int) -> npt.NDArray[np.complex64]:
    """Return two periodic cubic grids of independent noise of unit variance, as one flat array.

    The real part is the noise for land, and the imaginary part is the noise for clouds.
    """
    across = np.fft.fftfreq(_CELLS, 1.0 / _CELLS).astype(np.float32)
    wave = np.sqrt(across[:, None, None] ** 2 + across[None, :, None] ** 2 + across**2)
    amplitude = np.where(wave >= 1.5, np.maximum(wave, 1.5) ** _SLOPE, 0.0)
    rng = np.random.default_rng(seed)
    shape = (_CELLS, _CELLS, _CELLS)
    white = rng.standard_normal(shape, np.float32) + 1j * rng.standard_normal(shape, np.float32)
    # The transform of white noise is white noise, with independent real and imaginary parts.
    noise = np.fft.ifftn(white * amplitude)
    land, cloud = noise.real, noise.imag
    whole = land / land.std() + 1j * (cloud / cloud.std())
    return np.asarray(whole.astype(np.complex64).reshape(-1))


TOP = 120e3
"""Height (m) above which the air has less than a millionth of the limb's brightness."""
_DARKEST = -0.2
"""Cosine of the Sun's zenith angle below which only air above `TOP` is lit (11.5 deg below the horizon)."""


@dataclass(frozen=True, slots=True, eq=False)
class EarthIntersection:
    """First intersections of n lines of sight with the Earth's ellipsoid, or their nearest points to it.

    The heights (n,), m, are 0 for lines that meet the ground and infinite for lines that point away from the
    Earth. The points `places` (n, 3) are in Earth-fixed axes that are scaled so that the ellipsoid is the
    unit sphere.
    """

    hits: BoolArray
    heights: Float32Array
    places: npt.NDArray[np.floating[Any]]


def look(scene: EarthScene, rays: npt.NDArray[np.floating[Any]]) -> EarthIntersection:
    """Return the intersections of `rays` (n, 3) of any length, in camera axes, with the Earth.

    The precision is that of `rays`. For 32-bit rays from altitudes up to 2,000 km, the errors of all heights
    are below 2 m, and the errors of 99.9 % of the places are below 20 m. Places near the limb have larger
    errors along the line of sight.
    """
    origin, into_earth = (array.astype(rays.dtype) for array in scene.on_unit_sphere())
    axes: npt.NDArray[np.floating[Any]] = semi_axes().astype(rays.dtype)
    # Computing with contiguous rows of coordinates is several times faster than with rows of vectors.
    scaled = into_earth @ rays.T
    squares, along = np.sum(scaled * scaled, axis=0), origin @ scaled
    # The distance of the nearest point from the centre is more accurate than a quadratic's discriminant.
    nearest = origin[:, None] - (along / squares) * scaled
    nearest_squares = nearest * nearest
    distance = np.sum(nearest_squares, axis=0)
    ahead = along < 0.0
    hits = ahead & (distance <= 1.0)
    back = np.sqrt(np.maximum(1.0 - distance, 0.0) / squares)
    places = nearest - np.where(hits, back, 0.0) * scaled
    length = np.sqrt(distance)
    local = np.sqrt(axes**2 @ nearest_squares) / length
    heights = np.where(ahead, np.maximum(length - 1.0, 0.0) * local, np.inf).astype(np.float32, copy=False)
    return EarthIntersection(np.asarray(hits), heights, places.T)


def near_earth(scene: EarthScene, rays: Float32Array) -> IntArray:
    """Return the indices of the `rays` (n, 3), camera axes, that may pass below the height `TOP`.

    The indices include all rays for which `look` returns a height below `TOP`, and some further rays.
    """
    origin, into_earth = scene.on_unit_sphere()
    reach = float(origin @ origin) - (1.0 + TOP / float(semi_axes().min())) ** 2
    if reach <= 0.0:
        return np.arange(len(rays))
    scaled = into_earth.astype(np.float32) @ rays.T
    along = origin.astype(np.float32) @ scaled
    squares = scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2]
    # The margin of 1e-5 is far larger than the rounding errors of 32-bit numbers.
    return np.flatnonzero((along < 0.0) & (along * along > np.float32(reach * (1.0 - 1e-5)) * squares))


def radiance(scene: EarthScene, rays: FloatArray | Float32Array, sight: EarthIntersection) -> Float32Array:
    """Return the radiance (n,) along unit `rays` (n, 3) in camera axes, without the Sun's disc.

    The argument `sight` contains the intersections of the rays with the Earth.
    """
    result = np.zeros(len(rays), dtype=np.float32)
    axes = semi_axes().astype(np.float32)[:, None]
    seen = np.flatnonzero(sight.heights < TOP)
    places = _chosen(sight.places.T, seen)
    normals = _unit(places / axes)
    to_camera = scene.camera_matrix @ scene.earth_matrix.T
    distance = float(np.linalg.norm(scene.sun))
    sun = scene.in_earth(scene.sun / distance)
    solar = sun.astype(np.float32) @ normals
    lit = np.flatnonzero(solar > _DARKEST)
    if len(lit) < len(seen):
        seen, solar, places, normals = seen[lit], solar[lit], places[:, lit], normals[:, lit]
    directions = _chosen(rays.T, seen)
    upward = np.maximum(-np.sum(directions * (to_camera.astype(np.float32) @ normals), axis=0), 0.0)
    # The cosine of the scattering angle is 1 (forward scattering) for a line of sight towards the Sun.
    turned = (to_camera @ sun).astype(np.float32) @ directions
    air, hits = scene.atmosphere, sight.hits[seen]
    bottom = np.exp(-sight.heights[seen] / air.scale_height)
    depth = np.where(hits, air.slant_depth(upward), air.limb_depth * bottom)
    towards = air.slant_depth(solar)
    light = air.phase(turned) * air.scattered(depth, bottom, towards)
    ground = np.flatnonzero(hits & (solar > 0.0))
    beneath = _unit(places[:, ground] * axes)
    matt = albedo(beneath.T, scene.texture) * solar[ground]
    light[ground] += matt * np.exp(-depth[ground] - towards[ground])
    result[seen] = light * np.float32((ASTRONOMICAL_UNIT / distance) ** 2)
    return result


def _chosen(vectors: npt.NDArray[np.floating[Any]], at: IntArray) -> Float32Array:
    """Return the columns with the indices `at` of vectors (3, n) as 32-bit numbers."""
    coarse = vectors.astype(np.float32, copy=False)
    return coarse if len(at) == vectors.shape[1] else coarse.take(at, axis=1)


def _unit(vectors: Float32Array) -> Float32Array:
    """Return vectors (3, n) with unit length."""
    x, y, z = vectors
    return np.asarray(vectors / np.sqrt(x * x + y * y + z * z))


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
    """Return the brightness (mean 1) of the Sun at squared radii (...), 0 at the centre, 1 at the limb."""
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

    Raises OutOfRange for values out of range, and ValueError for a lens with different numbers of rows and
    columns.
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
    rays = np.asfortranarray(rays)  # column-major order makes the computations along the rays fast
    rays.setflags(write=False)
    return rays


@lru_cache(maxsize=4)
def _coarse_rays(lens: Lens) -> Float32Array:
    """Return the `pixel_rays` as 32-bit numbers."""
    return pixel_rays(lens).astype(np.float32, order="F")


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
    light = visible_share(scene) * float(axis[2]) * scatter_centre(model)
    if light == 0.0:
        return
    squares = 2.0 - 2.0 * (pixel_rays(model.lens) @ axis).reshape(image.shape)
    image += (light / (1.0 + squares / model.scatter_angle**2)).astype(np.float32)


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
    narrow = gaussian_filter(image, model.blur, mode="nearest", truncate=4.0) if model.blur > 0.0 else image
    if model.scatter == 0.0:
        return np.asarray(narrow)
    return np.asarray(narrow * np.float32(1.0 - model.scatter) + _scattered(model, image))


def _scattered(model: EarthCameraModel, image: Float32Array) -> Float32Array:
    rows, columns = image.shape
    padded = np.pad(image, ((0, -rows % _BIN), (0, -columns % _BIN)), mode="edge")
    down, across = padded.shape[0] // _BIN, padded.shape[1] // _BIN
    bins = padded.reshape(down, _BIN, across, _BIN).mean(axis=(1, 3))
    kernel, shape = _kernel(down, across, model.scatter, model.scatter_angle, model.lens.focal_length)
    spread = irfft2(rfft2(bins, shape) * kernel, shape)[:down, :across]
    smooth = _interpolation(down, rows) @ spread @ _interpolation(across, columns).T
    return np.asarray(smooth, dtype=np.float32)


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
        signal = np.log10(1.0 + radiance * np.float32(1.0 / model.darkest))
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
    return generator.standard_normal((model.rows, model.columns), dtype=np.float32) * np.float32(sigma)


@lru_cache(maxsize=8)
def _pattern(model: EarthCameraModel) -> tuple[Float32Array, Float32Array, IntArray, IntArray, Float32Array]:
    """Return pixel offsets (counts), sensitivity errors, dead pixels, hot pixels and hot pixels' counts."""
    rng = np.random.default_rng(model.seed)
    size = model.rows * model.columns
    offsets = _normal(model, model.fixed_pattern, rng)
    spread = _normal(model, model.response_spread, rng)
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
    light = np.zeros(len(rays), dtype=np.float32)
    near = near_earth(scene, rays)
    if not len(near):
        return light.reshape(model.rows, model.columns)
    rays = rays.T.take(near, axis=1).T
    sight = look(scene, rays)
    found = radiance(scene, rays, sight)
    light[near] = found
    at_limb = near[~sight.hits & (found > 0.0)]
    if len(at_limb):
        # A pixel with its centre on the ground may extend beyond the limb, so neighbours are included.
        wide = np.zeros((model.rows + 2, model.columns + 2), dtype=bool)
        down, across = np.divmod(at_limb, model.columns)
        for step in range(9):
            wide[down + step // 3, across + step % 3] = True
        at_limb = np.flatnonzero(wide[1:-1, 1:-1])
        pixels = np.stack([at_limb % model.columns, at_limb // model.columns], axis=1)
        points = (pixels[:, None, :] + _WITHIN).reshape(-1, 2)
        fine = model.lens.unit_vectors(points).astype(np.float32, order="F")
        light[at_limb] = radiance(scene, fine, look(scene, fine)).reshape(-1, len(_WITHIN)).mean(axis=1)
    return light.reshape(model.rows, model.columns)
