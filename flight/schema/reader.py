"""Reads configurations: from YAML to a validated `flight.schema.sections.Config`.

Each error is one line that states the file, the line, the value and the remedy. The module also checks that
values of a configuration are consistent with each other, and defines the networks that the link accepts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from ipaddress import IPv4Address, IPv4Network
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from flight.schema.bodies import Craft, ExclusionCones, OrbitConfig, TestbedConfig, as_orbit, as_testbed
from flight.schema.devices import (
    AravisDevice,
    Camera,
    Coils,
    Power,
    PowerMonitorSection,
    SensorsSection,
    SolarStringsSection,
    UnitSection,
    V4l2Device,
    WideCamera,
    camera_model,
    driver_of,
    drop_inherited,
    fitted_devices,
    structure_mask,
    with_drivers,
)
from flight.schema.document import (
    ConfigError,
    Document,
    Quaternion,
    check_aim,
    convert,
    read_document,
    read_text,
    to_yaml,
)
from flight.schema.sections import CONTROL_RATE_HZ, Commands, Config, Link
from hal.interfaces.devices import MOST_COILS
from knightcube.astro.inertia import inertia_problem
from knightcube.errors import UsageError
from knightcube.vision.camera.lens import LensError

Refuse = Callable[[str, str], None]
"""Function that raises the error about a value; its arguments are the value's dotted name and the problem."""

_BITS_OF = {
    range(8, 9): "GREY Mono8 YUYV UYVY MJPG BA81 GBRG GRBG RGGB",
    range(10, 11): "Y10 Mono10 Y10P Y10B BG10 GB10 BA10 RG10 pBAA pGAA pgAA pRAA",
    range(12, 13): "Y12 Mono12 Y12P BG12 GB12 BA12 RG12 pBCC pGCC pgCC pRCC",
    range(14, 15): "Y14",
    range(9, 17): "Y16 Y16-BE Mono16 BYR2 GB16 GR16 RG16",
}
PIXEL_BITS = {name: bits for bits, names in _BITS_OF.items() for name in names.split()}
"""Permitted numbers of bits per pixel of each pixel format."""
LOOPBACK = IPv4Network("127.0.0.0/8")
_LARGEST_CORRECTION = 0.3
"""Largest difference of an element of a calibration matrix from the identity matrix. Every matrix within this
bound has an inverse."""
_BEYOND = 1.01
"""Largest ratio of the current limit of a coil to the current that its supply voltage drives."""
_PREFIX = 24
"""Default prefix length of the network whose hosts may send frames to the link."""
_MOST_SEGMENTS = 10_000
"""Maximum number of segment files of a log. The link lists a folder of this size in 0.1 s."""
_DATA_SYMBOLS = 223
"""Number of data symbols in a codeword of the link's Reed-Solomon code."""


def check_consistency(config: Config, document: Document) -> None:
    """Raise ConfigError for values that contradict each other."""

    def refuse(dotted: str, problem: str) -> None:
        raise document.error(dotted, problem)

    _check_coils(config, refuse)
    if isinstance(config, TestbedConfig):
        _check_testbed(config, refuse)
    if isinstance(config, OrbitConfig):
        _check_orbit(config, refuse)
    _check_commands(config, refuse)
    if config.link is not None:
        _check_link(config.link, config.commands, refuse)
    unit = config.inertial_unit
    # A reading waits for its control cycle, and the current computed from it flows until the next cycle.
    least = 1.0 / unit.rate_hz + 2.0 / CONTROL_RATE_HZ
    if unit.max_age < least:
        rates = f"`rate_hz` of {unit.rate_hz} and a control loop of {CONTROL_RATE_HZ:g} Hz"
        problem = f"is {unit.max_age:g} s: must be at least {least:g} s with {rates}"
        refuse("inertial_unit.max_age", problem)
    telemetry = config.telemetry
    if telemetry.budget_bytes < 2 * telemetry.segment_bytes:
        refuse(
            "telemetry.budget_bytes",
            f"is {telemetry.budget_bytes}: must be at least twice `telemetry.segment_bytes` "
            f"({telemetry.segment_bytes})",
        )
    if telemetry.budget_bytes > _MOST_SEGMENTS * telemetry.segment_bytes:
        problem = f"is {telemetry.budget_bytes}: a log has at most {_MOST_SEGMENTS} segments"
        refuse("telemetry.budget_bytes", f"{problem}: give a larger `telemetry.segment_bytes`")
    logs = 2 if config.simulation is None else 3
    if telemetry.archive_bytes < logs * telemetry.budget_bytes:
        problem = f"is {telemetry.archive_bytes}: must be at least {logs} times `telemetry.budget_bytes`"
        refuse("telemetry.archive_bytes", f"{problem} ({telemetry.budget_bytes}), for the logs of one run")
    if config.camera is not None:
        _check_camera(config.camera, refuse)
        _check_length("camera.mounting", config.camera.mounting, refuse)
    _check_unit("inertial_unit", unit, refuse)
    if config.magnetometer is not None:
        _check_unit("magnetometer", config.magnetometer, refuse)
    for index, camera in enumerate(config.wide_cameras):
        _check_wide_camera(f"wide_cameras[{index}]", camera, config.wide_cameras[0], refuse)
    if config.solar_strings is not None:
        _check_strings(config.solar_strings, refuse)
    if config.power is not None:
        _check_power(config, config.power, refuse)
    _check_connections(config, refuse)


