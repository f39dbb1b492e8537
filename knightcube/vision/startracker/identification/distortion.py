"""Fits radial distortion with attitude and scale, for a lens that is not calibrated.

A lens shifts stars by some percent of their distance from the axis. A pinhole then fits a group of neighbours
and misses the rest, and its attitude is off by more than its residuals admit. Here the shift is a parameter:
an image at the tangent t of the true direction is seen at t (1 + c (t / R)^2), R the tangent of the corner
(Brown 1966, the first radial term), with a prior of what lenses do. From the group of stars that match first,
the match grows outwards as the parameter is determined; where the stars do not determine it, the covariance
of the attitude says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.directions import cross_matrices
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.identification.refinement import (
    Refinement,
    inflation,
    scale_slope,
    stretched,
    turned,
)
from knightcube.vision.startracker.index.sky_index import SkyIndex

PRIOR = 0.05
"""Standard deviation of c, the relative shift at the corner, of lenses that are not calibrated."""
_MOST = 0.25
_ROUNDS = 12
_STEPS = 6
_SETTLED = 1e-6
# Half width of the gate while the match grows: of a star's sigma, and of the corner's tangent.
_GATE_SIGMAS = 8.0
_GATE_SHARE = 0.004
# Deviations of the scatter beyond which a star is left out of the final fit.
_OUTLIER = 4.0
# Median of the square root of a chi-square of 2.
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True, slots=True, eq=False)
class DistortedFit:
    """Matched stars, and the attitude with a distorted lens.

    Attributes:
        observed: (k,) numbers of observed stars.
        star: (k,) numbers of guide stars.
        refined: attitude, scale and their covariance, widened, with the distortion free.
        distortion: c of the module's text.
        seen: (n, 3) true directions, camera frame, of all stars of the field by this lens.
        from_lens: (3, 3) rad^2, the part of the attitude's covariance that an uncertain c adds.
    """

    observed: IntArray
    star: IntArray
    refined: Refinement
    distortion: float
    seen: FloatArray
    from_lens: FloatArray


def fit_with_distortion(
    field: StarField,
    sky: SkyIndex,
    expected: npt.NDArray[np.intp],
    observed: IntArray,
    star: IntArray,
    start: Refinement,
) -> DistortedFit | None:
    """Return the match grown from `observed` and `star` (k,) at `start`; None if they fix no lens.

    `expected` are the guide stars in and about the field, the brightest first.
    """
    corner = math.hypot(*field.half_width)
    pose = _Pose(start.matrix, start.scale, 0.0)
    reference = sky.stars.direction[expected]
    seen: set[bytes] = set()
    fitted = None
    for _ in range(_ROUNDS):
        fitted = _fitted(field, sky, observed, star, pose, corner)
        if fitted is None:
            return None
        pose = fitted[0]
        if observed.tobytes() in seen:
            break
        seen.add(observed.tobytes())
        cosines = pose.true(field.direction, corner) @ (pose.matrix @ reference.T)
        nearest = cosines.argmax(axis=1)
        rows = np.arange(len(field))
        apart = np.sqrt(np.maximum(2.0 - 2.0 * cosines[rows, nearest], 0.0))
        gate = np.maximum(_GATE_SIGMAS * field.sigma, _GATE_SHARE * corner) * pose.scale
        within = np.flatnonzero((apart <= gate) & (cosines.argmax(axis=0)[nearest] == rows))
        if len(within) < len(observed):
            break
        observed, star = within, expected[nearest[within]]
    assert fitted is not None  # there was a round
    squares = fitted[2]
    spread = max(1.0, math.sqrt(float(np.median(squares))) / _RAYLEIGH_MEDIAN)
    kept = squares <= (_OUTLIER * spread) ** 2
    if kept.sum() >= 4 and not kept.all():
        observed, star = observed[kept], star[kept]
        fitted = _fitted(field, sky, observed, star, pose, corner)
        if fitted is None:
            return None
    pose, normal, squares = fitted
    # Residuals beyond the sigmas widen the whole; the prior is not of their making.
    normal[4, 4] -= PRIOR**-2
    normal /= inflation(squares, 5)
    normal[4, 4] += PRIOR**-2
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    from_lens = np.outer(covariance[:3, 4], covariance[:3, 4]) / covariance[4, 4]
    refined = Refinement(pose.matrix, pose.scale, covariance[:4, :4], squares)
    seen_by = pose.true(field.direction, corner)
    return DistortedFit(observed, star, refined, pose.distortion, seen_by, from_lens)


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """Attitude (3, 3), scale and distortion."""

    matrix: FloatArray
    scale: float
    distortion: float

    def true(self, direction: FloatArray, corner: float) -> FloatArray:
        """Return the true directions (n, 3) of those observed (n, 3)."""
        return stretched(direction, self.scale * self.ratio(direction, corner))

    def ratio(self, direction: FloatArray, corner: float) -> FloatArray:
        """Return true over seen tangents (n,) at the scale: Newton's method on r (1 + c s^2 r^2) = 1."""
        squared = self.distortion * _squared_tangent(direction) / corner**2
        ratio = np.ones(len(direction))
        for _ in range(4):
            ratio -= (ratio * (1.0 + squared * ratio**2) - 1.0) / (1.0 + 3.0 * squared * ratio**2)
        return ratio


def _squared_tangent(direction: FloatArray) -> FloatArray:
    return np.asarray((direction[:, 0] ** 2 + direction[:, 1] ** 2) / direction[:, 2] ** 2)


def _fitted(
    field: StarField, sky: SkyIndex, observed: IntArray, star: IntArray, pose: _Pose, corner: float
) -> tuple[_Pose, FloatArray, FloatArray] | None:
    """Return the fit to the matched stars, its normal matrix (5, 5) with the prior, and squares (k,)."""
    direction, reference = field.direction[observed], sky.stars.direction[star]
    weight = 1.0 / (field.sigma[observed] * pose.scale)
    for _ in range(_STEPS):
        ratio = pose.ratio(direction, corner)
        seen = stretched(direction, pose.scale * ratio)
        predicted = reference @ pose.matrix.T
        residual = weight[:, None] * (seen - predicted)
        slope = np.empty((len(seen), 3, 5))
        # d(A r) for a turn d is -[A r x] d, of which the residual takes the negative.
        slope[:, :, :3] = -cross_matrices(predicted)
        slope[:, :, 3] = scale_slope(seen)
        share = _squared_tangent(direction) * ratio**2 / corner**2
        slope[:, :, 4] = slope[:, :, 3] * (-share / (1.0 + 3.0 * pose.distortion * share))[:, None]
        slope *= weight[:, None, None]
        flat = slope.reshape(-1, 5)
        normal = flat.T @ flat
        normal[4, 4] += PRIOR**-2
        gradient = flat.T @ residual.ravel()
        gradient[4] += pose.distortion / PRIOR**2
        try:
            step = -np.linalg.solve(normal, gradient)
        except np.linalg.LinAlgError:
            return None
        distortion = pose.distortion + float(step[4])
        if not float(np.abs(step).max()) < 1.0 or abs(distortion) > _MOST:
            return None
        turn = np.asarray(step[:3], dtype=np.float64)
        pose = _Pose(turned(pose.matrix, turn), pose.scale * math.exp(float(step[3])), distortion)
        if np.abs(step).max() < _SETTLED:
            break
    missed = weight[:, None] * (pose.true(direction, corner) - reference @ pose.matrix.T)
    return pose, np.asarray(normal), np.einsum("ij,ij->i", missed, missed)
