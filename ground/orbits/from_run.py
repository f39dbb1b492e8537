"""First orbits of a run's objects, from the sightings and the craft's own places in its `track` packets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import DAY, earth_velocity
from knightcube.errors import UsageError
from knightcube.gnc.first_orbit import (
    MINIMUM_SIGHTINGS,
    ArcError,
    Bearings,
    FirstOrbit,
    first_orbit,
    smoothed,
)

_UNIX_EPOCH = 2_440_587.5


@dataclass(frozen=True, slots=True, eq=False)
class ObjectOrbit:
    """What is known of an object's orbit.

    Attributes:
        number: of the object in the flight.
        sightings, span: how many, over how many s.
        utc_ns: of the orbit, None without one.
        orbit: None where the sightings determine none; then `reason` says why.
    """

    number: int
    sightings: int
    span: float
    utc_ns: int | None
    orbit: FirstOrbit | None
    reason: str

    @property
    def date(self) -> datetime:
        """The orbit's time."""
        assert self.utc_ns is not None
        return datetime.fromtimestamp(self.utc_ns * 1e-9, UTC)


def orbits_of(run: Run) -> list[ObjectOrbit]:
    """Return one for each object that was tracked. Raises UsageError for a run without any."""
    tracks, labels = run["track"], run["run"]
    if not len(tracks) or not len(labels):
        raise UsageError(f"{run.folder}: no object was tracked; `camera: {{objects: {{}}}}` looks for them")
    start_ns = int(labels["utc_ns"][-1])
    return [_orbit(number, tracks, start_ns) for number in sorted(set(tracks["number"].tolist()))]


def _orbit(number: int, tracks: PacketArray, start_ns: int) -> ObjectOrbit:
    track = tracks[tracks["number"] == number]
    seen = track[np.isfinite(track["measured"]).all(axis=1)]
    times = seen["middle_ns"] * 1e-9
    span = float(times[-1] - times[0]) if len(times) else 0.0
    found = ObjectOrbit(number, len(seen), span, None, None, "")
    placed = seen[np.isfinite(seen["place"]).all(axis=1)]
    if len(placed) < MINIMUM_SIGHTINGS:
        reason = f"{len(placed)} sightings with the craft's own place: {MINIMUM_SIGHTINGS} or more are needed"
        return replace(found, reason=reason)
    times = placed["middle_ns"] * 1e-9
    middle = len(times) // 2
    measured = np.hstack([placed["place"], placed["velocity"]])
    observer, own = smoothed(times, measured, placed["place_sigma"], middle)
    utc_ns = start_ns + int(placed["middle_ns"][middle])
    date = float(terrestrial_time(_UNIX_EPOCH + utc_ns * 1e-9 / DAY))
    bearings = Bearings(times, placed["measured"], placed["measured_sigma"], observer, earth_velocity(date))
    try:
        orbit = first_orbit(bearings)
    except ArcError as error:
        return replace(found, reason=str(error))
    # An error of the craft's own orbit shifts the object's by as much.
    return replace(found, utc_ns=utc_ns, orbit=replace(orbit, covariance=orbit.covariance + own))
