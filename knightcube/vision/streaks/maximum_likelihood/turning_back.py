"""Whether a motion that seems to begin or to end at rest turned back within the exposure.

Where the rate changes evenly the light along a path is 1/sqrt(s), s px from where the star rests. A body
that turns back goes over the first part of the path twice: the light is doubled as far as the shorter of the
two ways leads. Ways of equal length look like one from rest, and no pixel distinguishes them. Each bright
streak's pixels are compared with the light of the fitted motion, and of others that turn back: the shorter
way takes a share of the longer one's time, and the path may be longer than fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, positions
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, path_lengths

# A rate that changes by less than this part of itself is far from rest: the pixels show how it changes.
_NEAR_REST = 1.5
_MOST_STARS = 10
# The light along a path is summed in steps of this many px, from so many before the rest to so many lengths.
_STEP = 0.5
_BEFORE = 5.0
_BEYOND = 1.9
# Px to either side of the path that count.
_ASIDE = 3
# The motions compared: times of the shorter way over the longer one's, and lengths over that of the fit.
# Ways nearly alike differ by a px or two of the path.
_SHARES = np.concatenate([np.arange(0.15, 0.96, 0.1), [0.97, 0.98, 0.99]])
_LENGTHS = np.concatenate([np.arange(0.95, 1.1, 0.01), np.arange(1.1, 1.71, 0.05)])
# Part of the light by which the profile across may be wrong.
_ROUGH = 0.05
# No star says more than this many sigmas squared.
_LOUDEST = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class _Along:
    """A streak's light along its path, and what gives chi-square for any other light there.

    Attributes:
        places: (k,) px from the rest.
        square, cross, plain: (k,) sums of w g^2, w g d and w g over the pixels nearest to each place: data d
            of weight w, and the point spread g across the path.
        moments: sums of w, w d and w d^2 over all pixels.
        pixels: their number.
    """

    places: FloatArray
    square: FloatArray
    cross: FloatArray
    plain: FloatArray
    moments: tuple[float, float, float]
    pixels: int


def turning_back(camera: ExposedCamera, scene: Scene) -> float:
    """Return by how many sigmas squared a motion that turned back explains bright streaks better.

    0 where none does. Where the rate is far from rest, or known from elsewhere, none is asked for.
    """
    motion, change = scene.motion, scene.motion.relative_growth
    if abs(change) < _NEAR_REST or motion.shape.any():
        return 0.0
    scene = scene.select(np.flatnonzero(scene.trusted))
    scene = scene.select(np.argsort(-scene.light, kind="stable")[:_MOST_STARS])
    first = -0.5 * np.sign(change)
    rests = positions(camera.pinhole, motion, scene.stars, np.full(len(scene.stars), first))
    onward = Motion.steady(-np.sign(first) * motion.whole)
    share = (0.5 - 1.0 / abs(change)) / (0.5 + 1.0 / abs(change))
    better = np.zeros((len(_SHARES), len(_LENGTHS)))
    for rest, length in zip(rests, path_lengths(camera.pinhole, motion, scene.stars), strict=True):
        streak = _along(camera, onward, rest, float(length), scene.width)
        fitted = _misfit(streak, np.array([share]), np.array([length]), scene.width)
        others = _misfit(streak, _SHARES, _LENGTHS * length, scene.width)
        scale = max(1.0, float(min(others.min(), fitted.min())) / max(streak.pixels, 1))
        better += np.clip((fitted - others) / scale, -_LOUDEST, _LOUDEST)
    return max(0.0, float(better.max()))


def _along(camera: ExposedCamera, onward: Motion, rest: FloatArray, length: float, width: float) -> _Along:
    """Return the light along the path of a star that is at pixel `rest` (2,) first and moves `onward`."""
    frame, pinhole = camera.frame, camera.pinhole
    places = np.arange(-_BEFORE, _BEYOND * length + _BEFORE, _STEP)
    path = positions(pinhole, onward, np.repeat(rest[None], len(places), axis=0), places / length)
    index = _pixels_near(path, pinhole.columns, pinhole.rows)
    index = index[~frame.bad[index]]
    points = np.stack([index % pinhole.columns, index // pinhole.columns], axis=1)
    apart = np.sum((points[:, None] - path) ** 2, axis=2)
    nearest = np.argmin(apart, axis=1)
    apart = apart[np.arange(len(index)), nearest]
    # What lies before the first place or beyond the last one is no part of the path.
    kept = (apart < _ASIDE**2) & (nearest > 0) & (nearest < len(places) - 1)
    index, apart, nearest = index[kept], apart[kept], nearest[kept]
    data = frame.signal[index].astype(float)
    bright = np.maximum(data, 0.0)
    weight = 1.0 / (frame.floor[index] + bright / frame.gain + (_ROUGH * bright) ** 2)
    across = np.exp(-0.5 * apart / width**2)
    square, cross, plain = (
        np.bincount(nearest, weight * each, len(places)).astype(float)
        for each in (across**2, across * data, across)
    )
    moments = float(np.sum(weight)), float(weight @ data), float(weight @ data**2)
    return _Along(places, square, cross, plain, moments, len(index))


def _pixels_near(path: FloatArray, columns: int, rows: int) -> IntArray:
    """Return the flat indices of the pixels about a path (k, 2)."""
    offset = np.arange(-_ASIDE, _ASIDE + 1)
    x, y = (np.rint(path[:, axis]).astype(np.int64)[:, None, None] for axis in (0, 1))
    x, y = np.broadcast_arrays(x + offset[:, None], y + offset)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return np.unique(y[inside] * columns + x[inside])


def _misfit(one: _Along, shares: FloatArray, lengths: FloatArray, width: float) -> FloatArray:
    """Return chi-square (s, l) under motions whose ways have `shares` (s,) of time and `lengths` (l,) px.

    The star's light and the sky about it are free.
    """
    edges = np.append(one.places, one.places[-1] + _STEP) - 0.5 * _STEP
    light = np.diff(_passed(edges / lengths[:, None], shares[:, None, None]), axis=-1)
    light = gaussian_filter1d(light, width / _STEP, axis=-1, mode="constant")
    square, cross, plain = light**2 @ one.square, light @ one.cross, light @ one.plain
    weight, first, second = one.moments
    determinant = np.maximum(square * weight - plain**2, 1e-30)
    explained = (weight * cross**2 - 2.0 * plain * cross * first + square * first**2) / determinant
    return np.asarray(second - explained)


def _passed(place: FloatArray, share: FloatArray) -> FloatArray:
    """Return what part of the light lies before `place`, in lengths from the rest.

    A negative `share` is of a motion that begins after the rest.
    """
    root, turned = np.sqrt(np.clip(place, 0.0, 1.0)), np.maximum(share, 0.0)
    whole = np.maximum(root, -share) + np.minimum(root, turned) + np.minimum(share, 0.0)
    return np.asarray(whole / (1.0 + share))
