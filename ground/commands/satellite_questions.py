"""Questions of the command `knightcube new-satellite`, and functions that read and check the answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ground.satellite_description import Coil, largest_dipole, sun_synchronous_inclination
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.errors import UsageError
from sim_hal.worlds.orbit import julian_date

Vector = tuple[float, float, float]
Values = Mapping[str, Any]
"""Answers to the questions about a satellite, by the name of the option that gives the same value."""

COIL_EXAMPLE = "axis=xyz,dipole=0.2,current=0.1,resistance=40"
_FORMS = {
    "1u": (0.1, 0.1, 0.1135),
    "1.5u": (0.1702, 0.1, 0.1),
    "2u": (0.227, 0.1, 0.1),
    "3u": (0.3405, 0.1, 0.1),
    "4u": (0.454, 0.1, 0.1),
    "6u": (0.366, 0.2263, 0.1),
    "8u": (0.227, 0.2263, 0.2263),
    "12u": (0.366, 0.2263, 0.2263),
    "16u": (0.454, 0.2263, 0.2263),
    "27u": (0.366, 0.3526, 0.3526),
}
"""Sizes of CubeSats, m; all but the 1U have their longest side along x.

The CubeSat Design Specification, Rev. 14.1, gives the sizes of 1U, 1.5U, 2U, 3U, 6U and 12U. A 4U, 8U or 16U
is a stack of units of 113.5 mm along x. A 27U is as long as a 12U and 126.3 mm wider along y and z.
"""
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_DENSITIES = (20.0, 20_000.0)
"""Range of the mean density, kg/m^3: from an empty box of thin sheet to solid tungsten."""
_LOWEST_PERIGEE = 150.0  # lowest permitted perigee, km above the equatorial radius
_ALTITUDES = (200.0, 2000.0)  # range of the semi-major axis minus the Earth's radius, km
_LARGEST_ECCENTRICITY = 0.1
_HIGHEST_VOLTAGE = 36.0  # largest voltage across a coil, V
_COIL_RANGES = {
    "dipole": (1e-3, 100.0, "A m^2"),
    "turns": (1.0, 1e5, ""),
    "area": (1e-6, 10.0, "m^2"),
    "current": (1e-3, 1.0, "A"),
    "resistance": (0.1, 10_000.0, "ohm"),
}
"""Minimum, maximum and unit of each number that describes a coil."""


@dataclass(frozen=True, slots=True)
class Question:
    """A value of the satellite's description, given as an option or as the answer to a question.

    Attributes:
        name: name of the option without dashes.
        metavar: unit or form of the value in the help text.
        text: the question, with the unit.
        read: function that converts a text to the value; it raises ValueError with the permitted values.
        default: text of the default value, or None for a value that must be given.
    """

    name: str
    metavar: str
    text: str
    read: Callable[[str], Any]
    default: str | None = None


def number(low: float, high: float, unit: str) -> Callable[[str], float]:
    """Return a function that reads a number within a range, and raises ValueError with the range."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise ValueError(f"give a number from {low:g} to {high:g} {unit}".rstrip())
        return value

    return read


def _coil_number(key: str, text: str) -> float:
    """Convert the text of a coil property to a number. Raises ValueError with the permitted range."""
    try:
        return number(*_COIL_RANGES[key])(text)
    except ValueError as error:
        raise ValueError(f"{key}={text}: {error}") from None


def read_coils(text: str) -> list[Coil]:
    """Return the equal coils that a text such as `axis=xy,dipole=0.2,current=0.1,resistance=40` describes.

    Raises ValueError with the problem and the remedy.
    """
    given: dict[str, str] = {}
    for part in text.split(","):
        key, equals, value = (word.strip() for word in part.partition("="))
        if not equals or key in given or key not in {"axis", *_COIL_RANGES}:
            problem = "is given twice" if key in given else "is unknown"
            raise ValueError(f"{part.strip()!r} {problem}: give coils such as {COIL_EXAMPLE}")
        given[key] = value
    for key in ("axis", "current", "resistance"):
        if key not in given:
            raise ValueError(f"`{key}` is missing: give coils such as {COIL_EXAMPLE}")
    current, resistance = (
        _coil_number("current", given["current"]),
        _coil_number("resistance", given["resistance"]),
    )
    kinds = {key for key in ("dipole", "turns", "area") if key in given}
    if kinds == {"dipole"}:
        per_ampere = _coil_number("dipole", given["dipole"]) / current
    elif kinds == {"turns", "area"}:
        per_ampere = _coil_number("turns", given["turns"]) * _coil_number("area", given["area"])
    else:
        raise ValueError("give either `dipole` (A m^2 at the current limit), or `turns` and `area` (m^2)")
    return [Coil(axis, per_ampere, resistance, current) for axis in _axes(given["axis"])]


