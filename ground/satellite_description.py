"""Description of a satellite by mass, size, orbit, coils and cameras, and its configuration file.

The file extends the configuration `orbit` (a 1U CubeSat) and contains only differing values. Values that are
not described are computed: the inertia is that of a homogeneous cuboid, and limits are scaled between those
of the configurations `orbit` and `orbit_3u`. The file omits weights and noise levels that the flight
application computes from craft and coils. The questions of `knightcube new-satellite` are defined together
with the functions that read and check the answers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flight.schema.document import ConfigError
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.mean_elements import FittedElements
from knightcube.astro.inertia import box_inertia
from knightcube.errors import UsageError
from sim_hal.settings import YEARS, OrbitSection
from sim_hal.worlds.orbit import elements, julian_date, log_density, sun_position

Vector = tuple[float, float, float]

TILT_DEG = 22.0
"""Tilt (deg) of the star camera's boresight from the orbit normal towards the zenith."""
_YEAR_RATE = 2.0 * math.pi / (365.2422 * 86_400.0)  # mean rate of the Sun's right ascension, rad/s
_EQUATOR_FIELD = 2.98e-5  # field of the Earth's dipole at the equator at one Earth radius, T [IGRF-13]
_OFFSET, _DRAG_COEFFICIENT, _SUN_PRESSURE = 0.02, 2.2, 4.56e-6
"""Centre of mass offset (m) [CubeSat Design Specification], drag coefficient, solar pressure (Pa)."""
_CURRENT_ERROR, _CURRENT_SIGMA = 3.5e-3 / 0.148, 2.0e-3 / 0.148
"""Bound of the simulated current error, and assumed current noise, as fractions of the current limit."""
_NEED_STARS = ("fine_within", "knowledge_deg", "camera_missed_percent")  # requirements for a star camera
_STRAY_FIELD = 7.4e-5  # field (T) of a coil at the magnetometer at the current limit [configuration `orbit`]


@dataclass(frozen=True, slots=True)
class Coil:
    """A coil or rod: unit vector of its axis, dipole per current (m^2), resistance (ohm) and limit (A)."""

    axis: Vector
    dipole_per_ampere: float
    resistance: float
    current_limit: float

    @property
    def dipole(self) -> float:
        """Dipole at the current limit, A m^2."""
        return self.dipole_per_ampere * self.current_limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Satellite:
    """The description of a satellite.

    Attributes:
        name: name of the configuration.
        mass: kg.
        size: lengths of the sides along the body axes, m.
        orbit: orbit at `utc`.
        utc: start of the flight, UTC, ISO 8601.
        coils: coils and rods.
        supply_voltage: voltage across a coil that is fully on, V.
        field_of_view_deg: field of view of the star camera, deg, or None without a star camera.
        wide_cameras: whether the six horizon cameras are fitted.
        release_deg: body rate at release, deg/s.
    """

    name: str
    mass: float
    size: Vector
    orbit: OrbitSection
    utc: str
    coils: tuple[Coil, ...]
    supply_voltage: float
    field_of_view_deg: float | None
    wide_cameras: bool
    release_deg: float


@dataclass(frozen=True, slots=True)
class Derived:
    """Values that are computed from the description of a satellite.

    Attributes:
        inertia: moments of inertia about the body axes, kg m^2.
        dipole: dipole of the coils in a typical direction, A m^2.
        field: root mean square of the magnetic field along the orbit, T.
        coil_torque: product of `dipole` and `field`, N m.
        disturbance: aerodynamic and solar torque on the largest face, with the centre of mass 2 cm off, N m.
        momentum_time: time (s) in which `coil_torque` removes the angular momentum at release.
        period: orbital period, s.
        slow_within: estimated upper limit of the detumbling time, s.
        duration: duration of the flight, s.
        detumble_horizon: planning horizon of detumbling, s.
        roll: roll error (rad) that has the same cost as an error of 1 deg of the pointing axis.
        sun_side: whether the Sun is on the side of body +y while +z points to nadir and +x along the
            velocity.
        beta_deg: angle between the Sun's direction and the orbital plane, deg.
    """

    inertia: Vector
    dipole: float
    field: float
    coil_torque: float
    disturbance: float
    momentum_time: float
    period: float
    slow_within: float
    duration: float
    detumble_horizon: float
    roll: float
    sun_side: bool
    beta_deg: float


