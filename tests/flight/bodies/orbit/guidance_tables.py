"""Attitudes and tables that several tests of the satellite's guidance share."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.gnc.control.three_axes.pointing_law import FAR, SLOW
from knightcube.gnc.control.three_axes.pointing_table import PointingTable, table_along
from knightcube.gnc.guidance.three_axes.attitude_law import references
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from tests.knightcube.gnc.control.three_axes.pointing_cases import INERTIA, LAW, ORBIT, STEP, WEIGHTS

NADIR = PointingTarget(Goal.NADIR, roll=0.0)


NEAR, AWAY = np.array([0.5 * FAR, 0.0, 0.0]), np.array([0.0, 1.2 * FAR, 0.0])


STILL, QUICK = np.array([0.5 * SLOW, 0.0, 0.0]), np.array([0.0, 0.0, 3.0 * SLOW])


@pytest.fixture(scope="module")
def table() -> PointingTable:
    times = STEP * np.arange(1.0, 20.0)
    wanted = references(LAW, ORBIT, times)
    return table_along(wanted, ORBIT.field_at(times), ORBIT.position_at(times), INERTIA, WEIGHTS)
