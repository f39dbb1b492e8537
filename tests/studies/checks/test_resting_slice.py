"""Runs a small slice of the campaign `resting`: claimed sigmas agree with errors, also for other cameras."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case
from knightcube.astro.chi_square import bound
from tests.studies.campaigns.resting import TRAILS, run, summarise

SEED = 17


def _flown(row: str, trail: float, runs: int) -> list[dict[str, object]]:
    return [run(Case(f"{row} {trail:g} {n}", (SEED, n), {"row": row, "trail": trail})) for n in range(runs)]


def test_attitudes_of_the_model_s_own_camera_are_known_as_well_as_they_claim(tmp_path: Path) -> None:
    results = [result for trail in TRAILS for result in _flown("none", trail, 4)]
    facts = summarise(results, tmp_path).facts
    json.dumps(facts, allow_nan=False)
    own = facts["all"]
    assert own["attitudes"] == own["frames"] == 12
    # The 99.9 % interval of chi-square(36) / 12 is within 1.1 and 5.9.
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
