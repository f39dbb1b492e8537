"""Checks an image's brightness against a prediction: sky, sunlit ground, night and the lit limb.

The paper leaves open how to distinguish a horizon from the terminator (Meller 3.3). A correct view predicts
the whole image: nothing bright in the sky or on the night side, and an edge all along the lit limb. A view
fitted to the terminator does not.

If no image shows a limb, the Earth fills one camera and the other cameras are dark (Meller 4.1).
`coarse_nadir` then tries directions all over the sphere. For each direction it predicts which samples of all
cameras are bright: those on the sunlit part of the Earth's disc. The directions are weighted by the number of
samples that they explain; their mean is the nadir and their spread its covariance. The Sun's direction, if
known, distinguishes night from sky; without it any sample on the disc may be dark.

`why_false` compares an image with a known attitude. An image that is mostly dark where sunlit ground must be,
or mostly bright where there can be none, comes from a broken camera: black, blinded, random or upside down.
Limb, twilight and the Sun's surroundings are excluded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.astro.directions import tangent_basis
from knightcube.vision.camera.lens import Lens, MountedCamera
from knightcube.vision.frame import ArrayPixels, PixelAccess
from knightcube.vision.horizon.edges import Samples
from knightcube.vision.horizon.limb import MEAN_RADIUS, UNIT_DEPTH_HEIGHT, LimbView, limb_residuals

TWILIGHT = np.radians(12.0)
"""Depression of the Sun (rad) beyond which ground and air count as night."""
DAYLIGHT = np.radians(8.0)
"""Elevation of the Sun (rad) beyond which ground and limb count as lit."""
GLARE = np.radians(12.0)
"""Angle from the Sun (rad) within which stray light is as bright as the Earth."""
_ATMOSPHERE = 60e3
"""Height (m) above which the air is darker than the Earth."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """How well a view explains the picture's light.

    Attributes:
        stray: the share of sky and night that is bright.
        missing: the share of sunlit ground that is dark.
        dark_samples, lit_samples: number of samples of each share.
    """

    stray: float
    missing: float
    dark_samples: int
    lit_samples: int


def sun_elevation(view: LimbView, rays: FloatArray, sun: FloatArray) -> FloatArray:
    """Return the Sun's elevation (n,) rad where rays (n, 3) meet the surface, or pass it nearest.

    `sun` (3,) is a unit vector in inertial axes.
    """
    stretching = view.surface.stretching()
    origin = stretching @ view.position
    directions = rays @ (view.rotation @ stretching)
    squares = np.einsum("ij,ij->i", directions, directions)
    along = directions @ origin
    depth = np.maximum(along * along - squares * (origin @ origin - 1.0), 0.0)
    places = origin - ((along + np.sqrt(depth)) / squares)[:, None] * directions
    normals = places @ stretching
    sine = normals @ sun / np.sqrt(np.einsum("ij,ij->i", normals, normals))
    return np.asarray(np.arcsin(np.minimum(np.maximum(sine, -1.0), 1.0)))


def agreement(view: LimbView, sun: FloatArray | None, samples: Samples) -> Agreement:
    """Return how a view agrees with samples; without a Sun only the sky counts."""
    rays, bright = samples.rays, samples.bright
    outside = limb_residuals(view, rays)
    distance = float(np.linalg.norm(view.position))
    reach = np.sqrt(max(distance**2 - view.surface.equatorial**2, 1.0))
    dark = outside > np.arctan(_ATMOSPHERE / reach)
    lit = np.zeros(len(rays), dtype=bool)
    if sun is not None:
        elevation = sun_elevation(view, rays, sun)
        away = rays @ (view.rotation @ sun) < np.cos(GLARE)
        dark = away & (dark | ((outside < 0.0) & (elevation < -TWILIGHT)))
        lit = (outside < -0.01) & (elevation > DAYLIGHT)
    darks, lits = int(np.count_nonzero(dark)), int(np.count_nonzero(lit))
    return Agreement(
        float(np.count_nonzero(bright & dark)) / max(darks, 1),
        float(np.count_nonzero(lit & ~bright)) / max(lits, 1),
        darks,
        lits,
    )


def limb_rays(view: LimbView, count: int) -> FloatArray:
    """Return `count` rays (count, 3) in camera axes evenly round the limb."""
    stretching = view.surface.stretching(view.limb_height)
    centre = -(stretching @ view.position)
    size = float(np.linalg.norm(centre))
    axis = centre / size
    stretched = np.sqrt(1.0 - size**-2) * axis + _circle(count) @ (tangent_basis(axis) / size)
    # Back from the stretched space, where the Earth is the unit sphere, then into the camera.
    rays = stretched @ (view.rotation @ view.surface.shape(view.limb_height)).T
    return np.asarray(rays / np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None])


@lru_cache(maxsize=8)
def _circle(count: int) -> FloatArray:
    angle = np.arange(count) * (2.0 * np.pi / count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


_SAMPLES = 8
"""Number of sampled rows, and of sampled columns."""
_DIRECTIONS = 2000
"""Number of directions that are tried, 4.5 deg apart."""
_STRAY = 0.03
"""Probability that a sample is bright in the sky or dark on sunlit ground."""
_WEIGHT = 0.2
"""Weight of a sample: its error is correlated with that of its neighbours."""
_WIDEST = math.radians(30.0)
"""Largest standard deviation per axis (rad) of a coarse nadir."""
_SPACE = math.sqrt(4.0 * math.pi / _DIRECTIONS)


@dataclass(frozen=True, slots=True, eq=False)
class ImageBrightness:
    """Samples of one picture: directions (n, 3) in body axes, and which of them are bright (n,)."""

    rays: FloatArray
    bright: BoolArray

    @property
    def share(self) -> float:
        """The share of the picture that is bright."""
        return float(np.mean(self.bright))


@dataclass(frozen=True, slots=True, eq=False)
class CoarseNadir:
    """A nadir of some degrees.

    Attributes:
        direction: (3,) unit vector in body axes.
        covariance: (3, 3) rad^2 of its error, nothing along it.
        explained: the share of all samples that it explains.
    """

    direction: FloatArray
    covariance: FloatArray
    explained: float

    @property
    def sigma(self) -> float:
        """The root of the mean variance over the two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