def _check_testbed(config: TestbedConfig, refuse: Refuse) -> None:
    _check_testbed_coils(config.coils, refuse)
    if config.guidance.replan_period >= config.guidance.horizon:
        problem = f"is {config.guidance.replan_period:g} s: must be shorter than `guidance.horizon`"
        refuse("guidance.replan_period", f"{problem} ({config.guidance.horizon:g} s)")
    unit = config.inertial_unit
    sensors = unit.sensors if isinstance(unit, SensorsSection) else ()
    measured = {quantity for sensor in sensors for quantity in sensor.measures}
    if "gyro" in measured and "acceleration" not in measured:
        problem = "measure the rate but not the acceleration, which gives the angle of the testbed"
        refuse("inertial_unit.sensors", f"{problem}: add a sensor that measures `acceleration`")
    times = [step.at for step in config.steps]
    _check_order("steps", times, refuse)
    if config.duration <= times[-1]:
        refuse("duration", f"is {config.duration!r}: must be later than the last target, at {times[-1]!r} s")


def _check_testbed_coils(coils: Coils, refuse: Refuse) -> None:
    if len(coils.windings) != 3:
        refuse("coils.windings", f"has {len(coils.windings)} entries: the testbed has three coils")
    for index, coil in enumerate(coils.windings):
        place, own = f"coils.windings[{index}]", tuple(float(index == axis) for axis in range(3))
        if coil.axis != own:
            refuse(f"{place}.axis", f"is {list(coil.axis)}: must be {list(own)} on the testbed")
        for name in ("dipole_per_ampere", "turns", "area", "current_limit"):
            if getattr(coil, name) is not None:
                refuse(f"{place}.{name}", "belongs to a satellite: the testbed's coils are equal")


def _check_satellite_coils(coils: Coils, refuse: Refuse) -> None:
    for index, coil in enumerate(coils.windings):
        place = f"coils.windings[{index}]"
        try:
            coil.strength()
        except ConfigError as error:
            refuse(f"{place}.{error.where}", error.problem)
        limit, reached = coil.current_limit or coils.current_limit, coils.supply_voltage / coil.resistance
        if limit > _BEYOND * reached:
            key = "coils.current_limit" if coil.current_limit is None else f"{place}.current_limit"
            most = f"the supply can drive only {reached:.3g} A through {coil.resistance:g} ohm"
            refuse(key, f"is {limit:g}: {most}")
        if reached > _MOST_SURPLUS * limit:
            more = f"the supply would drive {reached:.3g} A, more than {_MOST_SURPLUS:g} times the limit"
            refuse(f"{place}.resistance", f"is {coil.resistance:g}: {more} of {limit:g} A: give ohm and A")
    try:
        slots = coils.slots
    except UsageError as error:
        refuse("coils.windings", f"cannot be flown: {error}")
    else:
        if len(slots) > MOST_COILS:
            x, y, z = slots[-1].axis
            normal = f"[{x:.2f}, {y:.2f}, {z:.2f}]"
            refuse("coils.windings", f"lie in one plane: tilt one coil towards its normal {normal}")


def _check_craft(craft: Craft, refuse: Refuse) -> None:
    if craft.inertia is None and craft.mass is None:
        refuse("craft", "needs `inertia` or `mass`")
    try:
        problem = inertia_problem(craft.inertia_matrix())
    except ValueError:
        problem = "mixes numbers and rows: give three moments, or three rows of three values"
    if problem:
        refuse("craft.inertia", problem)
    for offset, edge, axis in zip(craft.centre_of_mass, craft.size, "xyz", strict=True):
        if abs(offset) >= 0.5 * edge:
            problem = f"is {offset:g} m along {axis}: outside the box of {edge:g} m"
            refuse("craft.centre_of_mass", f"{problem}: give m from the centre of the box")


