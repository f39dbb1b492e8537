"""Whether the streaks found are whole, or pieces of longer ones.

A turn taken too small makes of each star a chain of streaks, end to end on one circle about the axis and
alike in light: each piece fits as well as a whole one. Stars meet so by chance only seldom.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.motion import Motion

# Pieces lie within this many px of one circle, are this many turns apart, and differ in light by this factor.
_ASIDE = 1.3
_NEXT = (0.55, 1.7)
_ALIKE = 2.5


def circles(pinhole: Pinhole, motion: Motion, stars: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the angles (n,) rad of stars at pixels (n, 2) from the axis of rotation, and about it."""
    axis = motion.whole / max(float(np.linalg.norm(motion.whole)), 1e-12)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first = first / np.linalg.norm(first)
    local = pinhole.unit_vectors(stars) @ np.stack([first, np.cross(axis, first), axis]).T
    return np.arccos(np.clip(local[:, 2], -1.0, 1.0)), np.arctan2(local[:, 1], local[:, 0])


def apart(azimuth: FloatArray, other: FloatArray) -> FloatArray:
    """Return the differences (n, m) of angles (n,) and (m,) rad, at most pi."""
    return np.asarray(np.abs(np.remainder(azimuth[:, None] - other + np.pi, 2.0 * np.pi) - np.pi))


def in_chains(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, light: FloatArray, asked: int | None = None
) -> BoolArray:
    """Return which stars (n, 2) of `light` (n,) have another like them before or behind on their circle.

    Only the first `asked` of them are judged, when that is given.
    """
    polar, azimuth = circles(pinhole, motion, stars)
    turns = apart(azimuth[:asked], azimuth) / max(float(np.linalg.norm(motion.whole)), 1e-12)
    aside = np.abs(polar[:asked, None] - polar) * pinhole.focal_length
    ratio = light[:asked, None] / np.maximum(light, 1e-9)
    joined = (aside < _ASIDE) & (turns > _NEXT[0]) & (turns < _NEXT[1])
    return np.asarray((joined & (ratio < _ALIKE) & (ratio > 1.0 / _ALIKE)).any(axis=1))


def close_by(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, others: FloatArray, distance: float
) -> BoolArray:
    """Return which of `stars` (n, 2) draw streaks within `distance` px of a streak of `others` (m, 2)."""
    polar, azimuth = circles(pinhole, motion, stars)
    other_polar, other_azimuth = circles(pinhole, motion, others)
    beside = np.abs(polar[:, None] - other_polar) * pinhole.focal_length < distance
    room = distance / (pinhole.focal_length * np.maximum(np.sin(other_polar), 1e-3))
    angle = float(np.linalg.norm(motion.whole))
    return np.asarray((beside & (apart(azimuth, other_azimuth) < angle + room)).any(axis=1))
