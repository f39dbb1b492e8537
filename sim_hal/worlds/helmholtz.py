"""The field of the testbed's Helmholtz coil (Sease 2013, 5.34)."""

from __future__ import annotations

import math

VACUUM_PERMEABILITY = 4e-7 * math.pi
"""T m/A, as the thesis has it."""


def helmholtz_field(turns: float, current: float, radius: float) -> float:
    """Return the field in T in the middle of two coils of `turns` each; `current` in A, `radius` in m."""
    return math.pow(0.8, 1.5) * VACUUM_PERMEABILITY * turns * current / radius
