"""The steps of a multiplicative extended Kalman filter: carry a state over time, correct it by a measurement.

The error of the attitude is a small turn about the body's axes (Lefferts, Markley and Shuster 1982), put into
the quaternion at each correction and taken out of the covariance with the frame it was written in (Markley
and Crassidis 2014, 6.2.4: the reset). The rate is a state of its own, driven by Euler's equation and not by
the gyro: what the plant model knows makes the rate better than the gyro's. Attitudes of the past that are
still needed stand behind the state (stochastic cloning, Roumeliotis and Burdick 2002).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flight.arrays import FloatArray
from flight.estimation.estimate import DISTURBANCE, LATENCY, PARAMETERS, RATE, TURN
from flight.estimation.latency import Motion, aged
from flight.estimation.measurements import (
    AttitudeMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from flight.estimation.rigid_body import Linearised, Parameters, RigidBody, Torquing
from flight.estimation.turn import (
    Quaternion,
    Vector,
    compose,
    exponential,
    inverse,
    logarithm,
    matrix,
    skew,
    twist,
)

SIZE = 16
LONGEST_STEP = 0.025
"""s: also without measurements no step is longer than in the loop."""


class State(NamedTuple):
    """The estimate as tuples; `kept` are attitudes at starts of exposures, as they came.

    `latency` is by how much the inertial unit's samples are older than they say, s.
    """

    quaternion: Quaternion
    rate: Vector
    bias: Vector
    disturbance: Vector
    parameters: Parameters
    kept: tuple[tuple[MeanRateMeasurement, Quaternion], ...] = ()
    latency: float = 0.0


class ProcessNoise(NamedTuple):
    """What drives the state beside the model: spectral densities.

    `current` of one driven coil, A^2 s; `rate` (3, 3) rad^2/s^3; `walks` (6,) of bias (rad^2/s^3)
    and disturbance (rad^2/s^5); `latency` of that, s.
    """

    current: float
    rate: FloatArray
    walks: FloatArray
    latency: float = 0.0


class Innovation(NamedTuple):
    """What a measurement says beyond the state: y = H error + noise of covariance R."""

    value: tuple[float, ...]
    rows: FloatArray
    noise: FloatArray


def carry(
    body: RigidBody,
    noise: ProcessNoise,
    state: State,
    covariance: FloatArray,
    torquing: Torquing,
    duration: float,
) -> tuple[State, FloatArray]:
    """Carry state and covariance over `duration` s under one torquing."""
    steps = max(1, math.ceil(duration / LONGEST_STEP - 1e-9))
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
    """Carry by one step of the midpoint rule; kept attitudes stay what they were."""
    half = 0.5 * dt
    wx, wy, wz = state.rate
    middle = compose(exponential(half * wx, half * wy, half * wz), state.quaternion)
    model = body.linearise(middle, state.rate, state.parameters, torquing, half)
    ax, ay, az = (a + d for a, d in zip(model.acceleration, state.disturbance, strict=True))
    moved = exponential(dt * (wx + half * ax), dt * (wy + half * ay), dt * (wz + half * az))
    carried = State(
        compose(moved, state.quaternion),
        (wx + dt * ax, wy + dt * ay, wz + dt * az),
        state.bias,
        state.disturbance,
        state.parameters,
        state.kept,
        state.latency,
    )
    transition = _transition(state.rate, model, dt)
    if state.kept:
        covariance = covariance.copy()
        covariance[:SIZE] = transition @ covariance[:SIZE]
        covariance[:, :SIZE] = covariance[:, :SIZE] @ transition.T
    else:
        covariance = transition @ covariance @ transition.T
    _add_noise(covariance, noise, model.by_current, torquing, dt)
    return carried, covariance


def _transition(rate: Vector, model: Linearised, dt: float) -> FloatArray:
    """Return I + F dt + (F dt)^2 / 2 of the error's dynamics: turn' = -w x turn + rate error, and so on."""
    flow = _FLOW * dt
    x, y, z = rate[0] * dt, rate[1] * dt, rate[2] * dt
    flow[TURN, TURN] = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))
    flow[RATE, TURN] = model.by_turn * dt
    flow[RATE, RATE] = model.by_rate * dt
    flow[RATE, PARAMETERS] = np.array(model.by_parameters) * dt
    return np.asarray(_IDENTITY + flow + 0.5 * (flow @ flow))


def _add_noise(
    covariance: FloatArray, noise: ProcessNoise, by_current: FloatArray, torquing: Torquing, dt: float
) -> None:
    """Add what white angular acceleration and the two walks make in dt, in place."""
    density = noise.rate
    if noise.current and any(torquing.driven):
        density = density + noise.current * ((by_current * torquing.driven) @ by_current.T)
    cross = (0.5 * dt * dt) * density
    covariance[TURN, TURN] += (dt**3 / 3.0) * density
    covariance[TURN, RATE] += cross
    covariance[RATE, TURN] += cross
    covariance[RATE, RATE] += dt * density
    stride = len(covariance) + 1
    covariance.reshape(-1)[6 * stride : 12 * stride : stride] += dt * noise.walks
    covariance[LATENCY, LATENCY] += dt * noise.latency


def keep_attitude(
    state: State, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[State, FloatArray]:
    """Keep the attitude of now for the end of the exposure that begins here."""
    pick = [*range(len(covariance)), 0, 1, 2]
    kept = (*state.kept, (measurement, state.quaternion))
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


def release_attitude(
    state: State, covariance: FloatArray, measurement: MeanRateMeasurement
) -> tuple[State, FloatArray]:
    """Forget the attitude that was kept for this exposure."""
    place = _place(state, measurement)
    first = SIZE + 3 * place
    pick = [*range(first), *range(first + 3, len(covariance))]
    kept = state.kept[:place] + state.kept[place + 1 :]
    return state._replace(kept=kept), covariance[np.ix_(pick, pick)]


def innovation(
    state: State, measurement: Measurement, suspended: bool, motion: Motion | None = None
) -> Innovation:
    """Return what `measurement` says beyond `state`; of a suspended body, about the thread alone.

    `motion` is asked for a rate whose time is not known for sure.
    """
    size, noise = SIZE + 3 * len(state.kept), measurement.covariance
    if isinstance(measurement, RateMeasurement):
        x, y, z = measurement.rate.tolist()
        (wx, wy, wz), (bx, by, bz) = state.rate, state.bias
        value: Vector = (x - wx - bx, y - wy - by, z - wz - bz)
        rows = _rows("rate", size)
        if measurement.latency is not None and motion is not None:
            more = state.latency - measurement.latency
            value, rows = aged(more, motion.acceleration, value, rows)
            noise = noise + motion.uncertainty
    elif isinstance(measurement, AttitudeMeasurement):
        a, b, c, d = measurement.quaternion.tolist()
        between = compose((a, b, c, d), inverse(state.quaternion))
        value = (0.0, twist(between), 0.0) if suspended else logarithm(between)
        rows = _rows("turn", size)
        if measurement.latency is not None:
            value, rows = aged(state.latency - measurement.latency, state.rate, value, rows)
    else:
        value, rows = _mean_rate(state, measurement, size)
    if suspended:
        return Innovation(value[1:2], rows[1:2], noise[1:2, 1:2])
    return Innovation(value, rows, noise)


def _mean_rate(state: State, measurement: MeanRateMeasurement, size: int) -> tuple[Vector, FloatArray]:
    """Return innovation and rows of the mean rate between the attitude kept and that of now.

    With p the rotation vector from one to the other, p changes by Jr^-1(p) (turn now - A turn then).
    """
    span = (measurement.time_ns - measurement.since_ns) * 1e-9
    place = _place(state, measurement)
    between = compose(state.quaternion, inverse(state.kept[place][1]))
    px, py, pz = logarithm(between)
    x, y, z = measurement.rate.tolist()
    square = px * px + py * py + pz * pz
    angle = math.sqrt(square)
    # 1/p^2 - (1 + cos p) / (2 p sin p), which tends to 1/12 and is that to 1e-6 below 0.03 rad.
    second = 1.0 / 12.0 if angle < 0.03 else 1.0 / square - 0.5 / (angle * math.tan(0.5 * angle))
    by_turn = np.array(skew((px, py, pz)))
    by_turn = (_IDENTITY[TURN, TURN] + 0.5 * by_turn + second * (by_turn @ by_turn)) / span
    rows = np.zeros((3, size))
    rows[:, TURN] = by_turn
    first = SIZE + 3 * place
    rows[:, first : first + 3] = -by_turn @ np.array(matrix(between))
    return (x - px / span, y - py / span, z - pz / span), rows


def normalised_square(found: Innovation, covariance: FloatArray) -> tuple[float, FloatArray]:
    """Return y^T S^-1 y, chi-square of as many degrees as y has components, and the gain P H^T S^-1."""
    cross = covariance @ found.rows.T
    weight = _inverted(found.rows @ cross + found.noise)
    y = np.array(found.value)
    return float(y @ weight @ y), cross @ weight


def correct(
    state: State, covariance: FloatArray, found: Innovation, gain: FloatArray
) -> tuple[State, FloatArray]:
    """Put the correction into the state; covariance in Joseph's form, symmetric and positive."""
    keep = -(gain @ found.rows)
    keep.reshape(-1)[:: len(keep) + 1] += 1.0
    error = (gain @ np.array(found.value)).tolist()
    # The reset: the turn that is left is written in axes turned by half the correction.
    for first in (0, *range(SIZE, len(covariance), 3)):
        x, y, z = error[first : first + 3]
        reset = np.array(((1.0, 0.5 * z, -0.5 * y), (-0.5 * z, 1.0, 0.5 * x), (0.5 * y, -0.5 * x, 1.0)))
        keep[first : first + 3] = reset @ keep[first : first + 3]
        gain[first : first + 3] = reset @ gain[first : first + 3]
    covariance = keep @ covariance @ keep.T + gain @ found.noise @ gain.T
    covariance = 0.5 * (covariance + covariance.T)
    corrected = State(
        compose(exponential(*error[0:3]), state.quaternion),
        _sum(state.rate, error[3:6]),
        _sum(state.bias, error[6:9]),
        _sum(state.disturbance, error[9:12]),
        Parameters(*_sum(state.parameters, error[12:15])),
        tuple(
            (measurement, compose(exponential(*error[first : first + 3]), quaternion))
            for first, (measurement, quaternion) in zip(range(SIZE, len(error), 3), state.kept, strict=True)
        ),
        state.latency + error[LATENCY],
    )
    return corrected, covariance


