"""Published numbers of events, commands, directives and parameters.

Ground stations, archives and documents use these numbers, so every change of a row changes the interface.
"""

from __future__ import annotations

import math

_PLAIN = {
    "information": """
        1 started  2 stopped  5 mode  14 imu-recovered  21 control-regained  26 stream-good  31 coil-recovered
        33 power-recovered  35 coil-trusted  39 commands-trusted  40 target  41 plan-stretched
        48 worker-ready  51 camera-recovered  65 log-recovered  69 frame-unused  77 resource-normal
        80 commanded  91 guardian-ready  94 real-time  97 service-recovered  100 attitude-knowledge
        102 gps-recovered  105 strings-recovered  107 sun-clear  108 slew-begun  109 slew-ended
        120 object-found  121 object-lost  122 object-followed  132 field-trusted  134 wide-recovered
        136 wide-trusted  140 sun-found  144 coil-tested  156 gyro-recovered
        163 battery-recovered  166 power-sensor-recovered  171 work-restored
        """,
    "warning": """
        3 cycle-slip  6 crashed-often  7 boot-waits  11 imu-corrupt  12 imu-implausible  15 imu-refused
        25 stream-poor  32 power-fault  36 coil-suspect  37 power-doubted  38 commands-doubted
        42 plan-refused  43 planner-busy  44 planner-failed  45 holding  47 worker-died  50 camera-lost
        52 camera-frozen  53 camera-black  54 vision-failed  55 streak-refused  56 stars-refused
        57 camera-torn  58 camera-strange  59 vision-slow  61 state-recovered  62 state-lost
        63 state-unwritten  64 unclean-shutdown  66 camera-late  67 config-damaged  68 learned-refused
        70 clock-step  71 cpu-high  72 memory-grows  74 disk-low  75 hot  81 command-refused
        82 command-socket  92 guardian-acted  95 real-time-refused  98 state-old  99 start-waited
        101 gps-lost  103 gps-refused  104 strings-lost  106 sun-unclear  115 parameters-left
        123 object-escapes  130 clock-off  131 field-refused  133 wide-lost  135 wide-false  141 sun-missed
        142 astray  143 coil-corrected  150 returned  151 gps-link  152 field-extrapolated  153 gps-set-up
        154 camera-saturated  157 lens-changed  160 battery-low  161 battery-very-low  165 power-sensor-lost
        170 work-shed  172 imu-upset
        """,
    "fault": """
        4 task-failed  9 no-progress  10 imu-silent  13 imu-line-lost  16 imu-unusable  49 worker-rests
        60 log-fault  79 release-left  90 guardian-lost  93 guardian-blind  96 service-failing
        110 record-lost  155 gyro-lost
        """,
}
_WITH_REACTION = {
    8: ("task-failing", "fault", "safe"),
    20: ("control-lost", "fault", "coils_off"),
    22: ("blind", "fault", "safe"),
    23: ("tumbling", "warning", "detumble"),
    24: ("hold-impossible", "fault", "safe"),
    30: ("coil-fault", "fault", "coils_off"),
    34: ("coil-broken", "fault", "isolate"),
    46: ("slew-late", "warning", "hold"),
    73: ("memory-high", "fault", "restart"),
    76: ("too-hot", "fault", "safe"),
    162: ("battery-critical", "fault", "safe"),
    164: ("battery-charged", "information", "return"),
}


def published_events() -> dict[int, tuple[str, str, str]]:
    """Return (name, severity, reaction) of each event, by the code of the event."""
    rows = dict(_WITH_REACTION)
    for severity, text in _PLAIN.items():
        words = text.split()
        rows |= {
            int(code): (name, severity, "note") for code, name in zip(words[::2], words[1::2], strict=True)
        }
    return rows


PARAMETERS: tuple[tuple[str, str, float, float], ...] = (
    ("modes.arrived_angle", "rad", 1e-4, 0.5),
    ("modes.arrived_rate", "rad/s", 1e-5, 0.5),
    ("modes.arrived_for", "s", 0.1, 600.0),
    ("modes.slew_limit", "s", 1.0, 1e5),
    ("modes.hold_error", "rad", 1e-3, math.pi),
    ("modes.hold_patience", "s", 0.1, 3600.0),
    ("modes.tumble_rate", "rad/s", 1e-3, 10.0),
    ("modes.blind_limit", "s", 1.0, 1e5),
    ("modes.known_for", "s", 0.1, 3600.0),
    ("modes.lost_for", "s", 0.1, 3600.0),
    ("health.cpu_share", "-", 0.01, 64.0),
    ("health.memory", "B", 1e6, 1e12),
    ("health.memory_slope", "B/h", 1e3, 1e12),
    ("health.disk_free", "B", 1.0, 1e13),
    ("health.temperature", "degree C", -40.0, 150.0),
    ("health.hottest", "degree C", -40.0, 150.0),
)
"""Key, unit and bounds of each parameter, in the order in which packets contain them."""

_ENTITY = "entity:u2{2=ground,3=another-ground-station}"
_NAME = "name:S96"

COMMANDS: tuple[tuple[str, int, str, bool], ...] = (
    ("ping", 0x201, "number:u4", False),
    ("safe", 0x202, "reason:S64", True),
    ("mode", 0x203, "mode:u1{1=safe,2=detumble,3=hold,5=testbed-demo,7=sun,8=point}", True),
    ("slew", 0x204, "q2:f8[-0.68,0.68]", True),
    ("clear", 0x205, "event:S32", True),
    (
        "point",
        0x206,
        "goal:u1{0=nadir,1=velocity,2=sun,3=inertial,4=ground,5=object} numbers:4f8 roll:f8",
        True,
    ),
    ("load-parameters", 0x210, "replaced:u4 crc:u4 PARAMETERS", True),
    ("dump-parameters", 0x211, "", False),
)
"""Name, APID and fields of each command, and whether the command has a stated hazard."""

_KINDS = "{0=configuration,1=elements,2=catalogue,3=release}"
DIRECTIVES: tuple[tuple[str, int, str, bool], ...] = (
    ("schedule", 0x220, "at:S32 words:S96", True),
    ("unschedule", 0x221, "number:u4", False),
    ("list-schedule", 0x222, "", False),
    ("list-files", 0x223, f"{_ENTITY} under:S96", False),
    ("send-file", 0x224, f"{_ENTITY} {_NAME}", False),
    ("cancel-file", 0x225, "source:u2 number:u4", False),
    ("suspend-file", 0x229, "source:u2 number:u4", False),
    ("resume-file", 0x22A, "source:u2 number:u4", False),
    ("use-file", 0x226, f"{_NAME} sum:32u1", True),
    ("delete-file", 0x227, _NAME, True),
    ("activate", 0x2B0, f"{_NAME} sum:32u1 hours:f4 despite_faults:u1", True),
    ("confirm", 0x2B1, f"kind:u1{_KINDS}", False),
    ("withdraw", 0x2B2, f"kind:u1{_KINDS}", True),
    ("restart", 0x2B3, "part:u1{0=flight,1=link,2=board}", True),
    ("play", 0x2A0, "run:u4 begin:f8 end:f8", False),
    ("stop-playback", 0x2A1, "", False),
    ("new-key", 0x2A2, "spi:u2 generation:u4 key:32u1", False),
    ("portion", 0x2A3, "total:u1 number:u1 data:72u1", False),
)
"""Name, APID and fields of each directive, and whether the directive has a stated hazard."""
