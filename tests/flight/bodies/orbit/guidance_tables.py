"""Attitudes and parameter tables for several tests of the satellite's guidance."""

from __future__ import annotations

import numpy as np

from knightcube.gnc.control.pointing_law import FAR, SLOW
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

NADIR = PointingTarget(Goal.NADIR, roll=0.0)


NEAR, AWAY = np.array([0.5 * FAR, 0.0, 0.0]), np.array([0.0, 1.2 * FAR, 0.0])


STILL, QUICK = np.array([0.5 * SLOW, 0.0, 0.0]), np.array([0.0, 0.0, 3.0 * SLOW])
