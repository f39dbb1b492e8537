"""Runs a small slice of the campaign `first-orbits`: errors agree with claims, and short arcs are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case
from knightcube.gnc.first_orbit import ArcError, Bearings, first_orbit
from tests.studies.campaigns.first_orbits import run, summarise

SEED = 16
LONG, SHORT = {"arc": 240.0, "period": 10.0}, {"arc": 30.0, "period": 3.0}


def test_orbits_of_four_minutes_are_as_good_as_they_claim(tmp_path: Path) -> None:
    results = [run(Case(f"{number}/240", (SEED, number), LONG)) for number in range(4)]
    made = [result for result in results if result["refused"] is None]
    assert len(made) >= 2
    total = sum(result["nees"] for result in made)
    # The limits contain the 99.8 % intervals of chi-square with 12 to 24 degrees of freedom.
    assert 2.2 < total < 51.0
    assert sum(result["covered"] for result in made) >= len(made) - 1
    json.dumps(summarise(results, tmp_path).facts, allow_nan=False)


def test_half_a_minute_is_refused_with_the_distances_that_it_allows() -> None:
    result = run(Case("0/30", (SEED, 0), SHORT))
    assert result["refused"] is not None
    assert "the arc of 30 s is too short: the distance is" in result["refused"]


def test_a_motion_that_gravity_cannot_cause_is_not_accepted_as_an_orbit() -> None:
    times = np.arange(0.0, 240.0, 20.0)
    angle = 0.02 * times + 2e-5 * times**2
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(times))], axis=1)
    observer = np.tile([7e6, 0.0, 0.0, 0.0, 0.0, 7546.0], (len(times), 1))
    with pytest.raises(ArcError, match="no ballistic orbit fits"):
        first_orbit(Bearings(times, directions, np.full(len(times), 1e-5), observer, np.zeros(3)))
    few = Bearings(times[:5], directions[:5], np.full(5, 1e-5), observer[:5], np.zeros(3))
    with pytest.raises(ArcError, match="5 sightings"):
        first_orbit(few)
