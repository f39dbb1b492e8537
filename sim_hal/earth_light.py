"""Light of the Earth along lines of sight: ground, clouds, and air that scatters sunlight.

The air density decreases exponentially with height. Single scattering of sunlight in the air produces the
soft limb, twilight, and haze over the ground. The optical depth along an oblique path is the vertical optical
depth times Chapman's function. For a scale height far below the Earth's radius, Chapman's function is sqrt(pi
X/2) exp(X mu^2/2) erfc(mu sqrt(X/2)), where X is the ratio of Earth radius to scale height and mu the cosine
of the zenith angle (Huestis 2001, J. Quant. Spectrosc. Radiat. Transfer 69, 709). Huestis's formula is also
valid for a Sun below the horizon. The model omits refraction (which raises the apparent limb by 0.2 km, or
0.004 deg), ozone, and clouds above the limb.

Lines of sight are intersected exactly with the WGS 84 ellipsoid, in axes that are scaled so that the
ellipsoid is the unit sphere. The ground is Lambertian. Direct sunlight is attenuated by the air on the way to
the ground and again on the way to the camera. The map of land, sea and cloud is noise with a power-law
spectrum, sampled on a sphere within a periodic volume. The noise has two scales: continents and weather
systems, and coasts and single clouds. The map does not show the real Earth, but has bright edges inside the
limb, which disturb a horizon detector.

The function `light` computes the radiance along many lines of sight in a numpy form or a compiled form
(`knightcube.compiled`). Both forms read the air's functions from tables with linear interpolation. For scale
heights from 8 km, the relative error is below 2e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import erfcx, ndtri

from hal.interfaces.errors import check_limits
from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, semi_axes
from knightcube.compiled import compiled_form_of, loop_helper

Floats = npt.NDArray[np.floating[Any]]

_DEEPEST = -9.0
"""Smallest argument of erfcx (optical depth 1e35); smaller arguments are clipped to this value."""


@dataclass(frozen=True, slots=True)
class Atmosphere:
    """Air whose density decreases exponentially with height.

    Attributes:
        scale_height: scale height of the density, m.
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

    def tangent_depth(self, heights: Floats) -> Floats:
        """Return the optical depth of complete lines of sight with tangent heights (...), m."""
        return np.asarray(self.limb_depth * np.exp(-heights / self.scale_height))

    def slant_depth(self, cosines: Floats) -> Floats:
        """Return the optical depth from the ground to space at zenith-angle cosines (...) of either sign."""
        root = math.sqrt(0.5 * self._ratio)
        argument = np.maximum(cosines * root, _DEEPEST)
        return np.asarray(self.optical_depth * math.sqrt(math.pi) * root * erfcx(argument))

    def scattered(self, depth: Floats, bottom: Floats, sunward: Floats) -> Floats:
        """Return the fraction of sunlight scattered along lines of sight, without the phase function.

        `depth` (...) is the optical depth along the line of sight. `bottom` (...) is the air density at the
        line's lowest point, divided by the density at the ground. `sunward` (...) is the optical depth
        towards the Sun, from the ground below the line of sight. The scattered light comes from the air above
        the point where the optical depth along the line reaches one. The transmission of sunlight is averaged
        over the scattering air.
        """
        x = np.maximum(sunward * bottom / (1.0 + depth), 1e-6)
        return np.asarray(np.expm1(-depth) * np.expm1(-x) / x)

    def phase(self, cosines: Floats) -> Floats:
        """Return the radiance of optically thick sunlit air at cosines (...) of the scattering angle.

        The radiance is a quarter of the Rayleigh phase function times `multiple`.
        """
        return np.asarray(self.multiple * 0.1875 * (1.0 + cosines * cosines))


OCEAN, LAND, CLOUD = 0.06, 0.22, 0.65
"""Albedo of sea (0.05 to 0.1 in visible light), land (0.1 to 0.3) and cloud (up to 0.8)."""
LAND_SHARE, CLOUD_SHARE = 0.29, 0.55
"""Fractions of the Earth covered by land and by cloud."""

