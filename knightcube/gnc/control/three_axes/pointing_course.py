"""The course of pointing: the best motion over the whole revolution ahead, by multiple shooting.

A motion is improved by linear-quadratic steps about itself, as far along each as betters a merit: its cost,
and a price for what it lacks (Nocedal & Wright 2006, Numerical Optimization, algorithm 18.3). Unlike the
sweeps of `pointing_path` it need not be one that the body can fly meanwhile: where the equations of motion
carry each instant's state is compared with the next instant, and what lacks is taken up by the next step
(Bock & Plitt 1984, IFAC 9th World Congress). So errors do not grow along a revolution, in which a body that
coils can not hold about the field turns far about its pointing axis. Takes 0.07 ms an instant and step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import shapes
from knightcube.astro.quaternion import (
    attitude_matrix,
    from_rotation_vector,
    multiply,
)
from knightcube.gnc.control.three_axes.pointing_path import Expected, Gains, Motion, bends, off
from knightcube.gnc.control.three_axes.pointing_step import derivative, missed
from knightcube.gnc.control.three_axes.pointing_sweep import Cost, Linear, ToGo, sweep
from knightcube.gnc.guidance.three_axes.attitude_law import References

STEPS = 40
"""Largest number of steps."""
FARTHEST = math.radians(30.0)
"""rad that a step may turn the motion at any instant; a larger one is scaled as a whole."""
HALVES = 6
"""How often a step is halved until the motion is better by it."""
DEARER = 1.2
"""What the equations not kept cost in the merit, by what they are worth to the cost."""
DONE = math.radians(0.05)
"""rad: a step that turns the motion by less is the last, and one that saves less than SAVED of the merit."""
SAVED = 1e-4
ENOUGH = 0.01
"""Of the cost: what a motion may lack of its equations, by its price. A cost of one is beneath notice."""


@dataclass(frozen=True, slots=True, eq=False)
class _Direction:
    """A whole step: the change (n + 1, 6) of turn and rate, that (n, 3) of the dipole, and how it was found.

    `turned` is how far it turns the motion at most, rad; `worth` (6,) is how much the cost changes at most
    with what lacks at an instant.
    """

    change: FloatArray
    control: FloatArray
    gains: Gains
    linear: Linear
    turned: float
    worth: FloatArray


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
    criterion = _Criterion(expected, state, dipole)
    for _ in range(STEPS):
        step = _direction(criterion, motion)
        if not step.turned < math.inf:
            return None
        criterion.dear = np.maximum(criterion.dear, DEARER * step.worth)
        before = sum(criterion.merit(motion))
        better = _better(criterion, motion, step, before)
        motion = motion if better is None else better
        cost, lack = criterion.merit(motion)
        kept = lack <= ENOUGH * (1.0 + cost)
        if better is None or (kept and (step.turned < DONE or before - cost - lack < SAVED * (1.0 + before))):
            break
    strongest = float(np.abs(motion.control).max())
    speed = float(np.linalg.norm(motion.rate[:first], axis=1).max())
    return (motion, step.gains) if kept and strongest <= expected.limit and speed <= fastest else None


@dataclass(eq=False)
class _Criterion:
    """What a motion costs: `state` (6, 6) and `dipole` a step, and `dear` (6,) for what it lacks."""

    expected: Expected
    state: FloatArray
    dipole: float
    dear: FloatArray = field(default_factory=lambda: np.zeros(6))

    def merit(self, motion: Motion) -> tuple[float, float]:
        """Return the cost of a motion, and the price of what it lacks of the equations of motion."""
        astray = off(self.expected.wanted, motion)
        squares = float(np.einsum("ni,ij,nj->", astray, self.state, astray))
        squares += self.dipole * float(np.sum(motion.control**2))
        return 0.5 * squares, float(self.dear @ np.abs(missed(self.expected, motion)).sum(axis=0))


def _direction(criterion: _Criterion, motion: Motion) -> _Direction:
    """Return the whole linear-quadratic step from a motion, and the gains about it."""
    expected, state, dipole = criterion.expected, criterion.state, criterion.dipole
    count, wanted, sizes = len(motion.control), expected.wanted, expected.sizes
    shown = attitude_matrix(motion.quaternion[:count])
    linear = derivative(expected, motion)
    affine = np.zeros((count, 6, 1 + len(sizes)))
    affine[:, :, 0] = missed(expected, motion)
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
    own = np.einsum("nij,nj->ni", states, change) + slopes
    worth, most = own[-1], np.abs(own[-1])
    for k in range(count - 1, 0, -1):
        worth = linear.transition[k].T @ worth + own[k]
        most = np.maximum(most, np.abs(worth))
    return _Direction(change, control, Gains(gain, steady), linear, float(turns.max()), most)


def _better(criterion: _Criterion, motion: Motion, step: _Direction, before: float) -> Motion | None:
    """Return the motion after as much of a step as betters the merit `before`; None where no part does."""
    share = min(1.0, FARTHEST / max(step.turned, DONE))
    for _ in range(HALVES):
        moved = _moved(motion, share * step.change, share * step.control)
        if sum(criterion.merit(moved)) < before:
            return moved
        closed = _closed(criterion.expected, moved, step)
        if sum(criterion.merit(closed)) < before:
            return closed
        share *= 0.5
    return None


def _closed(expected: Expected, moved: Motion, step: _Direction) -> Motion:
    """Return a motion that lacks less of its equations, which a step has bent: a second-order correction."""
    lack, gain = missed(expected, moved), step.gains.gain
    change, control = np.zeros((len(gain) + 1, 6)), np.empty((len(gain), 3))
    transition, push = step.linear.transition, step.linear.by_control
    for k in range(len(gain)):
        control[k] = -gain[k] @ change[k]
        change[k + 1] = transition[k] @ change[k] + push[k] @ control[k] + lack[k]
    return _moved(moved, change, control)


def _moved(motion: Motion, change: FloatArray, control: FloatArray) -> Motion:
    """Return a motion with changes (n + 1, 6) of turn and rate and (n, 3) of its dipole."""
    turned = multiply(from_rotation_vector(change[:, :3]), motion.quaternion)
    return Motion(turned, motion.rate + change[:, 3:], motion.control + control)
