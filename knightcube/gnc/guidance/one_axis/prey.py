"""The prey path of virtual motion camouflage: a cubic in q2 between two states (Sease 2013, 5.35-5.38)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class CubicPrey:
    """q_p(t) = C0 + C1 t + C2 t^2 + C3 t^3 for t in s (5.35)."""

    c0: float
    c1: float
    c2: float
    c3: float

    @classmethod
    def between(
        cls, start: float, start_slope: float, end: float, end_slope: float, horizon: float
    ) -> CubicPrey:
        """Return the cubic from `start` to `end` in `horizon` s, slopes q2' in 1/s (5.37, 5.38)."""
        c2 = (3.0 * (end - start) - (2.0 * start_slope + end_slope) * horizon) / horizon**2
        c3 = (end_slope - start_slope - 2.0 * c2 * horizon) / (3.0 * horizon**2)
        return cls(start, start_slope, c2, c3)

    def q2(self, time: FloatArray) -> FloatArray:
        """Return q_p (n,) at `time` (n,) s (5.35)."""
        return np.asarray(self.c0 + time * (self.c1 + time * (self.c2 + time * self.c3)))

    def q2_rate(self, time: FloatArray) -> FloatArray:
        """Return q_p' (n,) in 1/s at `time` (n,) s (5.36)."""
        return np.asarray(self.c1 + time * (2.0 * self.c2 + time * 3.0 * self.c3))
