"""A frame of known attitude: its light over the sky, and the stars that the catalogue has there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.objects.object_fit import (
    STAR_SIGMA,
    Fitted,
    Patch,
    Trails,
    fit_object,
    reach_of,
)
from knightcube.vision.startracker.detection.survey import Survey
from knightcube.vision.startracker.sky_map import SkyMap

_BRIGHTEST = 1.0 + 3.0 * STAR_SIGMA
"""Of a star's light by the catalogue: what is more is not its."""
_LEAST_SHARE = 0.15
"""Of the light of the stars beside an object, that it must have: a star's image is known to about a tenth."""
_APART = 1.0
"""px from the nearest star, at least: nearer, a close pair is told from an object by nothing."""
_STEP_TO_SIGMA = 1.4826 / np.sqrt(2.0)
"""From the median step between neighbouring pixels to their noise."""
_MISFIT = 3.0
"""Of the patch with the object: one that fits worse is a tangle of other things."""


@dataclass(frozen=True, slots=True, eq=False)
class Stars:
    """The n catalogue stars of a frame: trails' `middle` and `half` (n, 2) px, and `magnitude` (n,)."""

    middle: FloatArray
    half: FloatArray
    magnitude: FloatArray


def stars_in(sky: SkyMap, epoch: float, shape: tuple[int, ...], rotation: FloatArray) -> Stars:
    """Return the stars of the frame and its margin; the camera turns by `rotation` (3,) rad, camera axes."""
    known = catalogue.load()
    directions = known.directions_at(epoch)
    centre = np.array([[(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0]])
    corner = sky.directions(np.vstack([centre, [[0.0, 0.0]]]))
    near = directions @ corner[0] > float(corner[0] @ corner[1]) - 0.01
    directions = directions[near]
    middle = sky.pixels(directions)
    half = np.zeros(middle.shape)
    if rotation.any():
        turns = (multiply(from_rotation_vector(s * rotation), sky.quaternion) for s in (-0.5, 0.5))
        begin, end = (replace(sky, quaternion=turn).pixels(directions) for turn in turns)
        half = 0.5 * (end - begin)
    seen = np.isfinite(middle).all(axis=1) & np.isfinite(half).all(axis=1)
    return Stars(middle[seen], half[seen], known.magnitude[near][seen])


class Scene:
    """The pixels about any place of a frame, with the stars there; places and light in px and counts."""

    def __init__(self, seen: Survey, stars: Stars, zero: float, psf: float) -> None:
        """`zero`: magnitude of one count."""
        self._light, self._sky = seen.pixels, seen.sky
        # The survey's noise has the faint stars in it, which are as smooth as their image.
        steps = np.abs(np.diff(seen.pixels[::4].astype(np.float64), axis=1))
        self._noise = max(float(np.median(steps)) * _STEP_TO_SIGMA, 1e-3)
        self._gain, self._ceiling, self._psf = seen.settings.gain or 1.0, seen.areas.ceiling, psf
        self._trails = Trails(stars.middle, stars.half, 10.0 ** (0.4 * (zero - stars.magnitude)))

    def measured(self, point: FloatArray, half: FloatArray, flux: float) -> Fitted | None:
        """Return the object near `point` (2,) px of a half extent (2,) px."""
        patch = self._patch(point, reach_of(half, self._psf))
        return None if patch is None else fit_object(patch, point, half, flux, self._near(point, patch))

    def beside(self, point: FloatArray, length: float, significance: float) -> Fitted | None:
        """Return an object whose light runs together with that of known stars, None without one.

        `point` (2,) is the middle of their light, `length` px its length. The object is where most is left
        when the stars are taken away.
        """
        patch = self._patch(point, 0.5 * length + reach_of(np.zeros(2), self._psf))
        if patch is None:
            return None
        stars = self._near(point, patch)
        left = patch.light.copy()
        for middle, half, flux in zip(stars.middle, stars.half, stars.flux, strict=True):
            image = patch.image(middle, half)
            share = patch.usable * image / (patch.noise**2 + flux * image / patch.gain)
            # No more than the star may have: the object's light must not go to it.
            light = float(np.sum(share * left)) / max(float(np.sum(share * image)), 1e-300)
            left -= np.clip(light, 0.0, _BRIGHTEST * flux) * image
        top = np.where(patch.usable, left, -np.inf)[1:-1, 1:-1]
        row, column = np.unravel_index(int(np.argmax(top)), top.shape)
        start = patch.corner + np.array([column + 1, row + 1])
        flux = float(top[row, column]) * 2.0 * np.pi * self._psf**2
        faint = flux < significance * patch.noise * np.sqrt(4.0 * np.pi) * self._psf
        found = None if faint else self.measured(start, np.array([0.3, 0.3]), flux)
        if found is None or found.flux < significance * found.flux_sigma or found.misfit > _MISFIT:
            return None
        away = np.linalg.norm(stars.middle - found.middle, axis=1)
        beside = stars.flux[away < reach_of(np.zeros(2), self._psf)]
        told = len(away) and away.min() > _APART and found.flux > _LEAST_SHARE * beside.max(initial=0.0)
        return found if told else None

    def _near(self, point: FloatArray, patch: Patch) -> Trails:
        """Return the stars that light a patch and stand above its noise."""
        near = self._trails.near(point, 0.5 * max(patch.light.shape) + 3.0 * self._psf)
        bright = near.flux > 3.0 * patch.noise
        return Trails(near.middle[bright], near.half[bright], near.flux[bright])

    def _patch(self, point: FloatArray, reach: float) -> Patch | None:
        """Return the pixels within `reach` px of a point (2,) in each axis, None off the frame."""
        rows, columns = self._light.shape
        x, y = np.rint(point).astype(int)
        size = int(np.ceil(reach))
        left, top, right, bottom = x - size, y - size, x + size + 1, y + size + 1
        if left < 0 or top < 0 or right > columns or bottom > rows:
            return None
        counts = self._light[top:bottom, left:right].astype(np.float64)
        row, column = np.mgrid[top:bottom, left:right]
        light = counts - self._sky.level.at(column.ravel(), row.ravel()).reshape(counts.shape)
        ceiling = self._ceiling - float(np.median(counts - light))
        usable = counts < self._ceiling
        return Patch(light, np.array([left, top]), self._noise, self._gain, usable, self._psf, ceiling)
