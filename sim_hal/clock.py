"""Simulated time: sleeping advances the world to the deadline and returns at once.

Due tickers run one after the other, in the order in which they were made, so a flight repeats bit for bit. A
job that itself sleeps (a driver waiting for its chip) advances the world, but no other ticker runs meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from hal.buses.clock import ContainedJob
from hal.interfaces.wires import Ticker


class TimedWorld(Protocol):
    """A world that a SimClock advances."""

    def next_event_ns(self) -> int:
        """Return the time of the next event."""

    def run_events(self, event_ns: int) -> None:
        """Process the events of that time, the next."""

    def advance_to(self, time_ns: int) -> None:
        """Process all events due at or before `time_ns`."""


class SimClock:
    """A Clock that jumps to each deadline. Time begins at `start_ns`; `utc_start_ns` is the label of time 0.

    Attributes:
        tickers: those that run, in the order in which they were made.
    """

    def __init__(self, utc_start_ns: int = 0, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._utc_start_ns = utc_start_ns
        self._world: TimedWorld | None = None
        self.tickers: list[SimTicker] = []
        self._running_jobs = False

    def attach(self, world: TimedWorld) -> None:
        """Advance this world from now on."""
        self._world = world

    def now_ns(self) -> int:
        """Return the simulated time."""
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance the world, event by event, to the deadline."""
        while self._now_ns < deadline_ns:
            next_ns = deadline_ns
            if not self._running_jobs:
                for ticker in self.tickers:
                    next_ns = min(next_ns, ticker.due_ns)
            self._advance_world(max(next_ns, self._now_ns))
            if not self._running_jobs:
                self._run_due_jobs()

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        """Run `job` every `period_ns` of simulated time, the first time one period from now."""
        made = SimTicker(self, name, period_ns, job)
        self.tickers.append(made)
        return made

    def utc_ns(self) -> int:
        """Return UTC in ns, a label for telemetry."""
        return self._utc_start_ns + self._now_ns

    def _advance_world(self, time_ns: int) -> None:
        world = self._world
        if world is not None:
            while (event_ns := world.next_event_ns()) <= time_ns:
                self._now_ns = max(self._now_ns, event_ns)
                world.run_events(event_ns)
            world.advance_to(time_ns)
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
    """A job on simulated time; a kick runs it at once."""

    def __init__(self, clock: SimClock, name: str, period_ns: int, job: Callable[[], None]) -> None:
        super().__init__(name, job, clock.now_ns)
        self.period_ns = period_ns
        self.due_ns = clock.now_ns() + period_ns
        self._clock = clock
        self._busy = False

    def kick(self) -> None:
        """Run the job now; its period starts again, as a thread's wait does."""
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
