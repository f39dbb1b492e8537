"""Comparison of images with the predicted brightness of the Earth, and estimate of a coarse nadir.

If the assumed view of the Earth is correct, the whole image agrees with it: sky and night side are dark, and
the sunlit limb has edges along its entire length. A view that was fitted to the terminator instead of the
limb does not agree with the image. Meller et al., section 3.3, do not state how to distinguish limb and
terminator.

If no image shows a limb, the Earth fills the field of one camera and the other cameras are dark (Meller et
al., section 4.1). Without a limb, `coarse_nadir` tries nadir directions that cover the sphere, and predicts
for each direction that the samples on the sunlit part of the Earth's disc are bright. The coarse nadir is the
mean of the trial directions, weighted by their likelihood, and the covariance is their spread. If the
direction of the Sun is unknown, any sample on the Earth's disc may be dark, because it may be on the night
side.

The function `why_false` compares an image with the view from a known attitude. An image contradicts the
attitude if it is mostly dark where sunlit ground must be, or mostly bright where only sky or night side can
be. Possible causes of a contradiction are a camera that has failed, is blinded, is mounted upside down or
sends random data. The comparison excludes samples near the limb, in the twilight zone and near the Sun.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, tangent_basis
from knightcube.vision.camera.lens import Lens, MountedCamera
from knightcube.vision.horizon.edges import Samples
from knightcube.vision.horizon.limb import MEAN_RADIUS, UNIT_DEPTH_HEIGHT, LimbView, limb_residuals

_TWILIGHT = np.radians(12.0)
"""Depression angle of the Sun below the horizon (rad) above which ground and atmosphere count as dark."""
DAYLIGHT = np.radians(8.0)
"""Elevation of the Sun (rad) above which ground and limb count as sunlit."""
GLARE = np.radians(12.0)
"""Angle from the Sun (rad) within which stray light may be as bright as the Earth."""
_ATMOSPHERE = 60e3
"""Tangent height (m) above which a line of sight counts as dark sky."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of an assumed view of the Earth with the brightness of an image.

    Attributes:
        stray: fraction of bright samples among the samples in the sky or on the night side.
        missing: fraction of dark samples among the samples on sunlit ground.
        dark_samples, lit_samples: numbers of samples in the sky or on the night side, and on sunlit ground.
    """

    stray: float
    missing: float
    dark_samples: int
    lit_samples: int


def sun_elevation(view: LimbView, rays: FloatArray, sun: FloatArray) -> FloatArray:
    """Return the Sun's elevation (n,), rad, where rays (n, 3) meet the Earth's surface or pass nearest to it.

    `sun` (3,) is the unit vector to the Sun in inertial axes.
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
    """Return how well an assumed view of the Earth agrees with samples of an image.

    If the Sun's direction is unknown, only samples in the sky outside possible glare of the Sun are compared.
    """
    rays, bright = samples.rays, samples.bright
    outside = limb_residuals(view, rays)
    dark = outside > np.arctan(_ATMOSPHERE / view.limb_distance)
    lit = np.zeros(len(rays), dtype=bool)
    if sun is not None:
        elevation = sun_elevation(view, rays, sun)
        away = rays @ (view.rotation @ sun) < np.cos(GLARE)
        dark = away & (dark | ((outside < 0.0) & (elevation < -_TWILIGHT)))
        lit = (outside < -0.01) & (elevation > DAYLIGHT)
    else:
        dark &= _away_from_glare(rays, dark, bright)
    darks, lits = int(np.count_nonzero(dark)), int(np.count_nonzero(lit))
    stray = float(np.count_nonzero(bright & dark)) / max(darks, 1)
    return Agreement(stray, float(np.count_nonzero(lit & ~bright)) / max(lits, 1), darks, lits)


_LEAST_GLARE, _IN_GLARE = 4, 0.8
"""Minimum number of bright sky samples, and minimum fraction near their mean direction, that show the Sun."""
_ROUND_GLARE = 0.85
"""Minimum bright fraction of the samples nearest to the assumed Sun, for the glare to count as round."""


