"""The state machine of the satellite's modes: triggers, transition table and machine.

The table holds the result of every trigger in every mode. `TriggerAnswer.STAY` is for a trigger without
effect in that mode, `TriggerAnswer.REFUSE` for a command that is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from flight.link.modes import Mode
from knightcube.errors import FlightError


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


class TriggerAnswer(Enum):
    """The result of a trigger that changes no mode."""

    STAY = "stays"
    REFUSE = "is refused"


Row = Mapping[Trigger, Mode | TriggerAnswer]
Table = Mapping[Mode, Row]

_COMMANDED: Row = {trigger: mode for mode, trigger in COMMANDS.items()}
_STARTED: Row = dict.fromkeys(STARTS.values(), TriggerAnswer.STAY)
_ACQUIRED: Row = dict.fromkeys((*KNOWN.values(), Trigger.LOST), TriggerAnswer.STAY)
_POINTING: Row = {  # a new target is approached from the present attitude
    **_STARTED,
    **_COMMANDED,
    **_ACQUIRED,
    Trigger.LOST: Mode.ACQUIRE,
    Trigger.REACT_SAFE: Mode.SAFE,
    Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
    Trigger.REACT_HOLD: TriggerAnswer.STAY,
    Trigger.DETUMBLED: TriggerAnswer.STAY,
    Trigger.SLOWED: TriggerAnswer.STAY,
    Trigger.ARRIVED: TriggerAnswer.STAY,
}

TRANSITIONS: Table = {
    Mode.BOOT: {
        **{trigger: mode for mode, trigger in STARTS.items()},
        **dict.fromkeys(COMMANDS.values(), TriggerAnswer.REFUSE),
        **_ACQUIRED,
        Trigger.COMMAND_SAFE: Mode.SAFE,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
        Trigger.REACT_HOLD: TriggerAnswer.STAY,
        Trigger.DETUMBLED: TriggerAnswer.STAY,
        Trigger.SLOWED: TriggerAnswer.STAY,
        Trigger.ARRIVED: TriggerAnswer.STAY,
    },
    Mode.SAFE: {  # left by command only; the way to pointing leads through the acquisition
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.COMMAND_SUN: Mode.ACQUIRE,
        Trigger.COMMAND_POINT: Mode.ACQUIRE,
        Trigger.COMMAND_SAFE: TriggerAnswer.STAY,
        Trigger.REACT_SAFE: TriggerAnswer.STAY,
        Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
        Trigger.REACT_HOLD: TriggerAnswer.STAY,
        Trigger.DETUMBLED: TriggerAnswer.STAY,
        Trigger.SLOWED: TriggerAnswer.STAY,
        Trigger.ARRIVED: TriggerAnswer.STAY,
    },
    Mode.DETUMBLE: {  # commanded to point it does so once its rate is low and its attitude known
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.COMMAND_SUN: TriggerAnswer.STAY,
        Trigger.COMMAND_POINT: TriggerAnswer.STAY,
        Trigger.COMMAND_DETUMBLE: TriggerAnswer.STAY,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
        Trigger.REACT_HOLD: TriggerAnswer.STAY,
        Trigger.DETUMBLED: Mode.HOLD,
        Trigger.SLOWED: Mode.ACQUIRE,
        Trigger.ARRIVED: TriggerAnswer.STAY,
    },
    Mode.HOLD: {  # commanded again it keeps the attitude of that moment
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: TriggerAnswer.STAY,
        Trigger.DETUMBLED: TriggerAnswer.STAY,
        Trigger.SLOWED: TriggerAnswer.STAY,
        Trigger.ARRIVED: TriggerAnswer.STAY,
    },
    Mode.SLEW: {  # commanded again it goes to the new target
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: Mode.HOLD,
        Trigger.DETUMBLED: TriggerAnswer.STAY,
        Trigger.SLOWED: TriggerAnswer.STAY,
        Trigger.ARRIVED: Mode.HOLD,
    },
    Mode.TESTBED_DEMO: {  # without a plan it holds the attitude, and continues with the next plan
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.COMMAND_DEMO: TriggerAnswer.STAY,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: TriggerAnswer.STAY,
        Trigger.DETUMBLED: TriggerAnswer.STAY,
        Trigger.SLOWED: TriggerAnswer.STAY,
        Trigger.ARRIVED: TriggerAnswer.STAY,
    },
    Mode.ACQUIRE: {
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        **{trigger: mode for mode, trigger in KNOWN.items()},
        Trigger.COMMAND_SUN: TriggerAnswer.STAY,
        Trigger.COMMAND_POINT: TriggerAnswer.STAY,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: TriggerAnswer.STAY,
        Trigger.DETUMBLED: TriggerAnswer.STAY,
        Trigger.SLOWED: TriggerAnswer.STAY,
        Trigger.ARRIVED: TriggerAnswer.STAY,
    },
    Mode.SUN: {**_POINTING, Trigger.COMMAND_SUN: TriggerAnswer.STAY},
    Mode.POINT: _POINTING,
}


def check(table: Table) -> None:
    """Validate a table; raises FlightError naming the first error."""
    for mode in Mode:
        row = table.get(mode)
        if row is None:
            raise FlightError(f"mode table: {mode.label} has no row")
        for trigger in Trigger:
            if trigger not in row:
                raise FlightError(f"mode table: {mode.label} has no answer to {trigger.value!r}")
        for trigger in SAFING:
            if row[trigger] is not Mode.SAFE and not (
                mode is Mode.SAFE and row[trigger] is TriggerAnswer.STAY
            ):
                raise FlightError(f"mode table: {trigger.value!r} does not lead from {mode.label} to safe")
        if not any(isinstance(to, Mode) and to is not mode for to in row.values()):
            raise FlightError(f"mode table: {mode.label} is a dead end")
        if mode is not Mode.BOOT and Mode.BOOT in row.values():
            raise FlightError(f"mode table: {mode.label} leads back to boot, which is for the start only")
    lost = set(Mode) - _reachable(table, Mode.BOOT)
    if lost:
        raise FlightError(f"mode table: {min(lost).label} cannot be reached from boot")


def _reachable(table: Table, start: Mode) -> set[Mode]:
    """Return the modes that some sequence of triggers leads to."""
    found, ahead = {start}, [start]
    while ahead:
        for to in table[ahead.pop()].values():
            if isinstance(to, Mode) and to not in found:
                found.add(to)
                ahead.append(to)
    return found


@dataclass(frozen=True, slots=True)
class ModeChange:
    """A transition from one mode to another, or to the same mode again."""

    before: Mode
    after: Mode
    trigger: Trigger


class ModeMachine:
    """Holds the mode and follows the table; without side effects. `since_ns`: when the mode was entered."""

    def __init__(self, time_ns: int = 0, table: Table = TRANSITIONS) -> None:
        """Begin in BOOT. Raises FlightError for an invalid table."""
        check(table)
        self._table = table
        self.mode = Mode.BOOT
        self.since_ns = time_ns

    def answer(self, trigger: Trigger) -> Mode | TriggerAnswer:
        """Return what `trigger` would do now."""
        return self._table[self.mode][trigger]

    def fire(self, trigger: Trigger, now_ns: int) -> ModeChange | None:
        """Follow the table; return the change, None when the mode stays or the trigger is refused."""
        after = self.answer(trigger)
        if isinstance(after, TriggerAnswer):
            return None
        change = ModeChange(self.mode, after, trigger)
        self.mode, self.since_ns = after, now_ns
        return change
