"""Tests of the times at which the guardian commands zero current, on a manual clock."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hal.guardian import FINAL_ZEROS, PATIENCE_NS, REPEAT_NS, SILENCE_NS, Watch

MS = 1_000_000


def test_before_the_first_heartbeat_zero_is_said_at_once_and_again() -> None:
    watch = Watch(0)
    assert watch.attempt(0)
    assert not watch.attempt(REPEAT_NS - 1)
    assert watch.attempt(REPEAT_NS)
    assert watch.outages == 0, "nothing has fallen silent yet"


@given(st.lists(st.integers(0, SILENCE_NS - 1), max_size=40))
def test_a_heart_that_beats_in_time_is_left_alone(gaps: list[int]) -> None:
    watch, now_ns = Watch(0), 0
    watch.beat(0)
    for gap in gaps:
        now_ns += gap
        assert not watch.attempt(now_ns)
        watch.beat(now_ns)


def test_silence_is_acted_on_after_its_time_and_counted_once() -> None:
    watch = Watch(0)
    watch.beat(0)
    assert watch.due_ns == SILENCE_NS
    assert [watch.attempt(at * MS) for at in (299, 300, 350, 400, 500)] == [False, True, False, True, True]
    assert watch.outages == 1


def test_a_heartbeat_after_silence_releases_at_once() -> None:
    watch = Watch(0)
    watch.beat(0)
    watch.attempt(SILENCE_NS)
    watch.beat(SILENCE_NS + 1)
    assert not watch.attempt(SILENCE_NS + REPEAT_NS)
    assert watch.attempt(2 * SILENCE_NS + 1)
    assert watch.outages == 2


def test_an_orphan_acts_at_once_and_ends_after_its_last_words() -> None:
    watch, now_ns = Watch(0), 5 * MS
    watch.beat(0)
    watch.orphan(now_ns)
    for _ in range(FINAL_ZEROS):
        assert not watch.over(now_ns)
        assert watch.attempt(now_ns)
        watch.acknowledged()
        now_ns += REPEAT_NS
    assert watch.over(now_ns)


def test_an_orphan_that_reaches_nobody_gives_up_in_the_end() -> None:
    watch = Watch(0)
    watch.orphan(0)
    assert not watch.over(PATIENCE_NS)
    assert watch.over(PATIENCE_NS + 1)


def test_who_is_not_an_orphan_never_ends() -> None:
    watch = Watch(0)
    for _ in range(10):
        watch.acknowledged()
    assert not watch.over(10**15)
