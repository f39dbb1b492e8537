"""The attitude from matched stars whose image positions have individual covariances.

The position of a streaked star is accurate across its path and inaccurate along it. Each residual b - A r is
taken in the two directions across the star and whitened by the covariance of the position; Gauss-Newton
minimises the sum of squares, the maximum likelihood estimate for Gaussian errors. The light of another star
in a streak shifts its position. Stars that disagree by more than chance allows, given the scatter of the
majority, are found with Huber's weights, which bound the influence of any star, and are excluded.

Tilt, decentring and distortion of an inexact lens (the bend, see `sky_map`) are fitted too, with a prior from
the calibration or from typical lenses: their remaining uncertainty is part of the covariance of the attitude.
The same holds for an error of the line time of a rolling shutter, which displaces each star along its motion
in proportion to its row.

The positions of streaks that differ from the model have errors of pixels, independent of their brightness. If
the streaks scatter beyond their noise, a common variance is added to the noise, so that the sum of squares
equals the degrees of freedom (Mandel & Paule 1970, Analytical Chemistry 42(11)). Without it the brightest
stars, whose noise is smallest, would dominate, and the covariance would be too small.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, cross_matrices
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, Solver
from knightcube.astro.quaternion import attitude_matrix, from_matrix
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.attitude_fit import (
    inflation,
    scale_slope,
    stretched,
    turned,
)
from knightcube.vision.startracker.sky_map import BENDS, bend_slope, bent

_MOST_STEPS = 8
_SETTLED = 1e-11
# Step (px) of the numerical derivative of the lens.
_STEP_PX = 0.5
# Chi-square with 2 degrees of freedom that is exceeded by chance once in 1000, and the median.
_FARTHEST = 13.8
_MEDIAN = 2.0 * float(np.log(2.0))
# Residual (standard deviations) above which the influence of a star is bounded in the search for outliers.
_PULL = 1.5
_HUBER_ROUNDS = 10
_LEAST_AGREEING = 4
# Maximum number of Newton steps for the common variance, and excess of the sum of squares at which they end.
_SCATTER_ROUNDS, _EXPLAINED = 12, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """The parameters that are fitted together with the attitude.

    Attributes:
        scale: whether the focal length is fitted.
        bend: prior information (6,), the reciprocal variances, of the lens errors (`sky_map`); empty (0,) if
            the lens is exact.
        late: displacement of each star (n, 2), px, due to an error of one standard deviation of the shutter's
            line time; (0, 2) if the line time is exact.
        scatter: whether a common variance may be added to the variances of the positions.
    """

    scale: bool = False
    bend: FloatArray = field(default_factory=lambda: np.zeros(0))
    late: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    scatter: bool = False


_NONE = Unknowns()


@dataclass(frozen=True, slots=True, eq=False)
class ImageFit:
    """The attitude and the quality of its fit.

    Attributes:
        fix: the attitude from the stars that agree; its covariance is increased if they scatter too much.
        scale: factor of the tangents x/z, y/z; 1 if it was fixed.
        scale_sigma: relative standard deviation of the scale; 0 if it was fixed.
        bend: bend of the lens (6,), see `sky_map`; zeros for an exact lens.
        delay: fitted error of the shutter's line time, in standard deviations.
        squares: chi-square of each star (n,), with two degrees of freedom.
        agree: whether the star was used (n,).
    """

    fix: AttitudeFix
    scale: float
    scale_sigma: float
    bend: FloatArray
    delay: float
    squares: FloatArray
    agree: BoolArray


def fit_in_image(
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    start: FloatArray,
    unknowns: Unknowns = _NONE,
) -> ImageFit:
    """Return the attitude for which stars at `reference` appear at `points`.

    Args:
        points: measured positions (n, 2), px.
        covariance: covariance of each position (n, 2, 2), px^2.
        reference: directions of the stars (n, 3), unit vectors.
        camera: the camera with its lens.
        start: approximate attitude (4,), reference to camera.
        unknowns: the parameters that are fitted together with the attitude.

    Raises AttitudeError if the stars do not determine the parameters.
    """
    # The derivatives (n, 3, 2) of direction by position.
    moved = [
        camera.unit_vectors(points + offset) - camera.unit_vectors(points - offset)
        for offset in _STEP_PX * np.eye(2)
    ]
    slopes = np.stack(moved, axis=-1) / (2.0 * _STEP_PX)
    seen = _Seen(camera.unit_vectors(points), slopes, covariance, reference, unknowns)
    pose = seen.fitted(_FittedPose(attitude_matrix(start), 1.0), np.ones(len(points)))
    squares, agree = seen.squares(pose), np.ones(len(points), dtype=np.bool_)
    if squares.max() > _FARTHEST:
        pose, agree = _without_outliers(seen, pose, squares)
        squares = seen.squares(pose)
    if unknowns.scatter:
        seen, pose = _scattered(seen, pose, agree)
        squares = seen.squares(pose)
    inverse = pose.covariance * inflation(squares[agree], seen.parameters(pose))
    turn = np.ascontiguousarray(inverse[:3, :3], dtype=np.float64)
    fix = AttitudeFix(from_matrix(pose.matrix), turn, 0.5 * float(squares[agree].sum()))
    scale_sigma = float(np.sqrt(inverse[3, 3])) if unknowns.scale else 0.0
    return ImageFit(fix, pose.scale, scale_sigma, pose.bend, pose.delay, squares, agree)


@dataclass(frozen=True, slots=True, eq=False)
class _FittedPose:
    """Attitude (3, 3), scale, bend (6,), delay, and the covariance of these parameters."""

    matrix: FloatArray
    scale: float
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    delay: float = 0.0
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Stars observed at `observed` (n, 3), camera frame, whose catalogue directions are `reference` (n, 3).

    `slopes` (n, 3, 2) are the derivatives of direction by position, and `covariance` (n, 2, 2), px^2, is the
    covariance of each position.
    """

    observed: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    reference: FloatArray
    unknowns: Unknowns
    whitener: FloatArray = field(init=False)
    late: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        # The whitener (n, 2, 3) transforms a direction error into two components of unit variance. It is a
        # pseudo-inverse: the third direction, along the line of sight, carries no error.
        spread = self.slopes @ np.linalg.cholesky(self.covariance)
        across = np.swapaxes(spread, -1, -2)
        object.__setattr__(self, "whitener", np.asarray(np.linalg.inv(across @ spread) @ across))
        late = self.unknowns.late
        late = np.einsum("nij,nj->ni", self.slopes, late) if len(late) else np.zeros((0, 3))
        object.__setattr__(self, "late", late)

    @property
    def before(self) -> FloatArray:
        """The prior information about bend and delay, which are the last parameters."""
        return np.append(self.unknowns.bend, np.ones(min(len(self.late), 1)))

    @property
    def camera(self) -> IntArray:
        """The indices of bend and delay among the parameters, after the rotation and ln scale."""
        return 3 + int(self.unknowns.scale) + np.arange(len(self.before))

    def parameters(self, pose: _FittedPose) -> float:
        """Return the effective number of parameters that the stars determine, without prior information."""
        before = self.before * np.diagonal(pose.covariance)[self.camera]
        return len(pose.covariance) - float(before.sum())

    def fitted(self, start: _FittedPose, weight: FloatArray) -> _FittedPose:
        """Return the pose that minimises the squares, weighted with `weight` (n,)."""
        whitener = self.whitener * np.sqrt(weight)[:, None, None]
        matrix, scale, known, bends = start.matrix, start.scale, self.before, len(self.unknowns.bend)
        held = np.append(start.bend[:bends], np.full(len(known) - bends, start.delay))
        for _ in range(_MOST_STEPS):
            pose = self._pose(matrix, scale, held)
            seen, predicted = self.directions(pose), self.reference @ matrix.T
            residual = np.einsum("nij,nj->ni", whitener, seen - predicted).ravel()
            flat = self._slope(whitener, seen, predicted)
            normal, gradient = flat.T @ flat, flat.T @ residual
            normal[self.camera, self.camera] += known
            gradient[self.camera] += known * held
            try:
                inverse = np.linalg.inv(normal)
            except np.linalg.LinAlgError as error:
                raise AttitudeError(f"{len(weight)} stars in one place fix no attitude") from error
            step = -inverse @ gradient
            if not np.all(np.abs(step[: 3 + int(self.unknowns.scale)]) < 1.0):
                raise AttitudeError(f"{len(weight)} stars do not agree on an attitude")
            matrix = turned(matrix, step[:3])
            scale *= float(np.exp(step[3])) if self.unknowns.scale else 1.0
            held = held + step[self.camera]
            if np.abs(step).max() < _SETTLED:
                break
        return replace(self._pose(matrix, scale, held), covariance=np.asarray(inverse, dtype=np.float64))

    def _pose(self, matrix: FloatArray, scale: float, held: FloatArray) -> _FittedPose:
        """Return a pose with the bend and delay in `held` (0, 1, 6 or 7,)."""
        bends = len(self.unknowns.bend)
        return _FittedPose(matrix, scale, np.pad(held[:bends], (0, BENDS - bends)), float(held[bends:].sum()))

    def _slope(self, whitener: FloatArray, seen: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return d(whitened residuals)/d(turn, ln scale, bend, delay), (2n, 3 to 11)."""
        slopes = [-whitener @ cross_matrices(predicted)]
        if self.unknowns.scale:
            slopes.append(whitener @ scale_slope(seen)[:, :, None])
        if len(self.unknowns.bend):
            slopes.append(whitener @ bend_slope(seen))
        if len(self.late):
            slopes.append(-whitener @ self.late[:, :, None])
        return np.concatenate(slopes, axis=2).reshape(2 * len(seen), -1)

    def directions(self, pose: _FittedPose) -> FloatArray:
        """Return the observed unit vectors (n, 3) at mid-exposure, corrected for the lens of a pose."""
        seen = bent(stretched(self.observed, pose.scale), pose.bend)
        return seen - pose.delay * self.late if len(self.late) else seen

    def squares(self, pose: _FittedPose) -> FloatArray:
        """Return each star's squared error over its covariance (n,)."""
        return np.asarray(np.sum(np.einsum("nij,nj->ni", self.whitener, self.missed(pose)) ** 2, axis=1))

    def missed(self, pose: _FittedPose) -> FloatArray:
        """Return the difference (n, 3) between observed and predicted direction of each star."""
        return self.directions(pose) - self.reference @ pose.matrix.T


def _without_outliers(seen: _Seen, pose: _FittedPose, squares: FloatArray) -> tuple[_FittedPose, BoolArray]:
    """Return the fit to the stars that agree, and a mask (n,) of these stars.

    An outlier shifts all residuals, so that their spread is meaningful only after the influence of outliers
    is bounded.
    """
    for _ in range(_HUBER_ROUNDS):
        pose = seen.fitted(pose, _PULL / np.maximum(np.sqrt(squares), _PULL))
        squares = seen.squares(pose)
    # A star agrees if it scatters as the majority does. If too few would remain, all stars are used.
    agree = squares <= _FARTHEST * max(1.0, float(np.median(squares)) / _MEDIAN)
    if np.count_nonzero(agree) < max(_LEAST_AGREEING, len(squares) // 2):
        agree = np.ones(len(squares), dtype=np.bool_)
    return seen.fitted(pose, agree.astype(np.float64)), agree


def _scattered(seen: _Seen, pose: _FittedPose, agree: BoolArray) -> tuple[_Seen, _FittedPose]:
    """Return stars and fit with a common variance added to the variances of the stars that `agree` (n,)."""
    weight, own, variance = agree.astype(np.float64), seen.covariance, 0.0
    for _ in range(_SCATTER_ROUNDS):
        root = np.linalg.cholesky(seen.covariance[agree])
        missed = np.einsum("nij,nj->ni", seen.whitener, seen.missed(pose))[agree]
        excess = float(np.sum(missed**2)) - (2 * len(missed) - seen.parameters(pose))
        if excess <= _EXPLAINED or len(missed) <= _LEAST_AGREEING:
            break
        # The derivative of the squares by the variance, at a fixed pose, because the pose minimises them.
        variance += excess / float(np.sum(np.linalg.solve(root.swapaxes(1, 2), missed[..., None]) ** 2))
        seen = replace(seen, covariance=own + variance * np.eye(2))
        pose = seen.fitted(pose, weight)
    return seen, pose


def attitude_by(
    solver: Solver,
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    fit: ImageFit,
    late: FloatArray,
) -> AttitudeFix:
    """Return the attitude by a solver of Wahba's problem, from the stars that agree in an image fit.

    The image fit excludes the stars that disagree and determines the lens. The solver takes the directions of
    the other stars, each with one error, the mean over both axes (Michalski 3.4).

    Args:
        solver: the solver.
        points: measured positions (n, 2), px.
        covariance: covariance of each position (n, 2, 2), px^2.
        reference: directions of the stars (n, 3), unit vectors.
        camera: the camera with which the fit was started.
        fit: the image fit.
        late: displacement of each star per standard deviation of the line time (n, 2), px, or (0, 2).

    Raises AttitudeError if the stars do not determine the attitude.
    """
    if len(late):
        points = points - fit.delay * late
    seen = bent(stretched(camera.unit_vectors(points), fit.scale), fit.bend)[fit.agree]
    pixels = np.sqrt(0.5 * np.trace(covariance[fit.agree], axis1=1, axis2=2))
    # Off the boresight a pixel subtends a smaller angle: by cos^2 along the radius and by cos across it.
    sigma = pixels * fit.scale / camera.focal_length * seen[:, 2] ** 1.5
    return solver(seen, reference[fit.agree], sigma)
