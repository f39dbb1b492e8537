"""From counts back to light: the logarithmic camera's curve undone, so that the limb has its true shape.

A logarithmic detector draws the thin air high above the limb out to a long ramp; where the brightness falls
to half, which is at a height that physics gives, is told in light, not in its logarithm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.math.arrays import FloatArray, Image


@dataclass(frozen=True, slots=True)
class LogarithmicResponse:
    """counts = pedestal + counts_per_decade log10(1 + light), light in units of the dark current's worth."""

    pedestal: float
    counts_per_decade: float

    def light(self, counts: Image) -> FloatArray:
        """Return the light of `counts` (...)."""
        return np.asarray(10.0 ** ((counts - self.pedestal) / self.counts_per_decade) - 1.0)


def light_of(counts: Image, response: LogarithmicResponse | None) -> FloatArray:
    """Return the light of counts (...), of any scale; without a response they are proportional to it."""
    if response is None:
        return np.asarray(counts, dtype=float)
    if counts.dtype == np.uint8:
        return np.asarray(response.light(np.arange(256.0))[counts])
    return response.light(counts)
