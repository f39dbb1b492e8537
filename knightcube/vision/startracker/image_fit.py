"""The attitude from matched stars whose image positions have individual covariances.

The position of a streaked star is accurate across its path and inaccurate along its path. The residual of a
star, which is the difference between observed and predicted unit vector, is resolved in two directions normal
to the star and scaled to unit variance with the covariance of the position. The minimum of the sum of
squares, found by a Gauss-Newton iteration, is the maximum likelihood estimate for Gaussian errors. A streak
that overlaps another star has a wrong position. Streaks with wrong positions are found by means of Huber's
weights, which limit the influence of each star. These streaks are excluded.

Tilt, decentring and distortion of the lens (the lens errors `bend`, see `sky_map`) are also fitted, with a
prior from the calibration or from typical lenses. The covariance of the attitude includes the remaining
uncertainty of the lens. An error of the line time of a rolling shutter, which displaces each star along its
motion in proportion to its row, is also fitted.

A star has a position error of some pixels, regardless of its brightness, if its image does not agree with the
model, for example a curved streak or the ring of a defocused lens. If the residuals show position errors from
images that do not agree with the model, a variance common to all stars is added to the noise, so that the sum
of squares equals the number of degrees of freedom (Mandel & Paule 1970, Analytical Chemistry 42(11)). Without
a common variance, the brightest stars would dominate the fit, and the covariance would be too small.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, cross_matrices, median
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, Solver
from knightcube.astro.quaternion import attitude_matrix, from_matrix
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.attitude_fit import inflation, scale_slope, stretched, turned
from knightcube.vision.startracker.sky_map import ASPECT, BENDS, bend_slope, bent

_MOST_STEPS = 8
_SETTLED = 1e-11
# Step (px) for the numerical derivative of a star's direction with respect to its image position.
_STEP_PX = 0.5
# Chi-square (2 degrees of freedom) that is exceeded with a probability of 0.1 %, and median of chi-square.
_FARTHEST = 13.8
_MEDIAN = 2.0 * float(np.log(2.0))
# Residual (standard deviations) above which Huber's weights limit the influence of a star.
_PULL = 1.5
_HUBER_ROUNDS = 10
_LEAST_AGREEING = 4
# Maximum number of Newton steps for the common variance, and the excess chi-square below which they end.
_SCATTER_ROUNDS, _EXPLAINED = 12, 1.0
# Number of parameters of attitude and scale.
_POSE = 4
# Maximum number of iterations that estimate the common variance and select the stars that agree with the fit.
_AGREEMENT_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """The parameters that are fitted together with the attitude.

    Attributes:
        scale: whether the scale of the image, and thus the focal length, is fitted.
        bend: reciprocal prior variances of the fitted lens errors (`sky_map`): (6,) for tilt, decentring and
            distortion, (8,) if the pixels are possibly not square, or (0,) if the lens is exact.
        late: displacement of each star (n, 2), px, due to an error of one standard deviation of the shutter's
            line time; (0, 2) if the line time is exact.
        scatter: whether a variance common to all stars is added to the variances of the positions as soon as
            the residuals are larger than expected. If `scatter` is false, a common variance is added only if
            this excess is significant and a factor common to all variances explains it less well.
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
        fix: attitude from the stars that agree with each other; its covariance is increased if the residuals
            are too large.
        scale: factor on the observed tangents x/z, y/z; 1 if the focal length was fixed.
        scale_sigma: relative standard deviation of the scale along the columns; 0 if it was fixed.
        bend: fitted lens errors (8,), see `sky_map`; zeros for an exact lens.
        delay: fitted error of the shutter's line time, in standard deviations.
        excess: chi-square per degree of freedom of the stars that agree with each other, for the measured
            variances of their positions; 1 unless it is significantly larger. Only attitude and scale are
            counted as fitted parameters. If fitted lens errors were also counted, a frame with few stars
            would have too few degrees of freedom.
        agree: mask of the stars that were used for the attitude (n,).
    """

    fix: AttitudeFix
    scale: float
    scale_sigma: float
    bend: FloatArray
    delay: float
    excess: float
    agree: BoolArray


def fit_in_image(
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    start: FloatArray,
    unknowns: Unknowns = _NONE,
) -> ImageFit:
    """Return the attitude that maps the star directions `reference` to the image positions `points`.

    The positions (n, 2), px, have the covariances (n, 2, 2). The star directions are unit vectors (n, 3) from
    the catalogue. The fit starts from the quaternion `start` (4,), reference to camera axes, and fits the
    `unknowns` together with the attitude. Raises AttitudeError if the stars do not determine the parameters.
    """
    # The array `slopes` (n, 3, 2) contains the derivatives of the directions with respect to the positions.
    # All directions are computed in one call, which takes less time than five calls.
    offsets = _STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    moved = (points + offsets[:, None]).reshape(-1, 2)
    observed, right, left, down, up = camera.unit_vectors(moved).reshape(5, -1, 3)
    slopes = np.stack([right - left, down - up], axis=-1) / (2.0 * _STEP_PX)
    seen = _Seen(observed, slopes, covariance, reference, unknowns)
    pose = seen.fitted(_FittedPose(attitude_matrix(start), 1.0), np.ones(len(points)))
    squares, agree = seen.squares(pose), np.ones(len(points), dtype=np.bool_)
    if squares.max() > _FARTHEST:
        pose, agree = _without_outliers(seen, pose, squares)
        squares = seen.squares(pose)
    excess = inflation(squares[agree], _POSE)
    factor = inflation(squares[agree], seen.parameters(pose))
    if unknowns.scatter or factor > 1.0:
        other, shifted, more = _with_scatter(seen, pose, agree)
        # Either all variances are too small by a common factor, or a common variance must be added to them.
        # The more likely of the two explanations of the residuals is used.
        if unknowns.scatter or _surprise(other, shifted, more, 1.0) < _surprise(seen, pose, more, factor):
            seen, pose, agree = other, shifted, more
            squares = seen.squares(pose)
    inverse = pose.covariance * inflation(squares[agree], seen.parameters(pose))
    turn = np.ascontiguousarray(inverse[:3, :3], dtype=np.float64)
    fix = AttitudeFix(from_matrix(pose.matrix), turn, 0.5 * float(squares[agree].sum()))
    along = np.zeros(len(inverse))
    along[3 : 3 + int(unknowns.scale)] = 1.0
    if unknowns.scale and len(unknowns.bend) == BENDS:
        along[4 + ASPECT] = 1.0
    scale_sigma = float(np.sqrt(along @ inverse @ along))
    return ImageFit(fix, pose.scale, scale_sigma, pose.bend, pose.delay, excess, agree)


@dataclass(frozen=True, slots=True, eq=False)
class _FittedPose:
    """Fitted attitude matrix (3, 3), scale, lens errors `bend` (8,), shutter delay, and their covariance."""

    matrix: FloatArray
    scale: float
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    delay: float = 0.0
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The n observed stars and the parameters that are fitted to them.

    Attributes:
        observed: observed unit vectors to the stars (n, 3), camera frame.
        slopes: derivatives of the observed directions with respect to the positions (n, 3, 2), rad/px.
        covariance: covariances of the positions (n, 2, 2), px^2.
        reference: unit vectors to the stars from the catalogue (n, 3).
        unknowns: parameters that are fitted together with the attitude.
        whitener: transformation (n, 2, 3) of a direction error into two components of unit variance.
        late: displacement of each direction due to a line time error of one standard deviation (n, 3), rad.
        before: reciprocal prior variances of the fitted lens errors `bend` and of the fitted delay.
    """

    observed: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    reference: FloatArray
    unknowns: Unknowns
    whitener: FloatArray = field(init=False)
    late: FloatArray = field(init=False)
    before: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        for name in ("observed", "reference"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))
        given = np.ascontiguousarray(self.slopes), np.ascontiguousarray(self.covariance)
        object.__setattr__(self, "whitener", _whiteners(*given))
        late = self.unknowns.late
        late = np.einsum("nij,nj->ni", self.slopes, late) if len(late) else np.zeros((0, 3))
        object.__setattr__(self, "late", late)
        object.__setattr__(self, "before", np.append(self.unknowns.bend, np.ones(min(len(late), 1))))

    def reweighted(
        self, start: _FittedPose, squares: FloatArray, rounds: int
    ) -> tuple[_FittedPose, FloatArray]:
        """Return the pose and the chi-squares (n,) after `rounds` steps with Huber's weights.

        The first weights follow from the chi-squares `squares` (n,) at the pose `start`.
        """
        given = self._given(start)
        agreed, matrix, scale, held, inverse, squares = self._sound(_reweighted, *given, squares, rounds)
        return self._pose(agreed, matrix, scale, held, inverse), squares

    def parameters(self, pose: _FittedPose) -> float:
        """Return the effective number of parameters that are determined by the stars and not by the prior."""
        before = self.before * np.diagonal(pose.covariance)[3 + int(self.unknowns.scale) :]
        return len(pose.covariance) - float(before.sum())

    def fitted(self, start: _FittedPose, weight: FloatArray, steps: int = _MOST_STEPS) -> _FittedPose:
        """Return the pose with the smallest sum of the stars' chi-squares, weighted with `weight` (n,).

        The fit ends after at most `steps` Gauss-Newton steps.
        """
        given = self._given(start)
        return self._pose(*self._sound(_fitted, *given, weight, steps))

    def _given(self, start: _FittedPose) -> tuple[Any, ...]:
        """Return the arguments of `_fitted` up to `free_scale`."""
        bends, known = len(self.unknowns.bend), self.before
        return (
            self.observed,
            self.whitener,
            self.reference,
            self.late,
            known,
            np.ascontiguousarray(start.matrix),
            float(start.scale),
            np.append(start.bend[:bends], np.full(len(known) - bends, start.delay)),
            self.unknowns.scale,
        )

    def _sound(self, fit: Callable[..., Any], *given: Any) -> Any:
        """Return the result of a fit. Raises AttitudeError if the normal matrix is singular."""
        try:
            return fit(*given)
        except np.linalg.LinAlgError as error:
            stars = len(self.observed)
            raise AttitudeError(f"{stars} stars are too close together for an attitude") from error

    def _pose(
        self, agreed: bool, matrix: FloatArray, scale: float, held: FloatArray, inverse: FloatArray
    ) -> _FittedPose:
        """Return the results of a fit as a pose. Raises AttitudeError if the fit diverged."""
        if not agreed:
            raise AttitudeError(f"{len(self.observed)} stars do not agree on an attitude")
        bends = len(self.unknowns.bend)
        bend = np.zeros(BENDS)
        bend[:bends] = held[:bends]
        return _FittedPose(matrix, scale, bend, float(held[bends:].sum()), inverse)

    def squares(self, pose: _FittedPose) -> FloatArray:
        """Return the chi-square of each star (n,) for a pose, with two degrees of freedom."""
        return np.asarray(np.sum(self.whitened(pose) ** 2, axis=1))

    def whitened(self, pose: _FittedPose) -> FloatArray:
        """Return the two residual components of unit variance of each star (n, 2) for a pose."""
        return np.asarray((self.whitener @ self.missed(pose)[:, :, None])[:, :, 0])

    def missed(self, pose: _FittedPose) -> FloatArray:
        """Return the difference between observed and predicted unit vector of each star (n, 3)."""
        scale, delay = float(pose.scale), float(pose.delay)
        matrix = np.ascontiguousarray(pose.matrix)
        return _missed(self.observed, self.reference, self.late, matrix, scale, pose.bend, delay)


