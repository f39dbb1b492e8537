"""Torque of air and sunlight on the faces of a craft.

Air: F = -1/2 rho C_D A (n . v) v on faces that meet the flow (Wertz 1978, 17.61, with C_D 2.2). Sunlight:
F = -P A cos(theta) ((1 - e) s + 2 e cos(theta) n) (Montenbruck & Gill 2000, 3.73). A face does not shade
another, which is exact for a box. Plain floats: for three components numpy costs ten times as much.
"""

from __future__ import annotations

from collections.abc import Sequence

from sim_hal.worlds.free_body.craft import Face

DRAG_COEFFICIENT = 2.2
SOLAR_PRESSURE = 4.56e-6
"""N/m^2 at one astronomical unit, on a black face."""

Floats = tuple[float, float, float]
NO_TORQUE: Floats = (0.0, 0.0, 0.0)


def drag(faces: Sequence[Face], flow: Floats, density: float) -> Floats:
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


def sunlight(faces: Sequence[Face], sun: Floats, light: float) -> Floats:
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
