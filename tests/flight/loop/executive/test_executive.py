"""The executive runs groups in order, survives their failures and never bursts."""

from __future__ import annotations

from itertools import pairwise

from flight.loop.executive.executive import Executive
from flight.loop.executive.rate_group import Cycle, RateGroup
from sim_hal.clock import SimClock

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
    Executive(SimClock(), groups, notes).run(0, 200 * MS)
    assert notes.cycles[:3] == [("fast", 0), ("slow", 0), ("fast", 1)]
    assert [slot for name, slot in notes.cycles if name == "fast"] == list(range(8))
    assert [slot for name, slot in notes.cycles if name == "slow"] == [0, 1]
    assert notes.slips == []


def test_a_task_that_stalls_makes_slips_and_then_the_grid_goes_on() -> None:
    clock, notes = SimClock(), Notes()
    starts: list[int] = []

    def stall_once(cycle: Cycle) -> None:
        starts.append(clock.now_ns())
        if cycle.slot == 2:
            clock.sleep_until_ns(clock.now_ns() + 1000 * MS)

    fast = RateGroup("fast", 25 * MS, stall_once)
    Executive(clock, [fast], notes).run(0, 2000 * MS)
    assert sum(slots for _, slots in notes.slips) == fast.slips == 39
    assert fast.cycles + fast.slips == 80
    assert min(b - a for a, b in pairwise(starts)) == 25 * MS


def test_an_exception_in_a_task_is_reported_and_the_loop_goes_on() -> None:
    notes = Notes()

    def fail(cycle: Cycle) -> None:
        if cycle.slot == 1:
            raise ZeroDivisionError("on purpose")

    fast = RateGroup("fast", 25 * MS, fail)
    Executive(SimClock(), [fast], notes).run(0, 100 * MS)
    assert notes.failures == ["fast: on purpose"]
    assert fast.cycles == 4


def test_execution_times_come_from_the_stopwatch() -> None:
    readings = iter(range(0, 10**9, 7 * MS))
    fast = RateGroup("fast", 5 * MS, lambda _: None)
    Executive(SimClock(), [fast], Notes(), stopwatch=lambda: next(readings)).run(0, 10 * MS)
    assert fast.max_execution_ns == 7 * MS
    assert fast.overruns == 2


def test_stop_ends_the_loop_after_the_running_cycle() -> None:
    notes = Notes()
    holder: list[Executive] = []

    def stop(cycle: Cycle) -> None:
        if cycle.slot == 3:
            holder[0].stop()

    executive = Executive(SimClock(), [RateGroup("fast", MS, stop), RateGroup("slow", MS, stop)], notes)
    holder.append(executive)
    executive.run(0, 10**12)
    assert notes.cycles[-1] == ("fast", 3)
