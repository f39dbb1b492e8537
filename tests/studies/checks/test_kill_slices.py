"""Tests that the summaries of the kill campaigns report faults; the kills themselves run in the campaigns."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tests.studies.campaigns import process_kill, start

FLIGHT = {
    "acts": {"planner": 2, "guardian": 1},
    "reported": {"planner": 3, "guardian": 1},
    "left": [],
    "sent": "SIGKILL",
    "current_before_a": 0.1,
    "zero_after_s": 0.01,
    "gone_after_s": 0.1,
    "orphans": 0,
}


def test_deaths_count_as_reported_once_each_and_late_coils_and_leftovers_are_found(tmp_path: Path) -> None:
    bad = FLIGHT | {"reported": {"planner": 1}, "zero_after_s": 0.5, "orphans": 1, "left": ["/dev/shm/x"]}
    facts = process_kill.summarise([FLIGHT, bad], tmp_path).facts
    assert facts["acts"] == {"planner": 4, "guardian": 2}
    assert facts["reported"] == {"planner": 3, "guardian": 1}
    assert (facts["beyond_limit"], facts["orphans"], facts["left"]) == (1, 1, ["/dev/shm/x"])


def test_the_list_of_a_start_has_every_call_with_every_error_and_flies_those_of_the_flight_in_turn() -> None:
    listed = start.points(Counter(read=30, rename=2), Counter(read=27))
    assert len(set(listed)) == 32 * len(start.ERRORS)
    ordered = start.in_turn(listed, 1)
    assert sorted(map(str, ordered)) == sorted(map(str, listed))
    begun = [point.begun for point in ordered]
    assert begun[: 2 * 20] == [True, False] * 20, "five calls came after the configuration was opened"
    assert not any(begun[2 * 20 :])
    assert start.in_turn(listed, 2) != ordered


def test_a_start_without_a_flight_is_counted_and_named() -> None:
    flew = {"flies": True, "restarts": 0, "waited": True, "status": None, "said": "", "took_s": 2.0}
    faults = [flew | {"fault": "read 1: EIO", "begun": True}]
    faults += [flew | {"fault": "openat 3: EACCES", "begun": False, "flies": False, "status": 2}]
    summary = start.summarise([{"faults": faults, "of": {"points": 100, "begun": 10}}], Path())
    assert (summary.facts["grounded"], summary.facts["waited"], summary.facts["begun"]) == (1, 1, 1)
    assert "openat 3: EACCES: status 2" in summary.text
