"""Definitions of all telemetry packets, and of the parameters that an operator can change in flight.

The encoder, the decoder, the ground database, the CSV export and the documentation are generated from these
definitions. The existing fields of a packet that was used in a flight are never changed. New fields are
appended, and the version of the packet is increased. All parameters are loaded at once, as one table. Until a
table is loaded, the parameters have the values of the configuration. Loaded values must also satisfy the
bounds of the configuration schema.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from flight.link.events import Mode, Severity
from hal.interfaces.devices import COIL_NAMES, MOST_COILS
from knightcube.gnc.guidance.plant import Q2_LIMIT

Range = tuple[float, float]
States = tuple[tuple[int, str], ...]
NO_YES: States = ((0, "no"), (1, "yes"))
Level = Literal["warning", "fault"]
Alarms = tuple[tuple[int, Level], ...]


@dataclass(frozen=True, slots=True)
class Limits:
    """Nominal ranges (low, high) of a value. A value outside its range causes a warning or a fault."""

    warning: Range | None = None
    fault: Range | None = None


@dataclass(frozen=True, slots=True)
class Field:
    """Definition of one field of a packet. Numbers are big-endian in the packet.

    Attributes:
        kind: numpy type code (f8, f4, u1, u2, u4, u8, i8), or S<n> for n bytes of UTF-8 text.
        count: number of values; a field with more than one value is an array.
        states: numbers and names of the states of an enumerated field.
        bits: numbers and names of the bits of a bit field, of which several can be set.
        alarms: states or set bits that are reported as a warning or a fault.
        limits: nominal ranges of a numeric field without states.
        valid: allowed range (low, high) of a command argument.
        wraps: whether the field is a counter that continues at 0 after its largest number.
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


def counter(name: str, meaning: str) -> Field:
    """Return the definition of a counter field, which wraps at the end of its range."""
    return Field(name, "u4", "-", meaning, wraps=True)


def flag(name: str, meaning: str) -> Field:
    """Return the definition of a Boolean field with the states no and yes."""
    return Field(name, "u1", "-", meaning, states=NO_YES)


@dataclass(frozen=True, slots=True)
class Packet:
    """Definition of a packet: name, application process identifier (APID), rate and fields.

    The text `hazard` states the harm that a telecommand can cause. The text is empty for a harmless packet.
    """

    name: str
    apid: int
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    version: int = 1
    telecommand: bool = False
    hazard: str = ""


def _packet(name: str, apid: int, rate: str, meaning: str, version: int = 1) -> Callable[..., Packet]:
    """Return a function that takes fields and returns the packet with these fields."""
    return lambda *fields: Packet(name, apid, rate, meaning, fields, version)


def _real(name: str, unit: str, meaning: str, count: int = 1, limits: Limits | None = None) -> Field:
    return Field(name, "f8", unit, meaning, count, limits=limits)


def _sigma(name: str, unit: str, meaning: str, count: int = 1) -> Field:
    return Field(name, "f4", unit, meaning, count)


def _estimated(name: str, unit: str, meaning: str, count: int) -> tuple[Field, Field]:
    return _real(name, unit, meaning, count), _sigma(f"{name}_sigma", unit, _ONE_SIGMA + name, count)


def _limit(key: str, unit: str, low: float, high: float, meaning: str) -> Field:
    return Field(key.replace(".", "_", 1), "f8", unit, f"{key}: {meaning}", valid=(low, high))


PARAMETER_FIELDS: tuple[Field, ...] = (
    _limit("modes.arrived_angle", "rad", 1e-4, 0.5, "largest angle error of a completed slew"),
    _limit("modes.arrived_rate", "rad/s", 1e-5, 0.5, "largest rate error of a completed slew"),
    _limit(
        "modes.arrived_for", "s", 0.1, 600.0, "time within the limits of angle and rate that completes a slew"
    ),
    _limit("modes.slew_limit", "s", 1.0, 1e5, "time after which a slew is late"),
    _limit("modes.hold_error", "rad", 1e-3, math.pi, "angle error above which an attitude cannot be held"),
    _limit("modes.hold_patience", "s", 0.1, 3600.0, "time above `hold_error` after which a hold fails"),
    _limit("modes.tumble_rate", "rad/s", 1e-3, 10.0, "rate above which the body is detumbled"),
    _limit("modes.blind_limit", "s", 1.0, 1e5, "time without an estimate after which the mode is safe"),
    _limit("modes.known_for", "s", 0.1, 3600.0, "duration of a known attitude that ends acquisition"),
    _limit("modes.lost_for", "s", 0.1, 3600.0, "time without an attitude after which acquisition starts"),
    _limit("health.cpu_share", "-", 0.01, 64.0, "largest processor load of the control process"),
    _limit("health.memory", "B", 1e6, 1e12, "largest memory of all flight processes"),
    _limit("health.memory_slope", "B/h", 1e3, 1e12, "largest growth of the memory of all processes"),
    _limit("health.disk_free", "B", 1.0, 1e13, "smallest free disk space"),
    _limit("health.temperature", "degree C", -40.0, 150.0, "board temperature that causes a warning"),
    _limit("health.hottest", "degree C", -40.0, 150.0, "board temperature at which the mode changes to safe"),
)
"""Definitions of the parameter fields, in the order of the parameter packets."""