def _whiteners_numpy(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the transformations (n, 2, 3) of direction errors into two components of unit variance.

    Each transformation is a pseudo-inverse, because a direction has no error along the line of sight.
    """
    spread = slopes @ np.linalg.cholesky(covariance)
    across = np.swapaxes(spread, -1, -2)
    return np.asarray(np.linalg.inv(across @ spread) @ across)


@compiled_form_of(_whiteners_numpy)
def _whiteners(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """See `_whiteners_numpy`."""
    out, across = np.empty((len(slopes), 2, 3)), np.empty((2, 3))
    for star in range(len(slopes)):
        # The rows of `across` are the columns of the product of slopes and Cholesky factor.
        first = math.sqrt(covariance[star, 0, 0])
        below = covariance[star, 1, 0] / first
        second = math.sqrt(covariance[star, 1, 1] - below * below)
        xx, xy, yy = 0.0, 0.0, 0.0
        for axis in range(3):
            across[0, axis] = first * slopes[star, axis, 0] + below * slopes[star, axis, 1]
            across[1, axis] = second * slopes[star, axis, 1]
            xx += across[0, axis] * across[0, axis]
            xy += across[0, axis] * across[1, axis]
            yy += across[1, axis] * across[1, axis]
        determinant = xx * yy - xy * xy
        for axis in range(3):
            out[star, 0, axis] = (yy * across[0, axis] - xy * across[1, axis]) / determinant
            out[star, 1, axis] = (xx * across[1, axis] - xy * across[0, axis]) / determinant
    return out


def _missed_numpy(
    observed: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    matrix: FloatArray,
    scale: float,
    bend: FloatArray,
    delay: float,
) -> FloatArray:
    """Return the difference between observed and predicted unit vector of each star (n, 3).

    The observed unit vectors are corrected for the lens errors `bend` and for the delay of the shutter.
    """
    seen = bent(stretched(observed, scale), bend)
    seen = seen - delay * late if len(late) else seen
    return np.asarray(seen - reference @ matrix.T)


@compiled_form_of(_missed_numpy)
def _missed(
    observed: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    matrix: FloatArray,
    scale: float,
    bend: FloatArray,
    delay: float,
) -> FloatArray:
    """See `_missed_numpy`."""
    out = np.empty_like(observed)
    for star in range(len(observed)):
        _miss(observed, reference, late, matrix, scale, bend, delay, star, out[star])
    return out


@loop_helper
def _miss(
    observed: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    matrix: FloatArray,
    scale: float,
    bend: FloatArray,
    delay: float,
    star: int,
    off: FloatArray,
) -> None:
    """Write the difference between observed and predicted unit vector of one star to `off` (3,)."""
    _see(observed[star], scale, bend, off)
    for axis in range(3):
        if len(late):
            off[axis] -= delay * late[star, axis]
        for k in range(3):
            off[axis] -= matrix[axis, k] * reference[star, k]


def _fitted_numpy(
    observed: FloatArray,
    whitener: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    known: FloatArray,
    matrix: FloatArray,
    scale: float,
    held: FloatArray,
    free_scale: bool,
    weight: FloatArray,
    steps: int,
) -> _Fitted:
    """Return a flag of convergence, the matrix, the scale, lens errors and delay, and the covariance.

    The fitted parameters are a rotation, ln scale if `free_scale` is true, some of the lens errors, and the
    delay if `late` is not empty. The array `held` contains the initial lens errors and delay, and `known`
    contains their reciprocal prior variances. Raises LinAlgError if the normal matrix is singular.
    """
    whitener = whitener * np.sqrt(weight)[:, None, None]
    bend, first, bends = np.zeros(BENDS), 3 + int(free_scale), len(held) - int(len(late) > 0)
    last = first + np.arange(len(known))
    for _ in range(steps):
        bend[:bends] = held[:bends]
        seen = bent(stretched(observed, scale), bend)
        if len(late):
            seen = seen - held[bends] * late
        normal, gradient = _normal(whitener, seen, reference @ matrix.T, late, free_scale, bends)
        normal[last, last] += known
        gradient[last] += known * held
        inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        step = -inverse @ gradient
        if not np.all(np.abs(step[:first]) < 1.0):
            return False, matrix, scale, held, inverse
        matrix = turned(matrix, step[:3])
        scale *= float(np.exp(step[3])) if free_scale else 1.0
        held = held + step[last]
        if np.abs(step).max() < _SETTLED:
            break
    return True, matrix, scale, held, inverse


def _normal(
    whitener: FloatArray, seen: FloatArray, predicted: FloatArray, late: FloatArray, scale: bool, bends: int
) -> tuple[FloatArray, FloatArray]:
    """Return normal matrix (p, p) and gradient (p,) of the residuals, scaled to unit variance.

    The p parameters are a rotation, ln scale if `scale` is true, the first `bends` of the eight lens errors,
    and the delay of the shutter if `late` is not empty.
    """
    slopes = [-whitener @ cross_matrices(predicted)]
    if scale:
        slopes.append(whitener @ scale_slope(seen)[:, :, None])
    if bends:
        slopes.append(whitener @ bend_slope(seen)[:, :, :bends])
    if len(late):
        slopes.append(-whitener @ late[:, :, None])
    flat = np.concatenate(slopes, axis=2).reshape(2 * len(seen), -1)
    residual = np.einsum("nij,nj->ni", whitener, seen - predicted).ravel()
    return flat.T @ flat, flat.T @ residual


_Fitted = tuple[bool, FloatArray, float, FloatArray, FloatArray]


@compiled_form_of(_fitted_numpy)
def _fitted(
    observed: FloatArray,
    whitener: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    known: FloatArray,
    matrix: FloatArray,
    scale: float,
    held: FloatArray,
    free_scale: bool,
    weight: FloatArray,
    steps: int,
) -> _Fitted:
    return _stepped(
        observed, whitener, reference, late, known, matrix, scale, held, free_scale, weight, steps
    )


@loop_helper
def _stepped(
    observed: FloatArray,
    whitener: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    known: FloatArray,
    matrix: FloatArray,
    scale: float,
    held: FloatArray,
    free_scale: bool,
    weight: FloatArray,
    steps: int,
) -> _Fitted:
    """Return the results of `_fitted_numpy`."""
    first = 4 if free_scale else 3
    count = first + len(known)
    matrix, held, step = matrix.copy(), held.copy(), np.empty(count)
    normal, gradient, inverse = np.empty((count, count)), np.empty(count), np.empty((count, count))
    for _ in range(steps):
        _write_normal(
            observed, whitener, reference, late, weight, matrix, scale, held, free_scale, normal, gradient
        )
        for k in range(len(known)):
            normal[first + k, first + k] += known[k]
            gradient[first + k] += known[k] * held[k]
        inverted = np.linalg.inv(normal)
        longest, sound = 0.0, True
        for i in range(count):
            step[i] = 0.0
            for j in range(count):
                inverse[i, j] = inverted[i, j]
                step[i] -= inverse[i, j] * gradient[j]
            longest = max(longest, abs(step[i]))
            sound &= i >= first or abs(step[i]) < 1.0
        if not sound:
            return False, matrix, scale, held, inverse
        _turn(matrix, step)
        scale *= math.exp(step[3]) if free_scale else 1.0
        for k in range(len(known)):
            held[k] += step[first + k]
        if longest < _SETTLED:
            break
    return True, matrix, scale, held, inverse


_Reweighted = tuple[bool, FloatArray, float, FloatArray, FloatArray, FloatArray]


def _reweighted_numpy(
    observed: FloatArray,
    whitener: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    known: FloatArray,
    matrix: FloatArray,
    scale: float,
    held: FloatArray,
    free_scale: bool,
    squares: FloatArray,
    rounds: int,
) -> _Reweighted:
    """Return the results of `_fitted_numpy` and the chi-squares (n,) after steps with Huber's weights."""
    seen, agreed, inverse = (observed, whitener, reference, late, known), True, np.zeros((0, 0))
    bends, bend = len(held) - int(len(late) > 0), np.zeros(BENDS)
    for _ in range(rounds):
        weight = _PULL / np.maximum(np.sqrt(squares), _PULL)
        agreed, matrix, scale, held, inverse = _fitted_numpy(
            *seen, matrix, scale, held, free_scale, weight, 1
        )
        if not agreed:
            break
        bend[:bends] = held[:bends]
        delay = float(held[bends:].sum())
        missed = _missed_numpy(observed, reference, late, matrix, scale, bend, delay)
        squares = np.sum(np.einsum("nij,nj->ni", whitener, missed) ** 2, axis=1)
    return agreed, matrix, scale, held, inverse, squares


@compiled_form_of(_reweighted_numpy)
def _reweighted(
    observed: FloatArray,
    whitener: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    known: FloatArray,
    matrix: FloatArray,
    scale: float,
    held: FloatArray,
    free_scale: bool,
    squares: FloatArray,
    rounds: int,
) -> _Reweighted:
    """See `_reweighted_numpy`."""
    squares, weight, off = squares.copy(), np.empty(len(squares)), np.empty(3)
    bends, bend, delay = len(held) - int(len(late) > 0), np.zeros(8), 0.0
    agreed, inverse = True, np.zeros((0, 0))
    for _ in range(rounds):
        for star in range(len(squares)):
            weight[star] = _PULL / max(math.sqrt(squares[star]), _PULL)
        agreed, matrix, scale, held, inverse = _stepped(
            observed, whitener, reference, late, known, matrix, scale, held, free_scale, weight, 1
        )
        if not agreed:
            break
        for k in range(bends):
            bend[k] = held[k]
        delay = held[bends] if len(late) else 0.0
        for star in range(len(squares)):
            _miss(observed, reference, late, matrix, scale, bend, delay, star, off)
            squares[star] = 0.0
            for row in range(2):
                squares[star] += (
                    whitener[star, row, 0] * off[0]
                    + whitener[star, row, 1] * off[1]
                    + whitener[star, row, 2] * off[2]
                ) ** 2
    return agreed, matrix, scale, held, inverse, squares


@loop_helper
def _write_normal(
    observed: FloatArray,
    whitener: FloatArray,
    reference: FloatArray,
    late: FloatArray,
    weight: FloatArray,
    matrix: FloatArray,
    scale: float,
    held: FloatArray,
    free_scale: bool,
    normal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the normal matrix (p, p) and the gradient (p,) of the stars without the prior."""
    count, delayed = len(gradient), len(late) > 0
    bends = len(held) - int(delayed)
    bend, seen, predicted = np.zeros(8), np.empty(3), np.empty(3)
    slope, flat = np.empty((3, count)), np.empty(count)
    for k in range(bends):
        bend[k] = held[k]
    normal[:], gradient[:] = 0.0, 0.0
    for star in range(len(observed)):
        _see(observed[star], scale, bend, seen)
        for axis in range(3):
            if delayed:
                seen[axis] -= held[bends] * late[star, axis]
                slope[axis, count - 1] = -late[star, axis]
            predicted[axis] = 0.0
            for k in range(3):
                predicted[axis] += matrix[axis, k] * reference[star, k]
        _write_slopes(seen, predicted, free_scale, bends, slope)
        _add_star(whitener[star], weight[star], seen, predicted, slope, flat, normal, gradient)
    for i in range(count):
        for j in range(i):
            normal[j, i] = normal[i, j]


@loop_helper
def _see(observed: FloatArray, scale: float, bend: FloatArray, seen: FloatArray) -> None:
    """Write the unit vector `observed` (3,), corrected for scale and lens errors, to `seen`."""
    squared, z = scale * scale, observed[2]
    shrink = 1.0 / math.sqrt(squared + (1.0 - squared) * z * z)
    x, y, z = observed[0] * scale * shrink, observed[1] * scale * shrink, z * shrink
    tx, ty = x / z, y / z
    square = tx * tx + ty * ty
    along = bend[0] * tx + bend[1] * ty + (bend[4] + bend[5] * square) * square
    dx = z * (square * bend[2] + tx * bend[6] + ty * bend[7])
    dy = z * (square * bend[3] - ty * bend[6] + tx * bend[7])
    inward = x * dx + y * dy
    seen[0] = x + along * x * z * z + dx - x * inward
    seen[1] = y + along * y * z * z + dy - y * inward
    seen[2] = z - along * z * (x * x + y * y) - z * inward
    size = math.sqrt(seen[0] * seen[0] + seen[1] * seen[1] + seen[2] * seen[2])
    for axis in range(3):
        seen[axis] /= size


@loop_helper
def _write_slopes(
    seen: FloatArray, predicted: FloatArray, scale: bool, bends: int, slope: FloatArray
) -> None:
    """Write derivatives of a residual with respect to rotation, scale and lens errors to `slope` (3, p)."""
    (x, y, z), (px, py, pz) = seen, predicted
    slope[0, 0], slope[0, 1], slope[0, 2] = 0.0, pz, -py
    slope[1, 0], slope[1, 1], slope[1, 2] = -pz, 0.0, px
    slope[2, 0], slope[2, 1], slope[2, 2] = py, -px, 0.0
    tx, ty = x / z, y / z
    square, last = tx * tx + ty * ty, 3
    if scale:
        slope[0, 3], slope[1, 3], slope[2, 3] = x * z * z, y * z * z, z * z * z - z
        last = 4
    for k in range(bends):  # the lens errors are in the order of `bend_slope`
        if k in (0, 1, 4, 5):
            along = (tx, ty, 0.0, 0.0, square, square * square)[k]
            slope[0, last] = along * x * z * z
            slope[1, last] = along * y * z * z
            slope[2, last] = along * (z * z * z - z)
        else:
            dx = z * (0.0, 0.0, square, 0.0, 0.0, 0.0, tx, ty)[k]
            dy = z * (0.0, 0.0, 0.0, square, 0.0, 0.0, -ty, tx)[k]
            inward = x * dx + y * dy
            slope[0, last], slope[1, last], slope[2, last] = dx - x * inward, dy - y * inward, -z * inward
        last += 1


@loop_helper
def _add_star(
    whitener: FloatArray,
    weight: float,
    seen: FloatArray,
    predicted: FloatArray,
    slope: FloatArray,
    flat: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add a star to the lower half of the normal matrix (p, p) and to the gradient (p,)."""
    for row in range(2):
        wx, wy, wz = whitener[row]
        off = wx * (seen[0] - predicted[0]) + wy * (seen[1] - predicted[1]) + wz * (seen[2] - predicted[2])
        for i in range(len(flat)):
            flat[i] = wx * slope[0, i] + wy * slope[1, i] + wz * slope[2, i]
            gradient[i] += weight * flat[i] * off
            for j in range(i + 1):
                normal[i, j] += weight * flat[i] * flat[j]


@loop_helper
def _turn(matrix: FloatArray, turn: FloatArray) -> None:
    """Rotate an attitude matrix (3, 3) in place, as `turned` does."""
    x, y, z = turn[0], turn[1], turn[2]
    angle = math.sqrt(x * x + y * y + z * z)
    first, second = 1.0, 0.5
    if angle > 0.0:
        first, second = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    for j in range(3):
        a, b, c = matrix[0, j], matrix[1, j], matrix[2, j]
        ca, cb, cc = y * c - z * b, z * a - x * c, x * b - y * a
        matrix[0, j] = a - first * ca + second * (y * cc - z * cb)
        matrix[1, j] = b - first * cb + second * (z * ca - x * cc)
        matrix[2, j] = c - first * cc + second * (x * cb - y * ca)


def _without_outliers(seen: _Seen, pose: _FittedPose, squares: FloatArray) -> tuple[_FittedPose, BoolArray]:
    """Return the fit to the stars that agree with each other, and a mask of these stars (n,).

    An outlier affects the residuals of all stars in a fit. The influence of outliers is bounded before the
    scatter of the residuals is computed.
    """
    # One step for each set of weights suffices, because only the residuals of the last fit are used.
    pose, squares = seen.reweighted(pose, squares, _HUBER_ROUNDS)
    # A star agrees with the fit if its residual is within the scatter of the majority of stars.
    # All stars are used if too few stars agree.
    agree = squares <= _FARTHEST * max(1.0, median(squares) / _MEDIAN)
    if np.count_nonzero(agree) < max(_LEAST_AGREEING, len(squares) // 2):
        agree = np.ones(len(squares), dtype=np.bool_)
    return seen.fitted(pose, agree.astype(np.float64)), agree


def _surprise(seen: _Seen, pose: _FittedPose, agree: BoolArray, factor: float) -> float:
    """Return -2 ln of the likelihood of the stars `agree` (n,), with variances multiplied by `factor`."""
    spread = np.linalg.slogdet(factor * seen.covariance[agree])[1]
    return float(np.sum(spread + seen.squares(pose)[agree] / factor))


def _with_scatter(seen: _Seen, pose: _FittedPose, agree: BoolArray) -> tuple[_Seen, _FittedPose, BoolArray]:
    """Return stars, fit and a mask of the stars that agree (n,) after a common variance is added.

    Bright points that disagree with the fit at their own variances possibly agree at the larger variances.
    The common variance is estimated again with all points that agree. Excluded streaks remain excluded.
    """
    own = seen
    for _ in range(_AGREEMENT_ROUNDS):
        seen, pose = _scattered(own, pose, agree)
        within = seen.squares(pose) <= _FARTHEST
        if (
            seen.unknowns.scatter
            or np.array_equal(within, agree)
            or np.count_nonzero(within) < np.count_nonzero(agree)
        ):
            break
        agree = within
    return seen, pose, agree


def _scattered(seen: _Seen, pose: _FittedPose, agree: BoolArray) -> tuple[_Seen, _FittedPose]:
    """Return stars and fit with an added common variance, estimated from the stars in `agree` (n,)."""
    weight, own, variance = agree.astype(np.float64), seen.covariance, 0.0
    for _ in range(_SCATTER_ROUNDS):
        root = np.linalg.cholesky(seen.covariance[agree])
        missed = np.einsum("nij,nj->ni", seen.whitener, seen.missed(pose))[agree]
        excess = float(np.sum(missed**2)) - (2 * len(missed) - seen.parameters(pose))
        if excess <= _EXPLAINED or len(missed) <= _LEAST_AGREEING:
            break
        # The Newton step differentiates chi-square with respect to the common variance, at constant pose.
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
    """Return the attitude from a solver of Wahba's problem for the stars that agree in an image fit.

    The image fit excludes outliers and determines the lens errors. The solver uses the directions of the
    stars that are not outliers, each with one standard deviation for both axes (Michalski, section 3.4). The
    first arguments are those of `fit_in_image`. The displacement of each star per standard deviation of the
    line time is `late` (n, 2), px; (0, 2) if the line time is exact. Raises AttitudeError for too few stars.
    """
    if len(late):
        points = points - fit.delay * late
    seen = bent(stretched(camera.unit_vectors(points), fit.scale), fit.bend)[fit.agree]
    pixels = np.sqrt(0.5 * np.trace(covariance[fit.agree], axis1=1, axis2=2))
    # At an angle a from the boresight, a pixel subtends a radial angle that is proportional to cos^2 a.
    # The tangential angle is proportional to cos a.
    sigma = pixels * fit.scale / camera.focal_length * seen[:, 2] ** 1.5
    fix = solver(seen, reference[fit.agree], sigma)
    # The loss function of a solver is half of the sum of the stars' chi-squares.
    squares = np.full(len(seen), 2.0 * fix.loss / len(seen))
    return replace(fix, covariance=fix.covariance * inflation(squares, 3))
