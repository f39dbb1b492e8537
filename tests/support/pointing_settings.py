"""Weights and axes of the pointing control in the simulated orbits."""

from __future__ import annotations

import numpy as np

from knightcube.gnc.control.pointing_table import PointingWeights
from knightcube.gnc.guidance.attitude_law import BodyAxes

AXES = BodyAxes(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))


WEIGHTS = {
    "knightcube": PointingWeights(
        turn=np.radians(1.0), rate=1.0, dipole=3e-4, roll=np.radians(30.0), axis=AXES.pointing
    ),
    "cubesat_3u": PointingWeights(
        turn=np.radians(1.0), rate=1.0, dipole=1.5e-3, roll=np.radians(3.0), axis=AXES.pointing
    ),
}
