"""Capture: turns a body that is far from its reference near enough for the pointing law.

The gains of the pointing law hold for small turns. Far off, the coils make the part across the field of a
torque that is proportional to turn and rate: J (w^2 turn + 2 w rate), with w so slow that the field turns
meanwhile (Lovera & Astolfi 2004, Automatica 40(8): such a law settles for gains that are small enough).
"""

from __future__ import annotations

import numpy as np

from flight.gnc.math.arrays import FloatArray

BANDWIDTH = 4e-3
"""rad/s: twice the speed at which the field turns along a low orbit."""


def capture_dipole(turn: FloatArray, rate: FloatArray, inertia: FloatArray, field: FloatArray) -> FloatArray:
    """Return the dipole (3,) A m^2 against a turn (3,) rad and a rate (3,) rad/s off the reference.

    `inertia` (3, 3) kg m^2 and the `field` (3,) T in body axes.
    """
    torque = -inertia @ (BANDWIDTH**2 * turn + 2.0 * BANDWIDTH * rate)
    return np.asarray(np.cross(field, torque) / float(field @ field))
