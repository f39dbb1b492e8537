"""Health, housekeeping and performance: checks and records the loop itself.

Health checks streams, progress and resources, and feeds the watchdog while all of them progress. Housekeeping
records the counters of devices and loop once a second, and checks the flight log. The performance record has
the times and execution times of cycles in a log of its own; its observer turns slips and failures into
events, and zeroes the coils after a failed control cycle.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flight.link import events
from flight.link.telemetry.definitions import CYCLE_TIMING, HEALTH, HOUSEKEEPING, JOB_TIMING, RATE_GROUP
from flight.loop.body import Planner, SteeringState
from flight.loop.executive.executive import Cycle, RateGroup
from flight.loop.executive.jobs import JobResult, WorkerChange
from flight.loop.fdir import facts
from flight.loop.fdir.facts import FACTS, EventLog
from flight.loop.fdir.resources import ClockWatch, ResourceMonitor, ResourceReader, ResourceSample
from flight.loop.fdir.supervision import GroupsAndWorkers, WorkerWatch, failing
from flight.loop.services import Services
from flight.loop.tasks.imaging import Imaging
from flight.loop.tasks.mode_control import ModeControl
from flight.loop.tasks.navigation import Navigation
from flight.loop.tasks.steering import CoilDrive
from flight.schema.sections import Health
from hal.interfaces.devices import CoilState, PowerMonitor, TorqueCoils
from hal.interfaces.wires import Ticker

CONTROL = "control"


class PerformanceObserver:
    """Records every cycle, slip and failure that the executive reports."""

    def __init__(self, coils: TorqueCoils, services: Services) -> None:
        self._coils = coils
        self._clock = services.clock
        self._recorder = services.recorder
        self._events = services.events

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        """Record a control cycle's lateness and execution time."""
        if group.name == CONTROL:
            self._recorder.time(
                CYCLE_TIMING,
                cycle.start_ns,
                cycle=cycle.slot,
                lateness=(cycle.start_ns - cycle.due_ns) * 1e-9,
                execution=execution_ns * 1e-9,
            )

    def slipped(self, group: RateGroup, slots: int) -> None:
        """Report skipped slots of the control group: no other group can slip without it."""
        if group.name != CONTROL:
            return
        text = f"{group.name}: {slots} slots skipped, {group.slips} since start"
        self._events.report(events.CYCLE_SLIP, self._clock.now_ns(), text)

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Switch the coils off when the control task failed, and report the error's place."""
        if group.name == CONTROL:
            self._coils.off()
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{group.name}: {type(error).__name__}: {error} ({last.name}, line {last.lineno})"
        self._events.report(events.TASK_FAILED, self._clock.now_ns(), text)

    def group(self, group: RateGroup, now_ns: int) -> None:
        """Record the statistics of a rate group."""
        self._recorder.time(
            RATE_GROUP,
            now_ns,
            name=group.name,
            period=group.period_ns * 1e-9,
            cycles=group.cycles,
            slips=group.slips,
            overruns=group.overruns,
            mean=group.mean_execution_ns * 1e-9,
            max=group.max_execution_ns * 1e-9,
        )

    def job(self, result: JobResult, now_ns: int) -> None:
        """Record the execution time of a job."""
        self._recorder.time(
            JOB_TIMING,
            now_ns,
            name=result.worker,
            execution=result.execution_ns * 1e-9,
            outcome=result.outcome,
        )


@dataclass(frozen=True, slots=True)
class HousekeepingInputs:
    """The sources of housekeeping; `log_error` returns why the flight log fails, empty while it works."""

    navigation: Navigation
    planner: Planner
    imaging: Imaging | None
    coils: TorqueCoils
    power: PowerMonitor | None
    log_error: Callable[[], str]


