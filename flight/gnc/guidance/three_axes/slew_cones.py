"""Exclusion cones: directions that a body axis keeps away from during a slew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flight.gnc.guidance.three_axes.slew_model import shown, shown_curvature, shown_slope
from flight.gnc.math.arrays import FloatArray


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
    """Cones as inequalities g >= 0 at n times: the limit's cosine less the one found."""

    def __init__(self, cones: tuple[Cone, ...], margin: float) -> None:
        """`margin` rad is added to each cone, for the way between the times."""
        self._cones = cones
        self._limits = np.cos([min(cone.angle + margin, np.pi) for cone in cones])
        self.count = len(cones)

    def values(self, q: FloatArray, times: FloatArray) -> FloatArray:
        """Return g (cones, n)."""
        found = [shown(q, cone.direction(times)) @ cone.axis for cone in self._cones]
        return self._limits[:, None] - np.array(found).reshape(self.count, len(q))

    def slopes(self, q: FloatArray, times: FloatArray) -> FloatArray:
        """Return the derivative (cones, n, 4) by the attitude."""
        found = [-cone.axis @ shown_slope(q, cone.direction(times)) for cone in self._cones]
        return np.array(found).reshape(self.count, len(q), 4)

    def curvatures(self, times: FloatArray) -> FloatArray:
        """Return the second derivative (cones, n, 4, 4)."""
        size = len(times)
        found = [
            -shown_curvature(np.broadcast_to(cone.axis, (size, 3)), cone.direction(times))
            for cone in self._cones
        ]
        return np.array(found).reshape(self.count, size, 4, 4)
