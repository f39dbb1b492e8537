"""Resumable Monte Carlo campaigns: many flights with random values, on all cores or on a cluster."""

from knightcube.errors import KnightCubeError


class CampaignError(KnightCubeError):
    """Error that ends a campaign. The results of completed cases are kept."""
