"""Mean body rate over one exposure from the ends of the star streaks (Sease, chapters 3 and 4, corrected).

The order of the two ends of a streak is initially unknown. All stars rotate about a common axis a, so that
a.(v2 - v1) = 0 for the end directions v1 and v2 of each streak. The axis is determined, up to its sign, as
the direction that is most nearly perpendicular to all chords v2 - v1. The sign of a.(v1 x v2) then determines
the order of the ends (Sease, eq. 3.17-3.19, corrected). Unlike a computation with the projected centre of
rotation, the computation with unit vectors has no singularity. The rotation is computed by OLAE, and outliers
are rejected by means of a robust, median-based standard deviation of the residuals. In contrast, the
"Combined Indicator" of Sease uses the ordinary standard deviation of the residuals, which is increased by
outliers. A single frame cannot distinguish the rate omega from -omega, so the sign must be determined from a
prior rate.

The corner detectors compute the cornerness of each pixel in an image region (Sease, eq. 3.1-3.13). The Harris
response and the structure tensor are computed by `knightcube.vision.objects.streak_ends`. The detector of
Trajkovic and Hedley (Fast corner detection, Image and Vision Computing 16, 1998) uses the diameters of a
small circle around a pixel. At a corner of an image region, the intensity changes along every diameter of the
circle. The cornerness is therefore the minimum, over all directions, of the sum of the squared intensity
changes from the centre to both ends of a diameter. Between the ends of two neighbouring diameters, the
intensity is interpolated linearly with a parameter t from 0 to 1. With the squared changes r and r' along two
neighbouring diameters, the squared change between the diameters is A t^2 + 2 B t + C with C = r and
A = r' - r - 2B. The coefficient B is a sum of two terms. Each term belongs to two neighbouring ends, one of
each diameter. The coefficient B1 printed in Sease, eq. 3.12, is corrected, because it combines the wrong
pairs of ends.

The attitudes at the start and end of the exposure follow from identified streaks (Sease, eq. 3.22-3.29). The
stars are identified by the midpoints of the streaks, which do not depend on a constant bias of the ends. The
ESOQ2 solver computes both attitudes from the ends of the streaks. A fixed star moves as v' = -omega x v, so
that Delta = A_end A_start^T = exp(-[omega T x]), and the rotation axis follows from Delta^T - Delta (Sease,
eq. 3.24, 3.26 and 3.27, corrected). The angle is computed from the quaternion, because the arc cosine of the
trace (Sease, eq. 3.25) is inaccurate for small angles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray, Image, cross_matrices
from knightcube.astro.attitude.solvers import SOLVERS, OlaeSolution, gain, rotation_between
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import KnightCubeError
from knightcube.reference.corner_streaks import StreakResult, StreakSettings
from knightcube.vision.background import MAD_TO_SIGMA
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.frame import saturation_level
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.streak_ends import (
    Regions,
    Streaks,
    StructureTensor,
    chord_outward,
    extend,
    harris_cornerness,
    measure_streaks,
    segment_frame,
    smoothed,
    tensor_of,
)
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    SolveSettings,
    SolveStatus,
    solve_places,
)
from knightcube.vision.startracker.survey import FrameKind
from knightcube.vision.streaks.streak_result import StreakStatus, admit, in_time, validate

# Number of the strongest streaks. Each pair of these streaks gives a candidate of the rotation axis.
_MOST_PROPOSERS = 24
_PARALLEL = 1e-12
# Minimum fraction of the measured streaks that must agree with the rotation.
_LEAST_AGREEMENT = 0.5
# Lower limit of the robust standard deviation of the residuals, relative to the expected errors.
_LEAST_SCALE = 0.3
_MOST_ROUNDS = 10


def estimate_rate(
    pixels: Image,
    pinhole: Pinhole,
    exposure: float,
    settings: StreakSettings,
    prior_rate: FloatArray | None = None,
    prior_sigma: float = 0.0,
    previous_checksum: int | None = None,
) -> StreakResult:
    """Return the mean body rate over one exposure from the star streaks in an image.

    Args:
        pixels: (rows, columns) raw pixel values of an unsigned integer type.
        pinhole: model of the camera.
        exposure: exposure time, s.
        settings: settings of the estimation.
        prior_rate: (3,) prior rate in camera axes, rad/s, which determines only the sense of rotation, or
            None.
        prior_sigma: standard deviation of each component of the prior rate, rad/s.
        previous_checksum: checksum of the previous frame, by which a frozen camera is detected, or None.

    Raises KnightCubeError for an invalid frame, exposure or prior. A failed estimation is reported by the
    status of the result.
    """
    validate(pixels, pinhole, exposure, prior_rate, prior_sigma)
    saturation = saturation_level(pixels, settings.saturation)
    checksum, unusable = admit(pixels, previous_checksum, saturation, settings.saturated_fraction)
    if unusable is not None:
        return StreakResult(unusable, checksum, exposure)
    segmented = segment_frame(pixels, settings)
    seen = StreakResult(StreakStatus.FAILED, checksum, exposure, hot_pixels=segmented.hot_pixels)
    streaks = measure_streaks(segmented, settings, cornerness)
    result = _rate(streaks, pinhole, exposure, settings, seen)
    if result.rate is not None:
        return in_time(result, prior_rate, prior_sigma, settings.sign_sigmas)
    typical = _typical_length(segmented.regions, settings)
    if typical < settings.least_length:
        # Most streaks are very short, so that apparent long streaks are blends of several stars.
        return replace(result, status=StreakStatus.TOO_SHORT, length=typical)
    return result


def _rate(
    streaks: Streaks, pinhole: Pinhole, exposure: float, settings: StreakSettings, seen: StreakResult
) -> StreakResult:
    """Return the result `seen` with the rate, whose sign is unknown, or with the status of a failure."""
    seen = replace(
        seen,
        endpoints=streaks.endpoints,
        sigma=streaks.sigma,
        used=np.zeros(len(streaks), dtype=np.bool_),
        length=float(np.median(streaks.lengths)) if len(streaks) else float("nan"),
    )
    if len(streaks) < settings.least_streaks:
        return replace(seen, status=StreakStatus.TOO_FEW)
    fit = fit_rotation(streaks.endpoints, streaks.sigma, pinhole, settings)
    if fit is None or fit.residual * pinhole.focal_length > settings.worst_residual:
        return seen
    ends = fit.endpoints[fit.used]
    length = float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)))
    if length < settings.least_length:
        return replace(seen, status=StreakStatus.TOO_SHORT, length=length)
    return replace(
        seen,
        status=StreakStatus.AMBIGUOUS,
        length=length,
        endpoints=fit.endpoints,
        used=fit.used,
        rate=fit.rotation_vector / exposure,
        covariance=fit.covariance / exposure**2,
        residual=fit.residual,
    )


def _typical_length(regions: Regions, settings: StreakSettings) -> float:
    """Return the median length (px) of the brightest regions, or infinity for too few regions."""
    if len(regions) < settings.least_streaks:
        return float("inf")
    brightest = np.argsort(-regions.flux, kind="stable")[: settings.most_streaks]
    return float(np.median(regions.length[brightest]))


def rotation_axis(
    first: FloatArray, second: FloatArray, tolerance: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the rotation axis (3,) with which most streaks agree, and flags (n,) of the agreeing streaks.

    The unit vectors `first` and `second` (n, 3) point to the ends of each streak, the strongest streak first,
    and `tolerance` (n,) is the tolerated error of each chord's direction, rad. The sign of the rotation axis
    is arbitrary. Each pair of streaks defines a rotation axis. The axis with which most streaks agree is
    refined by least squares over the streaks that agree. Up to about half of the streaks may be outliers. No
    random numbers are used. Raises ValueError for fewer than two streaks.
    """
    if len(first) < 2:
        raise ValueError(f"a rotation axis needs at least two streaks, not {len(first)}")
    chord = second - first
    chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    i, j = np.triu_indices(min(len(chord), _MOST_PROPOSERS), k=1)
    proposal = np.cross(chord[i], chord[j])
    size = np.linalg.norm(proposal, axis=-1, keepdims=True)
    proposal = proposal / np.maximum(size, _PARALLEL)
    missed = np.minimum((proposal @ chord.T / tolerance) ** 2, 1.0).sum(axis=-1)
    # Parallel chords are excluded, because their zero cross product would agree with all streaks.
    missed[size[:, 0] < _PARALLEL] = np.inf
    axis = proposal[np.argmin(missed)]
    for _ in range(3):
        agree = np.abs(chord @ axis) <= tolerance
        if np.count_nonzero(agree) < 2:
            break
        axis = np.linalg.svd(chord[agree] / tolerance[agree, None])[2][-1]
    return axis, np.asarray(np.abs(chord @ axis) <= tolerance)


