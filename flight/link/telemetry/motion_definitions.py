"""Packets of motion: the inertial unit, attitude, targets, modes and plans; the truth of a simulation."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Limits, Packet, counter
from flight.link.telemetry.states import MODES, NO_YES, STEERING
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT

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