_CELLS = 96
"""Edge length (grid cells) of the periodic noise volume."""
_SLOPE = -2.3
"""Exponent of the noise amplitude as a power of the wave number, as for the spectrum of clouds."""
_MODULO = np.arange(16 * _CELLS) % _CELLS
"""Remainders modulo `_CELLS` of the whole numbers up to the largest magnified grid coordinate."""
_RADIUS = 0.42 * _CELLS
"""Radius (grid cells) of the Earth's sphere in the noise volume."""
_MAGNIFICATION, _FINE = 11.0, 0.5
"""Magnification of the coordinates for the fine noise, and ratio of fine to coarse noise amplitude."""
_RESOLUTION = 2.0**-12
"""Resolution of the stored noise, in standard deviations."""
_SOFT = 0.1
"""Width of the transition at a coast or a cloud edge, in standard deviations of the noise."""


def albedo(directions: Float32Array, noise: npt.NDArray[np.int64]) -> Float32Array:
    """Return the ground's albedo (n,) in Earth-fixed directions (3, n), from the noise of `map_noise`."""
    places = directions * np.float32(_RADIUS)
    places += np.float32(0.5 * _CELLS)
    heights = _read(noise, places * np.float32(_MAGNIFICATION))
    heights *= np.float32(_FINE)
    heights += _read(noise, places)
    heights *= np.float32(_RESOLUTION / math.hypot(1.0, _FINE))
    land, cloud = _covered(heights.real, LAND_SHARE), _covered(heights.imag, CLOUD_SHARE)
    ground = OCEAN + (LAND - OCEAN) * land
    return np.asarray(ground + (CLOUD - ground) * cloud)


def _covered(heights: Float32Array, share: float) -> Float32Array:
    """Return the fraction (n,) covered by land or cloud at noise values (n,); its mean is `share`."""
    above = (heights - np.float32(ndtri(1.0 - share))) / np.float32(_SOFT) + np.float32(0.5)
    return np.asarray(np.clip(above, 0.0, 1.0))


def _read(noise: npt.NDArray[np.int64], places: Float32Array) -> npt.NDArray[np.complex64]:
    """Return the periodic noise (n,), linearly interpolated, at `places` (3, n), in grid cells.

    The unit of the noise is `_RESOLUTION`.
    """
    low = np.floor(places)
    along, across, up = places - low
    i, j, k = low.astype(np.intp)
    k = _MODULO.take(k)
    rows = [_MODULO.take(column) * _CELLS + k for column in (j, j + 1)]
    layers = [_MODULO.take(layer) * _CELLS**2 for layer in (i, i + 1)]

    def line(layer: IntArray, row: IntArray) -> npt.NDArray[np.complex64]:
        pairs = noise.take(layer + row).view(np.int16).astype(np.float32).view(np.complex64)
        return _blended(pairs[::2], pairs[1::2], up)

    faces = [_blended(line(layer, rows[0]), line(layer, rows[1]), across) for layer in layers]
    return _blended(faces[0], faces[1], along)


def _blended(
    before: npt.NDArray[np.complex64], after: npt.NDArray[np.complex64], share: Float32Array
) -> npt.NDArray[np.complex64]:
    """Return the linear interpolation (n,) between values `before` and `after` (n,), overwriting `after`."""
    after -= before
    after *= share
    after += before
    return after


@lru_cache(maxsize=4)
def map_noise(seed: int) -> npt.NDArray[np.int64]:
    """Return the land and cloud noise, of unit variance, on a periodic cubic grid, as one flat array.

    Each 64-bit number of the array contains four 16-bit integers in the unit `_RESOLUTION`, beginning with
    the lowest bits: the land noise and the cloud noise of a grid point, and then both noises of the next grid
    point along the third axis. The compiled form of `light` therefore reads two grid points at once.
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
    steps = np.stack([land / land.std(), cloud / cloud.std()], axis=-1) / _RESOLUTION
    steps = np.clip(np.rint(steps), -32_768, 32_767)
    return np.concatenate([steps, np.roll(steps, -1, axis=2)], axis=-1).astype("<i2").view("<i8").reshape(-1)


TOP = 120e3
"""Height (m) above which the air has less than a millionth of the limb's brightness."""
FAINTEST = 2e-4
"""Smallest radiance of visible air above the limb, relative to sunlit white ground.

In air that is fainter than this, the mean radiance within a limb pixel of 10 km differs from the radiance at
the pixel's centre by less than 5e-5.
"""
_DARKEST = -0.2
"""Cosine of the Sun's zenith angle below which only air above `TOP` is lit (11.5 deg below the horizon)."""