PARAMETER_KEYS: tuple[str, ...] = tuple(parameter.name.replace("_", ".", 1) for parameter in PARAMETER_FIELDS)
"""Configuration keys of the parameters, in the order of `PARAMETER_FIELDS`."""


TABLES: States = ((0, "configuration"), (1, "loaded"))
"""Sources of the parameter table in use."""
MODES: States = tuple((int(mode), mode.label) for mode in Mode)
SEVERITIES: States = tuple((int(severity), severity.name.lower()) for severity in Severity)
STEERING: States = ((0, "off"), (1, "following"), (2, "holding"), (3, "braking"))
"""How the control loop uses the coils (`flight.loop.body.SteeringState`)."""
_QUALITIES = "not-fitted never stale invalid slow good no-reading-yet"
STREAMS: States = tuple(enumerate(_QUALITIES.split()))
"""Quality levels of a stream of readings (`flight.loop.facts.StreamState`)."""
KNOWLEDGE: States = ((0, "lost"), (1, "coarse"), (2, "fine"))
"""Accuracy levels of the attitude estimate (`flight.bodies.orbit.body`)."""
COILS: States = tuple(enumerate(COIL_NAMES))
"""Torque coils in the order of the configuration."""
STAGES: States = tuple(enumerate(("accepted", "refused", "started", "completed", "failed", "repeated"), 1))
"""Stages of a command (`flight.link.process.commanding.Stage`)."""

SHED: States = tuple(enumerate(("nothing", "coils-limited", "camera-slower", "safe")))
"""Load shedding at a low battery; each state includes the preceding states (`flight.loop.power`)."""

SAFE_ALARM: Alarms = ((int(Mode.SAFE), "warning"),)
SEVERITY_ALARMS: Alarms = ((int(Severity.WARNING), "warning"), (int(Severity.FAULT), "fault"))
STREAM_ALARMS: Alarms = ((1, "fault"), (2, "fault"), (3, "fault"), (4, "warning"))
LOST_ALARM: Alarms = ((0, "warning"),)
SHED_ALARMS: Alarms = ((1, "warning"), (2, "warning"), (3, "fault"))

_NAMES = """
    boot-waits task-failing! no-progress! imu-silent! imu-unusable! imu-line-lost! control-lost! blind!
    tumbling hold-impossible! slew-late holding coil-fault! coil-x-broken! coil-y-broken! coil-z-broken!
    coil-suspect commands-doubted power-doubted power-fault camera-lost log-fault! cpu-high memory-grows
    memory-high! disk-low hot too-hot! imu-poor field-poor coils-poor power-poor camera-poor
    service-failing! camera-late vision-slow gps-lost gps-poor strings-lost sun-unclear clock-off
    field-refused wide-lost wide-false coil-4-broken! coil-5-broken! coil-6-broken!
    field-extrapolated gyro-lost! battery-low battery-very-low battery-critical! battery-monitor-lost
    bus-monitor-lost
"""
"""Detected conditions, in the order of `flight.loop.facts`; an exclamation mark marks a fault."""
FACTS: States = tuple((bit, name.rstrip("!")) for bit, name in enumerate(_NAMES.split()))
FACT_ALARMS: Alarms = tuple(
    (bit, "fault" if name.endswith("!") else "warning") for bit, name in enumerate(_NAMES.split())
)
RUN = _packet(
    "run",
    0x101,
    "at start, and after a change of the best known UTC",
    "Configuration, software and devices of the run",
)(
    Field("config_name", "S64", "-", "name of the configuration"),
    Field("config_crc", "u4", "-", "CRC-32 of the configuration in the folder of the run"),
    Field("software", "S32", "-", "version of the flight application"),
    Field("seed", "u8", "-", "seed of the simulation, 0 on hardware"),
    Field("utc_ns", "i8", "ns", "best known UTC, since 1970, at mission time zero; not used for control"),
    flag("simulated", "whether the devices are emulated"),
    flag("realtime", "whether the run uses the machine's clock; no means lock-step simulation"),
    Field("control_period_ns", "u8", "ns", "period of the control rate group"),
    _real("duration", "s", "planned duration of the run; NaN for an unlimited run"),
    _real("coil_resistance", "ohm", "resistance of the first three coils; NaN if not fitted", 3),
    _real("supply_voltage", "V", "configured coil supply voltage, after the losses of the bridges"),
    _real("current_limit", "A", "largest permitted current of a coil"),
)

EVENT = _packet("event", 0x130, "when it happens", "An event of the flight")(
    Field("code", "u2", "-", "number of the event (flight.link.events)"),
    Field("severity", "u1", "-", "severity of the event", states=SEVERITIES, alarms=SEVERITY_ALARMS),
    counter("suppressed", "events of this kind that the rate limit suppressed since the last report"),
    Field("name", "S32", "-", "name of the event"),
    Field("text", "S160", "-", "description of the event with values"),
)

