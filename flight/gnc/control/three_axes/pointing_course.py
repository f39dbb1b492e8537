"""The course of pointing: the best motion over the whole revolution ahead, by multiple shooting.

A motion is improved by linear-quadratic steps about itself. Unlike the sweeps of `pointing_path` it need not
be one that the body can fly meanwhile: where the equations of motion carry each instant's state is compared
with the next instant, and what lacks is taken up by the next step (Bock & Plitt 1984, IFAC 9th World
Congress). So errors do not grow along a revolution, in which a body that coils can not hold about the field
turns far about its pointing axis. Takes 0.2 ms an instant and step.
"""

from __future__ import annotations

import math

import numpy as np

from flight.gnc.control.three_axes.pointing_path import Expected, Gains, Motion, bends, off
from flight.gnc.control.three_axes.pointing_sweep import Cost, ToGo, linearised, sweep
from flight.gnc.earth.disturbance import shapes
from flight.gnc.guidance.three_axes.attitude_law import References
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)

STEPS = 20
"""Largest number of steps."""
FARTHEST = math.radians(30.0)
"""rad that a step may turn the motion at any instant; a larger one is scaled as a whole."""
SLOW, SHARE, LEAST = 0.7, 0.7, 0.3
"""Whole steps may overshoot: after a step that turned the motion by more than SLOW of the one before, SHARE
as much of a step is taken, LEAST at least, and more again after others."""
DONE = math.radians(0.05)
"""rad: a step that turns the motion by less is the last."""
ENOUGH = math.radians(1.5)
"""rad: the last of `STEPS` may turn the motion by as much, some time within the revolution."""


def best_course(
    expected: Expected, begun: References, state: FloatArray, dipole: float, fastest: float
) -> tuple[Motion, Gains] | None:
    """Return the best motion from the begin of `begun` over all that is expected, and the gains about it.

    `begun` (n + 1,) leads into the law and is what will be flown; `state` (6, 6) and `dipole` are what a step
    costs (`pointing_table.prices`). None where no motion is found within `STEPS`, where it needs more dipole
    than there is, or turns faster than `fastest` rad/s meanwhile.
    """
    count, first = len(expected.field) - 1, len(begun.times)
    quaternion = np.concatenate([begun.quaternion, expected.wanted.quaternion[first:]])
    rate = np.concatenate([begun.rate, expected.wanted.rate[first:]])
    motion = Motion(quaternion, rate, np.zeros((count, 3)))
    share, last = 1.0, math.inf
    for _ in range(STEPS):
        motion, gains, turned = _step(expected, motion, state, dipole, share)
        change, farthest = float(turned[:first].max()), float(turned.max())
        if not farthest < math.inf:
            return None
        if change < DONE and farthest < ENOUGH:
            break
        share = max(SHARE * share, LEAST) if farthest > SLOW * last else min(share / SHARE, 1.0)
        last = farthest
    strongest = float(np.abs(motion.control).max())
    speed = float(np.linalg.norm(motion.rate[:first], axis=1).max())
    found = change < ENOUGH and strongest <= expected.limit and speed <= fastest
    return (motion, gains) if found else None


def _step(
    expected: Expected, motion: Motion, state: FloatArray, dipole: float, share: float
) -> tuple[Motion, Gains, FloatArray]:
    """Return the motion after a step, the gains about it before, and how far it turned at most, rad."""
    count, wanted, sizes = len(motion.control), expected.wanted, expected.sizes
    motion_until = motion.references(wanted.times).until(count)
    shown = attitude_matrix(motion.quaternion[:count])
    linear = linearised(
        motion_until,
        expected.inertia,
        expected.field[:count],
        expected.position[:count],
        motion.control,
        expected.pressed(count),
    )
    affine = np.zeros((count, 6, 1 + len(sizes)))
    affine[:, :, 0] = _missed(expected, motion)
    affine[:, :, 1:] = linear.by_torque @ shapes(expected.pressures.until(count), shown)
    turned, astray = bends(wanted, motion), off(wanted, motion)
    back = np.swapaxes(turned, 1, 2)
    states, slopes = back @ state @ turned, np.einsum("nij,nj->ni", back @ state, astray)
    state_slope, control_slope = np.zeros(affine.shape), np.zeros((count, 3, affine.shape[2]))
    state_slope[:, :, 0], control_slope[:, :, 0] = slopes[:-1], dipole * motion.control
    end = np.zeros((6, affine.shape[2]))
    end[:, 0] = slopes[-1]
    cost = Cost(states[:-1], np.full((count, 3), dipole), state_slope, control_slope)
    gain, steady, _ = sweep(linear, affine, cost, ToGo(states[-1], end))
    change, control = np.zeros((count + 1, 6)), np.empty((count, 3))
    for k in range(count):
        control[k] = -(gain[k] @ change[k] + steady[k, :, 0])
        change[k + 1] = linear.transition[k] @ change[k] + linear.by_control[k] @ control[k] + affine[k, :, 0]
    turns = np.linalg.norm(change[:, :3], axis=1)
    share *= min(1.0, FARTHEST / max(float(turns.max()), DONE))
    moved = Motion(
        multiply(from_rotation_vector(share * change[:, :3]), motion.quaternion),
        motion.rate + share * change[:, 3:],
        motion.control + share * control,
    )
    return moved, Gains(gain, steady), turns


def _missed(expected: Expected, motion: Motion) -> FloatArray:
    """Return by how much (n, 6) each instant's state is carried past the next instant's."""
    step, count = expected.step, len(motion.control)
    q, w = motion.quaternion[:count], motion.rate[:count]
    middle = w + 0.5 * step * expected.accelerations(q, w, motion.control)
    half = multiply(from_rotation_vector(0.5 * step * w), q)
    there = multiply(from_rotation_vector(step * middle), q)
    speed = w + step * expected.accelerations(half, middle, motion.control)
    turn = to_rotation_vector(multiply(there, conjugate(motion.quaternion[1:])))
    return np.concatenate([turn, speed - motion.rate[1:]], axis=1)