class Housekeeping:
    """Writes the housekeeping packet."""

    def __init__(self, watched: HousekeepingInputs, services: Services) -> None:
        self._watched = watched
        self._recorder = services.recorder
        self._events = services.events
        self._facts = services.facts
        self._lost = 0

    def coils(self) -> CoilState:
        """Return the state of the coils."""
        return self._watched.coils.state()

    def run(self, cycle: Cycle, state: SteeringState) -> None:
        """Write the packet; `state` is that of the newest control cycle."""
        watched, now_ns = self._watched, cycle.start_ns
        error = watched.power.error() if watched.power else ""
        log_error = watched.log_error()
        text = log_error or "packets reach the disk again"
        self._facts.update(facts.LOG_FAULT, bool(log_error), now_ns, text)
        self.report_lost(now_ns)
        reading = watched.power.latest() if watched.power and not error else None
        link = watched.navigation.link()
        accepted, refused = watched.planner.counts()
        frames, streak_rates = watched.imaging.counts() if watched.imaging else (0, 0)
        self._recorder.record(
            HOUSEKEEPING,
            now_ns,
            state=int(state),
            imu_packets=link.packets,
            imu_bad_checksum=link.bad_checksum,
            imu_discarded_bytes=link.discarded_bytes,
            imu_out_of_range=link.out_of_range,
            imu_not_finite=link.not_finite,
            coil_faults=watched.coils.state().faults,
            coil_voltage=reading.voltage if reading else math.nan,
            coil_current=reading.current if reading else math.nan,
            coil_power=reading.power if reading else math.nan,
            plans_accepted=accepted,
            plans_refused=refused,
            frames=frames,
            streak_rates=streak_rates,
            events=self._events.count,
            records_lost=self._recorder.lost,
        )

    def report_lost(self, now_ns: int) -> None:
        """Report the records that were lost since the last call, with the newest reason."""
        lost = self._recorder.lost
        if lost != self._lost:
            text = f"{lost - self._lost} more, the newest: {self._recorder.lost_text}"
            self._lost = lost
            self._events.report(events.RECORD_LOST, now_ns, text)


RUNS_PER_PACKET = 4
_FAILING_CYCLES = 60
_WORKER_EVENTS = {
    WorkerChange.DIED: events.WORKER_DIED,
    WorkerChange.READY: events.WORKER_READY,
    WorkerChange.SPENT: events.WORKER_RESTS,
}


@dataclass(frozen=True, slots=True)
class HealthInputs:
    """The tasks and devices that health checks, in addition to the streams."""

    modes: ModeControl
    drive: CoilDrive
    power: PowerMonitor | None
    workers: Sequence[WorkerWatch]


