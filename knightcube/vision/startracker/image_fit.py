"""The attitude from matched stars whose image positions have individual covariances.

A streaked star is measured well across its path and badly along it. Each residual b - A r is taken in the two
directions across the star and whitened by the covariance of the position; Gauss-Newton minimises the sum of
squares, the maximum likelihood estimate for Gaussian errors. The light of another star in a streak shifts its
position. Stars that disagree by more than chance allows, given the scatter of the majority, are found with
Huber's weights, which bound the influence of any star, and are excluded.

Tilt, decentring and distortion of an inexact lens (the bend, see `sky_map`) are fitted too, with a prior from
the calibration or from typical lenses: their remaining uncertainty is part of the covariance of the attitude.
The same holds for an error of the line time of a rolling shutter, which displaces each star along its motion
in proportion to its row.

Streaks that differ from the model err by pixels, bright ones as much as faint ones. Where streaks scatter
beyond their noise, a common variance is added to the noise, so large that the sum of squares equals the
degrees of freedom (Mandel & Paule 1970, Analytical Chemistry 42(11)). Without it the brightest stars, whose
noise is smallest, would dominate, and the covariance would be too small.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, Solver
from knightcube.astro.directions import cross_matrices
from knightcube.astro.quaternion import attitude_matrix, from_matrix
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.identification.attitude_fit import (
    inflation,
    scale_slope,
    stretched,
    turned,
)
from knightcube.vision.startracker.sky_map import BENDS, bend_slope, bent

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
# Newton's steps to the common variance, from below; they end where the squares exceed by less.
_SCATTER_ROUNDS, _EXPLAINED = 12, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """What may be wrong beside the attitude, and is fitted with it.

    Attributes:
        scale: whether the focal length may be.
        bend: (6,) information about the lens's bend; (0,): it has none.
        late: (n, 2) px by which a standard deviation of the shutter's line time displaces each star; (0, 2):
            the line time is exact.
        scatter: whether the places may have a common variance beside their own.
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
        fix: the attitude by the stars that agree; its covariance is widened if they scatter beyond theirs.
        scale: factor of the tangents x/z, y/z; 1 when it was held.
        scale_sigma: relative standard deviation of the scale; 0 when it was held.
        bend: (6,) of the lens (`lens_bend`); zeros when it has none.
        delay: of the shutter beside the described one, in its standard deviations.
        squares: (n,) squared error of each star over its covariance, of two degrees of freedom.
        agree: (n,) whether the star was used.
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
    """Return the attitude that puts stars at `reference` (n, 3) to `points` (n, 2) px.

    Args:
        points: (n, 2) px.
        covariance: (n, 2, 2) px^2 of each.
        reference: (n, 3) unit vectors.
        camera: with its lens.
        start: (4,) an attitude near the answer, reference into camera.
        unknowns: what is fitted beside the attitude.

    Raises AttitudeError when the stars do not determine the parameters.
    """
    seen = _Seen(camera.unit_vectors(points), _slopes(points, camera), covariance, reference, unknowns)
    pose = seen.fitted(_Pose(attitude_matrix(start), 1.0), np.ones(len(points)))
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
class _Pose:
    """Attitude (3, 3), scale, bend (6,), delay, and the covariance that weights of stars give them."""

    matrix: FloatArray
    scale: float
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    delay: float = 0.0
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Stars seen at `observed` (n, 3), at `reference` (n, 3) in the sky.

    `slopes` (n, 3, 2) are d(direction)/d(place), `covariance` (n, 2, 2) px^2 is of the places.
    """

    observed: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    reference: FloatArray
    unknowns: Unknowns
    whitener: FloatArray = field(init=False)
    late: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "whitener", _whitener(self.slopes, self.covariance))
        late = self.unknowns.late
        late = np.einsum("nij,nj->ni", self.slopes, late) if len(late) else np.zeros((0, 3))
        object.__setattr__(self, "late", late)

    @property
    def before(self) -> FloatArray:
        """The information about the last parameters, bend and delay, before any star is seen."""
        return np.append(self.unknowns.bend, np.ones(min(len(self.late), 1)))

    @property
    def camera(self) -> IntArray:
        """The places of bend and delay among the parameters, after the turn and ln scale."""
        return 3 + int(self.unknowns.scale) + np.arange(len(self.before))

    def parameters(self, pose: _Pose) -> float:
        """Return how many parameters the stars gave: of bend and delay only what was not known before."""
        before = self.before * np.diagonal(pose.covariance)[self.camera]
        return len(pose.covariance) - float(before.sum())

    def fitted(self, start: _Pose, weight: FloatArray) -> _Pose:
        """Return the least of the squares times `weight` (n,)."""
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

    def _pose(self, matrix: FloatArray, scale: float, held: FloatArray) -> _Pose:
        """Return a pose with the bend and the delay that are `held` (0, 1, 6 or 7,)."""
        bends = len(self.unknowns.bend)
        return _Pose(matrix, scale, np.pad(held[:bends], (0, BENDS - bends)), float(held[bends:].sum()))

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

    def directions(self, pose: _Pose) -> FloatArray:
        """Return the unit vectors (n, 3) seen, at mid-exposure, through the lens of a pose."""
        seen = bent(stretched(self.observed, pose.scale), pose.bend)
        return seen - pose.delay * self.late if len(self.late) else seen

    def squares(self, pose: _Pose) -> FloatArray:
        """Return each star's squared error over its covariance (n,)."""
        return np.asarray(np.sum(np.einsum("nij,nj->ni", self.whitener, self.missed(pose)) ** 2, axis=1))

    def missed(self, pose: _Pose) -> FloatArray:
        """Return by how much (n, 3) each star is seen away from where a pose puts it."""
        return self.directions(pose) - self.reference @ pose.matrix.T


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