def _axes(text: str) -> list[Vector]:
    """Return the unit vectors of axes: letters such as `xyz`, or three components such as `0/0.6/0.8`."""
    if text and set(text) <= set(_AXES) and len(set(text)) == len(text):
        return [_AXES[letter] for letter in text]
    try:
        x, y, z = (float(part) for part in text.split("/"))
    except ValueError:
        x = y = z = math.nan
    length = math.hypot(x, y, z)
    if not 0.0 < length < math.inf:
        raise ValueError(f"axis={text}: give body axes such as x or xyz, or components such as 0/0.6/0.8")
    return [(x / length, y / length, z / length)]


def _read_name(text: str) -> str:
    if not (text.isascii() and text.isidentifier() and len(text) <= 64):
        raise ValueError("give letters, digits and underscores, beginning with a letter")
    return text


def _read_size(text: str) -> Vector:
    """Return the size of a box such as 0.3x0.1x0.1, or the size of a CubeSat such as 3u."""
    if text.lower() in _FORMS:
        return _FORMS[text.lower()]
    parts = text.lower().split("x")
    if len(parts) != 3:
        known = f"the CubeSats {', '.join(_FORMS)}"
        raise ValueError(f"give three sides in m, such as 0.3x0.1x0.1, or one of {known}")
    side = number(0.02, 3.0, "m for each side")
    return side(parts[0]), side(parts[1]), side(parts[2])


@dataclass(frozen=True, slots=True)
class Apsides:
    """An elliptical orbit given by its lowest and highest altitude.

    Attributes:
        altitude: semi-major axis minus the Earth's radius, km.
        eccentricity: eccentricity of the orbit.
    """

    altitude: float
    eccentricity: float


def _read_altitude(text: str) -> float | Apsides:
    """Return an altitude in km, or the orbit between two altitudes such as 450x900.

    Raises ValueError with the permitted values.
    """
    mean = number(*_ALTITUDES, "km, or the altitudes of perigee and apogee such as 450x900")
    ends = text.lower().split("x")
    if len(ends) != 2:
        return mean(text)
    end = number(_LOWEST_PERIGEE, 4000.0, "km for perigee and apogee")
    perigee, apogee = sorted((end(ends[0]), end(ends[1])))
    altitude = 0.5 * (perigee + apogee)
    eccentricity = 0.5 * (apogee - perigee) / (1e-3 * EARTH_RADIUS + altitude)
    if eccentricity > _LARGEST_ECCENTRICITY:
        raise ValueError(
            f"the eccentricity is {eccentricity:.3g}: give a lower apogee, up to {_LARGEST_ECCENTRICITY:g}"
        )
    mean(f"{altitude}")
    return Apsides(altitude, eccentricity)


def _read_inclination(text: str) -> float | None:
    """Return an inclination in deg, or None for a Sun-synchronous orbit."""
    return None if text.lower() == "sso" else number(0.0, 180.0, "deg, or sso")(text)


def _read_utc(text: str) -> str:
    whole = text if text.endswith("Z") else f"{text}Z"
    try:
        julian_date(whole)
    except ValueError:
        raise ValueError("give a time such as 2026-03-20T12:00:00") from None
    return whole


def _read_camera(text: str) -> float | None:
    """Return the field of view of the star camera in deg, or None without a star camera."""
    return None if text.lower() == "none" else number(6.0, 40.0, "deg, or none")(text)


def _read_yes(text: str) -> bool:
    if text.lower() not in {"yes", "no"}:
        raise ValueError("give yes or no")
    return text.lower() == "yes"


