"""The summaries of the kill campaigns ring where something is wrong; the flights themselves are campaigns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.studies.campaigns import installer_kill, process_kill

KILL = {"by_time": True, "place": 0.5, "label": "1", "which": "new", "complaint": ""}
FLIGHT = {
    "acts": {"planner": 2, "guardian": 1},
    "reported": {"planner": 3, "guardian": 1},
    "left": [],
    "sent": "SIGKILL",
    "current_before_a": 0.1,
    "zero_after_s": 0.01,
    "orphans": 0,
}


@pytest.mark.parametrize(
    ("change", "bad"),
    [({}, 0), ({"which": "none"}, 1), ({"complaint": "fly: ..."}, 1), ({"which": "old"}, 0)],
)
def test_a_kill_of_the_installer_is_bad_unless_the_old_or_new_release_flies_without_complaint(
    tmp_path: Path, change: dict[str, Any], bad: int
) -> None:
    facts = installer_kill.summarise([{"flown": [KILL | change], "end": ["last", ""]}], tmp_path).facts
    assert (len(facts["bad"]), facts["ends"]) == (bad, 1)


def test_deaths_count_as_reported_once_each_and_late_coils_and_leftovers_are_found(tmp_path: Path) -> None:
    bad = FLIGHT | {"reported": {"planner": 1}, "zero_after_s": 0.5, "orphans": 1, "left": ["/dev/shm/x"]}
    facts = process_kill.summarise([FLIGHT, bad], tmp_path).facts
    assert facts["acts"] == {"planner": 4, "guardian": 2}
    assert facts["reported"] == {"planner": 3, "guardian": 1}
    assert (facts["beyond_limit"], facts["orphans"], facts["left"]) == (1, 1, ["/dev/shm/x"])
