"""First guesses of a slew: curves of its momentum whose slope lies across the field.

Coils make no torque along the field. So the slope of the body's momentum among the stars lies across the
field all the way, and that is linear: momenta that end as wanted are a fixed curve and any sum of modes. The
attitude follows from the momentum. With a dozen numbers to find, a curve that ends in the target, keeps the
cones and takes little heat is found by least squares, from many random begins at once; the gradient of
gravity and other torques are left to the planner. Begins are always the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.gnc.guidance.three_axes.slew_cones import Kept
from knightcube.gnc.guidance.three_axes.slew_ends import Boresight, End
from knightcube.gnc.guidance.three_axes.slew_model import Around, Motion, SlewCraft, cross, shown
from knightcube.gnc.guidance.three_axes.slew_transcription import Trajectory

_BEGINS, _SPREAD = 24, 0.4
"""Random begins, and how large: of the torque of half a turn."""
_COSINES = 6
"""Of the torque in time, each along three axes."""
_ROUNDS = 12
_END, _CONE, _HEAT = 4.0, 2.0, 0.05
"""Weights: of a radian that the end misses, of a cone's cosine, and of the torque of half a turn."""
_ROOM = 0.03
"""Of a cone's cosine, that a guess keeps off."""
_DAMPED = 1.0
_LONGEST_STEP = 4.0
"""Torques of half a turn."""
_WEAK, _WEAK_END = 1e-3, 0.03
"""Modes of less heat, and directions of the momentum that are reached less, are left out."""
_MISSED, _CROSSED = 0.1, 0.02
"""rad off the target, and of a cone's cosine, from which a guess comes after those that miss by less."""
_SAME = 0.1
"""Curves that differ by less of their size are one."""


def guesses(
    motion: Motion, craft: SlewCraft, start: FloatArray, end: End, around: Around, kept: Kept, scale: float
) -> list[Trajectory]:
    """Return guesses from a state (7,) to the end over `scale` s, the promising ones first.

    `around` (2 k + 1) acts, the cones of `kept` are kept.
    """
    curves = _curves(craft, around, start, end, scale)
    fit = _Fit(curves, craft, start, end, kept, scale)
    found = []
    for states in fit.found():
        found.append(Trajectory(states, _dipoles(motion, craft, states)[::2]))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Curves:
    """Momenta at n times, kg m^2/s, ICRS: base (n, 3) and modes (d, n, 3), in torques of half a turn."""

    base: FloatArray
    modes: FloatArray


def _curves(craft: SlewCraft, around: Around, start: FloatArray, end: End, scale: float) -> _Curves:
    """Return the momenta from the start's to the end's, whose modes take heat independently."""
    count = len(around.field)
    step, strength = scale / (count - 1), np.linalg.norm(around.field, axis=1)
    field = around.field / strength[:, None]
    across = np.eye(3) - field[:, :, None] * field[:, None, :]
    in_time = np.cos(np.pi * np.outer(np.arange(_COSINES), np.linspace(0.0, 1.0, count)))
    slopes = np.einsum("nij,mn->mjni", across, in_time).reshape(3 * _COSINES, -1)
    strength = np.repeat(strength / strength.mean(), 3)
    heat, mixed = np.linalg.eigh((slopes / strength**2) @ slopes.T / count)
    used = heat > _WEAK * heat[-1]
    slopes = ((mixed[:, used] / np.sqrt(heat[used])).T @ slopes).reshape(-1, count, 3)
    curves = np.zeros_like(slopes)
    curves[:, 1:] = np.cumsum(0.5 * step * (slopes[:, 1:] + slopes[:, :-1]), axis=1)
    begun = _momentum(craft, start[:4], attitude_matrix(start[:4]).T @ start[4:] / scale)
    wanted = _momentum(craft, start[:4] if isinstance(end, Boresight) else end.quaternion, end.rate) - begun
    left, sizes, right = np.linalg.svd(curves[:, -1].T)
    reached = int((sizes > _WEAK_END * sizes[0]).sum())
    fixed = right[:reached].T @ ((left.T @ wanted)[:reached] / sizes[:reached])
    half_turn = 2.0 * np.pi * float(np.trace(craft.inertia)) / scale**2
    free = half_turn * np.tensordot(right[reached:], curves, 1)
    return _Curves(begun + np.tensordot(fixed, curves, 1), free)


