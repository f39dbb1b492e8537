"""Health: looks at streams, progress and resources, and feeds the watchdog while everything gets on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from flight.link import events
from flight.link.telemetry.definitions import HEALTH
from flight.link.telemetry.recorder import Recorder
from flight.loop.coil_drive import CoilDrive
from flight.loop.executive.rate_group import Cycle, RateGroup
from flight.loop.fdir import facts
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import FACTS, Facts
from flight.loop.fdir.progress import GroupsAndWorkers, failing
from flight.loop.fdir.resources import ClockWatch, ResourceMonitor, ResourceReader, ResourceSample
from flight.loop.fdir.streams import Streams
from flight.loop.modes.control import ModeControl
from hal.interfaces.devices import PowerMonitor
from hal.interfaces.wires import Clock, Ticker

LOOKS_A_PACKET = 4
_FAILING_CYCLES = 60


@dataclass(frozen=True, slots=True)
class HealthRooms:
    """What health looks at."""

    modes: ModeControl
    streams: Streams
    facts: Facts
    drive: CoilDrive
    power: PowerMonitor | None
    control: RateGroup
    progress: GroupsAndWorkers
    clock: Clock


class HealthWatch:
    """The task of the health rate group."""

    def __init__(
        self,
        rooms: HealthRooms,
        monitor: ResourceMonitor,
        clock_watch: ClockWatch,
        recorder: Recorder,
        event_log: EventLog,
        feed: Callable[[], None],
    ) -> None:
        self._rooms = rooms
        self._monitor = monitor
        self._clock_watch = clock_watch
        self._recorder = recorder
        self._events = event_log
        self._feed = feed
        self._fed = 0
        self._power_ns = -1
        self._counted = (rooms.control.cycles, rooms.control.completed)
        self._sample: ResourceSample | None = None
        self._ticker: Ticker | None = None

    def read_resources(self, clock: Clock, read: ResourceReader, period_ns: int) -> None:
        """Have the board looked at beside the loop, by a ticker of `clock`, until `close`."""

        def look() -> None:
            self._sample = read(clock.now_ns())

        self._ticker = clock.ticker("resources", period_ns, look)

    def begin(self, time_ns: int) -> None:
        """Count from here."""
        self._rooms.progress.begin(time_ns)

    def close(self) -> None:
        """Look at the board no more. Safe to call twice."""
        ticker, self._ticker = self._ticker, None
        if ticker is not None:
            ticker.stop()

    def run(self, cycle: Cycle) -> None:
        """Look once."""
        now_ns = cycle.start_ns
        self._look_at_streams(now_ns)
        self._look_at_progress(now_ns)
        self._look_at_services(now_ns)
        step = self._clock_watch.look()
        if step is not None:
            self._events.tell(events.CLOCK_STEP, now_ns, f"by {step:+.3f} s")
        sample, self._sample = self._sample, None
        if sample is not None:
            self._monitor.take(sample)
            self._monitor.report(self._rooms.facts, now_ns)
        if cycle.slot % LOOKS_A_PACKET == 0:
            self._record(now_ns)

    def _look_at_streams(self, now_ns: int) -> None:
        rooms = self._rooms
        error = rooms.power.error() if rooms.power is not None else ""
        rooms.facts.state(facts.POWER_FAULT, bool(error), now_ns, error or "readings come again")
        reading = rooms.power.latest() if rooms.power is not None else None
        if reading is not None and reading.time_ns != self._power_ns:
            self._power_ns = reading.time_ns
            rooms.streams.note("power", reading.time_ns, reading.current)
        for stream, poor, text in rooms.streams.look(now_ns):
            rooms.facts.state(stream.poor, poor, now_ns, text)

    def _look_at_progress(self, now_ns: int) -> None:
        """Feed the watchdog if all get on; leave the mode if the control task only fails."""
        rooms, before = self._rooms, self._counted
        if rooms.control.completed != before[1]:
            self._counted = (rooms.control.cycles, rooms.control.completed)
        failed = rooms.control.cycles - self._counted[0]
        text = f"{failed} control cycles in a row have failed"
        rooms.facts.state(facts.TASK_FAILING, failed >= _FAILING_CYCLES, now_ns, text)
        still = rooms.progress.standing_still(now_ns)
        rooms.facts.state(facts.NO_PROGRESS, bool(still), now_ns, f"no progress: {', '.join(still)}")
        if not still:
            self._feed()
            self._fed += 1

    def _look_at_services(self, now_ns: int) -> None:
        """Tell of the jobs beside the loop that fail or stand still."""
        poor = failing(self._rooms.clock.tickers, now_ns)
        text = "; ".join(poor) if poor else "all jobs run"
        self._rooms.facts.state(facts.SERVICE_FAILING, bool(poor), now_ns, text)

    def _record(self, now_ns: int) -> None:
        rooms, state = self._rooms, self._monitor.state
        sample, streams = state.sample, rooms.streams
        self._recorder.record(
            HEALTH,
            now_ns,
            mode=int(rooms.modes.mode),
            mode_age=(now_ns - rooms.modes.since_ns) * 1e-9,
            imu=int(streams.state("imu", now_ns)),
            field=int(streams.state("field", now_ns)),
            coils=int(streams.state("coils", now_ns)),
            power=int(streams.state("power", now_ns)),
            camera=int(streams.state("camera", now_ns)),
            facts=sum(rooms.facts.holds(fact) << bit for bit, fact in enumerate(FACTS)),
            coils_in_use=sum(int(used) << axis for axis, used in enumerate(rooms.drive.available)),
            fed=self._fed,
            slips=rooms.control.slips,
            clock_steps=self._clock_watch.steps,
            cpu_share=state.cpu_share,
            resident=sample.resident if sample else math.nan,
            proportional=sample.proportional if sample else math.nan,
            memory_slope=state.memory_slope,
            disk_free=sample.disk_free if sample else math.nan,
            temperature=sample.temperature if sample else math.nan,
        )
