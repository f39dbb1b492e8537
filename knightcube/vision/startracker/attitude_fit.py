"""Least-squares fits of attitude, scale and radial distortion to matched stars.

`refine` solves Wahba's problem with one more unknown, the scale k, which multiplies all tangents x/z and y/z
to correct the assumed focal length. A Gauss-Newton iteration minimises the residuals e = b(k) - A r, where b
is an observed unit vector, A the attitude matrix and r the unit vector from the catalogue. A small rotation d
about the camera axes and a small change dlnk of ln k change the residual e by -[A r x] d + s dlnk, with s =
(x z^2, y z^2, -z (x^2 + y^2)). The minimum of the sum of |e|^2 / sigma^2 is the maximum likelihood estimate
if sigma, rad, is the standard deviation of a direction along each of the two axes normal to it.

`fit_with_distortion` also fits the radial distortion of an uncalibrated lens. An uncalibrated lens displaces
stars by some per cent of their distance from the axis. A fit without distortion agrees only with a group of
neighbouring stars, and its attitude error is larger than the residuals indicate. A star with the true
field-angle tangent t appears at the tangent t (1 + c (t / R)^2), where R is the tangent of the image corner
(first radial term of Brown 1966). The distortion coefficient c has the prior standard deviation `PRIOR`. The
match starts with the stars that match without distortion, and is extended outwards as the distortion c is
determined. The covariance of the attitude includes the uncertainty of the distortion c.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray, cross_matrices, cross_matrix, median
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import from_matrix
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.startracker.index import SkyIndex


@dataclass(frozen=True, slots=True, eq=False)
class StarField:
    """The observed points of a frame, the brightest first; some points may not be stars.

    Attributes:
        direction: unit vectors to the points (n, 3), camera frame, for the assumed focal length.
        sigma: standard deviation of each direction along one axis (n,), rad.
        half_width: tangents of half the field of view along x and along y (2,).
        scale: lowest and highest possible factor by which the tangents x/z, y/z must be multiplied for the
            true focal length; (1, 1) for a calibrated camera.
        magnitude: instrumental magnitudes of the points (n,), or None if only the order of brightness is
            known.
    """

    direction: FloatArray
    sigma: FloatArray
    half_width: tuple[float, float]
    scale: tuple[float, float] = (1.0, 1.0)
    magnitude: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.direction)

    def rescaled(self, factor: float) -> StarField:
        """Return the field with tangents multiplied by `factor`, and its scale limits divided by `factor`."""
        stretched = self.direction * np.array([factor, factor, 1.0])
        return replace(
            self,
            direction=stretched / np.linalg.norm(stretched, axis=-1, keepdims=True),
            sigma=self.sigma * factor,
            half_width=(self.half_width[0] * factor, self.half_width[1] * factor),
            scale=(self.scale[0] / factor, self.scale[1] / factor),
        )

    def mirrored(self) -> StarField:
        """Return the mirrored field, with left and right swapped about the boresight."""
        return replace(self, direction=self.direction * np.array([-1.0, 1.0, 1.0]))

    def subset(self, chosen: IntArray) -> StarField:
        """Return the field with only the points `chosen` by indices (k,), in the order of the indices."""
        magnitude = None if self.magnitude is None else self.magnitude[chosen]
        return replace(self, direction=self.direction[chosen], sigma=self.sigma[chosen], magnitude=magnitude)


class MatchStatus(Enum):
    """The outcome of an identification of stars."""

    IDENTIFIED = "identified"
    TOO_FEW_STARS = "too-few-stars"
    NO_MATCH = "no-match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class StarMatch:
    """The guide stars assigned to the observed points, and the resulting attitude.

    Attributes:
        status: outcome of the identification; the other attributes are valid for IDENTIFIED only.
        star: index of the guide star of each point (n,); -1 for a point without a guide star.
        fix: attitude from all matched stars, ICRS to camera, with its covariance, or None unless identified.
        scale: factor by which the observed tangents x/z, y/z must be multiplied for the true focal length.
        scale_sigma: standard deviation of the scale; 0 if the scale was given.
        log10_false_alarm: log10 of the probability that random stars match equally well at any attitude; 0 if
            unknown.
        distortion: fitted distortion of the lens: displacement of a star in the image corner, relative to its
            distance from the optical axis; 0 if the stars matched without distortion.
        from_lens: part (3, 3), rad^2, of the covariance of `fix` that is due to the uncertainty of
            `distortion`.
        mirrored: whether the stars were identified in the mirrored field (`StarField.mirrored`). For a
            mirrored field, `fix` is the attitude of the mirrored field.
    """

    status: MatchStatus
    star: IntArray
    fix: AttitudeFix | None = None
    scale: float = 1.0
    scale_sigma: float = 0.0
    log10_false_alarm: float = 0.0
    distortion: float = 0.0
    from_lens: FloatArray | None = None
    mirrored: bool = False


# Rotation step (rad) below which the iteration ends. After a step d, the error is about d^2, or 0.002 arcsec.
_SETTLED = 1e-4
_MOST_STEPS = 6
# Minimum reciprocal condition number of the normal equations.
# Stars within 1e-6 rad of one direction have about this reciprocal condition number.
_LEAST_INFORMATION = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """The attitude and scale of a least-squares fit.

    Attributes:
        matrix: attitude matrix (3, 3) from ICRS to camera axes.
        scale: factor by which the tangents of the observed directions are multiplied.
        covariance: covariance of the rotation about the camera axes (rad) and of ln scale (4, 4), or of the
            rotation alone (3, 3) if the scale was fixed.
        squares: squared residual of each star, divided by the variance of the star's direction (n,).
    """

    matrix: FloatArray
    scale: float
    covariance: FloatArray
    squares: FloatArray

    @property
    def scale_sigma(self) -> float:
        """The relative standard deviation of the scale; 0 if the scale was fixed."""
        return math.sqrt(self.covariance[3, 3]) if len(self.covariance) == 4 else 0.0

    def fix(self) -> AttitudeFix:
        """Return the attitude and its covariance as an `AttitudeFix`, as solvers of Wahba's problem do."""
        turn = np.ascontiguousarray(self.covariance[:3, :3])
        return AttitudeFix(from_matrix(self.matrix), turn, 0.5 * float(self.squares.sum()))

    def widened(self) -> Refinement:
        """Return the fit with its covariance increased if the residuals exceed their standard deviations."""
        factor = inflation(self.squares, len(self.covariance))
        return self if factor == 1.0 else replace(self, covariance=self.covariance * factor)


