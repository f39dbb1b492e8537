"""Crashes are counted per operating time, and only operating time ages them out."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from flight.loop.state.content import REMEMBERED, KeptTable, Learned, StoredState
from flight.loop.state.history import BootRecord, Noted, begin, boot_record, end, go_on

LABEL = "1970-01-01T00:00:00Z"


def boot(state: StoredState, seconds: float, clean: bool, utc: str = LABEL) -> StoredState:
    """Return the state after one boot."""
    begun = begin(state, utc)
    state = go_on(begun, seconds, Noted("hold", {}, begun.table), utc)
    return end(state) if clean else state


def test_the_first_boot_has_no_past() -> None:
    assert boot_record(begin(StoredState(), LABEL), 600.0) == BootRecord(1, 0, False, "")


def test_an_unclean_shutdown_is_remembered_and_a_clean_one_is_not() -> None:
    state = boot(boot(StoredState(), 100.0, clean=True), 100.0, clean=False)
    assert boot_record(begin(state, LABEL), 600.0) == BootRecord(3, 1, True, "hold")
    state = boot(state, 100.0, clean=True)
    assert boot_record(begin(state, LABEL), 600.0) == BootRecord(4, 1, False, "hold")
    assert [crash.boot for crash in begin(state, LABEL).unclean] == [2]


def test_a_crash_is_recent_until_the_application_has_run_for_the_window() -> None:
    state = boot(StoredState(), 50.0, clean=False)
    for ran, recent in ((600.0, 1), (600.5, 0)):
        assert boot_record(begin(boot(state, ran, clean=True), LABEL), 600.0).unclean_recent == recent


def test_crashes_at_once_are_never_forgotten_by_waiting() -> None:
    state = StoredState()
    for number in range(1, 6):
        state = boot(state, 0.0, clean=False, utc=f"20{number}0-01-01T00:00:00Z")
        assert boot_record(begin(state, LABEL), 600.0).unclean_recent == number


def test_a_clock_that_lies_changes_the_labels_and_nothing_else() -> None:
    honest, lying = StoredState(), StoredState()
    for number, clean in enumerate((False, True, False, False)):
        honest = boot(honest, 40.0, clean, f"2026-01-0{number + 1}T00:00:00Z")
        lying = boot(lying, 40.0, clean, f"{(2099, 1970, 2038, 1901)[number]}-01-01T00:00:00Z")
    assert boot_record(begin(honest, LABEL), 100.0) == boot_record(begin(lying, LABEL), 100.0)
    assert honest.unclean[0].utc == "2026-01-01T00:00:00Z"


def test_only_the_newest_crashes_are_kept() -> None:
    state = StoredState()
    for _ in range(REMEMBERED + 10):
        state = boot(state, 1.0, clean=False)
    crashes = begin(state, LABEL).unclean
    assert len(crashes) == REMEMBERED
    assert crashes[-1].boot == state.boot_count


def test_what_is_learned_again_replaces_the_old_and_the_rest_stays() -> None:
    first, second = Learned((1.0,), ((0.1,),)), Learned((2.0,), ((0.1,),))
    begun = begin(StoredState(learned={"a": first, "b": first}), LABEL)
    state = go_on(begun, 1.0, Noted("", {"a": second}, begun.table), LABEL)
    assert state.learned == {"a": second, "b": first}


def test_a_table_that_a_crash_left_unproven_gives_way_to_the_one_before() -> None:
    new = KeptTable(values={"modes.known_for": 2.0}, before={"modes.known_for": 3.0}, proven=False, loads=2)
    proven = KeptTable(values=new.values, before=new.before, proven=True, loads=2)
    for table, clean, flown in ((new, False, 3.0), (new, True, 2.0), (proven, False, 2.0)):
        state = begin(StoredState(running=not clean, table=table), LABEL)
        assert state.table.values == {"modes.known_for": flown}
        assert state.table.loads == 2
    # The one that gave way is not tried a second time, and the one before it stays after a second crash.
    again = begin(begin(StoredState(running=True, table=new), LABEL), LABEL)
    assert again.table.values == new.before


@given(st.lists(st.tuples(st.floats(0.0, 1e5), st.booleans()), max_size=20), st.floats(0.0, 1e5))
def test_the_count_is_that_of_the_crashes_in_the_window(
    boots: list[tuple[float, bool]], window: float
) -> None:
    state, ends, ran = StoredState(), [], 0.0
    for seconds, clean in boots:
        state = boot(state, seconds, clean)
        ran += seconds
        if not clean:
            ends.append(ran)
    begun = begin(state, LABEL)
    record = boot_record(begun, window)
    assert record.unclean_recent == sum(ran - at <= window for at in ends)
    assert record.boot_count == len(boots) + 1
    assert all(a.operated <= b.operated for a, b in pairwise(begun.unclean))