@dataclass(frozen=True, slots=True, eq=False)
class EarthIntersection:
    """First intersections of n lines of sight with the ellipsoid, or nearest points of lines that miss it.

    The heights (n,), m, are 0 for lines that meet the ground and infinite for lines that point away from the
    Earth. The points `places` (n, 3) are in Earth-fixed axes that are scaled so that the ellipsoid is the
    unit sphere.
    """

    hits: BoolArray
    heights: Float32Array
    places: Floats


def intersect(rays: Floats, origin: FloatArray, into_earth: FloatArray) -> EarthIntersection:
    """Return the intersections of rays (3, n) of any length, in camera axes, with the Earth.

    `origin` (3,) is the camera's position in the scaled axes, and `into_earth` (3, 3) is the matrix from
    camera axes to the scaled axes. The floating-point type of `rays` limits the precision. For 32-bit rays
    from altitudes up to 2,000 km, all heights have errors below 2 m, and 99.9 % of the points have position
    errors below 20 m. Points near the limb have larger errors along the line of sight.
    """
    start = origin.astype(rays.dtype)
    axes: Floats = semi_axes().astype(rays.dtype)
    # Computing with contiguous rows of coordinates is several times faster than with rows of vectors.
    scaled = into_earth.astype(rays.dtype) @ rays
    squares, along = np.sum(scaled * scaled, axis=0), start @ scaled
    # The distance of the ray's nearest point is a more accurate test than a quadratic's discriminant.
    nearest = start[:, None] - (along / squares) * scaled
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


def near_earth(rays: Float32Array, origin: FloatArray, into_earth: FloatArray) -> IntArray:
    """Return the indices of the rays (3, n), camera axes, that may pass below the height `TOP`.

    The indices include all rays for which `intersect` returns a height below `TOP`, and some further rays.
    """
    reach = float(origin @ origin) - (1.0 + TOP / float(semi_axes().min())) ** 2
    if reach <= 0.0:
        return np.arange(rays.shape[1])
    scaled = into_earth.astype(np.float32) @ rays
    along = origin.astype(np.float32) @ scaled
    squares = scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2]
    # The margin of 1e-5 is far larger than the rounding errors of 32-bit numbers.
    return np.flatnonzero((along < 0.0) & (along * along > np.float32(reach * (1.0 - 1e-5)) * squares))


_STEPS, _SUN_STEPS = 4096, 6144
"""Numbers of intervals in the tables of `AirTables`."""
_HORIZON = 1024
"""Column of `AirTables.sun` for a Sun on the horizon; column 0 is for the cosine `_DARKEST`."""
_CHUNK = 65_536
"""Number of lines of sight that the numpy form computes at a time, because small arrays are faster."""
_BLOCK = 256
"""Number of lines of sight that `light` traces at a time."""

