"""The Sun's direction in body axes, carried on by a gyro, and the gyro's bias that its drift shows.

Between measurements the gyro turns the direction with the body. What the measurements then find off is the
bias, but for its part about the Sun, which moves the direction by nothing: so a Sun that is no longer seen is
carried on for an eclipse. A complementary filter (Mahony, Hamel & Pflimlin 2008, IEEE Trans. Autom. Control
53(5)) of one direction.
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_product

MEMORY = 2400.0
"""s for which a direction is carried on: the longest eclipse of a low orbit, and some minutes."""
SMOOTHED, DRIFT = 10.0, 6.5e-4
"""s over which directions are averaged; rad/s^2 of bias that a radian off shows."""
JUMP = 0.5
"""Sine of a turn from which on a direction replaces the one that was carried on, and shows no bias."""
LARGEST_BIAS = 3e-3
"""rad/s of an axis."""
SHORTLY = 0.5
"""s since the last turn, within which the carried direction is compared with the measured one."""
LONGEST_GAP = 3.0
"""s without a turn: the body may since have turned anywhere, as while nobody carries the direction."""
_SECOND = 1e-9


class CarriedSun:
    """Owns the direction and the bias."""

    def __init__(self) -> None:
        self._direction: FloatArray | None = None
        self._seen_ns = self._turned_ns = 0
        self.bias: FloatArray = np.zeros(3)
        """Of the gyro, (3,) rad/s."""

    @property
    def direction(self) -> FloatArray | None:
        """The Sun's direction (3,) in body axes at the last reading; None where it is not known."""
        return self._direction

    def turn(self, time_ns: int, turned: FloatArray) -> None:
        """Carry the direction on to `time_ns`; the body has `turned` (3, 3) since the last reading."""
        if self._direction is not None:
            gap = (time_ns - max(self._turned_ns, self._seen_ns)) * _SECOND
            known = gap <= LONGEST_GAP and (time_ns - self._seen_ns) * _SECOND <= MEMORY
            self._direction = turned @ self._direction if known else None
        self._turned_ns = time_ns

    def see(self, time_ns: int, sun: FloatArray) -> None:
        """Accept the direction (3,) of the Sun, body axes, of a time just past."""
        carried, since = self._direction, (time_ns - self._seen_ns) * _SECOND
        if (time_ns - self._turned_ns) * _SECOND > SHORTLY:
            carried = None
        self._seen_ns = time_ns
        off = np.zeros(3) if carried is None else cross_product(sun, carried)
        if carried is None or float(sun @ carried) <= 0.0 or float(off @ off) > JUMP**2:
            self._direction = sun
            return
        since = min(max(since, 0.0), SMOOTHED)
        mixed = carried + (since / SMOOTHED) * (sun - carried)
        self._direction = mixed / math.sqrt(float(mixed @ mixed))
        self.bias = np.clip(self.bias - (DRIFT * since) * off, -LARGEST_BIAS, LARGEST_BIAS)
