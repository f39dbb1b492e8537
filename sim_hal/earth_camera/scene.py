"""Scene of a camera that views Earth and Sun from a low orbit, and the radiance along lines of sight.

Radiance is stated relative to that of a white Lambertian surface with the Sun at the zenith.

The air density decreases exponentially with height. Single scattering of sunlight in the air produces the
soft limb, twilight, and haze over the ground. The optical depth along an oblique path is the vertical optical
depth times Chapman's function. For a scale height far below the Earth's radius this function is sqrt(pi X/2)
exp(X mu^2/2) erfc(mu sqrt(X/2)), where X is the ratio of Earth radius to scale height and mu the cosine of
the zenith angle (Huestis 2001, J. Quant. Spectrosc. Radiat. Transfer 69, 709). The formula is also valid for
a Sun below the horizon. The model omits refraction (which raises the apparent limb by 0.2 km, or 0.004 deg),
ozone, and clouds above the limb.

Lines of sight are intersected exactly with the WGS 84 ellipsoid, in axes that are scaled so that the
ellipsoid is the unit sphere. The ground is Lambertian. Direct sunlight is attenuated by the air on the way to
the ground and again on the way to the camera. Land, sea and cloud are noise with a power-law spectrum,
sampled on a sphere in a periodic volume at two scales: continents and weather, and coasts and single clouds.
The map does not show the real Earth, but has bright edges inside the limb, which disturb a horizon detector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import erfcx, ndtri

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro import quaternion
from knightcube.astro.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    cross_product,
    tangent_basis,
)
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, semi_axes
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS

ATMOSPHERE = "atmosphere"
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
        limits = {
            "scale_height": (100.0, 50e3, "m"),
            "optical_depth": (0.011, 10.0, ""),
            "multiple": (0.0, 4.0, ""),
        }
        check_limits(ATMOSPHERE, self, limits)

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
        line's lowest point, relative to the ground. `sunward` (...) is the optical depth towards the Sun,
        from the ground below the line of sight. The scattered light comes from the air above the point where
        the optical depth along the line reaches one. The transmission of sunlight is averaged over the
        scattering air.
        """
        x = np.maximum(sunward * bottom / (1.0 + depth), 1e-6)
        return np.asarray(np.expm1(-depth) * np.expm1(-x) / x)

    def phase(self, cosines: Float32Array) -> Float32Array:
        """Return the radiance of optically thick sunlit air at cosines (...) of the scattering angle.

        The radiance is a quarter of the Rayleigh phase function times `multiple`.
        """
        return np.asarray(self.multiple * 0.1875 * (1.0 + cosines * cosines))


DEVICE = "Earth scene"


