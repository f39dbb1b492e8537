"""The one table of telemetry: every packet, every field, its type, unit and meaning.

The packer, the parser, the ground database, the CSV export and the documentation are made from it. A packet
is never changed in place once it has flown: a field is appended and the packet's version raised.
"""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet, counter
from flight.link.telemetry.link_definitions import LINK, VERIFICATION
from flight.link.telemetry.orbit_definitions import NAVIGATION, ORBIT_TRUTH, SPIN

MAX_NODES = 40

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
        Field("simulated", "u1", "-", "1 when the devices are emulated"),
        Field("realtime", "u1", "-", "1 when flown on the machine's clock, 0 in lock-step"),
        Field("control_period_ns", "u8", "ns", "period of the control rate group"),
        Field("duration", "f8", "s", "planned length of the run, NaN when open"),
        Field("coil_resistance", "f8", "ohm", "resistance of each coil, NaN where none is fitted", 3),
        Field("supply_voltage", "f8", "V", "coil supply after losses, as configured"),
        Field("current_limit", "f8", "A", "largest current that a coil may carry"),
    ),
)

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
        Field("state", "u1", "-", "0 coils off, 1 following a path, 2 holding, 3 braking"),
        Field("estimate_age", "f8", "s", "age of the newest measurement in the estimate"),
        Field("angle", "f8", "rad", "estimated turn about the thread"),
        Field("q2", "f8", "-", "estimated second quaternion component"),
        Field("rate", "f8", "rad/s", "estimated rate about the thread"),
        Field("angle_sigma", "f8", "rad", "standard deviation of the angle"),
        Field("rate_sigma", "f8", "rad/s", "standard deviation of the rate"),
        Field("target_q2", "f8", "-", "commanded final q2"),
        Field("path_q2", "f8", "-", "planned q2 now"),
        Field("path_rate", "f8", "rad/s", "planned rate now"),
        Field("path_acceleration", "f8", "rad/s^2", "planned angular acceleration now"),
        counter("plan", "number of the plan being flown, 0 when none"),
        Field("current_command", "f8", "A", "currents asked of the coils", 3),
        Field("current_written", "f8", "A", "currents on the wire, limited and quantised", 3),
        Field("saturated", "u1", "-", "1 when any coil was limited"),
    ),
    version=2,
)

ATTITUDE = Packet(
    "attitude",
    0x114,
    "10 Hz",
    "The attitude of any body: estimate, path, target, dipole",
    (
        Field("mode", "u1", "-", "as in mode"),
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
        Field("q2", "f8", "-", "commanded final q2"),
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
        Field("before", "u1", "-", "mode until now, numbered as in mode"),
        Field("mode", "u1", "-", "0 boot, 1 safe, 2 detumble, 3 hold, 4 slew, 5 testbed-demo, 6 acquire"),
        Field("trigger", "S32", "-", "what led to it (flight.loop.modes.triggers)"),
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
        Field("accepted", "u1", "-", "1 when flown"),
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
        Field("accepted", "u1", "-", "1 when it entered the estimate"),
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
        Field("tracked", "u1", "-", "1 when the search began at the estimate's attitude, 0 lost in space"),
        Field("found", "u2", "-", "what was taken for a star"),
        Field("matched", "u2", "-", "of them guide stars"),
        Field("quaternion", "f8", "-", "reference into body, scalar last; NaN when none", 4),
        Field("covariance", "f8", "rad^2", "xx yy zz xy xz yz of small turns, body axes; NaN when none", 6),
        Field("log10_false_alarm", "f8", "-", "log10 of the chance matches expected in the whole sky"),
        Field("accepted", "u1", "-", "1 when it entered the estimate"),
    ),
)

EVENT = Packet(
    "event",
    0x130,
    "when it happens",
    "Something a reader of the log at night wants to know",
    (
        Field("code", "u2", "-", "number of the event (flight.link.events)"),
        Field("severity", "u1", "-", "0 information, 1 warning, 2 fault"),
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
        Field("state", "u1", "-", "as in control"),
        counter("imu_packets", "packets accepted since start"),
        counter("imu_bad_checksum", "packets with a wrong checksum"),
        counter("imu_discarded_bytes", "bytes that belonged to no packet"),
        counter("imu_out_of_range", "packets with implausible values"),
        counter("imu_not_finite", "packets with NaN or infinity"),
        counter("coil_faults", "failed transactions with the PWM chip"),
        Field("coil_voltage", "f8", "V", "supply of the coils, measured; NaN when unknown"),
        Field("coil_current", "f8", "A", "total current of the coils, measured; NaN when unknown"),
        Field("coil_power", "f8", "W", "power of the coils, measured; NaN when unknown"),
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
        Field("mode", "u1", "-", "as in mode"),
        Field("mode_age", "f8", "s", "time in this mode"),
        Field("imu", "u1", "-", "0 not fitted, 1 never came, 2 stale, 3 invalid, 4 slow, 5 good"),
        Field("field", "u1", "-", "the magnetometer, as imu"),
        Field("coils", "u1", "-", "acknowledged commands, as imu"),
        Field("power", "u1", "-", "the current monitor, as imu"),
        Field("camera", "u1", "-", "frames, as imu"),
        Field("facts", "u8", "-", "bit n: fact n of the table (flight.loop.fdir.facts) counts"),
        Field("coils_in_use", "u1", "-", "bits 0, 1, 2: the coils on body x, y, z"),
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
        Field("obeyed", "u1", "-", "1 when obeyed, 0 when refused"),
        Field("name", "S16", "-", "name of the command; empty for bytes that are none"),
        Field("source", "S16", "-", "socket, udp or timeline"),
        counter("count", "commands since start"),
        Field("mode", "u1", "-", "mode after it, as in mode"),
        Field("text", "S128", "-", "its values, or why it was refused"),
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

CYCLE_TIMING = Packet(
    "cycle_timing",
    0x150,
    "40 Hz, performance record",
    "When a control cycle ran and how long it took, on the machine's clock",
    (
        Field("cycle", "u8", "-", "slot of the control grid"),
        Field("lateness", "f8", "s", "start of the cycle after its slot"),
        Field("execution", "f8", "s", "time spent in the cycle"),
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
    TARGET,
    MODE,
    PLAN,
    STREAK,
    STARS,
    EVENT,
    HOUSEKEEPING,
    HEALTH,
    COMMAND,
    LINK,
    VERIFICATION,
    TRUTH,
    ORBIT_TRUTH,
    CYCLE_TIMING,
    RATE_GROUP,
    JOB_TIMING,
)