def stretched(direction: FloatArray, scale: float | FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) with their tangents x/z, y/z multiplied by `scale`, a number or (n,)."""
    if isinstance(scale, float) and scale == 1.0:
        return direction
    z = direction[:, 2]
    # The length of a unit vector whose tangents are multiplied by s is the root of s^2 + (1 - s^2) z^2.
    squared = scale * scale
    shrink = 1.0 / np.sqrt(squared + (1.0 - squared) * (z * z))
    longer = np.empty_like(direction)
    np.multiply(direction[:, :2], (scale * shrink)[:, None], out=longer[:, :2])
    np.multiply(z, shrink, out=longer[:, 2])
    return longer


def scale_slope(direction: FloatArray) -> FloatArray:
    """Return the derivatives (n, 3) of unit vectors (n, 3) with respect to the logarithm of the scale."""
    squared = direction[:, 2:] * direction[:, 2:]
    slope = direction * squared
    slope[:, 2:] -= direction[:, 2:]
    return np.asarray(slope)


def inflation(squares: FloatArray, parameters: float) -> float:
    """Return the factor by which variances must be increased to agree with the residuals of a fit.

    Each of the values `squares` (n,) is the chi-square of one star, which has two components. The sum of the
    squares has a chi-square distribution with 2n - `parameters` degrees of freedom. The returned factor is 1
    if the sum of the squares exceeds its mean by less than three standard deviations.
    """
    freedom = 2 * len(squares) - parameters
    if freedom <= 0:
        return 1.0
    excess = float(squares.sum()) / freedom
    return excess if excess > 1.0 + 3.0 * math.sqrt(2.0 / freedom) else 1.0


def refine(
    observed: FloatArray,
    reference: FloatArray,
    sigma: FloatArray,
    matrix: FloatArray,
    scale: float,
    free_scale: bool,
) -> Refinement | None:
    """Return the attitude and scale that best transform `reference` directions into `observed` directions.

    The unit vectors `observed` (n, 3), camera frame, and their standard deviations `sigma` (n,), rad, are
    given at scale 1. The unit vectors `reference` (n, 3) are ICRS. The fit starts from the attitude matrix
    (3, 3) and the scale, which is fixed unless `free_scale` is true. Returns None if the stars do not
    determine attitude and scale, or if the fit diverges.
    """
    settled, matrix, scale, covariance, squares = _refined(
        np.ascontiguousarray(observed),
        np.ascontiguousarray(reference),
        np.ascontiguousarray(sigma),
        np.ascontiguousarray(matrix),
        float(scale),
        free_scale,
    )
    return Refinement(matrix, scale, covariance, squares) if settled else None


_Refined = tuple[bool, FloatArray, float, FloatArray, FloatArray]


def _refined_numpy(
    observed: FloatArray,
    reference: FloatArray,
    sigma: FloatArray,
    matrix: FloatArray,
    scale: float,
    free_scale: bool,
) -> _Refined:
    """Return a flag of convergence, and the four attributes of the resulting `Refinement`."""
    parameters = 4 if free_scale else 3
    weight = (1.0 / (sigma * scale))[:, None]
    # A row contains a star's weighted prediction, residual and derivative with respect to ln scale.
    # All terms of the normal equations are elements of the Gram matrix (9, 9) of the rows.
    rows = np.zeros((len(observed), 9))
    normal = np.zeros((parameters, parameters))
    failed = False, matrix, scale, np.zeros((parameters, parameters)), np.zeros(len(observed))
    for _ in range(_MOST_STEPS):
        b = stretched(observed, scale)
        predicted = reference @ matrix.T
        np.multiply(predicted, weight, out=rows[:, :3])
        np.multiply(b - predicted, weight, out=rows[:, 3:6])
        if free_scale:
            np.multiply(scale_slope(b), weight, out=rows[:, 6:])
        gradient = _write_normal((rows.T @ rows).tolist(), normal)
        try:
            covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        except np.linalg.LinAlgError:
            return failed
        step = -(covariance @ gradient)
        longest = float(np.abs(step).max())
        # The product of the largest elements of a matrix and its inverse approximates the condition number.
        condition = float(normal.max()) * float(covariance.max()) * _LEAST_INFORMATION
        if not 0.0 < condition < 1.0 or not longest < 1.0:
            return failed
        matrix = turned(matrix, step[:3])
        if free_scale:
            scale *= math.exp(float(step[3]))
        if longest < _SETTLED:
            break
    # The residuals after the last step are computed from the linearised equations.
    left = rows[:, 3:6] + rows[:, :3] @ cross_matrix(step[:3]).T
    if free_scale:
        left += step[3] * rows[:, 6:]
    return True, matrix, scale, covariance, np.einsum("ij,ij->i", left, left)


def _write_normal(gram: list[list[float]], normal: FloatArray) -> list[float]:
    """Write the normal matrix (p, p) from the Gram matrix of the rows (9, 9); return the gradient (p,)."""
    trace = gram[0][0] + gram[1][1] + gram[2][2]
    gradient = _summed_cross(gram, 3)
    for i in range(3):
        for j in range(3):
            normal[i, j] = (trace if i == j else 0.0) - gram[i][j]
    if len(normal) == 4:
        normal[3, :3] = normal[:3, 3] = _summed_cross(gram, 6)
        normal[3, 3] = gram[6][6] + gram[7][7] + gram[8][8]
        gradient.append(gram[3][6] + gram[4][7] + gram[5][8])
    return gradient


@compiled_form_of(_refined_numpy)
def _refined(
    observed: FloatArray,
    reference: FloatArray,
    sigma: FloatArray,
    matrix: FloatArray,
    scale: float,
    free_scale: bool,
) -> _Refined:
    parameters = 4 if free_scale else 3
    weight = 1.0 / (sigma * scale)
    failed = False, matrix, scale, np.zeros((parameters, parameters)), np.zeros(len(observed))
    matrix = matrix.copy()
    rows = np.zeros((len(observed), 9))
    step, squares = np.zeros(4), np.zeros(len(observed))
    covariance = np.zeros((parameters, parameters))
    for _ in range(_MOST_STEPS):
        _fill_rows(observed, reference, weight, matrix, scale, rows)
        normal, gradient = _normal_equations(rows)
        information = 0.0
        for i in range(parameters):
            for j in range(parameters):
                information = max(information, normal[i, j])
        if not _inverted(normal, covariance):
            return failed
        largest, longest = 0.0, 0.0
        for i in range(parameters):
            step[i] = 0.0
            for j in range(parameters):
                step[i] -= covariance[i, j] * gradient[j]
                largest = max(largest, covariance[i, j])
            longest = max(longest, abs(step[i]))
        if not 0.0 < information * largest * _LEAST_INFORMATION < 1.0 or not longest < 1.0:
            return failed
        _turn(matrix, step)
        if free_scale:
            scale *= math.exp(step[3])
        if longest < _SETTLED:
            break
    for k in range(len(observed)):
        px, py, pz, ex, ey, ez, sx, sy, sz = rows[k]
        ex += step[1] * pz - step[2] * py + step[3] * sx
        ey += step[2] * px - step[0] * pz + step[3] * sy
        ez += step[0] * py - step[1] * px + step[3] * sz
        squares[k] = ex * ex + ey * ey + ez * ez
    return True, matrix, scale, covariance, squares


@loop_helper
def _fill_rows(
    observed: FloatArray,
    reference: FloatArray,
    weight: FloatArray,
    matrix: FloatArray,
    scale: float,
    rows: FloatArray,
) -> None:
    """Write weighted predictions, residuals and derivatives with respect to ln scale to `rows` (n, 9)."""
    squared = scale * scale
    for k in range(len(observed)):
        z, w = observed[k, 2], weight[k]
        shrink = 1.0 / math.sqrt(squared + (1.0 - squared) * z * z)
        bx, by, bz = observed[k, 0] * scale * shrink, observed[k, 1] * scale * shrink, z * shrink
        for i in range(3):
            rows[k, i] = w * (
                matrix[i, 0] * reference[k, 0]
                + matrix[i, 1] * reference[k, 1]
                + matrix[i, 2] * reference[k, 2]
            )
        rows[k, 3], rows[k, 4], rows[k, 5] = (w * bx - rows[k, 0], w * by - rows[k, 1], w * bz - rows[k, 2])
        rows[k, 6], rows[k, 7], rows[k, 8] = w * bx * bz * bz, w * by * bz * bz, w * (bz * bz * bz - bz)


@loop_helper
def _normal_equations(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix (4, 4) and the gradient (4,) of rotation and ln scale."""
    normal, gradient = np.zeros((4, 4)), np.zeros(4)
    for k in range(len(rows)):
        px, py, pz, ex, ey, ez, sx, sy, sz = rows[k]
        normal[0, 0] += py * py + pz * pz
        normal[1, 1] += px * px + pz * pz
        normal[2, 2] += px * px + py * py
        normal[0, 1] -= px * py
        normal[0, 2] -= px * pz
        normal[1, 2] -= py * pz
        normal[0, 3] += py * sz - pz * sy
        normal[1, 3] += pz * sx - px * sz
        normal[2, 3] += px * sy - py * sx
        normal[3, 3] += sx * sx + sy * sy + sz * sz
        gradient[0] += py * ez - pz * ey
        gradient[1] += pz * ex - px * ez
        gradient[2] += px * ey - py * ex
        gradient[3] += ex * sx + ey * sy + ez * sz
    for i in range(4):
        for j in range(i):
            normal[i, j] = normal[j, i]
    return normal, gradient


