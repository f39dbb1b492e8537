"""Tests of load shedding with test doubles: indications of overload, order of levels, recovery, telemetry."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link import events
from flight.loop.health import LEVELS, BusyPeriods, OverloadSign, Shedding, ShedLevel
from flight.loop.navigation import Navigation

S = 1_000_000_000


class Bench:
    """A load-shedding task, and counters by which a test simulates an overload."""

    def __init__(self) -> None:
        self.frames = self.cycles = 0
        self.busy_since_ns: int | None = None
        self.applied: list[ShedLevel] = []
        self.reports: list[tuple[Any, int, str]] = []
        self.records: list[dict[str, Any]] = []
        self.second = 0
        services = SimpleNamespace(
            events=SimpleNamespace(report=lambda *row: self.reports.append(row)),
            recorder=SimpleNamespace(record=lambda _, now_ns, **values: self.records.append(values)),
        )
        plans = BusyPeriods(lambda: self.busy_since_ns, 5 * S)
        self.task = Shedding(
            [
                OverloadSign("cycles", lambda: self.cycles, 3),
                OverloadSign("plans", lambda: plans.count, 1),
                OverloadSign("frames", lambda: self.frames, 2),
            ],
            plans,
            self.applied.append,
            lambda: (7, self.frames),
            cast(Any, services),
        )

    def run(self, seconds: int, *, frames: bool = False, cycles: bool = False) -> int:
        """Run the task once a second, with indications of overload in each second; return the level."""
        for _ in range(seconds):
            self.second += 1
            self.frames += frames
            self.cycles += cycles
            self.task.run(self.cycles, self.second * S)
        return LEVELS.index(self.applied[-1]) if self.applied else 0


def test_levels_reduce_readings_first_then_the_search_then_frames_then_plans_and_never_restore_work() -> None:
    reduced: dict[str, list[bool]] = {
        "readings": [not level.every_reading for level in LEVELS],
        "search": [not level.search for level in LEVELS],
        "frames": [level.frame_every > 1 for level in LEVELS],
        "plans": [level.plan_every > 1 for level in LEVELS],
    }
    first = {name: levels.index(True) for name, levels in reduced.items()}
    assert first["readings"] < first["search"] < first["frames"] < first["plans"]
    for before, after in itertools.pairwise(LEVELS):
        assert after.every_reading <= before.every_reading
        assert after.search <= before.search
        assert after.frame_every >= before.frame_every
        assert after.plan_every >= before.plan_every


def test_without_signs_nothing_is_reduced_or_recorded() -> None:
    bench = Bench()
    bench.task._frames = lambda: (0, 0)
    assert bench.run(600) == 0
    assert not bench.reports
    assert not bench.records


@pytest.mark.parametrize("sign", ["frames", "cycles"])
def test_an_overload_raises_the_level_step_by_step_to_the_last(sign: str) -> None:
    bench = Bench()
    levels = [bench.run(1, **{sign: True}) for _ in range(120)]
    assert levels[-1] == len(LEVELS) - 1
    assert sorted(levels) == levels
    raises = [i for i in range(1, 120) if levels[i] > levels[i - 1]]
    assert min(b - a for a, b in itertools.pairwise(raises)) >= 10
    assert [kind for kind, *_ in bench.reports] == [events.WORK_SHED] * (len(LEVELS) - 1)
    assert bench.reports[0][2].endswith(f": {sign}")


def test_single_late_frames_and_stalls_of_the_machine_reduce_nothing() -> None:
    bench = Bench()
    for _ in range(5):
        bench.run(1, frames=True)
        bench.run(2, cycles=True)
        assert bench.run(70) == 0


def test_work_returns_when_there_is_room_and_later_after_a_relapse() -> None:
    bench = Bench()
    assert bench.run(11, frames=True) == 1
    assert bench.run(58) == 1
    assert bench.run(5) == 0
    assert bench.reports[-1][0] is events.WORK_RESTORED
    assert bench.run(11, frames=True) == 1
    assert bench.run(100) == 1, "the next return is later"
    assert bench.run(25) == 0


def test_a_long_plan_counts_once() -> None:
    bench = Bench()
    bench.busy_since_ns = 1 * S
    assert bench.run(30) == 1
    assert bench.records[-1]["plans_late"] == 1


def test_periodic_plans_become_rarer_and_are_counted() -> None:
    bench = Bench()
    assert all(bench.task.makes_plan(slot) for slot in range(8))
    bench.run(120, frames=True)
    made = [bench.task.makes_plan(slot) for slot in range(80)]
    assert sum(made) == 80 // LEVELS[-1].plan_every
    bench.run(1)
    assert bench.records[-1]["plans_shed"] == 80 - sum(made)


def test_level_and_counters_are_recorded_when_they_change() -> None:
    bench = Bench()
    bench.run(3, frames=True)
    bench.run(30)
    assert [(row["level"], row["frames_late"]) for row in bench.records] == [(0, 1), (1, 2), (1, 3)]


def test_thinned_navigation_uses_the_newest_reading_of_a_cycle_and_watches_all() -> None:
    ingested: list[Any] = []
    noted: list[Any] = []
    navigation = object.__new__(Navigation)
    readings = [
        SimpleNamespace(time_ns=time_ns, field=np.ones(3), rate=np.ones(3), has_rate=True)
        for time_ns in (1, 2, 3)
    ]
    fakes: dict[str, Any] = {
        "_filter": SimpleNamespace(catch_up=lambda _: None, doubts_commands=False),
        "_unit": SimpleNamespace(poll=lambda: readings),
        "_facts": SimpleNamespace(update=lambda *_: None),
        "_streams": SimpleNamespace(note=lambda *row: noted.append(row[:2])),
        "_magnetometer": None,
        "_doubted": False,
        "_is_usable": lambda *_: True,
        "_ingest": ingested.append,
        "_watch_line": lambda _: None,
    }
    for name, value in fakes.items():
        setattr(navigation, name, value)
    for thinned in (False, True):
        ingested.clear()
        noted.clear()
        navigation.thin(thinned)
        used = navigation.update(10)
        assert list(used) == ingested == (readings[-1:] if thinned else readings)
        assert [time for name, time in noted if name == "imu"] == [1, 2, 3]
