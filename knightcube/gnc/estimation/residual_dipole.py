"""A body's residual dipole, from what the gyro sees beside the coils' torque in a measured field.

A Luenberger observer: the rate that coils and residual dipole would give is drawn to the measured one, and
the rest is taken for a dipole across the field. What lies along the field shows once the field has turned in
body axes. Gravity's and the air's torques across the field are taken for a dipole, too: whoever cancels the
dipole cancels them.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_product

DRAWN, LEARNED = 0.1, 8e-4
"""1/s and 1/s^2: time constants of ten seconds and two minutes."""
LONGEST = 1.0
"""s between readings, from which on the rate is taken as measured."""


class ResidualDipole:
    """The observer; `dipole` (3,) A m^2 in body axes, `bound` A m^2 of an axis."""

    def __init__(self, inertia: FloatArray, bound: float) -> None:
        """Take the moments (3,) kg m^2 about the body axes."""
        self._inertia, self._bound = inertia, bound
        self._rate: FloatArray | None = None
        self.dipole: FloatArray = np.zeros(3)

    def restart(self) -> None:
        """Keep the dipole, and begin with the next rate."""
        self._rate = None

    def follow(self, seconds: float, rate: FloatArray, field: FloatArray, coils: FloatArray) -> None:
        """Take a rate (3,) rad/s, `seconds` after the last.

        Meanwhile the dipole `coils` (3,) A m^2 acted in the field (3,) T.
        """
        square = float(field @ field)
        if self._rate is None or seconds > LONGEST or square == 0.0:
            self._rate = rate
            return
        missed = rate - self._rate
        shown = cross_product(field, self._inertia * missed) / square
        self.dipole = np.clip(self.dipole + (LEARNED * seconds) * shown, -self._bound, self._bound)
        torque = cross_product(coils + self.dipole, field) - cross_product(rate, self._inertia * rate)
        self._rate = self._rate + min(1.0, DRAWN * seconds) * missed + seconds * torque / self._inertia