def _away_from_glare(rays: FloatArray, sky: BoolArray, bright: BoolArray) -> BoolArray:
    """Return which rays (n, 3) are outside the Sun's glare, located by the bright samples in the sky.

    The assumed direction of the Sun is the mean direction of the bright samples in the sky, if most of these
    samples are within the glare of this direction and form a round patch. The masks `sky` (n,) and `bright`
    (n,) mark the samples in the sky and the bright samples. A band of clouds is not round and is therefore
    not glare.
    """
    everywhere = np.ones(len(rays), dtype=bool)
    bright = bright & sky
    count = np.count_nonzero(bright)
    if count < _LEAST_GLARE:
        return everywhere
    middle = rays[bright].sum(axis=0)
    cosine = rays @ (middle / np.linalg.norm(middle))
    glare = sky & (cosine > np.cos(GLARE))
    inside = np.count_nonzero(bright & glare)
    if inside <= _IN_GLARE * count:
        return everywhere
    nearest = np.argsort(-cosine[glare])[:inside]
    is_round = np.mean(bright[glare][nearest]) > _ROUND_GLARE
    return np.asarray(cosine < np.cos(GLARE)) if is_round else everywhere


_LEAST_SKY = 8
"""Minimum number of samples in the assumed sky for a test of whether the sky looks like space."""
_DIM_AIR = 30e3
"""Height (m) above the limb at which the atmosphere has 3 % of its maximum brightness.

This height replaces `_ATMOSPHERE` if the image has too few samples above `_ATMOSPHERE`.
"""
_CLEAR = 24.0
"""Minimum distance (px) of a sample from the atmosphere, so that none of its averaged pixels shows the Earth.
"""
_DARKEST = 0.15
"""Largest median brightness of space, as a fraction of the range from the dark to the bright level."""
_BLACKEST = 0.35
"""Largest dark level of an image of space, as a fraction of the bright level."""
_SMOOTHEST, _NOISES = 0.01, 2.0
"""Largest texture (`Samples.mottle`) of space.

The limit is the larger of `_SMOOTHEST` and `_NOISES` times the noise of a sample.
"""


def why_not_space(view: LimbView, sun: FloatArray | None, samples: Samples, pixel: float) -> str:
    """Return why the image beyond an assumed limb does not look like space, or an empty string if it does.

    Space is dark and has no texture beyond the noise of the detector. Stray light is smooth, whereas clouds
    and ground have texture. The test compares medians, so that stars and spacecraft structure have no effect
    if they cover less than half of the sky. The Sun direction `sun` (3,) is in inertial axes, and None if
    unknown. The argument `pixel` is the angular size of a pixel, rad.
    """
    outside = limb_residuals(view, samples.rays)
    away = np.ones(len(outside), dtype=bool)
    if sun is not None:
        away = samples.rays @ (view.rotation @ sun) < np.cos(GLARE)
    # In a narrow field, the atmosphere may fill the image up to a large height.
    for height in (_ATMOSPHERE, _DIM_AIR):
        sky = away & (outside > np.arctan(height / view.limb_distance) + _CLEAR * pixel)
        if np.count_nonzero(sky) >= _LEAST_SKY:
            break
    else:
        return ""
    if samples.floor > _BLACKEST:
        return f"the darkest pixels have {100.0 * samples.floor:.0f} % of the brightness of its bright side"
    level = float(np.median(samples.level[sky]))
    if level > _DARKEST:
        percent = f"{100.0 * level:.0f} %"
        return f"the dark side of the limb has a median brightness of {percent} of the bright side"
    # The median absolute value of Gaussian noise is 0.6745 standard deviations.
    mottle = float(np.median(np.abs(samples.mottle[sky]))) / 0.6745
    if mottle > max(_SMOOTHEST, _NOISES * samples.noise):
        return f"its dark side has a texture of {100.0 * mottle:.1f} % of the contrast, like ground or clouds"
    return ""