# Limits of the density of a satellite, kg/m^3: an inflated balloon, and platinum.
_DENSITIES = (5.0, 20_000.0)
# Largest ratio of the sum of the moments of inertia to that of the same mass at the corners of the body. The
# ratio exceeds 1 for a satellite with long booms.
_MOST_SPREAD = 10.0
# Smallest ratio of the sum of the moments of inertia to that of a homogeneous body.
_LEAST_INERTIA = 0.05
# Largest dipole moment of a coil per kg of the satellite, A m^2/kg, if a tenth of the mass is saturated iron.
_MOST_DIPOLE = 20.0
# Largest residual dipole of a satellite with magnetic control, per kg of its mass, A m^2/kg.
_MOST_RESIDUAL = 0.5
# Largest field of the Earth in orbit, T: at the poles, at the lowest altitude.
_EARTH_FIELD = 6.5e-5
# Largest ratio of the current that the supply can drive through a coil to the current limit of the coil.
_MOST_SURPLUS = 100.0


def _check_units(craft: Craft, coils: Coils, refuse: Refuse) -> None:
    """Refuse values that no satellite has, which are probably given in another unit."""
    low, high = _DENSITIES
    volume, square = math.prod(craft.size), sum(edge * edge for edge in craft.size)
    box = f"a box of {' x '.join(f'{edge:g}' for edge in craft.size)} m"
    mass, trace = craft.mass, float(np.trace(craft.inertia_matrix()))
    if mass is not None and not low <= mass / volume <= high:
        density = f"a density of {mass / volume:.3g} kg/m^3, not {low:g} to {high:g}"
        refuse("craft.mass", f"is {mass:g}: in {box} (`craft.size`) this is {density}: give kg and m")
    heaviest = mass or high * volume
    most, least = _MOST_SPREAD * heaviest * square / 2.0, _LEAST_INERTIA * (mass or 0.0) * square / 6.0
    if not least <= trace <= most:
        limits = f"{heaviest:.3g} kg in {box} have {least:.2g} to {most:.2g}"
        refuse("craft.inertia", f"has moments with a sum of {trace:.4g} kg m^2, but {limits}: give kg m^2")
    residual = math.hypot(*craft.residual_dipole)
    if residual > _MOST_RESIDUAL * heaviest:
        limit = f"more than {_MOST_RESIDUAL * heaviest:.3g} A m^2, the maximum for {heaviest:.3g} kg"
        refuse("craft.residual_dipole", f"has {residual:.4g} A m^2, {limit}: give A m^2 instead of mA m^2")
    for index, coil in enumerate(coils.windings):
        dipole = coil.strength() * (coil.current_limit or coils.current_limit)
        if dipole > _MOST_DIPOLE * heaviest:
            limit = f"more than {_MOST_DIPOLE * heaviest:.3g} A m^2, the maximum for {heaviest:.3g} kg"
            cure = "give m^2 for `area` and `dipole_per_ampere`, and A for `current_limit`"
            refuse(f"coils.windings[{index}]", f"has a dipole moment of {dipole:.4g} A m^2, {limit}: {cure}")


def _check_orbit(config: OrbitConfig, refuse: Refuse) -> None:
    _check_satellite_coils(config.coils, refuse)
    _check_craft(config.craft, refuse)
    _check_units(config.craft, config.coils, refuse)
    times = [step.at for step in config.targets]
    _check_order("targets", times, refuse)
    for index, step in enumerate(config.targets):
        check_aim(f"targets[{index}]", step, step.point, refuse)
        if step.point == "object" and not config.looks_for_objects():
            refuse(f"targets[{index}].point", "is object: needs `camera` with `objects`")
    axes = (config.pointing.axis, config.pointing.across)
    for name, axis in zip(("axis", "across"), axes, strict=True):
        if abs(math.hypot(*axis) - 1.0) > 1e-6:
            refuse(f"pointing.{name}", f"has length {math.hypot(*axis):.6g}: give a unit vector")
    cosine = sum(a * b for a, b in zip(*axes, strict=True))
    if abs(cosine) > 1e-6:
        degrees = math.degrees(math.acos(cosine))
        refuse("pointing.across", f"is {degrees:.1f} deg from `pointing.axis`: must be 90 deg from it")
    if config.inertial_unit.field_range < _EARTH_FIELD:
        problem = f"is {config.inertial_unit.field_range:g} T; the Earth's field reaches {_EARTH_FIELD:g} T"
        refuse("inertial_unit.field_range", f"{problem}: give T")
    if config.camera is not None:
        _check_cones(config.camera, config.pointing.cones, refuse)