HOUSEKEEPING = _packet(
    "housekeeping", 0x131, "1 Hz", "Counters and measurements of the devices and the loop", version=2
)(
    Field("state", "u1", "-", "use of the coils", states=STEERING),
    counter("imu_packets", "accepted packets of the inertial unit since start"),
    counter("imu_bad_checksum", "packets of the inertial unit with a wrong checksum"),
    counter("imu_discarded_bytes", "bytes from the inertial unit that belonged to no packet"),
    counter("imu_out_of_range", "packets of the inertial unit with values out of range"),
    counter("imu_not_finite", "packets of the inertial unit with NaN or infinity"),
    counter("coil_faults", "failed transactions with the PWM chip"),
    _real("coil_voltage", "V", "measured supply voltage of the bridges; NaN if unknown"),
    _real("coil_current", "A", "measured supply current of the coils; NaN if unknown"),
    _real("coil_power", "W", "measured supply power of the coils; NaN if unknown"),
    counter("plans_accepted", "plans flown since start"),
    counter("plans_refused", "plans rejected since start"),
    counter("frames", "frames received since start"),
    counter("streak_rates", "rates from star streaks that the estimate used"),
    counter("events", "events since start, including suppressed events"),
    counter("records_lost", "records lost since start because values were out of the packet's range"),
)

HEALTH = _packet(
    "health", 0x132, "1 Hz", "Mode, streams of readings, monitored conditions and resources of the board"
)(
    Field("mode", "u1", "-", "current mode", states=MODES, alarms=SAFE_ALARM),
    _real("mode_age", "s", "time in this mode"),
    Field("imu", "u1", "-", "readings of the inertial unit", states=STREAMS, alarms=STREAM_ALARMS),
    Field("field", "u1", "-", "readings of the magnetometer", states=STREAMS, alarms=STREAM_ALARMS),
    Field("coils", "u1", "-", "acknowledgements of the coils", states=STREAMS, alarms=STREAM_ALARMS),
    Field("power", "u1", "-", "readings of the current monitor", states=STREAMS, alarms=STREAM_ALARMS),
    Field("camera", "u1", "-", "frames of the camera", states=STREAMS, alarms=STREAM_ALARMS),
    Field("facts", "u8", "-", "conditions that the monitors found", bits=FACTS, alarms=FACT_ALARMS),
    Field("coils_in_use", "u1", "-", "coils in use by control", bits=COILS),
    counter("fed", "number of times the watchdog was reset"),
    counter("slips", "control cycles skipped since start"),
    counter("clock_steps", "number of changes of the wall clock"),
    _real("cpu_share", "-", "processor load of the control process; NaN if unknown"),
    _real("resident", "B", "resident memory of the control process; NaN if unknown"),
    _real("proportional", "B", "memory (proportional set size) of all flight processes; NaN if unknown"),
    _real("memory_slope", "B/s", "growth of the memory (proportional set size); NaN if unknown"),
    _real("disk_free", "B", "free disk space for the flight log; NaN if unknown"),
    _real("temperature", "deg C", "highest temperature of the board; NaN if unknown"),
)

_LEVEL = Limits((0.0, 0.0), (0.0, 5.0))

WORKLOAD = _packet(
    "workload",
    0x136,
    "after each change, 1 Hz at most",
    "Work that is reduced because the processor is overloaded",
)(
    Field("level", "u1", "-", "level of the reduction; 0 if all work is done", limits=_LEVEL),
    counter("frames_shed", "frames of the star camera skipped since start"),
    counter("plans_shed", "periodic planning jobs skipped since start"),
    counter("frames_late", "frames since start whose processing took too long or whose worker was busy"),
    counter("plans_late", "plans since start that took too long"),
    counter("cycles_lost", "control cycles skipped since start"),
)

COMMAND = _packet(
    "command", 0x133, "each command", "Outcome of a command, also sent as the answer to its sender"
)(
    flag("obeyed", "whether the command was executed; no means refused"),
    Field("name", "S16", "-", "name of the command; empty if the bytes are not a command"),
    Field("source", "S16", "-", "source of the command: socket, udp or timeline"),
    counter("count", "commands received since start"),
    Field("mode", "u1", "-", "mode after the command", states=MODES),
    Field("text", "S128", "-", "values of the command, or the reason of its refusal"),
)

_DRAWN = "%s; positive while the battery discharges"
POWER = _packet(
    "power",
    0x134,
    "1 Hz, only with the section `power`",
    "Battery and bus: measurements, state of charge and shed loads; NaN if unknown",
)(
    Field("shed", "u1", "-", "loads that are shed", states=SHED, alarms=SHED_ALARMS),
    Field("charge", "f4", "-", "state of charge", limits=Limits((0.4, 1.0), (0.2, 1.0))),
    Field("battery_voltage", "f4", "V", "voltage of the battery"),
    Field("battery_current", "f4", "A", _DRAWN % "current out of the battery"),
    Field("bus_voltage", "f4", "V", "voltage of the bus"),
    Field("bus_current", "f4", "A", "current of all loads"),
    _real("energy_in", "J", "energy into the battery since start"),
    _real("energy_out", "J", "energy out of the battery since start"),
)
MAX_NODES = 40
"""Maximum number of path nodes in a plan packet."""

_WANTED = "currents for the dipole with the configured coils, before the correction of sign and gain"
_WRITTEN = "currents written to the PWM chip, after the correction of sign and gain, limited and quantised"
_Q2 = Limits(fault=(-Q2_LIMIT, Q2_LIMIT))

IMU = _packet("imu", 0x110, "40 Hz", "One sample of the inertial unit")(
    Field("sample_time_ns", "i8", "ns", "mission time of the sample"),
    Field("device_time_ns", "u8", "ns", "time of the unit's own clock"),
    _real("quaternion", "-", "rotation of reference frame into body, scalar last", 4),
    _real("rate", "rad/s", "body rate, body axes", 3),
    _real("field", "T", "magnetic field, body axes", 3),
    _real("acceleration", "m/s^2", "specific force, body axes", 3),
)

