"""Tests of lateness, lost slots, memory and waits, with samples of known results."""

from __future__ import annotations

import mmap
import os
import time
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.support import process_watch
from tests.support.executive_figures import (
    PERIOD_NS,
    SLOPE_SPAN,
    judged_slope,
    waits,
)
from tests.support.lateness import Grid, on_grid, robbed, slope_per_hour, stalled
from tests.support.process_watch import Look

FIRST = 1000
_IN_TIME = np.full(12, 100_000)


def _grid(late_ns: npt.ArrayLike) -> Grid:
    """Return a loop with a given lateness at each slot.

    If a slot is more than a period late, the next slot is skipped.
    """
    late = np.asarray(late_ns, dtype=np.int64)
    starts = np.maximum.accumulate((FIRST + np.arange(len(late))) * PERIOD_NS + late)
    return on_grid(np.unique(starts), PERIOD_NS, FIRST, len(late))


def test_a_stall_of_two_periods_loses_the_slots_that_the_loop_was_half_a_period_late_for() -> None:
    stalled = _IN_TIME.copy()
    stalled[4] = 2 * PERIOD_NS + 1_000_000
    grid = _grid(stalled)
    assert np.flatnonzero(grid.lost).tolist() == [4, 5]
    assert grid.lateness[4:7] == pytest.approx([0.051, 0.026, 0.001], abs=1e-12)
    assert grid.figures()["max"] == pytest.approx(0.051)
    assert grid.figures()["p50"] == pytest.approx(1e-4)


def test_slots_after_the_end_of_a_loop_are_lost() -> None:
    starts = (FIRST + np.arange(5)) * PERIOD_NS
    assert np.flatnonzero(on_grid(starts, PERIOD_NS, FIRST, 7).lost).tolist() == [5, 6]


@pytest.mark.parametrize(("machine_at", "beyond"), [(6, 0), (5, 0), (4, 1), (None, 1)])
def test_a_lost_slot_is_the_machines_only_when_the_bare_loop_lost_it_or_its_neighbour(
    machine_at: int | None, beyond: int
) -> None:
    flight, machine = _IN_TIME.copy(), _IN_TIME.copy()
    flight[6] = 15_000_000
    if machine_at is not None:
        machine[machine_at] = 14_000_000
    lost_beyond = np.count_nonzero(_grid(flight).lost & ~stalled(_grid(machine)))
    assert lost_beyond == beyond


@pytest.mark.parametrize(
    ("late_ms", "taken_ms", "found"),
    [
        (15, 20, True),
        (15, 10, False),
        # A small load that is always present does not count as the cause of the loop's lateness.
        (90, 40, False),
        (90, 50, True),
    ],
)
def test_a_slot_is_the_hosts_when_it_took_what_makes_it_lost(
    late_ms: int, taken_ms: int, found: bool
) -> None:
    late = _IN_TIME.copy()
    late[6] = late_ms * 1_000_000
    noted_ns = (FIRST + np.arange(-2, 16)) * PERIOD_NS + 100_000
    stolen_ns = 7_000_000_000 + np.where(np.arange(-2, 16) >= 7, taken_ms * 1_000_000, 0)
    grid = _grid(late)
    assert bool(robbed(grid, noted_ns, stolen_ns)[6]) is found
    assert not robbed(grid, noted_ns, stolen_ns)[[0, 1, 2, 3, 4, 11]].any()


def test_a_leak_is_seen_through_the_memory_of_jobs_that_come_and_go() -> None:
    """A leak is detected in spite of jobs whose memory comes and goes.

    Half of the samples include a job of 50 MiB. The true slope is in at least 16 of the 95 % intervals.
    """
    seconds = np.arange(0.0, 600.0, 0.5)
    held = {0.0: 0, 5.0: 0}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        level = 150.0 + rng.normal(0.0, 0.2, len(seconds)) + 50.0 * (rng.random(len(seconds)) < 0.5)
        for leak in held:
            _, low, high = slope_per_hour(seconds, level + leak * seconds / 3600.0)
            held[leak] += low <= leak <= high
            assert high - low < 4.0
    assert min(held.values()) >= 16


def test_a_flight_too_short_for_a_slope_has_none() -> None:
    assert np.isnan(slope_per_hour(np.arange(20.0), np.arange(20.0))).all()


def test_memory_that_a_process_touches_is_seen_and_its_processor_time_too() -> None:
    """The memory that a process touches, and its processor time, are measured.

    The best of three measurements is checked, because the ends of other processes change shared pages.
    """
    me = {"me": os.getpid()}
    process_watch.unshared(me)  # the first call allocates the memory that sampling needs
    proportional, private = [], []
    for _ in range(3):
        before, alone = process_watch.look(me), process_watch.unshared(me)
        # The memory is mapped, because the heap would reuse memory that earlier tests have freed.
        held = np.frombuffer(mmap.mmap(-1, 32 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS))
        spent = time.process_time()
        while time.process_time() - spent < 0.1:
            held += 1.0
        after = process_watch.look(me)
        proportional.append(abs(after.memory["me"] - before.memory["me"] - (32 << 20)))
        private.append(abs(process_watch.unshared(me) - alone - (32 << 20)))
        assert 0.05 < after.processor["me"] - before.processor["me"] < 1.0
        assert alone >= before.memory["me"] - (1 << 20)
        del held
    assert min(proportional) < 6 << 20
    assert min(private) < 6 << 20


def test_a_slope_is_given_from_minutes_on_and_not_before() -> None:
    seconds = np.arange(0.0, SLOPE_SPAN + 1.0, 0.5)
    levels = 100.0 + 12.0 * seconds / 3600.0
    assert judged_slope(seconds.tolist(), levels.tolist()) == pytest.approx((12.0, 12.0, 12.0))
    assert np.isnan(judged_slope(seconds[:-4].tolist(), levels[:-4].tolist())).all()


def test_a_cycle_that_waits_is_blocked_and_one_without_a_processor_is_queued() -> None:
    """A cycle that waits for a worker is blocked, and a cycle that waits for the processor is queued.

    Each cycle of 20 ms has 2 ms of work, and then the thread waits for a worker or for the processor.
    """
    starts, execution = np.arange(0.0, 4.0, 0.025), np.full(160, 0.02)

    def found(on: float, queued: float) -> dict[str, Any]:
        looks = [Look(t, {}, {}, {}, {"control": (t * on, t * queued)}) for t in (0.0, 4.0)]
        return waits(looks, starts, execution)

    assert found(0.08, 0.0) == pytest.approx({"queued": 0.0, "blocked": 0.72}, abs=0.01)
    assert found(0.08, 0.8) == pytest.approx({"queued": 0.8, "blocked": 0.0}, abs=0.01)
