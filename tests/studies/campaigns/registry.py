"""All campaigns by name."""

from __future__ import annotations

from ground.campaigns.runner import Campaign
from tests.studies.campaigns.acquisition import ACQUISITION
from tests.studies.campaigns.coil_faults import COIL_FAULTS
from tests.studies.campaigns.controllers import CONTROLLERS_CAMPAIGN
from tests.studies.campaigns.coverage import COVERAGE
from tests.studies.campaigns.damaged_files import DAMAGED_FILES
from tests.studies.campaigns.detumble import DETUMBLE
from tests.studies.campaigns.eclipse import ECLIPSE
from tests.studies.campaigns.failures import FAILURES
from tests.studies.campaigns.false_horizons import FALSE_HORIZONS
from tests.studies.campaigns.faults import FAULTS
from tests.studies.campaigns.faults_kill import FAULTS_KILL
from tests.studies.campaigns.first_orbits import FIRST_ORBITS
from tests.studies.campaigns.frames import FRAMES_CAMPAIGN
from tests.studies.campaigns.gyro_dead import GYRO_DEAD
from tests.studies.campaigns.horizon_methods import HORIZON_METHODS
from tests.studies.campaigns.installer_kill import INSTALLER_KILL
from tests.studies.campaigns.ionf import IONF
from tests.studies.campaigns.knowledge import AGED_ELEMENTS, CALENDAR
from tests.studies.campaigns.lost_in_space import LOST_IN_SPACE
from tests.studies.campaigns.mismatch import MISMATCH, VIBRATION
from tests.studies.campaigns.nadir import NADIR
from tests.studies.campaigns.object_flights import OBJECT_FLIGHTS
from tests.studies.campaigns.object_passes import OBJECT_PASSES
from tests.studies.campaigns.orbit_attitude import ORBIT_ATTITUDE
from tests.studies.campaigns.orbit_faults import ORBIT_FAULTS
from tests.studies.campaigns.orbit_frames import ORBIT_FRAMES
from tests.studies.campaigns.orbit_pointing import ORBIT_POINTING
from tests.studies.campaigns.orbit_slews import ORBIT_SLEWS
from tests.studies.campaigns.planner_edge import PLANNER_EDGE
from tests.studies.campaigns.process_kill import PROCESS_KILL
from tests.studies.campaigns.rate_change import RATE_CHANGE
from tests.studies.campaigns.renewal_trials import RENEWAL_TRIALS
from tests.studies.campaigns.resting import RESTING
from tests.studies.campaigns.restored_keys import RESTORED_KEYS
from tests.studies.campaigns.robust_controllers import ROBUST_CONTROLLERS
from tests.studies.campaigns.rolling_shutter import ROLLING_SHUTTER
from tests.studies.campaigns.rso_orbits import RSO_ORBITS
from tests.studies.campaigns.safe_sun import SAFE_SUN
from tests.studies.campaigns.self_calibration import SELF_CALIBRATION
from tests.studies.campaigns.soak import SOAK
from tests.studies.campaigns.start import START
from tests.studies.campaigns.streaked import STREAKED
from tests.studies.campaigns.streaks import STREAKS, STREAKS_THESIS
from tests.studies.campaigns.structured_limbs import STRUCTURED_LIMBS
from tests.studies.campaigns.unknown_body import UNKNOWN_BODY
from tests.studies.campaigns.unlike_inertia import UNLIKE_INERTIA
from tests.studies.campaigns.warped_photographs import WARPED_PHOTOGRAPHS
from tests.studies.campaigns.worlds import WORLD_COMPARISON

CAMPAIGNS: dict[str, Campaign] = {
    campaign.name: campaign
    for campaign in (
        STREAKS,
        STREAKS_THESIS,
        FAILURES,
        MISMATCH,
        VIBRATION,
        RESTING,
        STREAKED,
        RATE_CHANGE,
        ROLLING_SHUTTER,
        SELF_CALIBRATION,
        RSO_ORBITS,
        FIRST_ORBITS,
        OBJECT_PASSES,
        OBJECT_FLIGHTS,
        LOST_IN_SPACE,
        WARPED_PHOTOGRAPHS,
        NADIR,
        FALSE_HORIZONS,
        STRUCTURED_LIMBS,
        HORIZON_METHODS,
        CONTROLLERS_CAMPAIGN,
        ROBUST_CONTROLLERS,
        PLANNER_EDGE,
        FAULTS,
        FAULTS_KILL,
        GYRO_DEAD,
        INSTALLER_KILL,
        DAMAGED_FILES,
        RESTORED_KEYS,
        RENEWAL_TRIALS,
        PROCESS_KILL,
        FRAMES_CAMPAIGN,
        COIL_FAULTS,
        UNKNOWN_BODY,
        UNLIKE_INERTIA,
        SOAK,
        START,
        COVERAGE,
        ORBIT_ATTITUDE,
        ORBIT_FRAMES,
        IONF,
        DETUMBLE,
        SAFE_SUN,
        WORLD_COMPARISON,
        ORBIT_FAULTS,
        ORBIT_POINTING,
        ORBIT_SLEWS,
        ACQUISITION,
        ECLIPSE,
        AGED_ELEMENTS,
        CALENDAR,
    )
}
