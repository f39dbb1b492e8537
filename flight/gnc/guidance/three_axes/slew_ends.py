"""The ends of a slew: the state that it starts from, and the attitude or the direction that it ends in.

A whole attitude is three equations, a boresight with a free roll two; the end's rate is three more. All are
quadratic forms of the quaternion, so their derivatives are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flight.gnc.guidance.three_axes.slew_model import shown, shown_curvature, shown_slope
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import cross_matrices, tangent_basis


@dataclass(frozen=True, slots=True, eq=False)
class Whole:
    """The attitude (4,) and the rate (3,) rad/s of the wanted frame, ICRS axes, at one time."""

    quaternion: FloatArray
    rate: FloatArray

    def misses(self, q: FloatArray) -> FloatArray:
        """Return half the sines (3,) by which an attitude (4,) misses."""
        return np.asarray(self.slope(q) @ q)

    def is_met(self, q: FloatArray) -> bool:
        """Return True: an attitude that misses by nothing is the target."""
        return True

    def slope(self, q: FloatArray) -> FloatArray:
        """Return the derivative (3, 4) of `misses`: the vector part of q times the target's inverse."""
        v, s = self.quaternion[:3], self.quaternion[3]
        return np.concatenate([s * np.eye(3) + cross_matrices(v[None])[0], -v[:, None]], axis=1)

    def curvature(self, pull: FloatArray) -> FloatArray:
        """Return the second derivative (4, 4) of pull . misses."""
        return np.zeros((4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class Boresight:
    """A body axis (3,) to a direction (3,), with a free roll; the `rate` (3,) rad/s is whole. Both ICRS."""

    axis: FloatArray
    direction: FloatArray
    rate: FloatArray

    def misses(self, q: FloatArray) -> FloatArray:
        """Return the sines (2,) by which an attitude (4,) misses."""
        return np.asarray(tangent_basis(self.axis) @ shown(q[None], self.direction[None])[0])

    def is_met(self, q: FloatArray) -> bool:
        """Return whether an attitude (4,) that misses by nothing points to it, not away from it."""
        return float(self.axis @ shown(q[None], self.direction[None])[0]) > 0.0

    def slope(self, q: FloatArray) -> FloatArray:
        """Return the derivative (2, 4) of `misses`."""
        return np.asarray(tangent_basis(self.axis) @ shown_slope(q[None], self.direction[None])[0])

    def curvature(self, pull: FloatArray) -> FloatArray:
        """Return the second derivative (4, 4) of pull . misses."""
        pulled = pull @ tangent_basis(self.axis)
        return np.asarray(shown_curvature(pulled[None], self.direction[None])[0])


End = Whole | Boresight
EndLaw = Callable[[float], End]
"""Gives the end of a slew that lasts so long, s."""


def miss(end: End, x: FloatArray, scale: float) -> FloatArray:
    """Return by how much a state (7,), times in `scale` s, misses its end: attitude, then rate (3,)."""
    wanted = scale * shown(x[None, :4], end.rate[None])[0]
    return np.concatenate([end.misses(x[:4]), x[4:] - wanted])


def miss_slope(end: End, x: FloatArray, scale: float) -> FloatArray:
    """Return the derivative (n, 7) of `miss`."""
    attitude = end.slope(x[:4])
    result = np.zeros((len(attitude) + 3, 7))
    result[:-3, :4] = attitude
    result[-3:, :4] = -scale * shown_slope(x[None, :4], end.rate[None])[0]
    result[-3:, 4:] = np.eye(3)
    return result


def miss_curvature(end: End, pull: FloatArray, scale: float) -> FloatArray:
    """Return the second derivative (4, 4) of pull . miss by the quaternion."""
    turning = shown_curvature(pull[None, -3:], end.rate[None])[0]
    return np.asarray(end.curvature(pull[:-3]) - scale * turning)