def rotation_angles(first: FloatArray, second: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the rotation angles (n,), rad, about an axis (3,) between the two ends (n, 3) of each streak.

    Streaks with the same sign of the angle have the same order of ends (Sease, eq. 3.19, corrected).
    """
    sine = np.cross(first, second) @ axis
    cosine = np.sum(first * second, axis=-1) - (first @ axis) * (second @ axis)
    return np.asarray(np.arctan2(sine, cosine))


@dataclass(frozen=True, slots=True)
class RotationFit:
    """Rotation of the camera over one exposure, with unknown sign.

    Attributes:
        rotation_vector: (3,) rotation vector from the first ends to the second ends in camera axes, rad.
        covariance: (3, 3) covariance of the rotation vector, rad^2.
        endpoints: (n, 2, 2) end positions, corrected for bias and consistently ordered, px.
        used: (n,) whether each streak is used in the fit of the rotation.
        residual: RMS error of a streak end, rad, computed from the residuals of the used streaks (Sease, eq.
            4.7).
    """

    rotation_vector: FloatArray
    covariance: FloatArray
    endpoints: FloatArray
    used: BoolArray
    residual: float


def fit_rotation(
    raw: FloatArray, sigma: FloatArray, pinhole: Pinhole, settings: StreakSettings
) -> RotationFit | None:
    """Return the rotation with which most streaks agree.

    The endpoints `raw` (n, 2, 2), px, are not corrected for bias and have the expected errors `sigma` (n,),
    px. The strongest streak is the first. Returns None unless half of the streaks and at least
    `least_streaks` agree.
    """
    needed = max(settings.least_streaks, _LEAST_AGREEMENT * len(raw))
    outward = chord_outward(raw)
    swapped, used = _consensus(extend(raw, outward, settings.endpoint_bias), sigma, pinhole, settings)
    raw = np.where(swapped[:, None, None], raw[:, ::-1], raw)
    outward = chord_outward(raw)
    errors = np.sqrt(2.0) * sigma / pinhole.focal_length
    # The bias of the ends is corrected along the chords in the first pass, and in the second pass along the
    # stars' arcs, which follow from the rotation of the first pass.
    for _ in range(2):
        if np.count_nonzero(used) < needed:
            return None
        endpoints = extend(raw, outward, settings.endpoint_bias)
        vectors = pinhole.unit_vectors(endpoints)
        try:
            solution, used = _reject_and_solve(vectors, errors, used, settings)
        except np.linalg.LinAlgError:
            return None
        # Outward image directions (n, 2, 2) along the star's arc at both ends of each streak.
        v = pinhole.unit_vectors(raw)
        velocity = -np.cross(solution.rotation_vector, v)
        image = velocity[..., :2] * v[..., 2:] - v[..., :2] * velocity[..., 2:]
        outward = image * np.array([-1.0, 1.0])[:, None]
    if np.count_nonzero(used) < needed:
        return None
    covariance = _covariance(solution, vectors[used], errors[used], pinhole, settings)
    residual = float(np.sqrt(0.5 * np.mean(np.sum(solution.residuals**2, axis=-1))))
    return RotationFit(solution.rotation_vector, covariance, endpoints, used, residual)


def _consensus(
    endpoints: FloatArray, sigma: FloatArray, pinhole: Pinhole, settings: StreakSettings
) -> tuple[BoolArray, BoolArray]:
    """Return flags (n,) of the streaks with reversed ends, and flags (n,) of the streaks that agree."""
    vectors = pinhole.unit_vectors(endpoints)
    length = np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=-1)
    allowed = np.maximum(settings.axis_tolerance, settings.outlier_sigmas * sigma)
    axis, agree = rotation_axis(vectors[:, 0], vectors[:, 1], allowed / length)
    angle = rotation_angles(vectors[:, 0], vectors[:, 1], axis)
    size = np.abs(angle)
    common = np.median(size[agree]) if agree.any() else np.nan
    # The tolerance is doubled, because both ends have errors and the axis may be inaccurate.
    agree &= np.abs(size - common) * length <= 2.0 * allowed * size
    return np.asarray(angle < 0.0), np.asarray(agree)


def _reject_and_solve(
    vectors: FloatArray, errors: FloatArray, used: BoolArray, settings: StreakSettings
) -> tuple[OlaeSolution, BoolArray]:
    """Return the rotation and flags (n,) of the used streaks after iterative rejection of outliers.

    In each iteration, streaks are rejected, or accepted again, according to their residuals, until the set of
    used streaks remains the same. Raises numpy.linalg.LinAlgError if the used streaks do not determine a
    rotation.
    """
    weights = 1.0 / errors**2
    solution = rotation_between(vectors[used, 0], vectors[used, 1], weights[used])
    for _ in range(_MOST_ROUNDS):
        z = np.stack(_components(vectors, solution)) / errors
        scale = np.maximum(MAD_TO_SIGMA * np.median(np.abs(z[:, used]), axis=1), _LEAST_SCALE)
        kept = np.all(np.abs(z) <= settings.outlier_sigmas * scale[:, None], axis=0)
        if np.array_equal(kept, used):
            break
        used = kept
        solution = rotation_between(vectors[used, 0], vectors[used, 1], weights[used])
    return solution, used


def _components(vectors: FloatArray, solution: OlaeSolution) -> tuple[FloatArray, FloatArray]:
    """Return the OLAE residuals, rad, along the motion of each streak (n,) and across the motion (n,)."""
    starts, ends = vectors[:, 0], vectors[:, 1]
    residual = np.cross(starts + ends, solution.rodrigues) - (ends - starts)
    along, across = _motion_axes(starts + ends, solution.rodrigues)
    return np.sum(residual * along, axis=-1), np.sum(residual * across, axis=-1)


def _motion_axes(sums: FloatArray, rodrigues: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (n, 3) along the star motion at mid-streak, and (n, 3) across the motion."""
    along = np.cross(sums, rodrigues)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.cross(sums, along)
    return along, across / np.linalg.norm(across, axis=-1, keepdims=True)


def _covariance(
    solution: OlaeSolution,
    vectors: FloatArray,
    errors: FloatArray,
    pinhole: Pinhole,
    settings: StreakSettings,
) -> FloatArray:
    """Return the covariance (3, 3) of the rotation vector, rad^2.

    The variances along and across the streaks are estimated separately from the residuals. Each variance is
    multiplied by nu/(nu - 2), where nu is the number of degrees of freedom, to allow for the uncertainty of
    the variance (Student's t distribution). The bias of the detector does not affect the residuals, so that
    the uncertainty of the bias (`endpoint_bias_sigma`) is added separately.
    """
    weights = 1.0 / errors**2
    cross = cross_matrices(solution.sums)
    hat = np.einsum("nij,jk,nlk,n->nil", cross, np.linalg.inv(solution.normal), cross, weights)
    moved = gain(solution, weights)
    covariance = np.zeros((3, 3))
    axes = _motion_axes(solution.sums, solution.rodrigues)
    for direction, residual in zip(axes, _components(vectors, solution), strict=True):
        leverage = float(np.einsum("ni,nij,nj->", direction, hat, direction))
        freedom = max(len(errors) - leverage, 1.0)
        scale = np.sum((residual / errors) ** 2) / freedom
        scale *= freedom / (freedom - 2.0) if freedom > 3.0 else 3.0
        column = np.einsum("nij,nj->ni", moved, direction) * errors[:, None]
        covariance += scale * column.T @ column
    shift = 2.0 * settings.endpoint_bias_sigma / pinhole.focal_length
    common = shift * np.einsum("nij,nj->i", moved, axes[0])
    return np.asarray(covariance + np.outer(common, common))


# Offsets (x, y) from the centre pixel to one end of each diameter, for 4 and for 8 neighbour pixels.
# A diameter is a line through the centre pixel that ends at two opposite neighbours.
_DIAMETERS = {4: ((1, 0), (0, 1)), 8: ((1, 0), (1, 1), (0, 1), (-1, 1))}


def cornerness(image: FloatArray, settings: EndpointSettings) -> FloatArray:
    """Return the response (rows, columns) of the corner detector that `settings` selects."""
    assert isinstance(settings, StreakSettings)
    if settings.detector == "harris":
        return harris_cornerness(image, settings)
    if settings.detector == "minimum-eigenvalue":
        return minimum_eigenvalue(tensor_of(image, settings))
    neighbours = 4 if settings.detector == "trajkovic-4" else 8
    image = smoothed(image, settings.smoothing_sigma)
    return trajkovic_response(image, neighbours, settings.coarse_relative, settings.fine_relative)


def minimum_eigenvalue(tensor: StructureTensor) -> FloatArray:
    """Return the smaller eigenvalue (rows, columns) of the structure tensor, at least 0 (Sease, eq. 3.6)."""
    half_trace = 0.5 * (tensor.xx + tensor.yy)
    larger = half_trace + np.hypot(0.5 * (tensor.xx - tensor.yy), tensor.xy)
    determinant = tensor.xx * tensor.yy - tensor.xy**2
    # The smaller eigenvalue is the determinant divided by the larger eigenvalue, which avoids cancellation.
    return np.asarray(np.maximum(determinant, 0.0) / np.where(larger > 0.0, larger, 1.0))


class _Changes(NamedTuple):
    """Intensity changes (rows, columns) from the centre pixel to the two ends of a diameter."""

    ahead: FloatArray
    behind: FloatArray

    @property
    def squared(self) -> FloatArray:
        """Sum of the squared intensity changes along the diameter, r_A or r_B in Sease, eq. 3.10."""
        return np.asarray(self.ahead**2 + self.behind**2)


def trajkovic_response(
    image: FloatArray, neighbours: int, coarse_relative: float, fine_relative: float
) -> FloatArray:
    """Return the interpixel cornerness of pixels above the thresholds T1 and T2, and zero for other pixels.

    The thresholds T1 (`coarse_relative`, in the image at half scale) and T2 (`fine_relative`) are relative to
    the largest simple cornerness with 4 or 8 `neighbours` (Sease, text at eq. 3.10).
    """
    simple = simple_response(image, neighbours)
    likely = _coarse_corners(image, neighbours, coarse_relative)
    likely &= simple >= fine_relative * simple.max(initial=0.0)
    return np.where(likely, interpixel_response(image, neighbours), 0.0)


def simple_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the simple cornerness: the minimum squared intensity change over the diameters.

    A diameter connects two opposite pixels of the 4 or 8 neighbours of a pixel (Sease, eq. 3.9 and 3.10).
    """
    return np.asarray(np.min([changes.squared for changes in _changes(image, neighbours)], axis=0))


def interpixel_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the interpixel cornerness: the minimum squared intensity change over all directions.

    The minimum is computed for each pair of neighbouring diameters (Sease, eq. 3.11-3.13, corrected). For
    four neighbours, the minimum equals Sease, eq. 3.11, with the smaller of the coefficients B1 and B2 as B.
    """
    ring = _changes(image, neighbours)
    # The neighbour of the last diameter is the first diameter with swapped ends.
    following = [*ring[1:], _Changes(ring[0].behind, ring[0].ahead)]
    return np.asarray(np.min([_least_between(*pair) for pair in zip(ring, following, strict=True)], axis=0))


def _least_between(first: _Changes, second: _Changes) -> FloatArray:
    """Return the minimum squared change (rows, columns) over the directions between two diameters."""
    r, r_second = first.squared, second.squared
    b = first.ahead * (second.ahead - first.ahead) + first.behind * (second.behind - first.behind)
    a = r_second - r - 2.0 * b
    inside = (b < 0.0) & (a + b > 0.0)
    return np.where(inside, r - b**2 / np.where(inside, a, 1.0), np.minimum(r, r_second))


def _changes(image: FloatArray, neighbours: int) -> list[_Changes]:
    """Return the intensity changes along each diameter. The image is extended by repeating border pixels."""
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="edge")

    def towards(x: int, y: int) -> FloatArray:
        return np.asarray(padded[1 + y : 1 + y + rows, 1 + x : 1 + x + columns] - image)

    return [_Changes(towards(x, y), towards(-x, -y)) for x, y in _DIAMETERS[neighbours]]


