"""The radiance along lines of sight: ground below air, air alone, the Sun; in units of a white matt surface.

Lines of sight are intersected with the WGS 84 ellipsoid exactly, in axes scaled so that it is the unit
sphere. The ground is matt (Lambert); direct sunlight reaches it through the air, and its light passes the
air again.

Land, sea and cloud are noise with a power-law spectrum, sampled on the sphere at two scales. The sphere cuts
through a periodic volume of noise once with the whole Earth inside (continents, weather) and once magnified
(coasts, single clouds), so there are no poles and no seams. The map is not the real Earth, but has the
feature that disturbs a horizon detector: bright edges everywhere inside the limb.

The Sun's disc is darker at the rim, hidden by the Earth, and dimmed by the air; its glare arises in the
optics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.special import ndtri

from knightcube.astro.arrays import BoolArray, FloatArray, tangent_basis
from knightcube.astro.earth.figure import semi_axes
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS
from knightcube.vision.camera.lens import CameraModel
from sim_hal.earth_camera.model import EarthCameraModel, pixel_rays
from sim_hal.earth_camera.scene import EarthScene

Float32Array = npt.NDArray[np.float32]

OCEAN, LAND, CLOUD = 0.06, 0.22, 0.65
"""Reflectances: sea reflects 0.05 to 0.1 of visible light, soil and plants 0.1 to 0.3, cloud up to 0.8."""
LAND_SHARE, CLOUD_SHARE = 0.29, 0.55

_CELLS = 96
_SLOPE = -2.3
"""Of the amplitude over wave number in three dimensions, near the spectrum of clouds."""
_RADIUS = 0.42 * _CELLS
"""Cells in the Earth's radius: the sphere fits in the volume."""
_MAGNIFICATION = 11.0
_FINE = 0.5
"""Amplitude of the fine noise over the coarse one."""
_SOFT = 0.1
"""Standard deviations of the noise over which a coast or a cloud's rim passes."""


def albedo(directions: FloatArray, seed: int) -> Float32Array:
    """Return the ground's albedo (n,) below Earth-fixed unit directions (n, 3)."""
    places = np.ascontiguousarray(directions.T, dtype=np.float32)
    places *= _RADIUS
    places += 0.5 * _CELLS
    land, cloud = (
        _covered(volume, places, share)
        for volume, share in zip(_volumes(seed), (LAND_SHARE, CLOUD_SHARE), strict=True)
    )
    ground = OCEAN + (LAND - OCEAN) * land
    return np.asarray(ground + (CLOUD - ground) * cloud)


def _covered(volume: Float32Array, places: Float32Array, share: float) -> Float32Array:
    """Return how far (n,) each of `places` (3, n) is covered, 0 .. 1, `share` of the Earth being so."""
    coarse = _read(volume, places)
    fine = _read(volume, places * np.float32(_MAGNIFICATION))
    height = (coarse + _FINE * fine) / np.hypot(1.0, _FINE)
    return np.asarray(np.clip((height - ndtri(1.0 - share)) / _SOFT + 0.5, 0.0, 1.0), dtype=np.float32)


def _read(volume: Float32Array, places: Float32Array) -> Float32Array:
    return np.asarray(map_coordinates(volume, places, order=1, mode="grid-wrap"))


@lru_cache(maxsize=4)
def _volumes(seed: int) -> tuple[Float32Array, Float32Array]:
    """Return two independent periodic volumes of zero mean and unit variance, for land and for cloud."""
    across = np.fft.fftfreq(_CELLS, 1.0 / _CELLS).astype(np.float32)
    wave = np.sqrt(across[:, None, None] ** 2 + across[None, :, None] ** 2 + across**2)
    amplitude = np.where(wave >= 1.5, np.maximum(wave, 1.5) ** _SLOPE, 0.0)
    rng = np.random.default_rng(seed)
    shape = (_CELLS, _CELLS, _CELLS)
    white = rng.standard_normal(shape, np.float32) + 1j * rng.standard_normal(shape, np.float32)
    # White noise's transform is white noise: real and imaginary parts come out independent.
    noise = np.fft.ifftn(white * amplitude)
    land, cloud = noise.real, noise.imag
    return (land / land.std()).astype(np.float32), (cloud / cloud.std()).astype(np.float32)


TOP = 120e3
"""m: height above which air is invisible (a millionth of the limb's brightness)."""
_DARKEST = -0.2
"""Cosine from the zenith of a Sun, 11.5 deg below the horizon, that lights only the air above `TOP`."""


