"""The filter's state at one time, as tuples."""

from __future__ import annotations

from typing import NamedTuple

from knightcube.gnc.estimation.measurements import MeanRateMeasurement
from knightcube.gnc.estimation.rigid_body import Parameters
from knightcube.gnc.estimation.turn import Quaternion, Vector

SIZE = 19
"""Size of the error state; `knightcube.gnc.estimation.estimate` names its parts."""


class State(NamedTuple):
    """The estimate; `kept` are attitudes at the starts of exposures, in order of time.

    `latency` is the age of the inertial unit's samples at their stamp, s; `field_bias` the magnetometer's
    bias, T, body axes.
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
    """Return the index of the kept attitude at the start of this exposure."""
    return next(place for place, (owner, _) in enumerate(state.kept) if owner is measurement)
