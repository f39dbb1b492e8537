"""The filter's first state and covariance, from one attitude and one rate."""

from __future__ import annotations

import numpy as np

from knightcube.gnc.estimation.estimate import (
    BIAS,
    DISTURBANCE,
    FIELD_BIAS,
    LATENCY,
    PARAMETERS,
    RATE,
    TURN,
)
from knightcube.gnc.estimation.filter_settings import FilterSettings, free_axes
from knightcube.gnc.estimation.measurements import AttitudeMeasurement, Measurement, RateMeasurement
from knightcube.gnc.estimation.replay import Checkpoint, Model
from knightcube.gnc.estimation.slow_prior import SlowPrior
from knightcube.gnc.estimation.state import SIZE, State
from knightcube.gnc.estimation.turn import exponential, twist


def first_checkpoint(
    model: Model,
    settings: FilterSettings,
    prior: SlowPrior,
    attitude: AttitudeMeasurement,
    rate: RateMeasurement,
) -> Checkpoint:
    """Return the checkpoint at the later measurement; a suspended body keeps only the thread's angle."""
    suspended, free = model.body.suspended, free_axes(model.body)
    a, b, c, d = attitude.quaternion.tolist()
    quaternion = exponential(0.0, twist((a, b, c, d)), 0.0) if suspended else (a, b, c, d)
    x, y, z = (free * (rate.rate - prior.bias)).tolist()
    bias_variance = prior.bias_covariance
    covariance = np.zeros((SIZE, SIZE))
    covariance[TURN, TURN] = attitude.covariance * np.outer(free, free)
    # The gyro measures the sum of rate and bias, so their errors are opposite.
    covariance[RATE, RATE] = rate.covariance * np.outer(free, free) + bias_variance
    covariance[RATE, BIAS] = covariance[BIAS, RATE] = -bias_variance
    covariance[BIAS, BIAS] = bias_variance
    covariance[DISTURBANCE, DISTURBANCE] = np.diag(settings.disturbance_start**2 * free)
    covariance[PARAMETERS, PARAMETERS] = prior.parameters_covariance
    covariance[FIELD_BIAS, FIELD_BIAS] = settings.field_bias_start**2 * np.eye(3)
    bx, by, bz = prior.bias.tolist()
    none = (0.0, 0.0, 0.0)
    state = State(quaternion, (x, y, z), (bx, by, bz), none, prior.parameters, latency=prior.latency)
    newest: Measurement = attitude if attitude.time_ns >= rate.time_ns else rate
    # The older both samples are, the further the body has moved: the errors of all three are correlated.
    age = np.zeros(SIZE)
    age[TURN], age[RATE] = (x, y, z), model.motion(state, covariance, newest.time_ns).acceleration
    age[LATENCY] = 1.0
    covariance += prior.latency_variance * np.outer(age, age)
    return Checkpoint(newest, True, state, covariance)