def sun_synchronous_inclination(altitude: float, eccentricity: float) -> float | None:
    """Return the inclination (deg) of a Sun-synchronous orbit, or None if none exists at this altitude.

    The argument `altitude` is the semi-major axis minus the Earth's radius, m (Vallado, eq. 11-13).
    """
    axis = EARTH_RADIUS + altitude
    motion = math.sqrt(GRAVITATIONAL_PARAMETER / axis**3)
    parameter = axis * (1.0 - eccentricity**2)
    cosine = -_YEAR_RATE / (1.5 * J2 * motion * (EARTH_RADIUS / parameter) ** 2)
    return math.degrees(math.acos(cosine)) if cosine >= -1.0 else None


def largest_dipole(coils: tuple[Coil, ...]) -> float:
    """Return the dipole of all coils in a typical direction, A m^2, or 0 if all coil axes are parallel.

    The result is the geometric mean of the singular values of the matrix of dipoles at the current limits.
    For three equal coils on three axes, the result is the dipole of one coil.
    """
    dipoles = np.array([[component * coil.dipole for component in coil.axis] for coil in coils])
    values = np.linalg.svd(dipoles, compute_uv=False)
    kept = values[values > 0.05 * values[0]]
    return float(np.exp(np.mean(np.log(kept)))) if len(kept) >= 2 else 0.0


def derived(satellite: Satellite, julian_date: float) -> Derived:
    """Return the computed values of a satellite whose flight starts at `julian_date`, UTC."""
    orbit, size = satellite.orbit, satellite.size
    x, y, z = np.diag(box_inertia(satellite.mass, size)).tolist()
    inertia = (x, y, z)
    axis = EARTH_RADIUS + orbit.altitude
    period = 2.0 * math.pi * math.sqrt(axis**3 / GRAVITATIONAL_PARAMETER)
    towards_pole = math.sin(math.radians(orbit.inclination_deg))
    field = _EQUATOR_FIELD * (EARTH_RADIUS / axis) ** 3 * math.sqrt(1.0 + 1.5 * towards_pole**2)
    dipole = largest_dipole(satellite.coils)
    torque = dipole * field
    area = max(size[0] * size[1], size[1] * size[2], size[2] * size[0])
    disturbance = area * _worst_pressure(axis * (1.0 - orbit.eccentricity)) * _OFFSET
    momentum_time = max(inertia) * math.radians(satellite.release_deg) / torque
    slow_within = _rounded_up(0.3 * period + 1.3 * momentum_time, 100.0)
    start = elements(orbit, julian_date)
    normal, sun = np.cross(*start.state()), sun_position(julian_date)
    beta = math.asin(float(normal @ sun) / float(np.linalg.norm(normal) * np.linalg.norm(sun)))
    return Derived(
        inertia=inertia,
        dipole=dipole,
        field=field,
        coil_torque=torque,
        disturbance=disturbance,
        momentum_time=momentum_time,
        period=period,
        slow_within=slow_within,
        duration=_rounded_up(slow_within + 1.1 * period, 100.0),
        detumble_horizon=1500.0 if momentum_time < 375.0 else 3000.0,
        roll=0.524 if disturbance / max(inertia) > 3e-6 else 0.0524,
        sun_side=beta < 0.0,
        beta_deg=math.degrees(beta),
    )


