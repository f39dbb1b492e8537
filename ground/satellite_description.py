"""Configuration file of a satellite that is described by mass, size, orbit, coils and cameras.

The file extends the configuration `orbit` (a 1U CubeSat) and contains only differing values. Values that are
not described are computed: the inertia is that of a homogeneous cuboid, and limits are scaled between those
of the configurations `orbit` and `orbit_3u`. The file omits weights and noise levels that the flight
application computes from craft and coils.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.mean_elements import FittedElements
from knightcube.astro.inertia import box_inertia
from sim_hal.settings import OrbitSection
from sim_hal.worlds.orbit import elements, log_density, sun_position

Vector = tuple[float, float, float]
Line = str | tuple[str, str]
"""A line of the configuration file, or a pair of a value and its comment."""

TILT_DEG = 22.0
"""Angle of the star camera from the normal of the orbit towards the zenith, deg."""
_YEAR_RATE = 2.0 * math.pi / (365.2422 * 86_400.0)  # mean rate of the Sun's right ascension, rad/s
_EQUATOR_FIELD = 2.98e-5  # field of the Earth's dipole at the equator at one Earth radius, T [IGRF-13]
_OFFSET, _DRAG_COEFFICIENT, _SUN_PRESSURE = 0.02, 2.2, 4.56e-6
"""Centre of mass offset (m) [CubeSat Design Specification], drag coefficient, solar pressure (Pa)."""
_CURRENT_ERROR, _CURRENT_SIGMA = 3.5e-3 / 0.148, 2.0e-3 / 0.148
"""Bound of the simulated current error, and assumed current noise, as fractions of the limit [`orbit`]."""
_STRAY_FIELD = 7.4e-5  # field (T) of a coil at the magnetometer at the current limit [as in `orbit`]


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
        disturbance: aerodynamic and solar torque on the largest face for a mass offset of 2 cm, N m.
        momentum_time: time (s) in which `coil_torque` removes the angular momentum at release.
        period: orbital period, s.
        slow_within: estimate of the longest time of detumbling, s.
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
    """Return the largest sum of drag and solar pressure (Pa) on a face in an orbit.

    The argument `perigee` is the distance of the perigee from the Earth's centre, m. The air is densest at
    the perigee.
    """
    place, sun = np.array([[perigee, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    density = math.exp(float(log_density(place, sun, 0.0)[0]))
    return 0.5 * _DRAG_COEFFICIENT * density * GRAVITATIONAL_PARAMETER / perigee + 2.0 * _SUN_PRESSURE


def _rounded_up(value: float, step: float) -> float:
    return step * math.ceil(value / step)


def configuration_text(satellite: Satellite, values: Derived, made: FittedElements, command: str) -> str:
    """Return the configuration file of a satellite, which names the `command` that writes the file."""
    x, y, z = satellite.size
    orbit = satellite.orbit
    wide = [] if satellite.wide_cameras else [("wide_cameras: []", "no cameras for Sun and horizon")]
    knowledge = [] if satellite.field_of_view_deg else [("  knowledge_deg: null", "no star camera")]
    place = ", ".join(
        f"{key}: {_text(value)}"
        for key, value in (
            ("altitude", orbit.altitude),
            ("inclination_deg", orbit.inclination_deg),
            ("eccentricity", orbit.eccentricity),
            ("local_time", orbit.local_time or 0.0),
        )
    )
    size = ", ".join(_text(side) for side in satellite.size)
    moments = ", ".join(f"{moment:.3e}" for moment in values.inertia)
    return _laid_out(
        f"# {satellite.name}: {satellite.mass:g} kg, {x:g} x {y:g} x {z:g} m. Written by:",
        f"#   {command}",
        "# Values are in SI units, unless their name contains another unit. Values marked [given] are those",
        "# of the command, and values marked [computed] follow from them. All other values are those of the",
        "# configuration `orbit`, or computed in flight from craft and coils. The command",
        "# `knightcube check FILE --merged NEW` writes all values into one file.",
        "",
        "extends: orbit",
        f"name: {satellite.name}",
        "",
        ("craft:", "model that the flight application uses"),
        (f"  mass: {_text(satellite.mass)}", "kg [given]"),
        (f"  size: [{size}]", "m, edges along the body axes [given]"),
        (
            f"  inertia: [{moments}]",
            "kg m^2, body axes [computed: homogeneous cuboid; replace it by that of the CAD model]",
        ),
        "",
        *_coil_lines(satellite),
        *_camera_lines(satellite, values),
        *wide,
        (
            "elements:",
            f"two-line elements [computed: fitted to a day of the orbit below, {1e-3 * made.rms:.2g} km rms]",
        ),
        f"  - '{made.lines[0]}'",
        f"  - '{made.lines[1]}'",
        "",
        "detumble:",
        (f"  horizon: {values.detumble_horizon:g}", "s, planning horizon of detumbling [computed]"),
        "",
        "estimation:",
        (
            f"  current_noise: {_CURRENT_SIGMA * min(coil.current_limit for coil in satellite.coils):.2g}",
            "A, noise of the current of a coil [computed]",
        ),
        "",
        ("pointing:", "body +z points to the goal, +x in the direction of flight if the roll is given"),
        (
            f"  roll: {values.roll:g}",
            f"rad, roll error ({math.degrees(values.roll):.0f} deg) with the same cost as a pointing "
            "error of 1 deg [computed]",
        ),
        *_cone_lines(satellite),
        "",
        "targets:",
        ("  - {at: 0.0, point: nadir, roll_deg: 0.0}", "body +z down, +x in the direction of flight"),
        "",
        ("requirements:", "requirements that `knightcube report` checks; null: not checked"),
        (
            f"  slow_within: {values.slow_within:g}",
            f"s, longest time of detumbling [computed: an estimate for {satellite.release_deg:g} deg/s]",
        ),
        *knowledge,
        ("  pointing_deg: null", "deg, rms error of the pointing axis: your requirement"),
        "",
        (f"duration: {values.duration:g}", "s, detumbling and more than one revolution [computed]"),
        "",
        ("simulation:", "the simulated satellite; other values equal those above"),
        (f"  utc: '{satellite.utc}'", "start of the flight [given]"),
        "  free_body:",
        (f"    orbit: {{{place}}}", "m, deg, h [given]"),
        (
            f"    release: {{speed: {math.radians(satellite.release_deg):.4g}}}",
            f"rad/s ({satellite.release_deg:g} deg/s), about a random axis [given]",
        ),
        *_current_lines(satellite),
    )


def _coil_lines(satellite: Satellite) -> list[Line]:
    """Return the lines of the configuration file that describe the coils."""
    largest = max(coil.current_limit for coil in satellite.coils)
    windings: list[Line] = []
    for coil in satellite.coils:
        axis = ", ".join(_text(component) for component in coil.axis)
        values = f"dipole_per_ampere: {_text(coil.dipole_per_ampere)}, resistance: {_text(coil.resistance)}"
        if coil.current_limit != largest:
            values += f", current_limit: {_text(coil.current_limit)}"
        dipole = f"{coil.dipole:.3g} A m^2 at {coil.current_limit:.3g} A"
        windings.append((f"    - {{axis: [{axis}], {values}}}", f"{dipole} [given]"))
    return [
        "coils:",
        ("  windings:", "direction of the dipole in body axes, dipole per current (m^2), resistance (ohm)"),
        *windings,
        (
            f"  supply_voltage: {_text(satellite.supply_voltage)}",
            "V across a coil that is fully on [computed]",
        ),
        (f"  current_limit: {_text(largest)}", "A [given]"),
        "",
    ]


def _current_lines(satellite: Satellite) -> list[Line]:
    """Return the lines of the simulated current errors, scaled from those of the configuration `orbit`."""
    least = min(coil.current_limit for coil in satellite.coils)
    fields = np.zeros((3, max(3, len(satellite.coils))))
    for index, coil in enumerate(satellite.coils):
        fields[:, index] = np.array(coil.axis) * _STRAY_FIELD / coil.current_limit
    rows = ", ".join(f"[{', '.join(f'{value:.2g}' for value in row)}]" for row in fields)
    return [
        (
            f"  current_noise: {_CURRENT_ERROR * least:.2g}",
            "A, largest error of a measured current in each cycle [computed]",
        ),
        (f"  coil_field: [{rows}]", "T/A, field of each coil at the magnetometer [assumed]"),
    ]


def _camera_lines(satellite: Satellite, values: Derived) -> list[Line]:
    """Return the lines of the configuration file that describe the star camera."""
    if satellite.field_of_view_deg is None:
        return [("camera: none", "no star camera"), ""]
    half = math.radians(0.5 * (90.0 + TILT_DEG))
    side, other, sine = ("-y", "+y", 1.0) if values.sun_side else ("+y", "-y", -1.0)
    sun = f"the Sun is {abs(values.beta_deg):.0f} deg from the plane of the orbit, towards {other}"
    return [
        ("camera:", "star camera; its other values are those of a camera with 512 x 512 px"),
        f"  # The boresight is body {side}, turned by {TILT_DEG:g} deg to -z, the zenith if +z points down.",
        f"  # At the start, {sun} [computed].",
        f"  mounting: [{sine * math.sin(half):.8f}, 0.0, 0.0, {math.cos(half):.8f}]",
        (f"  field_of_view_deg: {_text(satellite.field_of_view_deg)}", "deg [given]"),
        "",
    ]


def _cone_lines(satellite: Satellite) -> list[Line]:
    """Return the lines of the star camera's exclusion cones, which are wider than its field of view."""
    if satellite.field_of_view_deg is None:
        return []
    corner = math.degrees(
        math.atan(math.sqrt(2.0) * math.tan(math.radians(0.5 * satellite.field_of_view_deg)))
    )
    sun, earth, moon = (max(angle, math.ceil(corner + 2.0)) for angle in (42.0, 19.0, 16.0))
    return [
        (
            f"  cones: {{sun_deg: {sun:.1f}, earth_deg: {earth:.1f}, moon_deg: {moon:.1f}}}",
            "exclusion cones of the star camera during slews [computed]",
        )
    ]


def _text(value: float) -> str:
    """Return a number as YAML text."""
    return f"{value:.6g}" if "." in f"{value:.6g}" or "e" in f"{value:.6g}" else f"{value:.6g}.0"


def _laid_out(*lines: Line) -> str:
    """Return lines as text; a pair of value and comment becomes a line with an aligned comment."""
    texts = []
    for line in lines:
        if isinstance(line, str):
            texts.append(line)
        else:
            value, comment = line
            texts.append(f"{value:<27} # {comment}" if len(value) < 27 else f"{value}   # {comment}")
    return "\n".join(texts) + "\n"
