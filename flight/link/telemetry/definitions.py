"""Types of a packet definition, the table of all telemetry packets, and the table of parameters.

The packer, the parser, the ground database, the CSV export and the documentation are made from this table.
A packet that has flown is never changed in place: a field is appended, and the version of the packet is
raised. The parameters are values that an operator can change in flight, all of them at once. Until a table is
loaded, the configuration gives their values; the bounds of the configuration's schema apply as well.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from flight.link.events import Severity
from flight.link.modes import Mode
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT

Range = tuple[float, float]
States = tuple[tuple[int, str], ...]
Level = Literal["warning", "fault"]
Alarms = tuple[tuple[int, Level], ...]


@dataclass(frozen=True, slots=True)
class Limits:
    """Nominal ranges (low, high) of a value; a value outside is a warning or a fault."""

    warning: Range | None = None
    fault: Range | None = None


@dataclass(frozen=True, slots=True)
class Field:
    """One field: `kind` is a numpy type code (f8, f4, u1, u2, u4, u8, i8) or S<n> for n bytes of UTF-8.

    `count` > 1 makes an array. All numbers are big-endian on the wire.

    Attributes:
        states: the values of an enumerated field, each with its name.
        bits: the bits of a bit field, each with its name; several bits can be set.
        alarms: the states or set bits that are a warning or a fault.
        limits: the nominal ranges of a value without states.
        valid: the allowed range (low, high) of a command's argument.
        wraps: whether the field continues at 0 after its largest number.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    count: int = 1
    states: States = ()
    alarms: Alarms = ()
    limits: Limits | None = None
    valid: Range | None = None
    wraps: bool = False
    bits: States = ()


def counter(name: str, meaning: str, kind: str = "u4") -> Field:
    """Return the field of a counter, which wraps at the end of its range."""
    return Field(name, kind, "-", meaning, wraps=True)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet: its application process identifier (APID), rate and fields.

    `hazard` states the harm that a telecommand can cause, empty if there is none.
    """

    name: str
    apid: int
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    version: int = field(default=1)
    telecommand: bool = False
    hazard: str = ""


def _parameter(key: str, unit: str, low: float, high: float, meaning: str) -> Field:
    return Field(key.replace(".", "_", 1), "f8", unit, f"{key}: {meaning}", valid=(low, high))


PARAMETER_FIELDS: tuple[Field, ...] = (
    _parameter("modes.arrived_angle", "rad", 1e-4, 0.5, "a slew has arrived within this angle"),
    _parameter("modes.arrived_rate", "rad/s", 1e-5, 0.5, "and below this rate"),
    _parameter("modes.arrived_for", "s", 0.1, 600.0, "for this time"),
    _parameter("modes.slew_limit", "s", 1.0, 1e5, "a slew that takes longer is late"),
    _parameter("modes.hold_error", "rad", 1e-3, math.pi, "a hold that is off by more is impossible"),
    _parameter("modes.hold_patience", "s", 0.1, 3600.0, "once it was for this time"),
    _parameter("modes.tumble_rate", "rad/s", 1e-3, 10.0, "a faster body is braked"),
    _parameter("modes.blind_limit", "s", 1.0, 1e5, "without an estimate for longer the mode is safe"),
    _parameter("modes.known_for", "s", 0.1, 3600.0, "attitude known for this time ends the acquisition"),
    _parameter("modes.lost_for", "s", 0.1, 3600.0, "attitude lost for this time begins it again"),
    _parameter("health.cpu_share", "-", 0.01, 64.0, "of one core: the control process takes more"),
    _parameter("health.memory", "B", 1e6, 1e12, "the flight processes take more memory"),
    _parameter("health.memory_slope", "B/h", 1e3, 1e12, "it grows faster"),
    _parameter("health.disk_free", "B", 1.0, 1e13, "the disk has less left"),
    _parameter("health.temperature", "degree C", -40.0, 150.0, "the board is warm beyond it"),
    _parameter("health.hottest", "degree C", -40.0, 150.0, "and too hot beyond it"),
)
"""Fields of the parameters, in their order in the packets."""

PARAMETER_KEYS: tuple[str, ...] = tuple(parameter.name.replace("_", ".", 1) for parameter in PARAMETER_FIELDS)
"""Keys of the parameters in a configuration, in the same order."""


def crc_of(values: Sequence[float]) -> int:
    """Return the CRC-32 of a table's values, as big-endian doubles in the order of `KEYS`."""
    return zlib.crc32(struct.pack(f">{len(PARAMETER_FIELDS)}d", *values))