def _check_cones(camera: Camera, cones: ExclusionCones, refuse: Refuse) -> None:
    """Refuse a cone too small to keep the Sun, Moon or Earth out of the star camera's field of view."""
    half_width = math.tan(math.radians(0.5 * camera.field_of_view_deg))
    corner = math.degrees(math.atan(half_width * math.hypot(1.0, camera.rows / camera.columns)))
    for name, angle in cones.angles().items():
        if math.degrees(angle) < corner:
            problem = f"is {math.degrees(angle):g}: must cover the corner of the star camera's image,"
            refuse(f"pointing.cones.{name}_deg", f"{problem} {corner:.1f} deg from its boresight")


def _check_order(section: str, times: list[float], refuse: Refuse) -> None:
    if times[0] != 0.0:
        refuse(f"{section}[0].at", f"is {times[0]!r}: the first target must be given at 0")
    for index in range(1, len(times)):
        if times[index] <= times[index - 1]:
            refuse(f"{section}[{index}].at", f"is {times[index]!r}: targets must be in order of time")


def _check_coils(config: Config, refuse: Refuse) -> None:
    coils = config.coils
    for index, coil in enumerate(coils.windings):
        if not any(coil.axis):
            problem = f"is {list(coil.axis)}: give the direction of the coil's dipole moment"
            refuse(f"coils.windings[{index}].axis", problem)
    count = len(coils.windings)
    if not 2 <= count <= MOST_COILS:
        refuse("coils.windings", f"has {count} entries: 2 to {MOST_COILS} coils are supported")
    used = [channel for index, coil in enumerate(coils.windings) for channel in coil.pins(index)]
    if len(set(used)) != len(used):
        twice = next(channel for channel in used if used.count(channel) > 1)
        free = [channel for channel in range(16) if channel not in used]
        cure = f"give one of the two coils other `channels`, of {free}"
        refuse("coils.windings", f"use channel {twice} of the PWM chip twice: {cure}")


def _check_strings(strings: SolarStringsSection, refuse: Refuse) -> None:
    inputs = set()
    for index, string in enumerate(strings.strings):
        place = f"solar_strings.strings[{index}]"
        if (string.address, string.channel) in inputs:
            refuse(f"{place}.channel", f"is {string.channel}: this ADC channel is used for another string")
        inputs.add((string.address, string.channel))
        if abs(math.hypot(*string.normal) - 1.0) > 1e-6:
            refuse(f"{place}.normal", f"has length {math.hypot(*string.normal):.6g}: give a unit vector")


def _check_power(config: Config, power: Power, refuse: Refuse) -> None:
    curve, limits = power.battery.open_circuit, power.low_battery
    if any(after <= before for before, after in pairwise(curve)):
        refuse("power.battery.open_circuit", "must rise from each state of charge to the next")
    if not limits.critical < limits.very_low < limits.low:
        order = f"{limits.critical:g}, {limits.very_low:g}, {limits.low:g}"
        refuse("power.low_battery", f"has {order} as critical, very_low and low: must be in rising order")
    if limits.low + limits.hysteresis > 1.0:
        top = f"is {limits.low:g}: with the hysteresis of {limits.hysteresis:g}"
        refuse("power.low_battery.low", f"{top} it exceeds 1, the full charge: reduce the limit")
    if config.camera is not None and limits.camera_period < config.camera.period:
        period = f"is {limits.camera_period:g} s: must be at least `camera.period`"
        refuse("power.low_battery.camera_period", f"{period}, {config.camera.period:g} s")


def _connections(config: Config) -> Iterator[tuple[str, str, str]]:
    """Yield the dotted key, the value and the address of each device file and each I2C address in use.

    Two devices must not have the same address. An I2C address includes its bus, because devices on different
    buses may have the same address.
    """

    def chip(key: str, address: int, bus: int | str | None) -> tuple[str, str, str]:
        on = config.coils.bus if bus is None else bus
        file = f"/dev/i2c-{on}" if isinstance(on, int) else on
        return key, f"0x{address:02x}", f"0x{address:02x} on {file}"

    for offset in range(len(config.coils.windings) if config.coils.driver == "drv8830" else 1):
        yield chip("coils.address", config.coils.address + offset, None)
    for key, _, section in fitted_devices(config):
        if isinstance(section, PowerMonitorSection):
            yield chip(f"{key}.address", section.address, section.bus)
        elif isinstance(section, SolarStringsSection):
            first = {string.address: index for index, string in reversed(list(enumerate(section.strings)))}
            for address, index in first.items():
                yield chip(f"{key}.strings[{index}].address", address, section.bus)
        for number, sensor in enumerate(getattr(section, "sensors", ())):
            if sensor.address is not None:
                yield chip(f"{key}.sensors[{number}].address", sensor.address, sensor.bus)
            if sensor.spi is not None:
                yield f"{key}.sensors[{number}].spi", sensor.spi, sensor.spi
        if isinstance(file := getattr(section, "device", None), str):
            yield f"{key}.device", file, file
    cameras = [("camera", config.camera)] if config.camera is not None else []
    for key, camera in cameras + [(f"wide_cameras[{k}]", one) for k, one in enumerate(config.wide_cameras)]:
        for name in ("path", "name"):
            if isinstance(place := getattr(camera.device, name, None), str):
                yield f"{key}.device.{name}", place, place


