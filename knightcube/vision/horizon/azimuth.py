"""The turn about nadir from other sensors: a rough attitude, the coarse Sun, the magnetic field.

A horizon does not determine it, but the flattening depends on the pole and the light on the Sun. Each such
direction also has a known angle from nadir: a nadir that contradicts the angle is wrong.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.horizon.knowledge import HorizonKnowledge
from knightcube.vision.horizon.limb_equation import turn
from knightcube.vision.horizon.vector_method import shortest_turn

MOST_MISMATCH = 4.0
"""Standard deviations by which a coarse sensor may disagree."""
GUESS_SIGMA = math.radians(0.2)
"""rad, of a nadir by the cone through the edges, before a limb is fitted: a Sun to 0.005 deg is no such
measure of it (0.07 to 0.3 deg off in frames of flights)."""


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """A camera's orientation about an assumed nadir.

    Attributes:
        rotation: (3, 3), inertial into camera axes; nadir exactly as assumed.
        sigma: rad, of the turn about nadir; infinite if unknown.
        mismatch: the worst disagreement of a known direction with this nadir, in standard deviations of the
            direction and of a guessed nadir.
        share: of all nadirs, those that the known directions leave.
    """

    rotation: FloatArray
    sigma: float
    mismatch: float
    share: float = 1.0


def orientation(nadir: FloatArray, inertial_nadir: FloatArray, knowledge: HorizonKnowledge) -> Orientation:
    """Return the orientation about `nadir` (3,), camera axes, which is `inertial_nadir` (3,)."""
    base = shortest_turn(inertial_nadir, nadir)
    down = _unit(nadir)
    vote, weight, mismatch = 0.0 + 0.0j, 0.0, 0.0
    known = _known(knowledge, inertial_nadir)
    # Each leaves a ring of the sphere; two rings cross, a third adds little.
    narrowest = sorted(math.hypot(sigma, GUESS_SIGMA) for _, _, sigma in known)[:2]
    share = math.prod(min(1.0, MOST_MISMATCH * sigma) for sigma in narrowest)
    for camera, inertial, sigma in known:
        seen, expected = _unit(camera), _unit(base @ inertial)
        below, assumed = _dot(down, seen), _dot(down, expected)
        across = _length(_cross(down, expected))
        apart = math.atan2(_length(_cross(down, seen)), below) - math.atan2(across, assumed)
        mismatch = max(mismatch, abs(apart) / math.hypot(sigma, GUESS_SIGMA))
        if across > 0.05:
            angle = math.atan2(_dot(down, _cross(expected, seen)), _dot(seen, expected) - below * assumed)
            precision = (across / sigma) ** 2
            vote += precision * cmath.exp(1j * angle)
            weight += precision
    if weight == 0.0:
        return Orientation(base, math.inf, mismatch, share)
    return Orientation(turn(cmath.phase(vote) * nadir) @ base, weight**-0.5, mismatch, share)


def turned(rotation: FloatArray, nadir: FloatArray, angle: float) -> FloatArray:
    """Return a camera's rotation (3, 3) after a turn by `angle` rad about `nadir` (3,), camera axes."""
    return np.asarray(turn(angle * nadir) @ rotation)


def _known(
    knowledge: HorizonKnowledge, inertial_nadir: FloatArray
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return pairs of directions, camera and inertial, with their spreads: an attitude is two of them."""
    pairs = [(each.camera, each.inertial, each.sigma) for each in knowledge.sensed]
    if knowledge.attitude is not None:
        matrix, sigma = attitude_matrix(knowledge.attitude.quaternion), knowledge.attitude.sigma
        # Nadir itself tests the tilt, a direction normal to it gives the turn.
        for axis in (inertial_nadir, tangent_basis(inertial_nadir)[0]):
            pairs.append((matrix @ axis, axis, sigma))
    return pairs


# Plain floats: for one vector numpy costs ten times as much.
Vector = tuple[float, float, float]


def _unit(vector: FloatArray) -> Vector:
    x, y, z = vector.tolist()
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Vector, other: Vector) -> Vector:
    (a, b, c), (x, y, z) = one, other
    return b * z - c * y, c * x - a * z, a * y - b * x


def _length(vector: Vector) -> float:
    return math.sqrt(_dot(vector, vector))
