"""Position and velocity of the satellite in ICRS axes, from the last GPS fix or from two-line elements.

A GPS fix is propagated with the gravity of a spherical Earth and the oblateness term J2, by Runge-Kutta steps
of at most 30 s. Two-line elements are propagated by SGP4 (Vallado, Crawford, Hujsak and Kelso, AIAA
2006-6753), with an error of one to three kilometres near the epoch of the elements.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache

import numpy as np
from sgp4.api import SGP4_ERRORS, WGS72, Satrec

from knightcube.astro.arrays import FloatArray, brief, checked_deviation
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.orientation import (
    ROTATION_RATE,
    celestial_to_terrestrial,
    mean_equator_to_celestial,
)
from knightcube.astro.earth.sun import DAY, J2000
from knightcube.errors import ArgumentError, KnightCubeError, UsageError

_LONGEST_STEP = 30.0
LONGEST = 30.0 * DAY
"""Longest time (s) over which an orbit is propagated from one state.

The unknown drag displaces a satellite in a low orbit by hundreds to thousands of kilometres in 30 days.
"""
FASTEST, FARTHEST = 2e4, 1.5e9
"""Largest speed (m/s) of a satellite, above the escape velocity, and largest distance (m) from the Earth's
centre, the radius of the sphere in which the gravity of the Earth dominates (Hill sphere)."""
_J2000 = datetime(2000, 1, 1, 12)
_SGP4_EPOCH, _MINUTES_PER_DAY = 2_433_281.5, 1440.0
"""Julian date from which SGP4 counts days, and number of minutes in a day."""
_DRAG_FRACTION, _LEAST_DRAG = 0.5, 2.5e-4
"""Standard deviation of B* for small satellites as a fraction of B*, and its minimum (1/Earth radius)."""
_DRAG_TIME, _DECAYING = 0.25, 1e7
"""Time (days) over which the along-track shift due to B* is computed, and shift (m/day^2) that is assumed if
the orbit decays within this time."""
_DATES = 2_400_000.5, 2_816_787.5
"""First and last Julian date for which the orbit is asked: 17 November 1858 and 31 December 2999."""
LARGEST_SIGMA = 1e6
"""Largest standard deviation (m) of a position per axis that the library returns from two-line elements."""


class OrbitError(KnightCubeError):
    """Error raised if the orbit is unknown at a time.

    The reason is that the last fix or the two-line elements are too old, or that the orbit has decayed.
    """


@dataclass(frozen=True, slots=True, eq=False)
class OrbitState:
    """Geocentric position (3,), m, and velocity (3,), m/s, of the satellite, ICRS, at a Julian date UTC.

    The standard deviation of the position per axis is `sigma`, m.
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

    @property
    def perigee_radius(self) -> float:
        """Radius (m) of the perigee of the Keplerian orbit, or NaN for an open orbit."""
        energy = 0.5 * float(self.velocity @ self.velocity)
        energy -= GRAVITATIONAL_PARAMETER / float(np.linalg.norm(self.position))
        if energy >= 0.0:
            return math.nan
        axis = -0.5 * GRAVITATIONAL_PARAMETER / energy
        momentum = np.cross(self.position, self.velocity)
        square = 1.0 - float(momentum @ momentum) / (GRAVITATIONAL_PARAMETER * axis)
        return axis * (1.0 - math.sqrt(max(square, 0.0)))


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
        """Raise OrbitError for impossible orbits, and ArgumentError for an impossible deviation or age."""
        for name in ("position", "velocity"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        numbers = np.array([self.julian_date, *self.position, *self.velocity])
        if numbers.shape != (7,) or not np.all(np.isfinite(numbers)):
            raise OrbitError(f"fix at {self.julian_date}: position and velocity must be (3,) and finite")
        distance, speed = math.hypot(*self.position.tolist()), math.hypot(*self.velocity.tolist())
        if distance < LOWEST_RADIUS:
            raise OrbitError(f"fix at {self.julian_date}: {self.position} m is within the Earth")
        if distance > FARTHEST or speed > FASTEST:
            raise OrbitError(
                f"fix at {self.julian_date}: {distance:g} m from the Earth's centre at {speed:g} m/s: "
                "give a position in m and a velocity in m/s"
            )
        for name, unit in (("sigma", "m"), ("velocity_sigma", "m/s"), ("longest_age", "s")):
            checked_deviation(name, getattr(self, name), unit)

    def at(self, julian_date: float) -> OrbitState:
        """Return the orbit state propagated to a Julian date UTC. Raises OrbitError if the fix is too old."""
        age = (julian_date - self.julian_date) * DAY
        if not abs(age) <= self.longest_age:
            raise OrbitError(f"the last fix is {age:.0f} s old: fixes are used for {self.longest_age:g} s")
        state = _measured(self)
        later = propagated(state, age) if age else state
        # In orbit, an along-track velocity error causes a position error three times as large as in free
        # space.
        sigma = math.hypot(self.sigma, 3.0 * age * self.velocity_sigma)
        return OrbitState(julian_date, later[:3], later[3:], sigma)


@lru_cache(maxsize=16)
def _measured(fix: GpsFix) -> FloatArray:
    """Return the position (m) and velocity (m/s) of a fix, together (6,), ICRS, at the time of the fix."""
    to_ground = celestial_to_terrestrial(fix.julian_date)
    x, y, _ = fix.position.tolist()
    with_ground = fix.velocity + np.array([-ROTATION_RATE * y, ROTATION_RATE * x, 0.0])
    return np.concatenate([fix.position @ to_ground, with_ground @ to_ground])


def elements_of(lines: Sequence[str]) -> TwoLineElements:
    """Return the two-line elements in the argument `elements` of a public function.

    Raises ArgumentError unless there are two lines, and UsageError for lines that `TwoLineElements` rejects.
    """
    if not (isinstance(lines, Sequence) and len(lines) == 2 and all(isinstance(line, str) for line in lines)):
        raise ArgumentError("elements", f"{brief(lines)}: give the two lines of the element set as texts")
    first, second = lines
    return TwoLineElements(first, second)


class TwoLineElements:
    """Two-line element set, with a standard deviation that grows with the time since its epoch.

    An error of the drag term B* shifts the satellite along its track by an amount that grows with the square
    of the time. SGP4 computes the shift for the standard deviation of B*.
    """

    def __init__(self, first: str, second: str, sigma: float = 1500.0, growth: float = 1500.0) -> None:
        """Read a two-line element set.

        Raises UsageError for invalid lines (`check_lines`), and for elements that do not describe an orbit.

        Args:
            first: first line of the element set.
            second: second line of the element set.
            sigma: standard deviation of the position per axis at the epoch of the elements, m.
            growth: growth of the standard deviation with the time from the epoch, m per day.
        """
        for name, value, unit in (("sigma", sigma, "m"), ("growth", growth, "m per day")):
            checked_deviation(name, value, unit)
        first, second = first.rstrip(), second.rstrip()
        check_lines(first, second)
        self._satellite = Satrec.twoline2rv(first, second)
        code, *state = self._satellite.sgp4_tsince(0.0)
        if code or not np.all(np.isfinite(state)):
            reason = SGP4_ERRORS[code] if code else "its position is not finite"
            raise UsageError(f"{second!r}: these elements describe no orbit at their epoch: {reason}")
        self._sigma, self._growth = sigma, growth
        self._drag_growth = _drag_growth(self._satellite)
        self._newest: OrbitState | None = None

    @property
    def epoch(self) -> float:
        """Julian date UTC of the epoch of the elements."""
        return float(self._satellite.jdsatepoch + self._satellite.jdsatepochF)

    def at(self, julian_date: float) -> OrbitState:
        """Return the orbit state at a Julian date UTC. Raises OrbitError if SGP4 fails."""
        if self._newest is not None and self._newest.julian_date == julian_date:
            return self._newest
        whole = math.floor(julian_date)
        code, position, velocity = self._satellite.sgp4(whole, julian_date - whole)
        if code:
            raise OrbitError(f"SGP4 at {julian_date}: {SGP4_ERRORS[code]}")
        to_icrs = mean_equator_to_celestial(julian_date)
        self._newest = OrbitState(
            julian_date,
            1e3 * (to_icrs @ np.array(position)),
            1e3 * (to_icrs @ np.array(velocity)),
            self._sigma_at(julian_date),
        )
        return self._newest

    def _sigma_at(self, julian_date: float) -> float:
        """Return the standard deviation of the position per axis, m, at a Julian date UTC."""
        age = abs(julian_date - self.epoch)
        return math.hypot(self._sigma + self._growth * age, self._drag_growth * age**2)

    def known_at(self, julian_date: float) -> OrbitState:
        """Return the orbit state at a Julian date UTC.

        Raises OrbitError if SGP4 fails, or if the standard deviation of the position exceeds `LARGEST_SIGMA`
        because the date is too far from the epoch of the elements. Raises ArgumentError for a date before
        1858 or after 2999.
        """
        if not _DATES[0] <= julian_date <= _DATES[1]:
            raise ArgumentError("julian_date", f"{brief(julian_date)}: give a Julian date from 1858 to 2999")
        if not self._sigma_at(julian_date) <= LARGEST_SIGMA:
            begin, end = (_J2000 + timedelta(days=date - J2000) for date in (self.epoch, julian_date))
            raise OrbitError(
                f"the elements of {begin:%Y-%m-%d} do not give the orbit on {end:%Y-%m-%d}: the standard "
                f"deviation of the position exceeds {1e-3 * LARGEST_SIGMA:.0f} km "
                f"at {abs(julian_date - self.epoch):.0f} days from the epoch: use elements near this date"
            )
        state = self.at(julian_date)
        if not LOWEST_RADIUS <= float(np.linalg.norm(state.position)) < math.inf:
            raise OrbitError(f"SGP4 at {julian_date}: the position {state.position} m is not in orbit")
        return state


def _drag_growth(satellite: Satrec) -> float:
    """Return the along-track standard deviation due to the error of B*, m per day squared."""
    found = []
    for drag in (0.0, max(_DRAG_FRACTION * abs(satellite.bstar), _LEAST_DRAG)):
        made = Satrec()
        made.sgp4init(
            WGS72,
            "i",
            0,
            satellite.jdsatepoch - _SGP4_EPOCH + satellite.jdsatepochF,
            drag,
            0.0,
            0.0,
            satellite.ecco,
            satellite.argpo,
            satellite.inclo,
            satellite.mo,
            satellite.no_kozai,
            satellite.nodeo,
        )
        code, position, _ = made.sgp4_tsince(_DRAG_TIME * _MINUTES_PER_DAY)
        found.append(np.array(position))
        if code:
            return _DECAYING
    return 1e3 * float(np.linalg.norm(found[1] - found[0])) / _DRAG_TIME**2


_State = tuple[float, float, float, float, float, float]
"""Position (m) and velocity (m/s). The propagation uses floats, because numpy takes three times as long."""


def propagated(state: FloatArray, duration: float) -> FloatArray:
    """Return the position (m) and velocity (m/s), together (6,), after a duration (s) of at most 30 days.

    The equations of motion are integrated by the classical Runge-Kutta method. Raises ArgumentError for
    another duration.
    """
    if not abs(duration) <= LONGEST:
        raise ArgumentError("duration", f"{brief(duration)}: give at most {LONGEST:g} s, 30 days")
    steps = max(1, math.ceil(abs(duration) / _LONGEST_STEP))
    dt = duration / steps
    x, y, z, u, v, w = state.tolist()
    then: _State = (x, y, z, u, v, w)
    for _ in range(steps):
        k1 = _flow(then)
        k2 = _flow(_moved(then, 0.5 * dt, k1))
        k3 = _flow(_moved(then, 0.5 * dt, k2))
        k4 = _flow(_moved(then, dt, k3))
        (a1, b1, c1, d1, e1, f1), (a2, b2, c2, d2, e2, f2) = k1, k2
        (a3, b3, c3, d3, e3, f3), (a4, b4, c4, d4, e4, f4) = k3, k4
        sums = (
            a1 + 2.0 * a2 + 2.0 * a3 + a4, b1 + 2.0 * b2 + 2.0 * b3 + b4, c1 + 2.0 * c2 + 2.0 * c3 + c4,
            d1 + 2.0 * d2 + 2.0 * d3 + d4, e1 + 2.0 * e2 + 2.0 * e3 + e4, f1 + 2.0 * f2 + 2.0 * f3 + f4,
        )  # fmt: skip
        then = _moved(then, dt / 6.0, sums)
    return np.array(then)


def _moved(state: _State, dt: float, flow: _State) -> _State:
    """Return `state` + `dt` * `flow`."""
    x, y, z, u, v, w = state
    a, b, c, d, e, f = flow
    return x + dt * a, y + dt * b, z + dt * c, u + dt * d, v + dt * e, w + dt * f


def _flow(state: _State) -> _State:
    """Return velocity and acceleration for a spherical Earth with J2 (Sease, eq. 2.14)."""
    x, y, z, u, v, w = state
    squared = x * x + y * y + z * z
    pull = -GRAVITATIONAL_PARAMETER / squared**1.5
    flat = 1.5 * J2 * EARTH_RADIUS**2 / squared
    tilt = 5.0 * z * z / squared
    level, upright = pull * (1.0 + flat * (1.0 - tilt)), pull * (1.0 + flat * (3.0 - tilt))
    return u, v, w, level * x, level * y, upright * z


@dataclass(frozen=True, slots=True)
class _Field:
    """Field of a line of a two-line element set.

    Attributes:
        first, last: first and last column of the field, counted from 1.
        name: name of the quantity.
        form: regular expression of the whole field.
        example: example of a valid field.
        low, high: bounds of the value, if the field contains a number.
        unit: unit of the value, with a leading blank.
    """

    first: int
    last: int
    name: str
    form: str
    example: str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""


_RATE = r"[ +-]\d{5}[ +-]\d"
ANGLES = {"inclination": 180.0, "right ascension of the node": 360.0, "argument of perigee": 360.0}
"""Upper bounds (deg) of the angles in mean elements, whose lower bound is 0."""
FASTEST_MOTION, SLOWEST_MOTION, LARGEST_DRAG = 17.5, 0.01, 10.0
"""Bounds of the mean motion (revolutions per day), and largest absolute value of B* (1/Earth radius)."""
SGP4_TYPES = " 02"
"""Ephemeris types of mean elements for SGP4; type 4, for example, belongs to SGP4-XP."""
_LINES: tuple[tuple[_Field, ...], ...] = (
    (
        _Field(3, 7, "satellite number", r" *\d+|[A-HJ-NP-Z]\d{4}", "25544, or A0001 for 100001"),
        _Field(8, 8, "classification", "[A-Z ]", "U"),
        _Field(19, 20, "year of the epoch", r"\d\d", "26"),
        _Field(21, 32, "day of the year of the epoch", r" *\d+\.\d+ *", "320.51782528"),
        _Field(34, 43, "derivative of the mean motion", r"[ +\-0]\.\d{8}", " .00012182"),
        _Field(45, 52, "second derivative of the mean motion", _RATE, " 00000-0"),
        _Field(54, 61, "B*", _RATE, " 21606-3", -LARGEST_DRAG, LARGEST_DRAG, " per Earth radius"),
        _Field(63, 63, "ephemeris type", r"[\d ]", "0"),
        _Field(65, 68, "number of the element set", r" *\d*", " 292"),
    ),
    (
        _Field(3, 7, "satellite number", r" *\d+|[A-HJ-NP-Z]\d{4}", "25544, or A0001 for 100001"),
        *(
            _Field(first, first + 7, name, r" *\d*\.\d{4}", " 51.6416", 0.0, high, " deg")
            for first, (name, high) in zip((9, 18, 35), ANGLES.items(), strict=True)
        ),
        _Field(27, 33, "eccentricity without its point", r"\d{7}", "0006703"),
        _Field(44, 51, "mean anomaly", r" *\d*\.\d{4}", "325.0288", 0.0, 360.0, " deg"),
        _Field(
            *(53, 63, "mean motion", r" *\d+\.\d{8}", "15.49125391"),
            *(SLOWEST_MOTION, FASTEST_MOTION, " revolutions per day"),
        ),
        _Field(64, 68, "number of revolutions", r" *\d*", "56353"),
    ),
)
_BLANKS = (2, 9, 18, 33, 44, 53, 62, 64), (2, 8, 17, 26, 34, 43, 52)
"""Columns, counted from 1, that are blank in the first line and in the second line of an element set."""


def check_lines(first: str, second: str) -> None:
    """Raise UsageError, with line and columns, unless both lines are a valid two-line element set for SGP4.

    The check covers the columns, forms and ranges of all fields, the checksums, the ephemeris type, and the
    equality of the satellite numbers of both lines. A satellite number may begin with a letter (Alpha-5, in
    which A is 10 and the letters I and O are omitted).
    """
    for number, line in enumerate((first, second), 1):
        _check_line(number, line)
    if first[2:7].lstrip(" 0") != second[2:7].lstrip(" 0"):
        raise UsageError(
            f"{second!r}: line 2, columns 3 to 7: satellite number {second[2:7]}, but line 1 has "
            f"{first[2:7]}: take both lines from one element set"
        )
    days = 366.0 if int(first[18:20]) % 4 == 0 else 365.0
    if not 1.0 <= float(first[20:32]) < days + 1.0:
        # For resonant orbits SGP4 takes steps of half a day, and would take too many steps from an impossible
        # epoch.
        raise UsageError(
            f"{first!r}: line 1, columns 21 to 32: the day of the year of the epoch, {first[20:32].strip()}, "
            f"must be from 1 to {days:g}"
        )
    if first[62] not in SGP4_TYPES:
        raise UsageError(
            f"{first!r}: line 1, column 63: ephemeris type {first[62]} must be 0: take elements for SGP4"
        )
    eccentricity, motion = float(f"0.{second[26:33]}"), float(second[52:63])
    low = perigee_radius(motion, eccentricity)
    if low < LOWEST_RADIUS:
        raise UsageError(
            f"{second!r}: line 2, columns 27 to 33 and 53 to 63: eccentricity {eccentricity:g} and mean "
            f"motion {motion:g} give a perigee within the Earth, {1e-3 * low:.0f} km from its centre"
        )


LOWEST_RADIUS = 0.98 * EARTH_RADIUS
"""Minimum radius (m) of the perigee of mean elements and of a GPS position."""


def perigee_radius(motion: float, eccentricity: float) -> float:
    """Return the radius (m) of the perigee for a mean motion in revolutions per day."""
    rate = 2.0 * math.pi * motion / DAY
    return float(math.cbrt(GRAVITATIONAL_PARAMETER / rate**2) * (1.0 - eccentricity))


def _check_line(number: int, line: str) -> None:
    """Raise UsageError unless `line` is valid as line `number` of a two-line element set."""
    if len(line) != 69 or not line.startswith(f"{number} "):
        raise UsageError(
            f"{line!r}: line {number} of a two-line element set has 69 columns and starts with {number}, but "
            f"this line has {len(line)} columns"
        )
    if not (line.isascii() and line.isprintable()):
        raise UsageError(
            f"{line!r}: line {number} of a two-line element set has printable ASCII characters only"
        )
    for column in _BLANKS[number - 1]:
        if line[column - 1] != " ":
            raise UsageError(
                f"{line!r}: line {number}, column {column}: must be blank, but is "
                f"{line[column - 1]!r}: fields have fixed columns"
            )
    for field in _LINES[number - 1]:
        _check_field(number, line, field)
    total = sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10
    if str(total) != line[68]:
        raise UsageError(
            f"{line!r}: line {number}, column 69: checksum {line[68]}, the sum of its columns gives {total}"
        )


def _check_field(number: int, line: str, field: _Field) -> None:
    """Raise UsageError unless a field of `line` has the required form and a value within bounds."""
    text = line[field.first - 1 : field.last]
    columns = (
        f"columns {field.first} to {field.last}" if field.last > field.first else f"column {field.first}"
    )
    place = f"{line!r}: line {number}, {columns}: {field.name} {text.strip()!r}"
    valid = re.fullmatch(field.form, text)
    packed = field.form == _RATE and valid
    value = f"{text[0].strip()}.{text[1:6]}e{text[6:].strip()}" if packed else text
    with suppress(ValueError):
        if field.high < math.inf and not field.low <= float(value) <= field.high:
            raise UsageError(f"{place} must be from {field.low:g} to {field.high:g}{field.unit}")
    if valid is None:
        raise UsageError(f"{place} must have the form {field.example!r}")
