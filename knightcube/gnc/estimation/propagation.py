"""Propagates state and covariance: Euler's equation, and random walks of what is not modelled.

The error of the attitude is a small turn about the body's axes; kept attitudes do not change.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import DISTURBANCE, PARAMETERS, RATE, TURN
from knightcube.gnc.estimation.rigid_body import Linearised, RigidBody, Torquing
from knightcube.gnc.estimation.state import SIZE, State
from knightcube.gnc.estimation.turn import Vector, compose, exponential

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
    return propagated, _carried(noise, covariance, _transition(state.rate, model, dt), model, torquing, dt)


def _transition(rate: Vector, model: Linearised, dt: float) -> FloatArray:
    """Return the rows (6, 19) of turn and rate of I + F dt + (F dt)^2 / 2; all other rows are those of I.

    F is the error's dynamics: turn' = -w x turn + rate error, and so on.
    """
    x, y, z = rate
    flow = _FLOW.copy()
    flow[TURN, TURN] = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))
    flow[RATE, TURN] = model.by_turn
    flow[RATE, RATE] = model.by_rate
    flow[RATE, PARAMETERS] = model.by_parameters
    flow *= dt
    # Only turn and rate change, so the square of F needs only their columns.
    half = flow[:, _MOTION] * 0.5
    half += _IDENTITY
    transition = np.asarray(half.dot(flow))
    transition[:, _MOTION] += _IDENTITY
    return transition


def _carried(
    noise: ProcessNoise,
    covariance: FloatArray,
    transition: FloatArray,
    model: Linearised,
    torquing: Torquing,
    dt: float,
) -> FloatArray:
    """Return the covariance after a step: only the rows and columns of turn and rate change, but for walks.

    What does not change is copied, so that the result stays exactly symmetric there.
    """
    moved = transition.dot(covariance[:SIZE])
    among = moved[:, :SIZE].dot(transition.T)
    _add_noise(among, noise, model.by_current, torquing, dt)
    carried = covariance.copy()
    carried[_MOTION] = moved
    carried[:, _MOTION] = moved.T
    carried[_MOTION, _MOTION] = among
    carried.reshape(-1)[: SIZE * len(carried) : len(carried) + 1] += dt * noise.walks
    return carried


def _add_noise(
    among: FloatArray, noise: ProcessNoise, by_current: FloatArray, torquing: Torquing, dt: float
) -> None:
    """Add the effect of white angular acceleration over dt to the covariance (6, 6) of turn and rate."""
    steady = 0.0 if torquing.known else noise.unknown_current**2 * _UNKNOWN_FOR
    weights = [noise.current * driven + steady for driven in torquing.driven]
    density = noise.rate
    if any(weights):
        density = density + (by_current * np.array(weights)).dot(by_current.T)
    turn, cross = dt**3 / 3.0, 0.5 * dt * dt
    over = np.array((turn, cross, cross, dt)).reshape(2, 1, 2, 1)
    among += (over * density[:, np.newaxis]).reshape(6, 6)


_MOTION = slice(TURN.start, RATE.stop)
_IDENTITY: FloatArray = np.eye(6)
_FLOW: FloatArray = np.zeros((6, SIZE))
_FLOW[TURN, RATE] = np.eye(3)
_FLOW[RATE, DISTURBANCE] = np.eye(3)