CONTROL = _packet("control", 0x111, "40 Hz", "One control cycle: estimate, path, command", version=2)(
    Field("cycle", "u8", "-", "number of the control cycle since start, including skipped cycles"),
    Field("state", "u1", "-", "use of the coils", states=STEERING),
    _real("estimate_age", "s", "age of the newest measurement in the estimate"),
    _real("angle", "rad", "estimated rotation angle about the thread"),
    _real("q2", "-", "estimated second quaternion component"),
    _real("rate", "rad/s", "estimated rate about the thread"),
    _real("angle_sigma", "rad", "standard deviation of the angle"),
    _real("rate_sigma", "rad/s", "standard deviation of the rate"),
    _real("target_q2", "-", "commanded final q2", limits=_Q2),
    _real("path_q2", "-", "current q2 of the path", limits=_Q2),
    _real("path_rate", "rad/s", "current rate of the path"),
    _real("path_acceleration", "rad/s^2", "current angular acceleration of the path"),
    counter("plan", "number of the plan in use, 0 for none"),
    _real("current_command", "A", _WANTED, 3),
    _real("current_written", "A", _WRITTEN, 3),
    flag("saturated", "whether the current of a coil was limited"),
)

ATTITUDE = _packet("attitude", 0x114, "10 Hz", "Attitude estimate, path, target and dipole of any body")(
    Field("mode", "u1", "-", "current mode", states=MODES),
    _real("quaternion", "-", "estimated rotation of reference frame into body, scalar last", 4),
    _real("rate", "rad/s", "estimated body rate, body axes", 3),
    _sigma("angle_sigma", "rad", "standard deviation of the attitude about the body axes", 3),
    _sigma("rate_sigma", "rad/s", "standard deviation of the rate", 3),
    _real("wanted", "-", "current attitude of the path; NaN without a path", 4),
    _real("wanted_rate", "rad/s", "current rate of the path, body axes", 3),
    _real("target", "-", "target attitude; NaN without a target", 4),
    Field("dipole", "f4", "A m^2", "commanded dipole of the coils, body axes", 3),
)

_ABSENT = ", in the order of the configuration; NaN for coils that are not fitted"

COIL_CURRENTS = _packet(
    "coil_currents", 0x11B, "10 Hz, only with more than three coils", "Currents of up to six coils"
)(
    Field("command", "f4", "A", _WANTED + _ABSENT, MOST_COILS),
    Field("written", "f4", "A", _WRITTEN + _ABSENT, MOST_COILS),
)

TARGET = _packet("target", 0x112, "at each command", "A new commanded attitude", version=2)(
    counter("index", "number of the step, counted from 0, or of a commanded slew, counted from 1001"),
    _real("q2", "-", "commanded final q2", limits=_Q2),
    _real("rate", "rad/s", "commanded final rate"),
)

MODE = _packet("mode", 0x113, "at each change", "A change of the mode with its cause")(
    Field("before", "u1", "-", "mode before the change", states=MODES),
    Field("mode", "u1", "-", "mode after the change", states=MODES),
    Field("trigger", "S32", "-", "trigger of the change (flight.loop.modes)"),
    Field("reason", "S96", "-", "event or values that caused the trigger"),
    _real("target_q2", "-", "target q2 of a hold or slew; NaN if not known yet"),
)

PLAN = _packet("plan", 0x120, "every 5 s", "One result of the path planner")(
    counter("number", "number of the plan, from 1"),
    flag("accepted", "whether the plan is flown"),
    Field("status", "S32", "-", "optimal, stretched, or the reason of the rejection"),
    Field("origin_ns", "i8", "ns", "mission time of the start of the path"),
    _real("horizon_asked", "s", "requested horizon"),
    _real("horizon", "s", "planned horizon"),
    _real("start_q2", "-", "q2 at the start of the path"),
    _real("start_rate", "rad/s", "rate at the start of the path"),
    _real("target_q2", "-", "q2 at the end of the path"),
    _real("cost", "J", "planned integral of R I^2 over the path"),
    _real("peak_current", "A", "largest current on and between the nodes"),
    Field("evaluations", "u4", "-", "number of evaluations of the cost function"),
    Field("nodes", "u1", "-", "number of nodes of the path"),
    _real("node_q2", "-", "q2 at the Legendre-Gauss-Lobatto nodes; NaN if unused", MAX_NODES),
)

TRUTH = _packet(
    "truth",
    0x140,
    "40 Hz, simulation only",
    "True state of the simulated world, which sim_hal writes to a separate log",
)(
    _real("quaternion", "-", "rotation of reference frame into body, scalar last", 4),
    _real("rate", "rad/s", "body rate, body axes", 3),
    _real("current", "A", "true mean currents of the first three coils", 3),
    _real("energy", "J", "integral of R I^2 over all coils since mission time zero"),
    _real("supply_energy", "J", "integral of V |I| over all coils since mission time zero"),
)

TRUE_POWER = _packet(
    "true_power",
    0x145,
    "1 Hz, simulation only, only with the section `power`",
    "True power system, which sim_hal writes",
)(
    Field("charge", "f4", "-", "state of charge"),
    Field("battery_voltage", "f4", "V", "voltage of the battery and the bus"),
    Field("battery_current", "f4", "A", _DRAWN % "current out of the battery"),
    Field("solar_power", "f4", "W", "power of the solar panels that is used"),
    Field("load_power", "f4", "W", "power of all loads"),
    Field("coil_power", "f4", "W", "power of the coils at their supply"),
)

