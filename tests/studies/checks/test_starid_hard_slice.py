"""Runs a small slice of the benchmark `starid_hard`: a few lists of some rows, with another seed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from knightcube.vision.startracker.attitude_fit import MatchStatus, StarMatch
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import identify
from knightcube.vision.startracker.verification import nothing
from tests.studies.bench import starid_hard
from tests.studies.bench.starid_hard import drawn_list, hardships, measured
from tests.support.star_lists import ListKind, draw

_SEED = 20_261_123


@pytest.mark.slow
@pytest.mark.parametrize(
    ("row", "least"),
    [
        ("unknown 10-30 deg, 20 bright false", 6),
        ("unknown 4-60 deg, of 4-10 deg to V 8", 7),
        ("unknown 10-30 deg, mirrored", 8),
        ("known to 5 %, hint 10 % wrong", 8),
        ("known to 1 deg, distorted 2-8 %", 7),
        ("unknown 10-30 deg, distorted 2-8 %", 7),
    ],
)
def test_hard_lists_are_named_and_none_is_wrong(row: str, least: int) -> None:
    figures = measured(row, 8, default_index(), _SEED)
    assert figures["wrong"] == 0
    assert figures["right"] >= least


def test_an_answer_to_strewn_points_is_wrong_and_none_is_refused() -> None:
    row, rng = hardships()["random, unknown"], np.random.default_rng(1)
    drawn = drawn_list(row, default_index().stars, rng)
    found, _ = starid_hard.answered(
        hardships()["unknown 10-30 deg, mirrored"],
        drawn_list(hardships()["unknown 10-30 deg, mirrored"], default_index().stars, rng),
        default_index(),
    )
    assert found.status is MatchStatus.IDENTIFIED
    assert starid_hard.verdict(row, drawn, nothing(drawn.field())) == "refused"
    assert (
        starid_hard.verdict(row, drawn, StarMatch(found.status, np.arange(len(drawn.star)), found.fix))
        == "wrong"
    )


def test_the_command_prints_a_row_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert starid_hard.main(["--lists", "2", "--only", "known, mirrored", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["lists"] == 2
    assert row["right"] + row["wrong"] + row["refused"] == 2


@pytest.mark.slow
def test_a_lens_fitted_wrongly_is_refused_and_a_hidden_half_is_not() -> None:
    """Without the refusal, the result for one list would be wrong by 175 arcsec, or 5 sigmas.

    In the accepted lists only the left part is visible.
    """
    sky = default_index()
    name = "known to 1 deg, distorted 2-8 %"
    row, number = hardships()[name], list(hardships()).index(name)
    wrong = drawn_list(row, sky.stars, np.random.default_rng([314_159, number, 510]))
    assert starid_hard.verdict(row, wrong, identify(wrong.field(), sky)) != "wrong"
    kind = ListKind(field_deg=20.0, noise_px=0.3, known_deg=1.0)
    for seed in range(6):
        drawn = draw(kind, sky.stars, np.random.default_rng([_SEED, seed]))
        left = np.flatnonzero(drawn.pixels[:, 0] < 400.0)
        found = identify(drawn.field().subset(left), sky)
        assert found.status is MatchStatus.IDENTIFIED, seed
        assert np.array_equal(found.star[found.star >= 0], drawn.star[left][found.star >= 0])
