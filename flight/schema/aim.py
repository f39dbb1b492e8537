"""What a target, or a command of a time line, says of where a satellite points."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal

from msgspec import Meta

from flight.schema.values import Quaternion, Section
from knightcube.gnc.guidance.three_axes.pointing_target import ROLLS, Goal, PointingTarget

GoalName = Literal["nadir", "velocity", "sun", "inertial", "ground", "object"]
OWN = {
    "inertial": ("quaternion",),
    "ground": ("latitude_deg", "longitude_deg"),
    "object": ("right_ascension_deg", "declination_deg"),
}
"""The values that belong to a goal, each of which it needs; `object` needs both or none."""
LENGTH = 1e-3
"""A quaternion may miss the unit length by this, as in a command."""


class Aim(Section, frozen=True, kw_only=True):
    """The values of a goal; without `roll_deg` the roll is free.

    `quaternion`, ICRS into body, scalar last, belongs to `inertial`; latitude and longitude to `ground`;
    right ascension and declination, where it is looked for, to `object`.
    """

    quaternion: Quaternion | None = None
    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] | None = None
    longitude_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] | None = None
    right_ascension_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] | None = None
    declination_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] | None = None
    roll_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] | None = None

    def target_at(self, goal: str) -> PointingTarget:
        """Return the target at a goal. Raises UsageError for values that do not belong to it, or lack."""
        place = (self.latitude_deg, self.longitude_deg, self.right_ascension_deg, self.declination_deg)
        numbers = tuple(math.radians(value) for value in place if value is not None)
        roll = None if self.roll_deg is None else math.radians(self.roll_deg)
        return PointingTarget(Goal.named(goal), (*numbers, *(self.quaternion or ())), roll)


def check_aim(dotted: str, aim: Aim, goal: str | None, refuse: Callable[[str, str], None]) -> None:
    """Refuse values that do not belong to the goal, or lack; without a goal, any."""
    for owner, names in OWN.items():
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
    if aim.quaternion is not None and abs(math.hypot(*aim.quaternion) - 1.0) > LENGTH:
        length = math.hypot(*aim.quaternion)
        refuse(f"{dotted}.quaternion", f"has length {length:.6g}: a quaternion must have length 1")
