"""Propagates state and covariance: Euler's equation, and random walks of what is not modelled.

The error of the attitude is a small turn about the body's axes; kept attitudes do not change.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flight.gnc.estimation.estimate import DISTURBANCE, PARAMETERS, RATE, TURN
from flight.gnc.estimation.rigid_body import Linearised, RigidBody, Torquing
from flight.gnc.estimation.state import SIZE, State
from flight.gnc.estimation.turn import Vector, compose, exponential
from flight.gnc.math.arrays import FloatArray

LONGEST_STEP = 0.025
"""s: the default limit of a step, the period of the testbed's loop."""


_UNKNOWN_FOR = 0.3
"""s: an unknown current is modelled as white noise with the same effect over this time, in which the guardian
has zeroed the coils of a loop that stands."""


class ProcessNoise(NamedTuple):
    """Spectral densities of the process noise, and the largest current of a coil.

    `current` of one driven coil, A^2 s; `rate` (3, 3) rad^2/s^3; `walks` (19,) of the parts of the error, of
    the square of their unit per s; `unknown_current` A of each coil while its current is not known.
    """

    current: float
    rate: FloatArray
    walks: FloatArray
    unknown_current: float = 0.0


def propagate(
    body: RigidBody,
    noise: ProcessNoise,
    state: State,
    covariance: FloatArray,
    torquing: Torquing,
    duration: float,
    longest_step: float = LONGEST_STEP,
) -> tuple[State, FloatArray]:
    """Propagate over `duration` s under one torquing, in steps of at most `longest_step` s."""
    steps = max(1, math.ceil(duration / longest_step - 1e-9))
    for _ in range(steps):
        state, covariance = _step(body, noise, state, covariance, torquing, duration / steps)
    return state, covariance


def _step(
    body: RigidBody,
    noise: ProcessNoise,
    state: State,
    covariance: FloatArray,
    torquing: Torquing,
    dt: float,
) -> tuple[State, FloatArray]:
    """Propagate by one step of the midpoint rule; kept attitudes do not change."""
    half = 0.5 * dt
    wx, wy, wz = state.rate
    middle = compose(exponential(half * wx, half * wy, half * wz), state.quaternion)
    model = body.linearise(middle, state.rate, state.parameters, torquing, half)
    ax, ay, az = (a + d for a, d in zip(model.acceleration, state.disturbance, strict=True))
    moved = exponential(dt * (wx + half * ax), dt * (wy + half * ay), dt * (wz + half * az))
    propagated = State(
        compose(moved, state.quaternion),
        (wx + dt * ax, wy + dt * ay, wz + dt * az),
        state.bias,
        state.disturbance,
        state.parameters,
        state.kept,
        state.latency,
        state.field_bias,
    )
    transition = _transition(state.rate, model, dt)
    if state.kept:
        covariance = covariance.copy()
        covariance[:SIZE] = transition @ covariance[:SIZE]
        covariance[:, :SIZE] = covariance[:, :SIZE] @ transition.T
    else:
        covariance = transition @ covariance @ transition.T
    _add_noise(covariance, noise, model.by_current, torquing, dt)
    return propagated, covariance


def _transition(rate: Vector, model: Linearised, dt: float) -> FloatArray:
    """Return I + F dt + (F dt)^2 / 2 of the error's dynamics: turn' = -w x turn + rate error, and so on."""
    x, y, z = rate
    flow = _FLOW.copy()
    flow[TURN, TURN] = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))
    flow[RATE, TURN] = model.by_turn
    flow[RATE, RATE] = model.by_rate
    flow[RATE, PARAMETERS] = model.by_parameters
    flow *= dt
    return np.asarray(_IDENTITY + flow + 0.5 * (flow @ flow))


def _add_noise(
    covariance: FloatArray, noise: ProcessNoise, by_current: FloatArray, torquing: Torquing, dt: float
) -> None:
    """Add the effect of white angular acceleration and the random walks over dt, in place."""
    density = noise.rate
    if noise.current and any(torquing.driven):
        density = density + noise.current * ((by_current * torquing.driven) @ by_current.T)
    if not torquing.known:
        density = density + noise.unknown_current**2 * _UNKNOWN_FOR * (by_current @ by_current.T)
    turn, cross = dt**3 / 3.0, 0.5 * dt * dt
    over = np.array((turn, cross, cross, dt)).reshape(2, 1, 2, 1)
    covariance[_MOTION, _MOTION] += (over * density[:, np.newaxis]).reshape(6, 6)
    covariance.reshape(-1)[: SIZE * len(covariance) : len(covariance) + 1] += dt * noise.walks


_IDENTITY: FloatArray = np.eye(SIZE)
_MOTION = slice(TURN.start, RATE.stop)
_FLOW: FloatArray = np.zeros((SIZE, SIZE))
_FLOW[TURN, RATE] = np.eye(3)
_FLOW[RATE, DISTURBANCE] = np.eye(3)