@dataclass(frozen=True, slots=True, eq=False)
class EarthIntersection:
    """Where lines of sight (n, 3) pass: their first meeting with the ellipsoid, or their nearest point to it.

    Attributes:
        hits: which (n,) meet the ground.
        heights: m (n,), of the nearest point above the ellipsoid; 0 for those that hit, infinite where
            the Earth lies behind.
        places: points (n, 3) in Earth-fixed axes scaled to the unit sphere.
    """

    hits: BoolArray
    heights: Float32Array
    places: FloatArray


def look(scene: EarthScene, rays: FloatArray) -> EarthIntersection:
    """Return where `rays` (n, 3), of any length, in camera axes, pass the Earth."""
    axes = semi_axes()
    origin = scene.in_earth(scene.position) / axes
    into_earth = (scene.camera_matrix @ scene.earth_matrix.T) / axes
    scaled = rays @ into_earth
    squares = np.einsum("ij,ij->i", scaled, scaled)
    along = scaled @ origin
    # The nearest point's distance from the centre, without the cancellation of b^2 - ac.
    step = -along / squares
    nearest = origin + step[:, None] * scaled
    distance = np.einsum("ij,ij->i", nearest, nearest)
    ahead = along < 0.0
    hits = ahead & (distance <= 1.0)
    back = np.sqrt(np.maximum(1.0 - distance, 0.0) / squares)
    places = nearest - np.where(hits, back, 0.0)[:, None] * scaled
    length = np.sqrt(distance)
    local = np.sqrt(nearest**2 @ axes**2) / length
    heights = np.where(ahead, np.maximum(length - 1.0, 0.0) * local, np.inf).astype(np.float32)
    return EarthIntersection(np.asarray(hits), heights, places)


def radiance(scene: EarthScene, rays: FloatArray, sight: EarthIntersection) -> Float32Array:
    """Return the radiance (n,) along unit `rays` (n, 3) in camera axes that pass the Earth as `sight` says.

    The Sun's disc is left out.
    """
    result = np.zeros(len(rays), dtype=np.float32)
    seen = np.flatnonzero(sight.heights < TOP)
    normals = _normals(sight.places[seen])
    to_earth = scene.earth_matrix @ scene.camera_matrix.T
    distance = float(np.linalg.norm(scene.sun))
    sun = scene.in_earth(scene.sun / distance)
    sunward = normals @ sun
    lit = np.flatnonzero(sunward > _DARKEST)
    seen, normals = seen[lit], normals[lit]
    solar = sunward[lit].astype(np.float32)
    directions = rays[seen]
    upward = np.maximum(-np.einsum("ij,ij->i", directions, normals @ to_earth), 0.0).astype(np.float32)
    # Cosine of the scattering angle: 1, forward, for a line of sight towards the Sun.
    turned = (directions @ (to_earth.T @ sun)).astype(np.float32)
    air, hits = scene.atmosphere, sight.hits[seen]
    bottom = np.exp(-sight.heights[seen] / air.scale_height)
    depth = np.where(hits, air.slant_depth(upward), air.limb_depth * bottom)
    towards = air.slant_depth(solar)
    light = air.phase(turned) * air.scattered(depth, bottom, towards)
    ground = np.flatnonzero(hits & (solar > 0.0))
    matt = albedo(_unit(sight.places[seen[ground]] * semi_axes()), scene.texture) * solar[ground]
    light[ground] += matt * np.exp(-depth[ground] - towards[ground])
    result[seen] = light * np.float32((ASTRONOMICAL_UNIT / distance) ** 2)
    return result


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _normals(places: FloatArray) -> FloatArray:
    """Return the verticals (n, 3) at `places` (n, 3), scaled to the unit sphere, or above them."""
    return _unit(places / semi_axes())


RIM_DARKENING = 0.6
"""Linear coefficient of limb darkening near 550 nm (Cox 2000, Allen's Astrophysical Quantities)."""
_SUBPIXELS = 6
_RINGS, _SPOKES = 24, 48


def towards_sun(scene: EarthScene) -> tuple[FloatArray, float]:
    """Return the unit vector (3,) in camera axes from the camera to the Sun, and its disc's radius in rad."""
    offset = scene.sun - scene.position
    distance = float(np.linalg.norm(offset))
    return scene.camera_matrix @ offset / distance, math.asin(SUN_RADIUS / distance)


