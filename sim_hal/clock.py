"""Simulated time: the clock, the scheduling of emulated devices, and a queue of timed actions.

A sleep on the simulated clock advances the world to the deadline and returns at once. All due periodic jobs
(tickers) are run one after the other, in the order of their creation, so that a repeated flight is identical
to the bit. A job that sleeps, such as a driver that waits for its chip, advances the world, but other
periodic jobs do not run during this sleep.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Sequence
from typing import Protocol

from hal.buses.system import ContainedJob
from hal.interfaces.wires import Ticker

NEVER = 1 << 62
"""Time (ns) of an event that never occurs: 146 years, later than the end of any simulation."""


class EmulatedDevice(Protocol):
    """An emulated device, which processes events at simulated times."""

    def next_event_ns(self) -> int:
        """Return the time of the device's next event, or NEVER."""

    def advance(self, now_ns: int) -> None:
        """Process all events of the device up to `now_ns` in order, each at its own time."""


class FaultTimeline:
    """A queue of timed fault actions, with the interface of an emulated device."""

    def __init__(self) -> None:
        self._order = itertools.count()
        self._actions: list[tuple[int, int, Callable[[], None]]] = []

    def at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Run `action` at the simulation time `time_ns`."""
        heapq.heappush(self._actions, (time_ns, next(self._order), action))

    def next_event_ns(self) -> int:
        """Return the time at which the next action is due, or NEVER."""
        return self._actions[0][0] if self._actions else NEVER

    def advance(self, now_ns: int) -> None:
        """Run the actions that are due by `now_ns`."""
        while self.next_event_ns() <= now_ns:
            heapq.heappop(self._actions)[2]()


class TimedSimulation:
    """A world and its devices.

    The world advances from event to event, and each device processes its events.
    """

    def __init__(self, advance_world: Callable[[int], None], devices: Sequence[EmulatedDevice]) -> None:
        self._advance_world = advance_world
        self._devices = tuple(devices)

    def next_event_ns(self) -> int:
        """Return the time of the earliest next event of all devices."""
        return min([device.next_event_ns() for device in self._devices], default=NEVER)

    def run_events(self, event_ns: int) -> None:
        """Advance the world to `event_ns`, and run the devices whose events are due."""
        self._advance_world(event_ns)
        for device in self._devices:
            if device.next_event_ns() <= event_ns:
                device.advance(event_ns)

    def pass_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns`, up to which no event is due."""
        self._advance_world(time_ns)

    def advance_to(self, time_ns: int) -> None:
        """Process all events up to `time_ns` in order."""
        while (event_ns := self.next_event_ns()) <= time_ns:
            self.run_events(event_ns)
        self._advance_world(time_ns)


class TimedWorld(Protocol):
    """Interface of a simulated world that a SimClock advances."""

    def next_event_ns(self) -> int:
        """Return the time of the next event in the simulated world."""

    def run_events(self, event_ns: int) -> None:
        """Process the events at `event_ns`, which is the time of the next event."""

    def pass_to(self, time_ns: int) -> None:
        """Advance to `time_ns`, up to which no event is due."""


class SimClock:
    """A Clock of simulated time, which jumps to each deadline without waiting.

    The clock begins at the time `start_ns`, and `utc_start_ns` is the UTC (ns since 1970) at the time 0. The
    list `tickers` contains the periodic jobs in the order of their creation.
    """

    def __init__(self, utc_start_ns: int = 0, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._utc_start_ns = utc_start_ns
        self._world: TimedWorld | None = None
        self.tickers: list[SimTicker] = []
        self._running_jobs = False

    def attach(self, world: TimedWorld) -> None:
        """Set the world that advances together with this clock."""
        self._world = world

    def now_ns(self) -> int:
        """Return the simulated time, ns."""
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance the world to the deadline, event by event, and run the tickers that are due."""
        while self._now_ns < deadline_ns:
            next_ns = deadline_ns
            if not self._running_jobs:
                next_ns = min([deadline_ns, *[ticker.due_ns for ticker in self.tickers]])
            self._advance_world(max(next_ns, self._now_ns))
            if not self._running_jobs:
                self._run_due_jobs()

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        """Run `job` every `period_ns` of simulated time, for the first time after one period."""
        ticker = SimTicker(self, name, period_ns, job)
        self.tickers.append(ticker)
        return ticker

    def utc_ns(self) -> int:
        """Return the simulated UTC, ns since 1970."""
        return self._utc_start_ns + self._now_ns

    def _advance_world(self, time_ns: int) -> None:
        world = self._world
        if world is not None:
            while (event_ns := world.next_event_ns()) <= time_ns:
                self._now_ns = max(self._now_ns, event_ns)
                world.run_events(event_ns)
            world.pass_to(time_ns)
        self._now_ns = max(self._now_ns, time_ns)

    def _run_due_jobs(self) -> None:
        self._running_jobs = True
        try:
            for ticker in list(self.tickers):
                if ticker.due_ns <= self._now_ns:
                    ticker.due_ns = self._now_ns + ticker.period_ns
                    ticker.run()
        finally:
            self._running_jobs = False


class SimTicker(ContainedJob):
    """A job that runs periodically in simulated time; the method `kick` runs it at once."""

    def __init__(self, clock: SimClock, name: str, period_ns: int, job: Callable[[], None]) -> None:
        super().__init__(name, job, clock.now_ns)
        self.period_ns = period_ns
        self.due_ns = clock.now_ns() + period_ns
        self._clock = clock
        self._busy = False

    def kick(self) -> None:
        """Run the job now, and restart the period of the job."""
        self.due_ns = self._clock.now_ns() + self.period_ns
        self.run()

    def run(self) -> None:
        """Run the job, unless it is already running."""
        if self._busy:
            return
        self._busy = True
        try:
            super().run()
        finally:
            self._busy = False

    def stop(self) -> None:
        """Stop running the job."""
        if self in self._clock.tickers:
            self._clock.tickers.remove(self)