TRUE_COIL_CURRENTS = _packet(
    "true_coil_currents",
    0x143,
    "40 Hz, simulation only, only with more than three coils",
    "True currents of up to six coils, which sim_hal writes",
)(Field("current", "f4", "A", "true mean currents" + _ABSENT, MOST_COILS))

SPIN = _packet("spin", 0x115, "4 Hz", "Rate of a satellite in orbit from the magnetometer alone")(
    flag("known", "whether enough samples of the field agree for a valid rate"),
    _real("rate", "rad/s", "body rate, body axes", 3),
    _sigma("rate_sigma", "rad/s", "standard deviation of the rate about its worst axis"),
    _real("field", "T", "magnetic field, body axes", 3),
    counter("restarts", "number of restarts because the samples contradicted the rate"),
    Field("dipole", "f4", "A m^2", "commanded dipole of the coils, body axes", 3),
)

NAVIGATION = _packet(
    "navigation",
    0x116,
    "1 Hz",
    "Quality of a satellite's attitude estimate, and the constants that its filter has learned",
)(
    Field("knowledge", "u1", "-", "quality of the attitude estimate", states=KNOWLEDGE, alarms=LOST_ALARM),
    flag("placed", "whether the orbit is known"),
    counter("refused", "rejected measurements, including those of replays"),
    counter("fixes_refused", "GPS fixes that contradict the known orbit"),
    counter("restarts", "number of times the estimate was discarded and restarted"),
    _real("gyro_bias", "rad/s", "gyro bias, body axes; NaN before the first estimate", 3),
    _real("field_bias", "T", "magnetometer bias, body axes", 3),
    _real("residual_dipole", "A m^2", "residual dipole in the current sunlight, body axes", 3),
)

_INERTIA = "inertia tensor xx yy zz yz zx xy, body axes"
_COILS = "matrix from the dipole of the commanded currents to the actual dipole, row by row"
_TRUE_COILS = "matrix from the dipole of the written currents to the actual dipole, row by row"
_GYRO = "matrix from the rate to the rate that the gyro measures, row by row"
_FIELD = "matrix from the magnetic field to the field that the magnetometer measures, row by row"
_CAMERA = "rotation vector of the star camera from its configured mounting, body axes"
_ONE_SIGMA = "standard deviations of "

DESCRIPTION = _packet(
    "description",
    0x118,
    "0.1 Hz",
    "Estimated inertia, coils and sensors of a satellite in orbit, with their standard deviations",
)(
    *_estimated("inertia", "kg m^2", _INERTIA, 6),
    *_estimated("coils", "-", _COILS, 9),
    *_estimated("gyro", "-", _GYRO, 9),
    *_estimated("field", "-", _FIELD, 9),
    *_estimated("camera", "rad", _CAMERA, 3),
    _sigma("camera_attitude_sigma", "rad", _ONE_SIGMA + "the star camera's attitude, body axes", 3),
    _sigma("inertia_ratio_sigma", "-", _ONE_SIGMA + "inertia divided by its trace", 6),
    _sigma(
        "coils_ratio_sigma",
        "-",
        _ONE_SIGMA
        + "coils times the trace of the configured inertia, divided by that of the estimated inertia",
        9,
    ),
    *_estimated("gyro_bias", "rad/s", "gyro bias, body axes", 3),
    *_estimated("field_bias", "T", "magnetometer bias, body axes", 3),
    *_estimated("dipole", "A m^2", "residual dipole in shadow, body axes", 3),
    *_estimated("sunlit_dipole", "A m^2", "increase of the residual dipole in sunlight, body axes", 3),
)

FIX = _packet("fix", 0x119, "0.1 Hz", "Fix of the GPS receiver of a satellite in orbit", version=2)(
    Field("utc_ns", "i8", "ns", "UTC of the fix since 1970"),
    _real("position", "m", "geocentric position, ITRS", 3),
    _real("velocity", "m/s", "velocity with respect to the ground, ITRS", 3),
    Field("sigma", "f4", "m", "standard deviation of the position per axis; NaN if unknown"),
    _sigma("velocity_sigma", "m/s", "standard deviation of the velocity per axis; NaN if unknown"),
    Field("satellites", "u1", "-", "number of navigation satellites in use"),
    flag("used", "whether the orbit was updated"),
    _real("clock_off", "s", "host's UTC minus the UTC of the newest used fix; NaN before a fix"),
)

GPS_LINK = _packet(
    "gps_link",
    0x11A,
    "0.1 Hz",
    "Counters of the serial line of the GPS receiver since the start of the flight software",
)(
    counter("bytes_received", "received bytes"),
    counter("frames", "UBX frames with a valid checksum"),
    counter("long_frames", "UBX frames with more than 256 bytes of payload, which are skipped"),
    counter("bad_checksum", "UBX frames with a wrong checksum"),
    counter("discarded_bytes", "bytes outside UBX frames"),
    counter("sentences", "NMEA sentences, which only the driver `nmea` uses"),
    counter("out_of_range", "navigation solutions with an impossible value"),
    counter("unresolved", "navigation solutions without a valid date, time or leap seconds"),
    counter("no_fix", "navigation solutions without a valid fix"),
    counter("rolled_over", "navigation solutions whose date was moved by 1024 weeks"),
    counter("refused", "commands that the receiver refused"),
    Field("protocol", "f4", "-", "protocol version that the receiver reports; 0 if unknown"),
)

