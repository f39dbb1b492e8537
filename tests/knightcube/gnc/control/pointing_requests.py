"""Requests that several tests of the pointing planner share."""

from __future__ import annotations

import numpy as np

from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.gnc.control.pointing_job import SlewRequest, SlewStart
from knightcube.gnc.guidance.three_axes.attitude_law import BodyAxes, references
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LAW,
    LIMIT,
    ORBIT,
    RESIDUAL,
    SIZE,
    STEP,
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
)
