"""The one table of telemetry: every packet, every field, its type, unit and meaning.

The packer, the parser, the ground database, the CSV export and the documentation are made from it; the
modules `*_definitions` hold its rows by subject. A packet is never changed in place once it has flown: a
field is appended and the packet's version raised.
"""

from __future__ import annotations

from flight.link.telemetry.form import Packet
from flight.link.telemetry.health_definitions import COMMAND, EVENT, HEALTH, HOUSEKEEPING, RUN
from flight.link.telemetry.link_definitions import LINK, TRANSFER, VERIFICATION
from flight.link.telemetry.motion_definitions import (
    ATTITUDE,
    CONTROL,
    IMU,
    MAX_NODES,
    MODE,
    PLAN,
    TARGET,
    TRUTH,
)
from flight.link.telemetry.orbit_definitions import DIRECTIONS, NAVIGATION, ORBIT_TRUTH, SPIN
from flight.link.telemetry.parameter_definitions import PARAMETERS
from flight.link.telemetry.performance_definitions import CYCLE_TIMING, JOB_TIMING, RATE_GROUP
from flight.link.telemetry.vision_definitions import SIGHTINGS, STARS, STREAK, TRACK

__all__ = [
    "ATTITUDE",
    "COMMAND",
    "CONTROL",
    "CYCLE_TIMING",
    "DIRECTIONS",
    "EVENT",
    "HEALTH",
    "HOUSEKEEPING",
    "IMU",
    "JOB_TIMING",
    "LINK",
    "MAX_NODES",
    "MODE",
    "NAVIGATION",
    "ORBIT_TRUTH",
    "PACKETS",
    "PARAMETERS",
    "PLAN",
    "RATE_GROUP",
    "RUN",
    "SIGHTINGS",
    "SPIN",
    "STARS",
    "STREAK",
    "TARGET",
    "TRACK",
    "TRANSFER",
    "TRUTH",
    "VERIFICATION",
]

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
