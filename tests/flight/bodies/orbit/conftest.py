"""Fixtures of the tests of the orbiting body."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.guidance.attitude_law import references
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LAW,
    ORBIT,
    STEP,
    WEIGHTS,
)
from tests.support.held_motion import table_along


@pytest.fixture(scope="module")
def table() -> PointingTable:
    """Return a parameter table of the nadir pointing law."""
    times = STEP * np.arange(1.0, 20.0)
    wanted = references(LAW, ORBIT, times)
    return table_along(wanted, ORBIT.field_at(times), ORBIT.position_at(times), INERTIA, WEIGHTS)
