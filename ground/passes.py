"""Passes of a satellite over ground stations, and its eclipses, predicted from two-line elements.

Skyfield propagates the elements (SGP4) and finds rise, culmination and set. The package
`knightcube.astro.earth` computes the Sun's position, the Earth's shadow and the uncertainty of the elements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from skyfield.api import EarthSatellite, Time, load, wgs84
from skyfield.nutationlib import iau2000b_radians
from skyfield.toposlib import GeographicPosition

from flight.schema.document import ConfigError, Document, convert, read_document, read_text
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.astro.earth.orientation import celestial_to_terrestrial, terrestrial_time
from knightcube.astro.earth.sun import DAY, earth_from_sun, julian_date, sunlit_share
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

_SEARCH_S = 3600.0
"""Time (s) by which the search extends beyond the span, so that passes that overlap its ends are complete."""
_STEP_S = 10.0  # interval (s) between computed positions; begin and end of an eclipse are interpolated
_SPEED = 7.6e3  # typical speed (m/s) in a low orbit, which converts an along-track error to a timing error
NEWER = "give newer elements (`knightcube elements` with --fixes or --read)"
"""Remedy named in messages if the times predicted from the orbital elements are uncertain."""
_KNOWN_SHARE = 0.25
"""Largest standard deviation of the predicted times, as a fraction of the orbital period, with which the
revolution of a pass is known."""
SENDING = timedelta(minutes=1)
"""Shortest time from now until a scheduled command is due, because the satellite must receive it first."""
_BETWEEN = timedelta(seconds=1)
"""Shortest time between two commands of different passes: scheduled commands are due at whole seconds."""
_LOW_PERIOD_S = 9000.0
"""Longest period of an orbit in which each pass is shorter than `_SEARCH_S`."""
LEAD_S = 120.0
"""Default time (s) for the slew, between the command to point to the station and the rise."""
_RISE, _CULMINATION, _SET = range(3)
"""Codes of the events rise, culmination and set in the results of `EarthSatellite.find_events`."""


class Station(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Ground station.

    Attributes:
        name: name of the station in tables and plots.
        latitude_deg: geodetic latitude, degrees.
        longitude_deg: longitude, degrees, positive to the east.
        height: height above the WGS 84 ellipsoid, m.
        mask_deg: minimum elevation for contact with a satellite, degrees.
    """

    name: Annotated[str, Meta(min_length=1, max_length=40)]
    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=360.0)]
    height: Annotated[float, Meta(ge=-500.0, le=9000.0)] = 0.0
    mask_deg: Annotated[float, Meta(ge=0.0, lt=90.0)] = 5.0

    @property
    def text(self) -> str:
        """The station as the text that `station_of` reads."""
        numbers = (self.latitude_deg, self.longitude_deg, self.height, self.mask_deg)
        return ",".join([self.name.replace(",", " "), *(f"{number:.12g}" for number in numbers)])

    def on_earth(self) -> GeographicPosition:
        """Return the position of the station for Skyfield."""
        return wgs84.latlon(self.latitude_deg, self.longitude_deg, self.height)


