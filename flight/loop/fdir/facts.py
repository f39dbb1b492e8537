"""The table of facts: conditions that monitors update, their persistence, and the events they raise.

As in NASA's Limit Checker, a fact counts after N violations in a row; an unknown state (None) changes no
count. A latching fact stays until it is cleared by command. A mode in which a fact is not watched resets its
count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from flight.link import events
from flight.link.events import EventKind, Reaction
from flight.link.modes import STEERING, Mode
from flight.loop.fdir.event_log import EventLog
from knightcube.errors import FlightError

EVERYWHERE = frozenset(Mode)
_DRIVEN = STEERING | {Mode.DETUMBLE}


@dataclass(frozen=True, slots=True)
class Fact:
    """One row: a fact's persistence, and the events that report its begin and end.

    Facts of the 40 Hz cycle count cycles, the others count runs of the health task.

    Attributes:
        after: updates in a row in which the condition holds, until the fact counts.
        mended_after: updates in a row in which the condition does not hold, until the fact ends.
        latching: the fact ends only when cleared by command.
        modes: in which the fact is watched.
    """

    name: str
    begins: EventKind
    ends: EventKind | None = None
    after: int = 1
    mended_after: int = 1
    latching: bool = False
    modes: frozenset[Mode] = EVERYWHERE


BOOT_WAITS = Fact("boot-waits", events.BOOT_WAITS, modes=frozenset({Mode.BOOT}))
TASK_FAILING = Fact("task-failing", events.TASK_FAILING, latching=True)
NO_PROGRESS = Fact("no-progress", events.NO_PROGRESS)
IMU_SILENT = Fact("imu-silent", events.IMU_SILENT, events.IMU_RECOVERED)
IMU_UNUSABLE = Fact("imu-unusable", events.IMU_UNUSABLE, events.IMU_RECOVERED)
IMU_LINE_LOST = Fact("imu-line-lost", events.IMU_LINE_LOST, events.IMU_RECOVERED)
CONTROL_LOST = Fact("control-lost", events.CONTROL_LOST, events.CONTROL_REGAINED)
BLIND = Fact("blind", events.BLIND, modes=_DRIVEN)
TUMBLING = Fact("tumbling", events.TUMBLING, after=8, modes=STEERING | {Mode.ACQUIRE})
HOLD_IMPOSSIBLE = Fact(
    "hold-impossible", events.HOLD_IMPOSSIBLE, modes=frozenset({Mode.HOLD, Mode.TESTBED_DEMO})
)
SLEW_LATE = Fact("slew-late", events.SLEW_LATE, modes=frozenset({Mode.SLEW}))
HOLDING = Fact("holding", events.HOLDING, modes=frozenset({Mode.SLEW, Mode.TESTBED_DEMO}))
COIL_FAULT = Fact("coil-fault", events.COIL_FAULT, events.COIL_RECOVERED)
COIL_X_BROKEN, COIL_Y_BROKEN, COIL_Z_BROKEN = (
    Fact(f"coil-{axis}-broken", events.COIL_BROKEN, latching=True) for axis in "xyz"
)
COIL_SUSPECT = Fact("coil-suspect", events.COIL_SUSPECT)
COMMANDS_DOUBTED = Fact("commands-doubted", events.COMMANDS_DOUBTED, events.COMMANDS_TRUSTED)
POWER_DOUBTED = Fact("power-doubted", events.POWER_DOUBTED)
POWER_FAULT = Fact("power-fault", events.POWER_FAULT, events.POWER_RECOVERED)
CAMERA_LOST = Fact("camera-lost", events.CAMERA_LOST, events.CAMERA_RECOVERED)
LOG_FAULT = Fact("log-fault", events.LOG_FAULT, events.LOG_RECOVERED)
CPU_HIGH = Fact("cpu-high", events.CPU_HIGH, events.RESOURCE_NORMAL, after=3, mended_after=3)
MEMORY_GROWS = Fact("memory-grows", events.MEMORY_GROWS, events.RESOURCE_NORMAL, after=3, mended_after=3)
MEMORY_HIGH = Fact("memory-high", events.MEMORY_HIGH, after=3)
DISK_LOW = Fact("disk-low", events.DISK_LOW, events.RESOURCE_NORMAL, after=2, mended_after=2)
HOT = Fact("hot", events.HOT, events.RESOURCE_NORMAL, after=2, mended_after=2)
TOO_HOT = Fact("too-hot", events.TOO_HOT, after=2, latching=True)
IMU_POOR, FIELD_POOR, COILS_POOR, POWER_POOR, CAMERA_POOR = (
    Fact(f"{stream}-poor", events.STREAM_POOR, events.STREAM_GOOD, after=4, mended_after=8)
    for stream in ("imu", "field", "coils", "power", "camera")
)
SERVICE_FAILING = Fact("service-failing", events.SERVICE_FAILING, events.SERVICE_RECOVERED)
CAMERA_LATE = Fact("camera-late", events.CAMERA_LATE, events.CAMERA_RECOVERED)
VISION_SLOW = Fact("vision-slow", events.VISION_SLOW)
GPS_LOST = Fact("gps-lost", events.GPS_LOST, events.GPS_RECOVERED)
GPS_POOR = Fact("gps-poor", events.STREAM_POOR, events.STREAM_GOOD, after=4, mended_after=8)
STRINGS_LOST = Fact("strings-lost", events.STRINGS_LOST, events.STRINGS_RECOVERED)
SUN_UNCLEAR = Fact("sun-unclear", events.SUN_UNCLEAR, events.SUN_CLEAR, after=3, mended_after=3)
CLOCK_OFF = Fact("clock-off", events.CLOCK_OFF, after=2)
FIELD_REFUSED = Fact("field-refused", events.FIELD_REFUSED, events.FIELD_TRUSTED)
WIDE_LOST = Fact("wide-lost", events.WIDE_LOST, events.WIDE_RECOVERED)
WIDE_FALSE = Fact("wide-false", events.WIDE_FALSE, events.WIDE_TRUSTED, after=3)

FACTS: tuple[Fact, ...] = tuple(value for value in dict(vars()).values() if isinstance(value, Fact))


def check(facts: Iterable[Fact], modes_of: Callable[[Reaction], frozenset[Mode]]) -> None:
    """Validate the table; raises FlightError naming the row.

    `modes_of` returns the modes in which a reaction has an effect: a fact watched in none of them is useless.
    """
    seen: set[str] = set()
    for fact in facts:
        if fact.name in seen:
            raise FlightError(f"fact {fact.name} stands twice in the table")
        seen.add(fact.name)
        if fact.after < 1 or fact.mended_after < 1:
            raise FlightError(f"fact {fact.name}: a count of statements must be at least 1")
        if not fact.modes & modes_of(fact.begins.reaction):
            raise FlightError(
                f"fact {fact.name}: in no mode in which it is watched does its reaction "
                f"{fact.begins.reaction.name.lower()} do anything"
            )


@dataclass(slots=True)
class _State:
    holds: bool = False
    count: int = 0


class Facts:
    """Holds the state of every fact, and reports an event when a fact begins or ends."""

    def __init__(self, event_log: EventLog) -> None:
        self._events = event_log
        self._states = {fact.name: _State() for fact in FACTS}
        self._mode = Mode.BOOT

    def update(self, fact: Fact, holds: bool | None, now_ns: int, text: str) -> None:
        """Update whether a fact's condition holds now, None when unknown. `text` goes with the event."""
        state = self._states[fact.name]
        if holds is None or self._mode not in fact.modes:
            return
        if holds == state.holds:
            state.count = 0
            return
        state.count += 1
        if state.holds and (fact.latching or state.count < fact.mended_after):
            return
        if not state.holds and state.count < fact.after:
            return
        state.holds, state.count = holds, 0
        kind = fact.begins if holds else fact.ends
        if kind is not None:
            self._events.report(kind, now_ns, text)

    def holds(self, fact: Fact) -> bool:
        """Return whether a fact counts now."""
        return self._states[fact.name].holds

    def held(self) -> tuple[Fact, ...]:
        """Return the facts that count now, in the order of the table."""
        return tuple(fact for fact in FACTS if self._states[fact.name].holds)

    def clear(self, event_name: str) -> bool:
        """Reset the facts latched under an event's name; return whether there were any."""
        found = [fact for fact in self.held() if fact.latching and fact.begins.name == event_name]
        for fact in found:
            self._states[fact.name] = _State()
        return bool(found)

    def enter(self, mode: Mode) -> None:
        """Watch the facts of `mode`; reset the others."""
        self._mode = mode
        for fact in FACTS:
            if mode not in fact.modes:
                self._states[fact.name] = _State()
