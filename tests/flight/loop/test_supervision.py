"""Tests that the watchdog is fed only while no rate group and no worker is stalled."""

from __future__ import annotations

from flight.loop.executive import RateGroup
from flight.loop.health import GroupsAndWorkers, WorkerWatch, failing
from tests.manual_clock import ManualClock

SECOND = 1_000_000_000


def groups() -> tuple[RateGroup, RateGroup]:
    return (
        RateGroup("control", SECOND // 40, lambda _: None),
        RateGroup("planning", 5 * SECOND, lambda _: None),
    )


def test_groups_with_completed_cycles_progress_and_a_group_that_only_fails_does_not() -> None:
    control, planning = groups()
    watch = GroupsAndWorkers([control, planning], [])
    watch.begin(0)
    for k in range(1, 40):
        control.account(1000, completed=k < 20)
        planning.account(1000)
        expected = ["control"] if k * SECOND // 4 - 19 * SECOND // 4 > 2 * SECOND else []
        assert watch.stalled(k * SECOND // 4) == expected


def test_a_slow_group_has_three_of_its_periods() -> None:
    control, planning = groups()
    watch = GroupsAndWorkers([control, planning], [])
    watch.begin(0)
    for quarter in range(1, 80):
        control.account(1000)
        still = watch.stalled(quarter * SECOND // 4)
        assert still == (["planning"] if quarter > 60 else [])


def test_a_worker_counts_as_progressing_while_idle_and_until_its_timeout() -> None:
    busy: list[int | None] = [None]
    watch = GroupsAndWorkers([], [WorkerWatch("planner", lambda: busy[0], 4 * SECOND)])
    assert watch.stalled(100 * SECOND) == []
    busy[0] = 100 * SECOND
    assert watch.stalled(104 * SECOND) == []
    assert watch.stalled(104 * SECOND + 1) == ["planner"]
    busy[0] = None
    assert watch.stalled(200 * SECOND) == []


def test_a_job_beside_the_loop_that_raises_is_reported_and_runs_again() -> None:
    clock, runs = ManualClock(), 0

    def job() -> None:
        nonlocal runs
        runs += 1
        if runs <= 2:
            raise OSError("no such device")

    clock.ticker("camera", SECOND, job)
    clock.advance(2 * SECOND)
    assert failing(clock.tickers, clock.now_ns()) == ["camera: OSError: no such device"]
    clock.advance(SECOND)
    assert (runs, failing(clock.tickers, clock.now_ns())) == (3, [])


def test_a_job_that_does_not_end_is_reported_after_three_periods() -> None:
    clock = ManualClock()
    ticker = clock.ticker("log", 4 * SECOND, lambda: None)
    clock.advance(4 * SECOND)
    end_ns = ticker.served_ns
    assert failing(clock.tickers, end_ns + 12 * SECOND) == []
    assert failing(clock.tickers, end_ns + 13 * SECOND) == ["log: has not run for 13.0 s"]
