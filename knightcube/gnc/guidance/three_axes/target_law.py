"""The attitude law of a pointing target.

The law turns the body axis that points to the goal, and the body axis `across` as near as may be to a second
direction: that of flight for what lies below, nadir for the flight itself, the celestial pole for the Sun. A
given roll turns the body about the pointing axis from there; a free roll is the one that the body has when
the law begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, normalise
from knightcube.gnc.guidance.three_axes import attitude_law
from knightcube.gnc.guidance.three_axes.attitude_law import AttitudeLaw, Attitudes, Direction
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget

POLE = attitude_law.inertial(np.array([0.0, 0.0, 1.0]))
"""The Sun never comes within 66 deg of the celestial pole."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyAxes:
    """The body axis (3,) that points, and the axis (3,) `across` to it that a given roll begins from."""

    pointing: FloatArray
    across: FloatArray


def law_of(
    target: PointingTarget, axes: BodyAxes, quaternion: FloatArray, ephemeris: Ephemeris, time: float
) -> Attitudes:
    """Return the law of a target; a free roll is that of the attitude (4,) at `time` s of the ephemeris."""
    if target.goal is Goal.INERTIAL:
        fixed = normalise(np.array(target.numbers))
        return lambda _, times: np.broadcast_to(fixed, (len(times), 4))
    first, second = directions_of(target)
    if target.roll is None:
        return attitude_law.free_roll(axes.pointing, first, quaternion, ephemeris, time).attitudes
    turned = attitude_matrix(from_rotation_vector(target.roll * axes.pointing)) @ axes.across
    return AttitudeLaw(axes.pointing, first, turned, second).attitudes


def directions_of(target: PointingTarget) -> tuple[Direction, Direction]:
    """Return a goal's direction, and the direction that a roll of zero is measured from. Not for INERTIAL."""
    if target.goal is Goal.GROUND:
        return attitude_law.ground(*target.numbers), attitude_law.velocity
    return {
        Goal.NADIR: (attitude_law.nadir, attitude_law.velocity),
        Goal.VELOCITY: (attitude_law.velocity, attitude_law.nadir),
        Goal.SUN: (attitude_law.sun, POLE),
    }[target.goal]
