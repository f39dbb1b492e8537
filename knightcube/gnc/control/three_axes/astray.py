"""A body that leaves its path is planned for again; far off it is held still until it is slow before.

The law is linear in small turns. Led back from far off, coils at their limits chase the path, which makes a
light body turn faster than before. Damping alone can not: its torque is what of -2 w J rate lies across the
field, which takes energy from the body in any attitude.
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_product

FAR = math.radians(15.0)
"""rad off the path, from which on a body is held still."""
LEAVING = math.radians(5.0)
"""rad off the path, from which on a body that flies it is planned for again: torques are not as expected."""
SLOW = math.radians(0.1)
"""rad/s, below which a body is slow; an orbit's own is 0.06 deg/s."""
PATIENCE = 180.0
"""s after which it is planned for though not slow: what lies along the field takes a quarter of an orbit."""
DAMPING = 0.01
"""rad/s, w."""


class Astray:
    """Decides between path and damping; `since` is when damping began, s, None while the path is flown.

    Attributes:
        ready: whether the body may be planned for.
        leaving: whether it should be, though the path is flown.
    """

    def __init__(self) -> None:
        self.since: float | None = None
        self.ready = self.leaving = False

    def see(self, off: float, speed: float, now: float) -> None:
        """Take the turn off the path, rad, and the rate, rad/s, at a time, s."""
        if self.since is None and off > FAR:
            self.since = now
        self.leaving = self.since is None and off > LEAVING
        self.ready = self.since is not None and (speed < SLOW or now - self.since > PATIENCE)

    def planned(self) -> None:
        """Fly a path again."""
        self.since, self.ready, self.leaving = None, False, False


def damping_dipole(inertia: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
    """Return the dipole (3,) A m^2 that takes a rate (3,) rad/s as the field (3,) T allows, body axes.

    `inertia` (3,) kg m^2 of the body axes.
    """
    return np.asarray(cross_product(field, -2.0 * DAMPING * inertia * rate) / float(field @ field))