def _check_addresses(config: Config, refuse: Refuse) -> None:
    """Refuse I2C addresses that a chip cannot have, such as the decimal number 45 for 0x45."""
    for key, kind, section in fitted_devices(config):
        strings = enumerate(getattr(section, "strings", ()))
        found = [(f"{key}.strings[{k}].address", one.address) for k, one in strings]
        # The section of a driver from another package may use the key for an address that is not on I2C.
        if isinstance(getattr(section, "address", None), int):
            found.append((f"{key}.address", section.address))
        low, high = driver_of(kind, section, key).addresses
        for name, address in found:
            if not low <= address <= high:
                meant = int(str(address), 16)
                hint = f": did you mean 0x{meant:02x}?" if low <= meant <= high else ""
                chip = f"a chip of type {section.driver} has 0x{low:02x} to 0x{high:02x}"
                refuse(name, f"is 0x{address:02x} ({address}), but {chip}{hint}")
        if kind == "coils" and section.driver == "drv8830":
            last, greatest = section.address + len(section.windings) - 1, high - len(section.windings) + 1
            if last > high:
                problem = f"is 0x{section.address:02x}: its coils use the addresses up to 0x{last:02x}"
                cure = f"the last address of a drv8830 is 0x{high:02x}: give at most 0x{greatest:02x}"
                refuse(f"{key}.address", f"{problem}, but {cure}")


def _check_connections(config: Config, refuse: Refuse) -> None:
    taken: dict[str, str] = {}
    for key, value, place in _connections(config):
        if (first := taken.setdefault(place, key)) != key:
            refuse(key, f"is {value}, which `{first}` also uses: give each device its own address or file")
    _check_addresses(config, refuse)


def _check_length(dotted: str, quaternion: Quaternion, refuse: Refuse) -> None:
    norm = math.sqrt(sum(c * c for c in quaternion))
    if abs(norm - 1.0) > 1e-6:
        refuse(dotted, f"has length {norm:.6g}: a quaternion must have length 1")


# Largest noise of a gyro (rad/s) and of an attitude (rad), and largest range of a magnetometer (T).
_MOST_OF_UNIT = {
    "rate_noise": (0.02, "rad/s", "deg/s", math.pi / 180.0),
    "angle_noise": (0.5, "rad", "deg", math.pi / 180.0),
    "field_range": (0.01, "T", "uT", 1e-6),
}


def _check_unit(kind: str, unit: UnitSection, refuse: Refuse) -> None:
    _check_length(f"{kind}.mounting", unit.mounting, refuse)
    for name, (most, wanted, other, scale) in _MOST_OF_UNIT.items():
        value = getattr(unit, name)
        if value > most:
            other_unit = f"the unit is {wanted}, and {value:g} {other} are {value * scale:.3g} {wanted}"
            refuse(f"{kind}.{name}", f"is {value:g}: expected at most {most:g}: {other_unit}")
    for name in ("gyro_matrix", "field_matrix"):
        largest = float(np.abs(np.array(getattr(unit.calibration, name)) - np.eye(3)).max())
        if largest > _LARGEST_CORRECTION:
            problem = f"differs from the identity matrix by {largest:.3g}: it may differ by at most"
            refuse(f"{kind}.calibration.{name}", f"{problem} {_LARGEST_CORRECTION:g} in each element")


_COMMANDED = {
    "testbed": ("safe", "detumble", "hold", "testbed-demo"),
    "orbit": ("safe", "detumble", "sun", "point"),
}
"""Modes that can be commanded, by the body of this package."""


