"""Pointing targets of a satellite, which a configuration or a command can set.

A target is an immutable value, which is used in configurations, packets and planning jobs. The module
`attitude_law` computes the attitude law of a target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from knightcube.astro.arrays import brief, check_numbers
from knightcube.errors import UsageError

_ROUNDING = 1e-9  # largest rounding error (rad) of an angle that was converted from degrees
_LENGTH = 1e-3
"""Largest accepted difference between the length of a commanded quaternion and one."""


class Goal(IntEnum):
    """The pointing goals, with their numerical values in the command packet.

    The goals NADIR, VELOCITY and SUN have no arguments, INERTIAL has a quaternion, GROUND has latitude and
    longitude, and OBJECT has no arguments or right ascension and declination.
    """

    NADIR = 0
    VELOCITY = 1
    SUN = 2
    INERTIAL = 3
    GROUND = 4
    OBJECT = 5

    @property
    def label(self) -> str:
        """Name of the pointing goal in messages, configurations and commands."""
        return self.name.lower()

    @classmethod
    def named(cls, label: str) -> Goal:
        """Return the pointing goal with the name `label`. Raises UsageError for an unknown name."""
        for goal in cls:
            if isinstance(label, str) and goal.label == label:
                return goal
        raise UsageError(
            f"{brief(label)} is not a pointing goal: choose one of {', '.join(goal.label for goal in cls)}"
        )


NUMBERS = {Goal.INERTIAL: (4,), Goal.GROUND: (2,), Goal.OBJECT: (0, 2)}
"""Permitted numbers of arguments of each goal that has arguments; the largest number is the last."""
_RIGHT = 0.5 * math.pi
ARGUMENTS: Mapping[Goal, tuple[tuple[str, str, float, float], ...]] = {
    Goal.INERTIAL: tuple((f"quaternion {axis}", "-", -1.0, 1.0) for axis in "xyzw"),
    Goal.GROUND: (("latitude", "rad", -_RIGHT, _RIGHT), ("longitude", "rad", -math.pi, 2.0 * math.pi)),
    Goal.OBJECT: (("right ascension", "rad", 0.0, 2.0 * math.pi), ("declination", "rad", -_RIGHT, _RIGHT)),
}
"""Name, unit, minimum and maximum of each argument of the goals that have arguments, for forms and
documents."""
ROLLS = {
    Goal.INERTIAL: "an inertial attitude includes its roll: omit the roll",
    Goal.OBJECT: "an object is tracked with a free roll: omit the roll",
}
"""Goals for which a roll cannot be given, each with the reason."""


@dataclass(frozen=True, slots=True)
class PointingTarget:
    """A pointing goal with its numerical arguments and its roll.

    Attributes:
        goal: what to point at.
        numbers: numerical arguments of the goal. The goal INERTIAL has an attitude quaternion (4,) from ICRS
            into body axes. The goal GROUND has latitude and longitude, rad. The goal OBJECT has right
            ascension and declination, rad, of the field to search, or no arguments for the present field of
            view. Goals other than INERTIAL, GROUND and OBJECT have no arguments.
        roll: rotation about the pointing axis, rad, or None if free; always None for the goals in `ROLLS`.
    """

    goal: Goal
    numbers: tuple[float, ...] = ()
    roll: float | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for arguments that do not define an attitude."""
        if not isinstance(self.goal, Goal):
            raise UsageError(
                f"the goal of a pointing target is {brief(self.goal)}: give one of "
                + ", ".join(f"Goal.{goal.name}" for goal in Goal)
            )
        try:  # a tuple, because a list or an array could be changed later
            object.__setattr__(self, "numbers", tuple(map(float, self.numbers)))
        except (TypeError, ValueError, OverflowError):
            text = f"{self.goal.label}: {brief(self.numbers)}: give a sequence of numbers"
            raise UsageError(text) from None
        roll: object = self.roll
        if roll is not None and not isinstance(roll, float):
            check_numbers(roll=roll)
        wanted = NUMBERS.get(self.goal, (0,))
        if len(self.numbers) not in wanted:
            counts = " or ".join(map(str, wanted))
            names = ", ".join(name for name, *_ in ARGUMENTS.get(self.goal, ()))
            which = f": {names}" if names else ""
            raise UsageError(f"{self.goal.label} takes {counts} numbers, not {len(self.numbers)}{which}")
        if not all(map(math.isfinite, (*self.numbers, self.roll or 0.0))):
            raise UsageError(f"{self.goal.label}: numbers and roll must be finite")
        if self.goal is Goal.INERTIAL:
            length = math.hypot(*self.numbers)
            if abs(length - 1.0) > _LENGTH:
                raise UsageError(f"the quaternion has length {length:.6g}: it must have length 1")
        if self.roll is not None and self.goal in ROLLS:
            raise UsageError(ROLLS[self.goal])
        if self.goal is Goal.GROUND and not abs(self.numbers[0]) <= _RIGHT:
            raise UsageError(f"latitude {math.degrees(self.numbers[0]):g} deg: must be -90 to 90 deg")
        if self.goal is Goal.OBJECT and self.numbers and not abs(self.numbers[1]) <= _RIGHT:
            raise UsageError(f"declination {math.degrees(self.numbers[1]):g} deg: must be -90 to 90 deg")
        self._check_angles()

    def _check_angles(self) -> None:
        """Raise UsageError for an angle of more than a revolution, such as a mistyped value."""
        angles = () if self.goal is Goal.INERTIAL or not self.numbers else ARGUMENTS.get(self.goal, ())
        named = dict(zip((name for name, *_ in angles), self.numbers, strict=False))
        for name, value in (named | {"roll": self.roll or 0.0}).items():
            if abs(value) > 2.0 * math.pi + _ROUNDING:
                raise UsageError(f"{name} {math.degrees(value):g} deg must lie within -360 to 360 deg")

    @property
    def text(self) -> str:
        """Description of the pointing target for event messages."""
        text = self.goal.label
        if self.goal is Goal.GROUND:
            text += " latitude {:.4f}, longitude {:.4f} deg".format(*map(math.degrees, self.numbers))
        elif self.goal is Goal.INERTIAL:
            return text + " {:.4f} {:.4f} {:.4f} {:.4f}".format(*self.numbers)
        elif self.goal is Goal.OBJECT:
            near = " near RA {:.4f}, Dec {:.4f} deg"
            return text + (near.format(*map(math.degrees, self.numbers)) if self.numbers else "")
        return text + (", roll free" if self.roll is None else f", roll {math.degrees(self.roll):g} deg")


SUN = PointingTarget(Goal.SUN)
