"""Table of all events with their severities and reactions, and the modes of the satellite."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Severity(IntEnum):
    """The severity of an event."""

    INFORMATION = 0
    WARNING = 1
    FAULT = 2


class Reaction(IntEnum):
    """Action of the flight software after an event, in addition to recording the event."""

    NOTE = 0
    COILS_OFF = 1
    ISOLATE = 2
    HOLD = 3
    DETUMBLE = 4
    SAFE = 5
    RESTART = 6
    RETURN = 7


@dataclass(frozen=True, slots=True)
class EventKind:
    """Kind of event: one row of the event table. The code of a removed event is never used again.

    The text `remedy` states what an operator does about a warning or fault. The ground prints the table as
    the page `docs/events.md`.
    """

    code: int
    name: str
    severity: Severity
    meaning: str
    reaction: Reaction = Reaction.NOTE
    remedy: str = ""


def _info(code: int, name: str, meaning: str) -> EventKind:
    return EventKind(code, name, Severity.INFORMATION, meaning)


def _warn(code: int, name: str, meaning: str, remedy: str, reaction: Reaction = Reaction.NOTE) -> EventKind:
    return EventKind(code, name, Severity.WARNING, meaning, reaction, remedy)


def _fault(code: int, name: str, meaning: str, remedy: str, reaction: Reaction = Reaction.NOTE) -> EventKind:
    return EventKind(code, name, Severity.FAULT, meaning, reaction, remedy)


STARTED = _info(1, "started", "the control loop started")
STOPPED = _info(2, "stopped", "the control loop ended; the text gives the reason")
CYCLE_SLIP = _warn(
    3,
    "cycle-slip",
    "control cycles were skipped",
    "none for single slips; if they continue, stop other programs, and read `cpu-high` and `work-shed`",
)
TASK_FAILED = _fault(
    4,
    "task-failed",
    "a task raised an exception; if it is the control task, the coils go to zero",
    "the text names task and exception: download the log, and report both to the developers",
)
MODE = _info(5, "mode", "the mode changed; the text gives the cause")
CRASHED_OFTEN = _warn(
    6,
    "crashed-often",
    "too many recent unclean shutdowns: the flight starts in safe mode",
    "find the cause in the logs of the earlier flights, then command a mode",
)
BOOT_WAITS = _warn(
    7,
    "boot-waits",
    "the flight is still booting because the devices give no valid data",
    "the text names the device: check it as for the event of this device; only `safe` can be commanded now",
)
TASK_FAILING = _fault(
    8,
    "task-failing",
    "the control task fails in every cycle",
    "download the log and report the exception; `clear task-failing` permits another mode than SAFE",
    Reaction.SAFE,
)
NO_PROGRESS = _fault(
    9,
    "no-progress",
    "a rate group or worker makes no progress, so the watchdog is not reset",
    "none: the watchdog restarts the flight if the state persists; the text names the group or worker",
)
SERVICE_FAILING = _fault(
    96,
    "service-failing",
    "a background job, such as writing the log, fails or makes no progress",
    "the text names the job: free disk space, or check the disk",
)
SERVICE_RECOVERED = _info(97, "service-recovered", "all background jobs run again")
IMU_SILENT = _fault(
    10,
    "imu-silent",
    "the inertial unit sends nothing",
    "none in orbit: the flight keeps reading; on a bench, check power, cable and baud rate of the unit",
)
IMU_CORRUPT = _warn(
    11,
    "imu-corrupt",
    "the inertial unit sends bytes that form no packet",
    "check the cable and compare `inertial_unit.baud_rate` with the unit; single packets do no harm",
)
IMU_IMPLAUSIBLE = _warn(
    12,
    "imu-implausible",
    "the inertial unit sends values that are out of range or not finite",
    "none for single values; if they continue, check the unit with `knightcube bringup`",
)
IMU_LINE_LOST = _fault(
    13,
    "imu-line-lost",
    "the serial port of the inertial unit has disappeared",
    "none in orbit: the port is opened again when it returns; on a bench, check plug and USB adapter",
)
IMU_RECOVERED = _info(14, "imu-recovered", "the inertial unit sends valid packets again")
IMU_REFUSED = _warn(
    15,
    "imu-refused",
    "inertial measurements that disagree with the estimate are rejected",
    "none for single readings; if they continue, measure scale, mounting and noise with `bringup`",
)
IMU_UNUSABLE = _fault(
    16,
    "imu-unusable",
    "the inertial unit sends bytes that contain no reading",
    "configure the unit's output as the driver expects; check model and baud rate",
)
IMU_UPSET = _warn(
    172,
    "imu-upset",
    "the inertial unit restarted or lost its settings, and is configured again",
    "none for single events; if they continue, check the supply of the unit",
)
GYRO_LOST = _fault(
    155,
    "gyro-lost",
    "the inertial unit sends readings without a valid rate",
    "none: the flight continues without the gyro if other sensors permit; check the unit on a bench",
)
GYRO_RECOVERED = _info(156, "gyro-recovered", "the inertial unit measures the rate again")
CONTROL_LOST = _fault(
    20,
    "control-lost",
    "the coils are set to zero because the estimate is not valid",
    "restore a sensor: read the events of inertial unit, camera and magnetometer before this event",
    Reaction.COILS_OFF,
)
CONTROL_REGAINED = _info(21, "control-regained", "the estimate is valid again")
BLIND = _fault(
    22,
    "blind",
    "the estimate has been invalid or inaccurate for too long",
    "restore a sensor, see the earlier events of sensors; then command a mode",
    Reaction.SAFE,
)
TUMBLING = _warn(
    23,
    "tumbling",
    "the body rotates too fast for any mode but detumbling",
    "none: the flight detumbles by itself; find the cause, such as a wrong coil, before it points again",
    Reaction.DETUMBLE,
)
HOLD_IMPOSSIBLE = _fault(
    24,
    "hold-impossible",
    "the attitude cannot be held: its error is large and does not decrease",
    "check coils and targets, and the disturbance; then command a mode",
    Reaction.SAFE,
)
STREAM_POOR = _warn(
    25,
    "stream-poor",
    "a stream of readings is late, slow or out of range",
    "the text names stream and value: check the rate, the age and the range of this device",
)
STREAM_GOOD = _info(26, "stream-good", "a stream of readings is normal again")
COIL_FAULT = _fault(
    30,
    "coil-fault",
    "the PWM chip does not accept commands",
    "none in orbit: the flight keeps trying; on a bench, check bus, address and supply of the PWM chip",
    Reaction.COILS_OFF,
)
COIL_RECOVERED = _info(31, "coil-recovered", "the PWM chip accepts commands again")
COIL_BROKEN = _fault(
    34,
    "coil-broken",
    "a coil does not carry the commanded current and is isolated",
    "the text names coil and cause; after a repair or for a trial, send `clear coil-broken`",
    Reaction.ISOLATE,
)
COIL_TRUSTED = _info(35, "coil-trusted", "an isolated coil is used again, by command or for a trial")
COIL_CORRECTED = _warn(
    143,
    "coil-corrected",
    "a coil is used with another sign or gain, because the motion shows it",
    "correct sign or gain of this coil in `coils.windings`, so that later flights begin with it",
)
COIL_TESTED = _info(144, "coil-tested", "coils that pointing hardly uses were tested by short current pulses")
COIL_SUSPECT = _warn(
    36,
    "coil-suspect",
    "the supply current does not match the commanded currents; the faulty coil is unknown",
    "check the coils with `bringup`, and the resistances in `coils.windings`",
)
POWER_DOUBTED = _warn(
    37,
    "power-doubted",
    "the current monitor contradicts the measured motion, or measures all currents wrong by one factor",
    "check the shunt and the sign of the current monitor; the motion or the corrected current is used",
)
POWER_FAULT = _warn(
    32,
    "power-fault",
    "the current monitor does not answer",
    "none in orbit: the flight continues without it; on a bench, check bus and address of the monitor",
)
POWER_RECOVERED = _info(33, "power-recovered", "the current monitor answers again")
COMMANDS_DOUBTED = _warn(
    38,
    "commands-doubted",
    "the body does not move as commanded, so the filter uses the gyro alone",
    "none if it ends soon; otherwise compare coils, inertia and residual dipole with `knightcube identify`",
)
COMMANDS_TRUSTED = _info(39, "commands-trusted", "the body moves as commanded again")
TARGET = _info(40, "target", "a new attitude is commanded")
PLAN_STRETCHED = _info(41, "plan-stretched", "no path fits into the horizon, so the horizon was extended")
PLAN_REFUSED = _warn(
    42,
    "plan-refused",
    "a plan was rejected; the text gives the reason",
    "none for single plans, because the next plan follows; otherwise the text names the limit",
)
PLANNER_BUSY = _warn(
    43,
    "planner-busy",
    "the planner has not finished its previous job",
    "none for single plans; if it continues, read `cpu-high` and `work-shed`",
)
PLANNER_FAILED = _warn(
    44,
    "planner-failed",
    "the planner found no plan; the text gives the reason",
    "command a target that can be reached with the coils and the exclusion cones",
)
HOLDING = _warn(
    45,
    "holding",
    "the last valid path has ended and its final attitude is held",
    "none if the next plan follows; otherwise read `planner-failed` and `worker-died`",
)
SLEW_LATE = _warn(
    46,
    "slew-late",
    "a slew does not arrive in time",
    "none: the flight holds; command the slew again, and check coils and inertia if it is late again",
    Reaction.HOLD,
)
WORKER_DIED = _warn(
    47,
    "worker-died",
    "a worker process ended or was killed",
    "none: the worker is restarted; if it dies again, read `memory-high` and the journal",
)
WORKER_READY = _info(48, "worker-ready", "a worker runs again")
WORKER_RESTS = _fault(
    49,
    "worker-rests",
    "a worker died too often in a row and is restarted after some minutes",
    "read the journal, and check memory and load of the board",
)
CAMERA_LOST = _warn(
    50,
    "camera-lost",
    "the camera has delivered no frame for too long",
    "none in orbit: the flight opens the camera again; on a bench, check power and cable",
)
CAMERA_RECOVERED = _info(51, "camera-recovered", "the camera delivers frames again")
CAMERA_FROZEN = _warn(
    52,
    "camera-frozen",
    "the camera delivers the same frame repeatedly",
    "restart the camera or its power; frames that repeat are not used",
)
CAMERA_BLACK = _warn(
    53,
    "camera-black",
    "a frame is completely dark",
    "check lens cap, exposure and gain; in orbit, none if the camera is in the shadow of the structure",
)
CAMERA_SATURATED = _warn(
    154,
    "camera-saturated",
    "a frame is completely saturated",
    "none while Sun, Moon or Earth are in the field of view; otherwise reduce exposure or gain",
)
VISION_FAILED = _warn(
    54,
    "vision-failed",
    "vision found no result; the text gives the reason",
    "none for single frames; otherwise remove the cause in the text",
)
STREAK_REFUSED = _warn(
    55,
    "streak-refused",
    "a rate from star streaks disagrees with the estimate",
    "none for single rates; if they continue, check exposure and mounting of the camera",
)
STARS_REFUSED = _warn(
    56,
    "stars-refused",
    "an attitude from stars disagrees with the estimate",
    "none for single attitudes; if they continue, check the mounting of camera and inertial unit",
)
CAMERA_TORN = _warn(
    57,
    "camera-torn",
    "a frame contains parts of an earlier frame",
    "none for single frames; if they continue, check the camera's cable and the load of the bus",
)
CAMERA_STRANGE = _warn(
    58,
    "camera-strange",
    "many stars were detected but none match the catalogue",
    "check pixels, field of view and orientation with `knightcube solve` and `calibrate`",
)
VISION_SLOW = _warn(
    59,
    "vision-slow",
    "the processing of a frame takes too long",
    "read `cpu-high` and `work-shed`; take fewer or smaller frames",
)
FRAME_UNUSED = _info(69, "frame-unused", "a frame of the rotating body gave neither rate nor attitude")
CAMERA_LATE = _warn(
    66,
    "camera-late",
    "a frame arrived late or is overdue",
    "none for single frames; if they continue, check the load of the board and of the camera's bus",
)
LOG_FAULT = _fault(
    60,
    "log-fault",
    "the flight log cannot be written",
    "free disk space, or check disk and permissions of the folder",
)
LOG_RECOVERED = _info(65, "log-recovered", "the flight log is written again")
RECORD_LOST = _fault(
    110,
    "record-lost",
    "a record was lost because values were out of the packet's range",
    "the text names packet and field: download the log, and report it to the developers",
)
STATE_RECOVERED = _warn(
    61,
    "state-recovered",
    "one copy of the stored state is damaged; the other copy is used",
    "none: both copies are written again; if it repeats, check the disk",
)
STATE_LOST = _warn(
    62,
    "state-lost",
    "both copies of the stored state are damaged; default values are used",
    "load the parameters again; check the disk",
)
STATE_UNWRITTEN = _warn(
    63,
    "state-unwritten",
    "the state cannot be written to disk",
    "free disk space, or check disk and permissions of the folder",
)
STATE_OLD = _warn(
    98,
    "state-old",
    "the stored state precedes the last boot, so the last shutdown counts as unclean",
    "none; check the cause of the last shutdown if it was not intended",
)
PARAMETERS_LEFT = _warn(
    115,
    "parameters-left",
    "the loaded parameter table is rejected and the previous table is used",
    "dump the parameters, and load the table again if it was not the cause of the crash",
)
START_WAITED = _warn(
    99,
    "start-waited",
    "the start failed and was repeated; the text gives the reason",
    "none: the flight started; remove the cause in the text",
)
CONFIG_DAMAGED = _warn(
    67,
    "config-damaged",
    "the configuration is not the accepted one; the configuration of an earlier flight is used",
    "write the configuration again and run `install.sh --accept`, or renew the configuration",
)
LENS_CHANGED = _warn(
    157,
    "lens-changed",
    "a frame contradicts the learned lens, which is learned again",
    "none: the lens is learned again; if it repeats, run `knightcube calibrate`",
)
LEARNED_REFUSED = _warn(
    68,
    "learned-refused",
    "implausible or contradicted learned values were rejected",
    "none: the values are estimated again; if it repeats, look for a payload whose dipole changes",
)
UNCLEAN_SHUTDOWN = _warn(
    64,
    "unclean-shutdown",
    "the previous boot did not end cleanly",
    "none if the power was cut; otherwise read the log of the earlier flight",
)
CLOCK_STEP = _warn(
    70,
    "clock-step",
    "the wall clock was changed; control does not use it",
    "none: mission time continues; check the program that sets the clock",
)
CPU_HIGH = _warn(
    71,
    "cpu-high",
    "the control process uses too much processor time",
    "stop other programs of the board, or take fewer frames",
)
MEMORY_GROWS = _warn(
    72,
    "memory-grows",
    "the memory use of the flight processes grows",
    "watch `memory-high`; report it with the log to the developers",
)
MEMORY_HIGH = _fault(
    73,
    "memory-high",
    "the flight processes use too much memory",
    "none: the flight restarts; report it with the log to the developers",
    Reaction.RESTART,
)
DISK_LOW = _warn(
    74,
    "disk-low",
    "little disk space is left for the flight log",
    "download and delete old logs, or reduce the size of the archive",
)
HOT = _warn(
    75,
    "hot",
    "the board is warm",
    "reduce the load of the board, or improve its cooling; above the next limit `too-hot` follows",
)
TOO_HOT = _fault(
    76,
    "too-hot",
    "the board is too hot to drive coils",
    "wait until the board is cool, send `clear too-hot`, then command a mode",
    Reaction.SAFE,
)
RESOURCE_NORMAL = _info(77, "resource-normal", "a resource is within its limits again")
RELEASE_LEFT = _fault(
    79,
    "release-left",
    "the current release or the launcher is damaged or did not start; the text names the release in use",
    "read [Renewal](fly/renewal.md), and install the release again",
)
RETURNED = _warn(
    150,
    "returned",
    "the board returned to an earlier release or configuration; the text gives the reason",
    "remove the cause in the text, and renew again",
)
COMMANDED = _info(80, "commanded", "a command was executed")
COMMAND_REFUSED = _warn(
    81,
    "command-refused",
    "a command was refused; the text gives the reason",
    "correct the command as the text says, and send it again",
)
COMMAND_SOCKET = _warn(
    82,
    "command-socket",
    "the file of the command socket was removed, so the socket is bound again",
    "none: the socket exists again; find the program that removed the file",
)
GUARDIAN_LOST = _fault(
    90,
    "guardian-lost",
    "the guardian died or hangs; another one is started",
    "none: another guardian is started; if it dies again, read the journal",
)
GUARDIAN_READY = _info(91, "guardian-ready", "a guardian watches the heartbeats again")
GUARDIAN_ACTED = _warn(
    92,
    "guardian-acted",
    "the heartbeats stopped and the guardian held the coils at zero",
    "find the cause of the missing heartbeats: `cycle-slip`, `no-progress` or the journal",
)
GUARDIAN_BLIND = _fault(
    93,
    "guardian-blind",
    "the guardian cannot reach the PWM chip and keeps trying",
    "check bus and supply of the PWM chip; if the coils carry current, switch off their supply",
)
REAL_TIME = _info(94, "real-time", "the text lists the obtained real-time scheduling and locked memory")
REAL_TIME_REFUSED = _warn(
    95,
    "real-time-refused",
    "real-time scheduling or locked memory was refused",
    "run the flight as the service of `deploy/`, or permit real-time priority and locked memory",
)

ATTITUDE_KNOWLEDGE = _info(100, "attitude-knowledge", "the quality of the attitude estimate changed")
GPS_LOST = _warn(
    101,
    "gps-lost",
    "the GPS receiver has delivered no usable fix for too long",
    "none in orbit if it ends; otherwise check antenna, attitude and supply of the receiver",
)
GPS_RECOVERED = _info(102, "gps-recovered", "the GPS receiver delivers usable fixes again")
GPS_REFUSED = _warn(
    103,
    "gps-refused",
    "a GPS fix was refused; the text gives the reason",
    "none for single fixes; if all are refused, remove the cause in the text, such as old elements",
)
GPS_SET_UP = _warn(
    153,
    "gps-set-up",
    "the GPS receiver refused a command of its configuration",
    "compare the model of the receiver with the driver; the text names the command",
)
FIELD_EXTRAPOLATED = _warn(
    152,
    "field-extrapolated",
    "the date is outside the years of the field model",
    "install a release with newer coefficients, or correct the clock",
)
GPS_LINK = _warn(
    151,
    "gps-link",
    "frames of the GPS receiver were corrupt, implausible or corrected",
    "none for single frames; if they continue, check cable and baud rate of the receiver",
)
STRINGS_LOST = _warn(
    104,
    "strings-lost",
    "the solar strings deliver no readings",
    "none in orbit: the flight continues without them; on a bench, check bus and address of the converter",
)
STRINGS_RECOVERED = _info(105, "strings-recovered", "the solar strings deliver readings again")
SUN_UNCLEAR = _warn(
    106,
    "sun-unclear",
    "the solar strings detect no Sun although the satellite is sunlit",
    "check normals and channels of `solar_strings`; the flight continues without the Sun",
)
SUN_CLEAR = _info(107, "sun-clear", "the solar strings detect the Sun again")
CLOCK_OFF = _warn(
    130,
    "clock-off",
    "the wall clock differs from GPS time, which is used instead, or precedes the epoch of the elements",
    "set the clock of the board, or renew elements whose epoch is in the future",
)
FIELD_REFUSED = _warn(
    131,
    "field-refused",
    "the magnetometer is ignored because its value is stuck or contradicts the estimate",
    "none if it ends soon; otherwise check supply and mounting of the magnetometer",
)
FIELD_TRUSTED = _info(132, "field-trusted", "the magnetometer agrees with the estimate again")
SLEW_BEGUN = _info(108, "slew-begun", "a slew to the target with minimum heat begins")
SLEW_ENDED = _info(109, "slew-ended", "a slew has ended and the target is tracked from now on")
WIDE_LOST = _warn(
    133,
    "wide-lost",
    "a wide camera delivers no frames",
    "none in orbit: the flight opens the camera again; on a bench, check power and cable",
)
WIDE_RECOVERED = _info(134, "wide-recovered", "all wide cameras deliver frames again")
WIDE_FALSE = _warn(
    135,
    "wide-false",
    "the frames of a wide camera contradict the fine attitude",
    "check the mounting of this camera, and whether it was exchanged with another",
)
WIDE_TRUSTED = _info(136, "wide-trusted", "the frames of the wide cameras agree with the attitude again")

OBJECT_FOUND = _info(120, "object-found", "the track of a moving object is confirmed")
OBJECT_LOST = _info(
    121, "object-lost", "the track of an object ended because it was not detected for too long"
)

OBJECT_FOLLOWED = _info(122, "object-followed", "the boresight of the star camera follows an object")
OBJECT_ESCAPES = _warn(
    123,
    "object-escapes",
    "the torque of the coils is too small to keep an object in the field of view",
    "follow a slower object, or command another target",
)

SUN_FOUND = _info(140, "sun-found", "the Sun was detected in safe mode and the body turns towards it")
SUN_MISSED = _warn(
    141,
    "sun-missed",
    "no Sun was detected in safe mode, so the body is only damped",
    "none if the satellite is in eclipse; otherwise read `strings-lost` and `wide-lost`",
)
ASTRAY = _warn(
    142,
    "astray",
    "the body is far from its path and is slowed down before a new plan",
    "none: a new plan follows; if it repeats, check coils, inertia and residual dipole with `identify`",
)

BATTERY_LOW = _warn(
    160,
    "battery-low",
    "the battery is low, so the currents of the coils are limited",
    "reduce the loads, or point the solar cells to the Sun with `mode sun`",
)
BATTERY_VERY_LOW = _warn(
    161,
    "battery-very-low",
    "the battery is very low, so the star camera takes fewer frames",
    "reduce the loads, and point the solar cells to the Sun with `mode sun`",
)
BATTERY_CRITICAL = _fault(
    162,
    "battery-critical",
    "the battery is almost empty",
    "none: the flight leaves SAFE when the battery has recovered; reduce other loads",
    Reaction.SAFE,
)
BATTERY_RECOVERED = _info(163, "battery-recovered", "the battery is charged above a limit again")
BATTERY_CHARGED = EventKind(
    164,
    "battery-charged",
    Severity.INFORMATION,
    "the battery has recovered; a flight in SAFE because of the battery leaves SAFE",
    Reaction.RETURN,
)
POWER_SENSOR_LOST = _warn(
    165,
    "power-sensor-lost",
    "a monitor of battery or bus is silent, stuck or contradicted, and is not used",
    "none in orbit: the flight continues without it; on a bench, check the monitor with `bringup`",
)
POWER_SENSOR_RECOVERED = _info(
    166, "power-sensor-recovered", "the monitors of battery and bus are used again"
)

WORK_SHED = _warn(
    170,
    "work-shed",
    "the processor is overloaded, so less important work is reduced",
    "none if it ends soon; otherwise stop other programs, or take fewer frames",
)
WORK_RESTORED = _info(
    171, "work-restored", "reduced work is resumed, because the processor has spare capacity"
)

EVENTS: tuple[EventKind, ...] = tuple(
    value for value in dict(vars()).values() if isinstance(value, EventKind)
)


class Mode(IntEnum):
    """Mode of the satellite. The enumeration values are the values in the mode packet."""

    BOOT = 0
    """The coils are at zero until the devices deliver valid data."""
    SAFE = 1
    """A testbed sets its coils to zero; a satellite detumbles and points its solar cells to the Sun."""
    DETUMBLE = 2
    """The coils reduce the body rate, which requires no attitude estimate."""
    HOLD = 3
    """The body holds an attitude."""
    SLEW = 4
    """The body slews to a commanded attitude."""
    TESTBED_DEMO = 5
    """The testbed executes the configured sequence of demonstration steps."""
    ACQUIRE = 6
    """The coils are at zero while the satellite, which rotates slowly, determines its attitude."""
    SUN = 7
    """The satellite points to the Sun."""
    POINT = 8
    """The satellite points to the configured targets or to a commanded target."""

    @property
    def label(self) -> str:
        """Name of the mode in configurations, commands and reports."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def named(cls, label: str) -> Mode:
        """Return the mode with a given label. Raises ValueError for an unknown label."""
        for mode in cls:
            if mode.label == label:
                return mode
        raise ValueError(f"{label!r} is not a mode: use {', '.join(mode.label for mode in cls)}")


COMMANDABLE = (Mode.SAFE, Mode.DETUMBLE, Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO, Mode.SUN, Mode.POINT)
"""Modes that can be commanded. The modes BOOT and ACQUIRE are entered only automatically."""

POINTING = frozenset({Mode.SUN, Mode.POINT})
"""Modes that require a known attitude of the satellite in its orbit."""

ORBITAL = POINTING | {Mode.ACQUIRE}
"""Modes that exist only on a satellite in orbit, which must first acquire its attitude."""

TESTBED = frozenset({Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO})
"""Modes that exist only on a testbed."""

FOREIGN_MODES = {"testbed": ORBITAL, "orbit": TESTBED}
"""Modes that a kind of body does not have, by kind."""

STEERING = POINTING | TESTBED
"""Modes in which the planner and the controller steer the attitude."""
