"""Rate groups keep to their grid with any clock."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.loop.executive.rate_group import Cycle, RateGroup
from knightcube.errors import FlightError

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
    assert not made.account(PERIOD)
    assert made.account(PERIOD + 1)
    assert (made.cycles, made.overruns, made.max_execution_ns) == (2, 1, PERIOD + 1)
    assert made.mean_execution_ns == PERIOD + 0.5


def test_a_period_of_zero_is_refused() -> None:
    with pytest.raises(FlightError, match="not positive"):
        RateGroup("control", 0, lambda _: None)