def problem_of(values: Mapping[str, float]) -> str:
    """Return the problem of a table (missing or unknown key, value out of range), else an empty text."""
    if lacking := [key for key in PARAMETER_KEYS if key not in values]:
        return f"{lacking[0]} is missing: a table is loaded as a whole"
    if unknown := sorted(set(values) - set(PARAMETER_KEYS)):
        return f"{unknown[0]} is no parameter: {', '.join(PARAMETER_KEYS)}"
    for key, parameter in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True):
        low, high = parameter.valid or (-math.inf, math.inf)
        if not low <= values[key] <= high:  # NaN compares false
            return f"{key} = {values[key]:g} must lie within {low:g} to {high:g} {parameter.unit}"
    return ""


TABLES: States = ((0, "configuration"), (1, "loaded"))
"""Where the table of parameters comes from that flies."""
NO_YES: States = ((0, "no"), (1, "yes"))
MODES: States = tuple((int(mode), mode.label) for mode in Mode)
SEVERITIES: States = tuple((int(severity), severity.name.lower()) for severity in Severity)
STEERING: States = ((0, "off"), (1, "following"), (2, "holding"), (3, "braking"))
"""The use of the coils (`flight.loop.body.SteeringState`)."""
STREAMS: States = ((0, "not-fitted"), (1, "never"), (2, "stale"), (3, "invalid"), (4, "slow"), (5, "good"))
"""The quality of a stream of readings (`flight.loop.facts.StreamState`)."""
KNOWLEDGE: States = ((0, "lost"), (1, "coarse"), (2, "fine"))
"""How well the attitude is known (`flight.bodies.orbit.body`)."""
COILS: States = ((0, "x"), (1, "y"), (2, "z"))
"""The coils, by body axis."""
STAGES: States = ((1, "accepted"), (2, "refused"), (3, "started"), (4, "completed"), (5, "failed"))
"""The stages of a command (`flight.link.process.commanding.Stage`)."""

SAFE_ALARM: Alarms = ((int(Mode.SAFE), "warning"),)
SEVERITY_ALARMS: Alarms = ((int(Severity.WARNING), "warning"), (int(Severity.FAULT), "fault"))
STREAM_ALARMS: Alarms = ((1, "fault"), (2, "fault"), (3, "fault"), (4, "warning"))
LOST_ALARM: Alarms = ((0, "warning"),)

_FACTS: tuple[tuple[str, Level], ...] = (
    ("boot-waits", "warning"),
    ("task-failing", "fault"),
    ("no-progress", "fault"),
    ("imu-silent", "fault"),
    ("imu-unusable", "fault"),
    ("imu-line-lost", "fault"),
    ("control-lost", "fault"),
    ("blind", "fault"),
    ("tumbling", "warning"),
    ("hold-impossible", "fault"),
    ("slew-late", "warning"),
    ("holding", "warning"),
    ("coil-fault", "fault"),
    ("coil-x-broken", "fault"),
    ("coil-y-broken", "fault"),
    ("coil-z-broken", "fault"),
    ("coil-suspect", "warning"),
    ("commands-doubted", "warning"),
    ("power-doubted", "warning"),
    ("power-fault", "warning"),
    ("camera-lost", "warning"),
    ("log-fault", "fault"),
    ("cpu-high", "warning"),
    ("memory-grows", "warning"),
    ("memory-high", "fault"),
    ("disk-low", "warning"),
    ("hot", "warning"),
    ("too-hot", "fault"),
    ("imu-poor", "warning"),
    ("field-poor", "warning"),
    ("coils-poor", "warning"),
    ("power-poor", "warning"),
    ("camera-poor", "warning"),
    ("service-failing", "fault"),
    ("camera-late", "warning"),
    ("vision-slow", "warning"),
    ("gps-lost", "warning"),
    ("gps-poor", "warning"),
    ("strings-lost", "warning"),
    ("sun-unclear", "warning"),
    ("clock-off", "warning"),
    ("field-refused", "warning"),
    ("wide-lost", "warning"),
    ("wide-false", "warning"),
)
"""The facts that monitors keep, in the order of `flight.loop.facts`, as grave as their events."""
FACTS: States = tuple((bit, name) for bit, (name, _) in enumerate(_FACTS))
FACT_ALARMS: Alarms = tuple((bit, level) for bit, (_, level) in enumerate(_FACTS))


