"""The Earth's shadow: the visible share of the Sun's disc.

Sease 2.15 corrected: evaluated at the object's own position, and by default with the penumbra.
The Earth is a sphere of its equatorial radius without an atmosphere.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import SUN_RADIUS

Shadow = Literal["conical", "cylindrical"]


def sunlit_share(position: FloatArray, sun: FloatArray, shadow: Shadow = "conical") -> FloatArray:
    """Return the share (...) of the Sun's disc visible from `position` (..., 3) m: 0 in the umbra.

    `sun` (..., 3) m is its geocentric position. "conical" takes the overlap of the discs of Sun and Earth
    (Montenbruck & Gill 2000, 3.4.2); "cylindrical" gives 0 or 1 (Sease 2.15 corrected).
    """
    position, sun = np.asarray(position, dtype=float), np.asarray(sun, dtype=float)
    if shadow == "cylindrical":
        return np.where(_in_cylinder(position, sun), 0.0, 1.0)
    if shadow != "conical":
        raise ValueError(f"shadow = {shadow!r}: give conical or cylindrical")
    to_sun = sun - position
    distance = np.linalg.norm(position, axis=-1)
    sun_distance = np.linalg.norm(to_sun, axis=-1)
    sun_disc = np.arcsin(SUN_RADIUS / sun_distance)
    earth_disc = np.arcsin(np.minimum(1.0, EARTH_RADIUS / distance))
    cosine = -np.sum(position * to_sun, axis=-1) / (distance * sun_distance)
    # By the cross product, because the arc cosine is imprecise near zero.
    sine = np.linalg.norm(np.cross(position, to_sun), axis=-1) / (distance * sun_distance)
    apart = np.arctan2(sine, cosine)
    return 1.0 - _covered(sun_disc, earth_disc, apart)


def _in_cylinder(position: FloatArray, sun: FloatArray) -> BoolArray:
    towards = sun / np.linalg.norm(sun, axis=-1, keepdims=True)
    distance = np.linalg.norm(position, axis=-1)
    cosine = np.sum(position * towards, axis=-1) / distance
    tangent = np.sqrt(np.maximum(0.0, distance**2 - EARTH_RADIUS**2)) / distance
    return np.asarray(cosine <= -tangent)


def _covered(disc: FloatArray, cover: FloatArray, apart: FloatArray) -> FloatArray:
    """Return the share of a disc of radius `disc` that another of radius `cover` hides, centres `apart`, rad.

    Two plane discs that overlap hide the two segments beyond their common chord. The plane is accurate enough
    because the Sun's disc is small and the Earth's limb nearly straight across it.
    """
    crossing = (apart < disc + cover) & (apart > np.abs(disc - cover))
    safe = np.where(crossing, apart, disc + cover)
    chord = np.clip((safe**2 + disc**2 - cover**2) / (2.0 * safe * disc), -1.0, 1.0)
    other = np.clip((safe**2 + cover**2 - disc**2) / (2.0 * safe * cover), -1.0, 1.0)
    first = disc**2 * (np.arccos(chord) - chord * np.sqrt(1.0 - chord**2))
    second = cover**2 * (np.arccos(other) - other * np.sqrt(1.0 - other**2))
    within = np.where(apart <= cover - disc, 1.0, np.where(apart <= disc - cover, (cover / disc) ** 2, 0.0))
    return np.asarray(np.where(crossing, (first + second) / (np.pi * disc**2), within))