# A Python float would make numba compute with 64 bits, so the compiled form uses 32-bit constants.
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_FLOAT_TOP, _FLOAT_DARKEST, _FLOAT_STEPS = np.float32(TOP), np.float32(_DARKEST), np.float32(_STEPS)
_FLOAT_FAINTEST = np.float32(FAINTEST)
_PER_HEIGHT, _LIMB = np.float32(_STEPS / TOP), np.float32(_STEPS + 1)
_PER_COSINE = np.float32(_SUN_STEPS - _HORIZON)
_SIDE = np.float32(_CELLS)
_FLOAT_RADIUS, _CENTRE, _FINER = np.float32(_RADIUS), np.float32(0.5 * _CELLS), np.float32(_MAGNIFICATION)
_NORMALISED = math.hypot(1.0, _FINE) / _RESOLUTION
_FINE_SHARE = np.float32(_FINE)
_STEEPNESS = np.float32(1.0 / (_SOFT * _NORMALISED))
_LAND_EDGE = np.float32(_NORMALISED * ndtri(1.0 - LAND_SHARE))
_CLOUD_EDGE = np.float32(_NORMALISED * ndtri(1.0 - CLOUD_SHARE))
_FLOAT_OCEAN, _FLOAT_LAND, _FLOAT_CLOUD = np.float32(OCEAN), np.float32(LAND), np.float32(CLOUD)


class AirTables(NamedTuple):
    """Functions of the air at evenly spaced arguments, for linear interpolation.

    Attributes:
        sight: table (3, 2 x `_STEPS` + 3) for lines of sight. The rows are the air density at the lowest
            point divided by the density at the ground, the optical depth, and 1 - exp(-optical depth). The
            first `_STEPS` + 1 columns are for lines that meet the ground, with cosines of the zenith angle
            from 0 to 1. The other columns are for lines above the ground, with tangent heights from 0 to
            `TOP`.
        sun: table (2, `_SUN_STEPS` + 2) at cosines of the Sun's zenith angle from `_DARKEST` to 1. The rows
            are the optical depth towards the Sun, and the sunlight that reaches horizontal ground.
        share: table (1, `_STEPS` + 2) of the mean transmission of sunlight on its way to the scattering air,
            at values of 1/(1 + x) from 0 to 1. The optical depth x is that of `Atmosphere.scattered`.
    """

    sight: Float32Array
    sun: Float32Array
    share: Float32Array


@lru_cache(maxsize=4)
def air_tables(air: Atmosphere) -> AirTables:
    """Return the tables of an atmosphere."""
    steps = np.arange(_STEPS + 2) / _STEPS
    bottom = np.exp(-TOP * steps / air.scale_height)
    depth = np.concatenate([air.slant_depth(steps[:-1]), air.limb_depth * bottom])
    sight = np.stack([np.concatenate([np.ones(_STEPS + 1), bottom]), depth, -np.expm1(-depth)])
    cosines = (np.arange(_SUN_STEPS + 2) - _HORIZON) / (_SUN_STEPS - _HORIZON)
    towards = air.slant_depth(cosines)
    sun = np.stack([towards, np.maximum(cosines, 0.0) * np.exp(-towards)])
    x = 1.0 / np.clip(steps, 1e-9, 1.0 - 1e-9) - 1.0
    share = -np.expm1(-x) / x
    return AirTables(*(table.astype(np.float32) for table in (sight, sun, share[None])))


def _interpolated(table: Float32Array, places: Float32Array) -> Float32Array:
    """Return the values (k, n) of `table` (k, m), linearly interpolated at column numbers `places` (n,)."""
    low = places.astype(np.intp)
    before, after = table.take(low, axis=1), table.take(low + 1, axis=1)
    after -= before
    after *= places - low.astype(np.float32)
    after += before
    return after


