"""Runs a slice of the campaign `nadir`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Result, fly_here
from tests.studies.campaigns import campaign
from tests.studies.campaigns.nadir import summarise


@pytest.fixture(scope="module")
def slice_() -> list[Result]:
    """Return the results of two frames of the campaign `nadir` for each pair of view and atmosphere model."""
    return fly_here(campaign("nadir"), 2, 20_261_121)


@pytest.mark.slow
def test_a_slice_of_the_campaign_has_no_wrong_answer_and_honest_covariances(slice_: list[Result]) -> None:
    """The sum of eight NEES is a chi-square of 16 degrees of freedom, below 40 in 99.92 % of all slices."""
    assert {r["verdict"] for r in slice_} <= {"right", "refused", "ambiguous", "no-horizon"}
    answers = [r for r in slice_ if r["nees"] is not None]
    assert len(answers) >= 7
    assert sum(r["nees"] for r in answers) < 40.0
    for view, most in (("sunlit", 0.04), ("terminator", 0.1)):
        errors = [r["error_deg"] for r in answers if (r["view"], r["air"]) == (view, "known")]
        assert np.sqrt(np.mean(np.square(errors))) < most
    assert not any(r["warnings"] for r in slice_)


@pytest.mark.slow
def test_the_summary_counts_what_is_wrong_and_what_is_refused(slice_: list[Result], tmp_path: Path) -> None:
    wrong = {**slice_[0], "verdict": "wrong", "error_deg": 3.0, "nees": 900.0}
    none = {**slice_[1], "verdict": "refused", "error_deg": None, "nees": None, "reason": "5 % of sky"}
    summary = summarise([wrong, none, *slice_[2:]], tmp_path)
    assert summary.facts["views"]["sunlit/known"]["wrong"] == 1
    assert summary.facts["views"]["sunlit/known"]["refused"] == 1
    assert summary.facts["views"]["sunlit/known"]["worst_deg"] == 3.0
    assert "5 % of sky" in summary.text
