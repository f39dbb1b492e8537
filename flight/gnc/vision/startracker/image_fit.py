"""The attitude from matched stars whose places in the image have individual covariances.

A streaked star is measured well across its path and badly along it. Each residual b - A r is taken in the two
directions across the star and whitened by the place's covariance; Gauss-Newton minimises the sum of squares:
the maximum likelihood for Gaussian errors. Light of another star in a streak shifts its place: stars that
disagree by more than chance allows, given the scatter of the majority, are found under Huber's weights, which
bound the pull of any star, and are excluded.

The tilt, decentring and distortion of a lens that is not exact are fitted too, held by what is known of it or
is usual of lenses (`lens_bend`): what the stars leave open of them is in the attitude's covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flight.gnc.attitude.wahba import AttitudeError, AttitudeFix
from flight.gnc.camera.lens import CameraModel
from flight.gnc.math.arrays import BoolArray, FloatArray, IntArray
from flight.gnc.math.directions import cross_matrices
from flight.gnc.math.quaternion import attitude_matrix, from_matrix
from flight.gnc.vision.startracker.identification.refinement import inflation, scale_slope, stretched, turned
from flight.gnc.vision.startracker.lens_bend import BENDS, bend_slope, bent

_MOST_STEPS = 8
_SETTLED = 1e-11
# px, over which the slope of the lens is taken.
_STEP_PX = 0.5
# Of a chi-square of 2: exceeded by chance once in 1000, and its median.
_FARTHEST = 13.8
_MEDIAN = 2.0 * float(np.log(2.0))
# Deviations beyond which a star's pull is bounded while outliers are searched for.
_PULL = 1.5
_HUBER_ROUNDS = 10
_LEAST_AGREEING = 4


@dataclass(frozen=True, slots=True, eq=False)
class ImageFit:
    """The attitude and the quality of its fit.

    Attributes:
        fix: the attitude by the stars that agree; its covariance is widened if they scatter beyond theirs.
        scale: factor of the tangents x/z, y/z; 1 when it was held.
        scale_sigma: relative standard deviation of the scale; 0 when it was held.
        bend: (6,) of the lens (`lens_bend`); zeros when it has none.
        squares: (n,) squared error of each star over its covariance, of two degrees of freedom.
        agree: (n,) whether the star was used.
    """

    fix: AttitudeFix
    scale: float
    scale_sigma: float
    bend: FloatArray
    squares: FloatArray
    agree: BoolArray


def fit_in_image(
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    start: FloatArray,
    free_scale: bool = False,
    known: FloatArray | None = None,
) -> ImageFit:
    """Return the attitude that puts stars at `reference` (n, 3) to `points` (n, 2) px.

    Args:
        points: (n, 2) px.
        covariance: (n, 2, 2) px^2 of each.
        reference: (n, 3) unit vectors.
        camera: with its lens.
        start: (4,) an attitude near the answer, reference into camera.
        free_scale: whether the focal length may be wrong.
        known: (6,) information about the lens's bend, which is fitted too; (0,) or None: it has none.

    Raises AttitudeError when the stars do not determine the parameters.
    """
    observed = camera.unit_vectors(points)
    held = np.zeros(0) if known is None else known
    seen = _Seen(observed, _whitener(points, observed, covariance, camera), reference, free_scale, held)
    pose = seen.fitted(_Pose(attitude_matrix(start), 1.0), np.ones(len(points)))
    squares, agree = seen.squares(pose), np.ones(len(points), dtype=np.bool_)
    if squares.max() > _FARTHEST:
        pose, agree = _without_outliers(seen, pose, squares)
        squares = seen.squares(pose)
    inverse = pose.covariance * inflation(squares[agree], seen.parameters(pose))
    turn = np.ascontiguousarray(inverse[:3, :3], dtype=np.float64)
    fix = AttitudeFix(from_matrix(pose.matrix), turn, 0.5 * float(squares[agree].sum()))
    return ImageFit(
        fix, pose.scale, float(np.sqrt(inverse[3, 3])) if free_scale else 0.0, pose.bend, squares, agree
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """Attitude (3, 3), scale, bend (6,), and the covariance that weights of stars give them."""

    matrix: FloatArray
    scale: float
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Stars seen at `observed` (n, 3) with `whitener` (n, 2, 3), at `reference` (n, 3) in the sky.

    `known` (6,): information about the lens's bend before any star is seen; (0,): the lens has none.
    """

    observed: FloatArray
    whitener: FloatArray
    reference: FloatArray
    free_scale: bool
    known: FloatArray

    @property
    def lens(self) -> IntArray:
        """The places of the lens's bend among the parameters, after the turn and ln scale."""
        return 3 + int(self.free_scale) + np.arange(len(self.known))

    def parameters(self, pose: _Pose) -> float:
        """Return how many parameters the stars gave: of the bend only as much as was not known before."""
        before = self.known * np.diagonal(pose.covariance)[self.lens]
        return len(pose.covariance) - float(before.sum())

    def fitted(self, start: _Pose, weight: FloatArray) -> _Pose:
        """Return the least of the squares times `weight` (n,)."""
        whitener = self.whitener * np.sqrt(weight)[:, None, None]
        matrix, scale, bend = start.matrix, start.scale, start.bend
        for _ in range(_MOST_STEPS):
            seen, predicted = self.directions(scale, bend), self.reference @ matrix.T
            residual = np.einsum("nij,nj->ni", whitener, seen - predicted).ravel()
            flat = self._slope(whitener, seen, predicted)
            normal, gradient = flat.T @ flat, flat.T @ residual
            normal[self.lens, self.lens] += self.known
            gradient[self.lens] += self.known * bend[: len(self.known)]
            try:
                inverse = np.linalg.inv(normal)
            except np.linalg.LinAlgError as error:
                raise AttitudeError(f"{len(weight)} stars in one place fix no attitude") from error
            step = -inverse @ gradient
            if not np.all(np.abs(step[: 3 + int(self.free_scale)]) < 1.0):
                raise AttitudeError(f"{len(weight)} stars do not agree on an attitude")
            matrix = turned(matrix, step[:3])
            scale *= float(np.exp(step[3])) if self.free_scale else 1.0
            bend = bend + step[self.lens] if len(self.known) else bend
            if np.abs(step).max() < _SETTLED:
                break
        return _Pose(matrix, scale, bend, np.asarray(inverse, dtype=np.float64))

    def _slope(self, whitener: FloatArray, seen: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return d(whitened residuals)/d(turn, ln scale, bend), (2n, 3 to 10)."""
        slopes = [-whitener @ cross_matrices(predicted)]
        if self.free_scale:
            slopes.append(whitener @ scale_slope(seen)[:, :, None])
        if len(self.known):
            slopes.append(whitener @ bend_slope(seen))
        return np.concatenate(slopes, axis=2).reshape(2 * len(seen), -1)

    def directions(self, scale: float, bend: FloatArray) -> FloatArray:
        """Return the unit vectors (n, 3) seen through a lens of this scale and bend (6,)."""
        return bent(stretched(self.observed, scale), bend)

    def squares(self, pose: _Pose) -> FloatArray:
        """Return each star's squared error over its covariance (n,)."""
        missed = self.directions(pose.scale, pose.bend) - self.reference @ pose.matrix.T
        return np.asarray(np.sum(np.einsum("nij,nj->ni", self.whitener, missed) ** 2, axis=1))


def _without_outliers(seen: _Seen, pose: _Pose, squares: FloatArray) -> tuple[_Pose, BoolArray]:
    """Return the fit to the stars that agree, and which (n,) do.

    One outlier shifts all residuals: their spread is meaningless before its pull is bounded.
    """
    for _ in range(_HUBER_ROUNDS):
        pose = seen.fitted(pose, _PULL / np.maximum(np.sqrt(squares), _PULL))
        squares = seen.squares(pose)
    agree = _agreeing(squares)
    return seen.fitted(pose, agree.astype(np.float64)), agree


def _agreeing(squares: FloatArray) -> BoolArray:
    """Return which stars (n,) scatter as the majority does; all if too few would remain to decide."""
    agree = squares <= _FARTHEST * max(1.0, float(np.median(squares)) / _MEDIAN)
    enough = np.count_nonzero(agree) >= max(_LEAST_AGREEING, len(squares) // 2)
    return agree if enough else np.ones(len(squares), dtype=np.bool_)


def _whitener(
    points: FloatArray, observed: FloatArray, covariance: FloatArray, camera: CameraModel
) -> FloatArray:
    """Return matrices (n, 2, 3) that turn an error of a direction into two of variance one."""
    slopes = np.stack(
        [
            camera.unit_vectors(points + offset) - camera.unit_vectors(points - offset)
            for offset in _STEP_PX * np.eye(2)
        ],
        axis=-1,
    ) / (2.0 * _STEP_PX)
    root = np.linalg.cholesky(covariance)
    spread = slopes @ root
    # The pseudo-inverse: the third direction, along the line of sight, carries no error.
    return np.asarray(np.linalg.inv(np.swapaxes(spread, -1, -2) @ spread) @ np.swapaxes(spread, -1, -2))
