"""Steps and covariances: the normal equations solved.

The shared parameters (turn, growth, width) are solved for after each star's own four numbers are eliminated,
a small Schur complement a star. Stars that share pixels couple; conjugate gradients account for it in a few
rounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.motion import sensitivities
from knightcube.vision.streaks.maximum_likelihood.normal_equations import (
    ALONE,
    PRIOR,
    SHARED,
    Evaluation,
    apply_information,
)
from knightcube.vision.streaks.maximum_likelihood.scene import Scene

# Conjugate gradients stop at this part of the first step's squared norm: covariances are then as exact.
_CONVERGED = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """One step and the covariance.

    Attributes:
        shared: (SHARED,) step of the shared parameters; alone: (n, ALONE) of each star's own.
        eliminated: the equations that gave it, stars not sharing pixels.
    """

    shared: FloatArray
    alone: FloatArray
    eliminated: Eliminated

    @property
    def covariance(self) -> FloatArray:
        """The covariance (SHARED, SHARED) of the shared parameters."""
        kept = self.eliminated.kept
        out = np.zeros((SHARED, SHARED))
        out[kept[:, None], kept] = self.eliminated.inner
        return out

    @property
    def joint(self) -> FloatArray:
        """The covariance (n, SHARED + ALONE, SHARED + ALONE) of the shared parameters and each star's."""
        kept, gain, inner = self.eliminated.kept, self.eliminated.gain, self.eliminated.inner
        joint = np.zeros((len(gain), SHARED + ALONE, SHARED + ALONE))
        joint[:, :SHARED, :SHARED] = self.covariance
        crossed = -inner @ gain
        joint[:, kept, SHARED:] = crossed
        joint[:, SHARED:, kept] = crossed.swapaxes(1, 2)
        joint[:, SHARED:, SHARED:] = self.eliminated.own + gain.swapaxes(1, 2) @ inner @ gain
        return joint


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """The normal equations with every star's own numbers eliminated, stars not sharing pixels.

    Attributes:
        kept: (k,) which shared parameters are fitted.
        own: (n, ALONE, ALONE) inverse of each star's block; gain: (n, k, ALONE).
        inner: (k, k) covariance of the shared parameters.
    """

    kept: IntArray
    own: FloatArray
    gain: FloatArray
    inner: FloatArray

    def solve(self, shared: FloatArray, alone: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the solution for a right-hand side (SHARED,), (n, ALONE)."""
        step = self.inner @ (shared[self.kept] - np.einsum("nij,nj->i", self.gain, alone))
        out = np.zeros(SHARED)
        out[self.kept] = step
        return out, np.einsum("nij,nj->ni", self.own, alone) - step @ self.gain


def eliminate(evaluation: Evaluation, free: BoolArray) -> Eliminated | None:
    """Return the eliminated equations, None when the shared parameters are not determined.

    `free` (SHARED,): which shared parameters are fitted.
    """
    alone = evaluation.information[:, SHARED:, SHARED:].copy()
    diagonal = np.einsum("nii->ni", alone)
    diagonal += PRIOR
    # Light of a star outside has no information: a unit keeps the block regular, its gradient is zero.
    diagonal += np.where(diagonal > 0.0, 0.0, 1.0)
    own = _scaled_inverse(alone)
    kept = np.flatnonzero(free)
    cross = evaluation.information[:, kept, SHARED:]
    gain = cross @ own
    normal = (evaluation.information[:, kept[:, None], kept] - gain @ cross.swapaxes(1, 2)).sum(axis=0)
    scale = np.sqrt(np.diag(normal).clip(min=0.0))
    if not np.all(np.isfinite(normal)) or not np.all(scale > 0.0):
        return None
    scaled = normal / np.outer(scale, scale)
    least, most = np.linalg.eigvalsh(scaled)[[0, -1]]
    if most > 1e10 * least:
        return None
    return Eliminated(kept, own, gain, np.linalg.inv(scaled) / np.outer(scale, scale))


def solve(evaluation: Evaluation, scene: Scene, free: BoolArray, rounds: int) -> Solution | None:
    """Return the step to the maximum, None when the shared parameters are not determined.

    At most `rounds` conjugate gradients account for the pixels that stars share; 0 neglects them.
    """
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    alone = evaluation.gradient[:, SHARED:] - PRIOR * _from_prior(scene)
    shared = np.where(free, evaluation.gradient[:, :SHARED].sum(axis=0), 0.0)
    step = _conjugate(evaluation, eliminated, free, (shared, alone), rounds)
    return Solution(*step, eliminated)


def _from_prior(scene: Scene) -> FloatArray:
    """Return how far each star's numbers are from where the prior puts them: only the sky has a place."""
    return np.stack([np.zeros_like(scene.sky)] * 3 + [scene.sky], axis=-1)


def turn_covariance(evaluation: Evaluation, free: BoolArray, rounds: int) -> FloatArray | None:
    """Return the covariance (3, 3) of the turn, shared pixels accounted for; None without one."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    alone = np.zeros((len(evaluation.chi2), ALONE))
    out = np.empty((3, 3))
    for k in range(3):
        # Scaled to a unit of the solution, so that one tolerance serves all.
        unit = np.zeros(SHARED)
        unit[k] = 1.0 / np.sqrt(eliminated.inner[k].max())
        solved, _ = _conjugate(evaluation, eliminated, free, (unit, alone), rounds)
        out[k] = solved[:3] / unit[k]
    return 0.5 * (out + out.T)


def _conjugate(
    evaluation: Evaluation,
    eliminated: Eliminated,
    free: BoolArray,
    right: tuple[FloatArray, FloatArray],
    rounds: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the solution of the normal equations of all stars together for `right`.

    Conjugate gradients, preconditioned by the equations of stars that share no pixels: few rounds do.
    """
    x = eliminated.solve(*right)
    if rounds == 0:
        return x

    def product(v: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        shared, alone = apply_information(evaluation, *v)
        return np.where(free, shared, 0.0), alone

    def dot(a: tuple[FloatArray, FloatArray], b: tuple[FloatArray, FloatArray]) -> float:
        return float(a[0] @ b[0] + np.sum(a[1] * b[1]))

    image = product(x)
    residual = right[0] - image[0], right[1] - image[1]
    z = eliminated.solve(*residual)
    direction, size = z, dot(residual, z)
    first = abs(dot(right, x))
    for _ in range(rounds):
        if size <= _CONVERGED * first:
            break
        image = product(direction)
        length = size / dot(direction, image)
        x = x[0] + length * direction[0], x[1] + length * direction[1]
        residual = residual[0] - length * image[0], residual[1] - length * image[1]
        z = eliminated.solve(*residual)
        size, before = dot(residual, z), size
        direction = z[0] + size / before * direction[0], z[1] + size / before * direction[1]
    return x


def _scaled_inverse(matrices: FloatArray) -> FloatArray:
    scale = np.sqrt(np.einsum("nii->ni", matrices))
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = matrices / outer
    scaled[:, range(ALONE), range(ALONE)] += 1e-9
    return np.asarray(np.linalg.inv(scaled) / outer)


def moved(scene: Scene, solution: Solution, pinhole: Pinhole, longest: float) -> tuple[Scene, float]:
    """Return the scene after a step that moves no end of a streak by more than `longest` px.

    Also returned is by how many px the shared parameters' step would have moved an end, or the width.
    """
    n = len(scene.stars)
    growing = bool(solution.shared[3:6].any())
    change = sensitivities(
        pinhole, scene.motion, np.tile(scene.stars, (2, 1)), np.repeat([-0.5, 0.5], n), growing
    )
    along = change[:, :, :6] @ solution.shared[:6]
    ends = float(np.hypot(along[:, 0], along[:, 1]).max(initial=0.0))
    share = min(1.0, longest / max(ends, 1e-9), 0.3 * scene.width / max(abs(solution.shared[6]), 1e-9))
    step = solution.alone * share
    far = np.hypot(step[:, 0], step[:, 1])
    step[:, :2] *= np.minimum(1.0, longest / np.maximum(far, 1e-9))[:, None]
    shared = share * solution.shared
    turn, growth = scene.motion.turn + shared[:3], scene.motion.growth + shared[3:6]
    after = replace(
        scene,
        motion=replace(scene.motion, turn=turn, growth=growth),
        width=scene.width + float(shared[6]),
        stars=scene.stars + step[:, :2],
        light=np.maximum(scene.light + step[:, 2], 0.3 * scene.light),
        sky=scene.sky + step[:, 3],
    )
    return after, max(ends, abs(float(solution.shared[6])))
