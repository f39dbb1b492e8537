"""Position and velocity of the satellite in ICRS axes, from the last GPS fix or from two-line elements.

A GPS fix is propagated with the gravity of a spherical Earth and the oblateness term J2, by Runge-Kutta steps
of at most 30 s. Two-line elements are propagated by SGP4 (Vallado, Crawford, Hujsak and Kelso, AIAA
2006-6753), with an error of one to three kilometres near the epoch of the elements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from sgp4.api import SGP4_ERRORS, Satrec

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.orientation import (
    ROTATION_RATE,
    celestial_to_terrestrial,
    mean_equator_to_celestial,
)
from knightcube.astro.earth.sun import DAY
from knightcube.errors import FlightError, UsageError

_LONGEST_STEP = 30.0


class OrbitError(FlightError):
    """Raised if the orbit is unknown at a time, because the last fix is too old or the orbit has decayed."""


@dataclass(frozen=True, slots=True, eq=False)
class OrbitState:
    """Position and velocity of the satellite at a given time.

    Attributes:
        julian_date: Julian date UTC.
        position: (3,) geocentric position in ICRS axes, m.
        velocity: (3,) geocentric velocity in ICRS axes, m/s.
        sigma: standard deviation of the position per axis, m.
    """

    julian_date: float
    position: FloatArray
    velocity: FloatArray
    sigma: float

    @property
    def nadir(self) -> FloatArray:
        """Unit vector (3,) from the satellite to the centre of the Earth."""
        return np.asarray(-self.position / np.linalg.norm(self.position))

    @property
    def period(self) -> float:
        """Period of the Keplerian orbit, s, or infinity for an open orbit."""
        energy = 0.5 * float(self.velocity @ self.velocity)
        energy -= GRAVITATIONAL_PARAMETER / float(np.linalg.norm(self.position))
        if energy >= 0.0:
            return math.inf
        return 2.0 * math.pi * GRAVITATIONAL_PARAMETER / math.pow(-2.0 * energy, 1.5)


@dataclass(frozen=True, slots=True, eq=False)
class GpsFix:
    """Fix of a GPS receiver.

    Attributes:
        julian_date: Julian date UTC of the fix.
        position: (3,) geocentric position in ITRS axes, m.
        velocity: (3,) velocity with respect to the ground in ITRS axes, m/s.
        sigma: standard deviation of the position per axis, m.
        velocity_sigma: standard deviation of the velocity per axis, m/s.
        longest_age: maximum time over which the fix is propagated, s.
    """

    julian_date: float
    position: FloatArray
    velocity: FloatArray
    sigma: float = 10.0
    velocity_sigma: float = 0.1
    longest_age: float = 1500.0

    def __post_init__(self) -> None:
        """Raise OrbitError for values that are not finite and for a position inside the Earth."""
        numbers = np.array([self.julian_date, *self.position, *self.velocity])
        if numbers.shape != (7,) or not np.all(np.isfinite(numbers)):
            raise OrbitError(f"fix at {self.julian_date}: position and velocity must be (3,) and finite")
        if np.linalg.norm(self.position) < 0.98 * EARTH_RADIUS:
            raise OrbitError(f"fix at {self.julian_date}: {self.position} m is within the Earth")

    def at(self, julian_date: float) -> OrbitState:
        """Return the orbit state propagated to a Julian date UTC. Raises OrbitError if the fix is too old."""
        age = (julian_date - self.julian_date) * DAY
        if not abs(age) <= self.longest_age:
            raise OrbitError(f"the last fix is {age:.0f} s old: fixes are used for {self.longest_age:g} s")
        to_ground = celestial_to_terrestrial(self.julian_date)
        with_ground = self.velocity + np.cross([0.0, 0.0, ROTATION_RATE], self.position)
        state = np.concatenate([self.position @ to_ground, with_ground @ to_ground])
        later = propagated(state, age)
        # In orbit, an along-track velocity error causes three times the position error of free space.
        sigma = math.hypot(self.sigma, 3.0 * age * self.velocity_sigma)
        return OrbitState(julian_date, later[:3], later[3:], sigma)


class TwoLineElements:
    """Two-line element set, whose assumed position error grows linearly with the time since its epoch."""

    def __init__(self, first: str, second: str, sigma: float = 1500.0, growth: float = 1500.0) -> None:
        """Read a two-line element set.

        Raises UsageError for invalid lines and for elements that do not describe an orbit.

        Args:
            first: first line of the element set.
            second: second line of the element set.
            sigma: standard deviation of the position per axis at the epoch of the elements, m.
            growth: growth of the standard deviation with the time from the epoch, m per day.
        """
        for number, line in (("1", first), ("2", second)):
            _check_line(number, line.rstrip())
        self._satellite = Satrec.twoline2rv(first.rstrip(), second.rstrip())
        if not 1.0 <= self._satellite.epochdays < 367.0:
            # SGP4 steps through resonant orbits by half a day, which would take forever from an absurd epoch.
            raise UsageError(f"{first.rstrip()!r}: the day of the year of its epoch must be from 1 to 366")
        code, *state = self._satellite.sgp4_tsince(0.0)
        if code or not np.all(np.isfinite(state)):
            reason = SGP4_ERRORS[code] if code else "a column holds no number"
            raise UsageError(
                f"{second.rstrip()!r}: these elements describe no orbit at their epoch: {reason}"
            )
        self._sigma, self._growth = sigma, growth

    def at(self, julian_date: float) -> OrbitState:
        """Return the orbit state at a Julian date UTC. Raises OrbitError if SGP4 fails."""
        whole = math.floor(julian_date)
        code, position, velocity = self._satellite.sgp4(whole, julian_date - whole)
        if code:
            raise OrbitError(f"SGP4 at {julian_date}: {SGP4_ERRORS[code]}")
        to_icrs = mean_equator_to_celestial(julian_date)
        age = abs(julian_date - self._satellite.jdsatepoch - self._satellite.jdsatepochF)
        sigma = self._sigma + self._growth * age
        return OrbitState(
            julian_date, 1e3 * (to_icrs @ np.array(position)), 1e3 * (to_icrs @ np.array(velocity)), sigma
        )


def propagated(state: FloatArray, duration: float) -> FloatArray:
    """Return the position (m) and velocity (m/s), together (6,), after a duration (s).

    The equations of motion are integrated by the classical Runge-Kutta method.
    """
    steps = max(1, math.ceil(abs(duration) / _LONGEST_STEP))
    dt = duration / steps
    for _ in range(steps):
        k1 = _flow(state)
        k2 = _flow(state + 0.5 * dt * k1)
        k3 = _flow(state + 0.5 * dt * k2)
        k4 = _flow(state + dt * k3)
        state = state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return state


def _flow(state: FloatArray) -> FloatArray:
    """Return velocity and acceleration, together (6,), for a spherical Earth with J2 (Sease, eq. 2.14)."""
    position = state[:3]
    squared = float(position @ position)
    pull = -GRAVITATIONAL_PARAMETER / squared**1.5
    flat = 1.5 * J2 * EARTH_RADIUS**2 / squared
    tilt = 5.0 * float(position[2]) ** 2 / squared
    scale = pull * np.array([1.0 + flat * (1.0 - tilt), 1.0 + flat * (1.0 - tilt), 1.0 + flat * (3.0 - tilt)])
    return np.concatenate([state[3:], scale * position])


def _check_line(number: str, line: str) -> None:
    """Raise UsageError unless `line` is valid as line `number` of a two-line element set."""
    if len(line) != 69 or not line.startswith(f"{number} "):
        raise UsageError(
            f"{line!r}: line {number} of a two-line element set has 69 columns and starts with {number}"
        )
    if not (line.isascii() and line.isprintable()):
        raise UsageError(f"{line!r}: a two-line element set has printable ASCII characters only")
    total = sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10
    if str(total) != line[68]:
        raise UsageError(f"{line!r}: checksum {line[68]}, the sum of its columns gives {total}")
