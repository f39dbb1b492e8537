"""Health, housekeeping and performance: monitors and records the state of the flight software.

The health task checks streams, progress and resources, and triggers the watchdog while all rate groups and
workers make progress. A rate group is stalled if it has not completed a cycle within its time limit. A worker
is stalled if a job runs longer than its time limit. A stalled ticker job is reported but does not stop the
watchdog's trigger, because a restart would not repair a slow disk or a hung bus. A `ResourceReader` (`Board`
on Linux, a script in tests) samples processor load, memory, disk space and temperature on a ticker outside
the control loop, because the kernel may take milliseconds to answer.

Housekeeping records the counters of devices and tasks once a second, and checks the flight log. The
performance record stores lateness and execution time of the control cycles in a separate log. The observer of
the executive reports skipped time slots and failures as events, and switches the coils off after a failed
control cycle.

When the work of a flight exceeds the processor's capacity, the least important work is reduced first
(`Shedding`). Control cycles, safety, telemetry and commands are never reduced. All other work is reduced step
by step, in the order of `LEVELS`: readings of the inertial unit that arrive more often than control cycles,
then the search for objects, then frames of the star camera, then periodic plans. A plan that is not renewed
stays in force, and its final attitude is held after its end. Plans are always made for a new target and after
a loss of control.

Overload is recognised by its symptoms: lost control cycles, frames that arrive while the worker is busy or
whose processing takes too long, and plans that take too long. Each increase of the shedding level reduces
more work. The shedding level is decreased when no symptom has occurred for some time. If symptoms occur again
after a decrease, the next decrease is made later, so that the shedding level does not oscillate.
"""

from __future__ import annotations

import math
import os
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import (
    CYCLE_TIMING,
    HEALTH,
    HOUSEKEEPING,
    JOB_TIMING,
    RATE_GROUP,
    WORKLOAD,
)
from flight.loop import facts
from flight.loop.body import Planner, SteeringState
from flight.loop.executive import Cycle, JobResult, RateGroup, WorkerChange
from flight.loop.facts import FACTS, EventLog, Facts, Services
from flight.loop.imaging import Imaging
from flight.loop.modes import ModeControl
from flight.loop.navigation import Navigation
from flight.loop.steering import CoilDrive
from flight.schema.sections import Health
from hal.interfaces.devices import CoilState, PowerMonitor, TorqueCoils
from hal.interfaces.wires import SECOND_NS, Clock, Ticker

_HOUR = 3600.0
_LEAST_SLOPE_SAMPLES = 8


@dataclass(frozen=True, slots=True)
class ResourceSample:
    """A sample of the board's resources, with NaN for values that are not available.

    Attributes:
        time_ns: time of the sample by the monotonic clock.
        cpu: processor time (s) of the control process since its start.
        resident: resident set size (bytes) of the control process.
        proportional: sum of the proportional set sizes (bytes) of all flight processes.
        disk_free: free space (bytes) on the file system of the flight log.
        temperature: temperature (degrees Celsius) of the warmest thermal zone.
    """

    time_ns: int
    cpu: float
    resident: float
    proportional: float
    disk_free: float
    temperature: float


ResourceReader = Callable[[int], ResourceSample]
"""Function that samples the board's resources at a time (ns), and raises no exceptions."""


@dataclass(frozen=True, slots=True)
class ResourceState:
    """Processor load and memory growth computed from samples; NaN while there are too few samples.

    The load `cpu_share` is the processor time between the last two samples, as a fraction of one core. The
    growth `memory_slope` of memory use (bytes/s) is a least squares fit over the window.
    """

    sample: ResourceSample | None = None
    cpu_share: float = math.nan
    memory_slope: float = math.nan