def light_numpy(
    rays: Float32Array,
    origin: FloatArray,
    into_earth: FloatArray,
    axes: FloatArray,
    sun: FloatArray,
    sunlight: float,
    haze: float,
    sight_table: Float32Array,
    sun_table: Float32Array,
    share_table: Float32Array,
    noise: npt.NDArray[np.int64],
) -> tuple[Float32Array, BoolArray]:
    """Return the radiance along rays, as the numpy form of `light`."""
    radiance = np.zeros(rays.shape[1], dtype=np.float32)
    at_limb = np.zeros(rays.shape[1], dtype=np.bool_)
    into_axes = (into_earth * axes[:, None]).astype(np.float32)
    scale, direction = axes.astype(np.float32)[:, None], sun.astype(np.float32)
    for first in range(0, rays.shape[1], _CHUNK):
        part = rays[:, first : first + _CHUNK]
        chosen = near_earth(part, origin, into_earth)
        part = _chosen(part, chosen)
        meeting = intersect(part, origin, into_earth)
        normals = _unit(meeting.places.T / scale)
        solar = direction @ normals
        lit = np.flatnonzero((meeting.heights < TOP) & (solar > _DARKEST))
        part, places, normals = (_chosen(vectors, lit) for vectors in (part, meeting.places.T, normals))
        solar, hits, chosen = solar[lit], meeting.hits[lit], chosen[lit] + first
        part = into_axes @ part
        upward = np.clip(-np.sum(part * normals, axis=0), 0.0, 1.0)
        # The cosine of the scattering angle is 1 (forward scattering) for a line of sight towards the Sun.
        turned = direction @ part
        above = meeting.heights[lit] * _PER_HEIGHT + np.float32(_STEPS + 1)
        place = np.where(hits, upward * np.float32(_STEPS), above)
        bottom, depth, opacity = _interpolated(sight_table, place)
        towards, warmth = _interpolated(sun_table, (np.minimum(solar, 1.0) - _DARKEST) * _PER_COSINE)
        depth += 1.0
        share = _interpolated(share_table, np.float32(_STEPS) * depth / (depth + towards * bottom))[0]
        found = np.float32(haze) * (1.0 + turned * turned) * opacity * share
        ground = np.flatnonzero(hits & (warmth > 0.0))
        matt = np.float32(sunlight) * warmth[ground] * (1.0 - opacity[ground])
        found[ground] += matt * albedo(_unit(places[:, ground] * scale), noise)
        radiance[chosen] = found
        at_limb[chosen] = ~hits & (found > FAINTEST)
    return radiance, at_limb


def _chosen(vectors: Float32Array, at: IntArray) -> Float32Array:
    """Return the columns of `vectors` (3, n) with the indices `at`, in ascending order."""
    return vectors if len(at) == vectors.shape[1] else vectors.take(at, axis=1)


def _unit(vectors: Float32Array) -> Float32Array:
    """Return vectors (3, n) with unit length."""
    x, y, z = vectors
    return np.asarray(vectors / np.sqrt(x * x + y * y + z * z))


@compiled_form_of(light_numpy)
def light(
    rays: Float32Array,
    origin: FloatArray,
    into_earth: FloatArray,
    axes: FloatArray,
    sun: FloatArray,
    sunlight: float,
    haze: float,
    sight_table: Float32Array,
    sun_table: Float32Array,
    share_table: Float32Array,
    noise: npt.NDArray[np.int64],
) -> tuple[Float32Array, BoolArray]:
    """Return the Earth's radiance (n,) along rays, and the mask (n,) of rays with visible air above the limb.

    Air is visible if its radiance exceeds `FAINTEST`.

    Args:
        rays: unit vectors (3, n) in camera axes; the radiance along a ray of NaN is 0.
        origin: position (3,) of the camera in the scaled axes.
        into_earth: matrix (3, 3) from camera axes into the scaled axes.
        axes: semi-axes (3,) of the ellipsoid, m.
        sun: unit vector (3,) to the Sun, Earth-fixed axes.
        sunlight: solar irradiance divided by the irradiance at 1 au.
        haze: radiance of optically thick sunlit air at right angles to the Sun.
        sight_table: first table of `air_tables`.
        sun_table: second table of `air_tables`.
        share_table: third table of `air_tables`.
        noise: noise of land and cloud from `map_noise`.
    """
    count = rays.shape[1]
    radiance = np.zeros(count, np.float32)
    at_limb = np.zeros(count, np.bool_)
    # Flat arrays with offsets of _BLOCK permit vector instructions; rows of two-dimensional arrays do not.
    traced, shaded = np.empty(6 * _BLOCK, np.float32), np.empty(2 * _BLOCK, np.float32)
    points = np.empty(3 * _BLOCK, np.float32)
    heights = np.empty(2 * _BLOCK, np.float32)
    lit, ground = np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.int64)
    down, lowest = _earthward(origin, into_earth, axes)
    for start in range(0, count, _BLOCK):
        size = min(_BLOCK, count - start)
        if not _steepest(rays, start, size, down) > lowest:
            continue
        _trace(rays, start, size, origin, into_earth, axes, sun, traced)
        number = 0
        for i in range(size):
            if traced[_BLOCK + i] >= _ZERO:
                lit[number] = i
                number += 1
        _shade(traced, lit, number, sight_table, sun_table, share_table, np.float32(haze), shaded)
        below = 0
        for j in range(number):
            i = lit[j]
            radiance[start + i] = shaded[j]
            at_limb[start + i] = traced[i] >= _LIMB and shaded[j] > _FLOAT_FAINTEST
            if shaded[_BLOCK + j] > _ZERO:
                ground[below] = j
                for axis in range(3):
                    points[axis * _BLOCK + below] = traced[(3 + axis) * _BLOCK + i]
                below += 1
        _find_albedo(points, below, noise, heights)
        for k in range(below):
            j = ground[k]
            radiance[start + lit[j]] += np.float32(sunlight) * shaded[_BLOCK + j] * points[k]
    return radiance, at_limb