DIRECTIONS = _packet(
    "directions",
    0x117,
    "each set of images of the wide cameras",
    "Directions of the Sun and nadir from the wide cameras of a satellite in orbit",
)(
    Field("middle_ns", "i8", "ns", "mission time of the middle of the exposures"),
    Field("frames", "u1", "-", "bit mask of the cameras whose frames were read"),
    _real("sun", "-", "direction of the Sun, body axes; NaN if unknown", 3),
    _sigma("sun_sigma", "rad", "standard deviation of the Sun's direction per axis; NaN if unknown"),
    Field("sun_cameras", "u1", "-", "bit mask of the cameras that show the Sun; 0 if from solar cells"),
    flag("sun_used", "whether the estimate used the Sun's direction"),
    _real("nadir", "-", "direction of nadir, body axes; NaN if unknown", 3),
    _sigma("nadir_sigma", "rad", "standard deviation of nadir per axis; NaN if unknown"),
    Field(
        "nadir_cameras",
        "u1",
        "-",
        "bit mask of the cameras that show the limb; 0 if nadir is from the brightness of all images",
    ),
    flag("nadir_used", "whether the estimate used the nadir"),
)

SEPARATE_ATTITUDES = _packet(
    "separate_attitudes",
    0x144,
    "each set of images of the wide cameras, with `estimation.compare` only",
    "Attitudes determined as by Meller et al., for comparison; quaternions rotate ICRS into body axes",
)(
    Field("middle_ns", "i8", "ns", "mission time of the attitudes"),
    _real("cameras", "-", "attitude from Sun and nadir, scalar last; NaN if unknown", 4),
    _sigma("cameras_sigma", "rad", "standard deviation per axis of the attitude from Sun and nadir"),
    _real("magnetometer", "-", "attitude from the magnetometer, scalar last; NaN if unknown", 4),
    _sigma("magnetometer_sigma", "rad", "standard deviation per axis of the attitude from the magnetometer"),
    _real("fused", "-", "mean of both attitudes, scalar last; NaN if unknown", 4),
    _sigma("fused_sigma", "rad", "standard deviation of the mean of both attitudes per axis"),
    _real("filtered", "-", "attitude of the filter with the gyros, scalar last; NaN if unknown", 4),
    _sigma("filtered_sigma", "rad", "standard deviation of the filter's attitude per axis"),
    _real("gyro_bias", "rad/s", "gyro bias that the filter estimates, body axes", 3),
    _real("flown", "-", "attitude estimate that is used for control, scalar last; NaN if unknown", 4),
    _sigma("flown_sigma", "rad", "standard deviation per axis of the attitude that is used for control"),
)

ORBIT_TRUTH = _packet(
    "orbit_truth",
    0x141,
    "1 Hz, simulation of an orbit only",
    "True environment and torques of the simulated satellite, which sim_hal writes; NaN if unknown",
)(
    _real("utc", "day", "Julian date UTC of the simulated world"),
    _real("position", "m", "geocentric position, ICRS", 3),
    _real("velocity", "m/s", "geocentric velocity, ICRS", 3),
    _real("field", "T", "magnetic field of the Earth, ICRS", 3),
    _real("sun", "-", "direction of the Sun, ICRS", 3),
    _real("sunlit", "-", "visible fraction of the Sun's disc"),
    _real("residual_dipole", "A m^2", "true residual dipole, body axes", 3),
    _real("coil_torque", "N m", "torque of the coils, body axes", 3),
    _real("dipole_torque", "N m", "torque of the residual dipole, body axes", 3),
    _real("gravity_torque", "N m", "torque of the gravity gradient, body axes", 3),
    _real("drag_torque", "N m", "torque of air drag, body axes", 3),
    _real("sunlight_torque", "N m", "torque of solar pressure, body axes", 3),
)

TRUE_DESCRIPTION = _packet(
    "true_description",
    0x142,
    "at the start, simulation of an orbit only",
    "True inertia, coils and sensors of the simulated satellite, which sim_hal writes",
)(
    _real("inertia", "kg m^2", _INERTIA, 6),
    _real("coils", "-", _TRUE_COILS, 9),
    _real("gyro", "-", _GYRO, 9),
    _real("field", "-", _FIELD, 9),
    _real("camera", "rad", _CAMERA, 3),
)

_COVARIANCE = "covariance xx yy zz xy xz yz, body axes; NaN if unknown"
STREAK = _packet("streak", 0x121, "each frame", "Star streaks in one frame, and the rate from them")(
    counter("sequence", "frame number of the camera"),
    Field("exposure_start_ns", "i8", "ns", "mission time of the start of the exposure"),
    _real("exposure", "s", "exposure time"),
    Field("status", "S32", "-", "rate, ambiguous, too-short, too-few, failed, black, saturated, frozen"),
    Field("streaks", "u2", "-", "streaks found"),
    Field("used", "u2", "-", "streaks used in the rate"),
    _real("length", "px", "median length of the streaks"),
    _real("rate", "rad/s", "mean body rate over the exposure, body axes; NaN if unknown", 3),
    _real("covariance", "rad^2/s^2", _COVARIANCE, 6),
    _real("residual", "rad", "rms residual of the end points; NaN without a result"),
    flag("accepted", "whether the estimate used the rate"),
)

