"""Modes of the satellite with their names and packet values."""

from __future__ import annotations

from enum import IntEnum


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
    """The satellite points to the configured targets or to a commanded one."""

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

STEERING = POINTING | TESTBED
"""Modes in which the planner and the controller steer the attitude."""
