"""Initial guesses of a slew: a prey path that turns about the field by circling, not by torque.

No torque acts along the field. A turn about it comes from geometry instead: an axis that circles once, of
radius a, turns the body by about the circle's area, pi a^2, about its centre. So the guess is the
eigen-axis turn in fifth-order time with such a circle before it in the body, large enough for the turn's part
along the field; both ways round, and with the circle begun in several directions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flight.gnc.guidance.three_axes.slew_ends import Boresight, End
from flight.gnc.guidance.three_axes.slew_model import Around, Motion, SlewCraft, cross
from flight.gnc.guidance.three_axes.slew_transcription import Trajectory
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import tangent_basis
from flight.gnc.math.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)

_PHASES = np.arange(8) * 0.25 * np.pi
_ROLLS = np.arange(-2, 4) * np.pi / 3.0


def turns(q: FloatArray, end: End) -> list[FloatArray]:
    """Return rotation vectors (3,) rad from an attitude (4,) to an end: both ways, or with several rolls."""
    if isinstance(end, Boresight):
        axis = end.axis
        wanted = attitude_matrix(q) @ end.direction
        # The body turns so that its axis comes to lie where the direction now is.
        normal = np.cross(axis, wanted)
        sine = float(np.linalg.norm(normal))
        angle = float(np.arctan2(sine, axis @ wanted))
        pointed = from_rotation_vector(angle * (normal / sine if sine > 1e-6 else tangent_basis(axis)[0]))
        return [to_rotation_vector(multiply(from_rotation_vector(roll * axis), pointed)) for roll in _ROLLS]
    short = to_rotation_vector(multiply(end.quaternion, conjugate(q)))
    size = float(np.linalg.norm(short))
    if size < 1e-3:
        return [short]
    return [short, short * (1.0 - 2.0 * np.pi / size)]


def guesses(
    motion: Motion, craft: SlewCraft, start: FloatArray, end: End, around: Around
) -> Iterator[list[Trajectory]]:
    """Yield guesses of each way round from a state (7,) to the end, where `around` (2 k + 1) acts."""
    for turn in turns(start[:4], end):
        middle = multiply(from_rotation_vector(0.5 * turn), start[:4])
        field = normalise(attitude_matrix(middle) @ around.field[len(around.field) // 2])
        ways = [_circling(start, turn, field, float(phase), len(around.field)) for phase in _PHASES]
        yield [Trajectory(states, _dipoles(motion, craft, states)[::2]) for states in ways]


def _circling(start: FloatArray, turn: FloatArray, field: FloatArray, phase: float, count: int) -> FloatArray:
    """Return states (count, 7) of the turn, with the circle about `field` (3,) that its part there needs."""
    s = np.linspace(0.0, 1.0, count)[:, None]
    share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    about = float(turn @ field)
    first, second = np.array([[np.cos(phase), np.sin(phase)], [-np.sin(phase), np.cos(phase)]]) @ _across(
        field
    )
    radius, angle = np.sqrt(abs(about) / np.pi), 2.0 * np.pi * share
    circle = radius * ((1.0 - np.cos(angle)) * first + np.sign(about) * np.sin(angle) * second)
    drift = s * (1.0 - s) ** 3 * (1.0 + 3.0 * s) * start[4:]
    q = multiply(
        from_rotation_vector(circle + drift), multiply(from_rotation_vector(share * turn), start[:4])
    )
    rate = np.empty((count, 3))
    rate[1:-1] = 0.5 * (count - 1) * to_rotation_vector(multiply(q[2:], conjugate(q[:-2])))
    rate[0], rate[-1] = start[4:], 0.0
    return np.concatenate([q, rate], axis=1)


def _across(field: FloatArray) -> FloatArray:
    """Return two directions (2, 3) that make a right-handed frame with the field last."""
    return tangent_basis(field)


def _dipoles(motion: Motion, craft: SlewCraft, states: FloatArray) -> FloatArray:
    """Return the least dipoles (n, 3) for the part of the states' torque that lies across the field."""
    still = motion.flow(states, np.zeros((len(states), 3)))
    wanted = np.gradient(states[:, 4:], 1.0 / (len(states) - 1), axis=0) - still[:, 4:]
    field = motion.field(states[:, :4])
    return np.asarray(cross(field, wanted @ craft.inertia) / np.sum(field * field, axis=1, keepdims=True))
