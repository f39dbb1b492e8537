"""What turns a craft besides its inertia: coils, residual dipole, gravity gradient, air, sunlight.

Everything in body axes but the gravity gradient, which needs the position alone (`rotation.Loads`).
"""

from __future__ import annotations

import math

from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from sim_hal.worlds.free_body import pressure
from sim_hal.worlds.free_body.craft import TrueCraft
from sim_hal.worlds.free_body.environment import air_flow
from sim_hal.worlds.free_body.rotation import Floats, Matrix, turned
from sim_hal.worlds.free_body.section import Disturbances
from sim_hal.worlds.surroundings import Surroundings


class LoadModel:
    """The loads of one craft with its disturbances in multiples of the worst case."""

    def __init__(self, craft: TrueCraft, multiples: Disturbances) -> None:
        self._faces = craft.faces
        self._drag, self._sunlight = multiples.drag, multiples.solar_pressure
        self._gradient = math.sqrt(3.0 * multiples.gravity_gradient * GRAVITATIONAL_PARAMETER)
        # Row by row, as a rotation matrix is kept, although it is none.
        a, b, c, d, e, f, g, h, i = craft.coil_dipole.ravel().tolist()
        self._coils: Matrix = (a, b, c, d, e, f, g, h, i)
        x, y, z = craft.constant_dipole.tolist()
        self._constant: Floats = (x, y, z)
        x, y, z = craft.sunlit_dipole.tolist()
        self._sunlit: Floats = (x, y, z)
        self._walking = craft.walking_dipole

    def coil_dipole(self, currents: Floats) -> Floats:
        """Return the coils' dipole (3,) A m^2 at currents (3,) A."""
        return turned(self._coils, currents)

    def residual_dipole(self, around: Surroundings) -> Floats:
        """Return the residual dipole (3,) A m^2."""
        light, walking = around.light, self._walking
        (a, b, c), (d, e, f), (x, y, z) = self._constant, self._sunlit, around.walk
        return a + light * d + walking * x, b + light * e + walking * y, c + light * f + walking * z

    def pull(self, position: Floats) -> Floats:
        """Return what `rotation.Loads.pull` asks for, rad/s, at a position (3,) m."""
        x, y, z = position
        squared = x * x + y * y + z * z
        scale = self._gradient / (squared * math.sqrt(math.sqrt(squared)))
        return scale * x, scale * y, scale * z

    def pressures(self, around: Surroundings, to_body: Matrix) -> tuple[Floats, Floats]:
        """Return the torques (3,) N m of air and sunlight; `to_body` turns ICRS into body axes."""
        flow = turned(to_body, air_flow(around))
        drag = pressure.drag(self._faces, flow, self._drag * around.density)
        light = self._sunlight * around.light
        return drag, pressure.sunlight(self._faces, turned(to_body, around.sun), light)