STARS = _packet("stars", 0x122, "each frame", "Stars in one frame, and the attitude from them")(
    counter("sequence", "frame number of the camera"),
    Field("middle_ns", "i8", "ns", "mission time of the middle of the exposure"),
    Field("status", "S32", "-", "solved, no-stars, too-few-stars, no-match, ambiguous"),
    flag("tracked", "whether the search began at the estimated attitude; no means a lost-in-space search"),
    Field("found", "u2", "-", "detected stars"),
    Field("matched", "u2", "-", "detected stars that match guide stars"),
    _real("quaternion", "-", "rotation of reference frame into body, scalar last or NaN", 4),
    _real("covariance", "rad^2", _COVARIANCE, 6),
    _real("log10_false_alarm", "-", "log10 of the expected number of chance matches in the whole sky"),
    flag("accepted", "whether the estimate used the attitude"),
)

LENS = _packet(
    "lens",
    0x125,
    "each frame from which the lens is learned",
    "The lens of the star camera as learned from its frames",
)(
    counter("sequence", "frame number of the camera"),
    Field("frames", "u4", "-", "frames from which the lens was learned"),
    Field("contradictions", "u4", "-", "frames that have contradicted the learned lens"),
    _real("focal_length", "px", "focal length"),
    _real("centre", "px", "pixel (x, y) of the optical axis", 2),
    _real("distortion", "-", "coefficients k1 and k2 of the radial distortion", 2),
    _real("line_time", "s", "delay between the exposures of successive rows"),
    _real("psf_sigma", "px", "standard deviation of the point spread"),
    _real("sigma", "-", _ONE_SIGMA + "the seven values above, each in its unit", 7),
    _real(
        "corner_sigma", "-", "relative standard deviation of the distance of an image corner from the centre"
    ),
)

MOST_SIGHTINGS = 8
"""Maximum number of sightings in a `sightings` packet."""

SIGHTINGS = _packet(
    "sightings",
    0x123,
    "each frame searched for objects",
    "Detections in one frame that match no star, such as moving objects",
)(
    counter("sequence", "frame number of the camera"),
    Field("middle_ns", "i8", "ns", "mission time of the middle of the exposure"),
    Field("found", "u2", "-", "number of sightings, of which the packet contains the brightest"),
    Field("x", "f4", "px", "column of each sighting, brightest first; NaN if unused", MOST_SIGHTINGS),
    Field("y", "f4", "px", "row of each sighting; NaN if unused", MOST_SIGHTINGS),
    Field("magnitude", "f4", "mag", "magnitude V of each sighting; NaN if unknown", MOST_SIGHTINGS),
)

TRACK = _packet(
    "track",
    0x124,
    "each object in each frame searched",
    "Line of sight to an object, tracked over frames, in the reference frame of the attitude",
    version=3,
)(
    Field("number", "u4", "-", "number of the object in this flight, from 1"),
    Field("middle_ns", "i8", "ns", "mission time of the middle of the exposure"),
    flag("seen", "whether the frame shows the object; no means predicted"),
    Field("sightings", "u4", "-", "sightings since the start of the track"),
    _real("measured", "-", "measured direction in this frame; NaN if not detected", 3),
    _real("measured_sigma", "rad", "standard deviation per axis, with the attitude error; NaN if none"),
    _real("direction", "-", "estimated direction to the object", 3),
    _real("rate", "rad/s", "rate of change of the direction", 3),
    _real("acceleration", "rad/s^2", "acceleration perpendicular to the direction", 3),
    _real("covariance", "rad^2", "covariance xx yy zz xy xz yz of the direction", 6),
    _real("rate_covariance", "rad^2/s^2", "covariance xx yy zz xy xz yz of the rate", 6),
    _real("magnitude", "mag", "mean magnitude V of the last sightings; NaN if unknown"),
    _real("magnitude_sigma", "mag", "standard deviation of the magnitude; NaN if unknown"),
    _real("place", "m", "geocentric position of the camera; NaN if unknown", 3),
    _real("velocity", "m/s", "geocentric velocity of the camera; NaN if unknown", 3),
    _real("place_sigma", "m", "standard deviation of the position per axis"),
    flag("relative", "whether the attitude of this frame is estimated without identified stars"),
)

PARAMETERS = _packet(
    "parameters",
    0x184,
    "at the start of a flight that takes commands, after each load, and on request",
    "Table of the parameters in use",
)(
    counter("loads", "number of tables loaded in this and earlier boots"),
    Field("crc", "u4", "-", "CRC-32 of the values, as big-endian doubles in this order"),
    Field("table", "u1", "-", "source of the table", states=TABLES),
    flag("kept", "whether the table is stored on disk"),
    *(replace(field, valid=None) for field in PARAMETER_FIELDS),
)