class ResourceMonitor:
    """Stores the newest samples of resources, and updates the monitored conditions about them."""

    def __init__(self, settings: Health) -> None:
        self._settings = settings
        self._warm: deque[ResourceSample] = deque(maxlen=max(round(_HOUR / settings.look_period), 2))
        self._begun_ns: int | None = None
        self.state = ResourceState()

    def adopt(self, settings: Health) -> None:
        """Replace the limits of the resources."""
        self._settings = settings

    def ingest(self, sample: ResourceSample) -> None:
        """Add a sample."""
        share = math.nan
        if self.state.sample is not None:
            span = (sample.time_ns - self.state.sample.time_ns) * 1e-9
            share = (sample.cpu - self.state.sample.cpu) / span if span > 0.0 else math.nan
        if self._begun_ns is None:
            self._begun_ns = sample.time_ns
        if (sample.time_ns - self._begun_ns) * 1e-9 >= self._settings.warm_up:
            self._warm.append(sample)
        self.state = ResourceState(sample, share, self._slope())

    def report(self, facts_: Facts, now_ns: int) -> None:
        """Update the monitored conditions about resources from the newest sample."""
        sample, limits = self.state.sample, self._settings
        if sample is None:
            return
        slope = self.state.memory_slope * _HOUR
        for fact, value, limit, text in (
            (facts.CPU_HIGH, self.state.cpu_share, limits.cpu_share, "{:.2f} of a core, limit {:g}"),
            (facts.MEMORY_GROWS, slope, limits.memory_slope, "growth of {:.3g} bytes an hour, limit {:g}"),
            (facts.MEMORY_HIGH, sample.proportional, limits.memory, "{:.4g} bytes, {:g} allowed"),
            (facts.DISK_LOW, -sample.disk_free, -limits.disk_free, "{:.3g} bytes free, {:g} required"),
            (facts.HOT, sample.temperature, limits.temperature, "{:.1f} deg C, warning above {:g}"),
            (facts.TOO_HOT, sample.temperature, limits.hottest, "{:.1f} deg C, limit {:g}"),
        ):
            known = not math.isnan(value)
            facts_.update(fact, value > limit if known else None, now_ns, text.format(abs(value), abs(limit)))

    def _slope(self) -> float:
        if len(self._warm) < _LEAST_SLOPE_SAMPLES:
            return math.nan
        time = np.array([sample.time_ns for sample in self._warm]) * 1e-9
        memory = np.array([sample.proportional for sample in self._warm])
        time -= time.mean()
        if (time[-1] - time[0]) < self._settings.slope_window or not np.isfinite(memory).all():
            return math.nan
        return float(time @ (memory - memory.mean()) / (time @ time))


_CLOCK_STEP_NS = 500_000_000
"""Smallest step (ns) of the wall clock that is reported."""


class ClockWatch:
    """Detects steps of the wall clock by comparing UTC with monotonic time."""

    def __init__(self, clock: Clock) -> None:
        """Watch `clock` for steps larger than 0.5 s."""
        self._clock = clock
        self._offset_ns: int | None = None
        self.steps = 0

    def look(self) -> float | None:
        """Return the step (s) of the wall clock since the last call, or None for a drift or no change."""
        offset_ns = self._clock.utc_ns() - self._clock.now_ns()
        before_ns, self._offset_ns = self._offset_ns, offset_ns
        if before_ns is None or abs(offset_ns - before_ns) <= _CLOCK_STEP_NS:
            return None
        self.steps += 1
        return (offset_ns - before_ns) * 1e-9


_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


class Board:
    """Reads resources from the kernel; values that the kernel does not provide are NaN."""

    def __init__(self, log_folder: Path, proc: Path = Path("/proc"), thermal: Path | None = None) -> None:
        """`proc` and `thermal` are the kernel's folders of processes and thermal zones."""
        self._folder = log_folder
        self._proc = proc
        self._thermal = thermal or Path("/sys/class/thermal")

    def __call__(self, now_ns: int) -> ResourceSample:
        """Return the present use of the board's resources."""
        process = os.getpid()
        # The process name in brackets may itself contain brackets and blanks.
        # User and system time are fields 14 and 15 of the line (proc(5)).
        stat = _read(self._proc / str(process) / "stat").rpartition(")")[2].split()
        statm = _read(self._proc / str(process) / "statm").split()
        try:
            room = os.statvfs(self._folder)
            disk_free = float(room.f_bavail) * room.f_frsize
        except OSError:
            disk_free = math.nan
        zones = (_read(zone).strip() for zone in sorted(self._thermal.glob("thermal_zone*/temp")))
        return ResourceSample(
            now_ns,
            cpu=(int(stat[11]) + int(stat[12])) / _TICKS if len(stat) > 12 else math.nan,
            resident=float(statm[1]) * _PAGE if len(statm) > 1 else math.nan,
            proportional=math.fsum(map(self._proportional, [process, *self._below(process)])),
            disk_free=disk_free,
            temperature=max(
                (int(word) * 1e-3 for word in zones if word.lstrip("-").isdigit()), default=math.nan
            ),
        )

    def _below(self, parent: int) -> Iterator[int]:
        """Yield the process identifiers of all descendants of the process `parent`."""
        for task in sorted((self._proc / str(parent) / "task").glob("*/children")):
            for word in _read(task).split():
                yield int(word)
                yield from self._below(int(word))

    def _proportional(self, process: int) -> float:
        """Return the proportional set size (bytes) of a process, or 0 if the process has ended."""
        for line in _read(self._proc / str(process) / "smaps_rollup").splitlines():
            if line.startswith("Pss:"):
                return float(line.split()[1]) * 1024.0
        state = _read(self._proc / str(process) / "stat").rpartition(")")[2].split()[:1]
        return 0.0 if state in ([], ["Z"], ["X"]) else math.nan


