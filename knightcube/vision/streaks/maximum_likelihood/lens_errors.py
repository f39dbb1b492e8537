"""How an error of the camera's description shows in the streaks, and what of it the stars themselves correct.

A lens or a shutter that is not as described moves the ends of every streak. To the fit, which knows nothing
of it, that looks like another turn, another one for each star. Where the stars then disagree they say how the
camera differs; what they cannot say widens the covariance by what is not known of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.bent_pinhole import BentPinhole
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from knightcube.vision.streaks.maximum_likelihood.motion import moving, positions
from knightcube.vision.streaks.maximum_likelihood.scene import Scene

# Instants at which a path is compared with where an error puts it: the ends and between.
_INSTANTS = np.linspace(-0.5, 0.5, 9)
_SLOWEST = 1e-3
# Turn and the star's own place among the sensitivities.
_TURN_AND_PLACE = np.array([0, 1, 2, 6, 7])
# Probability of a camera that is as described being taken for another.
_BY_CHANCE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What the errors of the camera's description change.

    Attributes:
        step: (k,) of the shared parameters, to where they are without these errors; 0 where chance explains
            what the stars say of them.
        added: (k, k), covariance beside that of an exact camera; described: that of the errors alone whose
            size the description gives.
        score: (n, k) of each star after these errors.
        error: (m,), the likeliest errors, in standard deviations.
    """

    step: FloatArray
    added: FloatArray
    described: FloatArray
    score: FloatArray
    error: FloatArray


def correct(
    information: FloatArray,
    score: FloatArray,
    seeming: FloatArray,
    spread: float,
    described: int,
    counted: FloatArray | None = None,
) -> Correction | None:
    """Return the joint solution of the shared parameters and of the camera's errors; None without one.

    `information` (n, k, k) and `score` (n, k) are each star's, its own numbers eliminated; `seeming`
    (n, k, m) the change of the parameters that m errors, each of one standard deviation, seem to be, those
    first whose size is `described`; `spread` the variance of what is left over, in that of the noise;
    `counted` (m,) what the fit knows of the errors already, beside which the correction is.
    """
    m = seeming.shape[2]
    known = information / spread
    shared = known.sum(axis=0)
    weighted = known @ seeming
    cross = weighted.sum(axis=0)
    own = np.sum(seeming.swapaxes(1, 2) @ weighted, axis=0) + np.eye(m)
    asked = np.einsum("nkm,nk->m", seeming, score) / spread
    if counted is not None:
        asked = asked - counted
    total = score.sum(axis=0) / spread
    try:
        leading = np.linalg.solve(shared, cross)
        left = own - cross.T @ leading
        error = np.linalg.solve(left, asked - leading.T @ total)
        added, stated = (
            _added(leading[:, :count], left[:count, :count], error[:count]) for count in (m, described)
        )
    except np.linalg.LinAlgError:
        return None
    change = leading @ error
    seen = counted is not None or float((asked - leading.T @ total) @ error) > chdtri(m, _BY_CHANCE)
    left_over = score - np.einsum("nij,nj->ni", information, seeming @ error - change)
    return Correction(seen * -change, added, stated, left_over, error)


def _added(leading: FloatArray, left: FloatArray, error: FloatArray) -> FloatArray:
    """Return the covariance (k, k) by errors of which the stars leave the information `left` (m, m).

    Streaks displaced by much of their width ask for too little: a correction is known to its own size.
    """
    change = leading @ error
    return np.asarray(leading @ np.linalg.inv(left) @ leading.T + np.outer(change, change))


def seeming_turns(camera: ExposedCamera, scene: Scene, exposure: float) -> FloatArray:
    """Return the turn (n, 3, m), rad, that one standard deviation of each error seems to be to each star.

    Errors that cannot be, being known exactly, are left out; that of the shutter is the last. A streak shows
    where its path lies all along and, by its ends, how far it goes: an error that only lengthens the path is
    no other curvature.
    """
    errors = _errors(camera)
    n = len(scene.stars)
    if not errors:
        return np.empty((n, 3, 0))
    time, stars = np.repeat(_INSTANTS, n), np.tile(scene.stars, (len(_INSTANTS), 1))
    sensitive, velocity = moving(camera.pinhole, scene.motion, stars, time, growing=False)
    place = positions(camera.pinhole, scene.motion, stars, time)
    shift = _displacements(camera.pinhole, errors, place, velocity / exposure)
    speed = np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), _SLOWEST)
    tangent = velocity / speed
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    ends = np.abs(time) == 0.5
    change, moved = (
        np.concatenate(
            [
                np.einsum("pi,pij->pj", normal, of).reshape(len(_INSTANTS), n, -1),
                np.einsum("pi,pij->pj", tangent[ends], of[ends]).reshape(2, n, -1),
            ]
        ).swapaxes(0, 1)
        for of in (sensitive[:, :, _TURN_AND_PLACE], shift)
    )
    return np.asarray((np.linalg.pinv(change) @ moved)[:, :3])


def _errors(camera: ExposedCamera) -> dict[str, float]:
    """Return one standard deviation of each error that can be; the shutter's is the last."""
    known = camera.settings.knowledge
    sizes = {
        "focal length": known.focal_length,
        "centre x": known.centre,
        "centre y": known.centre,
        "distortion": known.distortion,
        "line time": camera.settings.line_time_sigma,
    }
    return {error: sigma for error, sigma in sizes.items() if sigma > 0.0}


def _displacements(
    pinhole: Pinhole, errors: dict[str, float], place: FloatArray, velocity: FloatArray
) -> FloatArray:
    """Return by how many px (p, 2, m) each error moves stars at `place` (p, 2), px, with `velocity`, px/s."""
    away = place - np.array(pinhole.centre)
    corner = np.hypot(*pinhole.centre)
    moves = {
        "focal length": away,
        "centre x": np.array([[1.0, 0.0]]),
        "centre y": np.array([[0.0, 1.0]]),
        "distortion": away * (np.sum(away**2, axis=1, keepdims=True) / corner**2),
        "line time": velocity * away[:, 1:],
    }
    return np.stack(
        [np.broadcast_to(sigma * moves[error], away.shape) for error, sigma in errors.items()], axis=-1
    )


def bent_camera(camera: ExposedCamera, error: FloatArray) -> ExposedCamera:
    """Return the camera with a lens of these errors, in deviations and in the order of `seeming_turns`."""
    sizes = zip(_errors(camera).items(), error, strict=False)  # the shutter's, which is none of the lens
    found = {name: sigma * float(by) for (name, sigma), by in sizes}
    scale, x, y, cubic = (
        found.get(name, 0.0) for name in ("focal length", "centre x", "centre y", "distortion")
    )
    pinhole = camera.pinhole
    lens = BentPinhole(pinhole.columns, pinhole.rows, pinhole.focal_length, (x, y), scale, cubic)
    return replace(camera, pinhole=lens)
