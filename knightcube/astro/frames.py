"""Constant rotations between the mission's frames, and the map of an inertial unit's attitude into them.

The testbed frame T has y down along the thread and the field along -z. Magnetic north is the field's own
direction, so N = -z, D = y and E = D x N = -x: v_T = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]] v_NED.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, multiply

NED_TO_TESTBED: FloatArray = np.array([0.5, -0.5, -0.5, 0.5])


def attitude_map(mounting: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the matrix M (4, 4) that maps the attitude of a unit to that of the body.

    The unit measures q (4,), NED into sensor. With `mounting` (4,) sensor into body and `reference` (4,) NED
    into the mission's reference frame, M q = mounting q conj(reference), the reference frame into the body.
    """
    return np.asarray(multiply(multiply(mounting, np.eye(4)), conjugate(reference)).T)
