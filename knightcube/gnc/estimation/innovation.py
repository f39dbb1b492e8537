"""The innovation of a measurement and its derivative by the state's error.

A direction is compared in the plane across it: two components, so its covariance along it has no effect. A
field is compared as a vector: its strength too depends on the magnetometer's bias.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.gnc.estimation.estimate import FIELD_BIAS, TURN
from knightcube.gnc.estimation.latency import Motion, aged
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    DirectionMeasurement,
    FieldMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.state import SIZE, State, place_of
from knightcube.gnc.estimation.turn import Vector, compose, inverse, logarithm, matrix, skew, times, twist


class Innovation(NamedTuple):
    """The innovation y = H error + noise: `value` y, `rows` H, `noise` its covariance R."""

    value: tuple[float, ...]
    rows: FloatArray
    noise: FloatArray


def innovation(
    state: State, measurement: Measurement, suspended: bool, motion: Motion | None = None
) -> Innovation:
    """Return the innovation of `measurement`; of a suspended body, only its part about the thread.

    `motion` is needed for a rate whose age is estimated.
    """
    size, noise = SIZE + 3 * len(state.kept), measurement.covariance
    # The turns of a suspended body about x and z have no variance, so whole directions and fields work too.
    if isinstance(measurement, DirectionMeasurement):
        return _direction(state, measurement, size)
    if isinstance(measurement, FieldMeasurement):
        return _field(state, measurement, size)
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
    """Return innovation and rows of the mean rate between the kept attitude and the present one.

    With p the rotation vector from one to the other, p changes by Jr^-1(p) (turn now - A turn then).
    """
    span = (measurement.time_ns - measurement.since_ns) * 1e-9
    place = place_of(state, measurement)
    between = compose(state.quaternion, inverse(state.kept[place][1]))
    px, py, pz = logarithm(between)
    x, y, z = measurement.rate.tolist()
    square = px * px + py * py + pz * pz
    angle = math.sqrt(square)
    # 1/p^2 - (1 + cos p) / (2 p sin p) tends to 1/12, and differs by less than 1e-6 below 0.03 rad.
    second = 1.0 / 12.0 if angle < 0.03 else 1.0 / square - 0.5 / (angle * math.tan(0.5 * angle))
    by_turn = np.array(skew((px, py, pz)))
    by_turn = (_EYE + 0.5 * by_turn + second * (by_turn @ by_turn)) / span
    rows = np.zeros((3, size))
    rows[:, TURN] = by_turn
    first = SIZE + 3 * place
    rows[:, first : first + 3] = -by_turn @ np.array(matrix(between))
    return (x - px / span, y - py / span, z - pz / span), rows


def _direction(state: State, measurement: DirectionMeasurement, size: int) -> Innovation:
    """Return innovation and rows of a direction: b - A r, in the plane across A r, is [A r x] e.

    With A the estimated attitude and e its error, b is A r - e x A r.
    """
    rx, ry, rz = measurement.reference.tolist()
    expected = times(matrix(state.quaternion), (rx, ry, rz))
    across = tangent_basis(expected)
    rows = np.zeros((2, size))
    rows[:, TURN] = across @ np.array(skew(expected))
    first, second = (across @ measurement.observed).tolist()
    return Innovation((first, second), rows, across @ measurement.covariance @ across.T)


def _field(state: State, measurement: FieldMeasurement, size: int) -> Innovation:
    """Return innovation and rows of a magnetometer's reading: m - A B - bias."""
    bx, by, bz = measurement.reference.tolist()
    expected = times(matrix(state.quaternion), (bx, by, bz))
    rows = np.zeros((3, size))
    rows[:, TURN] = skew(expected)
    rows[:, FIELD_BIAS] = _EYE
    (mx, my, mz), (ex, ey, ez), (hx, hy, hz) = measurement.field.tolist(), expected, state.field_bias
    return Innovation((mx - ex - hx, my - ey - hy, mz - ez - hz), rows, measurement.covariance)


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
_EYE: FloatArray = np.eye(3)
