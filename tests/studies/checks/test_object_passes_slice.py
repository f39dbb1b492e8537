"""Runs a small slice of the campaign `object-passes`: claimed errors, and no track in an empty sky."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case
from tests.studies.campaigns.object_passes import run, summarise

SEED = 16


def test_an_object_is_sighted_near_the_bound_and_an_empty_sky_shows_none(tmp_path: Path) -> None:
    few = {"length": "short", "still": 4, "turning": 4}
    shown = run(Case("short/0/3.0", (SEED, 0, 1), {"magnitude": 3.0, **few}))
    empty = run(Case("short/0/None", (SEED, 0, 5), {"magnitude": None, **few, "still": 1, "turning": 1}))
    seen = [frame for frame in shown["frames"] if "error" in frame]
    assert len(seen) >= 4
    for frame in seen:
        assert frame["bound"] < frame["claim"]
        assert frame["error"] < min(frame["bound"] + 0.1, 4.0 * frame["claim"])
    assert shown["nees"]
    assert np.max(shown["nees"]) < 18.4  # 99.99 % quantile of chi-square with two degrees of freedom
    assert shown["false_tracks"] == empty["false_tracks"] == 0
    json.dumps(summarise([shown, empty], tmp_path).facts, allow_nan=False)