@loop_helper
def _earthward(
    origin: FloatArray, into_earth: FloatArray, axes: FloatArray
) -> tuple[tuple[np.float32, np.float32, np.float32], np.float32]:
    """Return the unit vector (3,) to the Earth's centre, camera axes, and the limit of a scalar product.

    A unit ray stays above the height `TOP` if its scalar product with the vector is below the limit.
    """
    x, y, z = origin[0] * axes[0], origin[1] * axes[1], origin[2] * axes[2]
    distance = math.sqrt(x * x + y * y + z * z)
    x, y, z = -x / distance * axes[0], -y / distance * axes[1], -z / distance * axes[2]
    sine = (max(axes[0], axes[1], axes[2]) + TOP) / distance
    # The margin of 1e-5 is far larger than the rounding errors of 32-bit numbers.
    lowest = math.sqrt(1.0 - sine * sine) - 1e-5 if sine < 1.0 else -2.0
    m = into_earth
    right = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
    below = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
    ahead = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
    return (np.float32(right), np.float32(below), np.float32(ahead)), np.float32(lowest)


@loop_helper
def _steepest(
    rays: Float32Array, start: int, size: int, down: tuple[np.float32, np.float32, np.float32]
) -> np.float32:
    """Return the largest scalar product of `down` (3,) with the `size` rays that begin at column `start`.

    Rays that are not numbers are ignored.
    """
    x, y, z = down
    largest = -_ONE
    for i in range(start, start + size):
        largest = max(largest, x * rays[0, i] + y * rays[1, i] + z * rays[2, i])
    return largest


