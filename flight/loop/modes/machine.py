"""The state machine of the modes."""

from __future__ import annotations

from dataclasses import dataclass

from flight.link.modes import Mode
from flight.loop.modes.table import TRANSITIONS, Answer, Table, check
from flight.loop.modes.triggers import Trigger


@dataclass(frozen=True, slots=True)
class Change:
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

    def answer(self, trigger: Trigger) -> Mode | Answer:
        """Return what `trigger` would do now."""
        return self._table[self.mode][trigger]

    def fire(self, trigger: Trigger, now_ns: int) -> Change | None:
        """Follow the table; return the change, None when the mode stays or the trigger is refused."""
        after = self.answer(trigger)
        if isinstance(after, Answer):
            return None
        change = Change(self.mode, after, trigger)
        self.mode, self.since_ns = after, now_ns
        return change
