"""Gains of the pointing law along a given motion, without a search by the planner."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.pointing_path import CostToGo, SweepCost, linearised, sweep
from knightcube.gnc.control.pointing_table import PointingTable, PointingWeights, step_costs
from knightcube.gnc.guidance.attitude_law import AttitudeReferences


def table_along(
    motion: AttitudeReferences,
    field: FloatArray,
    position: FloatArray,
    inertia: FloatArray,
    weights: PointingWeights,
) -> PointingTable:
    """Return the gain table for a given motion (n + 1,) without disturbance torques.

    `field` (n + 1, 3) is in T, `position` (n + 1, 3) in m, both in ICRS; `inertia` (3, 3) is in kg m^2. The
    gains near the end are computed from a shorter prediction.
    """
    count, dt = len(motion.times) - 1, float(motion.times[1] - motion.times[0])
    state, dipole = step_costs(weights, dt)
    linear = linearised(motion.until(count), inertia, field[:count], position[:count])
    affine = -np.einsum("nij,nj->ni", linear.by_torque, linear.missing)[:, :, None]
    nothing = np.zeros(affine.shape)
    states = np.broadcast_to(state, (count, 6, 6))
    cost = SweepCost(states, np.full((count, 3), dipole), nothing, nothing[:, :3])
    gain, steady, _ = sweep(linear, affine, cost, CostToGo(state, nothing[0]))
    return PointingTable(motion, motion, -steady[:, :, 0], gain, np.zeros((count, 3, 0)), np.zeros(0))