QUESTIONS = (
    Question("name", "NAME", "name of the satellite", _read_name, "my_satellite"),
    Question("mass", "KG", "mass, kg", number(0.1, 500.0, "kg")),
    Question(
        "size",
        "XxYxZ",
        f"sides along body x, y and z, m, such as 0.3x0.1x0.1; or {', '.join(_FORMS)}, longest along x",
        _read_size,
    ),
    Question(
        "altitude",
        "KM",
        "altitude of the orbit (semi-major axis minus 6378 km), km; or those of perigee and apogee, such as "
        "450x900, without --eccentricity",
        _read_altitude,
        "500",
    ),
    Question(
        "eccentricity", "E", "eccentricity of the orbit", number(0.0, _LARGEST_ECCENTRICITY, ""), "0.001"
    ),
    Question("inclination", "DEG", "inclination, deg, or sso for Sun-synchronous", _read_inclination, "sso"),
    Question(
        "local-time",
        "H",
        "mean local time of the ascending node at the start, h",
        number(0.0, 24.0, "h"),
        "10.5",
    ),
    Question("utc", "UTC", "start of the flight, UTC", _read_utc, "2026-03-20T12:00:00"),
    Question(
        "coil",
        "KEY=VALUE,...",
        "equal coils, one along each named axis: dipole (A m^2) at the current limit (A), and resistance "
        f"(ohm), such as {COIL_EXAMPLE}; for an air coil turns and area (m^2) can replace the dipole",
        read_coils,
    ),
    Question("star-camera", "DEG", "field of view of the star camera, deg, or none", _read_camera, "20"),
    Question("horizon-cameras", "yes|no", "six cameras for Sun and horizon, yes or no", _read_yes, "yes"),
    Question("release", "DEG/S", "rate at the release, deg/s", number(0.1, 30.0, "deg/s"), "10"),
)


def read_value(name: str, text: str) -> Any:
    """Convert an answer to the question `name` to its value. Raises UsageError with the permitted values."""
    (question,) = (one for one in QUESTIONS if one.name == name)
    try:
        return question.read(text)
    except ValueError as error:
        raise UsageError(f"--{name} {text}: {error}") from error


def check_values(name: str, values: Values) -> None:
    """Check the value of the question `name` for consistency with the values that are known so far.

    Raises UsageError if the values contradict each other.
    """
    problem = ""
    if name in {"mass", "size"} and {"mass", "size"} <= set(values):
        problem = _density_problem(values["mass"], values["size"])
    if name in {"altitude", "eccentricity"} and {"altitude", "eccentricity"} <= set(values):
        problem = _perigee_problem(values["altitude"], values["eccentricity"])
    if name == "inclination" and values[name] is None:
        altitude = values["altitude"]
        if sun_synchronous_inclination(1e3 * altitude, values["eccentricity"]) is None:
            problem = f"no orbit at {altitude:g} km is Sun-synchronous: give an inclination"
    if name == "coil":
        problem = _coil_problem(values["coil"])
    if problem:
        raise UsageError(problem)


def _density_problem(mass: float, size: Vector) -> str:
    volume = size[0] * size[1] * size[2]
    low, high = _DENSITIES
    if low <= mass / volume <= high:
        return ""
    bounds = f"{low * volume:.2g} to {high * volume:.3g} kg"
    return f"{mass:g} kg in this size has {mass / volume:,.3g} kg/m^3: give {bounds}, or another size"


def _perigee_problem(altitude: float, eccentricity: float) -> str:
    """Return a text that states why an orbit is too low and how to correct it, or an empty text."""
    axis = 1e-3 * EARTH_RADIUS + altitude
    perigee = axis * (1.0 - eccentricity) - 1e-3 * EARTH_RADIUS
    if perigee >= _LOWEST_PERIGEE:
        return ""
    most = math.floor(1e4 * (altitude - _LOWEST_PERIGEE) / axis) / 1e4
    return (
        f"the perigee is at {perigee:.0f} km, below {_LOWEST_PERIGEE:g} km: "
        f"for a mean altitude of {altitude:g} km give an eccentricity up to {most:g}"
    )


def _coil_problem(coils: list[Coil]) -> str:
    voltage = max(coil.resistance * coil.current_limit for coil in coils)
    if voltage > _HIGHEST_VOLTAGE:
        return (
            f"{voltage:.3g} V at the current limit, above {_HIGHEST_VOLTAGE:g} V: give a lower current limit"
        )
    if largest_dipole(tuple(coils)) == 0.0:
        return "these coils control only one axis: give also coils on other axes, such as axis=xyz"
    return ""