RUN = Packet(
    "run",
    0x101,
    "once, at start",
    "What is being flown",
    (
        Field("config_name", "S64", "-", "name of the configuration"),
        Field("config_crc", "u4", "-", "CRC-32 of the configuration as it stands in the run's folder"),
        Field("software", "S32", "-", "version of the flight application"),
        Field("seed", "u8", "-", "seed of the simulation, 0 on hardware"),
        Field("utc_ns", "i8", "ns", "UTC at mission time zero, nanoseconds since 1970: a label only"),
        Field("simulated", "u1", "-", "the devices are emulated", states=NO_YES),
        Field("realtime", "u1", "-", "flown on the machine's clock; no: in lock-step", states=NO_YES),
        Field("control_period_ns", "u8", "ns", "period of the control rate group"),
        Field("duration", "f8", "s", "planned length of the run, NaN when open"),
        Field("coil_resistance", "f8", "ohm", "resistance of each coil, NaN where none is fitted", 3),
        Field("supply_voltage", "f8", "V", "coil supply after losses, as configured"),
        Field("current_limit", "f8", "A", "largest current that a coil may carry"),
    ),
)

EVENT = Packet(
    "event",
    0x130,
    "when it happens",
    "Something a reader of the log at night wants to know",
    (
        Field("code", "u2", "-", "number of the event (flight.link.events)"),
        Field("severity", "u1", "-", "how grave it is", states=SEVERITIES, alarms=SEVERITY_ALARMS),
        counter("suppressed", "how many of its kind the throttle held back since the last report"),
        Field("name", "S32", "-", "name of the event"),
        Field("text", "S160", "-", "what happened, with its values"),
    ),
)

HOUSEKEEPING = Packet(
    "housekeeping",
    0x131,
    "1 Hz",
    "Health of the devices and of the loop",
    (
        Field("state", "u1", "-", "use of the coils", states=STEERING),
        counter("imu_packets", "packets accepted since start"),
        counter("imu_bad_checksum", "packets with a wrong checksum"),
        counter("imu_discarded_bytes", "bytes that belonged to no packet"),
        counter("imu_out_of_range", "packets with implausible values"),
        counter("imu_not_finite", "packets with NaN or infinity"),
        counter("coil_faults", "failed transactions with the PWM chip"),
        Field("coil_voltage", "f8", "V", "voltage of the bus before the bridges, measured; NaN when unknown"),
        Field("coil_current", "f8", "A", "current from the bus to the coils, measured; NaN when unknown"),
        Field("coil_power", "f8", "W", "power from the bus to the coils, measured; NaN when unknown"),
        counter("plans_accepted", "plans flown since start"),
        counter("plans_refused", "plans refused since start"),
        counter("frames", "frames received since start"),
        counter("streak_rates", "rates from streaks that entered the estimate"),
        counter("events", "events since start, suppressed ones counted"),
        counter("records_lost", "records since start whose values did not fit their packet"),
    ),
    version=2,
)

HEALTH = Packet(
    "health",
    0x132,
    "1 Hz",
    "Mode, streams, facts and resources",
    (
        Field("mode", "u1", "-", "what the satellite does", states=MODES, alarms=SAFE_ALARM),
        Field("mode_age", "f8", "s", "time in this mode"),
        Field("imu", "u1", "-", "the inertial unit", states=STREAMS, alarms=STREAM_ALARMS),
        Field("field", "u1", "-", "the magnetometer", states=STREAMS, alarms=STREAM_ALARMS),
        Field("coils", "u1", "-", "acknowledged commands of the coils", states=STREAMS, alarms=STREAM_ALARMS),
        Field("power", "u1", "-", "the current monitor", states=STREAMS, alarms=STREAM_ALARMS),
        Field("camera", "u1", "-", "the camera's frames", states=STREAMS, alarms=STREAM_ALARMS),
        Field("facts", "u8", "-", "what the monitors find", bits=FACTS, alarms=FACT_ALARMS),
        Field("coils_in_use", "u1", "-", "the coils that control uses", bits=COILS),
        counter("fed", "how often the watchdog was fed"),
        counter("slips", "slots of the control group skipped since start"),
        counter("clock_steps", "how often the wall clock was set"),
        Field("cpu_share", "f8", "-", "processor time of the control process over time; NaN when unknown"),
        Field("resident", "f8", "B", "resident set of the control process; NaN when unknown"),
        Field("proportional", "f8", "B", "proportional set of all flight processes; NaN when unknown"),
        Field("memory_slope", "f8", "B/s", "of the proportional set, by least squares; NaN when unknown"),
        Field("disk_free", "f8", "B", "room for the flight log; NaN when unknown"),
        Field("temperature", "f8", "deg C", "of the warmest zone of the board; NaN when unknown"),
    ),
)

