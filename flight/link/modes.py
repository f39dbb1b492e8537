"""The modes: what the satellite does, as packets, commands and configurations name it."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """What the satellite is doing; the values are those of the mode packet."""

    BOOT = 0
    """Coils at zero until the devices give good data."""
    SAFE = 1
    """Listening, coils at zero; a satellite is braked and turns to the Sun by its solar strings."""
    DETUMBLE = 2
    """The magnetometer's B-dot takes the rate out."""
    HOLD = 3
    """Keeps an attitude."""
    SLEW = 4
    """On the way to a commanded attitude."""
    TESTBED_DEMO = 5
    """Flies the configured steps."""
    ACQUIRE = 6
    """Coils at zero: the body turns slowly, and its attitude is not known yet."""
    SUN = 7
    """Points to the Sun."""
    POINT = 8
    """Points to the targets of the configuration, or to a commanded one."""

    @property
    def label(self) -> str:
        """The mode's name for people, configurations and commands."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def named(cls, label: str) -> Mode:
        """Return the mode of a label. Raises ValueError for a word that is none."""
        for mode in cls:
            if mode.label == label:
                return mode
        raise ValueError(f"{label!r} is no mode: {', '.join(mode.label for mode in cls)}")


COMMANDABLE = (Mode.SAFE, Mode.DETUMBLE, Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO, Mode.SUN, Mode.POINT)
"""The modes that can be commanded; BOOT ends by itself, and detumbling leads to ACQUIRE."""

POINTING = frozenset({Mode.SUN, Mode.POINT})
"""The modes of a satellite that knows its attitude."""

ORBITAL = POINTING | {Mode.ACQUIRE}
"""The modes of a body that must acquire its attitude."""

STEERING = POINTING | {Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO}
"""The modes in which planner and controller turn the body."""