def _worst_pressure(perigee: float) -> float:
    """Return the largest pressure (Pa) of air and sunlight, `perigee` m from the Earth's centre."""
    place, sun = np.array([[perigee, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    density = math.exp(float(log_density(place, sun, 0.0)[0]))
    return 0.5 * _DRAG_COEFFICIENT * density * GRAVITATIONAL_PARAMETER / perigee + 2.0 * _SUN_PRESSURE


def _rounded_up(value: float, step: float) -> float:
    return step * math.ceil(value / step)


def configuration_text(satellite: Satellite, values: Derived, made: FittedElements, command: str) -> str:
    """Return the text of a satellite's configuration file, including the `command` that writes the file."""
    x, y, z = satellite.size
    orbit, release = satellite.orbit, satellite.release_deg
    place = ", ".join(
        f"{key}: {_text(getattr(orbit, key) or 0.0)}"
        for key in ("altitude", "inclination_deg", "eccentricity", "local_time")
    )
    moments = ", ".join(f"{moment:.3e}" for moment in values.inertia)
    limits = [coil.current_limit for coil in satellite.coils]
    wide = "" if satellite.wide_cameras else "wide_cameras: [] # no cameras for Sun and horizon\n"
    unjudged = () if satellite.field_of_view_deg else _NEED_STARS
    knowledge = "".join(f"  {key}: null # no star camera\n" for key in unjudged)
    return _laid_out(f"""\
# {satellite.name}: {satellite.mass:g} kg, {x:g} x {y:g} x {z:g} m. Written by:
#   {command}
# Values are in SI units, unless their name contains another unit. Values marked [given] are those
# of the command, and values marked [computed] follow from them. All other values are those of the
# configuration `orbit`, or computed in flight from craft and coils. The command
# `knightcube check FILE --merged NEW` writes all values into one file.

extends: orbit
name: {satellite.name}

craft: # model that the flight application uses
  mass: {_text(satellite.mass)} # kg [given]
  size: [{", ".join(map(_text, satellite.size))}] # m, edges along the body axes [given]
  inertia: [{moments}] # kg m^2, body axes \
[computed: homogeneous cuboid; replace it by that of the CAD model]

{_coil_lines(satellite)}
{_camera_lines(satellite, values)}
{wide}elements: # two-line elements [computed: fitted to a day of the orbit below, \
{1e-3 * made.rms:.2g} km rms]
  - '{made.lines[0]}'
  - '{made.lines[1]}'

detumble:
  horizon: {values.detumble_horizon:g} # s, planning horizon of detumbling [computed]

estimation:
  current_noise: {_CURRENT_SIGMA * min(limits):.2g} # A, noise of the current of a coil [computed]

pointing: # body +z points to the goal, +x in the direction of flight if the roll is given
  roll: {values.roll:g} # rad, roll error ({math.degrees(values.roll):.0f} deg) with the same cost as \
a pointing error of 1 deg [computed]
{_cone_line(satellite)}
targets:
  - {{at: 0.0, point: nadir, roll_deg: 0.0}} # body +z down, +x in the direction of flight

requirements: # requirements that `knightcube report` checks; null: not checked
  slow_within: {values.slow_within:g} # s, longest time of detumbling \
[computed: an estimate for {release:g} deg/s]
{knowledge}  pointing_deg: null # deg, rms error of the pointing axis: your requirement

duration: {values.duration:g} # s, detumbling and more than one revolution [computed]

simulation: # the simulated satellite; other values equal those above
  utc: '{satellite.utc}' # start of the flight [given]
  free_body:
    orbit: {{{place}}} # m, deg, h [given]
    release: {{speed: {math.radians(release):.4g}}} # rad/s ({release:g} deg/s), about a random axis [given]
  current_noise: {_CURRENT_ERROR * min(limits):.2g} # A, largest error of a measured current \
in each cycle [computed]
  coil_field: [{_coil_fields(satellite)}] # T/A, field of each coil at the magnetometer [assumed]
""")


def _coil_lines(satellite: Satellite) -> str:
    largest = max(coil.current_limit for coil in satellite.coils)
    windings = ""
    for coil in satellite.coils:
        values = f"dipole_per_ampere: {_text(coil.dipole_per_ampere)}, resistance: {_text(coil.resistance)}"
        if coil.current_limit != largest:
            values += f", current_limit: {_text(coil.current_limit)}"
        dipole = f"{coil.dipole:.3g} A m^2 at {coil.current_limit:.3g} A"
        windings += f"    - {{axis: [{', '.join(map(_text, coil.axis))}], {values}}} # {dipole} [given]\n"
    return f"""\
coils:
  windings: # direction of the dipole in body axes, dipole per current (m^2), resistance (ohm)
{windings}  supply_voltage: {_text(satellite.supply_voltage)} # V across a coil that is fully on [computed]
  current_limit: {_text(largest)} # A [given]
"""


def _coil_fields(satellite: Satellite) -> str:
    """Return the field of each coil at the magnetometer, scaled from that of the configuration `orbit`."""
    fields = np.zeros((3, max(3, len(satellite.coils))))
    for index, coil in enumerate(satellite.coils):
        fields[:, index] = np.array(coil.axis) * _STRAY_FIELD / coil.current_limit
    return ", ".join(f"[{', '.join(f'{value:.2g}' for value in row)}]" for row in fields)


def _camera_lines(satellite: Satellite, values: Derived) -> str:
    if satellite.field_of_view_deg is None:
        return "camera: none # no star camera\n"
    half = math.radians(0.5 * (90.0 + TILT_DEG))
    side, other, sine = ("-y", "+y", 1.0) if values.sun_side else ("+y", "-y", -1.0)
    return f"""\
camera: # star camera with 512 x 512 px: give your `columns` and `rows`, and its other values
  # The boresight is body {side}, turned by {TILT_DEG:g} deg to -z, the zenith if +z points down.
  # At the start, the Sun is {abs(values.beta_deg):.0f} deg from the plane of the orbit, \
towards {other} [computed].
  mounting: [{sine * math.sin(half):.8f}, 0.0, 0.0, {math.cos(half):.8f}]
  field_of_view_deg: {_text(satellite.field_of_view_deg)} # deg, across the columns [given]
"""


def _cone_line(satellite: Satellite) -> str:
    """Return the line of the star camera's exclusion cones, which are wider than its field of view."""
    if satellite.field_of_view_deg is None:
        return ""
    half = math.radians(0.5 * satellite.field_of_view_deg)
    corner = math.degrees(math.atan(math.sqrt(2.0) * math.tan(half)))
    sun, earth, moon = (max(angle, math.ceil(corner + 2.0)) for angle in (42.0, 19.0, 16.0))
    cones = f"{{sun_deg: {sun:.1f}, earth_deg: {earth:.1f}, moon_deg: {moon:.1f}}}"
    return f"  cones: {cones} # exclusion cones of the star camera during slews [computed]\n"


def _text(value: float) -> str:
    return f"{value:.6g}" if "." in f"{value:.6g}" or "e" in f"{value:.6g}" else f"{value:.6g}.0"


def _laid_out(text: str) -> str:
    """Return a text with its comments aligned, except comments that are alone on their line."""
    lines = []
    for line in text.splitlines():
        value, mark, comment = line.partition(" # ")
        padded = f"{value:<27}" if len(value) < 27 else f"{value}  "
        lines.append(f"{padded} # {comment}" if mark and value.strip() else line)
    return "\n".join(lines) + "\n"


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
    current, resistance = (_coil_number(key, given[key]) for key in ("current", "resistance"))
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
    """Return an altitude in km, or the orbit between two altitudes such as 450x900. Raises ValueError."""
    mean = number(*_ALTITUDES, "km, or the altitudes of perigee and apogee such as 450x900")
    ends = text.lower().split("x")
    if len(ends) != 2:
        return mean(text)
    end = number(_LOWEST_PERIGEE, 4000.0, "km for perigee and apogee")
    perigee, apogee = sorted((end(ends[0]), end(ends[1])))
    altitude = 0.5 * (perigee + apogee)
    eccentricity = 0.5 * (apogee - perigee) / (1e-3 * EARTH_RADIUS + altitude)
    if eccentricity > _LARGEST_ECCENTRICITY:
        cure = f"give a lower apogee, up to {_LARGEST_ECCENTRICITY:g}"
        raise ValueError(f"the eccentricity is {eccentricity:.3g}: {cure}")
    mean(f"{altitude}")
    return Apsides(altitude, eccentricity)


def _number_or(word: str, low: float, high: float) -> Callable[[str], float | None]:
    """Return a function that reads a number of degrees within a range, or `word` as None."""
    read = number(low, high, f"deg, or {word}")
    return lambda text: None if text.lower() == word else read(text)


def _read_utc(text: str) -> str:
    whole = text if text.endswith("Z") else f"{text}Z"
    first, last = YEARS
    try:
        julian_date(whole)
    except ConfigError:
        raise ValueError("give a time such as 2026-03-20T12:00:00") from None
    if not first <= int(whole[:4]) <= last:
        raise ValueError(f"give a year from {first} to {last}")
    return whole


def _read_yes(text: str) -> bool:
    if text.lower() not in {"yes", "no"}:
        raise ValueError("give yes or no")
    return text.lower() == "yes"


def _read_field_of_view(text: str) -> float | None:
    """Return a field of view in deg, or None for `none`.

    Raises ValueError for an invalid value, and for a resolution in pixels such as `640 x 480`.
    """
    if re.fullmatch(r"\d+\s*x\s*\d+", text.lower()):
        pixels = "give the pixels as `camera.columns` and `camera.rows` in the written file"
        raise ValueError(f"give the field of view across the columns, 6 to 40 deg, or none; {pixels}")
    return _number_or("none", 6.0, 40.0)(text)


_INCLINATION = _number_or("sso", 0.0, 180.0)
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
    Question(
        "inclination",
        "DEG",
        "inclination, deg, or sso for Sun-synchronous",
        _number_or("sso", 0.0, 180.0),
        "sso",
    ),
    Question(
        "local-time",
        "H",
        "local time of the ascending node by the true Sun at the start, h",
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
    Question(
        "star-camera",
        "DEG",
        "field of view of the star camera across its columns, deg, or none",
        _read_field_of_view,
        "20",
    ),
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
    orbit = {"altitude", "eccentricity", "inclination"}
    if not problem and name in orbit and orbit <= set(values) and values["inclination"] is None:
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
        cure = "give a lower current limit"
        return f"{voltage:.3g} V at the current limit, above {_HIGHEST_VOLTAGE:g} V: {cure}"
    if largest_dipole(tuple(coils)) == 0.0:
        return "these coils control only one axis: give also coils on other axes, such as axis=xyz"
    return ""