LINK = _packet(
    "link",
    0x170,
    "1 Hz, of the link process; not in the flight log",
    "Counts of received frames, and counters of the security associations",
    version=4,
)(
    counter("received", "frames received since the start of the link"),
    counter("admitted", "accepted frames"),
    counter("refused_crc", "frames refused because of a wrong CRC"),
    counter("refused_header", "frames refused because they are not for this spacecraft"),
    counter("refused_spi", "frames refused because their SPI has no association"),
    counter("refused_lost", "frames refused because both copies of the counter of their SPI are lost"),
    counter("refused_mac", "frames refused because of a wrong MAC, for example a forgery or an old key"),
    counter("refused_repeated", "frames refused because their counter was used before"),
    counter("refused_beyond", "frames refused because their counter is 2^40 or more ahead"),
    counter("refused_unstored", "frames refused because their counter could not be stored"),
    counter(
        "refused_command", "accepted frames without a command, without an answer, or refused by the flight"
    ),
    Field("highest", "i8", "-", "highest accepted counter of SPI 1 and 2; -1 if none, -2 if lost", 2),
    Field("generation", "u4", "-", "generation of the keys of SPI 1 to 4; 0 for lost", 4),
    Field("copies", "u1", "-", "valid copies of the counters of SPI 1 to 4", 4),
    counter("sent", "telemetry frames sent since the start of the link"),
    counter("thinned", "live packets omitted because of the limited rate; the archive contains them"),
    flag("playing", "whether a playback of the archive is running"),
    Field("played_ns", "i8", "ns", "mission time of the newest packet of the playback"),
    counter("unreported", "reports that were lost because of invalid values or newer reports"),
    counter("corrected", "wrong bits of telecommands that the BCH code has corrected"),
    counter("untaken", "telemetry frames that a line did not take, counted for each line and attempt"),
)

VERIFICATION = _packet(
    "verification",
    0x171,
    "at each step of a command, of the link process; not in the flight log",
    "Stage of a command that was received over the link",
    version=2,
)(
    Field("spi", "u2", "-", "SPI of the command's frame"),
    Field("counter", "i8", "-", "counter of the command's frame; at most 2^63 - 1"),
    Field("stage", "u1", "-", "stage of the command", states=STAGES),
    Field("name", "S16", "-", "name of the command, empty if unknown"),
    Field("text", "S128", "-", "values of the command, or the reason for its stage"),
    Field("packet", "u2", "-", "first 16 bits of the command's packet; 0 if it was not read"),
    Field("sequence", "u2", "-", "sequence count of the command's packet"),
)

TRANSFER = _packet(
    "transfer",
    0x172,
    "1 Hz for each open transfer, and at its end; from the link process, not in the flight log",
    "Progress of a file transfer",
)(
    flag("down", "whether the satellite sends the file"),
    Field("source", "u2", "-", "sending entity: 1 satellite, 2 ground, 3 another ground station"),
    Field("number", "u4", "-", "number of the transfer at the sending entity"),
    Field("name", "S96", "-", "name of the file, empty while it is unknown"),
    Field("size", "u4", "bytes", "size of the file"),
    Field("done", "u4", "bytes", "bytes received, or bytes sent and not requested again"),
    flag("open", "whether the transfer continues"),
    Field("condition", "u1", "-", "condition code of the end (CCSDS 727.0-B); 0 if complete or open"),
    Field("text", "S64", "-", "reason of the end"),
)

_LATENESS = Limits(fault=(0.0, 0.0125))
"""Nominal range of the delay (s) of a control cycle. A cycle that is late by half its period is skipped."""
_EXECUTION = Limits(warning=(0.0, 0.0125), fault=(0.0, 0.025))

CYCLE_TIMING = _packet(
    "cycle_timing",
    0x150,
    "40 Hz, performance record",
    "Start and duration of a control cycle on the machine's clock",
    version=2,
)(
    Field("cycle", "u8", "-", "number of the control cycle"),
    _real("lateness", "s", "delay of the start of the cycle", limits=_LATENESS),
    _real("execution", "s", "duration of the cycle", limits=_EXECUTION),
)

RATE_GROUP = _packet(
    "rate_group",
    0x151,
    "1 Hz each, performance record",
    "Statistics of a rate group of the executive since start",
)(
    Field("name", "S16", "-", "name of the rate group"),
    _real("period", "s", "period of the rate group"),
    counter("cycles", "cycles that ran"),
    counter("slips", "cycles that were skipped"),
    counter("overruns", "cycles longer than the period"),
    _real("mean", "s", "mean execution time"),
    _real("max", "s", "longest execution time"),
)

JOB_TIMING = _packet(
    "job_timing", 0x152, "each job, performance record", "Duration and outcome of a worker's job"
)(
    Field("name", "S16", "-", "name of the worker"),
    _real("execution", "s", "duration of the job"),
    Field("outcome", "S16", "-", "outcome: done, failed, timed-out or died"),
)

PACKETS: tuple[Packet, ...] = (
    RUN, IMU, CONTROL, ATTITUDE, COIL_CURRENTS, SPIN, NAVIGATION, DESCRIPTION, FIX, GPS_LINK, DIRECTIONS,
    SEPARATE_ATTITUDES, TARGET, MODE, PLAN, STREAK, STARS, LENS, SIGHTINGS, TRACK, EVENT, HOUSEKEEPING,
    HEALTH, WORKLOAD, POWER, COMMAND, PARAMETERS, LINK, VERIFICATION, TRANSFER, TRUTH, TRUE_COIL_CURRENTS,
    ORBIT_TRUTH, TRUE_DESCRIPTION, TRUE_POWER, CYCLE_TIMING, RATE_GROUP, JOB_TIMING,
)  # fmt: skip
