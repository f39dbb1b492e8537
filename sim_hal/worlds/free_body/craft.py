"""The true craft: mass properties, faces, coils and residual dipole, with the errors that a seed draws.

The flight software assumes nominal values; the true values differ from them as a built satellite differs from
its drawing. Quantities are in principal axes or in body axes, as their names state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import CraftSection, Disturbances

CRAFTS = {
    # Sease 2013 Table 5.1 with its exponent corrected; 80 turns of 0.0081 m^2.
    "knightcube": CraftSection(
        inertia=(1.10e-3, 1.05e-3, 0.99e-3), size=(0.1, 0.1, 0.1), dipole_per_ampere=0.648
    ),
    # Assumed: 4 kg; 0.2 A m^2 at 58.8 mA, 5 W/(A m^2)^2 with coils of 57.8 ohm.
    "cubesat_3u": CraftSection(inertia=(0.0066, 0.0333, 0.0333), size=(0.3, 0.1, 0.1), dipole_per_ampere=3.4),
}

PRESSURE_ARM = 0.02
"""m from the centre of mass to the centre of pressure: the most that the CubeSat standard allows."""
CONSTANT_DIPOLE, SUNLIT_DIPOLE, WALKING_DIPOLE = 1e-3, 3e-4, 5e-5
"""A m^2: the worst case of each part of the residual dipole; of the walk its standard deviation."""
_REFLECTED = (0.1, 0.6)
"""Bounds of the share of sunlight that a face reflects like a mirror."""


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A flat face: outward `normal` and the arm from the centre of mass to its middle (m), body axes.

    `area` in m^2; `mirrored` is the share of sunlight that it reflects like a mirror; the rest is absorbed.
    """

    normal: tuple[float, float, float]
    arm: tuple[float, float, float]
    area: float
    mirrored: float


@dataclass(frozen=True, slots=True, eq=False)
class TrueCraft:
    """A craft as it was built.

    Attributes:
        inertia: (3,) kg m^2, of the principal axes.
        to_principal: (4,) body axes into principal axes.
        faces: of the box.
        coil_dipole: (3, 3) m^2, currents to dipole in body axes.
        constant_dipole: (3,) A m^2, body axes.
        sunlit_dipole: (3,) A m^2, body axes, at one astronomical unit.
        walking_dipole: A m^2, standard deviation of each axis.
    """

    inertia: tuple[float, float, float]
    to_principal: FloatArray
    faces: tuple[Face, ...]
    coil_dipole: FloatArray
    constant_dipole: FloatArray
    sunlit_dipole: FloatArray
    walking_dipole: float


def build(section: CraftSection, disturbances: Disturbances, generator: np.random.Generator) -> TrueCraft:
    """Return a craft as one seed builds it.

    The number of draws does not depend on the multiples, so a seed's directions are the same at 0.1 and 1.
    """
    widest = math.radians(disturbances.principal_turn_deg)
    turn = generator.uniform(widest / 3.0, widest) * _direction(generator)
    arm = PRESSURE_ARM * _direction(generator)
    mirrored = generator.uniform(*_REFLECTED, 6)
    scale = 1.0 + disturbances.coil_scale * generator.standard_normal(3)
    tilt = math.radians(disturbances.coil_tilt_deg) * generator.standard_normal((3, 3))
    np.fill_diagonal(tilt, 1.0)
    constant, sunlit = _direction(generator), _direction(generator)
    worst = disturbances.residual_dipole
    return TrueCraft(
        inertia=section.inertia,
        to_principal=quaternion.from_rotation_vector(turn),
        faces=box(section.size, arm, mirrored),
        # A column is a coil's axis; scaled after its tilt.
        coil_dipole=section.dipole_per_ampere * scale * tilt / np.linalg.norm(tilt, axis=0),
        constant_dipole=worst * CONSTANT_DIPOLE * constant,
        sunlit_dipole=worst * SUNLIT_DIPOLE * sunlit,
        walking_dipole=worst * WALKING_DIPOLE,
    )


def box(size: tuple[float, float, float], arm: FloatArray, mirrored: FloatArray) -> tuple[Face, ...]:
    """Return the six faces of a box of `size` m whose middle stands `arm` (3,) m from the centre of mass."""
    faces = []
    for index in range(6):
        axis, sign = index // 2, 1.0 - 2.0 * (index % 2)
        normal = np.zeros(3)
        normal[axis] = sign
        nx, ny, nz = normal.tolist()
        ax, ay, az = (arm + 0.5 * size[axis] * normal).tolist()
        area = size[0] * size[1] * size[2] / size[axis]
        faces.append(Face((nx, ny, nz), (ax, ay, az), area, float(mirrored[index])))
    return tuple(faces)


def _direction(generator: np.random.Generator) -> FloatArray:
    """Return a direction (3,), all equally likely."""
    vector = generator.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))
