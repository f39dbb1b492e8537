"""The motion of a satellite with coils, its Jacobian, and its curvature, at many times at once.

State (7,): attitude and body rate; control (3,): the coils' dipole. With b = A(q) B and e = A(q) r:

    q' = 1/2 [w, 0] q,    J w' = (m + residual) x b + 3 mu / r^3 e x J e + torque - w x J w

The torque has no part along the field: that is why only some paths can be flown. All derivatives are exact:
A(q) v is a quadratic form of q, with Davenport's matrix as its curvature.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from flight.gnc.earth.figure import GRAVITATIONAL_PARAMETER
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import cross_matrices

_EYE3: FloatArray = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class SlewCraft:
    """What a slew's planner believes of the craft, in body axes.

    Attributes:
        inertia: (3, 3) kg m^2.
        limit: (3,) A m^2, of each coil.
        weights: (3,) W/(A m^2)^2, heat of each coil per square of its dipole.
        residual: (3,) A m^2, the craft's own dipole.
        torque: (3,) N m, a constant disturbance.
    """

    inertia: FloatArray
    limit: FloatArray
    weights: FloatArray
    residual: FloatArray = field(default_factory=lambda: np.zeros(3))
    torque: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """What acts on the body at n times, ICRS axes: `field` (n, 3) T and `position` (n, 3) m."""

    field: FloatArray
    position: FloatArray

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return the directions (n, 3) of the position, and 3 mu / r^3 (n,) 1/s^2."""
        radius = np.linalg.norm(self.position, axis=1)
        return self.position / radius[:, None], 3.0 * GRAVITATIONAL_PARAMETER / radius**3


Along = Callable[[FloatArray], Around]
"""Gives what acts at times (n,) s after the start of a slew."""


def shown(q: FloatArray, vector: FloatArray) -> FloatArray:
    """Return A(q) v (n, 3), also off the unit sphere, where it grows with |q|^2."""
    v, s = q[:, :3], q[:, 3:]
    inner = np.sum(v * vector, axis=1, keepdims=True)
    square = s * s - np.sum(v * v, axis=1, keepdims=True)
    return np.asarray(square * vector + 2.0 * inner * v - 2.0 * s * cross(v, vector))