def limb_rays(view: LimbView, count: int) -> FloatArray:
    """Return unit vectors (count, 3) in camera axes to points at equal intervals around the limb."""
    stretching = view.surface.stretching(view.limb_height)
    centre = -(stretching @ view.position)
    size = float(np.linalg.norm(centre))
    axis = centre / size
    angle = np.arange(count) * (2.0 * np.pi / count)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    stretched = np.sqrt(1.0 - size**-2) * axis + circle @ (tangent_basis(axis) / size)
    # The rays are transformed from scaled axes, in which the Earth is the unit sphere, into camera axes.
    rays = stretched @ (view.rotation @ view.surface.shape(view.limb_height)).T
    return np.asarray(rays / np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None])


_SAMPLES = 8
"""Number of sampled rows, and of sampled columns, of an image."""
_DIRECTIONS = 2000
"""Number of trial directions of nadir, about 4.5 deg apart."""
_STRAY = 0.03
"""Assumed probability that a sample in the sky is bright, and that a sample on sunlit ground is dark."""
_WEIGHT = 0.2
"""Weight of a sample in the log-likelihood, below 1 because neighbouring samples have correlated errors."""
_WIDEST = math.radians(30.0)
"""Largest standard deviation per axis (rad) of a coarse nadir."""
_SPACE = math.sqrt(4.0 * math.pi / _DIRECTIONS)
"""Distance between neighbouring trial directions of nadir (rad)."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageBrightness:
    """Samples of one image: unit vectors (n, 3) in body axes, and mask of the bright samples (n,)."""

    rays: FloatArray
    bright: BoolArray

    @property
    def share(self) -> float:
        """The fraction of the samples that are bright."""
        return float(np.mean(self.bright))


@dataclass(frozen=True, slots=True, eq=False)
class CoarseNadir:
    """An estimated nadir (3,) in body axes, with an uncertainty of several degrees.

    The covariance (3, 3), rad^2, is zero along the nadir direction. The attribute `explained` is the mean
    probability of the observed brightness of the samples, given the most likely nadir.
    """

    direction: FloatArray
    covariance: FloatArray
    explained: float

    @property
    def sigma(self) -> float:
        """The standard deviation of the direction, as the rms over two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


def image_brightness(
    image: Image, camera: MountedCamera, bright: float, hidden: BoolArray | None = None
) -> ImageBrightness:
    """Return which of 8 x 8 samples of an image (rows, columns) are bright, with their directions.

    Samples in the mask `hidden` (rows, columns) are omitted.

    The argument `bright` is the threshold, counts. The threshold must be lower than the counts of a dark sea
    under a low Sun, and higher than the counts of stray light beside the Earth.
    """
    rows, columns = (_sample_indices(size) for size in image.shape)
    lit = bright < image[np.ix_(rows, columns)].T
    rays, imaged = _sample_rays(Lens.of(camera.lens))
    lit = lit.ravel()[imaged]
    if hidden is not None:
        seen = ~hidden[np.ix_(rows, columns)].T.ravel()[imaged]
        rays, lit = rays[seen], lit[seen]
    return ImageBrightness(camera.in_body(rays), lit)


def coarse_nadir(
    looks: Sequence[ImageBrightness], altitude: float, sun: FloatArray | None = None
) -> CoarseNadir | None:
    """Return the nadir that explains the brightness of all images, or None if the nadir is too uncertain.

    The altitude is above the Earth's mean radius, m. The argument `sun` is the direction of the Sun (3,) in
    body axes, accurate to ten degrees, or None if the direction is unknown.
    """
    rays = np.concatenate([look.rays for look in looks])
    bright = np.concatenate([look.bright for look in looks])
    if sun is not None:
        away = rays @ sun < math.cos(GLARE)
        rays, bright = rays[away], bright[away]
    if not bright.any():
        return None
    tried = _sphere(_DIRECTIONS)
    expected = _bright_probability(tried, rays, altitude, sun)
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


