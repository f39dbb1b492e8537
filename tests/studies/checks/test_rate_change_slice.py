"""Runs a small slice of the campaign `rate-change`, and tests its frames against an independent sum."""

from __future__ import annotations

from ground.campaigns.runner import Case, fly_here
from tests.studies.campaigns.rate_change import RATE_CHANGE, run

# Motion that reverses and returns nearly to its start. A motion from rest at a very different rate fits its
# streaks equally well.
FOLDED = {"theta": 21.97996, "length": 6.63953, "exposure": 0.2, "change": 18.80413}


def test_a_rate_that_changes_by_up_to_twice_its_mean_is_found_within_its_covariance() -> None:
    """A chi-square with 3 degrees of freedom exceeds 16.3 once in a thousand cases."""
    results = fly_here(RATE_CHANGE, 4, 20_261_123)
    assert len(results) == 6
    for result in results[:4]:
        assert result["status"] == "rate"
        assert result["nees"] < 16.3
    # The remaining cases are rotations that reverse.
    assert all(result["nees"] is None for result in results[4:])


def test_a_turn_that_reverses_is_not_reported_as_one_from_rest() -> None:
    assert run(Case("folded", (7, 49, 1), dict(FOLDED)))["nees"] is None
