"""Estimation of the lens parameters of a camera by the star tracker, from its own solved frames.

The lens has the parameters of `knightcube calibrate`: focal length, optical axis, and distortion. The line
time of the shutter and the width of the point spread function are estimated together with the lens
parameters. All parameters have priors with their configured values and standard deviations. Each solved frame
improves the parameters by a weighted least-squares fit in pixels, in which the attitude of the frame is
unknown. The three attitude parameters of a frame are eliminated with the Schur complement, as in the
calibration on the ground. The estimate after one frame is the prior of the fit to the next frame. Between
frames, the variances grow as in a slow random walk.

A frame that contradicts the estimated parameters, but agrees with the configuration, indicates that the lens
has changed. After a change of the lens, the estimated parameters are discarded, and the estimation starts
again from the configuration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.errors import KnightCubeError
from knightcube.vision.camera.lens import (
    SHAPE_TERMS,
    UNSTATED,
    CameraKnowledge,
    CameraModel,
    Lens,
    LensError,
)
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.sky_map import apparent
from knightcube.vision.startracker.solve import FrameSolution
from knightcube.vision.streaks.streak_result import StreakStatus

PARAMETERS = ("focal_length", "centre_x", "centre_y", "k1", "k2", *SHAPE_TERMS)
_CUT = 5.0
"""Residual (standard deviations) above which the match of a star is rejected."""
_CAUCHY = 2.385
"""Tuning constant of the Cauchy weights, for 95 % efficiency without outliers."""
_MEDIAN_LENGTH = np.sqrt(2.0 * np.log(2.0))
"""Median length of a residual of unit variance per axis (Rayleigh distribution)."""
_MIN_SPREAD = 1e-12
"""Minimum eigenvalue of the information matrix of a frame's attitude, as a fraction of its trace."""
_MIN_INDEPENDENCE = 1e-10
"""Minimum eigenvalue of the information matrix of the lens, normalised to a unit diagonal."""
MIN_COSINE = 0.05
"""Minimum cosine of the angle between a star in the image and the optical axis."""
NONE = 1e-7
"""Prior standard deviation of a lens term that is fixed at zero."""
MIN_SIGMA_PX = 0.02
"""Minimum standard deviation (px) of a star position, for errors that the covariance does not include."""


class CalibrationError(KnightCubeError):
    """Error raised for frames that do not determine a lens.

    The message of the function `calibrate_lens` states the reason for each image.
    """


class UndeterminedAttitudeError(CalibrationError):
    """Error raised for a frame whose accepted matches do not determine its attitude.

    The attribute `frame` is the index of the frame.
    """

    def __init__(self, frame: int) -> None:
        """Initialise the error with the index of the frame."""
        super().__init__(f"frame {frame}: its matches do not determine its attitude")
        self.frame = frame


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFrame:
    """The n stars identified in one frame, a few of which may be misidentified.

    Attributes:
        points: measured star positions (n, 2), px.
        sigma: standard deviations (n,) of the star positions along one axis, px.
        directions: unit vectors (n, 3) to the stars in any reference frame.
        covariance: covariances (n, 2, 2) of the star positions, px^2, used instead of `sigma`, or None if the
            errors along both axes are equal.
        late: derivatives (n, 2) of the star positions with respect to the line time of the shutter, px/s. If
            `late` is given, the line time is the tenth parameter of the fit.
    """

    points: FloatArray
    sigma: FloatArray
    directions: FloatArray
    covariance: FloatArray | None = None
    late: FloatArray | None = None

    def weighted(self, displacements: FloatArray) -> FloatArray:
        """Return displacements (n, 2, ...), px, divided by the standard deviations of the star positions."""
        if self.covariance is None:
            return np.asarray(displacements / self.sigma.reshape(-1, *[1] * (displacements.ndim - 1)))
        root = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return np.asarray(np.einsum("nij,nj...->ni...", root, displacements))

    def select(self, chosen: BoolArray) -> MatchedFrame:
        """Return the frame with only the stars in the mask `chosen` (n,)."""
        parts = (None if part is None else part[chosen] for part in (self.covariance, self.late))
        return MatchedFrame(self.points[chosen], self.sigma[chosen], self.directions[chosen], *parts)


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """Lens parameters (9,) and attitudes (m, 4) of the frames, from reference axes to camera axes."""

    parameters: FloatArray
    attitudes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FitStep:
    """Result of one Gauss-Newton step of the calibration.

    The attribute `decrease` is the decrease of chi-square that the linear model predicts. The information
    matrix (9, 9) of the lens parameters comes from the stars, after elimination of the attitudes.
    """

    fit: LensFit
    decrease: float
    information: FloatArray


