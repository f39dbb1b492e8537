"""Runs a small slice of the campaign `false-horizons` at a fixed seed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.horizon.nadir import HorizonStatus, find_nadir
from knightcube.vision.horizon.settings import HorizonKnowledge
from tests.studies.campaigns.false_horizons import MAKERS, cases, photographed, run, summarise

SEED = 3
# Each of these pictures would give a significant (false) horizon, with or without known altitude, if the test
# ignored the number of trials.
FALSE_ONCE = ("clouds-15", "coast-16", "terminator-12", "gradient-6", "stars-4", "flares-11")


@pytest.mark.slow
def test_pictures_that_once_gave_a_horizon_give_none(tmp_path: Path) -> None:
    drawn = {case.key: case for case in cases(20, SEED)}
    assert len(drawn) == 20 * len(MAKERS)
    results = [run(drawn[key]) for key in FALSE_ONCE]
    assert not any({"found", "wrong"} & set(result["answers"].values()) for result in results)
    facts = summarise(results, tmp_path).facts
    json.dumps(facts, allow_nan=False)
    assert (facts["false"], facts["empty"]) == (0, len(FALSE_ONCE))


@pytest.mark.parametrize("seed", [3, 7, 8, 42])
def test_a_rendered_day_sky_shows_no_horizon_and_the_reason_is_stated(seed: int) -> None:
    """Edges of each picture form a significant horizon at some field of view, but neither side is space."""
    draw = np.random.default_rng([77, seed])
    picture = photographed(MAKERS["day_sky"]((480, 640), draw), draw)
    reasons = []
    for field in (12.0, 30.0, 70.0):
        camera = Pinhole.from_field_of_view(640, 480, np.radians(field))
        for altitude in (None, 515e3):
            found = find_nadir(picture, camera, HorizonKnowledge(altitude=altitude))
            assert found.status is HorizonStatus.NO_HORIZON, (field, altitude, found.reason)
            reasons.append(found.reason)
    assert any("not the limb" in reason for reason in reasons)