def _momentum(craft: SlewCraft, q: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the momentum (3,) of an attitude (4,) at a rate (3,) rad/s, both vectors ICRS."""
    turned = attitude_matrix(q)
    return np.asarray(turned.T @ craft.inertia @ turned @ rate)


class _Fit:
    """Least squares, by Levenberg and Marquardt, of many sums of the modes at once."""

    def __init__(
        self, curves: _Curves, craft: SlewCraft, start: FloatArray, end: End, kept: Kept, scale: float
    ) -> None:
        self._curves, self._start, self._end, self._kept = curves, start, end, kept
        self._scale, self._lighter = scale, np.linalg.inv(craft.inertia)

    def found(self) -> list[FloatArray]:
        """Return states (n, 7) of the guesses, the promising ones first, each once."""
        sums = self._fitted()
        q, momentum = self._flown(sums)
        missed, crossed = self._missed(q), self._crossed(q)
        lost = np.linalg.norm(missed, axis=1) > _MISSED
        lost |= crossed.max(axis=1, initial=0.0) > _CROSSED + _ROOM
        taken: list[FloatArray] = []
        states = []
        for k in np.lexsort((np.sum(sums**2, axis=1), lost)):
            if all(np.linalg.norm(sums[k] - other) > _SAME * np.linalg.norm(other) for other in taken):
                taken.append(sums[k])
                rate = self._scale * shown(q[k], momentum[k]) @ self._lighter.T
                states.append(np.concatenate([q[k], rate], axis=1))
        return states

    def _fitted(self) -> FloatArray:
        """Return sums (m, d) that miss least."""
        count = len(self._curves.modes)
        sums = _SPREAD * np.random.default_rng(16).normal(size=(_BEGINS, count))
        left = self._left(sums)
        damped, small = np.full(_BEGINS, _DAMPED), 1e-4
        for _ in range(_ROUNDS):
            near = (sums[:, None] + small * np.eye(count)).reshape(-1, count)
            slopes = (self._left(near).reshape(_BEGINS, count, -1) - left[:, None]) / small
            squares = slopes @ slopes.transpose(0, 2, 1) + damped[:, None, None] * np.eye(count)
            steps = -np.linalg.solve(squares, slopes @ left[:, :, None])[:, :, 0]
            size = np.linalg.norm(steps, axis=1, keepdims=True)
            there = sums + steps * np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-9))
            then = self._left(there)
            better = np.sum(then**2, axis=1) < np.sum(left**2, axis=1)
            sums, left = np.where(better[:, None], there, sums), np.where(better[:, None], then, left)
            damped = np.where(better, 0.2 * damped, 5.0 * damped)
        return np.asarray(sums)

    def _left(self, sums: FloatArray) -> FloatArray:
        """Return what is to be least (m, n) of sums (m, d)."""
        q, _ = self._flown(sums)
        return np.concatenate([_END * self._missed(q), _CONE * self._crossed(q), _HEAT * sums], axis=1)

    def _missed(self, q: FloatArray) -> FloatArray:
        """Return by what (m, 3) rad paths (m, n, 4) miss the end, of a boresight its sine."""
        end, last = self._end, q[:, -1]
        if isinstance(end, Boresight):
            return shown(last, np.broadcast_to(end.direction, (len(q), 3))) - end.axis
        return to_rotation_vector(multiply(np.broadcast_to(end.quaternion, last.shape), conjugate(last)))

    def _crossed(self, q: FloatArray) -> FloatArray:
        """Return how deep (m, cones n) paths lie within the cones, of the cosine."""
        return np.maximum(0.0, _ROOM - self._kept.values(q[:, None, 1:])).reshape(len(q), -1)

    def _flown(self, sums: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the attitudes (m, n, 4) and momenta (m, n, 3) of sums (m, d), by the midpoint rule."""
        momentum = self._curves.base + np.tensordot(sums, self._curves.modes, 1)
        half = 0.5 * self._scale / (momentum.shape[1] - 1)
        middle = 0.5 * (momentum[:, 1:] + momentum[:, :-1])
        q = np.empty((*momentum.shape[:2], 4))
        q[:, 0] = self._start[:4]
        for k in range(middle.shape[1]):
            before = q[:, k]
            between = _unit(before + half * self._slope(before, momentum[:, k]))
            q[:, k + 1] = _unit(before + 2.0 * half * self._slope(between, middle[:, k]))
        return q, momentum

    def _slope(self, q: FloatArray, momentum: FloatArray) -> FloatArray:
        """Return q' (m, 4) at attitudes (m, 4) with momenta (m, 3)."""
        rate = 0.5 * shown(q, momentum) @ self._lighter.T
        v, s = q[:, :3], q[:, 3:]
        return np.concatenate([cross(v, rate) + s * rate, -np.sum(v * rate, axis=1, keepdims=True)], axis=1)


def _unit(q: FloatArray) -> FloatArray:
    return np.asarray(q / np.sqrt(np.sum(q * q, axis=1, keepdims=True)))


def _dipoles(motion: Motion, craft: SlewCraft, states: FloatArray) -> FloatArray:
    """Return the least dipoles (n, 3) for the part of the states' torque that lies across the field."""
    still = motion.flow(states, np.zeros((len(states), 3)))
    wanted = np.gradient(states[:, 4:], 1.0 / (len(states) - 1), axis=0) - still[:, 4:]
    field = motion.field(states[:, :4])
    return np.asarray(cross(field, wanted @ craft.inertia) / np.sum(field * field, axis=1, keepdims=True))