def parameters_of(lens: Lens) -> FloatArray:
    """Return the parameters (9,) of a lens in the order of PARAMETERS."""
    shape = [getattr(lens, name) for name in SHAPE_TERMS]
    return np.array([lens.focal_length, *lens.centre, lens.k1, lens.k2, *shape])


def residuals(frame: MatchedFrame, fit: LensFit, number: int) -> FloatArray:
    """Return measured minus predicted positions (n, 2) of frame `number`, in standard deviations.

    The residual of a star beside or behind the camera is infinite.
    """
    focal_length, x, y, k1, k2 = fit.parameters[:5]
    in_camera = frame.directions @ attitude_matrix(fit.attitudes[number]).T
    ahead = in_camera[:, 2:] > MIN_COSINE
    tangent = in_camera[:, :2] / np.where(ahead, in_camera[:, 2:], 1.0)
    square = np.sum(tangent**2, axis=1, keepdims=True)
    distorted = tangent * (1.0 + square * (k1 + square * k2))
    distorted = distorted + _tangential_slopes(tangent) @ fit.parameters[7:9]
    predicted = focal_length * distorted @ _pixels(fit) + np.array([x, y])
    if frame.late is not None:
        predicted = predicted + frame.late * fit.parameters[9]
    return np.where(ahead, frame.weighted(frame.points - predicted), np.inf)


def _pixels(fit: LensFit) -> FloatArray:
    """Return the symmetric matrix (2, 2) of aspect and shear by which distorted tangents are multiplied."""
    aspect, shear = fit.parameters[5:7]
    return np.array([[1.0 + aspect, shear], [shear, 1.0 - aspect]])


def _tangential_slopes(tangent: FloatArray) -> FloatArray:
    """Return the derivatives (n, 2, 2) of distorted tangents with respect to the coefficients p1 and p2."""
    x, y = tangent.T
    cross, square = 2.0 * x * y, x * x + y * y
    return np.stack([np.stack([cross, square + 2.0 * y * y]), np.stack([square + 2.0 * x * x, cross])]).T


def step(
    frames: Sequence[MatchedFrame],
    fit: LensFit,
    weights: Sequence[FloatArray],
    prior: FloatArray,
    expected: FloatArray,
) -> FitStep:
    """Return lens parameters and attitudes after one Gauss-Newton step of the calibration.

    The squared residuals of the stars of each frame have the `weights` (n,). The lens parameters have the
    prior means `expected` (9,). Their prior information `prior` is either inverse variances (9,) or a matrix
    (9, 9). Raises UndeterminedAttitudeError if a frame does not determine its attitude, and CalibrationError
    if the data do not determine the lens.
    """
    information, gradient = np.zeros((len(fit.parameters),) * 2), np.zeros(len(fit.parameters))
    prior = np.diag(prior) if prior.ndim == 1 else prior
    turns, decrease = [], 0.0
    for number, frame in enumerate(frames):
        lens, turn, misfit = _linearised(frame, fit, number, weights[number])
        own = turn.T @ turn
        if np.linalg.eigvalsh(own)[0] <= _MIN_SPREAD * np.trace(own):
            raise UndeterminedAttitudeError(number)
        inverse = np.linalg.inv(own)
        free, coupling = inverse @ (turn.T @ misfit), inverse @ (turn.T @ lens)
        turns.append((free, coupling))
        decrease += float(free @ (turn.T @ misfit))
        beyond = lens - turn @ coupling  # part of the lens effect that a rotation cannot compensate
        information += beyond.T @ beyond
        gradient += beyond.T @ misfit
    gradient += prior @ (expected - fit.parameters)
    total = information + prior
    unit = np.sqrt(np.diag(total))
    if not np.all(unit > 0.0):
        raise CalibrationError(
            "the stars do not determine a parameter of the lens: give its prior uncertainty"
        )
    scaled = total / np.outer(unit, unit)
    if not np.linalg.eigvalsh(scaled)[0] > _MIN_INDEPENDENCE:
        raise CalibrationError("the matches do not separate the lens's parameters: give a prior")
    change = np.asarray(np.linalg.solve(scaled, gradient / unit) / unit)
    attitudes = [
        normalise(multiply(from_rotation_vector(free - coupling @ change), attitude))
        for (free, coupling), attitude in zip(turns, fit.attitudes, strict=True)
    ]
    moved = LensFit(fit.parameters + change, np.array(attitudes))
    return FitStep(moved, decrease + float(gradient @ change), information)


