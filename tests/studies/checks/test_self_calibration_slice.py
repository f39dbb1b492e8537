"""Runs a small slice of the campaign `self-calibration`: one lens and three frames."""

from __future__ import annotations

import pytest

from ground.campaigns.runner import Case
from tests.studies.campaigns import self_calibration


def test_the_claim_of_a_rate_shrinks_from_the_first_frame_to_the_third(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(self_calibration, "FRAMES", 3)
    frames = self_calibration.run(Case("0", (1, 0, 0), {"row": "default"}))["frames"]
    assert [one["before"] for one in frames] == [0, 1, 2]
    assert frames[0]["claim"] > 5.0, "the camera is known to 2 px, 0.5 % and 30 us a line"
    assert frames[2]["claim"] < 0.5 * frames[0]["claim"]
    # Once in 10,000 frames a chi-square with three degrees of freedom exceeds 21, and one with six exceeds
    # 28.
    assert max(one["nees"] for one in frames) < 21.0
    assert max(one["lens_nees"] for one in frames) < 28.0
    assert max(one["contradictions"] for one in frames) == 0