def _read(path: Path) -> str:
    """Return the content of a kernel file, or an empty text if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


_PERIODS = 3
_SHORTEST_LIMIT_NS = 2_000_000_000


@dataclass(frozen=True, slots=True)
class WorkerWatch:
    """A worker to watch; `busy_since_ns` returns the start time (ns) of its job, or None if it is idle."""

    name: str
    busy_since_ns: Callable[[], int | None]
    limit_ns: int


class GroupsAndWorkers:
    """Detects stalled rate groups and workers."""

    def __init__(self, groups: list[RateGroup], workers: list[WorkerWatch]) -> None:
        self._workers = workers
        # For each group: number of completed cycles, and time (ns) at which this number last increased.
        self._progress = {group: (group.completed, 0) for group in groups}

    def begin(self, time_ns: int) -> None:
        """Start the supervision of progress at `time_ns`."""
        self._progress = {group: (completed, time_ns) for group, (completed, _) in self._progress.items()}

    def stalled(self, now_ns: int) -> list[str]:
        """Return the names of the stalled rate groups and workers."""
        names = []
        for group, (completed, since_ns) in self._progress.items():
            if group.completed != completed:
                self._progress[group] = group.completed, now_ns
            elif now_ns - since_ns > max(_PERIODS * group.period_ns, _SHORTEST_LIMIT_NS):
                names.append(group.name)
        for worker in self._workers:
            since = worker.busy_since_ns()
            if since is not None and now_ns - since > worker.limit_ns:
                names.append(worker.name)
        return names


def failing(tickers: Sequence[Ticker], now_ns: int) -> list[str]:
    """Return a text for each ticker job that reports an error or is stalled."""
    problems = []
    for ticker in tickers:
        stood_ns = now_ns - ticker.served_ns
        if ticker.error:
            problems.append(f"{ticker.name}: {ticker.error}")
        elif stood_ns > max(_PERIODS * ticker.period_ns, _SHORTEST_LIMIT_NS):
            problems.append(f"{ticker.name}: has not run for {stood_ns * 1e-9:.1f} s")
    return problems


CONTROL = "control"


class PerformanceObserver:
    """Records cycles, and reports skipped slots (`lost` control cycles) and failures as events."""

    def __init__(self, coils: TorqueCoils, services: Services) -> None:
        self._coils, self._clock, self._recorder = coils, services.clock, services.recorder
        self._events = services.events
        self.lost = 0

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
        """Report skipped slots of the control group.

        Other groups skip slots only if the control group does.
        """
        if group.name != CONTROL:
            return
        self.lost += slots
        text = f"{group.name}: {slots} slots skipped, {group.slips} since start"
        self._events.report(events.CYCLE_SLIP, self._clock.now_ns(), text)

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Switch the coils off if the control task failed, and report where the error occurred."""
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


_LINE_COUNTERS = ("packets", "bad_checksum", "discarded_bytes", "out_of_range", "not_finite")


