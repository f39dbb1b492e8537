"""The motion of a free satellite during a short step, and its error dynamics.

The satellite moves under the torques of its dipole in the magnetic field and of the gravity gradient, and
under the disturbance torques of `knightcube.astro.earth.disturbance`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrix, cross_product
from knightcube.astro.earth.disturbance import Pressures, shapes
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import (
    Vector,
    added,
    attitude_matrix,
    compose,
    cross,
    exponential,
    from_rotation_vector,
    matrix,
    multiply,
    times,
)
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.gnc.estimation.rigid_body import by_inertia, by_matrix

Bodies = tuple[FloatArray, FloatArray, FloatArray, float]
"""Inertia tensor (3, 3), kg m^2, its inverse, areas (3,) of the faces, and trace of the assumed inertia."""


class MotionStep(NamedTuple):
    """The motion of a satellite during a step.

    Attributes:
        quaternion: attitude (4,) at the end.
        rate: body rate (3,) at the end, rad/s.
        swept: integral (3,) of the rate over the step, rad.
        middle: body rate (3,) in the middle of the step, rad/s.
        acceleration: angular acceleration (3,) in the middle of the step, rad/s^2.
        slopes: derivatives (3, 39) of the angular acceleration with respect to the errors of attitude (3),
            rate (3), dipole in shadow (3) and its increase in sunlight (3), torque components (9), inertia
            (6), matrix of the coils (9) and variation of the coils (3).
    """

    quaternion: FloatArray
    rate: FloatArray
    swept: FloatArray
    middle: FloatArray
    acceleration: FloatArray
    slopes: FloatArray


def _rates_numpy(
    inertia: FloatArray, inverse: FloatArray, rate: FloatArray, torque: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the rate (3,) after `dt` s, and `swept`, `middle` and `acceleration` of a `MotionStep`."""

    def accelerated(at: FloatArray) -> FloatArray:
        return np.asarray(inverse @ (torque - cross_product(at, inertia @ at)))

    first = accelerated(rate)
    second = accelerated(rate + 0.5 * dt * first)
    middle = rate + 0.5 * dt * second
    third = accelerated(middle)
    last = accelerated(rate + dt * third)
    after = rate + dt / 6.0 * (first + 2.0 * (second + third) + last)
    return after, dt * (rate + dt / 6.0 * (first + second + third)), middle, third