def _check_commands(config: Config, refuse: Refuse) -> None:
    commands, modes = config.commands, _COMMANDED.get(config.body)
    for index, step in enumerate(commands.timeline):
        dotted = f"commands.timeline[{index}]"
        given = [name for name in ("mode", "slew", "point", "clear") if getattr(step, name) is not None]
        if len(given) != 1:
            refuse(dotted, f"gives {given}: must give one of mode, slew, point, clear")
        if step.point is not None and isinstance(config, TestbedConfig):
            refuse(f"{dotted}.point", "is a command for satellites: use `slew` for the testbed")
        if step.slew is not None and isinstance(config, OrbitConfig):
            refuse(f"{dotted}.slew", "is a command for the testbed: use `point` for a satellite")
        if modes is not None and step.mode is not None and step.mode not in modes:
            refuse(f"{dotted}.mode", f"is {step.mode}: this body can be commanded to {', '.join(modes)}")
        check_aim(dotted, step, step.point, refuse)
    if not _is_loopback(commands):
        problem = "accepts unprotected commands from other machines"
        cure = "give a loopback address, and use `link` with keys"
        refuse("commands.udp", f"{commands.udp} {problem}: {cure}")


def _check_link(link: Link, commands: Commands, refuse: Refuse) -> None:
    if commands.socket is None:
        refuse("link", "needs `commands.socket`, through which it passes commands to the flight")
    if link.udp is None and link.tcp is None and link.serial is None and link.kiss is None:
        refuse("link", "has no communication line: give `udp`, `tcp`, `serial` or `kiss`")
    depth = link.coding.reed_solomon
    if depth is not None and (link.frame_bytes % depth or link.frame_bytes > _DATA_SYMBOLS * depth):
        most = _DATA_SYMBOLS * depth
        cure = f"must be a multiple of `link.coding.reed_solomon` ({depth}), at most {most}"
        refuse("link.frame_bytes", f"is {link.frame_bytes}: {cure}")
    if link.call_signs is not None and link.kiss is None and not (link.serial and link.serial.kiss):
        refuse("link.call_signs", "needs `link.kiss` or `link.serial.kiss`")
    if link.idle_rate > link.rate:
        refuse("link.idle_rate", f"is {link.idle_rate:g}: must not be above `link.rate` ({link.rate:g})")
    if link.telemetry_to is not None and link.udp is None:
        refuse("link.telemetry_to", "needs `link.udp`: add it, or omit `telemetry_to`")
    host = (link.telemetry_to or "localhost:0").rpartition(":")[0]
    try:
        IPv4Address("127.0.0.1" if host == "localhost" else host)
    except ValueError:  # resolving a host name would block the link at each frame
        refuse("link.telemetry_to", f"{host} is not an IPv4 address: give one, such as 192.0.2.7:5011")
    try:
        peer_networks(link)
    except ValueError as error:
        named = next((name for name in ("peers", "udp", "tcp", "kiss") if getattr(link, name)), "peers")
        refuse(f"link.{named}", str(error))


# Largest distance of the optical axis from the image centre along a side of the image, relative to the side.
_MOST_OFF_CENTRE = 0.25

# Largest relative difference between the field of view of a lens and the stated field of view.
_FIELD_TOLERANCE = 0.1


def _check_wide_camera(dotted: str, camera: WideCamera, first: WideCamera, refuse: Refuse) -> None:
    _check_length(f"{dotted}.mounting", camera.mounting, refuse)
    _check_lens(dotted, camera, refuse)
    try:
        structure_mask(camera, of_file=False)
    except UsageError as error:
        refuse(f"{dotted}.structure", f"is refused: {error}")
    for name in ("response", "decades", "bits", "pedestal"):
        if (value := getattr(camera, name)) != (wanted := getattr(first, name)):
            problem = f"is {value!r}: must be equal for all `wide_cameras`, the first has {wanted!r}"
            refuse(f"{dotted}.{name}", problem)


def _check_lens(dotted: str, camera: Camera | WideCamera, refuse: Refuse) -> None:
    """Refuse a lens that cannot be that of the camera, such as a lens calibrated with another image size."""
    if camera.lens is None:
        return
    try:
        camera_model(camera)
    except LensError as error:
        refuse(f"{dotted}.lens", f"is refused: {error}")
        return
    (x, y), (columns, rows) = camera.lens.centre, (camera.columns, camera.rows)
    if abs(x - 0.5 * columns) > _MOST_OFF_CENTRE * columns or abs(y - 0.5 * rows) > _MOST_OFF_CENTRE * rows:
        problem = f"is ({x:g}, {y:g}): far from the centre of an image of {columns} x {rows} pixels"
        refuse(f"{dotted}.lens.centre", f"{problem}; give the lens of a calibration with images of this size")
    field_deg = 2.0 * math.degrees(math.atan(0.5 * columns / camera.lens.focal_length))
    if abs(field_deg / camera.field_of_view_deg - 1.0) > _FIELD_TOLERANCE:
        problem = f"is {camera.lens.focal_length:g} px: {columns} columns then cover {field_deg:.4g} deg,"
        stated = f"but `{dotted}.field_of_view_deg` is {camera.field_of_view_deg:g}"
        refuse(f"{dotted}.lens.focal_length", f"{problem} {stated}: give both of the same camera")


