"""The triggers that lead from one mode to another."""

from __future__ import annotations

from enum import Enum

from flight.link.modes import Mode


class Trigger(Enum):
    """What may change the mode: the end of the boot, a command, a reaction, or an achievement."""

    START_SAFE = "start in safe"
    START_DETUMBLE = "start in detumble"
    START_HOLD = "start in hold"
    START_DEMO = "start in testbed-demo"
    COMMAND_SAFE = "commanded safe"
    COMMAND_DETUMBLE = "commanded detumble"
    COMMAND_HOLD = "commanded hold"
    COMMAND_SLEW = "commanded slew"
    COMMAND_DEMO = "commanded testbed-demo"
    COMMAND_SUN = "commanded sun"
    COMMAND_POINT = "commanded point"
    REACT_SAFE = "reaction safe"
    REACT_DETUMBLE = "reaction detumble"
    REACT_HOLD = "reaction hold"
    DETUMBLED = "rate is low"
    SLOWED = "rate is low, attitude unknown"
    ARRIVED = "arrived"
    KNOWN_SUN = "attitude known, to the sun"
    KNOWN_POINT = "attitude known"
    LOST = "attitude lost"


STARTS = {
    Mode.SAFE: Trigger.START_SAFE,
    Mode.DETUMBLE: Trigger.START_DETUMBLE,
    Mode.HOLD: Trigger.START_HOLD,
    Mode.TESTBED_DEMO: Trigger.START_DEMO,
}
"""The trigger that ends the boot, for each mode that can be configured."""

COMMANDS = {
    Mode.SAFE: Trigger.COMMAND_SAFE,
    Mode.DETUMBLE: Trigger.COMMAND_DETUMBLE,
    Mode.HOLD: Trigger.COMMAND_HOLD,
    Mode.SLEW: Trigger.COMMAND_SLEW,
    Mode.TESTBED_DEMO: Trigger.COMMAND_DEMO,
    Mode.SUN: Trigger.COMMAND_SUN,
    Mode.POINT: Trigger.COMMAND_POINT,
}
"""The trigger of a command for each mode; BOOT and ACQUIRE cannot be commanded."""

KNOWN = {Mode.SUN: Trigger.KNOWN_SUN, Mode.POINT: Trigger.KNOWN_POINT}
"""The trigger that ends the acquisition, for each mode that may follow."""

SAFING = (Trigger.COMMAND_SAFE, Trigger.REACT_SAFE)
"""The triggers that must lead to SAFE from every mode."""
