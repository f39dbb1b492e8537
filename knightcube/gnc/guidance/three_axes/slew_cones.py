"""Exclusion cones: directions that a body axis keeps away from during a slew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.three_axes.slew_model import shown, shown_curvature


@dataclass(frozen=True, slots=True, eq=False)
class Cone:
    """Body `axis` (3,) stays `angle` rad or more away from a direction.

    Attributes:
        name: for messages.
        direction: gives unit vectors (n, 3), ICRS, at times (n,) s after the start.
    """

    name: str
    axis: FloatArray
    direction: Callable[[FloatArray], FloatArray]
    angle: float

    def clearance(self, q: FloatArray, times: FloatArray) -> FloatArray:
        """Return how far outside (n,) rad the axis lies at attitudes (n, 4)."""
        cosine = shown(q, self.direction(times)) @ self.axis / np.sum(q * q, axis=1)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) - self.angle)


class Kept:
    """Cones as inequalities g >= 0 at n times: the limit's cosine less that of axis and direction.

    That cosine is a quadratic form of the attitude.
    """

    def __init__(self, cones: tuple[Cone, ...], margin: FloatArray, times: FloatArray) -> None:
        """`margin` rad, of all or (cones, n), is added for the way between the `times` (n,) s."""
        angles = np.array([cone.angle for cone in cones]).reshape(-1, 1) + margin
        self._limits = np.cos(np.clip(angles, 0.0, np.pi))
        self.count, size = len(cones), len(times)
        found = [
            -shown_curvature(np.broadcast_to(cone.axis, (size, 3)), cone.direction(times)) for cone in cones
        ]
        self.curvatures = np.array(found).reshape(self.count, size, 4, 4)
        """(cones, n, 4, 4), the second derivative by the attitude."""

    def values(self, q: FloatArray) -> FloatArray:
        """Return g (cones, n) at attitudes (n, 4); of many paths (m, 1, n, 4) (m, cones, n)."""
        return np.asarray(self._limits + 0.5 * np.sum(self.slopes(q) * q, axis=-1))

    def slopes(self, q: FloatArray) -> FloatArray:
        """Return the derivative (cones, n, 4) by the attitude."""
        return np.asarray((self.curvatures @ q[..., None])[..., 0])
