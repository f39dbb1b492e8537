"""Where a satellite was: its place over the ground, the Sun and the day's side, from its two-line elements.

On a testbed, and without elements in the run's configuration, nothing is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema.reader import load
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.geomagnetism import GeomagneticError, field
from knightcube.astro.earth.orbit_knowledge import OrbitError, OrbitState, TwoLineElements
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic, terrestrial_time
from knightcube.astro.earth.sun import DAY, earth_from_sun, sunlit_share
from knightcube.errors import FlightError

Object = dict[str, Any]
_UNIX_EPOCH = 2_440_587.5
_TRACK_STEP, _TRACK_HALF = 60.0, 5700.0  # s: a revolution of a low orbit before and after


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Of one flight.

    Attributes:
        camera: the star camera's turn into the body (4,) and its field of view, rad.
        coil_dipole: of a coil at the limit of its current, A m^2.
    """

    elements: TwoLineElements | None
    camera: tuple[list[float], float] | None
    coil_dipole: float | None = None

    @classmethod
    def of(cls, path: Path) -> Surroundings:
        """Return those of a configuration; nothing is known without one that can be read."""
        try:
            config: Any = load(path)
        except FlightError:
            return NOWHERE
        lines = getattr(config, "elements", None)
        camera = getattr(config, "camera", None)
        sight = None if camera is None else (list(camera.mounting), math.radians(camera.field_of_view_deg))
        return cls(TwoLineElements(*lines) if lines else None, sight, _coil_dipole(config))

    def at(self, utc_ns: int) -> Object | None:
        """Return place, directions (3,), ICRS, and the points below satellite and Sun, deg."""
        state = self._state(_julian_date(utc_ns))
        if state is None:
            return None
        sun_place = -earth_from_sun(float(terrestrial_time(state.julian_date)))[0]
        place = self._below(state)
        to_ground = celestial_to_terrestrial(state.julian_date)
        sun_ground = to_ground @ (sun_place / np.linalg.norm(sun_place))
        return {
            "latitude": place[0],
            "longitude": place[1],
            "altitude_km": place[2] * 1e-3,
            "sun_latitude": math.degrees(math.asin(sun_ground[2])),
            "sun_longitude": math.degrees(math.atan2(sun_ground[1], sun_ground[0])),
            "sunlit": float(sunlit_share(state.position[None], sun_place[None])[0]),
            "sun": _direction(sun_place - state.position),
            "nadir": _direction(-state.position),
            "velocity": _direction(state.velocity),
            "field_t": _field(state),
        }

    def track(self, utc_ns: int) -> list[list[float]]:
        """Return the ground track [[latitude, longitude], ...] deg, a revolution before and after."""
        if self.elements is None:
            return []
        dates = _julian_date(utc_ns) + np.arange(-_TRACK_HALF, _TRACK_HALF, _TRACK_STEP) / DAY
        states = [self._state(float(date)) for date in dates]
        return [list(self._below(state)[:2]) for state in states if state is not None]

    def _state(self, date: float) -> OrbitState | None:
        try:
            return None if self.elements is None else self.elements.at(date)
        except OrbitError:
            return None

    def _below(self, state: OrbitState) -> tuple[float, float, float]:
        longitude, latitude, height = geodetic(celestial_to_terrestrial(state.julian_date) @ state.position)
        return math.degrees(float(latitude)), math.degrees(float(longitude)), float(height)


def _coil_dipole(config: Any) -> float | None:
    """Return the largest dipole of a coil of either body's configuration, A m^2."""
    if (craft := getattr(config, "craft", None)) is not None:
        return float(craft.dipole_per_ampere * config.coils.current_limit)
    if (plant := getattr(config, "plant", None)) is not None:
        return float(plant.coil_turns * plant.coil_area * config.coils.current_limit)
    return None


NOWHERE = Surroundings(None, None)
"""Nothing is known."""


def _julian_date(utc_ns: int) -> float:
    return _UNIX_EPOCH + utc_ns * 1e-9 / DAY


def _direction(vector: FloatArray) -> list[float]:
    unit: list[float] = (vector / np.linalg.norm(vector)).tolist()
    return unit


def _field(state: OrbitState) -> list[float] | None:
    try:
        found: list[float] = field(state.julian_date, state.position).tolist()
    except GeomagneticError:
        return None
    return found
