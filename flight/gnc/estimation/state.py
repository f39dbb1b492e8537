"""What the filter believes at one time, as tuples, and where its parts stand in the error's covariance."""

from __future__ import annotations

from typing import NamedTuple

from flight.gnc.estimation.measurements import MeanRateMeasurement
from flight.gnc.estimation.rigid_body import Parameters
from flight.gnc.estimation.turn import Quaternion, Vector

SIZE = 19
"""Of the error: see `flight.gnc.estimation.estimate` for its parts."""


class State(NamedTuple):
    """The estimate; `kept` are attitudes at starts of exposures, as they came.

    `latency` is by how much the inertial unit's samples are older than they say, s; `field_bias` what the
    magnetometer reads too much, T, body axes.
    """

    quaternion: Quaternion
    rate: Vector
    bias: Vector
    disturbance: Vector
    parameters: Parameters
    kept: tuple[tuple[MeanRateMeasurement, Quaternion], ...] = ()
    latency: float = 0.0
    field_bias: Vector = (0.0, 0.0, 0.0)


def place_of(state: State, measurement: MeanRateMeasurement) -> int:
    """Return which of the attitudes kept is the one at the start of this exposure."""
    return next(place for place, (owner, _) in enumerate(state.kept) if owner is measurement)
