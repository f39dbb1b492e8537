"""Names of the runner of campaigns, which is `ground.campaigns.runner`."""

from ground.campaigns import CampaignError
from ground.campaigns.runner import (
    Campaign,
    Case,
    Parameters,
    Progress,
    Result,
    Results,
    Summary,
    fly,
    fly_here,
    show,
    summary,
)

__all__ = [
    "Campaign",
    "CampaignError",
    "Case",
    "Parameters",
    "Progress",
    "Result",
    "Results",
    "Summary",
    "fly",
    "fly_here",
    "show",
    "summary",
]