COMMAND = Packet(
    "command",
    0x133,
    "each command",
    "What became of a command; also the answer to whoever sent it",
    (
        Field("obeyed", "u1", "-", "no: refused", states=NO_YES),
        Field("name", "S16", "-", "name of the command; empty for bytes that are none"),
        Field("source", "S16", "-", "socket, udp or timeline"),
        counter("count", "commands since start"),
        Field("mode", "u1", "-", "mode after it", states=MODES),
        Field("text", "S128", "-", "its values, or why it was refused"),
    ),
)


MAX_NODES = 40
"""Room for the nodes of a path."""

_Q2 = Limits(fault=(-Q2_LIMIT, Q2_LIMIT))

IMU = Packet(
    "imu",
    0x110,
    "40 Hz",
    "One sample of the inertial unit as the driver gave it",
    (
        Field("sample_time_ns", "i8", "ns", "mission time of the sample"),
        Field("device_time_ns", "u8", "ns", "the unit's own clock"),
        Field("quaternion", "f8", "-", "reference frame into body, scalar last", 4),
        Field("rate", "f8", "rad/s", "body rate, body axes", 3),
        Field("field", "f8", "T", "magnetic field, body axes", 3),
        Field("acceleration", "f8", "m/s^2", "specific force, body axes", 3),
    ),
)

CONTROL = Packet(
    "control",
    0x111,
    "40 Hz",
    "One control cycle: estimate, path, command",
    (
        Field("cycle", "u8", "-", "slot of the control grid since start, skipped ones counted"),
        Field("state", "u1", "-", "use of the coils", states=STEERING),
        Field("estimate_age", "f8", "s", "age of the newest measurement in the estimate"),
        Field("angle", "f8", "rad", "estimated turn about the thread"),
        Field("q2", "f8", "-", "estimated second quaternion component"),
        Field("rate", "f8", "rad/s", "estimated rate about the thread"),
        Field("angle_sigma", "f8", "rad", "standard deviation of the angle"),
        Field("rate_sigma", "f8", "rad/s", "standard deviation of the rate"),
        Field("target_q2", "f8", "-", "commanded final q2", limits=_Q2),
        Field("path_q2", "f8", "-", "planned q2 now", limits=_Q2),
        Field("path_rate", "f8", "rad/s", "planned rate now"),
        Field("path_acceleration", "f8", "rad/s^2", "planned angular acceleration now"),
        counter("plan", "number of the plan being flown, 0 when none"),
        Field("current_command", "f8", "A", "currents asked of the coils", 3),
        Field("current_written", "f8", "A", "currents on the wire, limited and quantised", 3),
        Field("saturated", "u1", "-", "a coil was limited", states=NO_YES),
    ),
    version=2,
)

ATTITUDE = Packet(
    "attitude",
    0x114,
    "10 Hz",
    "The attitude of any body: estimate, path, target, dipole",
    (
        Field("mode", "u1", "-", "what the satellite does", states=MODES),
        Field("quaternion", "f8", "-", "estimated, reference frame into body, scalar last", 4),
        Field("rate", "f8", "rad/s", "estimated body rate, body axes", 3),
        Field("angle_sigma", "f4", "rad", "standard deviation of small turns about the body's axes", 3),
        Field("rate_sigma", "f4", "rad/s", "standard deviation of the rate", 3),
        Field("wanted", "f8", "-", "attitude of the path now, NaN without a path", 4),
        Field("wanted_rate", "f8", "rad/s", "rate of the path now, body axes", 3),
        Field("target", "f8", "-", "attitude to be reached, NaN without a target", 4),
        Field("dipole", "f4", "A m^2", "dipole wanted of the coils, body axes", 3),
    ),
)

