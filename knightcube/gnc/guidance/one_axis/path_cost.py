"""The power that a path is to save: the coil's heat, or what the coil takes from the supply.

A coil on a chopped supply carries full current for a part of each PWM period: its L/R of 0.1 ms is short
against the 20 ms of the period. The mean current I then takes V |I| from the supply, V = R Imax, while R I^2,
the thesis's cost (Sease 5.1), is the heat of a steady current I.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant

_ROUNDED = 0.1
"""Of Imax: while minimised, |I| is sqrt(I^2 + e^2) - e, whose slope is continuous."""


class PathCost(StrEnum):
    """The power whose integral is least along a path."""

    HEAT = "heat"
    SUPPLY = "supply"

    def power(self, plant: SingleAxisPlant, current: FloatArray) -> FloatArray:
        """Return the power in W for mean currents (m,) in A."""
        if self is PathCost.HEAT:
            return np.asarray(plant.resistance * current * current)
        return np.asarray(plant.resistance * plant.current_limit * np.abs(current))

    def smooth(self, plant: SingleAxisPlant, current: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the power as it is minimised, W, and its derivative, W/A, for mean currents (m,) in A."""
        if self is PathCost.HEAT:
            pull = plant.resistance * current
            return pull * current, 2.0 * pull
        voltage, rounding = plant.resistance * plant.current_limit, _ROUNDED * plant.current_limit
        size = np.sqrt(current * current + rounding * rounding)
        return voltage * (size - rounding), voltage * current / size
