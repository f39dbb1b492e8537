"""Runs a small slice of the campaign `lost-in-space` with each method on nominal lists."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case, Result
from knightcube.reference.star_identification import METHODS
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarMatch
from knightcube.vision.startracker.verification import nothing
from tests.studies.campaigns import lost_in_space
from tests.support.star_lists import ListKind, draw

LISTS = 6


@pytest.fixture(scope="module")
def results() -> list[Result]:
    """Return the campaign's results for nominal lists."""
    cases = [
        Case(f"nominal/0/{run}", (20_261_121, 0, run), {"axis": "nominal", "value": 0.0})
        for run in range(LISTS)
    ]
    return [lost_in_space.run(case) for case in cases]


@pytest.mark.slow
def test_every_method_is_right_on_nearly_all_nominal_lists_and_never_wrong(results: list[Result]) -> None:
    for name in METHODS:
        verdicts = [result[name]["verdict"] for result in results]
        assert "wrong" not in verdicts, name
        assert verdicts.count("right") >= LISTS - 1, name


@pytest.mark.slow
def test_the_summary_counts_every_list_of_a_cell(results: list[Result], tmp_path: Path) -> None:
    summary = lost_in_space.summarise(results, tmp_path)
    for name in METHODS:
        row = summary.facts["nominal"][name]
        assert row["right"] + row["wrong"] + row["refused"] == LISTS


def test_no_two_cases_share_a_key_or_a_seed() -> None:
    cases = lost_in_space.cases(2, 1)
    assert len({case.key for case in cases}) == len({case.seed for case in cases}) == len(cases)


def test_an_answer_off_by_more_than_the_noise_allows_is_wrong() -> None:
    """The true attitude counts as right, and the same attitude rotated by half a degree as wrong."""
    sky = lost_in_space.known_sky(15.0)
    drawn = draw(ListKind(field_deg=15.0, known_deg=0.0), sky.index.stars, np.random.default_rng(7))
    field = drawn.field()
    good = METHODS["pyramid"].identify(field, sky)
    assert good.status is MatchStatus.IDENTIFIED
    assert good.fix is not None
    assert lost_in_space.verdict(good, drawn) == "right"
    tilt = good.fix.quaternion + np.array([0.005, 0.0, 0.0, 0.0])
    fix = replace(good.fix, quaternion=tilt / np.linalg.norm(tilt))
    assert lost_in_space.verdict(StarMatch(good.status, good.star, fix), drawn) == "wrong"
    assert lost_in_space.verdict(nothing(field), drawn) == "refused"
