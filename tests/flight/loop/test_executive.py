"""Tests that rate groups keep their time grid with any clock, continue after failures and never burst."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.loop.executive import Cycle, CyclicExecutive, RateGroup
from knightcube.errors import KnightCubeError
from sim_hal.clock import SimClock

PERIOD = 25_000_000


def group() -> RateGroup:
    made = RateGroup("control", PERIOD, lambda _: None)
    made.begin(1000)
    return made


def test_nothing_runs_before_it_is_due() -> None:
    assert group().claim(999) == (None, 0)


def test_slots_on_time_run_one_after_the_other() -> None:
    made = group()
    for slot in range(4):
        now = 1000 + slot * PERIOD
        assert made.claim(now) == (Cycle(slot, now, now), 0)
        assert made.claim(now) == (None, 0)


def test_a_cycle_less_than_half_a_period_late_still_runs_in_its_slot() -> None:
    made = group()
    late = 1000 + PERIOD // 2 - 1
    assert made.claim(late) == (Cycle(0, 1000, late), 0)
    assert made.due_ns == 1000 + PERIOD


def test_a_cycle_more_than_half_a_period_late_is_skipped_and_counted() -> None:
    made = group()
    assert made.claim(1000 + PERIOD // 2) == (None, 1)
    assert made.slips == 1
    assert made.due_ns == 1000 + PERIOD


def test_after_a_long_stall_one_cycle_runs_and_the_rest_are_slips_not_a_burst() -> None:
    made = group()
    stall = 1000 + 43 * PERIOD + 1
    assert made.claim(stall) == (Cycle(43, 1000 + 43 * PERIOD, stall), 43)
    assert made.claim(stall) == (None, 0)
    assert made.slips == 43


@given(st.lists(st.integers(min_value=0, max_value=5 * PERIOD), min_size=1, max_size=60))
def test_slots_run_and_slots_skipped_are_together_the_slots_that_passed(pauses: list[int]) -> None:
    made = group()
    now, ran, last_start = 1000, 0, None
    for pause in pauses:
        now += pause
        before = made.due_ns
        cycle, _ = made.claim(now)
        if cycle is not None:
            ran += 1
            assert cycle.due_ns <= now < cycle.due_ns + PERIOD / 2
            if last_start is not None:
                assert now - last_start > PERIOD / 2
            last_start = now
        assert made.due_ns >= before
        assert made.due_ns > now
        assert ran + made.slips == (made.due_ns - 1000) // PERIOD


def test_execution_times_and_overruns_are_accounted() -> None:
    made = group()
    made.account(PERIOD)
    assert made.overruns == 0
    made.account(PERIOD + 1)
    assert (made.cycles, made.overruns, made.max_execution_ns) == (2, 1, PERIOD + 1)
    assert made.mean_execution_ns == PERIOD + 0.5


def test_a_period_of_zero_is_refused() -> None:
    with pytest.raises(KnightCubeError, match="not positive"):
        RateGroup("control", 0, lambda _: None)


MS = 1_000_000


class Notes:
    """An observer that records all reports."""

    def __init__(self) -> None:
        self.cycles: list[tuple[str, int]] = []
        self.slips: list[tuple[str, int]] = []
        self.failures: list[str] = []

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        self.cycles.append((group.name, cycle.slot))

    def slipped(self, group: RateGroup, slots: int) -> None:
        self.slips.append((group.name, slots))

    def failed(self, group: RateGroup, error: Exception) -> None:
        self.failures.append(f"{group.name}: {error}")


def test_groups_run_at_their_rates_the_more_important_first() -> None:
    notes = Notes()
    groups = [RateGroup("fast", 25 * MS, lambda _: None), RateGroup("slow", 100 * MS, lambda _: None)]
    CyclicExecutive(SimClock(), groups, notes).run(0, 200 * MS)
    assert notes.cycles[:3] == [("fast", 0), ("slow", 0), ("fast", 1)]
    assert [slot for name, slot in notes.cycles if name == "fast"] == list(range(8))
    assert [slot for name, slot in notes.cycles if name == "slow"] == [0, 1]
    assert notes.slips == []


def test_a_task_that_stalls_causes_slips_and_then_the_grid_continues() -> None:
    clock, notes = SimClock(), Notes()
    starts: list[int] = []

    def stall_once(cycle: Cycle) -> None:
        starts.append(clock.now_ns())
        if cycle.slot == 2:
            clock.sleep_until_ns(clock.now_ns() + 1000 * MS)

    fast = RateGroup("fast", 25 * MS, stall_once)
    CyclicExecutive(clock, [fast], notes).run(0, 2000 * MS)
    assert sum(slots for _, slots in notes.slips) == fast.slips == 39
    assert fast.cycles + fast.slips == 80
    assert min(b - a for a, b in pairwise(starts)) == 25 * MS


def test_an_exception_in_a_task_is_reported_and_the_loop_goes_on() -> None:
    notes = Notes()

    def fail(cycle: Cycle) -> None:
        if cycle.slot == 1:
            raise ZeroDivisionError("on purpose")

    fast = RateGroup("fast", 25 * MS, fail)
    CyclicExecutive(SimClock(), [fast], notes).run(0, 100 * MS)
    assert notes.failures == ["fast: on purpose"]
    assert fast.cycles == 4


def test_execution_times_come_from_the_stopwatch() -> None:
    readings = iter(range(0, 10**9, 7 * MS))
    fast = RateGroup("fast", 5 * MS, lambda _: None)
    CyclicExecutive(SimClock(), [fast], Notes(), stopwatch=lambda: next(readings)).run(0, 10 * MS)
    assert fast.max_execution_ns == 7 * MS
    assert fast.overruns == 2


def test_stop_ends_the_loop_after_the_running_cycle() -> None:
    notes = Notes()
    holder: list[CyclicExecutive] = []

    def stop(cycle: Cycle) -> None:
        if cycle.slot == 3:
            holder[0].stop()

    executive = CyclicExecutive(SimClock(), [RateGroup("fast", MS, stop), RateGroup("slow", MS, stop)], notes)
    holder.append(executive)
    executive.run(0, 10**12)
    assert notes.cycles[-1] == ("fast", 3)