class Housekeeping:
    """Writes the housekeeping packet once a second."""

    def __init__(
        self,
        navigation: Navigation,
        planner: Planner,
        imaging: Imaging | None,
        coils: TorqueCoils,
        power: PowerMonitor | None,
        log_error: Callable[[], str],
        services: Services,
    ) -> None:
        """Collect the counters of the tasks; `log_error` returns the error of the flight log, or ""."""
        self._navigation, self._planner, self._imaging = navigation, planner, imaging
        self._coils, self._power, self._log_error = coils, power, log_error
        self._recorder, self._events = services.recorder, services.events
        self._facts = services.facts
        self._lost = 0

    def coils(self) -> CoilState:
        """Return the state of the coils."""
        return self._coils.state()

    def run(self, cycle: Cycle, state: SteeringState) -> None:
        """Write the housekeeping packet with the steering state (`state`) of the newest control cycle."""
        now_ns, power, log_error = cycle.start_ns, self._power, self._log_error()
        text = log_error or "packets reach the disk again"
        self._facts.update(facts.LOG_FAULT, bool(log_error), now_ns, text)
        self.report_lost(now_ns)
        reading = power.latest() if power and not power.error() else None
        link = self._navigation.link()
        accepted, refused = self._planner.counts()
        frames, streak_rates = self._imaging.counts() if self._imaging else (0, 0)
        self._recorder.record(
            HOUSEKEEPING,
            now_ns,
            state=int(state),
            **{f"imu_{name}": getattr(link, name) for name in _LINE_COUNTERS},
            coil_faults=self._coils.state().faults,
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
        """Report the number of records lost since the last call, with the newest reason."""
        lost = self._recorder.lost
        if lost != self._lost:
            text = f"{lost - self._lost} more, the newest: {self._recorder.lost_text}"
            self._lost = lost
            self._events.report(events.RECORD_LOST, now_ns, text)


RUNS_PER_PACKET = 4
_FAILING_CYCLES = 60
_RECORDED_STREAMS = ("imu", "field", "coils", "power", "camera")
_RECORDED_RESOURCES = ("resident", "proportional", "disk_free", "temperature")
_WORKER_EVENTS = {
    WorkerChange.DIED: events.WORKER_DIED,
    WorkerChange.READY: events.WORKER_READY,
    WorkerChange.SPENT: events.WORKER_RESTS,
}


class HealthWatch:
    """Task of the health rate group: checks streams, progress, resources and workers."""

    def __init__(
        self,
        modes: ModeControl,
        drive: CoilDrive,
        power: PowerMonitor | None,
        workers: Sequence[WorkerWatch],
        limits: Health,
        feed: Callable[[], None],
        services: Services,
    ) -> None:
        """Watch the tasks; `feed` triggers the watchdog while all rate groups and workers progress."""
        self._modes, self._drive, self._power, self._workers = modes, drive, power, workers
        self._monitor = ResourceMonitor(limits)
        self._clock_watch = ClockWatch(services.clock.host)
        self._clock, self._recorder = services.clock, services.recorder
        self._events, self._jobs = services.events, services.jobs
        # Worker events need no throttle, because each of them belongs to a restart, and restarts are limited.
        self._worker_events = EventLog(services.recorder.event, 0)
        self._facts, self._streams, self._feed = services.facts, services.streams, feed
        self._fed = 0
        self._power_ns = -1
        self._sample: ResourceSample | None = None
        self._ticker: Ticker | None = None

    def watch(self, groups: Sequence[RateGroup]) -> None:
        """Watch the rate groups of the flight, the first of which must be the control group."""
        self._control = groups[0]
        self._progress = GroupsAndWorkers(list(groups), list(self._workers))
        self._counted = (self._control.cycles, self._control.completed)

    def read_resources(self, read: ResourceReader, period_ns: int) -> None:
        """Sample the use of the board's resources periodically in another thread, until `close` is called."""

        def sample() -> None:
            self._sample = read(self._clock.now_ns())

        self._ticker = self._clock.ticker("resources", period_ns, sample)

    def adopt(self, limits: Health) -> None:
        """Replace the limits of the resources."""
        self._monitor.adopt(limits)

    def begin(self, time_ns: int) -> None:
        """Start the supervision of progress and of the ages of readings at `time_ns`."""
        self._progress.begin(time_ns)

    def close(self) -> None:
        """Stop reading the board. Safe to call twice."""
        ticker, self._ticker = self._ticker, None
        if ticker is not None:
            ticker.stop()

    def run(self, cycle: Cycle) -> None:
        """Run all checks once."""
        now_ns = cycle.start_ns
        self._events.release(now_ns)
        self._check_streams(now_ns)
        self._check_progress(now_ns)
        failures = failing(self._clock.tickers, now_ns)
        text = "; ".join(failures) or "all jobs run"
        self._facts.update(facts.SERVICE_FAILING, bool(failures), now_ns, text)
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

    def _check_streams(self, now_ns: int) -> None:
        error = self._power.error() if self._power is not None else ""
        self._facts.update(facts.POWER_FAULT, bool(error), now_ns, error or "readings arrive again")
        reading = self._power.latest() if self._power is not None else None
        if reading is not None and reading.time_ns != self._power_ns:
            self._power_ns = reading.time_ns
            self._streams.note("power", reading.time_ns, reading.current)
        for stream, poor, text in self._streams.look(now_ns):
            self._facts.update(stream.poor, poor, now_ns, text)

    def _check_progress(self, now_ns: int) -> None:
        """Trigger the watchdog if nothing is stalled, and report a control task that fails repeatedly."""
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

    def _record(self, now_ns: int) -> None:
        state, streams = self._monitor.state, self._streams
        sample = state.sample
        self._recorder.record(
            HEALTH,
            now_ns,
            mode=int(self._modes.mode),
            mode_age=(now_ns - self._modes.since_ns) * 1e-9,
            facts=sum(self._facts.holds(fact) << bit for bit, fact in enumerate(FACTS)),
            coils_in_use=sum(int(used) << axis for axis, used in enumerate(self._drive.available)),
            fed=self._fed,
            slips=self._control.slips,
            clock_steps=self._clock_watch.steps,
            cpu_share=state.cpu_share,
            memory_slope=state.memory_slope,
            **{name: int(streams.state(name, now_ns)) for name in _RECORDED_STREAMS},
            **{name: getattr(sample, name) if sample else math.nan for name in _RECORDED_RESOURCES},
        )


@dataclass(frozen=True, slots=True)
class ShedLevel:
    """The work that is done at one shedding level.

    Attributes:
        every_reading: whether all readings of the inertial unit are used, or only the newest of each cycle.
        search: whether frames are searched for objects.
        frame_every: number n such that every n-th due exposure of the star camera is made.
        plan_every: number n such that every n-th due periodic plan is made.
        text: description of the reduced work, for the texts of events.
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
    ShedLevel(False, False, 2, 1, f"{_NEWEST}, no search for objects, half of the frames"),
    ShedLevel(False, False, 2, 2, f"{_NEWEST}, no search for objects, half of the frames and periodic plans"),
    ShedLevel(
        False, False, 4, 4, f"{_NEWEST}, no search for objects, a quarter of the frames and periodic plans"
    ),
    ShedLevel(
        False, False, 8, 8, f"{_NEWEST}, no search for objects, an eighth of the frames and periodic plans"
    ),
)
"""Levels of load shedding, from no reduction to the strongest reduction of the work."""

_WINDOW_NS = 60 * SECOND_NS
"""Time (ns) over which the symptoms of an overload are counted."""
_SETTLE_NS = 10 * SECOND_NS
"""Shortest time (ns) from a change of the shedding level to its next increase. The change takes effect within
this time."""
_SHORTEST_QUIET_NS = 60 * SECOND_NS
_LONGEST_QUIET_NS = 960 * SECOND_NS
"""Times (ns) without a symptom of overload after which the shedding level is decreased: initial value, and
maximum after repeated doubling."""


@dataclass(eq=False)
class OverloadSign:
    """A symptom of overload, which is detected from a counter.

    Attributes:
        text: name of the symptom, for the texts of events.
        count: function that returns how often the symptom has occurred since start.
        needed: number of occurrences within a minute that increase the shedding level.
    """

    text: str
    count: Callable[[], int]
    needed: int
    _counted: int = 0
    _times: deque[int] = field(default_factory=deque)

    def look(self, now_ns: int) -> bool:
        """Return whether the symptom occurred since the last call; several occurrences count once."""
        count = self.count()
        occurred, self._counted = count > self._counted, count
        if occurred:
            self._times.append(now_ns)
        while self._times and now_ns - self._times[0] > _WINDOW_NS:
            self._times.popleft()
        return occurred

    @property
    def is_overload(self) -> bool:
        """Whether the symptom occurred often enough to increase the shedding level."""
        return len(self._times) >= self.needed

    def forget(self) -> None:
        """Discard the counted occurrences of the symptom, because the shedding level has changed."""
        self._times.clear()


class BusyPeriods:
    """Counts the jobs that have run for longer than a limit."""

    def __init__(self, busy_since_ns: Callable[[], int | None], limit_ns: int) -> None:
        """Watch a worker; `busy_since_ns` returns the start time (ns) of its job, or None if it is idle."""
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
    """Task that reduces the workers' jobs while they exceed the processor's capacity; runs once a second."""

    def __init__(
        self,
        signs: Sequence[OverloadSign],
        plans: BusyPeriods,
        apply: Callable[[ShedLevel], None],
        frames: Callable[[], tuple[int, int]],
        services: Services,
    ) -> None:
        """Start without reductions.

        `apply` puts a level into effect. `frames` returns how many frames were omitted, and how many were
        late.
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
        """Return whether to make the periodic plan of the time slot `slot`; an omitted plan is counted."""
        made = slot % LEVELS[self._level].plan_every == 0
        self.plans_shed += not made
        return made

    def run(self, lost_cycles: int, now_ns: int) -> None:
        """Look for overload, change the shedding level by at most one, and record `lost_cycles`."""
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