TARGET = Packet(
    "target",
    0x112,
    "at each command",
    "A new commanded attitude",
    (
        counter("index", "number of the step, from 0; of a commanded slew from 1001"),
        Field("q2", "f8", "-", "commanded final q2", limits=_Q2),
        Field("rate", "f8", "rad/s", "commanded final rate"),
    ),
    version=2,
)

MODE = Packet(
    "mode",
    0x113,
    "at each change",
    "A new mode, and what led to it",
    (
        Field("before", "u1", "-", "mode until now", states=MODES),
        Field("mode", "u1", "-", "mode from now on", states=MODES),
        Field("trigger", "S32", "-", "what led to it (flight.loop.modes)"),
        Field("reason", "S96", "-", "of the trigger: the event, the values"),
        Field("target_q2", "f8", "-", "q2 wanted by a hold or a slew, NaN when not yet known"),
    ),
)

PLAN = Packet(
    "plan",
    0x120,
    "every 5 s",
    "One result of the path planner, flown or not",
    (
        counter("number", "number of the plan, from 1"),
        Field("accepted", "u1", "-", "flown", states=NO_YES),
        Field("status", "S32", "-", "optimal, stretched, or the reason of refusal"),
        Field("origin_ns", "i8", "ns", "mission time of the path's start"),
        Field("horizon_asked", "f8", "s", "horizon asked for"),
        Field("horizon", "f8", "s", "horizon planned"),
        Field("start_q2", "f8", "-", "q2 at the start"),
        Field("start_rate", "f8", "rad/s", "rate at the start"),
        Field("target_q2", "f8", "-", "q2 at the end"),
        Field("cost", "f8", "J", "planned integral of R I^2"),
        Field("peak_current", "f8", "A", "largest current between and on the nodes"),
        Field("evaluations", "u4", "-", "evaluations of the cost"),
        Field("nodes", "u1", "-", "number of nodes in use"),
        Field("node_q2", "f8", "-", "q2 on the Legendre-Gauss-Lobatto nodes, NaN past the last", MAX_NODES),
    ),
)

TRUTH = Packet(
    "truth",
    0x140,
    "40 Hz, simulation only",
    "What the simulated world really did; written by sim_hal into a log of its own",
    (
        Field("quaternion", "f8", "-", "reference frame into body, scalar last", 4),
        Field("rate", "f8", "rad/s", "body rate, body axes", 3),
        Field("current", "f8", "A", "mean coil currents as the world felt them", 3),
        Field("energy", "f8", "J", "integral of R I^2 over all coils since mission time zero"),
        Field("supply_energy", "f8", "J", "integral of V |I| over all coils since mission time zero"),
    ),
)


SPIN = Packet(
    "spin",
    0x115,
    "4 Hz",
    "The rate by the magnetometer alone, of a satellite in orbit",
    (
        Field("known", "u1", "-", "enough samples of the field agree", states=NO_YES),
        Field("rate", "f8", "rad/s", "body rate, body axes", 3),
        Field("rate_sigma", "f4", "rad/s", "standard deviation of the rate's worst axis"),
        Field("field", "f8", "T", "magnetic field, body axes", 3),
        counter("restarts", "how often the samples contradicted the rate until it was found again"),
        Field("dipole", "f4", "A m^2", "dipole wanted of the coils, body axes", 3),
    ),
)

NAVIGATION = Packet(
    "navigation",
    0x116,
    "1 Hz",
    "How well a satellite in orbit knows its attitude, and what its filter has learned",
    (
        Field("knowledge", "u1", "-", "of the attitude", states=KNOWLEDGE, alarms=LOST_ALARM),
        Field("placed", "u1", "-", "the orbit is known", states=NO_YES),
        counter("refused", "measurements that did not pass their gate, replays included"),
        counter("fixes_refused", "GPS fixes that contradict what is known of the orbit"),
        counter("restarts", "how often the estimate was discarded for a new one"),
        Field("gyro_bias", "f8", "rad/s", "body axes, NaN before an estimate", 3),
        Field("field_bias", "f8", "T", "of the magnetometer, body axes", 3),
        Field("residual_dipole", "f8", "A m^2", "in the present light, body axes", 3),
    ),
)

