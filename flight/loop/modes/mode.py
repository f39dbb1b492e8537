"""The modes, and the triggers that lead from one to another."""

from __future__ import annotations

from enum import Enum, IntEnum


class Mode(IntEnum):
    """What the satellite is doing; the values are those of the mode packet."""

    BOOT = 0
    """Coils at zero until the devices give good data."""
    SAFE = 1
    """Coils at zero, listening."""
    DETUMBLE = 2
    """The magnetometer's B-dot takes the rate out."""
    HOLD = 3
    """Keeps an attitude."""
    SLEW = 4
    """On the way to a commanded attitude."""
    TESTBED_DEMO = 5
    """Flies the configured steps."""

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


class Trigger(Enum):
    """What may change the mode: the end of the start, a command, a reaction, or something achieved."""

    START_SAFE = "start in safe"
    START_DETUMBLE = "start in detumble"
    START_HOLD = "start in hold"
    START_DEMO = "start in testbed-demo"
    COMMAND_SAFE = "commanded safe"
    COMMAND_DETUMBLE = "commanded detumble"
    COMMAND_HOLD = "commanded hold"
    COMMAND_SLEW = "commanded slew"
    COMMAND_DEMO = "commanded testbed-demo"
    REACT_SAFE = "reaction safe"
    REACT_DETUMBLE = "reaction detumble"
    REACT_HOLD = "reaction hold"
    DETUMBLED = "rate is low"
    ARRIVED = "arrived"


STARTS = {
    Mode.SAFE: Trigger.START_SAFE,
    Mode.DETUMBLE: Trigger.START_DETUMBLE,
    Mode.HOLD: Trigger.START_HOLD,
    Mode.TESTBED_DEMO: Trigger.START_DEMO,
}
"""The trigger that ends the start in each mode that can be configured."""

COMMANDS = {
    Mode.SAFE: Trigger.COMMAND_SAFE,
    Mode.DETUMBLE: Trigger.COMMAND_DETUMBLE,
    Mode.HOLD: Trigger.COMMAND_HOLD,
    Mode.SLEW: Trigger.COMMAND_SLEW,
    Mode.TESTBED_DEMO: Trigger.COMMAND_DEMO,
}
"""The trigger of a command for each mode; BOOT is not to be commanded."""

SAFING = (Trigger.COMMAND_SAFE, Trigger.REACT_SAFE)
"""What must lead to SAFE from wherever it comes."""

STEERING = frozenset({Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO})
"""The modes in which planner and controller turn the body."""