def _check_camera(camera: Camera, refuse: Refuse) -> None:
    _check_lens("camera", camera, refuse)
    if camera.saturation is not None and camera.saturation > (highest := 2**camera.bits - 1):
        problem = f"is {camera.saturation:g}: pixels of {camera.bits} bits (`camera.bits`) have at most"
        refuse("camera.saturation", f"{problem} {highest} counts")
    if camera.exposure >= camera.period:
        problem = f"is {camera.exposure:g} s: must be shorter than `camera.period` ({camera.period:g} s)"
        refuse("camera.exposure", problem)
    if camera.streak_exposure is not None:
        least, most = camera.streak_exposure
        if not least <= most < camera.period:
            limits = f"a minimum and a maximum below `camera.period` ({camera.period:g} s)"
            refuse("camera.streak_exposure", f"is [{least:g}, {most:g}] s: must be {limits}")
    if camera.objects is not None and camera.objects.needed > camera.objects.within:
        refuse("camera.objects.needed", f"is {camera.objects.needed}: must be at most `within`")
    if camera.fine_period is not None and not camera.period <= camera.fine_period < camera.max_age:
        refuse(
            "camera.fine_period",
            f"is {camera.fine_period:g}: must be at least `camera.period` ({camera.period:g}) and less than "
            f"`camera.max_age` ({camera.max_age:g})",
        )
    if isinstance(camera.device, V4l2Device | AravisDevice):
        pixel_format, possible = camera.device.pixel_format, PIXEL_BITS[camera.device.pixel_format]
        if camera.bits not in possible:
            span = f"{possible[0]}" if len(possible) == 1 else f"{possible[0]} to {possible[-1]}"
            refuse("camera.bits", f"is {camera.bits}: pixels of {pixel_format} have {span} bits")


def peer_networks(link: Link) -> tuple[IPv4Network, ...]:
    """Return the networks from which link and service sandbox accept frames. Raises ValueError.

    The result is empty if none of UDP, TCP and KISS is configured.
    """
    lines = (link.udp, link.tcp, link.kiss) if link.peers is None else (link.kiss,)
    hosts = [address.rpartition(":")[0] for address in lines if address is not None]
    networks = []
    if link.peers is not None and (link.udp or link.tcp or link.kiss):
        networks = list(map(IPv4Network, link.peers))
    for host in hosts:
        try:
            own = IPv4Address("127.0.0.1" if host == "localhost" else host)
        except ValueError as error:
            raise ValueError(
                f"{host} is not an IPv4 address: list the permitted senders in `link.peers`"
            ) from error
        if own.is_unspecified:
            raise ValueError(f"{host} accepts every network: list the permitted senders in `link.peers`")
        networks.append(LOOPBACK if own.is_loopback else IPv4Network((own, _PREFIX), strict=False))
    return tuple(dict.fromkeys(networks))


def _is_loopback(commands: Commands) -> bool:
    """Return whether unprotected UDP commands are disabled or accepted from this machine only."""
    host = (commands.udp or "localhost:0").rpartition(":")[0]
    try:
        return host == "localhost" or IPv4Address(host).is_loopback
    except ValueError:
        return False


T = TypeVar("T")
S = TypeVar("S", bound=msgspec.Struct)

_FIELDS = {*TestbedConfig.__struct_fields__, *OrbitConfig.__struct_fields__}
"""Names of the top-level sections of all bodies."""


def load(path: Path) -> Config:
    """Read and validate a configuration file. Raises ConfigError."""
    return parse(read_text(path), str(path))


def parse(text: str, name: str = "configuration") -> Config:
    """Validate a configuration text. Error messages name the file `name`. Raises ConfigError."""
    document = read_document(text, name)
    optionals = "inertial_unit", "magnetometer", "camera", "power_monitor", "power", "gps", "solar_strings"
    for optional in optionals:
        if document.values.get(optional) == "none":
            document.values[optional] = None
    _replace_unit(document)
    _check_body(document)
    shape = OrbitConfig if document.values.get("body") == "orbit" else TestbedConfig
    _check_sections(document, shape)
    drop_inherited(document)
    config: Config = convert(document, with_drivers(shape, document))
    check_consistency(config, document)
    return config


