"""Excitations that several tests of the identification share."""

from __future__ import annotations

from tests.ground.identification.worlds import World

USUAL = World(inertia=1.05e-3, dipole=0.648, field=4.5e-4, stiffness=1.0e-5, damping=2.0e-6)