DIRECTIONS = Packet(
    "directions",
    0x117,
    "each round of the wide cameras",
    "The Sun and nadir that the wide cameras show, of a satellite in orbit",
    (
        Field("middle_ns", "i8", "ns", "mission time of the exposures' middle"),
        Field("frames", "u1", "-", "cameras whose frames were read, by bits"),
        Field("sun", "f8", "-", "direction of the Sun, body axes; NaN when none", 3),
        Field("sun_sigma", "f4", "rad", "standard deviation of an axis; NaN when none"),
        Field(
            "sun_cameras", "u1", "-", "the camera that shows it, by bits; none: the solar strings stand in"
        ),
        Field("sun_used", "u1", "-", "entered the estimate", states=NO_YES),
        Field("nadir", "f8", "-", "direction of nadir, body axes; NaN when none", 3),
        Field("nadir_sigma", "f4", "rad", "standard deviation of an axis; NaN when none"),
        Field("nadir_cameras", "u1", "-", "those whose limb gave it, by bits; none: the light in all frames"),
        Field("nadir_used", "u1", "-", "entered the estimate", states=NO_YES),
    ),
)

ORBIT_TRUTH = Packet(
    "orbit_truth",
    0x141,
    "1 Hz, simulation of an orbit only",
    "What surrounded the satellite and turned it; written by sim_hal beside truth; NaN is not known",
    (
        Field("utc", "f8", "day", "Julian date UTC of the simulated world"),
        Field("position", "f8", "m", "geocentric, ICRS", 3),
        Field("velocity", "f8", "m/s", "ICRS", 3),
        Field("field", "f8", "T", "of the Earth, ICRS", 3),
        Field("sun", "f8", "-", "direction of the Sun, ICRS", 3),
        Field("sunlit", "f8", "-", "share of the Sun's disc that is seen"),
        Field("residual_dipole", "f8", "A m^2", "body axes", 3),
        Field("coil_torque", "f8", "N m", "body axes", 3),
        Field("dipole_torque", "f8", "N m", "of the residual dipole, body axes", 3),
        Field("gravity_torque", "f8", "N m", "of the gravity gradient, body axes", 3),
        Field("drag_torque", "f8", "N m", "body axes", 3),
        Field("sunlight_torque", "f8", "N m", "body axes", 3),
    ),
)


STREAK = Packet(
    "streak",
    0x121,
    "each frame",
    "What vision found in one frame",
    (
        counter("sequence", "the camera's count"),
        Field("exposure_start_ns", "i8", "ns", "mission time of the exposure's start"),
        Field("exposure", "f8", "s", "exposure time"),
        Field("status", "S32", "-", "rate, ambiguous, too-short, too-few, failed, black, saturated, frozen"),
        Field("streaks", "u2", "-", "streaks found"),
        Field("used", "u2", "-", "streaks used in the rate"),
        Field("length", "f8", "px", "median length of the streaks"),
        Field("rate", "f8", "rad/s", "mean body rate over the exposure, body axes; NaN when none", 3),
        Field("covariance", "f8", "rad^2/s^2", "xx yy zz xy xz yz of the rate, body axes; NaN when none", 6),
        Field("residual", "f8", "rad", "rms residual of the endpoints; NaN when none"),
        Field("accepted", "u1", "-", "entered the estimate", states=NO_YES),
    ),
)

STARS = Packet(
    "stars",
    0x122,
    "each frame",
    "Which stars one frame shows, and the attitude that they give",
    (
        counter("sequence", "the camera's count"),
        Field("middle_ns", "i8", "ns", "mission time of the exposure's middle"),
        Field("status", "S32", "-", "solved, no-stars, too-few-stars, no-match, ambiguous"),
        Field(
            "tracked",
            "u1",
            "-",
            "searched at the estimate's attitude; no: lost in space",
            states=NO_YES,
        ),
        Field("found", "u2", "-", "what was taken for a star"),
        Field("matched", "u2", "-", "of them guide stars"),
        Field("quaternion", "f8", "-", "reference into body, scalar last; NaN when none", 4),
        Field("covariance", "f8", "rad^2", "xx yy zz xy xz yz of small turns, body axes; NaN when none", 6),
        Field("log10_false_alarm", "f8", "-", "log10 of the chance matches expected in the whole sky"),
        Field("accepted", "u1", "-", "entered the estimate", states=NO_YES),
    ),
)