@loop_helper
def _inverted(normal: FloatArray, inverse: FloatArray) -> bool:
    """Write the inverse of the leading (p, p) block of `normal` into `inverse`, and overwrite `normal`.

    Returns whether the block is regular. Gauss-Jordan elimination without pivoting is stable, because the
    matrix is positive definite.
    """
    count = len(inverse)
    inverse[:] = 0.0
    for i in range(count):
        inverse[i, i] = 1.0
    for i in range(count):
        pivot = normal[i, i]
        if not pivot > 0.0:
            return False
        for j in range(count):
            normal[i, j] /= pivot
            inverse[i, j] /= pivot
        for k in range(count):
            if k != i:
                factor = normal[k, i]
                for j in range(count):
                    normal[k, j] -= factor * normal[i, j]
                    inverse[k, j] -= factor * inverse[i, j]
    return True


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


def _summed_cross(gram: list[list[float]], at: int) -> list[float]:
    """Return the sum of p x q over the stars. In each row, p is in columns 0 to 2, and q begins at `at`."""
    return [gram[1][at + 2] - gram[2][at + 1], gram[2][at] - gram[0][at + 2], gram[0][at + 1] - gram[1][at]]


def turned(matrix: FloatArray, turn: FloatArray) -> FloatArray:
    """Return the attitude matrix (3, 3) after a rotation `turn` (3,), rad, about the camera axes."""
    x, y, z = turn.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    first = math.sin(angle) / angle if angle > 0.0 else 1.0
    second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 0.0 else 0.5
    cross = cross_matrix(turn)
    return np.asarray(matrix - (first * cross - second * (cross @ cross)) @ matrix)


