"""Filter states that several tests of the estimation share."""

from __future__ import annotations

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import compose, exponential
from knightcube.gnc.estimation.estimate import FilterState, Parameters
from knightcube.gnc.estimation.rigid_body import BodyErrors

STATE = FilterState(
    exponential(0.3, -0.5, 0.8), (0.2, -0.3, 0.1), (1e-3, 0.0, -2e-3), (0.01, 0.02, -0.03), Parameters()
)

NO_ERRORS = BodyErrors(
    moments=0.0,
    axes=0.0,
    gyro_scale=0.0,
    gyro_alignment=0.0,
    coil_gain=0.0,
    coil_axes=0.0,
    field_matrix=0.0,
    camera=0.0,
    horizon=0.0,
)
"""Description of a body and devices without errors."""


def moved(state: FilterState, error: FloatArray) -> FilterState:
    """Return a filter state plus an error vector."""
    e = error.tolist()
    return FilterState(
        compose(exponential(*e[0:3]), state.quaternion),
        (state.rate[0] + e[3], state.rate[1] + e[4], state.rate[2] + e[5]),
        (state.bias[0] + e[6], state.bias[1] + e[7], state.bias[2] + e[8]),
        (state.disturbance[0] + e[9], state.disturbance[1] + e[10], state.disturbance[2] + e[11]),
        Parameters(*(p + d for p, d in zip(state.parameters, e[12:15], strict=True))),
        state.kept,
        state.latency + e[15],
        (state.field_bias[0] + e[16], state.field_bias[1] + e[17], state.field_bias[2] + e[18]),
    )
