"""The transition table: the result of every trigger in every mode.

`Answer.STAY` is for a trigger without effect in that mode, `Answer.REFUSE` for a command that is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from flight.link.modes import Mode
from flight.loop.modes.triggers import COMMANDS, KNOWN, SAFING, STARTS, Trigger
from knightcube.errors import FlightError


class Answer(Enum):
    """The result of a trigger that changes no mode."""

    STAY = "stays"
    REFUSE = "is refused"


Row = Mapping[Trigger, Mode | Answer]
Table = Mapping[Mode, Row]

_COMMANDED: Row = {trigger: mode for mode, trigger in COMMANDS.items()}
_STARTED: Row = dict.fromkeys(STARTS.values(), Answer.STAY)
_ACQUIRED: Row = dict.fromkeys((*KNOWN.values(), Trigger.LOST), Answer.STAY)
_POINTING: Row = {  # a new target is approached from the present attitude
    **_STARTED,
    **_COMMANDED,
    **_ACQUIRED,
    Trigger.LOST: Mode.ACQUIRE,
    Trigger.REACT_SAFE: Mode.SAFE,
    Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
    Trigger.REACT_HOLD: Answer.STAY,
    Trigger.DETUMBLED: Answer.STAY,
    Trigger.SLOWED: Answer.STAY,
    Trigger.ARRIVED: Answer.STAY,
}

TRANSITIONS: Table = {
    Mode.BOOT: {
        **{trigger: mode for mode, trigger in STARTS.items()},
        **dict.fromkeys(COMMANDS.values(), Answer.REFUSE),
        **_ACQUIRED,
        Trigger.COMMAND_SAFE: Mode.SAFE,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Answer.STAY,
        Trigger.REACT_HOLD: Answer.STAY,
        Trigger.DETUMBLED: Answer.STAY,
        Trigger.SLOWED: Answer.STAY,
        Trigger.ARRIVED: Answer.STAY,
    },
    Mode.SAFE: {  # left by command only; the way to pointing leads through the acquisition
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.COMMAND_SUN: Mode.ACQUIRE,
        Trigger.COMMAND_POINT: Mode.ACQUIRE,
        Trigger.COMMAND_SAFE: Answer.STAY,
        Trigger.REACT_SAFE: Answer.STAY,
        Trigger.REACT_DETUMBLE: Answer.STAY,
        Trigger.REACT_HOLD: Answer.STAY,
        Trigger.DETUMBLED: Answer.STAY,
        Trigger.SLOWED: Answer.STAY,
        Trigger.ARRIVED: Answer.STAY,
    },
    Mode.DETUMBLE: {  # commanded to point it does so once its rate is low and its attitude known
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.COMMAND_SUN: Answer.STAY,
        Trigger.COMMAND_POINT: Answer.STAY,
        Trigger.COMMAND_DETUMBLE: Answer.STAY,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Answer.STAY,
        Trigger.REACT_HOLD: Answer.STAY,
        Trigger.DETUMBLED: Mode.HOLD,
        Trigger.SLOWED: Mode.ACQUIRE,
        Trigger.ARRIVED: Answer.STAY,
    },
    Mode.HOLD: {  # commanded again it keeps the attitude of that moment
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: Answer.STAY,
        Trigger.DETUMBLED: Answer.STAY,
        Trigger.SLOWED: Answer.STAY,
        Trigger.ARRIVED: Answer.STAY,
    },
    Mode.SLEW: {  # commanded again it goes to the new target
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: Mode.HOLD,
        Trigger.DETUMBLED: Answer.STAY,
        Trigger.SLOWED: Answer.STAY,
        Trigger.ARRIVED: Mode.HOLD,
    },
    Mode.TESTBED_DEMO: {  # without a plan it holds the attitude, and continues with the next plan
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        Trigger.COMMAND_DEMO: Answer.STAY,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: Answer.STAY,
        Trigger.DETUMBLED: Answer.STAY,
        Trigger.SLOWED: Answer.STAY,
        Trigger.ARRIVED: Answer.STAY,
    },
    Mode.ACQUIRE: {
        **_STARTED,
        **_COMMANDED,
        **_ACQUIRED,
        **{trigger: mode for mode, trigger in KNOWN.items()},
        Trigger.COMMAND_SUN: Answer.STAY,
        Trigger.COMMAND_POINT: Answer.STAY,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
        Trigger.REACT_HOLD: Answer.STAY,
        Trigger.DETUMBLED: Answer.STAY,
        Trigger.SLOWED: Answer.STAY,
        Trigger.ARRIVED: Answer.STAY,
    },
    Mode.SUN: {**_POINTING, Trigger.COMMAND_SUN: Answer.STAY},
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
            if row[trigger] is not Mode.SAFE and not (mode is Mode.SAFE and row[trigger] is Answer.STAY):
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
