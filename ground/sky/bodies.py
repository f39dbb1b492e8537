"""Sun, Moon and planets in a picture, seen from the Earth's centre.

ERFA's series: plan94 (Simon et al. 1994: a few arcseconds, Jupiter and Saturn 80", 1800 to 2050), moon98
(Meeus 1998: 10"), epv00 for the Earth. ERFA is a dependency already, and needs no file of ephemerides. An
observer on the ground sees the Moon up to 1 deg elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import erfa
import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, earth_from_sun
from knightcube.vision.startracker.sky_map import SkyMap

PLANETS = {"Mercury": 1, "Venus": 2, "Mars": 4, "Jupiter": 5, "Saturn": 6, "Uranus": 7, "Neptune": 8}
_LIGHT_DAY_PER_UNIT = ASTRONOMICAL_UNIT / 299_792_458.0 / DAY


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A body in a picture: its direction (3,), ICRS without aberration, and its place (2,) px."""

    name: str
    direction: FloatArray
    point: FloatArray


def bodies_in(sky: SkyMap, julian_date: float) -> list[Body]:
    """Return the bodies within a picture at a Julian date TT."""
    names, directions = zip(*directions_of_bodies(julian_date).items(), strict=True)
    places = sky.pixels(np.array(directions))
    inside = np.isfinite(places).all(axis=1) & sky.camera.contains(places)
    return [Body(names[k], directions[k], places[k]) for k in np.flatnonzero(inside)]


def directions_of_bodies(julian_date: float) -> dict[str, FloatArray]:
    """Return the unit vector (3,), ICRS, of every body from the Earth's centre; light's time is taken off."""
    earth = earth_from_sun(julian_date)[0] / ASTRONOMICAL_UNIT
    found = {
        "Sun": -earth,
        "Moon": np.asarray(erfa.moon98(julian_date, 0.0)["p"], dtype=float),
    }
    for name, number in PLANETS.items():
        away = np.zeros(3)
        for _ in range(3):
            then = julian_date - _LIGHT_DAY_PER_UNIT * float(np.linalg.norm(away))
            away = np.asarray(erfa.plan94(then, 0.0, number)["p"], dtype=float) - earth
        found[name] = away
    return {name: away / np.linalg.norm(away) for name, away in found.items()}