def _linearised(
    frame: MatchedFrame, fit: LensFit, number: int, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the weighted Jacobians (2n, p) and (2n, 3) of n star positions, and weighted residuals (2n,).

    The derivatives are with respect to p lens parameters (9 or 10) and to a small rotation. The first nine
    lens parameters are the parameters of `Lens` in the order of PARAMETERS. A small rotation moves a
    direction v by v x rotation.
    """
    misfit = residuals(frame, fit, number)
    usable = (weight > 0.0) & np.isfinite(misfit[:, 0])
    focal_length, _, _, k1, k2, _, _, p1, p2 = fit.parameters[:9]
    v = frame.directions[usable] @ attitude_matrix(fit.attitudes[number]).T
    u = v[:, :2] / v[:, 2:]
    square = np.sum(u**2, axis=1)
    stretch, slope = 1.0 + square * (k1 + square * k2), k1 + 2.0 * square * k2
    lens = np.zeros((len(u), 2, len(fit.parameters)))
    x, y = u.T
    tangential = _tangential_slopes(u)
    distorted, pixels = u * stretch[:, None] + tangential @ np.array([p1, p2]), focal_length * _pixels(fit)
    lens[:, :, 0] = distorted @ pixels / focal_length
    lens[:, 0, 1] = lens[:, 1, 2] = 1.0
    lens[:, :, 3] = u * square[:, None] @ pixels
    lens[:, :, 4] = lens[:, :, 3] * square[:, None]
    lens[:, :, 5] = focal_length * distorted * np.array([1.0, -1.0])
    lens[:, :, 6] = focal_length * distorted[:, ::-1]
    lens[:, :, 7:9] = pixels @ tangential
    if frame.late is not None:
        lens[:, :, 9] = frame.late[usable]
    bend = 2.0 * np.array(
        [[p1 * y + 3.0 * p2 * x, p1 * x + p2 * y], [p1 * x + p2 * y, 3.0 * p1 * y + p2 * x]]
    )
    by_tangent = pixels @ (
        stretch[:, None, None] * np.eye(2)
        + 2.0 * slope[:, None, None] * u[:, :, None] * u[:, None, :]
        + bend.transpose(2, 0, 1)
    )
    one = np.ones_like(x)
    by_turn = np.array([[x * y, -one - x * x, y], [one + y * y, -x * y, -x]])
    turn = np.einsum("nij,jkn->nik", by_tangent, by_turn)
    scale = np.sqrt(weight[usable])
    over, chosen = scale[:, None, None], frame.select(usable)
    return (
        (chosen.weighted(lens) * over).reshape(-1, len(fit.parameters)),
        (chosen.weighted(turn) * over).reshape(-1, 3),
        (misfit[usable] * scale[:, None]).ravel(),
    )


def residual_lengths(frames: Sequence[MatchedFrame], fit: LensFit) -> list[FloatArray]:
    """Return, for each frame, the lengths (n,) of its stars' residuals, in standard deviations."""
    return [np.linalg.norm(residuals(frame, fit, number), axis=1) for number, frame in enumerate(frames)]


def residual_spread(lengths: Sequence[FloatArray]) -> float:
    """Return the standard deviation per axis of the residuals, estimated from their median.

    The result is at least one. Raises CalibrationError if half of the stars are behind the camera.
    """
    median = float(np.median(np.concatenate(lengths)))
    if not median < np.inf:
        raise CalibrationError("half of the matched stars are behind the camera: too many matches are wrong")
    return max(1.0, median / float(_MEDIAN_LENGTH))


def cauchy_weights(lengths: Sequence[FloatArray]) -> list[FloatArray]:
    """Return, for each frame, the Cauchy weights (n,) of stars with residuals of the `lengths` (n,)."""
    scale = _CAUCHY * residual_spread(lengths)
    return [1.0 / (1.0 + (length / scale) ** 2) for length in lengths]


def accepted_matches(lengths: Sequence[FloatArray]) -> tuple[BoolArray, ...]:
    """Return, for each frame, the mask (n,) of the stars with residuals of acceptable `lengths` (n,)."""
    cut = _CUT * residual_spread(lengths)
    return tuple(length <= cut for length in lengths)


def matched_frame(
    solution: FrameSolution,
    sky: SkyIndex,
    velocity: FloatArray | None = None,
    shutter: tuple[float, float] | None = None,
) -> MatchedFrame:
    """Return the identified stars of a solution as a matched frame.

    The velocity (3,) of the camera, m/s, corrects aberration. If `shutter` (the line time of the solution and
    its standard deviation, s) is given, the matched frame includes the covariances of the positions and the
    effect of the line time.
    """
    matched = solution.matched
    own, points = solution.covariance[matched], solution.points[matched]
    sigma = np.sqrt(0.5 * np.trace(own, axis1=1, axis2=2) + MIN_SIGMA_PX**2)
    directions = sky.stars.direction[solution.star[matched]]
    if velocity is not None:
        directions = apparent(directions, velocity)
    if shutter is None:
        return MatchedFrame(points, sigma, directions)
    late = np.zeros_like(points)
    if len(solution.late) and shutter[1] > 0.0:
        late = solution.late[matched] / shutter[1]
    own = own + MIN_SIGMA_PX**2 * np.eye(2)
    return MatchedFrame(points + late * shutter[0], sigma, directions, own, late)


LEARNED = (*PARAMETERS[:5], "line_time", "psf_sigma")
"""Names of the parameters estimated from frames, in the units px, px, px, none, none, s and px."""
_LINE_TIME, _PSF = 9, 10
_AT = np.array([0, 1, 2, 3, 4, _LINE_TIME, _PSF])
"""Indices of the LEARNED parameters in an array of PARAMETERS, line time and point-spread width."""
_SECOND_TERM = 1.0 / 3.0
"""Ratio of the prior standard deviations of the second and the first distortion term, at an image corner."""
_FOURTH_AS = -0.3, 1.2
"""Coefficients (a, b) of the least-squares fit of a + b r^2 to r^4 over an image; r = 1 at the corners."""
_FOURTH_LEFT = 0.058
"""RMS error, over the image, of the approximation of a fourth power by a constant and a quadratic term."""
_PSF_PRIOR, _PSF_NOISE = 0.3, 0.05
"""Relative standard deviations of the configured point-spread width, and of the width measured in a frame."""
_DRIFT = 0.02
"""Random walk of the lens parameters per square root of an hour, in configured standard deviations."""
_FOCAL_KNOWN = 2e-3
"""Relative standard deviation of the focal length below which the estimated lens is used."""
_CONTRADICTION = 40.0
"""Chi-square (6 degrees of freedom, probability 5e-7) above which a frame contradicts the estimated lens."""
_LEAST_MATCHED = 6
"""Minimum number of matched stars in a frame that is used to estimate the lens parameters."""
_PLAUSIBLE = 5.0
"""Largest deviation of stored values from the configuration, in configured standard deviations."""
_ROBUST_ROUNDS, _MOST_ROUNDS, _SETTLED = 5, 8, 1e-4
"""Number of robust steps, maximum number of unweighted steps, and decrease of chi-square at convergence."""


def axes_turn(configured: CameraModel, learned: CameraModel) -> FloatArray:
    """Return the quaternion (4,) from the camera axes of the configured lens to those of the estimated lens.

    The boresight of each lens is its optical axis. Both lens models assign the same direction to the pixel on
    the optical axis of the configured lens, so that an estimated optical axis does not change the mounting.
    """
    x, y, _ = learned.unit_vectors(np.array([configured.centre]))[0].tolist()
    sine = math.hypot(x, y)
    return from_rotation_vector(np.array([y, -x, 0.0]) * (math.asin(sine) / sine if sine > 0.0 else 1.0))


def _exact(lens: Lens) -> FloatArray:
    """Return standard deviations (11,) so small that an update does not change the parameters."""
    return NONE * np.array([lens.focal_length, *[1.0] * 8, 1e-5, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class LensKnowledge:
    """Lens parameters estimated from solved frames, with their covariance.

    `update` returns the estimate after a frame.

    The estimated parameters (LEARNED) are the focal length (px), the pixel of the optical axis (px), two
    coefficients of radial distortion, the line time of the shutter (s), and the standard deviation of the
    point spread function (px).

    Attributes:
        configured: the configured camera, whose aspect, shear and tangential distortion are not estimated.
        prior: configured values (11,) of PARAMETERS, line time and point-spread width.
        spread: configured standard deviations (11,) of the values in `prior`.
        values: estimated values (11,) of the parameters in `prior`.
        covariance: covariance (11, 11) of `values`.
        frames: number of frames from which the values were estimated.
        contradictions: number of times that a frame contradicted the estimated values.
    """

    configured: Lens
    prior: FloatArray
    spread: FloatArray
    values: FloatArray
    covariance: FloatArray
    frames: int = 0
    contradictions: int = 0

    @classmethod
    def of(
        cls,
        camera: CameraModel,
        accuracy: CameraKnowledge,
        *,
        scale_error: float = 0.0,
        line_time: float | None = None,
        psf_sigma: float = 1.0,
    ) -> LensKnowledge:
        """Return the lens parameters of a camera as configured, before its first frame.

        The largest relative error of the focal length is `scale_error`. The line time of the shutter, s, is
        None if it is unknown. The standard deviation of the point spread function, px, is `psf_sigma`.
        """
        lens = Lens.of(camera)
        line_sigma = accuracy.line_time
        if line_sigma is None:
            line_sigma = UNSTATED if line_time is None else 0.0
        square = (math.hypot(*lens.ideal.centre) / lens.focal_length) ** 2
        first = accuracy.distortion / square
        focal = max(accuracy.focal_length, scale_error) * lens.focal_length
        spread = [focal, accuracy.centre, accuracy.centre, first, _SECOND_TERM * first / square]
        spread += [0.0] * len(SHAPE_TERMS) + [line_sigma, _PSF_PRIOR * psf_sigma]
        prior = np.array([*parameters_of(lens), line_time or 0.0, psf_sigma])
        sigma = np.maximum(spread, _exact(lens))
        return cls(lens, prior, sigma, prior, np.diag(sigma**2))

    @property
    def usable(self) -> bool:
        """Whether the estimated lens is accurate enough to replace the configured lens."""
        return self.frames > 0 and math.sqrt(self.covariance[0, 0]) < _FOCAL_KNOWN * float(self.values[0])

    @property
    def camera(self) -> Lens:
        """The estimated lens if it is usable, otherwise the configured lens."""
        if not self.usable:
            return self.configured
        f, x, y, k1, k2 = self.values[:5].tolist()
        return replace(self.configured, focal_length=f, centre=(x, y), k1=k1, k2=k2)

    @property
    def turn(self) -> FloatArray:
        """The quaternion (4,) from the camera axes of the configured lens to those of the estimated lens."""
        return axes_turn(self.configured, self.camera)

    @property
    def psf_sigma(self) -> float:
        """The estimated standard deviation of the point spread function, px."""
        return float(self.values[_PSF])

    @property
    def shutter(self) -> tuple[float, float]:
        """The line time with which frames are fitted, and its standard deviation, s.

        A line time that does not differ significantly from zero is replaced by zero, because the fit of a
        frame is faster for a global shutter.
        """
        values, sigma = (self.values, self.sigma) if self.usable else (self.prior, self.spread)
        time, doubt = float(values[_LINE_TIME]), float(sigma[_LINE_TIME])
        if doubt < 2.0 * _exact(self.configured)[_LINE_TIME]:
            doubt = 0.0
        return (0.0, math.hypot(doubt, time)) if abs(time) < 3.0 * doubt else (time, doubt)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (11,) of the estimated values."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def learned(self) -> tuple[FloatArray, FloatArray]:
        """The values (7,) and the covariance (7, 7) of the parameters LEARNED."""
        return self.values[_AT], self.covariance[np.ix_(_AT, _AT)]

    @property
    def accuracy(self) -> CameraKnowledge:
        """The accuracy of the estimated lens, including the covariance that the fit of streaks needs.

        The attribute `distortion` is the standard deviation of the radial displacement of an image corner,
        including the effect of the focal length.
        """
        f, square = float(self.values[0]), (math.hypot(*self.configured.ideal.centre) / self.values[0]) ** 2
        constant, quadratic = _FOURTH_AS
        by = np.zeros((5, len(self.values)))
        by[0, 0], by[0, 4] = 1.0 / f, constant * square**2
        by[1, 1] = by[2, 2] = by[4, _LINE_TIME] = 1.0
        by[3, 3], by[3, 4] = square, quadratic * square**2
        covariance = by @ self.covariance @ by.T
        covariance[3, 3] += (_FOURTH_LEFT * square**2) ** 2 * self.covariance[4, 4]
        covariance[4, 4] = self.shutter[1] ** 2
        corner = np.zeros(len(self.values))
        corner[0], corner[3], corner[4] = 1.0 / f, square, square**2
        focal, centre, _, _ = np.sqrt(np.diag(covariance)[:4]).tolist()
        return CameraKnowledge(
            focal,
            math.hypot(centre, math.sqrt(covariance[2, 2])) / math.sqrt(2.0),
            math.sqrt(float(corner @ self.covariance @ corner)),
            self.shutter[1],
            tuple(map(tuple, covariance.tolist())),
            float(self.sigma[_PSF]),
        )

    def restored(self, values: FloatArray, covariance: FloatArray, changed: float) -> LensKnowledge | None:
        """Return an estimate that starts from stored values (7,) of LEARNED and their covariance (7, 7).

        Since the values were stored, each has possibly changed by the fraction `changed` of its configured
        standard deviation. Returns None if a value differs from the configuration by more than five
        configured standard deviations, or if there are not seven values.
        """
        if values.shape != _AT.shape:
            return None
        if not np.all(np.abs(values - self.prior[_AT]) <= _PLAUSIBLE * self.spread[_AT]):
            return None
        whole, spread = self.values.copy(), self.covariance.copy()
        whole[_AT] = values
        spread[np.ix_(_AT, _AT)] = covariance + np.diag((changed * self.spread[_AT]) ** 2)
        return replace(self, values=whole, covariance=spread, frames=1)

    def update(
        self, solution: FrameSolution, sky: SkyIndex, velocity: FloatArray | None = None, elapsed: float = 0.0
    ) -> LensKnowledge:
        """Return the estimate after a frame that was taken `elapsed` s after the last frame.

        A frame with too few stars does not change the estimate.

        The frame was solved with `camera` and `shutter` of this object and, if given, with the velocity (3,)
        of the camera, m/s. If the frame contradicts the estimated lens, the result is the configured lens,
        the attribute `contradictions` is increased by one, and the frame should be solved again.
        """
        motion, line_time_known = solution.motion, self.shutter[1] == 0.0
        if solution.fix is None or solution.mirrored or len(solution.matched) < _LEAST_MATCHED:
            return self
        if motion is not None and motion.status is not StreakStatus.RATE and not line_time_known:
            return self  # a rate of unknown sign leaves the sign of the line time's effect unknown
        frame, attitude = matched_frame(solution, sky, velocity, self.shutter), solution.fix.quaternion
        focal = solution.camera.focal_length
        if motion is not None and motion.length > 0.0:
            # A distortion error bends a star's path and thus displaces the middle of the fitted path.
            corner = math.hypot(*self.configured.ideal.centre)
            square = (corner / float(self.values[0])) ** 2
            distortion = (self.sigma if self.usable else self.spread)[3] * square
            off = 0.5 * float(distortion) * corner * (motion.length / corner) ** 2
            frame = replace(frame, covariance=np.asarray(frame.covariance) + off**2 * np.eye(2))
        grown = self.covariance + np.diag((_DRIFT * self.spread) ** 2 * (elapsed / 3600.0))
        begun = replace(self, values=self.prior, covariance=np.diag(self.spread**2))
        try:
            alone = _FrameFit.of(frame, attitude, focal, begun)
            if alone.excess > 1.0:
                frame = replace(frame, covariance=np.asarray(frame.covariance) * alone.excess)
                alone = _FrameFit.of(frame, attitude, focal, begun)
            frame = frame.select(alone.used)
            together = _FrameFit.of(frame, attitude, focal, replace(self, covariance=grown), cut=False)
        except CalibrationError:
            return self
        if self.frames > 0 and together.objective - alone.objective > _CONTRADICTION:
            return replace(begun, frames=0, contradictions=self.contradictions + 1)
        values, covariance = self.values.copy(), grown
        values[:_PSF], covariance[:_PSF, :_PSF] = together.parameters, together.covariance
        known = replace(self, values=values, covariance=covariance, frames=self.frames + 1)
        try:
            _ = known.camera
        except LensError:
            return self
        return known._with_psf(solution.psf_sigma)

    def _with_psf(self, measured: float) -> LensKnowledge:
        """Return the estimate updated with a measured point-spread width, px, which is NaN if unknown.

        If the measured width contradicts the estimate, the estimation starts again from the configured width.
        """
        if not measured > 0.0:
            return self
        noise = (_PSF_NOISE * measured) ** 2
        mean, variance = self.psf_sigma, float(self.covariance[_PSF, _PSF])
        if (measured - mean) ** 2 > _CONTRADICTION * (variance + noise):
            mean, variance = float(self.prior[_PSF]), float(self.spread[_PSF]) ** 2
        gain = variance / (variance + noise)
        values, covariance = self.values.copy(), self.covariance.copy()
        values[_PSF], covariance[_PSF, _PSF] = mean + gain * (measured - mean), (1.0 - gain) * variance
        return replace(self, values=values, covariance=covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _FrameFit:
    """Fit of lens and attitude to one frame and a prior.

    Attributes:
        parameters: fitted lens parameters (10,), including the line time.
        covariance: covariance (10, 10) of the parameters.
        objective: chi-square of residuals and prior.
        used: mask (n,) of the stars that agree with the fit.
        excess: chi-square of the residuals per degree of freedom if significantly above 1, otherwise 1.
    """

    parameters: FloatArray
    covariance: FloatArray
    objective: float
    used: BoolArray
    excess: float

    @classmethod
    def of(
        cls,
        frame: MatchedFrame,
        attitude: FloatArray,
        focal_length: float,
        known: LensKnowledge,
        *,
        cut: bool = True,
    ) -> _FrameFit:
        """Return the fit to a frame with the prior `known`, without outliers if `cut` is true.

        The fit starts at the given `focal_length` (px) and `attitude` (4,).
        Raises CalibrationError if the frame does not determine its attitude, or if few stars agree.
        """
        expected = known.values[:_PSF]
        # The covariance is normalised for its inversion, because the parameters differ greatly in size.
        sigma = known.sigma[:_PSF]
        inverse = np.linalg.inv(known.covariance[:_PSF, :_PSF] / np.outer(sigma, sigma))
        prior = inverse / np.outer(sigma, sigma)
        fit = LensFit(np.append(focal_length, expected[1:]), np.asarray(attitude, dtype=float)[None])
        used: BoolArray = np.ones(len(frame.points), dtype=np.bool_)
        for _ in range(_ROBUST_ROUNDS if cut else 0):
            fit = step([frame], fit, cauchy_weights(residual_lengths([frame], fit)), prior, expected).fit
        if cut:
            (used,) = accepted_matches(residual_lengths([frame], fit))
        if np.count_nonzero(used) < _LEAST_MATCHED:
            raise CalibrationError("too few stars agree for a fit of the lens")
        for _ in range(_MOST_ROUNDS):
            last = step([frame], fit, [used.astype(np.float64)], prior, expected)
            fit = last.fit
            if last.decrease < _SETTLED:
                break
        squares = residual_lengths([frame], fit)[0][used] ** 2
        off, unit = fit.parameters - expected, np.sqrt(np.diag(last.information + prior))
        scaled = np.linalg.inv((last.information + prior) / np.outer(unit, unit))
        covariance = scaled / np.outer(unit, unit)
        # Effective number of lens parameters that the stars, and not the prior, determine.
        own = len(off) - float(np.sum(prior * covariance))
        freedom = max(2.0 * len(squares) - 3.0 - own, 1.0)
        excess = float(squares.sum()) / freedom
        significant = excess > 1.0 + 3.0 * math.sqrt(2.0 / freedom)
        objective = float(squares.sum() + off @ prior @ off)
        return cls(fit.parameters, covariance, objective, used, excess if significant else 1.0)