def _scattered(seen: _Seen, pose: _Pose, agree: BoolArray) -> tuple[_Seen, _Pose]:
    """Return stars and fit with the variance that stars which `agree` (n,) share beside their own."""
    weight, own, variance = agree.astype(np.float64), seen.covariance, 0.0
    for _ in range(_SCATTER_ROUNDS):
        root = np.linalg.cholesky(seen.covariance[agree])
        missed = np.einsum("nij,nj->ni", seen.whitener, seen.missed(pose))[agree]
        excess = float(np.sum(missed**2)) - (2 * len(missed) - seen.parameters(pose))
        if excess <= _EXPLAINED or len(missed) <= _LEAST_AGREEING:
            break
        # d(squares)/d(variance), the pose held: it is where they are least.
        variance += excess / float(np.sum(np.linalg.solve(root.swapaxes(1, 2), missed[..., None]) ** 2))
        seen = replace(seen, covariance=own + variance * np.eye(2))
        pose = seen.fitted(pose, weight)
    return seen, pose


def _slopes(points: FloatArray, camera: CameraModel) -> FloatArray:
    """Return d(direction)/d(place) (n, 3, 2) at points (n, 2) px."""
    moved = [
        camera.unit_vectors(points + offset) - camera.unit_vectors(points - offset)
        for offset in _STEP_PX * np.eye(2)
    ]
    return np.stack(moved, axis=-1) / (2.0 * _STEP_PX)


def _whitener(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return matrices (n, 2, 3) that turn an error of a direction into two of variance one."""
    spread = slopes @ np.linalg.cholesky(covariance)
    # The pseudo-inverse: the third direction, along the line of sight, carries no error.
    return np.asarray(np.linalg.inv(np.swapaxes(spread, -1, -2) @ spread) @ np.swapaxes(spread, -1, -2))


def attitude_by(
    solver: Solver,
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    fit: ImageFit,
    late: FloatArray,
) -> AttitudeFix:
    """Return a solver's attitude from the stars at `points` (n, 2) px that agree in an image fit.

    `covariance` (n, 2, 2) px^2, `reference` (n, 3) and `late` (n, 2) are theirs, `camera` is that of the
    fit's start. Raises AttitudeError.
    """
    if len(late):
        points = points - fit.delay * late
    seen = bent(stretched(camera.unit_vectors(points), fit.scale), fit.bend)[fit.agree]
    pixels = np.sqrt(0.5 * np.trace(covariance[fit.agree], axis1=1, axis2=2))
    # A pixel off the boresight is seen shorter: by cos^2 along the radius and cos across it.
    sigma = pixels * fit.scale / camera.focal_length * seen[:, 2] ** 1.5
    return solver(seen, reference[fit.agree], sigma)
