"""Packets of the run and its health: events, housekeeping, commands."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet, counter
from flight.link.telemetry.states import (
    COILS,
    FACT_ALARMS,
    FACTS,
    MODES,
    NO_YES,
    SAFE_ALARM,
    SEVERITIES,
    SEVERITY_ALARMS,
    STEERING,
    STREAM_ALARMS,
    STREAMS,
)

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