@loop_helper
def _trace(
    rays: Float32Array,
    start: int,
    size: int,
    origin: FloatArray,
    into_earth: FloatArray,
    axes: FloatArray,
    sun: FloatArray,
    traced: Float32Array,
) -> None:
    """Compute `traced` for the `size` lines of sight that begin at column `start` of `rays` (3, n).

    For each line of sight, the array `traced` (6 x `_BLOCK`) contains the column number of `AirTables.sight`,
    the column number of `AirTables.sun` (-1 for a dark line of sight), the cosine of the scattering angle,
    and the point on the ground (3), m.
    """
    m = into_earth.astype(np.float32)
    m11, m12, m13, m21, m22, m23 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m31, m32, m33 = m[2, 0], m[2, 1], m[2, 2]
    o1, o2, o3 = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    a1, a2, a3 = np.float32(axes[0]), np.float32(axes[1]), np.float32(axes[2])
    b1, b2, b3 = _ONE / a1, _ONE / a2, _ONE / a3
    s1, s2, s3 = np.float32(sun[0]), np.float32(sun[1]), np.float32(sun[2])
    for i in range(size):
        x, y, z = rays[0, start + i], rays[1, start + i], rays[2, start + i]
        u, v, w = m11 * x + m12 * y + m13 * z, m21 * x + m22 * y + m23 * z, m31 * x + m32 * y + m33 * z
        squares, along = u * u + v * v + w * w, o1 * u + o2 * v + o3 * w
        inverse = _ONE / squares
        share = along * inverse
        x, y, z = o1 - share * u, o2 - share * v, o3 - share * w
        distance = x * x + y * y + z * z
        length = np.sqrt(distance)
        local = np.sqrt(a1 * a1 * x * x + a2 * a2 * y * y + a3 * a3 * z * z) / length
        height = max(length - _ONE, _ZERO) * local
        back = np.sqrt(max(_ONE - distance, _ZERO) * inverse)
        x, y, z = x - back * u, y - back * v, z - back * w
        n1, n2, n3 = x * b1, y * b2, z * b3
        normal = _ONE / np.sqrt(n1 * n1 + n2 * n2 + n3 * n3)
        solar = min((s1 * n1 + s2 * n2 + s3 * n3) * normal, _ONE)
        upward = min(back * squares * normal, _ONE)
        traced[i] = upward * _FLOAT_STEPS if distance <= _ONE else height * _PER_HEIGHT + _LIMB
        bright = (along < _ZERO) & (height < _FLOAT_TOP) & (solar > _FLOAT_DARKEST)
        traced[_BLOCK + i] = (solar - _FLOAT_DARKEST) * _PER_COSINE if bright else -_ONE
        traced[2 * _BLOCK + i] = s1 * a1 * u + s2 * a2 * v + s3 * a3 * w
        traced[3 * _BLOCK + i] = x * a1
        traced[4 * _BLOCK + i] = y * a2
        traced[5 * _BLOCK + i] = z * a3


@loop_helper
def _shade(
    traced: Float32Array,
    lit: IntArray,
    number: int,
    sight_table: Float32Array,
    sun_table: Float32Array,
    share_table: Float32Array,
    haze: np.float32,
    shaded: Float32Array,
) -> None:
    """Store the radiance of the air, and the radiance of white ground at 1 au, in `shaded` (2 x `_BLOCK`).

    The first `number` entries of `lit` are the indices of the sunlit lines of sight in `traced`.
    """
    for j in range(number):
        i = lit[j]
        place = traced[i]
        low = int(place)
        step = place - np.float32(low)
        bottom = _between(sight_table, 0, low, step)
        depth = _ONE + _between(sight_table, 1, low, step)
        opacity = _between(sight_table, 2, low, step)
        direct = _ONE - opacity if place < _LIMB else _ZERO
        place, turned = traced[_BLOCK + i], traced[2 * _BLOCK + i]
        low = int(place)
        step = place - np.float32(low)
        towards = _between(sun_table, 0, low, step)
        shaded[_BLOCK + j] = direct * _between(sun_table, 1, low, step)
        place = _FLOAT_STEPS * depth / (depth + towards * bottom)
        low = int(place)
        share = _between(share_table, 0, low, place - np.float32(low))
        shaded[j] = haze * (_ONE + turned * turned) * opacity * share


@loop_helper
def _between(table: Float32Array, row: int, low: int, step: np.float32) -> np.float32:
    """Return the value of a table's row at the fraction `step` from column `low` to the next column."""
    before: np.float32 = table[row, np.uint32(low)]
    after: np.float32 = table[row, np.uint32(low + 1)]
    return before + step * (after - before)