def _place(state: State, measurement: MeanRateMeasurement) -> int:
    return next(place for place, (owner, _) in enumerate(state.kept) if owner is measurement)


def _sum(a: Vector, b: list[float]) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _inverted(s: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric (1, 1) or (3, 3) matrix, by cofactors."""
    if len(s) == 1:
        return np.asarray(1.0 / s)
    (a, b, c), (_, d, e), (_, _, f) = s.tolist()
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * ca + b * cb + c * cc)
    return np.asarray(np.array(((ca, cb, cc), (cb, cd, ce), (cc, ce, cf))) * scale)


def _rows(kind: str, size: int) -> FloatArray:
    """Return the rows (3, size) of a measured turn or of a gyro's rate."""
    rows = _ROWS.get((kind, size))
    if rows is None:
        rows = np.zeros((3, size))
        for first in (0,) if kind == "turn" else (3, 6):
            rows[:, first : first + 3] += np.eye(3)
        _ROWS[kind, size] = rows
    return rows


_ROWS: dict[tuple[str, int], FloatArray] = {}
_IDENTITY: FloatArray = np.eye(SIZE)
_FLOW: FloatArray = np.zeros((SIZE, SIZE))
_FLOW[TURN, RATE] = np.eye(3)
_FLOW[RATE, DISTURBANCE] = np.eye(3)
