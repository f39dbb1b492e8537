"""Whether a motion makes whole streaks of the light: not pieces of longer ones, nor several end to end."""

from __future__ import annotations

from enum import Enum

import numpy as np

from knightcube.vision.streaks.maximum_likelihood.chains import in_chains
from knightcube.vision.streaks.maximum_likelihood.end_checks import trailing, true_ends, unbroken
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from knightcube.vision.streaks.maximum_likelihood.matched_filter import FaintStars
from knightcube.vision.streaks.maximum_likelihood.motion import positions
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, window_times

# Share of the stars that may seem pieces of longer streaks by chance.
_MOST_CHAINED = 0.45
# Share of the ends on the detector that are where the motion puts them: without doubt, and at least.
_TRUE_ENDS = (0.75, 0.6)
# Share of the stars that are dark along a good part of their path, which one may be for reasons of its own.
_BROKEN = (0.12, 0.35)
# With this many stars both of whose ends are in place nothing else raises doubt.
_VOUCHING = 3
# Share of the light of streaks that lie in the frame from end to end which the motion must have on its side.
_WHOLE_LIGHT = 0.5
# Where the rate changes by more than the first part of itself, the second part of the stars may have light
# beyond an end.
_UNEVEN = 0.4
_MOST_TRAILING = 0.5


class Wholeness(Enum):
    """Whether the streaks' ends and the light between them support a motion."""

    WHOLE = "whole"
    DOUBTED = "doubted"
    BROKEN = "broken"


def wholeness(camera: ExposedCamera, scene: Scene, faint: FaintStars) -> Wholeness:
    """Return whether the stars that decide are as long as their light; doubted when some of them are not.

    In a crowded frame what passes for a star may be several: a few that are dark here or there do not speak
    against the motion, but ask for another witness, unless enough streaks vouch for it with both ends, which
    alone give the angle turned. So does a motion that most streaks with both ends disown, and one that none
    vouches for; where the ends of those that decide are not where they should be, it is not the motion.
    """
    stars = np.concatenate([scene.stars, faint.stars])
    light = np.concatenate([scene.light, faint.light])
    chained = in_chains(camera.pinhole, scene.motion, stars, light, len(scene.stars))
    if float(np.mean(chained[scene.trusted])) > _MOST_CHAINED:
        return Wholeness.BROKEN
    deciding = scene.select(scene.trusted)
    times = window_times(camera.pinhole, deciding.motion, camera.shutter, deciding.stars)
    seen = camera.frame, camera.pinhole, scene.motion, deciding.stars, deciding.light, times
    if abs(scene.motion.relative_growth) > _UNEVEN and trailing(*seen) > _MOST_TRAILING:
        return Wholeness.BROKEN
    ends, lit = true_ends(*seen), unbroken(*seen)
    known = np.isfinite(ends)
    both = known.all(axis=1)
    right = float(np.mean(ends[known])) if known.any() else 1.0
    if both.any() and float(np.mean(ends[both])) < _TRUE_ENDS[1]:
        return Wholeness.BROKEN
    in_place = ends[both].all(axis=1)
    vouched = np.count_nonzero(in_place) >= _VOUCHING and float(np.mean(in_place)) >= _TRUE_ENDS[0]
    dark = np.count_nonzero(lit == 0.0)
    for worst, (least_ends, most_broken) in zip(
        (Wholeness.BROKEN, Wholeness.DOUBTED), zip(_TRUE_ENDS[::-1], _BROKEN[::-1], strict=True), strict=True
    ):
        if right < least_ends or dark > max(1.0, most_broken * len(lit)):
            return Wholeness.WHOLE if vouched and worst is Wholeness.DOUBTED else worst
    unvouched = bool(known.any()) and not both.any()
    doubted = unvouched or (not vouched and _disowned(camera, scene))
    return Wholeness.DOUBTED if doubted else Wholeness.WHOLE


def _disowned(camera: ExposedCamera, scene: Scene) -> bool:
    """Return whether most light of the bright streaks that show both ends is not of stars that agree."""
    times = window_times(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    inside = np.ones(len(scene.stars), dtype=np.bool_)
    for time in times.T:
        inside &= camera.pinhole.contains(positions(camera.pinhole, scene.motion, scene.stars, time))
    # Fainter stars were never asked.
    bright = inside & (scene.light >= scene.light[scene.trusted].min())
    light = scene.light[bright]
    return float(light[scene.trusted[bright]].sum()) < _WHOLE_LIGHT * float(light.sum())