def _coarse_corners(image: FloatArray, neighbours: int, relative: float) -> BoolArray:
    """Return a mask (rows, columns) of the pixels close to a likely corner in the image at half scale."""
    rows, columns = image.shape
    even = np.pad(image, ((0, rows % 2), (0, columns % 2)), mode="edge")
    half = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean(axis=(1, 3))
    simple = simple_response(half, neighbours)
    likely = ndimage.maximum_filter(simple >= relative * simple.max(initial=0.0), 3)
    return np.asarray(np.kron(likely, np.ones((2, 2), dtype=np.bool_))[:rows, :columns])


# Lower limit (px) of an endpoint's assumed error, because few streaks can have small residuals by chance.
_LEAST_SIGMA_PX = 0.02


@dataclass(frozen=True, slots=True)
class TwoAttitudes:
    """Attitudes at the start and end of an exposure, and the mean rate between them.

    Attributes:
        start: attitude at the start of the exposure, reference frame into camera axes.
        end: attitude at the end of the exposure, reference frame into camera axes.
        rotation_vector: (3,) rotation axis times angle in camera axes, rad (Sease, eq. 3.25 and 3.26).
        rate: (3,) rate of the camera with respect to the stars in camera axes, rad/s (Sease, eq. 3.27).
        covariance: (3, 3) covariance of the rate for independent errors of the two attitudes, rad^2/s^2.
    """

    start: AttitudeFix
    end: AttitudeFix
    rotation_vector: FloatArray
    rate: FloatArray
    covariance: FloatArray


