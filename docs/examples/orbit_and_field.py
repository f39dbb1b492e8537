"""Position of a satellite, and the magnetic field, the Sun and the Earth's shadow at that position."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np

from knightcube import (
    magnetic_field,
    orbit_state,
    propagate_elements,
    propagate_orbit,
    sun_direction,
    sunlit_fraction,
)

START = datetime(2026, 11, 26, 12, 0, 0)  # UTC

position, velocity = orbit_state(semi_major_axis=6.878e6, inclination=np.radians(97.4))
seconds = np.arange(0.0, 5_701.0, 950.0)
positions, velocities = propagate_orbit(position, velocity, seconds)

print("time, s  height, km  field, uT             Sun, deg from zenith  sunlit")
for elapsed, place, motion in zip(seconds, positions, velocities, strict=True):
    time = START + timedelta(seconds=float(elapsed))
    field = 1e6 * magnetic_field(time, place)
    distance = np.linalg.norm(place)
    angle = np.degrees(np.arccos(sun_direction(time, place, motion) @ place / distance))
    sunlit = float(sunlit_fraction(time, place))
    print(
        f"{elapsed:7.0f}  {distance / 1e3 - 6371:10.1f}  {field.round(1)!s:20}  {angle:20.1f}  {sunlit:6.2f}"
    )

ISS = (
    "1 25544U 98067A   26329.50000000  .00016717  00000-0  30000-3 0  9995",
    "2 25544  51.6400 120.0000 0006000  30.0000 330.0000 15.50000000 10008",
)
(where,), (how_fast,) = propagate_elements(ISS, [datetime(2026, 11, 25, 13, 0, 0)])
radius, speed = np.linalg.norm(where) / 1e3, np.linalg.norm(how_fast)
print(f"ISS at 13:00: {radius:.0f} km from the Earth's centre, {speed:.0f} m/s")