def image_brightness(frame: Image | PixelAccess, camera: MountedCamera, bright: float) -> ImageBrightness:
    """Return where a picture is bright, by 8 of its columns; `bright` counts are the sunlit Earth.

    A dark sea under a low Sun must reach them, the scattered light of the Earth beside it must not.
    """
    access = ArrayPixels(frame) if isinstance(frame, np.ndarray) else frame
    columns, rows = _sample_indices(access.columns), _sample_indices(access.rows)
    lit = access.read_columns(columns)[:, rows] > bright
    rays, imaged = _rays(Lens.of(camera.lens))
    return ImageBrightness(camera.in_body(rays), lit.ravel()[imaged])


def coarse_nadir(
    looks: Sequence[ImageBrightness], altitude: float, sun: FloatArray | None = None
) -> CoarseNadir | None:
    """Return the nadir that the light in all pictures leaves; None where it leaves too much open.

    `altitude` m is above the mean Earth; `sun` (3,) a unit vector in body axes, to ten degrees.
    """
    rays = np.concatenate([look.rays for look in looks])
    bright = np.concatenate([look.bright for look in looks])
    if sun is not None:
        away = rays @ sun < math.cos(GLARE)
        rays, bright = rays[away], bright[away]
    if not bright.any():
        return None
    tried = _sphere(_DIRECTIONS)
    expected = _expected(tried, rays, altitude, sun)
    chance = np.where(bright, expected, 1.0 - expected)
    score = _WEIGHT * np.log(chance).sum(axis=1)
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    mean = weights @ tried
    length = float(np.linalg.norm(mean))
    if length < math.cos(_WIDEST):
        return None
    direction = mean / length
    across = tried - np.outer(tried @ direction, direction)
    covariance = (across * weights[:, None]).T @ across
    covariance += _SPACE**2 / 12.0 * (np.eye(3) - np.outer(direction, direction))
    found = CoarseNadir(direction, covariance, float(chance[int(np.argmax(score))].mean()))
    return found if found.sigma < _WIDEST else None