MOST_SIGHTINGS = 8
"""Of a frame that its packet holds."""

SIGHTINGS = Packet(
    "sightings",
    0x123,
    "each frame searched for objects",
    "What in one frame is no star: objects, and what only tracks over frames distinguish from them",
    (
        counter("sequence", "the camera's count"),
        Field("middle_ns", "i8", "ns", "mission time of the exposure's middle"),
        Field("found", "u2", "-", "sightings, of which the packet holds the brightest"),
        Field("x", "f4", "px", "column of each, brightest first; NaN for none", MOST_SIGHTINGS),
        Field("y", "f4", "px", "row of each; NaN for none", MOST_SIGHTINGS),
        Field("magnitude", "f4", "mag", "V by the frame's stars; NaN when unknown", MOST_SIGHTINGS),
    ),
)

TRACK = Packet(
    "track",
    0x124,
    "each object in each frame searched",
    "The line of sight to an object, tracked over frames; directions in the axes of the attitude's reference",
    (
        Field("number", "u4", "-", "of the object in this flight, from 1"),
        Field("middle_ns", "i8", "ns", "mission time of the exposure's middle"),
        Field("seen", "u1", "-", "the frame shows it; no: predicted", states=NO_YES),
        Field("sightings", "u4", "-", "since the start of the track"),
        Field("measured", "f8", "-", "direction in this frame; NaN when not seen", 3),
        Field(
            "measured_sigma", "f8", "rad", "along an axis, the attitude's share included; NaN when not seen"
        ),
        Field("direction", "f8", "-", "of the track", 3),
        Field("rate", "f8", "rad/s", "change of the direction", 3),
        Field("acceleration", "f8", "rad/s^2", "change of the rate, at right angles to the direction", 3),
        Field("covariance", "f8", "rad^2", "xx yy zz xy xz yz of the direction", 6),
        Field("rate_covariance", "f8", "rad^2/s^2", "xx yy zz xy xz yz of the rate", 6),
        Field("magnitude", "f8", "mag", "V, mean over the last sightings; NaN when unknown"),
        Field("magnitude_sigma", "f8", "mag", "of that, by their scatter; NaN when unknown"),
        Field("place", "f8", "m", "of the camera, about the Earth's centre; NaN when unknown", 3),
        Field("velocity", "f8", "m/s", "likewise", 3),
        Field("place_sigma", "f8", "m", "of an axis of the place"),
    ),
    version=2,
)


PARAMETERS = Packet(
    "parameters",
    0x184,
    "at the start of a flight that takes commands, at each load, at will",
    "The table of parameters that flies",
    (
        counter("loads", "tables loaded, earlier boots included"),
        Field("crc", "u4", "-", "CRC-32 of the values, as big-endian doubles in this order"),
        Field("table", "u1", "-", "where it comes from", states=TABLES),
        Field("kept", "u1", "-", "it outlives the process", states=NO_YES),
        *(replace(field, valid=None) for field in PARAMETER_FIELDS),
    ),
)


LINK = Packet(
    "link",
    0x170,
    "1 Hz, of the link process; not in the flight log",
    "Frames that came, by their fate, and the counters of the security associations",
    (
        counter("received", "frames that came since the link's start"),
        counter("admitted", "of them let in"),
        counter("refused_crc", "refused: the CRC is wrong"),
        counter("refused_header", "refused: no frame of this spacecraft"),
        counter("refused_spi", "refused: no association of that SPI"),
        counter("refused_lost", "refused: both copies of the counter of that SPI are lost"),
        counter("refused_mac", "refused: the MAC is wrong, as of a forgery or of an old key"),
        counter("refused_repeated", "refused: the counter was used"),
        counter("refused_beyond", "refused: the counter is 65,536 or more ahead"),
        counter("refused_unstored", "refused: the counter could not be stored"),
        counter("refused_command", "let in, but no command; no answer; or refused by the flight"),
        Field("highest", "i8", "-", "highest accepted counter of SPI 1 and 2; -1 none yet, -2 lost", 2),
        Field("generation", "u4", "-", "of the keys of SPI 1 to 4; 0 lost", 4),
        Field("copies", "u1", "-", "good copies of the counters of SPI 1 to 4", 4),
        counter("sent", "telemetry frames sent since the link's start"),
        counter("thinned", "live packets left out for want of rate; the archive has them"),
        Field("playing", "u1", "-", "the archive is played back", states=NO_YES),
        Field("played_ns", "i8", "ns", "mission time that the playback has reached"),
        counter("unreported", "reports of the link whose values did not fit, or that newer ones displaced"),
    ),
    version=2,
)

