"""What a slew's planner takes from an orbit's prediction: field, place, cones of Sun, Earth and Moon.

Times of slews count from `begin` s of the ephemeris.
"""

from __future__ import annotations

import math

import erfa
import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import pressures
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.guidance.three_axes.slew_cones import Cone
from knightcube.gnc.guidance.three_axes.slew_model import Along, Around
from knightcube.gnc.guidance.three_axes.slew_path import SlewPath


def along(
    ephemeris: Ephemeris, begin: float, areas: FloatArray | None = None, path: SlewPath | None = None
) -> Along:
    """Return field, position, air and light over the time of a slew.

    Air and light press by the `areas` (3,) that a body on `path` shows to them.
    """

    def around(times: FloatArray) -> Around:
        since = begin + times
        pressed = pressures(ephemeris, since)
        if areas is not None and path is not None:
            pressed = pressed.facing(areas, attitude_matrix(path.references(times).quaternion))
        return Around(ephemeris.field_at(since), ephemeris.position_at(since), pressed)

    return around


def cones(ephemeris: Ephemeris, begin: float, axis: FloatArray, **angles: float) -> tuple[Cone, ...]:
    """Return the cones that body `axis` (3,) keeps, rad: `sun` and `moon` from centre, `earth` from limb."""
    date = float(terrestrial_time(ephemeris.julian_date + begin / 86_400.0))
    moon = ASTRONOMICAL_UNIT * np.asarray(erfa.moon98(date, 0.0)["p"], dtype=float)

    def towards_earth(times: FloatArray) -> FloatArray:
        place = ephemeris.position_at(begin + times)
        return np.asarray(-place / np.linalg.norm(place, axis=1, keepdims=True))

    def towards_moon(times: FloatArray) -> FloatArray:
        away = moon - ephemeris.position_at(begin + times)
        return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))

    distance = float(np.linalg.norm(ephemeris.position_at(np.array([begin]))[0]))
    limb = math.asin(min(1.0, EARTH_RADIUS / distance))
    known = {
        "sun": (lambda times: ephemeris.sun_at(begin + times), 0.0),
        "earth": (towards_earth, limb),
        "moon": (towards_moon, 0.0),
    }
    return tuple(
        Cone(name.capitalize(), axis, known[name][0], known[name][1] + angle)
        for name, angle in angles.items()
    )