class HealthWatch:
    """The task of the health rate group."""

    def __init__(
        self, inputs: HealthInputs, limits: Health, feed: Callable[[], None], services: Services
    ) -> None:
        """Watch `inputs`; `feed` is called while every rate group and worker makes progress."""
        self._inputs = inputs
        self._monitor = ResourceMonitor(limits)
        self._clock_watch = ClockWatch(services.clock, limits.clock_step)
        self._clock = services.clock
        self._recorder = services.recorder
        self._events = services.events
        self._jobs = services.jobs
        # Every death of a worker is written: the budget of restarts bounds them, so there is no throttle.
        self._worker_events = EventLog(services.recorder.event, 0)
        self._facts = services.facts
        self._streams = services.streams
        self._feed = feed
        self._fed = 0
        self._power_ns = -1
        self._sample: ResourceSample | None = None
        self._ticker: Ticker | None = None

    def watch(self, groups: Sequence[RateGroup]) -> None:
        """Watch the rate groups of the flight, control first."""
        self._control = groups[0]
        self._progress = GroupsAndWorkers(list(groups), list(self._inputs.workers))
        self._counted = (self._control.cycles, self._control.completed)

    def read_resources(self, read: ResourceReader, period_ns: int) -> None:
        """Read the board's resources on a ticker, outside the loop, until `close`."""

        def sample() -> None:
            self._sample = read(self._clock.now_ns())

        self._ticker = self._clock.ticker("resources", period_ns, sample)

    def adopt(self, limits: Health) -> None:
        """Go on with other bounds of resources."""
        self._monitor.adopt(limits)

    def begin(self, time_ns: int) -> None:
        """Count from here."""
        self._progress.begin(time_ns)

    def close(self) -> None:
        """Stop reading the board. Safe to call twice."""
        ticker, self._ticker = self._ticker, None
        if ticker is not None:
            ticker.stop()

    def run(self, cycle: Cycle) -> None:
        """Run all checks once."""
        now_ns = cycle.start_ns
        self._look_at_streams(now_ns)
        self._look_at_progress(now_ns)
        self._look_at_services(now_ns)
        for news in self._jobs.news():
            text = f"{news.worker}: {news.text}"
            self._worker_events.report(_WORKER_EVENTS[news.change], now_ns, text)
        step = self._clock_watch.look()
        if step is not None:
            self._events.report(events.CLOCK_STEP, now_ns, f"by {step:+.3f} s")
        sample, self._sample = self._sample, None
        if sample is not None:
            self._monitor.ingest(sample)
            self._monitor.report(self._facts, now_ns)
        if cycle.slot % RUNS_PER_PACKET == 0:
            self._record(now_ns)

    def _look_at_streams(self, now_ns: int) -> None:
        inputs = self._inputs
        error = inputs.power.error() if inputs.power is not None else ""
        self._facts.update(facts.POWER_FAULT, bool(error), now_ns, error or "readings come again")
        reading = inputs.power.latest() if inputs.power is not None else None
        if reading is not None and reading.time_ns != self._power_ns:
            self._power_ns = reading.time_ns
            self._streams.note("power", reading.time_ns, reading.current)
        for stream, poor, text in self._streams.look(now_ns):
            self._facts.update(stream.poor, poor, now_ns, text)

    def _look_at_progress(self, now_ns: int) -> None:
        """Feed the watchdog if nothing is stalled; update the fact that the control task keeps failing."""
        before = self._counted
        if self._control.completed != before[1]:
            self._counted = (self._control.cycles, self._control.completed)
        failed = self._control.cycles - self._counted[0]
        text = f"{failed} control cycles in a row have failed"
        self._facts.update(facts.TASK_FAILING, failed >= _FAILING_CYCLES, now_ns, text)
        still = self._progress.stalled(now_ns)
        self._facts.update(facts.NO_PROGRESS, bool(still), now_ns, f"no progress: {', '.join(still)}")
        if not still:
            self._feed()
            self._fed += 1

    def _look_at_services(self, now_ns: int) -> None:
        """Update the fact that a job outside the loop fails or is stalled."""
        poor = failing(self._clock.tickers, now_ns)
        text = "; ".join(poor) if poor else "all jobs run"
        self._facts.update(facts.SERVICE_FAILING, bool(poor), now_ns, text)

    def _record(self, now_ns: int) -> None:
        inputs, state = self._inputs, self._monitor.state
        sample, streams = state.sample, self._streams
        self._recorder.record(
            HEALTH,
            now_ns,
            mode=int(inputs.modes.mode),
            mode_age=(now_ns - inputs.modes.since_ns) * 1e-9,
            imu=int(streams.state("imu", now_ns)),
            field=int(streams.state("field", now_ns)),
            coils=int(streams.state("coils", now_ns)),
            power=int(streams.state("power", now_ns)),
            camera=int(streams.state("camera", now_ns)),
            facts=sum(self._facts.holds(fact) << bit for bit, fact in enumerate(FACTS)),
            coils_in_use=sum(int(used) << axis for axis, used in enumerate(inputs.drive.available)),
            fed=self._fed,
            slips=self._control.slips,
            clock_steps=self._clock_watch.steps,
            cpu_share=state.cpu_share,
            resident=sample.resident if sample else math.nan,
            proportional=sample.proportional if sample else math.nan,
            memory_slope=state.memory_slope,
            disk_free=sample.disk_free if sample else math.nan,
            temperature=sample.temperature if sample else math.nan,
        )
