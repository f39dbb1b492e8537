"""The torques on a craft: coils, residual dipole, gravity gradient, air, sunlight.

Torques are in body axes, except for the gravity gradient, which needs the position alone (`rotation.Loads`).

Air: F = -1/2 rho C_D A (n . v) v on faces that meet the flow (Wertz 1978, 17.61, with C_D 2.2). Sunlight: F
= -P A cos(theta) ((1 - e) s + 2 e cos(theta) n) (Montenbruck & Gill 2000, 3.73). A face does not shade
another, which is exact for a box. The code uses plain floats, because for three components numpy takes ten
times as long.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from sim_hal.settings import Disturbances
from sim_hal.worlds.free_body.craft import Face, TrueCraft
from sim_hal.worlds.free_body.environment import air_flow
from sim_hal.worlds.free_body.rotation import Floats, Matrix, turned
from sim_hal.worlds.world import OrbitEnvironment

DRAG_COEFFICIENT = 2.2
SOLAR_PRESSURE = 4.56e-6
"""N/m^2 at one astronomical unit, on a black face."""

NO_TORQUE: Floats = (0.0, 0.0, 0.0)


def air_torque(faces: Sequence[Face], flow: Floats, density: float) -> Floats:
    """Return the torque (3,) N m, body axes; `flow` is the velocity through the air, m/s, body axes."""
    vx, vy, vz = flow
    half = 0.5 * DRAG_COEFFICIENT * density
    # All forces have the direction of the flow, so their arms add up before one cross product.
    x = y = z = 0.0
    for face in faces:
        nx, ny, nz = face.normal
        against = nx * vx + ny * vy + nz * vz
        if against > 0.0:
            weight = half * face.area * against
            ax, ay, az = face.arm
            x += weight * ax
            y += weight * ay
            z += weight * az
    return z * vy - y * vz, x * vz - z * vx, y * vx - x * vy


def sunlight_torque(faces: Sequence[Face], sun: Floats, light: float) -> Floats:
    """Return the torque (3,) N m, body axes; `sun` (3,) is its direction, `light` over that at 1 au."""
    if light <= 0.0:
        return NO_TORQUE
    sx, sy, sz = sun
    tx = ty = tz = 0.0
    for face in faces:
        nx, ny, nz = face.normal
        cosine = nx * sx + ny * sy + nz * sz
        if cosine > 0.0:
            scale = -SOLAR_PRESSURE * light * face.area * cosine
            along, normal = scale * (1.0 - face.mirrored), 2.0 * scale * face.mirrored * cosine
            fx, fy, fz = along * sx + normal * nx, along * sy + normal * ny, along * sz + normal * nz
            ax, ay, az = face.arm
            tx += ay * fz - az * fy
            ty += az * fx - ax * fz
            tz += ax * fy - ay * fx
    return tx, ty, tz


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

    def residual_dipole(self, around: OrbitEnvironment) -> Floats:
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

    def pressures(self, around: OrbitEnvironment, to_body: Matrix) -> tuple[Floats, Floats]:
        """Return the torques (3,) N m of air and sunlight; `to_body` turns ICRS into body axes."""
        flow = turned(to_body, air_flow(around))
        drag = air_torque(self._faces, flow, self._drag * around.density)
        light = self._sunlight * around.light
        return drag, sunlight_torque(self._faces, turned(to_body, around.sun), light)