def _bright_probability(
    tried: FloatArray, rays: FloatArray, altitude: float, sun: FloatArray | None
) -> FloatArray:
    """Return the probability (d, n) that samples at `rays` (n, 3) are bright for nadirs `tried` (d, 3)."""
    radius = MEAN_RADIUS + UNIT_DEPTH_HEIGHT
    distance = (MEAN_RADIUS + altitude) / radius
    cosine = tried @ rays.T
    inside = cosine > math.sqrt(1.0 - distance**-2)
    if sun is None:
        return np.where(inside, 0.5, _STRAY)
    sine = _sun_over_ground(cosine, rays @ sun, (tried @ sun)[:, None], distance)
    low, high = math.sin(-_TWILIGHT), math.sin(DAYLIGHT)
    day = np.clip((sine - low) / (high - low), 0.0, 1.0)
    return np.where(inside, _STRAY + (1.0 - 2.0 * _STRAY) * day, _STRAY)


def _sun_over_ground(cosine: FloatArray, ahead: FloatArray, below: FloatArray, distance: float) -> FloatArray:
    """Return the sine of the Sun's elevation at the points where rays meet the surface of a sphere.

    The cosines are those of the angles between each ray and nadir, between each ray and the Sun (`ahead`),
    and between nadir and the Sun (`below`). The camera's `distance` from the sphere's centre is in its radii.
    """
    depth = np.sqrt(np.maximum(1.0 - distance**2 * (1.0 - cosine**2), 0.0))
    return np.asarray((distance * cosine - depth) * ahead - distance * below)


def _sample_indices(size: int) -> IntArray:
    return np.asarray((np.arange(_SAMPLES) + 0.5) * size / _SAMPLES, dtype=int)


@lru_cache(maxsize=8)
def _sample_rays(lens: Lens) -> tuple[FloatArray, BoolArray]:
    """Return unit vectors (m, 3) to the samples in the field of the lens, and their mask (64,)."""
    x, y = np.meshgrid(_sample_indices(lens.columns), _sample_indices(lens.rows), indexing="ij")
    rays = lens.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1).astype(float))
    imaged = np.isfinite(rays[:, 0])
    return rays[imaged], imaged


@lru_cache(maxsize=1)
def _sphere(count: int) -> FloatArray:
    """Return unit vectors (count, 3) that cover the sphere evenly (a Fibonacci lattice)."""
    number = np.arange(count) + 0.5
    z = 1.0 - 2.0 * number / count
    turn = math.pi * (1.0 + math.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


_MARGIN = math.radians(5.0)
"""Angle (rad) from the limb within which samples are not used: margin for atmosphere and attitude error."""
_DAY = DAYLIGHT + math.radians(12.0)
"""Elevation of the Sun (rad) above which ground is certainly bright."""
_STRAY_LIGHT = math.radians(25.0)
"""Angle between the Sun and the nearest sample (rad) below which stray light may cover the whole image."""
_LEAST = 8
"""Minimum number of samples (of 64) that must be predicted to be bright, or dark, for a test of the attitude.
"""
_MOST = 0.6
"""Fraction of contradicting samples above which an image contradicts the attitude.

Clouds alone cause a lower fraction of contradicting samples.
"""


def why_false(look: ImageBrightness, nadir: FloatArray, altitude: float, sun: FloatArray) -> str:
    """Return why an image contradicts a known attitude, or an empty string if it agrees.

    Nadir and Sun (3,) are in body axes, accurate to a degree. The altitude is above the mean radius, m.
    """

    def mostly(against: BoolArray) -> bool:
        return len(against) >= _LEAST and float(np.mean(against)) > _MOST

    distance = 1.0 + altitude / MEAN_RADIUS
    limb = math.asin(1.0 / distance)
    cosine = look.rays @ nadir
    sine = _sun_over_ground(cosine, look.rays @ sun, np.asarray(nadir @ sun), distance)
    within, beyond = cosine > math.cos(limb - _MARGIN), cosine < math.cos(limb + _MARGIN)
    lit = within & (sine > math.sin(_DAY))
    dark = beyond | (within & (sine < -math.sin(_TWILIGHT + _MARGIN)))
    if mostly(~look.bright[lit]):
        return "the image is dark where the sunlit Earth should be"
    if mostly(look.bright[dark]) and float((look.rays @ sun).max()) < math.cos(_STRAY_LIGHT):
        return "the image is bright where only sky or night should be"
    return ""
