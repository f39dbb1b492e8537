"""All campaigns by name."""

from __future__ import annotations

from tests.campaigns.campaign import Campaign
from tests.campaigns.consistency import CONSISTENCY
from tests.campaigns.controllers import CONTROLLERS_CAMPAIGN
from tests.campaigns.coverage import COVERAGE
from tests.campaigns.failures import FAILURES
from tests.campaigns.faults import FAULTS
from tests.campaigns.faults_kill import FAULTS_KILL
from tests.campaigns.lost_in_space import LOST_IN_SPACE
from tests.campaigns.nadir import NADIR
from tests.campaigns.orbit_attitude import ORBIT_ATTITUDE
from tests.campaigns.rso import RSO_SLEW, RSO_TRACK
from tests.campaigns.rso_orbits import RSO_ORBITS
from tests.campaigns.soak import SOAK
from tests.campaigns.step_robust import STEP_ROBUST
from tests.campaigns.streaks import STREAKS

CAMPAIGNS: dict[str, Campaign] = {
    campaign.name: campaign
    for campaign in (
        STREAKS,
        FAILURES,
        RSO_SLEW,
        RSO_TRACK,
        RSO_ORBITS,
        CONSISTENCY,
        LOST_IN_SPACE,
        NADIR,
        CONTROLLERS_CAMPAIGN,
        STEP_ROBUST,
        FAULTS,
        FAULTS_KILL,
        SOAK,
        COVERAGE,
        ORBIT_ATTITUDE,
    )
}
