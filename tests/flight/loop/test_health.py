"""Tests of resource monitoring: means and slopes, persistent excesses, and steps of the wall clock."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flight.link import events
from flight.loop import facts
from flight.loop.facts import EventLog
from flight.loop.health import (
    Board,
    ClockWatch,
    GroupsAndWorkers,
    Housekeeping,
    PerformanceObserver,
    ResourceMonitor,
    ResourceSample,
    WorkerWatch,
    failing,
)
from flight.schema.sections import Health
from tests.flight.loop.records import EventRecord

MIB = 1024.0 * 1024.0
SETTINGS = Health(look_period=5.0, warm_up=20.0, slope_window=100.0)


def sample(seconds: float, **changes: float) -> ResourceSample:
    sound = ResourceSample(round(seconds * 1e9), 0.2 * seconds, 80 * MIB, 150 * MIB, 1e10, 45.0)
    return replace(sound, **changes)  # type: ignore[arg-type]  # the time is not read


def watched(samples: list[ResourceSample]) -> tuple[ResourceMonitor, EventRecord]:
    monitor, record = ResourceMonitor(SETTINGS), EventRecord()
    for one in samples:
        monitor.ingest(one)
        monitor.report(record.facts, one.time_ns)
    return monitor, record


def test_a_sound_board_raises_no_alarm_and_its_share_of_the_processor_is_reported() -> None:
    monitor, record = watched([sample(5.0 * k) for k in range(60)])
    assert record.names == []
    assert monitor.state.cpu_share == pytest.approx(0.2)
    assert monitor.state.memory_slope == pytest.approx(0.0, abs=1e-6)


def test_memory_that_grows_is_reported_with_its_slope_and_the_warm_up_is_left_out() -> None:
    def memory(seconds: float) -> float:
        return 150 * MIB + 5e3 * seconds + (0.0 if seconds >= 20.0 else -50 * MIB)

    monitor, record = watched([sample(5.0 * k, proportional=memory(5.0 * k)) for k in range(60)])
    assert monitor.state.memory_slope == pytest.approx(5e3, rel=1e-6)
    assert record.names == ["memory-grows"]


def test_a_slope_is_not_claimed_before_its_window_is_full() -> None:
    monitor, record = watched([sample(5.0 * k, proportional=150 * MIB + 1e5 * k) for k in range(23)])
    assert math.isnan(monitor.state.memory_slope)
    assert record.names == []


@pytest.mark.parametrize(
    ("change", "event"),
    [
        ({"disk_free": 1e8}, "disk-low"),
        ({"temperature": 85.0}, "hot"),
        ({"proportional": 2e9}, "memory-high"),
    ],
)
def test_an_exceeded_bound_is_reported_after_some_samples_and_never_for_one(
    change: dict[str, float], event: str
) -> None:
    for count, names in ((1, []), (4, [event])):
        _, record = watched([sample(5.0 * k, **change) for k in range(count)])
        assert [name for name in record.names if name == event] == names


def test_a_board_that_is_too_hot_is_latched() -> None:
    samples = [sample(5.0 * k, temperature=100.0 if k < 4 else 40.0) for k in range(20)]
    _, record = watched(samples)
    assert "too-hot" in record.names
    assert record.facts.holds(facts.TOO_HOT)
    assert not record.facts.holds(facts.HOT)


def test_quantities_that_the_board_does_not_measure_are_unknown() -> None:
    samples = [sample(5.0 * k, temperature=math.nan, disk_free=math.nan) for k in range(10)]
    _, record = watched(samples)
    assert record.names == []


class TwoClocks:
    """A clock whose monotonic time and UTC the test sets."""

    def __init__(self) -> None:
        self.monotonic_ns, self.wall_ns = 0, 1_700_000_000_000_000_000

    def now_ns(self) -> int:
        return self.monotonic_ns

    def utc_ns(self) -> int:
        return self.wall_ns

    def go(self, seconds: float, drift: float = 0.0) -> None:
        self.monotonic_ns += round(seconds * 1e9)
        self.wall_ns += round(seconds * (1.0 + drift) * 1e9)


def test_a_step_of_the_wall_clock_is_seen_either_way_and_slow_drift_is_not() -> None:
    clocks = TwoClocks()
    watch = ClockWatch(clocks)  # type: ignore[arg-type]  # only the time is read
    seen = []
    for k in range(200):
        clocks.go(0.25, drift=2e-4)
        if k in {50, 120}:
            clocks.wall_ns += {50: 3_600_000_000_000, 120: -2_000_000_000}[k]
        seen.append(watch.look())
    steps = [step for step in seen if step is not None]
    assert steps == [pytest.approx(3600.0, abs=0.01), pytest.approx(-2.0, abs=0.01)]
    assert watch.steps == 2


def test_the_board_measures_time_and_memory_of_this_process(tmp_path: Path) -> None:
    read = Board(tmp_path)(123)
    assert read.time_ns == 123
    assert 0.0 < read.cpu <= sum(os.times()[:2]) + 0.05
    assert 5 * MIB < read.resident < 5e9
    assert read.proportional > 5 * MIB
    assert read.disk_free > 0.0


def test_the_board_reads_what_the_kernel_writes_and_nothing_where_it_writes_nothing(tmp_path: Path) -> None:
    process = tmp_path / "proc" / str(os.getpid())
    (process / "task" / "1").mkdir(parents=True)
    # The process name contains spaces and brackets. utime is 250 ticks and stime is 50 ticks (proc(5)).
    (process / "stat").write_text(f"{os.getpid()} (a ) b) S " + " ".join(["0"] * 10) + " 250 50 " + "0 " * 30)
    (process / "statm").write_text("1000 512 100 1 0 200 0")
    (process / "smaps_rollup").write_text("Rss: 9000 kB\nPss:   4096 kB\nPss_Dirty: 1 kB\n")
    (process / "task" / "1" / "children").write_text("77 78 ")
    (tmp_path / "proc" / "77").mkdir()
    (tmp_path / "proc" / "77" / "smaps_rollup").write_text("Pss: 1024 kB\n")
    # A worker that has ended, but whose parent has not waited for it, has no memory.
    (tmp_path / "proc" / "78").mkdir()
    (tmp_path / "proc" / "78" / "stat").write_text("78 (python) Z " + "0 " * 40)
    zone = tmp_path / "thermal" / "thermal_zone0"
    zone.mkdir(parents=True)
    (zone / "temp").write_text("51500\n")
    read = Board(tmp_path, tmp_path / "proc", tmp_path / "thermal")(0)
    assert read.cpu == 300 / os.sysconf("SC_CLK_TCK")
    assert read.resident == 512 * os.sysconf("SC_PAGE_SIZE")
    assert read.proportional == 5 * MIB
    assert read.temperature == 51.5
    nothing = Board(tmp_path / "gone", tmp_path / "none", tmp_path / "none")(0)
    assert math.isnan(nothing.cpu)
    assert math.isnan(nothing.temperature)
    assert math.isnan(nothing.disk_free)


def measured_slope(count: int, window: float = 30.0) -> float:
    """Return the measured slope of a memory that grows by 5 kB/s, from `count` samples 5 s apart."""
    monitor = ResourceMonitor(Health(look_period=5.0, warm_up=0.0, slope_window=window))
    for k in range(count):
        monitor.ingest(sample(5.0 * k, proportional=150 * MIB + 5e3 * 5.0 * k))
    return monitor.state.memory_slope


def test_a_slope_needs_eight_samples_and_its_window() -> None:
    assert math.isnan(measured_slope(7))
    assert measured_slope(8) == pytest.approx(5e3)
    assert math.isnan(measured_slope(8, 35.1))
    assert measured_slope(8, 35.0) == pytest.approx(5e3)


def test_an_hour_of_samples_is_kept() -> None:
    """If a memory is constant for an hour and then grows by 1 MiB in an hour, the slope is 1 MiB/h.

    Only samples of the last hour are kept.
    """
    monitor = ResourceMonitor(Health(look_period=60.0, warm_up=0.0, slope_window=600.0))
    for k in range(121):
        monitor.ingest(sample(60.0 * k, proportional=150 * MIB + MIB * max(0.0, (k - 60) / 60.0)))
    assert monitor.state.memory_slope * 3600.0 == pytest.approx(MIB, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "at", "over"),
    [
        ("cpu", 0.7, 0.71),
        ("proportional", 1e9, 1.001e9),
        ("disk_free", 2e8, 1.99e8),
        ("temperature", 80.0, 80.1),
    ],
)
def test_a_value_at_its_limit_is_allowed(name: str, at: float, over: float) -> None:
    for value, reported in ((at, False), (over, True)):
        samples = [sample(5.0 * k, **{name: 5.0 * k * value if name == "cpu" else value}) for k in range(6)]
        _, record = watched(samples)
        assert bool(record.names) is reported


def test_the_share_of_the_processor_is_that_between_two_samples() -> None:
    monitor = ResourceMonitor(SETTINGS)
    monitor.ingest(sample(0.0, cpu=1.0))
    assert math.isnan(monitor.state.cpu_share)
    monitor.ingest(sample(4.0, cpu=3.0))
    assert monitor.state.cpu_share == 0.5
    monitor.ingest(sample(4.0, cpu=3.0))
    assert math.isnan(monitor.state.cpu_share)


@pytest.mark.parametrize(("step_ns", "seen"), [(500_000_000, False), (500_000_001, True)])
def test_a_step_of_more_than_half_a_second_is_reported(step_ns: int, seen: bool) -> None:
    clocks = TwoClocks()
    watch = ClockWatch(clocks)  # type: ignore[arg-type]  # only the time is read
    assert watch.look() is None
    clocks.wall_ns -= step_ns
    assert (watch.look() is not None) is seen
    assert watch.steps == int(seen)


def group(name: str, period_ns: int = 25_000_000) -> Any:
    """Return a test double of a rate group for the health task."""
    return SimpleNamespace(
        name=name, period_ns=period_ns, completed=0, cycles=7, slips=2, overruns=1,
        mean_execution_ns=3_000_000.0, max_execution_ns=9_000_000,
    )  # fmt: skip


class Group:
    """A hashable rate group."""

    def __init__(self, name: str, period_ns: int) -> None:
        self.name, self.period_ns, self.completed = name, period_ns, 0


SECOND = 1_000_000_000


@pytest.mark.parametrize(("period_ns", "limit_ns"), [(25_000_000, 2 * SECOND), (SECOND, 3 * SECOND)])
def test_a_group_is_stalled_after_three_periods_and_two_seconds(period_ns: int, limit_ns: int) -> None:
    one = Group("control", period_ns)
    watch = GroupsAndWorkers([cast(Any, one)], [])
    watch.begin(5)
    assert watch.stalled(5 + limit_ns) == []
    assert watch.stalled(6 + limit_ns) == ["control"]
    one.completed = 1
    assert watch.stalled(10 * SECOND) == []
    assert watch.stalled(10 * SECOND + limit_ns) == []
    assert watch.stalled(10 * SECOND + limit_ns + 1) == ["control"]


def test_a_worker_is_stalled_while_its_job_runs_beyond_the_limit() -> None:
    since: list[int | None] = [None]
    watch = GroupsAndWorkers([], [WorkerWatch("planner", lambda: since[0], 3 * SECOND)])
    assert watch.stalled(100 * SECOND) == []
    since[0] = 100 * SECOND
    assert watch.stalled(103 * SECOND) == []
    assert watch.stalled(103 * SECOND + 1) == ["planner"]


def test_a_job_on_a_ticker_fails_when_it_raises_or_stands_still() -> None:
    def ticker(served_ns: int, error: str = "", period_ns: int = SECOND) -> Any:
        return SimpleNamespace(name="log", served_ns=served_ns, error=error, period_ns=period_ns)

    now = 10 * SECOND
    assert failing([ticker(now - 3 * SECOND)], now) == []
    assert failing([ticker(now - 3 * SECOND - 1)], now) == ["log: has not run for 3.0 s"]
    assert failing([ticker(now - 2 * SECOND, period_ns=1)], now) == []
    assert failing([ticker(now - 2 * SECOND - 1, period_ns=1)], now) == ["log: has not run for 2.0 s"]
    assert failing([ticker(now, "disk full"), ticker(now)], now) == ["log: disk full"]


class Observed:
    """The performance observer, with a record of its actions."""

    def __init__(self) -> None:
        self.offs = 0
        self.times: list[tuple[str, dict[str, Any]]] = []
        self.events: list[tuple[str, str]] = []
        recorder = SimpleNamespace(time=lambda packet, _, **values: self.times.append((packet.name, values)))
        log = EventLog(lambda kind, _, held, text: self.events.append((kind.name, text)), throttle_ns=0)
        services = SimpleNamespace(clock=SimpleNamespace(now_ns=lambda: 9), recorder=recorder, events=log)
        self.observer = PerformanceObserver(cast(Any, SimpleNamespace(off=self._off)), cast(Any, services))

    def _off(self) -> None:
        self.offs += 1


def test_only_the_cycles_of_control_are_recorded_with_lateness_and_duration() -> None:
    seen = Observed()
    cycle = cast(Any, SimpleNamespace(slot=4, start_ns=1_000_300_000, due_ns=1_000_000_000))
    seen.observer.ran(group("health"), cycle, 5)
    assert seen.times == []
    seen.observer.ran(group("control"), cycle, 2_000_000)
    assert seen.times == [
        ("cycle_timing", {"cycle": 4, "lateness": pytest.approx(3e-4), "execution": pytest.approx(2e-3)})
    ]


def test_only_the_slips_of_control_are_events() -> None:
    seen = Observed()
    seen.observer.slipped(group("health"), 3)
    assert seen.events == []
    seen.observer.slipped(group("control"), 3)
    assert seen.events == [("cycle-slip", "control: 3 slots skipped, 2 since start")]


def test_a_failure_of_control_zeroes_the_coils_and_any_failure_is_an_event() -> None:
    seen = Observed()
    for name, offs in (("health", 0), ("control", 1)):
        try:
            raise ValueError("no number")
        except ValueError as error:
            seen.observer.failed(group(name), error)
        assert seen.offs == offs
        assert seen.events[-1][0] == "task-failed"
        assert seen.events[-1][1].startswith(f"{name}: ValueError: no number (test_a_failure_of_control")


def test_the_statistics_of_groups_and_jobs_are_in_seconds() -> None:
    seen = Observed()
    seen.observer.group(group("health", SECOND), 0)
    seen.observer.job(
        cast(Any, SimpleNamespace(worker="vision", execution_ns=SECOND // 4, outcome="done")), 0
    )
    assert seen.times == [
        (
            "rate_group",
            {
                "name": "health", "period": 1.0, "cycles": 7, "slips": 2, "overruns": 1,
                "mean": pytest.approx(3e-3), "max": pytest.approx(9e-3),
            },
        ),
        ("job_timing", {"name": "vision", "execution": 0.25, "outcome": "done"}),
    ]  # fmt: skip


def test_lost_records_are_reported_with_their_number_since_the_last_call() -> None:
    said: list[tuple[Any, str]] = []
    recorder = SimpleNamespace(lost=0, lost_text="")
    log = SimpleNamespace(report=lambda kind, _, text: said.append((kind, text)), count=0)
    services = cast(Any, SimpleNamespace(recorder=recorder, events=log, facts=None))
    housekeeping = cast(Any, Housekeeping)(*(None,) * 5, lambda: "", services)
    housekeeping.report_lost(0)
    assert said == []
    recorder.lost, recorder.lost_text = 3, "too long"
    housekeeping.report_lost(1)
    recorder.lost = 4
    housekeeping.report_lost(2)
    housekeeping.report_lost(3)
    assert [kind for kind, _ in said] == [events.RECORD_LOST] * 2
    assert said[0][1].startswith("3 ")
    assert "too long" in said[0][1]
    assert said[1][1].startswith("1 ")
