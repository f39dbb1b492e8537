"""A coarse nadir where no picture shows a limb: the Earth fills one camera, the others are dark (Meller 4.1).

    looks = [light_seen(frame, camera, bright=30.0) for ...]
    coarse = coarse_nadir(looks, altitude, sun)

Each direction could be nadir. For each the Earth's disc is laid over all the cameras' samples: within its
sunlit part they should be bright, outside it and in its night dark. The directions are weighed by how many
samples they explain; their mean is the nadir and their spread its covariance. The Sun's direction, if known,
tells night from sky; without it any sample on the disc may be dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Lens
from knightcube.vision.camera.mounted import MountedCamera
from knightcube.vision.camera.pixel_access import ArrayPixels, PixelAccess
from knightcube.vision.horizon.ellipsoid import MEAN_RADIUS
from knightcube.vision.horizon.illumination import DAYLIGHT, GLARE, TWILIGHT
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT

_SAMPLES = 8
"""Of a row, on as many columns."""
_DIRECTIONS = 2000
"""That are tried: 4.5 deg apart."""
_STRAY = 0.03
"""Chance of a sample that is bright in the sky or dark on sunlit ground."""
_WEIGHT = 0.2
"""Of a sample, whose errors are those of its neighbours, too."""
_WIDEST = math.radians(30.0)
"""rad an axis: wider spreads say nothing."""
_SPACE = math.sqrt(4.0 * math.pi / _DIRECTIONS)


@dataclass(frozen=True, slots=True, eq=False)
class LightSeen:
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


def light_seen(frame: Image | PixelAccess, camera: MountedCamera, bright: float) -> LightSeen:
    """Return where a picture is bright, by 8 of its columns; `bright` counts are the sunlit Earth.

    A dark sea under a low Sun must reach them, the scattered light of the Earth beside it must not.
    """
    access = ArrayPixels(frame) if isinstance(frame, np.ndarray) else frame
    columns, rows = _places(access.columns), _places(access.rows)
    lit = access.read_columns(columns)[:, rows] > bright
    rays, imaged = _rays(Lens.of(camera.lens))
    return LightSeen(camera.in_body(rays), lit.ravel()[imaged])


def coarse_nadir(
    looks: Sequence[LightSeen], altitude: float, sun: FloatArray | None = None
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


def _places(size: int) -> IntArray:
    return np.asarray((np.arange(_SAMPLES) + 0.5) * size / _SAMPLES, dtype=int)


@lru_cache(maxsize=8)
def _rays(lens: Lens) -> tuple[FloatArray, BoolArray]:
    """Return directions (m, 3), camera axes, of the samples that the lens images, and which they are."""
    x, y = np.meshgrid(_places(lens.columns), _places(lens.rows), indexing="ij")
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