def _expected(tried: FloatArray, rays: FloatArray, altitude: float, sun: FloatArray | None) -> FloatArray:
    """Return the chances (directions, samples) that a sample is bright if a direction is nadir."""
    radius = MEAN_RADIUS + UNIT_DEPTH_HEIGHT
    distance = (MEAN_RADIUS + altitude) / radius
    cosine = tried @ rays.T
    inside = cosine > math.sqrt(1.0 - distance**-2)
    if sun is None:
        return np.where(inside, 0.5, _STRAY)
    sine = sun_over_ground(cosine, rays @ sun, (tried @ sun)[:, None], distance)
    low, high = math.sin(-TWILIGHT), math.sin(DAYLIGHT)
    day = np.clip((sine - low) / (high - low), 0.0, 1.0)
    return np.where(inside, _STRAY + (1.0 - 2.0 * _STRAY) * day, _STRAY)


def sun_over_ground(cosine: FloatArray, ahead: FloatArray, below: FloatArray, distance: float) -> FloatArray:
    """Return the sine of the Sun's height where rays meet the ground: the place in radii times the Sun.

    `cosine` is of a ray's angle from nadir, `ahead` of the Sun's from the ray, `below` of the Sun's from
    nadir, of any shapes that fit together; `distance` from the Earth's centre is in its radii.
    """
    depth = np.sqrt(np.maximum(1.0 - distance**2 * (1.0 - cosine**2), 0.0))
    return np.asarray((distance * cosine - depth) * ahead - distance * below)


def _sample_indices(size: int) -> IntArray:
    return np.asarray((np.arange(_SAMPLES) + 0.5) * size / _SAMPLES, dtype=int)


@lru_cache(maxsize=8)
def _rays(lens: Lens) -> tuple[FloatArray, BoolArray]:
    """Return directions (m, 3), camera axes, of the samples that the lens images, and which they are."""
    x, y = np.meshgrid(_sample_indices(lens.columns), _sample_indices(lens.rows), indexing="ij")
    rays = lens.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1).astype(float))
    imaged = np.isfinite(rays[:, 0])
    return rays[imaged], imaged


@lru_cache(maxsize=1)
def _sphere(count: int) -> FloatArray:
    """Return unit vectors (count, 3) evenly over the sphere, along a spiral of the golden angle."""
    number = np.arange(count) + 0.5
    z = 1.0 - 2.0 * number / count
    turn = math.pi * (1.0 + math.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


_MARGIN = math.radians(5.0)
"""Angle beside the limb (rad) that is excluded: the air, and one degree of attitude error."""
_DAY = DAYLIGHT + math.radians(12.0)
_STRAY_LIGHT = math.radians(25.0)
"""Angle of a sample from the Sun (rad) within which stray light may cover the whole image."""
_LEAST = 8
"""Least number of samples, of 64, that a decision needs."""
_MOST = 0.6
"""Share of contradicting samples that no good image has: cloud shadows, seas and lens ghosts cause fewer."""


def why_false(look: ImageBrightness, nadir: FloatArray, altitude: float, sun: FloatArray) -> str:
    """Return why a picture is not of what its camera must see, empty where it may be.

    `nadir` and `sun` (3,) are unit vectors in body axes, to a degree; `altitude` m is above the mean Earth.
    """
    lit, dark = _sure(look.rays, nadir, altitude, sun)
    if _mostly(~look.bright[lit]):
        return "it is dark where the sunlit Earth is"
    if float((look.rays @ sun).max()) < math.cos(_STRAY_LIGHT) and _mostly(look.bright[dark]):
        return "it is bright where there is only sky or night"
    return ""


def _sure(
    rays: FloatArray, nadir: FloatArray, altitude: float, sun: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return which rays (n, 3) surely meet sunlit ground, and which surely no ground that the Sun lights."""
    distance = 1.0 + altitude / MEAN_RADIUS
    limb = math.asin(1.0 / distance)
    cosine = rays @ nadir
    sine = sun_over_ground(cosine, rays @ sun, np.asarray(nadir @ sun), distance)
    within, beyond = cosine > math.cos(limb - _MARGIN), cosine < math.cos(limb + _MARGIN)
    return within & (sine > math.sin(_DAY)), beyond | (within & (sine < -math.sin(TWILIGHT + _MARGIN)))


def _mostly(against: BoolArray) -> bool:
    return len(against) >= _LEAST and float(np.mean(against)) > _MOST
