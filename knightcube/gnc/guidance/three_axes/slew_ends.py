"""The ends of a slew: the state that it starts from, and the attitude or the direction that it ends in.

A whole attitude is three equations, a boresight with a free roll two; the end's rate is three more. All are
quadratic in the quaternion, so their derivatives are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices, tangent_basis
from knightcube.gnc.guidance.three_axes.slew_model import shown, shown_curvature


@dataclass(frozen=True, slots=True, eq=False)
class Whole:
    """The attitude (4,) and the rate (3,) rad/s of the wanted frame, ICRS axes, at one time."""

    quaternion: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return True: an attitude that misses by nothing is the target."""
        return True

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return the linear (3, 4) and the quadratic part (3, 4, 4) of half the sines that q misses by.

        They are the vector part of q times the target's inverse.
        """
        v, s = self.quaternion[:3], self.quaternion[3]
        linear = np.concatenate([s * np.eye(3) + cross_matrices(v[None])[0], -v[:, None]], axis=1)
        return linear, np.zeros((3, 4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class Boresight:
    """A body axis (3,) to a direction (3,), with a free roll; the `rate` (3,) rad/s is whole. Both ICRS."""

    axis: FloatArray
    direction: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return whether an attitude (4,) that misses by nothing points to it, not away from it."""
        return float(self.axis @ shown(q[None], self.direction[None])[0]) > 0.0

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return the linear (2, 4) and the quadratic part (2, 4, 4) of the sines that q misses by."""
        across = tangent_basis(self.axis)
        return np.zeros((2, 4)), shown_curvature(across, np.broadcast_to(self.direction, (2, 3)))


End = Whole | Boresight
EndLaw = Callable[[float], End]
"""Gives the end of a slew that lasts so long, s."""


class Ending:
    """The equations of an end: by how much a state (7,) misses it, attitude, then rate (3,)."""

    def __init__(self, end: End, scale: float) -> None:
        """Take the end, and the unit of times, s."""
        linear, forms = end.misses()
        self.count = len(linear) + 3
        self._linear = np.zeros((self.count, 7))
        self._linear[:-3, :4], self._linear[-3:, 4:] = linear, np.eye(3)
        turning = shown_curvature(np.eye(3), np.broadcast_to(-scale * end.rate, (3, 3)))
        self._forms = np.concatenate([forms, turning])

    def miss(self, x: FloatArray) -> FloatArray:
        """Return by how much a state misses."""
        return np.asarray(self._linear @ x + 0.5 * (self._forms @ x[:4]) @ x[:4])

    def slope(self, x: FloatArray) -> FloatArray:
        """Return the derivative (n, 7) of `miss`."""
        result = self._linear.copy()
        result[:, :4] += self._forms @ x[:4]
        return result

    def curvature(self, pull: FloatArray) -> FloatArray:
        """Return the second derivative (4, 4) of pull . miss by the quaternion."""
        return np.asarray(np.tensordot(pull, self._forms, 1))
