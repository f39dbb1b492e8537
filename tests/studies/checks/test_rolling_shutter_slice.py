"""Runs a small slice of the campaign `rolling-shutter`, and tests its frames row by row."""

from __future__ import annotations

from ground.campaigns.runner import fly_here
from tests.studies.campaigns.rolling_shutter import ALONE, PRIOR, ROLLING_SHUTTER


def test_no_rate_is_beyond_its_covariance_with_a_prior_or_without() -> None:
    """A chi-square with 3 degrees of freedom exceeds 16.3 once in a thousand cases."""
    results = fly_here(ROLLING_SHUTTER, 3, 20_261_123)
    for result in results:
        assert result[PRIOR]["status"] == "rate"
        assert result[PRIOR]["nees"] < 16.3
        assert result[PRIOR]["over_bound"] < 9.0
        assert result[ALONE]["status"] == "ambiguous"
        assert result[ALONE]["nees"] < 16.3