def _icrs_pole() -> FloatArray:
    return np.array([0.0, 0.0, 1.0])


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
    pole: FloatArray = field(default_factory=_icrs_pole)
    rotation: float = 0.0
    texture: int = 0
    atmosphere: Atmosphere = field(default_factory=Atmosphere)

    def __post_init__(self) -> None:
        for name, size in (("position", 3), ("attitude", 4), ("sun", 3), ("pole", 3)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (size,) or not np.all(np.isfinite(value)):
                raise ValueError(f"{DEVICE}: {name} = {value}: give ({size},) finite numbers")
            object.__setattr__(self, name, value)
        for name in ("attitude", "pole"):
            length = float(np.linalg.norm(getattr(self, name)))
            if abs(length - 1.0) > 1e-6:
                raise OutOfRange(DEVICE, f"length of {name}", length, 1.0, 1.0, "")
        if not np.isfinite(self.rotation):
            raise OutOfRange(DEVICE, "rotation", self.rotation, -np.inf, np.inf, "rad")
        outside = float(np.linalg.norm(self.in_earth(self.position) / semi_axes()))
        if outside <= 1.0:
            raise OutOfRange(DEVICE, "position in Earth radii", outside, 1.0, np.inf, "")

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


OCEAN, LAND, CLOUD = 0.06, 0.22, 0.65
"""Albedo of sea (0.05 to 0.1 in visible light), land (0.1 to 0.3) and cloud (up to 0.8)."""
LAND_SHARE, CLOUD_SHARE = 0.29, 0.55
"""Fractions of the Earth covered by land and by cloud."""

_CELLS = 96
"""Edge length (cells) of the periodic noise volume."""
_SLOPE = -2.3
"""Exponent of the noise amplitude as a power of the wave number, as for the spectrum of clouds."""
_RADIUS = 0.42 * _CELLS
"""Radius (cells) of the Earth's sphere in the noise volume."""
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
    """Return the periodic noise (n,), interpolated linearly between the cells, at `places` (3, n) in cells.

    The real part is the noise for land and the imaginary part that for clouds, so both are read at once.
    """
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
    """First intersections of n lines of sight with the Earth's ellipsoid, or the points nearest to it.

    Attributes:
        hits: whether (n,) each line of sight meets the ground.
        heights: heights (n,) of the nearest points above the ellipsoid, m; 0 for lines that meet the ground,
            infinite for lines that point away from the Earth.
        places: intersections or nearest points (n, 3), in Earth-fixed axes that are scaled to the unit
            sphere.
    """

    hits: BoolArray
    heights: Float32Array
    places: FloatArray


def look(scene: EarthScene, rays: FloatArray) -> EarthIntersection:
    """Return the intersections of `rays` (n, 3) of any length, in camera axes, with the Earth."""
    axes = semi_axes()
    origin = scene.in_earth(scene.position) / axes
    into_earth = (scene.camera_matrix @ scene.earth_matrix.T) / axes
    # The coordinates are computed as rows of contiguous numbers, which is several times faster.
    scaled = into_earth.T @ rays.T
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
    heights = np.where(ahead, np.maximum(length - 1.0, 0.0) * local, np.inf).astype(np.float32)
    return EarthIntersection(np.asarray(hits), heights, places.T)


def near_earth(scene: EarthScene, rays: Float32Array) -> IntArray:
    """Return the indices of the `rays` (n, 3), camera axes, that may pass below the height `TOP`.

    The indices include all rays for which `look` returns a height below `TOP`, and some further rays.
    """
    axes = semi_axes()
    origin = scene.in_earth(scene.position) / axes
    into_earth = (scene.camera_matrix @ scene.earth_matrix.T) / axes
    reach = float(origin @ origin) - (1.0 + TOP / float(axes.min())) ** 2
    if reach <= 0.0:
        return np.arange(len(rays))
    scaled = into_earth.T.astype(np.float32) @ rays.T
    along = origin.astype(np.float32) @ scaled
    squares = scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2]
    # The margin of 1e-5 is far larger than the rounding errors of 32-bit numbers.
    return np.flatnonzero((along < 0.0) & (along * along > np.float32(reach * (1.0 - 1e-5)) * squares))


def radiance(scene: EarthScene, rays: FloatArray, sight: EarthIntersection) -> Float32Array:
    """Return the radiance (n,) along unit `rays` (n, 3) in camera axes, without the Sun's disc.

    `sight` holds the intersections of the rays with the Earth.
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


def _chosen(vectors: FloatArray, at: IntArray) -> Float32Array:
    """Return the columns `at` of vectors (3, n) as 32-bit numbers."""
    coarse = vectors.astype(np.float32)
    return coarse if len(at) == vectors.shape[1] else coarse[:, at]


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
    """Return the brightness of the Sun's disc (mean 1) at squared relative radii (...) from 0 to 1."""
    rim = 1.0 - RIM_DARKENING * (1.0 - np.sqrt(np.maximum(1.0 - share, 0.0)))
    return np.asarray(rim / (1.0 - RIM_DARKENING / 3.0))


def transmission(scene: EarthScene, rays: FloatArray) -> FloatArray:
    """Return the fraction (n,) of sunlight that reaches the camera along `rays` (n, 3), camera axes."""
    sight = look(scene, rays)
    through = np.exp(-scene.atmosphere.tangent_depth(sight.heights))
    return np.where(sight.hits, 0.0, through)
