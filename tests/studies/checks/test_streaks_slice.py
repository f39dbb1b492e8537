"""Runs a small slice of the campaign `streaks`: five estimators are compared with bound and truth."""

from __future__ import annotations

import numpy as np
import pytest

from ground.campaigns.runner import Case, Result
from tests.studies.campaigns import streaks

FRAMES = 5


@pytest.fixture(scope="module")
def results() -> list[Result]:
    """Return frames with a rotation of 10 % of the field, 45 deg off the boresight."""
    cases = [Case(f"45/10/{run}", (20_261_121, run), {"theta": 45, "percent": 10}) for run in range(FRAMES)]
    return [streaks.run(case) for case in cases]


@pytest.mark.slow
def test_the_likelihood_estimator_is_at_the_bound_and_knows_it(results: list[Result]) -> None:
    """Check the ratio of rms error to bound, and the NEES (99.9 % limits for 15 degrees of freedom)."""
    found = [result["likelihood"] for result in results]
    assert all(one["status"] == "rate" for one in found)
    ratios = [
        [one["magnitude"] / result["bound"][0], one["vector"] / result["bound"][1]]
        for one, result in zip(found, results, strict=True)
    ]
    magnitude, vector = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert magnitude < 2.0
    assert vector < 2.0
    assert sum(one["nees"] for one in found) < 37.7
    assert max(one["across_px"] for one in found) < 0.1


@pytest.mark.slow
def test_the_thesis_detectors_stay_within_table_3_1(results: list[Result]) -> None:
    """At 10 %, Table 3.1 states mean magnitude errors of 0.69 % (Harris) and 1.20 % (minimum eigenvalue)."""
    for name, limit in (("harris", 0.0069), ("minimum-eigenvalue", 0.0120)):
        errors = [abs(r[name]["magnitude"]) for r in results if r[name]["status"] == "rate"]
        assert len(errors) >= FRAMES - 1
        assert np.mean(errors) < limit


@pytest.mark.slow
def test_the_summary_has_a_row_for_every_cell(results: list[Result]) -> None:
    facts = streaks._cell(results)
    assert facts["likelihood"]["rates"] == FRAMES
    assert facts["bound_magnitude"] < facts["bound_vector"]


@pytest.mark.slow
def test_the_thesis_s_own_camera_gives_the_thesis_s_table() -> None:
    """At 50 %, Table 3.1 states errors of 0.07 % (Harris) and 0.19 % (minimum eigenvalue).

    The mean of only two frames may be twice as large.

    The model of the likelihood estimator does not describe this camera. The estimator must refuse a frame, or
    be better than the best result of the thesis.
    """
    cases = [Case(f"60/50/{run}", (20_261_123, run), {"theta": 60, "percent": 50}) for run in range(2)]
    seen = [streaks.thesis_run(case) for case in cases]
    for name, limit in (("harris", 0.0007), ("minimum-eigenvalue", 0.0019), ("likelihood", 0.00035)):
        rates = [result[name] for result in seen if result[name]["status"] == "rate"]
        assert len(rates) >= (1 if name == "likelihood" else 2)
        assert np.mean([abs(rate["magnitude"]) for rate in rates]) < 2.0 * limit


@pytest.mark.slow
def test_the_biases_of_the_thesis_s_spots_are_those_that_are_measured() -> None:
    """The tolerance is 0.02 px, because the frames differ from the table's; the thesis states 0.10 px."""
    measured = streaks.measured_bias("harris", 4, 20_261_126)
    assert measured == pytest.approx(streaks.THESIS_BIAS["harris"], abs=0.02)
