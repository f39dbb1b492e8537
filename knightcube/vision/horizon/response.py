"""Converts counts to light: inverts a logarithmic camera's curve, so that the limb has its true shape.

A logarithmic detector stretches the thin air above the limb to a long ramp; physics gives the height at which
the light, not its logarithm, falls to half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image


@dataclass(frozen=True, slots=True)
class LogarithmicResponse:
    """counts = pedestal + counts_per_decade log10(1 + light), light in units of the dark current."""

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
