"""Modes of the satellite, with their names in packets, commands and configurations."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """Mode of the satellite; the values are those of the mode packet."""

    BOOT = 0
    """The coils are at zero until the devices deliver valid data."""
    SAFE = 1
    """The testbed's coils are at zero. A satellite detumbles and turns to the Sun by its solar strings."""
    DETUMBLE = 2
    """The coils reduce the rate by the magnetometer alone."""
    HOLD = 3
    """The body holds an attitude."""
    SLEW = 4
    """The body slews to a commanded attitude."""
    TESTBED_DEMO = 5
    """The testbed flies the configured steps."""
    ACQUIRE = 6
    """The coils are at zero while the attitude of the slowly rotating body is determined."""
    SUN = 7
    """The satellite points to the Sun."""
    POINT = 8
    """The satellite points to the configured targets or to a commanded one."""

    @property
    def label(self) -> str:
        """The mode's name for people, configurations and commands."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def named(cls, label: str) -> Mode:
        """Return the mode of a label. Raises ValueError for an unknown label."""
        for mode in cls:
            if mode.label == label:
                return mode
        raise ValueError(f"{label!r} is not a mode: use {', '.join(mode.label for mode in cls)}")


COMMANDABLE = (Mode.SAFE, Mode.DETUMBLE, Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO, Mode.SUN, Mode.POINT)
"""The modes that can be commanded; BOOT ends by itself, and detumbling leads to ACQUIRE."""

POINTING = frozenset({Mode.SUN, Mode.POINT})
"""The modes of a satellite that knows its attitude."""

ORBITAL = POINTING | {Mode.ACQUIRE}
"""The modes of a body that must acquire its attitude."""

STEERING = POINTING | {Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO}
"""The modes in which planner and controller rotate the body."""