def shown_slope(q: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the derivative (n, 3, 4) of A(q) v by q."""
    v, s = q[:, :3], q[:, 3]
    slope = np.empty((len(q), 3, 4))
    inner = np.sum(v * vector, axis=1)
    outer = v[:, :, None] * vector[:, None, :]
    slope[:, :, :3] = 2.0 * (
        outer
        - outer.transpose(0, 2, 1)
        + inner[:, None, None] * _EYE3
        + s[:, None, None] * cross_matrices(vector)
    )
    slope[:, :, 3] = 2.0 * (s[:, None] * vector - cross(v, vector))
    return slope


def shown_curvature(pull: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the second derivative (n, 4, 4) of pull . A(q) v by q: twice Davenport's matrix."""
    curvature = np.empty((len(pull), 4, 4))
    outer = pull[:, :, None] * vector[:, None, :]
    inner = np.sum(pull * vector, axis=1)
    curvature[:, :3, :3] = outer + outer.transpose(0, 2, 1) - inner[:, None, None] * _EYE3
    curvature[:, :3, 3] = curvature[:, 3, :3] = cross(pull, vector)
    curvature[:, 3, 3] = inner
    return 2.0 * curvature


class Motion:
    """The motion of one craft; times are counted in units of `scale` s, dipoles in `unit` A m^2."""

    def __init__(self, craft: SlewCraft, scale: float, unit: float) -> None:
        self._scale, self._unit = scale, unit
        self._inertia = craft.inertia
        self._inverse = np.linalg.inv(craft.inertia)
        self._residual = craft.residual / unit
        self._torque = scale**2 * craft.torque
        self.push = scale**2 * unit

    def flow(self, x: FloatArray, m: FloatArray, around: Around) -> FloatArray:
        """Return x' (n, 7) at states (n, 7) and dipoles (n, 3)."""
        q, w = x[:, :4], x[:, 4:]
        down, strength = around.gradient()
        b, e = self.push * shown(q, around.field), shown(q, down)
        torque = cross(m + self._residual, b) + self._torque - cross(w, w @ self._inertia)
        torque += (self._scale**2 * strength)[:, None] * cross(e, e @ self._inertia)
        result = np.empty_like(x)
        result[:, :3] = 0.5 * (cross(q[:, :3], w) + q[:, 3:] * w)
        result[:, 3] = -0.5 * np.sum(w * q[:, :3], axis=1)
        result[:, 4:] = torque @ self._inverse
        return result

    def slopes(self, x: FloatArray, m: FloatArray, around: Around) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of x' by the state (n, 7, 7) and by the dipole (n, 7, 3)."""
        q, w = x[:, :4], x[:, 4:]
        down, strength = around.gradient()
        b, e = self.push * shown(q, around.field), shown(q, down)
        by_state, by_dipole = np.zeros((len(x), 7, 7)), np.zeros((len(x), 7, 3))
        by_state[:, :3, :3] = -0.5 * cross_matrices(w)
        by_state[:, :3, 3] = 0.5 * w
        by_state[:, 3, :3] = -0.5 * w
        by_state[:, :3, 4:] = 0.5 * (q[:, 3, None, None] * _EYE3 + cross_matrices(q[:, :3]))
        by_state[:, 3, 4:] = -0.5 * q[:, :3]
        turned = cross_matrices(m + self._residual) @ (self.push * shown_slope(q, around.field))
        stiff = cross_matrices(e) @ self._inertia - cross_matrices(e @ self._inertia)
        turned += (self._scale**2 * strength)[:, None, None] * (stiff @ shown_slope(q, down))
        by_state[:, 4:, :4] = self._inverse @ turned
        spin = cross_matrices(w @ self._inertia) - cross_matrices(w) @ self._inertia
        by_state[:, 4:, 4:] = self._inverse @ spin
        by_dipole[:, 4:] = -self._inverse @ cross_matrices(b)
        return by_state, by_dipole

    def curvature(self, x: FloatArray, m: FloatArray, around: Around, y: FloatArray) -> FloatArray:
        """Return the second derivative (n, 10, 10) of y . x' by state and dipole, for `y` (n, 7)."""
        q, pull = x[:, :4], y[:, 4:] @ self._inverse
        down, strength = around.gradient()
        result = np.zeros((len(x), 10, 10))
        mixed = result[:, 4:7, :4]
        mixed[:, :, :3] = 0.5 * (cross_matrices(y[:, :3]) - y[:, 3, None, None] * _EYE3)
        mixed[:, :, 3] = 0.5 * y[:, :3]
        result[:, :4, 4:7] = mixed.transpose(0, 2, 1)
        crossed = cross_matrices(pull)
        swirl = self._inertia @ crossed - crossed @ self._inertia
        result[:, 4:7, 4:7] = -swirl
        e, slope = shown(q, down), shown_slope(q, down)
        tide = (self._scale**2 * strength)[:, None]
        by_e = tide * (cross(e @ self._inertia, pull) + cross(pull, e) @ self._inertia)
        result[:, :4, :4] = (
            shown_curvature(self.push * cross(pull, m + self._residual), around.field)
            + shown_curvature(by_e, down)
            + tide[:, :, None] * (slope.transpose(0, 2, 1) @ swirl @ slope)
        )
        result[:, 7:, :4] = -crossed @ (self.push * shown_slope(q, around.field))
        result[:, :4, 7:] = result[:, 7:, :4].transpose(0, 2, 1)
        return result


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b (n, 3), in a fraction of the time of `np.cross`."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