def merged_text(text: str, name: str) -> str:
    """Return a configuration and the files that it extends as one text. Raises ConfigError.

    The text has no inherited keys of a driver that an extending file replaces.
    """
    document = read_document(text, name)
    if len(document.chain) == 1:
        return text
    drop_inherited(document)
    # The names are quoted, because they may contain line breaks.
    names_of = ", ".join(ascii(Path(one).name) for one in document.chain)
    return f"# merged from {names_of}\n{to_yaml(document.values)}"


def _check_sections(document: Document, shape: type[Any]) -> None:
    """Raise ConfigError with all missing values if a file that extends no other file lacks most of them."""
    required = [one for one in msgspec.structs.fields(shape) if one.required and one.encode_name != "name"]
    missing = [one.encode_name for one in required if one.encode_name not in document.values]
    if 2 * len(missing) > len(required) and len(document.chain) == 1:
        cure = "give them, or add `extends: orbit`, or another configuration that has them"
        raise ConfigError(document.name, f"has no {', '.join(f'`{name}`' for name in missing)}: {cure}")


def _check_body(document: Document) -> None:
    """Raise ConfigError, with a remedy, for a section that belongs to the other kind of body.

    A body defined outside this repository uses the sections of the testbed.
    """
    shapes = {"testbed": TestbedConfig, "orbit": OrbitConfig}
    body = document.values.get("body", "testbed")
    own, other = ("orbit", "testbed") if body == "orbit" else ("testbed", "orbit")
    foreign = {*shapes[other].__struct_fields__} - {*shapes[own].__struct_fields__}
    found = next((key for key in document.values if key in foreign), None)
    if found is None:
        return
    if "body" not in document.values and len(document.chain) == 1:
        cure = f"add `extends: orbit`, or another configuration, or `body: {other}`"
        raise document.error(
            found, f"belongs to `body: {other}`, but no `extends` and no `body` is given: {cure}"
        )
    cure = {"targets": "give `steps` instead", "steps": "give `targets` instead"}.get(found, "omit it")
    raise document.error(found, f"belongs to `body: {other}`, but `body` is {body}: {cure}, or change `body`")


def _replace_unit(document: Document) -> None:
    """Use the magnetometer as an inertial unit without a gyro if `inertial_unit` is `none`.

    Raises ConfigError if `inertial_unit` is `none` and no magnetometer is configured.
    """
    values = document.values
    if values.get("inertial_unit") is not None:
        return
    if isinstance(values.get("magnetometer"), dict):
        values["inertial_unit"] = {"driver": "sensors", **values.pop("magnetometer")}
    elif "inertial_unit" in values:
        raise document.error("inertial_unit", "is none: give a `magnetometer`, which then replaces the unit")


def load_testbed(path: Path) -> TestbedConfig:
    """Read and validate a configuration of the testbed. Raises ConfigError for any other body."""
    try:
        return as_testbed(load(path))
    except ConfigError as error:
        raise placed(error, read_text(path), str(path)) from error


def load_orbit(path: Path) -> OrbitConfig:
    """Read and validate a satellite's configuration. Raises ConfigError for any other body."""
    try:
        return as_orbit(load(path))
    except ConfigError as error:
        raise placed(error, read_text(path), str(path)) from error


def load_camera(path: Path) -> Camera:
    """Read the camera of a configuration, or of a file with only a `camera` section. Raises ConfigError."""
    text = read_text(path)
    document = read_document(text, str(path))
    if set(document.values) == {"camera"} and document.values["camera"] != "none":
        return convert(document, Camera, "camera")
    camera = parse(text, str(path)).camera
    if camera is None:
        raise ConfigError(str(path), "`camera` is none: give a configuration with a camera")
    return camera


def placed(error: UsageError, text: str, name: str) -> UsageError:
    """Add file and line to an error that begins with a value's dotted name; return other errors unchanged."""
    where, _, problem = str(error).partition(": ")
    if where.partition(".")[0].partition("[")[0] not in _FIELDS:
        return error
    return read_document(text, name).error(where, problem)


def simulation_section(text: str, name: str, shape: type[T]) -> T | None:
    """Return the `simulation` section as the simulator's type `shape`, or None. Raises ConfigError."""
    document = read_document(text, name)
    return None if document.values.get("simulation") is None else convert(document, shape, "simulation")


def replace(section: S, **changes: Any) -> S:
    """Return a copy of a section with some values changed."""
    return msgspec.structs.replace(section, **changes)
