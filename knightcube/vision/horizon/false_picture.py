"""Whether a wide camera's picture can be of what a known attitude puts before it.

    look = light_seen(frame, camera, bright=30.0)
    reason = why_false(look, nadir, altitude, sun)

The attitude says where sunlit ground must be and where there can be none. Limb, twilight and what is near
the Sun are left out. A picture that is mostly dark on the one, or mostly bright on the other, is a broken
camera's: black, blinded, random, upside down.
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.horizon.ellipsoid import MEAN_RADIUS
from knightcube.vision.horizon.filled_camera import LightSeen, sun_over_ground
from knightcube.vision.horizon.illumination import DAYLIGHT, TWILIGHT

_MARGIN = math.radians(5.0)
"""rad beside the limb: the air above it, and a degree of the attitude's error."""
_DAY = DAYLIGHT + math.radians(12.0)
_STRAY_LIGHT = math.radians(25.0)
"""rad: with the Sun closer to some sample its light may be in the whole picture."""
_LEAST = 8
"""Samples, of 64, that a judgement needs."""
_MOST = 0.6
"""Share of them that is otherwise in no sound picture: a cloud's shadow, a sea, a ghost of the lens."""


def why_false(look: LightSeen, nadir: FloatArray, altitude: float, sun: FloatArray) -> str:
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