def attitudes_of_ends(
    endpoints: FloatArray, reference: FloatArray, sigma: FloatArray, pinhole: Pinhole, exposure: float
) -> TwoAttitudes:
    """Return the attitudes at the start and end of an exposure, and the mean rate, from identified streaks.

    The `endpoints` (n, 2, 2), px, are corrected for bias and have the standard deviations `sigma` (n,), px.
    The unit vectors `reference` (n, 3) point to the stars. Raises AttitudeError if the stars do not determine
    an attitude, KnightCubeError for an invalid exposure.
    """
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise KnightCubeError(f"exposure of {exposure} s: must be finite and positive")
    vectors = pinhole.unit_vectors(endpoints)
    errors = sigma / pinhole.focal_length
    start = SOLVERS["esoq2"](vectors[:, 0], reference, errors)
    end = SOLVERS["esoq2"](vectors[:, 1], reference, errors)
    turn = multiply(end.quaternion, conjugate(start.quaternion))
    rotation = to_rotation_vector(turn)
    # The error of the start attitude is rotated into the end axes, to which the rotation vector refers.
    propagated = attitude_matrix(turn)
    angle = float(np.linalg.norm(rotation))
    cross = cross_matrices(rotation[None])[0]
    # For an angle of zero both terms of the coefficient diverge, but their difference has the limit 1/12.
    second = 1.0 / 12.0 if angle < 1e-3 else 1.0 / angle**2 - 1.0 / (2.0 * angle * np.tan(0.5 * angle))
    jacobian = np.eye(3) + 0.5 * cross + second * cross @ cross
    covariance = jacobian @ (end.covariance + propagated @ start.covariance @ propagated.T) @ jacobian.T
    return TwoAttitudes(start, end, rotation, rotation / exposure, covariance / exposure**2)


