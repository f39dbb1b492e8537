"""The planner's job of a satellite: from an orbit, an attitude and a target to a table of the pointing law.

The field and the torques are predicted along the orbit for a revolution and a quarter, which the last gains
that are kept need as preview; a third of a revolution is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.control.three_axes.pointing_table import PointingTable, PointingWeights, pointing_table
from flight.gnc.earth.disturbance import pressures, shapes
from flight.gnc.earth.ephemeris import predict
from flight.gnc.earth.orbit_knowledge import OrbitState
from flight.gnc.guidance.three_axes.attitude_law import references
from flight.gnc.guidance.three_axes.pointing_target import PointingTarget
from flight.gnc.guidance.three_axes.target_law import BodyAxes, law_of
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix

PREVIEW, KEPT, STEP = 7_200.0, 1_800.0, 10.0
"""s: how far is predicted, how much of the table is kept, and its step."""
LEAD = 2.0
"""s from the state to the begin of the table."""


@dataclass(frozen=True, slots=True, eq=False)
class PointingJob:
    """A job: the orbit's state and the attitude (4,) at `origin_ns`, ICRS; `inertia` (3, 3) kg m^2."""

    number: int
    origin_ns: int
    orbit: OrbitState
    inertia: FloatArray
    axes: BodyAxes
    weights: PointingWeights
    target: PointingTarget
    quaternion: FloatArray


def run(job: PointingJob) -> PointingTable:
    """Return the table, its times in s after the origin; takes half a second.

    Raises FlightError where the field is not known, UsageError where the law has no attitude.
    """
    ahead = predict(job.orbit, PREVIEW + 4.0 * STEP)
    times = np.arange(LEAD, PREVIEW, STEP)
    law = law_of(job.target, job.axes, job.quaternion, ahead, LEAD)
    wanted = references(law, ahead, times)
    torques = shapes(pressures(ahead, times), attitude_matrix(wanted.quaternion))
    field, position = ahead.field_at(times), ahead.position_at(times)
    table = pointing_table(wanted, job.inertia, field, position, torques, job.weights)
    return table.until(round(KEPT / STEP))