class _Stations(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    stations: Annotated[tuple[Station, ...], Meta(min_length=1)]


@dataclass(frozen=True, slots=True)
class Pass:
    """Pass of a satellite over a ground station, while the satellite is above the minimum elevation.

    Attributes:
        station: the ground station.
        rise: UTC at which the satellite rises above the minimum elevation.
        top: UTC of the highest elevation.
        set: UTC at which the satellite sets below the minimum elevation.
        azimuths_deg: azimuths at rise, highest elevation and set, degrees, from north to east.
        elevation_deg: highest elevation, degrees.
        range: distance of the satellite at the highest elevation, m.
        sunlit: visible fraction of the Sun's disc at the satellite at the highest elevation.
        sun_elevation_deg: elevation of the Sun above the station's horizon, at the time `top`, degrees.
    """

    station: Station
    rise: datetime
    top: datetime
    set: datetime
    azimuths_deg: tuple[float, float, float]
    elevation_deg: float
    range: float
    sunlit: float
    sun_elevation_deg: float


def facts_of(one: Pass) -> dict[str, object]:
    """Return a pass as JSON data."""
    return {
        "station": one.station.name,
        **{f"{name}_utc": getattr(one, name).isoformat() for name in ("rise", "top", "set")},
        "azimuths_deg": list(one.azimuths_deg),
        "elevation_deg": one.elevation_deg,
        "range_m": one.range,
        "sunlit": one.sunlit,
        "sun_elevation_deg": one.sun_elevation_deg,
    }


def scheduled_targets(
    passes: Sequence[Pass], lead: float = LEAD_S, earliest: datetime | None = None
) -> list[list[tuple[datetime, PointingTarget]]]:
    """Return UTC and target of the commands for each pass, which point to the station and back to nadir.

    The passes are in order of rise. The first command of a pass is due `lead` s before the rise, but not
    before the preceding pass ends, because until then the satellite points to the station of the preceding
    pass. No command is due before `earliest`. A pass that ends during an earlier pass, or before `earliest`,
    has no commands.
    """
    found: list[list[tuple[datetime, PointingTarget]]] = []
    # End of the latest pass that has commands.
    free: datetime | None = None if earliest is None else earliest - _BETWEEN
    for one in passes:
        place = (math.radians(one.station.latitude_deg), math.radians(one.station.longitude_deg))
        begin = one.rise - timedelta(seconds=lead)
        if free is not None:
            begin = max(begin, free + _BETWEEN)
        if begin >= one.set:
            found.append([])
            continue
        found.append([(begin, PointingTarget(Goal.GROUND, place)), (one.set, PointingTarget(Goal.NADIR))])
        free = one.set
    return found


def read_stations(path: Path) -> tuple[Station, ...]:
    """Return the stations in a YAML file with the list `stations`.

    Raises ConfigError for a file that cannot be read, and for a wrong value.
    """
    return convert(read_document(read_text(path, packaged=False), str(path)), _Stations).stations


def station_of(text: str) -> Station:
    """Return the station in a text NAME,LATITUDE,LONGITUDE[,HEIGHT[,MASK]], in degrees and metres.

    Raises UsageError for a wrong value.
    """
    form = "give NAME,LATITUDE,LONGITUDE[,HEIGHT[,MASK]], such as Berlin,52.5,13.4"
    name, *numbers = text.split(",")
    keys = ("latitude_deg", "longitude_deg", "height", "mask_deg")
    if not 2 <= len(numbers) <= len(keys):
        raise UsageError(f"station {text!r}: {form}")
    try:
        values: dict[str, Any] = dict(zip(keys, map(float, numbers), strict=False))
        return convert(Document({"name": name.strip(), **values}, f"station {text!r}", {}), Station)
    except (ValueError, ConfigError) as error:
        problem = str(error) if isinstance(error, ConfigError) else f"station {text!r}: {error}"
        raise UsageError(f"{problem}; {form}") from error


class OrbitPrediction:
    """Passes and eclipses of a satellite within a span of time."""

    def __init__(self, lines: tuple[str, str], begin: datetime, days: float) -> None:
        """Propagate two-line elements over a span of `days` days from the UTC `begin`.

        Raises UsageError for invalid elements, and for elements that describe no orbit in the span.
        """
        self.begin, self.end = begin, begin + timedelta(days=days)
        self._elements = TwoLineElements(*lines)
        self._scale = load.timescale(builtin=True)
        self._satellite = EarthSatellite(*lines, "satellite", self._scale)
        count = math.ceil(days * DAY / _STEP_S) + 1
        seconds = np.linspace(0.0, days * DAY, count)
        self._at = [begin + timedelta(seconds=float(time)) for time in seconds]
        self._positions = np.asarray(self._satellite.at(self._times(self._at)).position.m, dtype=float).T
        try:
            for edge in (self.begin, self.end):
                self._elements.at(julian_date(edge))
        except OrbitError as error:
            raise UsageError(f"no passes from {begin:%Y-%m-%d} on: {error}") from error

    @property
    def period_s(self) -> float:
        """Duration (s) of a revolution."""
        return 60.0 * math.tau / float(self._satellite.model.no_kozai)

    @property
    def timing_error_s(self) -> float:
        """Standard deviation (s) of predicted times at the end of the span due to the age of the elements."""
        return self._elements.at(julian_date(self.end)).sigma / _SPEED

    def check_age(self) -> None:
        """Raise UsageError if the predicted times are uncertain by more than a quarter of a revolution."""
        if self.timing_error_s > _KNOWN_SHARE * self.period_s:
            epoch = f"{self._satellite.epoch.utc_datetime():%Y-%m-%d}"
            problem = f"the times at the end have a standard deviation of {self.timing_error_s:.0f} s"
            cure = f"{NEWER}, or a time near {epoch}"
            raise UsageError(f"the elements of {epoch} are too old: {problem}: {cure}")

    def _times(self, at: Sequence[datetime]) -> Time:
        """Return times with the nutation model IAU 2000B.

        This model needs a tenth of the processor time of Skyfield's IAU 2000A. It changes the positions by a
        few centimetres.
        """
        times = self._scale.from_datetimes(list(at))
        times._nutation_angles_radians = iau2000b_radians(times)
        return times

    def passes(self, stations: Sequence[Station]) -> list[Pass]:
        """Return the passes over all stations that overlap the span, in order of rise.

        Raises UsageError if the satellite never sets at a station, such as a geostationary satellite. Raises
        UsageError also if the elements are too old to predict the revolution of a pass.
        """
        self.check_age()
        found = [one for station in stations for one in self._over(station)]
        return sorted(found, key=lambda one: (one.rise, one.station.name))

    def _over(self, station: Station) -> Iterator[Pass]:
        place = station.on_earth()
        around = timedelta(seconds=_SEARCH_S if self.period_s < _LOW_PERIOD_S else self.period_s)
        first, last = (self._scale.from_datetime(at) for at in (self.begin - around, self.end + around))
        times, events = self._satellite.find_events(place, first, last, altitude_degrees=station.mask_deg)
        if _SET not in events and self._seen_from(place, [self.end])[0][0] > station.mask_deg:
            problem = f"the satellite stays above {station.mask_deg:g} deg, so that no pass begins or ends"
            raise UsageError(f"station {station.name}: {problem}: omit this station")
        own: list[datetime] = []
        for time, event in zip(times, events, strict=True):
            at = time.utc_datetime()
            own = [at] if event == _RISE else [*own, at]
            if event != _SET or len(own) < 3:  # shorter if the pass began before the search interval
                continue
            if own[-1] > self.begin and own[0] < self.end:
                yield self._described(station, place, own)

    def _described(self, station: Station, place: GeographicPosition, own: list[datetime]) -> Pass:
        """Return the pass whose rise, culminations and set are at the times `own`."""
        elevations, azimuths, ranges = self._seen_from(place, own)
        top = 1 + int(np.argmax(elevations[1:-1]))
        sun = -earth_from_sun(float(terrestrial_time(julian_date(own[top]))))[0]
        position = np.asarray(self._satellite.at(self._scale.from_datetime(own[top])).position.m, dtype=float)
        north, east = math.radians(station.latitude_deg), math.radians(station.longitude_deg)
        level = math.cos(north)
        up = np.array([level * math.cos(east), level * math.sin(east), math.sin(north)])
        towards = celestial_to_terrestrial(julian_date(own[top])) @ (sun / np.linalg.norm(sun))
        return Pass(
            station,
            own[0],
            own[top],
            own[-1],
            (float(azimuths[0]), float(azimuths[top]), float(azimuths[-1])),
            float(elevations[top]),
            float(ranges[top]),
            float(sunlit_share(position, sun)),
            math.degrees(math.asin(float(np.clip(up @ towards, -1.0, 1.0)))),
        )

    def _seen_from(
        self, place: GeographicPosition, at: Sequence[datetime]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return elevations, azimuths (n,), degrees, and distances (n,), m, of the satellite."""
        elevation, azimuth, distance = (self._satellite - place).at(self._times(at)).altaz()
        return np.asarray(elevation.degrees), np.asarray(azimuth.degrees), np.asarray(distance.m)

    def elevation(self, station: Station, at: datetime) -> float:
        """Return the satellite's elevation at one time, degrees, above the horizon of a station."""
        return float(self._seen_from(station.on_earth(), [at])[0][0])

    def elevations(self, station: Station) -> tuple[list[datetime], FloatArray]:
        """Return times within the span, and the satellite's elevation (n,), degrees, at each time."""
        return self._at, self._seen_from(station.on_earth(), self._at)[0]

    def eclipses(self) -> list[tuple[datetime, datetime]]:
        """Return start and end of each eclipse in the span.

        At the start and at the end of an eclipse, half of the Sun's disc is visible.
        """
        dates = np.array([julian_date(at) for at in self._at])
        # The Sun's direction changes slowly, so that 25 ephemeris values a day are sufficient.
        knots = np.linspace(dates[0], dates[-1], 2 + math.ceil(24.0 * (dates[-1] - dates[0])))
        known = np.array([-earth_from_sun(float(terrestrial_time(date)))[0] for date in knots])
        sun = np.column_stack([np.interp(dates, knots, column) for column in known.T])
        shade = 0.5 - sunlit_share(self._positions, sun)
        seconds = (dates - dates[0]) * DAY
        change = np.flatnonzero((shade[1:] > 0.0) != (shade[:-1] > 0.0))
        between = shade[change] / (shade[change] - shade[change + 1])
        edges = list(seconds[change] + between * (seconds[change + 1] - seconds[change]))
        edges = ([0.0] if shade[0] > 0.0 else []) + edges + ([seconds[-1]] if shade[-1] > 0.0 else [])
        at = [self.begin + timedelta(seconds=float(edge)) for edge in edges]
        return list(zip(at[::2], at[1::2], strict=True))
