"""Runs a small slice of the campaign `horizon-methods` at a fixed seed."""

from __future__ import annotations

import json
from pathlib import Path

from tests.studies.campaigns.horizon_methods import HORIZON_METHODS, METHODS, run


def test_all_methods_answer_a_level_sunlit_limb_and_only_the_papers_are_fooled(tmp_path: Path) -> None:
    """With seed 5, all methods without `32` in their name are correct to 2 deg in daylight.

    Near the terminator, the first two methods are correct to 0.5 deg, and one method of the paper is wrong by
    more than 5 deg.
    """
    keys = ("level-sunlit-0", "tilted-terminator-0")
    results = [run(case) for case in HORIZON_METHODS.cases(1, 5) if case.key in keys]
    day, evening = (result["answers"] for result in results)
    assert tuple(day) == METHODS
    plain = [name for name in METHODS if "32" not in name]
    assert all(day[name]["error_deg"] < 2.0 for name in plain)
    assert day["several cameras"]["error_deg"] < 0.05
    assert all(evening[name]["error_deg"] < 0.5 for name in METHODS[:2])
    assert evening["circle, 32 lines"]["error_deg"] > 5.0
    summary = HORIZON_METHODS.summarise(results, tmp_path)
    json.dumps(summary.facts, allow_nan=False)
    assert summary.facts["tilted/terminator/circle, 32 lines"]["far"] == 1
