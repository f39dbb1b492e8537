"""Tests of the campaign `worlds`: the same cases run in both worlds, and the summary shows a difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case
from sim_hal.worlds.free_body import FreeBody
from tests.studies.campaigns import worlds

SHORT = {"speed": np.radians(0.6), "seconds": 240.0}


def test_equal_worlds_agree_and_an_unlike_one_does_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(worlds, "BasiliskWorld", FreeBody)
    results = [
        worlds.run(Case(case.key, case.seed, {**case.parameters, **SHORT})) for case in worlds.cases(1, 1)
    ]
    facts = worlds.summarise(results, tmp_path).facts
    assert facts["lost"] == 0
    for kind, figures in worlds.FIGURES.items():
        for figure in figures:
            assert facts[f"{kind}/{figure}"]["median_ratio"] == 1.0
    assert facts["within"]
    for result in results:
        if result["world"] == "basilisk" and result["kind"] == "nadir":
            result["nadir_rms"] *= 1.3
    assert not worlds.summarise(results, tmp_path).facts["within"]


def test_each_flight_is_flown_in_both_worlds() -> None:
    cases = worlds.cases(3, 1)
    assert [case.parameters["world"] for case in cases] == ["free_body", "basilisk"] * 6
    assert len({case.parameters["flight"] for case in cases}) == 6
    crafts = [case.parameters["craft"] for case in cases if case.parameters["kind"] == "nadir"][::2]
    assert crafts == ["cubesat_3u", "knightcube", "cubesat_3u"]
