"""Requests that several tests of the pointing planner share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import box_areas, pressures
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.gnc.control.pointing_job import SlewRequest, SlewStart, slew, slew_table
from knightcube.gnc.control.pointing_table import PointingPreview, PointingTable
from knightcube.gnc.guidance.attitude_law import BodyAxes, references
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LAW,
    LIMIT,
    ORBIT,
    RESIDUAL,
    SIZE,
    STEP,
    WEIGHTS,
    X,
    Y,
    Z,
)

NADIR = PointingTarget(Goal.NADIR, roll=0.0)


AXES = BodyAxes(Z, X)


WISH = SlewRequest(700.0, np.full(3, 5.0), RESIDUAL, -Y)


TIMES = np.arange(STEP, 5_000.0, STEP)


WANTED = references(LAW, ORBIT, TIMES)


BEGIN = SlewStart(
    multiply(from_rotation_vector(np.radians([0.0, 60.0, 0.0])), WANTED.quaternion[0]),
    np.zeros(3),
    TIMES,
    100,
    INERTIA,
    LIMIT,
    SIZE,
    box_areas(INERTIA),
)


def planned(sizes: FloatArray) -> PointingTable:
    """Return the plan for a body with the torque coefficients `sizes` (9,), N m."""
    begin = replace(BEGIN, sizes=sizes)
    path = slew(begin, WISH, NADIR, AXES, ORBIT, np.inf)
    assert path is not None
    field, position = ORBIT.field_at(TIMES), ORBIT.position_at(TIMES)
    expected = PointingPreview(WANTED, WANTED, field, position, pressures(ORBIT, TIMES), sizes)
    return slew_table(begin, path, RESIDUAL, NADIR, AXES, ORBIT, expected, WEIGHTS)
