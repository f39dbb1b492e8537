"""Where streaks really end, about where a motion puts their ends.

Once an end lies more than a few widths of the point spread beyond the light, the pixels about it only show
that they are dark: the fit may settle there, each star pulled a little to and fro by others that
cross it. The whole stretch decides: light ends where that much of it, rather than none, explains the most
from the inside on. Where another star crosses an end that is somewhere else; most streaks agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.maximum_likelihood.end_checks import brightness, expected_brightness
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from knightcube.vision.streaks.maximum_likelihood.motion import positions
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, path_lengths, window_times

# Looked at is this part of a streak's length to either side of its end, between this many px, in this many
# steps.
_REACH = 0.08
_LEAST_REACH, _MOST_REACH = 10.0, 40.0
_STEPS = 41
# An end can be judged when its stretch of light stands out by this many deviations.
_TELLING = 5.0
# Light of others counts at most this many times the star's own.
_CAP = 2.0
# This many streaks at least must be too long or too short, by this many px, by the same to this many, and
# this many times as many as are as long as they should be.
_LEAST_STREAKS = 3
_LEAST_OFF = 4.0
_ALIKE = 3.0
_MORE = 2
# Beyond this change of the rate, in parts of it, the light is too uneven.
_MOST_GROWTH = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """By how many px (n, 2) streaks go on beyond where they should end, NaN where unknown."""

    beyond: FloatArray
    length: FloatArray

    @property
    def stretch(self) -> float:
        """The part of itself by which the motion is too small, 0 where streaks do not agree against it."""
        off = self.beyond.sum(axis=1)
        known = np.isfinite(off)
        off, length = off[known], self.length[known]
        wrong = off[np.abs(off) > _LEAST_OFF]
        if len(wrong) < _LEAST_STREAKS:
            return 0.0
        agree = np.abs(wrong[:, None] - off) < _ALIKE
        most = agree[np.argmax(agree.sum(axis=1))]
        if most.sum() < max(_LEAST_STREAKS, _MORE * np.count_nonzero(np.abs(off) <= _LEAST_OFF)):
            return 0.0
        return float(np.median(off[most] / length[most]))


def find_edges(camera: ExposedCamera, scene: Scene) -> Edges:
    """Return where the streaks of `scene` end in the frame, beside where its motion puts their ends."""
    motion, stars = scene.motion, scene.stars
    length = path_lengths(camera.pinhole, motion, stars)
    beyond = np.full((len(stars), 2), np.nan)
    long = np.flatnonzero(length > 2.0 * _LEAST_REACH)
    if not len(long):
        return Edges(beyond, length)
    stars, own = stars[long], np.maximum(length[long], 1.0)
    reach = np.clip(_REACH * own, _LEAST_REACH, _MOST_REACH)
    outward = np.linspace(-1.0, 1.0, _STEPS) * reach[:, None]
    times = window_times(camera.pinhole, motion, camera.shutter, stars)
    expected = expected_brightness(scene.light[long], own)[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        time = times[:, end, None] + sign * outward / own[:, None]
        mean, deviation = brightness(
            camera.frame, camera.pinhole, motion, np.repeat(stars, _STEPS, axis=0), time.reshape(-1, 1)
        )
        mean, deviation = mean.reshape(-1, _STEPS), np.maximum(deviation.reshape(-1, _STEPS), 1e-6)
        seen = np.minimum(np.maximum(mean, -expected), _CAP * expected)
        # What light explains more than darkness does, from the inside on.
        explained = np.cumsum((seen - 0.5 * expected) * expected / deviation**2, axis=1)
        last = np.argmax(explained, axis=1)
        sure = np.sum((expected / deviation) ** 2, axis=1) > _TELLING**2
        known = np.isfinite(mean).all(axis=1) & sure
        found = outward[np.arange(len(last)), last] + 0.5 * (outward[:, 1] - outward[:, 0])
        beyond[long, end] = np.where(known, found, np.nan)
    return Edges(beyond, length)


def stretched(camera: ExposedCamera, scene: Scene) -> Scene | None:
    """Return `scene` with a motion by which its streaks end where their light does; None when they do.

    Also None where the rate changes so much that the light along a streak is not alike.
    A star stays where its ends are, or the one that is on the detector.
    """
    if abs(scene.motion.relative_growth) > _MOST_GROWTH:
        return None
    edges = find_edges(camera, scene)
    stretch = edges.stretch
    if stretch == 0.0:
        return None
    off = edges.beyond / np.maximum(edges.length, 1.0)[:, None]
    # Mid-exposure, in exposures of the old motion, from the one end and from the other.
    middle = np.stack([0.5 * stretch - off[:, 0], off[:, 1] - 0.5 * stretch], axis=-1)
    known = np.isfinite(middle)
    time = np.where(known, middle, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    moved = positions(camera.pinhole, scene.motion, scene.stars, time)
    motion = replace(scene.motion, turn=scene.motion.turn + stretch * scene.motion.whole)
    return replace(scene, motion=motion, stars=moved)
