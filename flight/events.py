"""The table of events: what can happen that a reader of the log wants to know, and how loudly.

A throttle tells the first of a kind at once and then at most one each `THROTTLE_NS`, with the number held
back: a fault at 40 Hz makes a line in the log every few seconds, not forty a second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

THROTTLE_NS = 5_000_000_000


class Severity(IntEnum):
    """How much it matters."""

    INFORMATION = 0
    WARNING = 1
    FAULT = 2


@dataclass(frozen=True, slots=True)
class EventKind:
    """One row of the table. The code is for ever; names are for people."""

    code: int
    name: str
    severity: Severity
    meaning: str


STARTED = EventKind(1, "started", Severity.INFORMATION, "the loop begins")
STOPPED = EventKind(2, "stopped", Severity.INFORMATION, "the loop ends, with the reason")
CYCLE_SLIP = EventKind(3, "cycle-slip", Severity.WARNING, "slots of a rate group were skipped")
TASK_FAILED = EventKind(4, "task-failed", Severity.FAULT, "a task of the loop raised an exception")
IMU_SILENT = EventKind(10, "imu-silent", Severity.FAULT, "no bytes come from the inertial unit")
IMU_CORRUPT = EventKind(
    11, "imu-corrupt", Severity.WARNING, "bytes come from the inertial unit that are no packets"
)
IMU_IMPLAUSIBLE = EventKind(12, "imu-implausible", Severity.WARNING, "values out of range or not finite")
IMU_LINE_LOST = EventKind(13, "imu-line-lost", Severity.FAULT, "the serial port is gone")
IMU_RECOVERED = EventKind(14, "imu-recovered", Severity.INFORMATION, "good packets come again")
IMU_UNUSABLE = EventKind(
    16, "imu-unusable", Severity.FAULT, "bytes come from the inertial unit, but no reading in them"
)
IMU_REFUSED = EventKind(
    15, "imu-refused", Severity.WARNING, "measurements disagree with the estimate and are left out"
)
CONTROL_LOST = EventKind(20, "control-lost", Severity.FAULT, "no trustworthy estimate: coils to zero")
CONTROL_REGAINED = EventKind(
    21, "control-regained", Severity.INFORMATION, "the estimate is trustworthy again"
)
COIL_FAULT = EventKind(30, "coil-fault", Severity.FAULT, "the PWM chip does not take commands")
COIL_RECOVERED = EventKind(31, "coil-recovered", Severity.INFORMATION, "the PWM chip takes commands again")
POWER_FAULT = EventKind(32, "power-fault", Severity.WARNING, "the current monitor does not answer")
POWER_RECOVERED = EventKind(33, "power-recovered", Severity.INFORMATION, "the current monitor answers again")
TARGET = EventKind(40, "target", Severity.INFORMATION, "a new attitude is commanded")
PLAN_STRETCHED = EventKind(
    41, "plan-stretched", Severity.INFORMATION, "no path within the horizon: stretched"
)
PLAN_REFUSED = EventKind(42, "plan-refused", Severity.WARNING, "a plan was not flown, with the reason")
PLANNER_BUSY = EventKind(43, "planner-busy", Severity.WARNING, "the planner has not finished the last job")
PLANNER_FAILED = EventKind(
    44, "planner-failed", Severity.WARNING, "the planner gave no plan, with the reason"
)
HOLDING = EventKind(
    45, "holding", Severity.WARNING, "the last good path has ended: holding its final attitude"
)
CAMERA_LOST = EventKind(50, "camera-lost", Severity.WARNING, "no frame has come for too long")
CAMERA_RECOVERED = EventKind(51, "camera-recovered", Severity.INFORMATION, "frames come again")
CAMERA_FROZEN = EventKind(52, "camera-frozen", Severity.WARNING, "the camera gives the same frame again")
CAMERA_BLACK = EventKind(53, "camera-black", Severity.WARNING, "the frame holds no light, or only light")
VISION_FAILED = EventKind(54, "vision-failed", Severity.WARNING, "vision gave no result, with the reason")
STREAK_REFUSED = EventKind(
    55, "streak-refused", Severity.WARNING, "a rate from streaks disagrees with the estimate"
)
STARS_REFUSED = EventKind(
    56, "stars-refused", Severity.WARNING, "the stars' attitude disagrees with the estimate"
)
LOG_FAULT = EventKind(60, "log-fault", Severity.FAULT, "the flight log cannot be written")

EVENTS: tuple[EventKind, ...] = tuple(
    value for value in dict(vars()).values() if isinstance(value, EventKind)
)

Sink = Callable[[EventKind, int, int, str], None]
"""Takes an event that is told: kind, time in ns, how many of its kind were held back before it, text."""


class EventLog:
    """Tells events to a sink, throttled by kind."""

    def __init__(self, sink: Sink, throttle_ns: int = THROTTLE_NS) -> None:
        self._sink = sink
        self._throttle_ns = throttle_ns
        self._last_told: dict[int, int] = {}
        self._held_back: dict[int, int] = {}
        self.count = 0

    def tell(self, kind: EventKind, time_ns: int, text: str) -> None:
        """Tell an event, or count it if one of its kind was told a moment ago."""
        self.count += 1
        last_ns = self._last_told.get(kind.code)
        if last_ns is not None and time_ns - last_ns < self._throttle_ns:
            self._held_back[kind.code] = self._held_back.get(kind.code, 0) + 1
            return
        self._last_told[kind.code] = time_ns
        self._sink(kind, time_ns, self._held_back.pop(kind.code, 0), text)

    def flush(self, time_ns: int) -> None:
        """Tell what is still held back, at the end."""
        by_code = {kind.code: kind for kind in EVENTS}
        for code, held_back in list(self._held_back.items()):
            self._sink(by_code[code], time_ns, held_back - 1, "the last one held back by the throttle")
        self._held_back.clear()


class Condition:
    """A state that is told when it begins and, by another kind, when it ends."""

    def __init__(self, log: EventLog, begins: EventKind, ends: EventKind | None) -> None:
        self._log = log
        self._begins = begins
        self._ends = ends
        self.holds = False

    def update(self, holds: bool, time_ns: int, text: str) -> None:
        """Tell the change, if there is one."""
        if holds and not self.holds:
            self._log.tell(self._begins, time_ns, text)
        elif self.holds and not holds and self._ends is not None:
            self._log.tell(self._ends, time_ns, text)
        self.holds = holds
