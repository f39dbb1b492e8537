"""The table of events, with the severity of each and the reaction to it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Severity(IntEnum):
    """The severity of an event."""

    INFORMATION = 0
    WARNING = 1
    FAULT = 2


class Reaction(IntEnum):
    """The reaction to an event, beside recording it."""

    NOTE = 0
    COILS_OFF = 1
    ISOLATE = 2
    HOLD = 3
    DETUMBLE = 4
    SAFE = 5
    RESTART = 6


@dataclass(frozen=True, slots=True)
class EventKind:
    """One row of the table. The code is for ever; names are for people."""

    code: int
    name: str
    severity: Severity
    meaning: str
    reaction: Reaction = Reaction.NOTE


_TOLD, _WARNED, _FAULT = Severity.INFORMATION, Severity.WARNING, Severity.FAULT

STARTED = EventKind(1, "started", _TOLD, "the loop begins")
STOPPED = EventKind(2, "stopped", _TOLD, "the loop ends, with the reason")
CYCLE_SLIP = EventKind(3, "cycle-slip", _WARNED, "slots of the control group were skipped")
TASK_FAILED = EventKind(
    4, "task-failed", _FAULT, "a task raised an exception; where it was the control task, coils to zero"
)
MODE = EventKind(5, "mode", _TOLD, "another mode than at the start, with what led to it")
CRASHED_OFTEN = EventKind(
    6, "crashed-often", _WARNED, "too many unclean shutdowns of late: the start leads to safe"
)
BOOT_WAITS = EventKind(7, "boot-waits", _WARNED, "the devices give no good data: still booting")
TASK_FAILING = EventKind(8, "task-failing", _FAULT, "the control task fails cycle after cycle", Reaction.SAFE)
NO_PROGRESS = EventKind(
    9, "no-progress", _FAULT, "a rate group or worker stands still: the watchdog is fed no more"
)
SERVICE_FAILING = EventKind(
    96, "service-failing", _FAULT, "a job beside the loop, as the coils' or the log's, fails or stands still"
)
SERVICE_RECOVERED = EventKind(97, "service-recovered", _TOLD, "the jobs beside the loop run again")
IMU_SILENT = EventKind(10, "imu-silent", _FAULT, "no bytes come from the inertial unit")
IMU_CORRUPT = EventKind(11, "imu-corrupt", _WARNED, "bytes come from the inertial unit that are no packets")
IMU_IMPLAUSIBLE = EventKind(12, "imu-implausible", _WARNED, "values out of range or not finite")
IMU_LINE_LOST = EventKind(13, "imu-line-lost", _FAULT, "the serial port is gone")
IMU_RECOVERED = EventKind(14, "imu-recovered", _TOLD, "good packets come again")
IMU_REFUSED = EventKind(
    15, "imu-refused", _WARNED, "measurements disagree with the estimate and are left out"
)
IMU_UNUSABLE = EventKind(
    16, "imu-unusable", _FAULT, "bytes come from the inertial unit, but no reading in them"
)
CONTROL_LOST = EventKind(
    20, "control-lost", _FAULT, "no trustworthy estimate: coils to zero", Reaction.COILS_OFF
)
CONTROL_REGAINED = EventKind(21, "control-regained", _TOLD, "the estimate is trustworthy again")
BLIND = EventKind(22, "blind", _FAULT, "no trustworthy estimate for too long", Reaction.SAFE)
TUMBLING = EventKind(
    23, "tumbling", _WARNED, "the body turns faster than it may outside detumbling", Reaction.DETUMBLE
)
HOLD_IMPOSSIBLE = EventKind(
    24, "hold-impossible", _FAULT, "the attitude cannot be held: far off and not coming back", Reaction.SAFE
)
STREAM_POOR = EventKind(25, "stream-poor", _WARNED, "a stream of readings is late, slow or out of its range")
STREAM_GOOD = EventKind(26, "stream-good", _TOLD, "a stream of readings is as it should be again")
COIL_FAULT = EventKind(30, "coil-fault", _FAULT, "the PWM chip does not take commands", Reaction.COILS_OFF)
COIL_RECOVERED = EventKind(31, "coil-recovered", _TOLD, "the PWM chip takes commands again")
COIL_BROKEN = EventKind(
    34, "coil-broken", _FAULT, "a coil does not carry what is commanded: left out", Reaction.ISOLATE
)
COIL_TRUSTED = EventKind(35, "coil-trusted", _TOLD, "by command a coil is used again")
COIL_SUSPECT = EventKind(
    36, "coil-suspect", _WARNED, "the supply current is not what the coils are told; which one is not known"
)
POWER_DOUBTED = EventKind(
    37, "power-doubted", _WARNED, "the current monitor says what the body does not feel"
)
POWER_FAULT = EventKind(32, "power-fault", _WARNED, "the current monitor does not answer")
POWER_RECOVERED = EventKind(33, "power-recovered", _TOLD, "the current monitor answers again")
COMMANDS_DOUBTED = EventKind(
    38,
    "commands-doubted",
    _WARNED,
    "the body does not move as commanded: the filter follows the gyro alone",
)
COMMANDS_TRUSTED = EventKind(39, "commands-trusted", _TOLD, "the body follows the commands again")
TARGET = EventKind(40, "target", _TOLD, "a new attitude is commanded")
PLAN_STRETCHED = EventKind(41, "plan-stretched", _TOLD, "no path within the horizon: stretched")
PLAN_REFUSED = EventKind(42, "plan-refused", _WARNED, "a plan was not flown, with the reason")
PLANNER_BUSY = EventKind(43, "planner-busy", _WARNED, "the planner has not finished the last job")
PLANNER_FAILED = EventKind(44, "planner-failed", _WARNED, "the planner gave no plan, with the reason")
HOLDING = EventKind(45, "holding", _WARNED, "the last good path has ended: holding its final attitude")
SLEW_LATE = EventKind(46, "slew-late", _WARNED, "a slew does not arrive", Reaction.HOLD)
WORKER_DIED = EventKind(47, "worker-died", _WARNED, "the process of a worker ended or was killed")
WORKER_READY = EventKind(48, "worker-ready", _TOLD, "a worker runs again")
WORKER_RESTS = EventKind(
    49, "worker-rests", _FAULT, "a worker died too often in a row: it is started again minutes later"
)
CAMERA_LOST = EventKind(50, "camera-lost", _WARNED, "no frame has come for too long")
CAMERA_RECOVERED = EventKind(51, "camera-recovered", _TOLD, "frames come again")
CAMERA_FROZEN = EventKind(52, "camera-frozen", _WARNED, "the camera gives the same frame again")
CAMERA_BLACK = EventKind(53, "camera-black", _WARNED, "the frame holds no light, or only light")
VISION_FAILED = EventKind(54, "vision-failed", _WARNED, "vision gave no result, with the reason")
STREAK_REFUSED = EventKind(55, "streak-refused", _WARNED, "a rate from streaks disagrees with the estimate")
STARS_REFUSED = EventKind(56, "stars-refused", _WARNED, "the stars' attitude disagrees with the estimate")
CAMERA_TORN = EventKind(57, "camera-torn", _WARNED, "parts of a frame are of an earlier one")
CAMERA_STRANGE = EventKind(
    58, "camera-strange", _WARNED, "many stars in a frame, and no sky that has them: are its pixels in order?"
)
VISION_SLOW = EventKind(59, "vision-slow", _WARNED, "vision takes long over a frame")
FRAME_UNUSED = EventKind(
    69,
    "frame-unused",
    _TOLD,
    "a frame of a body in motion gave no rate and no attitude",
)
CAMERA_LATE = EventKind(
    66, "camera-late", _WARNED, "a frame comes long after its exposure, or has not come yet"
)
LOG_FAULT = EventKind(60, "log-fault", _FAULT, "the flight log cannot be written")
LOG_RECOVERED = EventKind(65, "log-recovered", _TOLD, "packets reach the disk again")
RECORD_LOST = EventKind(110, "record-lost", _FAULT, "values did not fit their packet: the record is lost")
STATE_RECOVERED = EventKind(
    61, "state-recovered", _WARNED, "a copy of the kept state is bad: the other is used"
)
STATE_LOST = EventKind(62, "state-lost", _WARNED, "both copies of the kept state are bad: defaults")
STATE_UNWRITTEN = EventKind(63, "state-unwritten", _WARNED, "the state cannot be kept on disk")
STATE_OLD = EventKind(
    98, "state-old", _WARNED, "the kept state counts fewer boots than there were: an unclean shutdown"
)
PARAMETERS_LEFT = EventKind(
    115, "parameters-left", _WARNED, "the loaded table of parameters is not flown: the one before it is"
)
START_WAITED = EventKind(99, "start-waited", _WARNED, "the start failed and was tried again, with the reason")
CONFIG_DAMAGED = EventKind(
    67, "config-damaged", _WARNED, "the configuration is not the accepted one: the last that flew is flown"
)
LEARNED_REFUSED = EventKind(
    68, "learned-refused", _WARNED, "what an earlier boot learned is not believed: begun without it"
)
UNCLEAN_SHUTDOWN = EventKind(64, "unclean-shutdown", _WARNED, "the last boot did not end by itself")
CLOCK_STEP = EventKind(70, "clock-step", _WARNED, "the wall clock was set; nothing steers by it")
CPU_HIGH = EventKind(71, "cpu-high", _WARNED, "the control process takes more of a core than it should")
MEMORY_GROWS = EventKind(72, "memory-grows", _WARNED, "the memory of the flight processes grows")
MEMORY_HIGH = EventKind(
    73, "memory-high", _FAULT, "the flight processes take too much memory", Reaction.RESTART
)
DISK_LOW = EventKind(74, "disk-low", _WARNED, "little room is left for the flight log")
HOT = EventKind(75, "hot", _WARNED, "the board is warm")
TOO_HOT = EventKind(76, "too-hot", _FAULT, "the board is too hot to drive coils", Reaction.SAFE)
RESOURCE_NORMAL = EventKind(77, "resource-normal", _TOLD, "a resource is within its bounds again")
RELEASE_LEFT = EventKind(
    79,
    "release-left",
    _FAULT,
    "the current release or releases.py is damaged or did not start: the text names the one that flies",
)
COMMANDED = EventKind(80, "commanded", _TOLD, "a command was obeyed")
COMMAND_REFUSED = EventKind(81, "command-refused", _WARNED, "a command was not obeyed, with the reason")
COMMAND_SOCKET = EventKind(
    82, "command-socket", _WARNED, "the file of the command socket was removed: it is bound again"
)
GUARDIAN_LOST = EventKind(90, "guardian-lost", _FAULT, "the guardian has died or hangs: another is started")
GUARDIAN_READY = EventKind(91, "guardian-ready", _TOLD, "a guardian is on watch again")
GUARDIAN_ACTED = EventKind(
    92, "guardian-acted", _WARNED, "heartbeats stopped: the guardian held the coils at 0"
)
GUARDIAN_BLIND = EventKind(
    93, "guardian-blind", _FAULT, "the guardian cannot reach the PWM chip; it goes on trying"
)
REAL_TIME = EventKind(94, "real-time", _TOLD, "what was obtained of real-time scheduling and locked memory")
REAL_TIME_REFUSED = EventKind(95, "real-time-refused", _WARNED, "scheduling or locked memory was refused")

ATTITUDE_KNOWLEDGE = EventKind(100, "attitude-knowledge", _TOLD, "how well the attitude is known has changed")
GPS_LOST = EventKind(101, "gps-lost", _WARNED, "no fix of use has come for too long")
GPS_RECOVERED = EventKind(102, "gps-recovered", _TOLD, "fixes of use come again")
GPS_REFUSED = EventKind(103, "gps-refused", _WARNED, "a fix contradicts what is known of the orbit")
STRINGS_LOST = EventKind(104, "strings-lost", _WARNED, "the solar strings give no readings")
STRINGS_RECOVERED = EventKind(105, "strings-recovered", _TOLD, "the solar strings give readings again")
SUN_UNCLEAR = EventKind(106, "sun-unclear", _WARNED, "the solar strings see no Sun in the sunlight")
SUN_CLEAR = EventKind(107, "sun-clear", _TOLD, "the solar strings see the Sun again")
CLOCK_OFF = EventKind(
    130, "clock-off", _WARNED, "the wall clock differs from the receiver's time, by which the place is known"
)
FIELD_REFUSED = EventKind(
    131, "field-refused", _WARNED, "the magnetometer repeats its value, or contradicts the estimate: left out"
)
FIELD_TRUSTED = EventKind(132, "field-trusted", _TOLD, "the magnetometer agrees with the estimate again")
SLEW_BEGUN = EventKind(108, "slew-begun", _TOLD, "a slew of least heat to the target begins")
SLEW_ENDED = EventKind(109, "slew-ended", _TOLD, "a slew is over: the target is pointed to from now on")
WIDE_LOST = EventKind(133, "wide-lost", _WARNED, "a wide camera gives no frames")
WIDE_RECOVERED = EventKind(134, "wide-recovered", _TOLD, "all wide cameras give frames again")
WIDE_FALSE = EventKind(
    135, "wide-false", _WARNED, "a wide camera's pictures are not of what it must see by a fine attitude"
)
WIDE_TRUSTED = EventKind(
    136, "wide-trusted", _TOLD, "the wide cameras' pictures are of what they must see again"
)

OBJECT_FOUND = EventKind(120, "object-found", _TOLD, "a track of an object that is no star is confirmed")
OBJECT_LOST = EventKind(
    121, "object-lost", _TOLD, "the track of an object ended: it was not seen for too long"
)

OBJECT_FOLLOWED = EventKind(122, "object-followed", _TOLD, "the star camera's boresight follows an object")
OBJECT_ESCAPES = EventKind(
    123, "object-escapes", _WARNED, "the coils' torque does not suffice to keep an object in the field"
)

SUN_FOUND = EventKind(140, "sun-found", _TOLD, "in safe mode the Sun is seen, and the body turns to it")
SUN_MISSED = EventKind(141, "sun-missed", _WARNED, "in safe mode no Sun is seen: the body is only held still")
ASTRAY = EventKind(
    142, "astray", _WARNED, "far off its path the body is held still until it is slow, then planned for"
)

EVENTS: tuple[EventKind, ...] = tuple(
    value for value in dict(vars()).values() if isinstance(value, EventKind)
)