@loop_helper
def _find_albedo(
    points: Float32Array, count: int, noise: npt.NDArray[np.int64], heights: Float32Array
) -> None:
    """Replace the x coordinates of `points` (3 x `_BLOCK`) on the ground, m, by the albedo at the points.

    The other coordinates and `heights` (2 x `_BLOCK`) are overwritten with intermediate results.
    """
    for i in range(count):
        x, y, z = points[i], points[_BLOCK + i], points[2 * _BLOCK + i]
        scale = _FLOAT_RADIUS / np.sqrt(x * x + y * y + z * z)
        points[i], points[_BLOCK + i] = x * scale + _CENTRE, y * scale + _CENTRE
        points[2 * _BLOCK + i] = z * scale + _CENTRE
        heights[i], heights[_BLOCK + i] = -_LAND_EDGE, -_CLOUD_EDGE
    _add_noise(points, count, _ONE, _ONE, noise, heights)
    _add_noise(points, count, _FINER, _FINE_SHARE, noise, heights)
    for i in range(count):
        land, cloud = heights[i] * _STEEPNESS + _HALF, heights[_BLOCK + i] * _STEEPNESS + _HALF
        ground = _FLOAT_OCEAN + (_FLOAT_LAND - _FLOAT_OCEAN) * min(max(land, _ZERO), _ONE)
        points[i] = ground + (_FLOAT_CLOUD - ground) * min(max(cloud, _ZERO), _ONE)


@loop_helper
def _add_noise(
    points: Float32Array,
    count: int,
    magnification: np.float32,
    share: np.float32,
    noise: npt.NDArray[np.int64],
    heights: Float32Array,
) -> None:
    """Add the land and cloud noise at the magnified points (3 x `_BLOCK`), times `share`, to `heights`."""
    cells, pairs = np.empty(4 * _BLOCK, np.uint32), np.empty(4 * _BLOCK, np.int64)
    for n in range(count):
        i, j = np.floor(points[n] * magnification), np.floor(points[_BLOCK + n] * magnification)
        k = _within(np.floor(points[2 * _BLOCK + n] * magnification))
        layer, row = _within(i + _ONE) * _SIDE, _within(j + _ONE)
        i, j = _within(i) * _SIDE, _within(j)
        # Grid points have numbers below 2^24, which 32-bit floating-point numbers represent exactly.
        cells[n], cells[_BLOCK + n] = np.uint32((i + j) * _SIDE + k), np.uint32((i + row) * _SIDE + k)
        cells[2 * _BLOCK + n] = np.uint32((layer + j) * _SIDE + k)
        cells[3 * _BLOCK + n] = np.uint32((layer + row) * _SIDE + k)
    # This loop is separate, because only loops without scattered reads are compiled to vector instructions.
    for first in range(0, 4 * _BLOCK, _BLOCK):
        for n in range(first, first + count):
            pairs[n] = noise[cells[n]]
    for n in range(count):
        along, across = points[n] * magnification, points[_BLOCK + n] * magnification
        up = points[2 * _BLOCK + n] * magnification
        along, across, up = along - np.floor(along), across - np.floor(across), up - np.floor(up)
        land1, cloud1 = _on_line(pairs[n], up)
        land2, cloud2 = _on_line(pairs[_BLOCK + n], up)
        land3, cloud3 = _on_line(pairs[2 * _BLOCK + n], up)
        land4, cloud4 = _on_line(pairs[3 * _BLOCK + n], up)
        land1, cloud1 = land1 + across * (land2 - land1), cloud1 + across * (cloud2 - cloud1)
        land3, cloud3 = land3 + across * (land4 - land3), cloud3 + across * (cloud4 - cloud3)
        heights[n] += share * (land1 + along * (land3 - land1))
        heights[_BLOCK + n] += share * (cloud1 + along * (cloud3 - cloud1))


@loop_helper
def _within(cell: np.float32) -> np.float32:
    """Return a non-negative whole number modulo `_CELLS`."""
    turns: np.float32 = np.floor((cell + _HALF) / _SIDE)
    return cell - _SIDE * turns


@loop_helper
def _on_line(noise: np.int64, up: np.float32) -> tuple[np.float32, np.float32]:
    """Return the land and cloud noise at the fraction `up` from a grid point to the next grid point."""
    land, cloud = np.float32((noise << 48) >> 48), np.float32((noise << 32) >> 48)
    next_land, next_cloud = np.float32((noise << 16) >> 48), np.float32(noise >> 48)
    return land + up * (next_land - land), cloud + up * (next_cloud - cloud)