def solve_ends(
    found: StreakResult,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> tuple[FrameSolution, StreakResult]:
    """Return the attitude at mid-exposure, and a streak result with the rate between start and end attitude.

    If the streaks cannot be identified, the streak result is returned unchanged. The covariance of the rate
    is not changed, because it already describes the errors of the streak ends along and across the streaks.
    """
    # The streaks are sorted by their expected error, the smallest first.
    used = np.flatnonzero(found.used)
    used = used[np.argsort(found.sigma[used], kind="stable")]
    sigma = found.sigma[used]
    if len(used):
        typical = np.sqrt(np.mean(sigma**2))
        sigma = sigma * max(found.residual * camera.focal_length, _LEAST_SIGMA_PX) / typical
    ends = found.endpoints[used]
    covariance = 0.5 * sigma[:, None, None] ** 2 * np.eye(2)
    solution = solve_places(
        ends.mean(axis=1), covariance, FrameKind.STREAKS, camera, scale, sky, settings, prior
    )
    if solution.status is not SolveStatus.SOLVED:
        return solution, found
    matched = solution.matched
    reference = sky.stars.direction[solution.star[matched]]
    try:
        both = attitudes_of_ends(
            ends[matched], reference, sigma[matched], solution.camera.ideal, found.exposure
        )
    except AttitudeError:
        return solution, found
    scatter = _scatter(both, len(matched))
    middle = multiply(from_rotation_vector(0.5 * both.rotation_vector), both.start.quaternion)
    fix = replace(
        both.start,
        quaternion=middle,
        covariance=0.25 * scatter * (both.start.covariance + both.end.covariance),
        loss=(both.start.loss + both.end.loss) / scatter,
    )
    return replace(solution, fix=fix), replace(found, rate=both.rate)


def _scatter(both: TwoAttitudes, count: int) -> float:
    """Return the ratio of the observed variance of the residuals of `count` stars to the assumed variance.

    The fit of each attitude has two residual components per star and three parameters. The variance ratio is
    multiplied by nu/(nu - 2), where nu is the number of degrees of freedom, to allow for the uncertainty of
    the ratio (Student's t distribution).
    """
    freedom = 4 * count - 6
    squares = 2.0 * (both.start.loss + both.end.loss)
    return squares / (freedom - 2) if freedom > 2 and squares > 0.0 else 1.0
