"""A small slice of the campaign `rate-change`: frames summed instant by instant, by other arithmetic."""

from __future__ import annotations

from tests.studies.campaigns.campaign import fly_here
from tests.studies.campaigns.rate_change import RATE_CHANGE


def test_a_rate_that_changes_by_up_to_twice_its_mean_is_found_within_its_covariance() -> None:
    """Chi-square of 3: 16.3 is exceeded once in a thousand."""
    for result in fly_here(RATE_CHANGE, 4, 20_261_123):
        assert result["status"] == "rate"
        assert result["nees"] < 16.3