def visible_share(scene: EarthScene) -> float:
    """Return the share of the Sun's light that Earth and air let through to the camera, 0 .. 1."""
    axis, radius = towards_sun(scene)
    share = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(axis)
    rays = axis + math.tan(radius) * (share[:, None, None] * spokes).reshape(-1, 3)
    weights = np.repeat(_darkening(share**2), _SPOKES)
    return float(_transmission(scene, rays) @ weights / weights.sum())


def add_disc(scene: EarthScene, model: EarthCameraModel, image: Float32Array) -> None:
    """Add the disc's radiance, blurred, to `image` (rows, columns)."""
    axis, radius = towards_sun(scene)
    window = _window(model.lens, axis, radius, math.ceil(4.0 * model.blur) + 1)
    if window is None:
        return
    left, top, width, height = window
    grid = (np.arange(max(width, height) * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    x, y = np.meshgrid(left + grid[: width * _SUBPIXELS], top + grid[: height * _SUBPIXELS])
    rays = model.lens.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1))
    # Squares of chords: the angle's cosine is flat where the disc is.
    share = np.sum((rays - axis) ** 2, axis=1) / (2.0 * math.sin(0.5 * radius)) ** 2
    fine = np.zeros(len(rays))
    # Outside the lens's field the ray is NaN, and every comparison is false.
    inside = np.flatnonzero(share < 1.0)
    fine[inside] = _darkening(share[inside]) * _transmission(scene, rays[inside])
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
    """Add the sunlight that the optics scatter to `image` (rows, columns), the Sun in the field or beside it.

    The scattered radiance falls from its centre as 1/(1 + (s/s0)^2), s the chord: the shape of Harvey and
    Shack for polished optics, with a slope of two; over the hemisphere it holds the share `scatter`. The lens
    has no hood: sunlight reaches it from all of the half space before it, by the cosine of its incidence.
    """
    axis, _ = towards_sun(scene)
    if axis[2] <= 0.0 or model.scatter == 0.0:
        return
    light = visible_share(scene) * float(axis[2]) * scatter_centre(model)
    squares = 2.0 - 2.0 * (pixel_rays(model.lens) @ axis).reshape(image.shape)
    image += (light / (1.0 + squares / model.scatter_angle**2)).astype(np.float32)


def scatter_centre(model: EarthCameraModel) -> float:
    """Return the radiance at the centre of scattered sunlight, when it holds the share `scatter` of it all.

    The integral of 1/(1 + (s/s0)^2) over the hemisphere is pi s0^2 ln(1 + 2/s0^2), and the irradiance of the
    Sun is pi in these units.
    """
    square = model.scatter_angle**2
    return model.scatter / (square * math.log(1.0 + 2.0 / square))


def _darkening(share: FloatArray) -> FloatArray:
    """Return the disc's brightness at squares of radius (...), 0 .. 1, its mean over the disc being one."""
    rim = 1.0 - RIM_DARKENING * (1.0 - np.sqrt(np.maximum(1.0 - share, 0.0)))
    return np.asarray(rim / (1.0 - RIM_DARKENING / 3.0))


def _transmission(scene: EarthScene, rays: FloatArray) -> FloatArray:
    sight = look(scene, rays)
    through = np.exp(-scene.atmosphere.tangent_depth(sight.heights))
    return np.where(sight.hits, 0.0, through)


def _window(
    lens: CameraModel, axis: FloatArray, radius: float, margin: int
) -> tuple[int, int, int, int] | None:
    """Return left, top, width and height of the pixels that the disc and its blur may touch, or None."""
    angle = np.arange(16) * (np.pi / 8.0)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(axis)
    # A sixteen-sided figure holds the disc when it is wider by 1/cos(pi/16).
    rim = lens.project(axis + math.tan(radius) / math.cos(np.pi / 16.0) * ring)
    rim = rim[~np.isnan(rim[:, 0])]
    if not len(rim):
        return None
    # Cut to the detector before the cast: at 90 deg from the axis a rim lies beyond any integer.
    outer = np.array([lens.columns, lens.rows]) - 1 + margin
    low = np.maximum(np.floor(rim.min(axis=0)) - margin, -margin)
    high = np.minimum(np.ceil(rim.max(axis=0)) + margin, outer)
    if np.any(low > high):
        return None
    (left, top), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return left, top, width + 1, height + 1