PRIOR = 0.05
"""Prior standard deviation of an uncalibrated lens's distortion, as a fraction of the corner's radius."""
_MOST = 0.25
_GROWTH_ROUNDS = 12
_DISTORTION_STEPS = 6
_DISTORTION_SETTLED = 1e-6
# Half-width of the gate within which a star matches a guide star, in standard deviations of its position.
_GATE_SIGMAS = 8.0
# Minimum half-width of the gate within which a star matches a guide star, relative to the corner's tangent.
_GATE_SHARE = 0.004
# Residual above which a star is excluded from the final fit, in standard deviations of the residuals.
_OUTLIER = 4.0
# Median of the square root of chi-square with 2 degrees of freedom (the Rayleigh distribution).
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True, slots=True, eq=False)
class DistortedFit:
    """The matched stars and the attitude of a camera with a distorted lens.

    Attributes:
        observed: indices of the observed points that match guide stars (k,).
        star: indices of the guide stars that the points match (k,).
        refined: attitude and scale, with a covariance that is increased if the residuals are too large.
        distortion: radial distortion: displacement of a star in the image corner, relative to its distance
            from the optical axis.
        seen: unit vectors to all observed points, corrected for the distortion (n, 3), camera frame.
        from_lens: part (3, 3), rad^2, of the attitude covariance that is due to the uncertainty of the
            distortion.
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
    """Return a match extended to the stars that match only if the distortion of the lens is fitted.

    The points `observed` (k,) match the guide stars `star` (k,) without distortion at the attitude `start`.
    The guide stars `expected` are in and around the field, the brightest first. Returns None if the matched
    stars do not determine the distortion.
    """
    corner = math.hypot(*field.half_width)
    pose = _DistortedPose(start.matrix, start.scale, 0.0)
    points = np.ascontiguousarray(field.direction), np.ascontiguousarray(field.sigma)
    reference = sky.stars.direction[expected]
    seen: set[bytes] = set()
    fitted = None
    for _ in range(_GROWTH_ROUNDS):
        fitted = _distorted_fit(field, sky, observed, star, pose, corner)
        if fitted is None:
            return None
        pose = fitted[0]
        if observed.tobytes() in seen:
            break
        seen.add(observed.tobytes())
        within, nearest = _agreeing(
            *points, reference, np.ascontiguousarray(pose.matrix), pose.scale, pose.distortion, corner
        )
        if len(within) < len(observed):
            break
        observed, star = within, expected[nearest]
    assert fitted is not None  # the loop runs at least once
    squares = fitted[2]
    spread = max(1.0, math.sqrt(median(squares)) / _RAYLEIGH_MEDIAN)
    kept = squares <= (_OUTLIER * spread) ** 2
    if kept.sum() >= 4 and not kept.all():
        observed, star = observed[kept], star[kept]
        fitted = _distorted_fit(field, sky, observed, star, pose, corner)
        if fitted is None:
            return None
    pose, normal, squares = fitted
    # Residuals that are too large increase the covariance from the stars, but not the variance of the prior.
    normal[4, 4] -= PRIOR**-2
    normal /= inflation(squares, 5)
    normal[4, 4] += PRIOR**-2
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    from_lens = np.outer(covariance[:3, 4], covariance[:3, 4]) / covariance[4, 4]
    refined = Refinement(pose.matrix, pose.scale, covariance[:4, :4], squares)
    seen_by = pose.true(field.direction, corner)
    return DistortedFit(observed, star, refined, pose.distortion, seen_by, from_lens)


def _agreeing_numpy(
    direction: FloatArray,
    sigma: FloatArray,
    reference: FloatArray,
    matrix: FloatArray,
    scale: float,
    distortion: float,
    corner: float,
) -> tuple[IntArray, IntArray]:
    """Return the indices (k,) of points that match guide stars, and those (k,) of the stars in `reference`.

    A point and a guide star match if they are nearest to each other and within the gate.
    """
    cosines = _true_numpy(direction, scale, distortion, corner) @ (matrix @ reference.T)
    nearest = cosines.argmax(axis=1)
    rows = np.arange(len(direction))
    apart = np.sqrt(np.maximum(2.0 - 2.0 * cosines[rows, nearest], 0.0))
    gate = np.maximum(_GATE_SIGMAS * sigma, _GATE_SHARE * corner) * scale
    within = np.flatnonzero((apart <= gate) & (cosines.argmax(axis=0)[nearest] == rows))
    return within, nearest[within]


@compiled_form_of(_agreeing_numpy)
def _agreeing(
    direction: FloatArray,
    sigma: FloatArray,
    reference: FloatArray,
    matrix: FloatArray,
    scale: float,
    distortion: float,
    corner: float,
) -> tuple[IntArray, IntArray]:
    """See `_agreeing_numpy`."""
    points, stars = len(direction), len(reference)
    nearest, closest = np.zeros(points, dtype=np.int64), np.full(points, -2.0)
    owner, true, cosine = np.zeros(stars, dtype=np.int64), np.empty((3, points)), np.empty(points)
    for k in range(points):
        _write_true(direction[k], scale, distortion, corner, true[:, k])
    for star in range(stars):
        x, y, z = _rotated(matrix, reference[star])
        for k in range(points):
            cosine[k] = x * true[0, k] + y * true[1, k] + z * true[2, k]
        best = -2.0
        for k in range(points):
            if cosine[k] > best:
                best, owner[star] = cosine[k], k
            if cosine[k] > closest[k]:
                closest[k], nearest[k] = cosine[k], star
    within, matched, count = np.empty(points, dtype=np.int64), np.empty(points, dtype=np.int64), 0
    for k in range(points):
        gate = max(_GATE_SIGMAS * sigma[k], _GATE_SHARE * corner) * scale
        if max(2.0 - 2.0 * closest[k], 0.0) <= gate * gate and owner[nearest[k]] == k:
            within[count], matched[count] = k, nearest[k]
            count += 1
    return within[:count].copy(), matched[:count].copy()


@loop_helper
def _rotated(matrix: FloatArray, vector: FloatArray) -> tuple[float, float, float]:
    """Return the product of a matrix (3, 3) and a vector (3,)."""
    x, y, z = vector
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _DistortedPose:
    """The attitude matrix (3, 3), scale and radial distortion of a camera."""

    matrix: FloatArray
    scale: float
    distortion: float

    def true(self, direction: FloatArray, corner: float) -> FloatArray:
        """Return observed unit vectors (n, 3) corrected for scale and distortion."""
        return _true(np.ascontiguousarray(direction), float(self.scale), float(self.distortion), corner)

    def ratio(self, direction: FloatArray, corner: float) -> FloatArray:
        """Return the ratios r (n,) of true to observed tangents.

        The ratio r of a star solves r (1 + c s^2 r^2) = 1, where c is the distortion and s is the observed
        tangent divided by the corner's tangent.
        """
        squared = self.distortion * _squared_tangent(direction) / corner**2
        ratio = np.ones(len(direction))
        for _ in range(4):
            ratio -= (ratio * (1.0 + squared * ratio**2) - 1.0) / (1.0 + 3.0 * squared * ratio**2)
        return ratio


def _true_numpy(direction: FloatArray, scale: float, distortion: float, corner: float) -> FloatArray:
    """Return observed unit vectors (n, 3) corrected for scale and distortion."""
    pose = _DistortedPose(np.eye(3), scale, distortion)
    return stretched(direction, scale * pose.ratio(direction, corner))


@compiled_form_of(_true_numpy)
def _true(direction: FloatArray, scale: float, distortion: float, corner: float) -> FloatArray:
    """See `_true_numpy`."""
    out = np.empty_like(direction)
    for k in range(len(direction)):
        _write_true(direction[k], scale, distortion, corner, out[k])
    return out


@loop_helper
def _write_true(
    direction: FloatArray, scale: float, distortion: float, corner: float, out: FloatArray
) -> None:
    """Write an observed unit vector (3,), corrected for scale and distortion, to `out` (3,)."""
    x, y, z = direction
    factor = scale * _ratio(distortion * (x * x + y * y) / (z * z * corner * corner))
    shrink = 1.0 / math.sqrt(factor * factor + (1.0 - factor * factor) * z * z)
    out[0], out[1], out[2] = x * factor * shrink, y * factor * shrink, z * shrink


@loop_helper
def _ratio(squared: float) -> float:
    """Return the ratio of true to observed tangent (see `_DistortedPose.ratio`)."""
    ratio = 1.0
    for _ in range(4):
        ratio -= (ratio * (1.0 + squared * ratio * ratio) - 1.0) / (1.0 + 3.0 * squared * ratio * ratio)
    return ratio


def _squared_tangent(direction: FloatArray) -> FloatArray:
    return np.asarray((direction[:, 0] ** 2 + direction[:, 1] ** 2) / direction[:, 2] ** 2)


def _distorted_fit(
    field: StarField, sky: SkyIndex, observed: IntArray, star: IntArray, pose: _DistortedPose, corner: float
) -> tuple[_DistortedPose, FloatArray, FloatArray] | None:
    """Return a fit of attitude, scale and distortion, its normal matrix (5, 5) and chi-squares (k,).

    The normal matrix includes the prior of the distortion. There is one chi-square for each matched star.
    """
    direction, reference = field.direction[observed], sky.stars.direction[star]
    weight = 1.0 / (field.sigma[observed] * pose.scale)
    start = np.ascontiguousarray(pose.matrix), float(pose.scale), float(pose.distortion)
    try:
        settled, matrix, scale, distortion, normal, squares = _fit_distorted(
            direction, reference, weight, *start, corner
        )
    except np.linalg.LinAlgError:
        return None
    return (_DistortedPose(matrix, scale, distortion), normal, squares) if settled else None


_Distorted = tuple[bool, FloatArray, float, float, FloatArray, FloatArray]


def _fit_distorted_numpy(
    direction: FloatArray,
    reference: FloatArray,
    weight: FloatArray,
    matrix: FloatArray,
    scale: float,
    distortion: float,
    corner: float,
) -> _Distorted:
    """Return a flag of convergence, matrix, scale, distortion, normal matrix and chi-squares (n,).

    Raises LinAlgError if the normal matrix is singular.
    """
    pose = _DistortedPose(matrix, scale, distortion)
    for _ in range(_DISTORTION_STEPS):
        ratio = pose.ratio(direction, corner)
        seen = stretched(direction, pose.scale * ratio)
        predicted = reference @ pose.matrix.T
        residual = weight[:, None] * (seen - predicted)
        slope = np.empty((len(seen), 3, 5))
        # A rotation d changes the prediction A r by -[d x] A r = [A r x] d, and the residual by -[A r x] d.
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
        step = -np.linalg.solve(normal, gradient)
        distortion = pose.distortion + float(step[4])
        if not float(np.abs(step).max()) < 1.0 or abs(distortion) > _MOST:
            return False, pose.matrix, pose.scale, pose.distortion, normal, np.zeros(len(weight))
        turn = np.asarray(step[:3], dtype=np.float64)
        pose = _DistortedPose(turned(pose.matrix, turn), pose.scale * math.exp(float(step[3])), distortion)
        if np.abs(step).max() < _DISTORTION_SETTLED:
            break
    missed = weight[:, None] * (pose.true(direction, corner) - reference @ pose.matrix.T)
    squares = np.einsum("ij,ij->i", missed, missed)
    return True, pose.matrix, pose.scale, pose.distortion, np.asarray(normal), squares


@compiled_form_of(_fit_distorted_numpy)
def _fit_distorted(
    direction: FloatArray,
    reference: FloatArray,
    weight: FloatArray,
    matrix: FloatArray,
    scale: float,
    distortion: float,
    corner: float,
) -> _Distorted:
    """See `_fit_distorted_numpy`."""
    matrix, slope, off = matrix.copy(), np.zeros((3, 5)), np.empty(3)
    normal, gradient, step = np.empty((5, 5)), np.empty(5), np.empty(5)
    squares = np.zeros(len(direction))
    for _ in range(_DISTORTION_STEPS):
        normal[:], gradient[:] = 0.0, 0.0
        for star in range(len(direction)):
            _write_distorted(direction[star], reference[star], matrix, scale, distortion, corner, slope, off)
            squared = weight[star] * weight[star]
            for i in range(5):
                for axis in range(3):
                    gradient[i] += squared * slope[axis, i] * off[axis]
                    for j in range(5):
                        normal[i, j] += squared * slope[axis, i] * slope[axis, j]
        normal[4, 4] += PRIOR**-2
        gradient[4] += distortion / PRIOR**2
        inverse = np.linalg.inv(normal)  # `np.linalg.solve` would take twice as long to compile
        for i in range(5):
            step[i] = 0.0
            for j in range(5):
                step[i] -= inverse[i, j] * gradient[j]
        longest = float(np.abs(step).max())
        if not longest < 1.0 or abs(distortion + step[4]) > _MOST:
            return False, matrix, scale, distortion, normal, squares
        _turn(matrix, step)
        scale *= math.exp(step[3])
        distortion += step[4]
        if longest < _DISTORTION_SETTLED:
            break
    for star in range(len(direction)):
        _write_distorted(direction[star], reference[star], matrix, scale, distortion, corner, slope, off)
        for axis in range(3):
            squares[star] += (weight[star] * off[axis]) ** 2
    return True, matrix, scale, distortion, normal, squares


@loop_helper
def _write_distorted(
    direction: FloatArray,
    reference: FloatArray,
    matrix: FloatArray,
    scale: float,
    distortion: float,
    corner: float,
    slope: FloatArray,
    off: FloatArray,
) -> None:
    """Write the residual of one star (3,) to `off`, and its derivatives (3, 5) to `slope`, not weighted."""
    x, y, z = direction
    tangent = (x * x + y * y) / (z * z * corner * corner)
    ratio = _ratio(distortion * tangent)
    factor = scale * ratio
    shrink = 1.0 / math.sqrt(factor * factor + (1.0 - factor * factor) * z * z)
    x, y, z = x * factor * shrink, y * factor * shrink, z * shrink
    px, py, pz = _rotated(matrix, reference)
    off[0], off[1], off[2] = x - px, y - py, z - pz
    slope[0, 1], slope[0, 2] = pz, -py
    slope[1, 0], slope[1, 2] = -pz, px
    slope[2, 0], slope[2, 1] = py, -px
    slope[0, 3], slope[1, 3], slope[2, 3] = x * z * z, y * z * z, z * z * z - z
    share = tangent * ratio * ratio
    for axis in range(3):
        slope[axis, 4] = -slope[axis, 3] * share / (1.0 + 3.0 * distortion * share)