def _step_numpy(
    body: Bodies,
    quaternion: FloatArray,
    rate: FloatArray,
    driven: FloatArray,
    dipole: FloatArray,
    sizes: FloatArray,
    around: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    sunlit: float,
    gravity: float,
    dt: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the elements of a `MotionStep` of `dt` s, by the classical Runge-Kutta method.

    The step begins with an attitude (4,) and a rate (3,), rad/s. The commanded dipole of the coils is
    `driven` (3,), A m^2. The sum of the estimated dipole of the coils and the residual dipole is `dipole`
    (3,), A m^2. The components of the disturbance torques are `sizes` (9,), N m. `around` contains, in ICRS,
    the magnetic field (3,), T, the position (3,), m, and the pressures of air and sunlight, each (1, 3), Pa.
    `gravity` is the gravitational parameter of the Earth, m^3/s^2.
    """
    inertia, inverse, areas, trace = body
    to_body = attitude_matrix(multiply(from_rotation_vector(0.5 * dt * rate), quaternion))
    field, position = to_body @ around[0], to_body @ around[1]
    radius = math.sqrt(float(position @ position))
    up = position / radius
    stiff = inertia @ up
    strength = 3.0 * gravity / radius**3
    shape = shapes(Pressures(around[2], around[3]).facing(areas, to_body[None]), to_body[None])[0]
    across, upright = cross_matrix(field), cross_matrix(up)
    torque = -across @ dipole + strength * upright @ stiff + shape @ sizes
    after, swept, middle, acceleration = _rates_numpy(inertia, inverse, rate, torque, dt)
    # The rate changes its direction during the step (Bortz 1971, to second order).
    rotation = from_rotation_vector(swept + dt * dt / 12.0 * cross_product(rate, after))
    turning = cross_matrix(middle)
    stiffness = strength * (upright @ inertia - cross_matrix(stiff)) @ upright
    changed = strength * upright @ by_inertia(up) - by_inertia(acceleration) - turning @ by_inertia(middle)
    slopes = np.empty((3, 39))
    slopes[:, 0:3] = inverse @ (cross_matrix(dipole) @ across + stiffness)
    slopes[:, 3:6] = inverse @ (cross_matrix(inertia @ middle) - turning @ inertia)
    slopes[:, 6:9] = -inverse @ across
    slopes[:, 9:12] = sunlit * slopes[:, 6:9]
    slopes[:, 12:21] = inverse @ shape
    slopes[:, 21:27] = trace * inverse @ changed
    slopes[:, 27:36] = slopes[:, 6:9] @ by_matrix(driven)
    slopes[:, 36:39] = slopes[:, 6:9] * driven
    return multiply(rotation, quaternion), after, swept, middle, acceleration, slopes


@loop_helper
def _skew(v: Vector) -> FloatArray:
    """Return the matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = v
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


@loop_helper
def _by_inertia(v: Vector) -> FloatArray:
    """See `rigid_body.by_inertia`."""
    x, y, z = v
    return np.array(((x, 0.0, 0.0, 0.0, z, y), (0.0, y, 0.0, z, 0.0, x), (0.0, 0.0, z, y, x, 0.0)))


@loop_helper
def _add(to: FloatArray, first: int, factor: float, one: FloatArray, other: FloatArray) -> None:
    """Add `factor` * `one` (3, 3) @ `other` (3, n) to the n columns of `to` that begin with `first`."""
    for i in range(3):
        for j in range(other.shape[1]):
            for k in range(3):
                to[i, first + j] += factor * one[i, k] * other[k, j]


@loop_helper
def _times(rows: FloatArray, v: Vector) -> Vector:
    """Return the product of a matrix (3, 3) and a vector (3,)."""
    (a, b, c), (d, e, f), (g, h, i) = rows[0], rows[1], rows[2]
    return times(((a, b, c), (d, e, f), (g, h, i)), v)


@loop_helper
def _ahead(vector: Vector, seconds: float, slope: Vector) -> Vector:
    """Return `vector` + `seconds` * `slope`."""
    return vector[0] + seconds * slope[0], vector[1] + seconds * slope[1], vector[2] + seconds * slope[2]


@loop_helper
def _accelerated(inertia: FloatArray, inverse: FloatArray, rate: Vector, torque: Vector) -> Vector:
    """Return the angular acceleration (3,), rad/s^2."""
    return _times(inverse, added(torque, cross(_times(inertia, rate), rate)))


@loop_helper
def _rates(
    inertia: FloatArray, inverse: FloatArray, rate: Vector, torque: Vector, dt: float
) -> tuple[Vector, Vector, Vector, Vector]:
    """See `_rates_numpy`."""
    first = _accelerated(inertia, inverse, rate, torque)
    second = _accelerated(inertia, inverse, _ahead(rate, 0.5 * dt, first), torque)
    middle = _ahead(rate, 0.5 * dt, second)
    third = _accelerated(inertia, inverse, middle, torque)
    last = _accelerated(inertia, inverse, _ahead(rate, dt, third), torque)
    twice = added(second, third)
    after = _ahead(rate, dt / 6.0, added(added(added(first, twice), twice), last))
    mean = _ahead(rate, dt / 6.0, added(first, twice))
    return after, (dt * mean[0], dt * mean[1], dt * mean[2]), middle, third


@loop_helper
def _exposed(areas: FloatArray, pressure: Vector) -> Vector:
    """Return a pressure vector (3,), body axes, multiplied by the exposed area of the body."""
    x, y, z = pressure
    length = math.sqrt(x * x + y * y + z * z)
    area = (abs(x) * areas[0] + abs(y) * areas[1] + abs(z) * areas[2]) / (length if length > 0.0 else 1.0)
    return area * x, area * y, area * z


@loop_helper
def _by_unknowns(
    body: Bodies, dipole: Vector, field: Vector, up: Vector, strength: float, air: Vector, light: Vector
) -> FloatArray:
    """Return the derivatives (3, 39) of the torque without the terms that depend on the rate."""
    inertia, _, _, trace = body
    found, gradient, eye = np.zeros((3, 39)), np.zeros((3, 3)), np.eye(3)
    upright, across = _skew(up), _skew(field)
    _add(gradient, 0, 1.0, upright, inertia)
    _add(gradient, 0, -1.0, eye, _skew(_times(inertia, up)))
    _add(found, 0, 1.0, _skew(dipole), across)
    _add(found, 0, strength, gradient, upright)
    _add(found, 6, -1.0, eye, across)
    _add(found, 12, 1.0, eye, eye)
    _add(found, 15, -1.0, eye, _skew(air))
    _add(found, 18, -1.0, eye, _skew(light))
    _add(found, 21, trace * strength, upright, _by_inertia(up))
    return found


@compiled_form_of(_step_numpy)
def _step(
    body: Bodies,
    quaternion: FloatArray,
    rate: FloatArray,
    driven: FloatArray,
    dipole: FloatArray,
    sizes: FloatArray,
    around: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    sunlit: float,
    gravity: float,
    dt: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """See `_step_numpy`."""
    inertia, inverse, areas, trace = body
    half, begun = 0.5 * dt, (rate[0], rate[1], rate[2])
    attitude = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    to_body = matrix(compose(exponential(half * rate[0], half * rate[1], half * rate[2]), attitude))
    vectors, pressed = (around[0], around[1]), (around[2], around[3])
    field, position = [times(to_body, (v[0], v[1], v[2])) for v in vectors]
    air, light = [_exposed(areas, times(to_body, (v[0, 0], v[0, 1], v[0, 2]))) for v in pressed]
    radius = math.sqrt(position[0] ** 2 + position[1] ** 2 + position[2] ** 2)
    up = position[0] / radius, position[1] / radius, position[2] / radius
    strength = 3.0 * gravity / radius**3
    given = dipole[0], dipole[1], dipole[2]
    torque = added(cross(given, field), (sizes[0], sizes[1], sizes[2]))
    torque = _ahead(torque, strength, cross(up, _times(inertia, up)))
    torque = added(torque, cross((sizes[3], sizes[4], sizes[5]), air))
    torque = added(torque, cross((sizes[6], sizes[7], sizes[8]), light))
    after, swept, middle, third = _rates(inertia, inverse, begun, torque, dt)
    x, y, z = _ahead(swept, dt * dt / 12.0, cross(begun, after))
    found = _by_unknowns(body, given, field, up, strength, air, light)
    eye, turning = np.eye(3), _skew(middle)
    _add(found, 3, 1.0, eye, _skew(_times(inertia, middle)))
    _add(found, 3, -1.0, turning, inertia)
    _add(found, 21, -trace, eye, _by_inertia(third))
    _add(found, 21, -trace, turning, _by_inertia(middle))
    slopes = np.zeros((3, 39))
    _add(slopes, 0, 1.0, inverse, found)
    for i in range(3):
        for j in range(3):
            slopes[i, 9 + j], slopes[i, 36 + j] = sunlit * slopes[i, 6 + j], slopes[i, 6 + j] * driven[j]
            for k in range(3):
                slopes[i, 27 + 3 * j + k] = slopes[i, 6 + j] * driven[k]
    quaternion = np.array(compose(exponential(x, y, z), attitude))
    return quaternion, np.array(after), np.array(swept), np.array(middle), np.array(third), slopes


def step(
    body: Bodies,
    quaternion: FloatArray,
    rate: FloatArray,
    dipoles: tuple[FloatArray, FloatArray],
    sizes: FloatArray,
    around: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    sunlit: float,
    dt: float,
) -> MotionStep:
    """Return the motion during a step of `dt` s. The arguments are those of `_step_numpy`.

    The `dipoles` are the commanded dipole of the coils, and the sum of the estimated dipole of the coils and
    the residual dipole.
    """
    return MotionStep(
        *_step(body, quaternion, rate, *dipoles, sizes, around, sunlit, GRAVITATIONAL_PARAMETER, dt)
    )
