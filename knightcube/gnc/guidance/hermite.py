"""Cubic Hermite interpolation: through values with given slopes at uneven times (de Boor 1978, ch. IV).

scipy.interpolate would cost each process that flies or plans a slew 20 MiB for these two formulas.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class HermiteCubic:
    """A curve through `values` (n, k) with `slopes` (n, k) at rising `times` (n,), n > 1.

    Times outside continue the first or the last cubic.
    """

    times: FloatArray
    values: FloatArray
    slopes: FloatArray

    def __call__(self, times: FloatArray) -> FloatArray:
        """Return the values (m, k) at `times` (m,)."""
        s, span, start, step, out, into = self._parts(times)
        bend = (1.0 - s) * (span * out - step) + s * (step - span * into)
        return np.asarray(start + s * step + s * (1.0 - s) * bend)

    def derivative(self, times: FloatArray) -> FloatArray:
        """Return the slopes (m, k) at `times` (m,)."""
        s, span, _, step, out, into = self._parts(times)
        mean = 6.0 * s * (1.0 - s) * step / span
        return np.asarray(mean + (1.0 - s) * (1.0 - 3.0 * s) * out + s * (3.0 * s - 2.0) * into)

    def _parts(self, times: FloatArray) -> tuple[FloatArray, ...]:
        """Return share (m, 1) and length (m, 1) of the spans of `times`, their begins, steps and slopes."""
        at = np.asarray(times, dtype=float)
        before = np.clip(np.searchsorted(self.times, at, side="right") - 1, 0, len(self.times) - 2)
        span = (self.times[before + 1] - self.times[before])[:, None]
        share = (at - self.times[before])[:, None] / span
        start = self.values[before]
        step = self.values[before + 1] - start
        return share, span, start, step, self.slopes[before], self.slopes[before + 1]
