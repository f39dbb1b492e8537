"""Types of configuration values with their bounds, and the values of a pointing goal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.plant import Q2_LIMIT
from knightcube.gnc.guidance.pointing_target import ROLLS, Goal, PointingTarget

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Longitude = Annotated[float, Meta(ge=-360.0, le=360.0)]
Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
Q2 = Annotated[float, Meta(ge=-Q2_LIMIT, le=Q2_LIMIT)]
Address = Annotated[int, Meta(ge=0x08, le=0x77)]
Bus = (
    Annotated[int, Meta(ge=0, le=0xFFFFF)]
    | Annotated[
        str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="the number of a bus, or its device file")
    ]
)
CallSign = Annotated[
    str,
    Meta(
        pattern=r"^[A-Z0-9]{1,6}(-([0-9]|1[0-5]))?$",
        description="an amateur call sign of capitals and digits with an SSID from 0 to 15, such as OK0SAT-1",
    ),
]
Peer = Annotated[
    str,
    Meta(
        pattern=r"^[0-9]{1,3}(\.[0-9]{1,3}){3}(/[0-9]{1,2})?$",
        description="an IPv4 address or subnet, such as 192.168.7.0/24",
    ),
]
HostPort = Annotated[
    str,
    Meta(
        pattern=r"^[^:\s]+:([0-5]?[0-9]{1,4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])$",
        description="HOST:PORT, such as 127.0.0.1:5005, PORT 65535 at most",
    ),
]
Sign = Literal[-1, 1]
SignedAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
DriverName = Annotated[str, Meta(min_length=1, max_length=200)]
"""Name of a driver in `flight.schema.devices`, or `module:object`."""
Channel = Annotated[int, Meta(ge=0, le=15)]
BaudRate = Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600]
Estimator = Literal["likelihood", "harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]
Vector = tuple[float, float, float]
Inertia = tuple[float | Vector, float | Vector, float | Vector]
"""Three moments of inertia about the body axes, or the three rows of the inertia tensor, kg m^2.

The function `inertia_problem` checks the moments. Bounds in this type would damage memory: msgspec 0.22
cannot distinguish a number with a bound from a tuple of fixed length.
"""
Quaternion = tuple[float, float, float, float]
PlainMode = Literal["testbed-demo", "hold", "detumble", "safe"]
CommandedMode = Literal[PlainMode, "sun", "point"]
GoalName = Literal["nadir", "velocity", "sun", "inertial", "ground", "object"]

_OWN = {
    "inertial": ("quaternion",),
    "ground": ("latitude_deg", "longitude_deg"),
    "object": ("right_ascension_deg", "declination_deg"),
}
"""Keys that a goal requires and no other goal accepts. The goal `object` may have both keys or none."""
_LENGTH_ERROR = 1e-3
"""Largest accepted deviation of a commanded quaternion's norm from 1."""


def inertia_matrix(inertia: Inertia) -> FloatArray:
    """Return the inertia tensor (3, 3), kg m^2. Raises ValueError if moments are mixed with matrix rows."""
    given = np.array(inertia, dtype=float)
    return np.diag(given) if given.ndim == 1 else given


class Section(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A section of the configuration, in which unknown keys are errors."""


class Aim(Section, frozen=True, kw_only=True):
    """The values that describe a pointing goal.

    The goal `inertial` requires `quaternion` (ICRS to body, scalar last), and `ground` requires latitude and
    longitude. For the goal `object`, right ascension and declination give the direction of the search. If
    `roll_deg` is omitted, the roll angle is free.
    """

    quaternion: Quaternion | None = None
    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    right_ascension_deg: Longitude | None = None
    declination_deg: Latitude | None = None
    roll_deg: Longitude | None = None

    def target_at(self, goal: str) -> PointingTarget:
        """Return the pointing target for a goal.

        Raises UsageError for a missing value, and for a value of another goal.
        """
        angles = (self.latitude_deg, self.longitude_deg, self.right_ascension_deg, self.declination_deg)
        numbers = tuple(math.radians(value) for value in angles if value is not None)
        roll = None if self.roll_deg is None else math.radians(self.roll_deg)
        return PointingTarget(Goal.named(goal), (*numbers, *(self.quaternion or ())), roll)


def check_aim(dotted: str, aim: Aim, goal: str | None, refuse: Callable[[str, str], None]) -> None:
    """Report missing values, values of other goals, and values without a goal through `refuse`."""
    for owner, names in _OWN.items():
        needed = owner == goal and (
            owner != "object" or any(getattr(aim, name) is not None for name in names)
        )
        for name in names:
            given = getattr(aim, name) is not None
            if given and goal != owner:
                refuse(f"{dotted}.{name}", f"belongs to `point: {owner}`, not to {goal or 'this command'}")
            if not given and needed:
                refuse(f"{dotted}.point", f"is {goal}: needs `{name}`")
    if aim.roll_deg is not None and (goal is None or Goal.named(goal) in ROLLS):
        refuse(f"{dotted}.roll_deg", ROLLS[Goal.named(goal)] if goal else "belongs to `point`")
    if aim.quaternion is not None and abs(math.hypot(*aim.quaternion) - 1.0) > _LENGTH_ERROR:
        length = math.hypot(*aim.quaternion)
        refuse(f"{dotted}.quaternion", f"has length {length:.6g}: a quaternion must have length 1")