VERIFICATION = Packet(
    "verification",
    0x171,
    "at each step of a command, of the link process; not in the flight log",
    "What became of a command that came by the link",
    (
        Field("spi", "u2", "-", "of its frame"),
        Field("counter", "i8", "-", "of its frame: with the SPI its identifier; 2^63 - 1 for all beyond"),
        Field("stage", "u1", "-", "how far the command is", states=STAGES),
        Field("name", "S16", "-", "name of the command, empty for none"),
        Field("text", "S128", "-", "its values, or the reason"),
        Field("packet", "u2", "-", "first 16 bits of the command's packet, 0 where it was not read"),
        Field("sequence", "u2", "-", "sequence count of the command's packet"),
    ),
    version=2,
)

TRANSFER = Packet(
    "transfer",
    0x172,
    "1 Hz of each open transfer and at its end, of the link process; not in the flight log",
    "How a file's transfer stands",
    (
        Field("down", "u1", "-", "the satellite sends the file", states=NO_YES),
        Field("source", "u2", "-", "entity that sends: 1 the satellite, 2 the ground, 3 another's ground"),
        Field("number", "u4", "-", "of the transfer there"),
        Field("name", "S96", "-", "of the file, empty while it is not known"),
        Field("size", "u4", "bytes", "of the file"),
        Field("done", "u4", "bytes", "sent and not asked for again; or received"),
        Field("open", "u1", "-", "the transfer goes on", states=NO_YES),
        Field("condition", "u1", "-", "why it ended, CCSDS 727.0-B condition code; 0 whole, or open"),
        Field("text", "S64", "-", "how it ended"),
    ),
)


_LATENESS = Limits(fault=(0.0, 0.0125))
"""s, half a period of the demonstration's 40 Hz: a slot later than that is skipped."""
_EXECUTION = Limits(warning=(0.0, 0.0125), fault=(0.0, 0.025))

CYCLE_TIMING = Packet(
    "cycle_timing",
    0x150,
    "40 Hz, performance record",
    "When a control cycle ran and how long it took, on the machine's clock",
    (
        Field("cycle", "u8", "-", "slot of the control grid"),
        Field("lateness", "f8", "s", "start of the cycle after its slot", limits=_LATENESS),
        Field("execution", "f8", "s", "time spent in the cycle", limits=_EXECUTION),
    ),
    version=2,
)

RATE_GROUP = Packet(
    "rate_group",
    0x151,
    "1 Hz each, performance record",
    "One rate group of the executive since start",
    (
        Field("name", "S16", "-", "name of the group"),
        Field("period", "f8", "s", "its period"),
        counter("cycles", "slots that ran"),
        counter("slips", "slots that were skipped"),
        counter("overruns", "cycles longer than the period"),
        Field("mean", "f8", "s", "mean execution time"),
        Field("max", "f8", "s", "longest execution time"),
    ),
)

JOB_TIMING = Packet(
    "job_timing",
    0x152,
    "each job, performance record",
    "One job of a worker",
    (
        Field("name", "S16", "-", "name of the worker"),
        Field("execution", "f8", "s", "time spent in the job"),
        Field("outcome", "S16", "-", "done, failed, timed-out, died"),
    ),
)


PACKETS: tuple[Packet, ...] = (
    RUN,
    IMU,
    CONTROL,
    ATTITUDE,
    SPIN,
    NAVIGATION,
    DIRECTIONS,
    TARGET,
    MODE,
    PLAN,
    STREAK,
    STARS,
    SIGHTINGS,
    TRACK,
    EVENT,
    HOUSEKEEPING,
    HEALTH,
    COMMAND,
    PARAMETERS,
    LINK,
    VERIFICATION,
    TRANSFER,
    TRUTH,
    ORBIT_TRUTH,
    CYCLE_TIMING,
    RATE_GROUP,
    JOB_TIMING,
)
