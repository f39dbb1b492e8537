"""Monte Carlo campaigns: many flights with drawn values, on all cores or on a cluster, resumable."""

from knightcube.errors import FlightError


class CampaignError(FlightError):
    """Error that ends a campaign. The results until then are kept."""
