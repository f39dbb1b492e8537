"""How an error of the camera's description shows in the streaks, and what of it the stars themselves correct.

A lens or a shutter that is not as described moves the ends of every streak. To the fit, which knows nothing
of it, that looks like another turn, another one for each star. Where the stars then disagree they say how the
camera differs; what they cannot say widens the covariance by what is not known of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from flight.gnc.math.arrays import FloatArray
from flight.gnc.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from flight.gnc.vision.streaks.maximum_likelihood.motion import paths, positions, sensitivities
from flight.gnc.vision.streaks.maximum_likelihood.scene import Scene

_ENDS = (-0.5, 0.5)
# Probability of a camera that is as described being taken for another.
_BY_CHANCE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What the errors of the camera's description change.

    Attributes:
        step: (k,) of the shared parameters, to where they are without these errors; 0 where chance explains
            what the stars say of them.
        added: (k, k), covariance beside that of an exact camera.
        score: (n, k) of each star after these errors.
    """

    step: FloatArray
    added: FloatArray
    score: FloatArray


def correct(
    information: FloatArray, score: FloatArray, seeming: FloatArray, spread: float
) -> Correction | None:
    """Return the joint solution of the shared parameters and of the camera's errors; None without one.

    `information` (n, k, k) and `score` (n, k) are each star's, its own numbers eliminated; `seeming`
    (n, k, m) the change of the parameters that m errors, each of one standard deviation, seem to be;
    `spread` the variance of what is left over, in that of the noise.
    """
    m = seeming.shape[2]
    known = information / spread
    shared = known.sum(axis=0)
    weighted = known @ seeming
    cross = weighted.sum(axis=0)
    own = np.sum(seeming.swapaxes(1, 2) @ weighted, axis=0) + np.eye(m)
    asked = np.einsum("nkm,nk->m", seeming, score) / spread
    total = score.sum(axis=0) / spread
    try:
        leading = np.linalg.solve(shared, cross)
        rest = np.linalg.inv(own - cross.T @ leading)
    except np.linalg.LinAlgError:
        return None
    asked -= leading.T @ total
    error = rest @ asked
    change = leading @ error
    left = score - np.einsum("nij,nj->ni", information, seeming @ error - change)
    added = leading @ rest @ leading.T
    if float(asked @ error) > chdtri(m, _BY_CHANCE):
        return Correction(-change, added, left)
    return Correction(np.zeros_like(change), added + np.outer(change, change), left)


def seeming_turns(camera: ExposedCamera, scene: Scene, exposure: float) -> FloatArray:
    """Return the turn (n, 3, m), rad, that one standard deviation of each error seems to be to each star.

    Errors that cannot be, being known exactly, are left out.
    """
    displaced = [_displacements(camera, scene, exposure, at) for at in (*_ENDS, 0.0)]
    n, m = len(scene.stars), displaced[0].shape[2]
    out = np.empty((n, 3, m))
    first, last = (
        sensitivities(camera.pinhole, scene.motion, scene.stars, np.full(n, at), growing=False)[:, :, :3]
        for at in _ENDS
    )
    opening = np.linalg.pinv(last - first)
    for k in range(m):
        middle = scene.stars + displaced[2][:, :, k]
        moved = []
        for at, shift in zip(_ENDS, displaced, strict=False):
            time = np.full(n, at)
            true = positions(camera.pinhole, scene.motion, scene.stars, time) + shift[:, :, k]
            moved.append(true - positions(camera.pinhole, scene.motion, middle, time))
        out[:, :, k] = np.einsum("nij,nj->ni", opening, moved[1] - moved[0])
    return out


def _displacements(camera: ExposedCamera, scene: Scene, exposure: float, at: float) -> FloatArray:
    """Return by how many px (n, 2, m) each error moves the stars at a time."""
    pinhole, known = camera.pinhole, camera.settings.knowledge
    there = paths(pinhole, scene.motion, scene.stars, np.full(len(scene.stars), at))
    away = there.position - np.array(pinhole.centre)
    corner = np.hypot(*pinhole.centre)
    cubic = away * (np.sum(away**2, axis=1, keepdims=True) / corner**2)
    late = there.velocity * (away[:, 1:] / exposure)
    nothing = np.zeros(len(away))
    moves = [
        (known.focal_length, away),
        (known.centre, np.stack([nothing + 1.0, nothing], axis=1)),
        (known.centre, np.stack([nothing, nothing + 1.0], axis=1)),
        (known.distortion, cubic),
        (known.line_time, late),
    ]
    chosen = [sigma * move for sigma, move in moves if sigma > 0.0]
    return np.stack(chosen, axis=-1) if chosen else np.empty((len(away), 2, 0))
