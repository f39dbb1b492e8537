"""Resources: shares and slopes of the samples, bounds with persistence, and steps of the wall clock."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from flight.loop import facts
from flight.loop.health import Board, ClockWatch, ResourceMonitor, ResourceSample
from flight.schema.sections import Health
from tests.flight.loop.records import EventRecord

MIB = 1024.0 * 1024.0
SETTINGS = Health(look_period=5.0, warm_up=20.0, slope_window=100.0)


def sample(seconds: float, **changes: float) -> ResourceSample:
    sound = ResourceSample(round(seconds * 1e9), 0.2 * seconds, 80 * MIB, 150 * MIB, 1e10, 45.0)
    return replace(sound, **changes)  # type: ignore[arg-type]  # never the time


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
def test_a_bound_that_is_passed_is_reported_after_some_looks_and_never_for_one(
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


def test_what_the_board_does_not_have_is_neither_good_nor_bad() -> None:
    samples = [sample(5.0 * k, temperature=math.nan, disk_free=math.nan) for k in range(10)]
    _, record = watched(samples)
    assert record.names == []


class TwoClocks:
    """Monotonic time and UTC, each set by hand."""

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
    watch = ClockWatch(clocks)  # type: ignore[arg-type]  # of a clock it asks the time only
    seen = []
    for k in range(200):
        clocks.go(0.25, drift=2e-4)
        if k in {50, 120}:
            clocks.wall_ns += {50: 3_600_000_000_000, 120: -2_000_000_000}[k]
        seen.append(watch.look())
    steps = [step for step in seen if step is not None]
    assert steps == [pytest.approx(3600.0, abs=0.01), pytest.approx(-2.0, abs=0.01)]
    assert watch.steps == 2


def test_the_board_shows_of_this_very_process(tmp_path: Path) -> None:
    read = Board(tmp_path)(123)
    assert read.time_ns == 123
    assert 0.0 < read.cpu <= sum(os.times()[:2]) + 0.05
    assert 5 * MIB < read.resident < 5e9
    assert read.proportional > 5 * MIB
    assert read.disk_free > 0.0


def test_the_board_reads_what_the_kernel_writes_and_nothing_where_it_writes_nothing(tmp_path: Path) -> None:
    process = tmp_path / "proc" / str(os.getpid())
    (process / "task" / "1").mkdir(parents=True)
    # A name with spaces and brackets in it; utime 250, stime 50 ticks (proc(5)).
    (process / "stat").write_text(f"{os.getpid()} (a ) b) S " + " ".join(["0"] * 10) + " 250 50 " + "0 " * 30)
    (process / "statm").write_text("1000 512 100 1 0 200 0")
    (process / "smaps_rollup").write_text("Rss: 9000 kB\nPss:   4096 kB\nPss_Dirty: 1 kB\n")
    (process / "task" / "1" / "children").write_text("77 78 ")
    (tmp_path / "proc" / "77").mkdir()
    (tmp_path / "proc" / "77" / "smaps_rollup").write_text("Pss: 1024 kB\n")
    # A worker that has ended and was not waited for has no memory.
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
