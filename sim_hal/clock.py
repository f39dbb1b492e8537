"""Simulated time: the clock, the scheduling of emulated devices, and a queue of timed actions.

A sleep on the simulated clock advances the world to the deadline and returns at once. All due periodic jobs
(tickers) are run one after the other, in the order of their creation, so that a repeated flight is identical
to the bit. A job that sleeps, such as a driver that waits for its chip, advances the world, but other
periodic jobs do not run during this sleep.
"""

from __future__ import annotations

import heapq
import itertools
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Protocol

from flight.schema.document import MISTAKES
from hal.buses.system import ContainedJob
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import Ticker
from knightcube.errors import KnightCubeError, UsageError

NEVER = 1 << 62
"""Time (ns) of an event that never occurs: 146 years, later than the end of any simulation."""


class EmulatedDevice(Protocol):
    """An emulated device, which processes events at simulated times."""

    def next_event_ns(self) -> int:
        """Return the time of the device's next event, or NEVER."""

    def advance(self, now_ns: int) -> None:
        """Process all events of the device up to `now_ns` in order, each at its own time."""


class EmulatorError(UsageError):
    """Error raised if the code of an emulator or world of another package fails.

    The message names the class, the file with the line, and the remedy. The error ends the simulation.
    """


_NOT_EMULATORS = {"flight", "hal", "knightcube", "numpy", "scipy", "sim_hal"} | sys.stdlib_module_names
"""Packages whose classes are not emulators of another package."""


def check_emulator(error: Exception) -> None:
    """Raise EmulatorError if `error` was raised in a method of a class of another package.

    Other errors, and errors that an emulator may raise (OSError for a chip that does not acknowledge, and
    errors of devices and users), are not changed.
    """
    if isinstance(error, (OSError, DeviceError, KnightCubeError)):
        return
    frames = list(traceback.walk_tb(error.__traceback__))
    for frame, _ in frames:
        kind = type(frame.f_locals.get("self"))
        package = kind.__module__.partition(".")[0]
        if package in _NOT_EMULATORS:
            continue
        own = [one for one in frames if one[0].f_globals.get("__name__", "").partition(".")[0] == package]
        last, line = (own or frames)[-1]
        raise EmulatorError(
            f"the emulator {kind.__module__}:{kind.__qualname__} failed: {last.f_code.co_filename}:{line}: "
            f"{type(error).__name__}: {error}: correct this line"
        ) from error


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
        try:
            return min([device.next_event_ns() for device in self._devices], default=NEVER)
        except MISTAKES as error:
            check_emulator(error)
            raise

    def run_events(self, event_ns: int) -> None:
        """Advance the world to `event_ns`, and run the devices whose events are due."""
        try:
            self._advance_world(event_ns)
            for device in self._devices:
                if device.next_event_ns() <= event_ns:
                    device.advance(event_ns)
        except MISTAKES as error:
            check_emulator(error)
            raise

    def pass_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns`, up to which no event is due."""
        try:
            self._advance_world(time_ns)
        except MISTAKES as error:
            check_emulator(error)
            raise

    def advance_to(self, time_ns: int) -> None:
        """Process all events up to `time_ns` in order."""
        while (event_ns := self.next_event_ns()) <= time_ns:
            self.run_events(event_ns)
        self.pass_to(time_ns)


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
        self._mistake: EmulatorError | None = None

        def run() -> None:
            try:
                job()
            except EmulatorError as error:
                self._mistake = error
                raise

        super().__init__(name, run, clock.now_ns)
        self.period_ns = period_ns
        self.due_ns = clock.now_ns() + period_ns
        self._clock = clock
        self._busy = False

    def kick(self) -> None:
        """Run the job now, and restart the period of the job."""
        self.due_ns = self._clock.now_ns() + self.period_ns
        self.run()

    def run(self) -> None:
        """Run the job, unless it is already running. Raises EmulatorError, which ends the simulation."""
        if self._busy:
            return
        self._busy = True
        try:
            super().run()
        finally:
            self._busy = False
        if self._mistake is not None:
            raise self._mistake

    def stop(self) -> None:
        """Stop running the job."""
        if self in self._clock.tickers:
            self._clock.tickers.remove(self)
