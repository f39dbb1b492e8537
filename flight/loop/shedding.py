"""Load shedding: when the work of a flight exceeds its processor, the least important work is reduced first.

Control cycles, safety, telemetry and commands are never reduced. All other work is reduced step by step, in
the order of `LEVELS`: readings of the inertial unit that arrive more often than control cycles, then the
search for objects, then frames of the star camera, then periodic plans. A plan that is not renewed stays in
force, and its final attitude is held after its end. Plans for a new target, or after a loss of control, are
always made.

Overload is recognised by its signs: lost control cycles, frames that arrive while the worker is busy or whose
processing takes too long, and plans that take too long. Each raise of the level reduces more work. The level
falls when no sign was seen for some time. If the signs return after a fall, the next fall is later, so that
the level does not oscillate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from flight.link import events
from flight.link.telemetry.definitions import WORKLOAD
from flight.loop.facts import Services
from hal.interfaces.wires import SECOND_NS


@dataclass(frozen=True, slots=True)
class ShedLevel:
    """Reduced work of a level.

    Attributes:
        every_reading: whether all readings of the inertial unit are used, not the newest of each cycle alone.
        search: whether frames are searched for objects.
        frame_every: number of due exposures of the star camera of which one is made.
        plan_every: number of due periodic plans of which one is made.
        text: description of the reduced work for events.
    """

    every_reading: bool
    search: bool
    frame_every: int
    plan_every: int
    text: str


_NEWEST = "1 reading of the inertial unit per control cycle"
LEVELS: tuple[ShedLevel, ...] = (
    ShedLevel(True, True, 1, 1, "all work is done"),
    ShedLevel(False, True, 1, 1, _NEWEST),
    ShedLevel(False, False, 1, 1, f"{_NEWEST}, no search for objects"),
    ShedLevel(False, False, 2, 1, f"{_NEWEST}, no search for objects, 1 of 2 frames"),
    ShedLevel(False, False, 2, 2, f"{_NEWEST}, no search for objects, 1 of 2 frames and periodic plans"),
    ShedLevel(False, False, 4, 4, f"{_NEWEST}, no search for objects, 1 of 4 frames and periodic plans"),
    ShedLevel(False, False, 8, 8, f"{_NEWEST}, no search for objects, 1 of 8 frames and periodic plans"),
)
"""Levels in the order in which work is reduced."""

_WINDOW_NS = 60 * SECOND_NS
"""Time (ns) in which the signs of an overload are counted."""
_SETTLE_NS = 10 * SECOND_NS
"""Shortest time (ns) from a change of the level to the next raise, in which the change takes effect."""
_SHORTEST_QUIET_NS = 60 * SECOND_NS
_LONGEST_QUIET_NS = 960 * SECOND_NS
"""Times (ns) without a sign after which the level falls: the first one, and the last one after doublings."""


@dataclass(eq=False)
class OverloadSign:
    """A sign of overload, which a counter shows.

    Attributes:
        text: name of the sign for events.
        count: function that returns how often the sign has occurred since start.
        needed: number of occurrences within a minute that raise the level.
    """

    text: str
    count: Callable[[], int]
    needed: int
    _counted: int = 0
    _times: deque[int] = field(default_factory=deque)

    def look(self, now_ns: int) -> bool:
        """Return whether the sign occurred since the last call; several occurrences count once."""
        count = self.count()
        occurred, self._counted = count > self._counted, count
        if occurred:
            self._times.append(now_ns)
        while self._times and now_ns - self._times[0] > _WINDOW_NS:
            self._times.popleft()
        return occurred

    @property
    def is_overload(self) -> bool:
        """Whether the sign occurred often enough to raise the level."""
        return len(self._times) >= self.needed

    def forget(self) -> None:
        """Discard the occurrences before a change of the level."""
        self._times.clear()


class BusyPeriods:
    """Counts the times at which a job has been running for longer than a limit."""

    def __init__(self, busy_since_ns: Callable[[], int | None], limit_ns: int) -> None:
        """Watch the worker whose job began at `busy_since_ns`, which is None while the worker is idle."""
        self._busy_since_ns, self._limit_ns = busy_since_ns, limit_ns
        self._counted_ns = -1
        self.count = 0

    def look(self, now_ns: int) -> None:
        """Count the running job, once, if it runs for longer than the limit."""
        since_ns = self._busy_since_ns()
        if since_ns is not None and now_ns - since_ns > self._limit_ns and since_ns != self._counted_ns:
            self._counted_ns = since_ns
            self.count += 1


class Shedding:
    """Task that reduces the workers' jobs while they exceed the processor; run once a second.

    Attributes:
        plans_shed: number of periodic plans that were not made since start.
    """

    def __init__(
        self,
        signs: Sequence[OverloadSign],
        plans: BusyPeriods,
        apply: Callable[[ShedLevel], None],
        frames: Callable[[], tuple[int, int]],
        services: Services,
    ) -> None:
        """Start with all work.

        Args:
            signs: signs of overload.
            plans: counter of plans that are late.
            apply: function that makes navigation and imaging follow a level.
            frames: function that returns the numbers of frames not taken, and of frames that are late.
            services: services of the loop.
        """
        self._signs, self._plans, self._apply, self._frames = tuple(signs), plans, apply, frames
        self._recorder, self._events = services.recorder, services.events
        self._level = 0
        self._changed_ns = self._sign_ns = -_WINDOW_NS
        self._quiet_ns = _SHORTEST_QUIET_NS
        self._has_fallen = False
        self._recorded: dict[str, int] = {}
        self.plans_shed = 0

    def makes_plan(self, slot: int) -> bool:
        """Return whether the periodic plan of the time slot `slot` is made, and count it if not."""
        made = slot % LEVELS[self._level].plan_every == 0
        self.plans_shed += not made
        return made

    def run(self, lost_cycles: int, now_ns: int) -> None:
        """Judge the load, change the level by one at most, and record changes.

        The number of control cycles lost since start is `lost_cycles`.
        """
        self._plans.look(now_ns)
        seen = [sign for sign in self._signs if sign.look(now_ns)]
        if seen:
            self._sign_ns = now_ns
        found = [sign.text for sign in seen if sign.is_overload]
        since_ns = now_ns - self._changed_ns
        if found and since_ns >= _SETTLE_NS and self._level < len(LEVELS) - 1:
            if self._has_fallen:
                self._quiet_ns = min(2 * self._quiet_ns, _LONGEST_QUIET_NS)
            self._change(self._level + 1, "; ".join(found), now_ns)
        elif self._level and min(now_ns - self._sign_ns, since_ns) >= self._quiet_ns:
            self._change(self._level - 1, f"no sign of overload for {self._quiet_ns * 1e-9:g} s", now_ns)
        self._record(lost_cycles, now_ns)

    def _change(self, level: int, reason: str, now_ns: int) -> None:
        is_raised, self._level, self._changed_ns = level > self._level, level, now_ns
        self._has_fallen = not is_raised
        for sign in self._signs:
            sign.forget()
        self._apply(LEVELS[level])
        kind = events.WORK_SHED if is_raised else events.WORK_RESTORED
        self._events.report(kind, now_ns, f"level {level}, {LEVELS[level].text}: {reason}")

    def _record(self, lost_cycles: int, now_ns: int) -> None:
        """Record level and counters if one of them has changed."""
        shed, late = self._frames()
        values = {
            "level": self._level,
            "frames_shed": shed,
            "plans_shed": self.plans_shed,
            "frames_late": late,
            "plans_late": self._plans.count,
            "cycles_lost": lost_cycles,
        }
        if any(values.values()) and values != self._recorded:
            self._recorded = values
            self._recorder.record(WORKLOAD, now_ns, **values)
