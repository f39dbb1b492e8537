"""Runs a small slice of the campaign `resting`: claimed sigmas agree with errors, also for other cameras."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case
from knightcube.astro.chi_square import bound
from tests.studies.campaigns.imperfections import Imperfection
from tests.studies.campaigns.resting import TRAILS, look_at, run, summarise
from tests.studies.campaigns.statistics import squared_sigmas
from tests.support.supersampled import Optics, ring

SEED = 17


def _flown(row: str, trail: float, runs: int) -> list[dict[str, object]]:
    return [run(Case(f"{row} {trail:g} {n}", (SEED, n), {"row": row, "trail": trail})) for n in range(runs)]


def test_attitudes_of_the_model_s_own_camera_are_known_as_well_as_they_claim(tmp_path: Path) -> None:
    results = [result for trail in TRAILS for result in _flown("none", trail, 4)]
    facts = summarise(results, tmp_path).facts
    json.dumps(facts, allow_nan=False)
    own = facts["all"]
    assert own["attitudes"] == own["frames"] == 12
    # The 99.9 % interval of chi-square(36) / 12 lies between 1.1 and 5.9.
    assert 1.1 < own["nees"] < 5.9
    assert own["worst"] < np.sqrt(bound(1e-4, 3))
    assert own["claim"] < 0.004


def test_attitudes_of_unlike_cameras_are_within_their_claims(tmp_path: Path) -> None:
    """The cases are another distortion, and a rolling shutter with known and unknown line time."""
    for row, trail in (
        ("distortion 0.2 %", 0.0),
        ("rolling, described", 3.0),
        ("rolling, unknown line time", 1.0),
    ):
        own = summarise(_flown(row, trail, 2), tmp_path).facts["all"]
        assert own["attitudes"] == 2
        assert own["worst"] < 4.5
        assert own["claim"] < 0.02


def test_attitudes_of_defocused_stars_are_accurate_and_within_their_claims(tmp_path: Path) -> None:
    """Without binning, the errors of these frames are 0.2 to 0.9 px, and up to 7 claimed sigmas."""
    rows = "ring 8 px, hole 4 px", "ring 8 px, hole 6 px"
    results = [result for row in rows for trail in TRAILS for result in _flown(row, trail, 1)]
    own = summarise(results, tmp_path).facts["all"]
    assert own["attitudes"] == own["frames"] == 6
    assert own["worst"] < np.sqrt(bound(1e-4, 3))
    assert own["off"] < 0.2
    assert own["claim"] < 0.3


def test_displaced_parts_of_all_stars_do_not_give_a_wrong_attitude() -> None:
    """All five points that are detected without binning are displaced by about 5 px to the same side."""
    wide = Imperfection(Optics((ring(16.0, 10.0),), radius=17.0))
    result = look_at(Case("wide ring", (5, 3, 20), {"row": "wide ring", "trail": 2.0}), wide, 0.0)
    assert result["error"] is not None
    assert squared_sigmas(result["error"], result["covariance"]) < bound(1e-4, 3)
