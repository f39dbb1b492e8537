"""A camera's lens from solved frames: focal length, optical axis and radial distortion, with their errors.

Weighted least squares in pixels over all frames at once, each frame's attitude unknown too. Wrong matches are
first weighed down (Cauchy's weights, scaled by the residuals' own spread), then left out beyond five sigma.

Some parameters may not be in the data: in a narrow field a shift of the axis is a turn of the camera, and a
single frame hardly separates them. Each therefore has a prior, stated as a standard deviation about the lens
assumed: of the initial focal length, the axis in the middle, no distortion. A parameter that is not known to
half of that afterwards is named in `undetermined`. Without a prior, data that leave the lens open are
refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ground.calibration.lens_fit import (
    PARAMETER_COUNT,
    CalibrationError,
    Fit,
    MatchedFrame,
    Step,
    parameters_of,
    residuals,
    step,
)
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.attitude.solvers import solve
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.vision.camera.lens import CameraModel, Lens, LensError

PARAMETERS = ("focal_length", "centre_x", "centre_y", "k1", "k2")
_ROBUST_STEPS = 20
_MOST_STEPS = 50
_MOST_SELECTIONS = 10
# Of the chi-square: a step that promises less is none.
_CONVERGED = 1e-6
# Of the lengths in a frame: what their sums and products in double precision leave open.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)
_CUT = 5.0
# Cauchy's constant, for 95 % efficiency where no match is wrong.
_CAUCHY = 2.385
# The median of a residual's length in sigmas, of Rayleigh's distribution.
_MEDIAN_LENGTH = np.sqrt(2.0 * np.log(2.0))
DETERMINED = 0.5
"""Of its prior's standard deviation: to this a parameter must be known."""
# Standard deviations by which chi-square may exceed its degrees of freedom before the sigmas count as wrong.
_DOUBT = 3.0


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Prior knowledge of a lens: standard deviations about the lens assumed; inf for none.

    Attributes:
        focal_length: a part of it; the default allows any lens whose field is roughly known.
        centre: px, along one axis; the default allows a sensor placed by hand.
        k1, k2: the defaults allow any lens that is no fisheye.
    """

    focal_length: float = 0.1
    centre: float = 50.0
    k1: float = 1.0
    k2: float = 3.0

    def information(self, lens: Lens) -> FloatArray:
        """Return the information (5,) about each of PARAMETERS.

        Raises CalibrationError unless all standard deviations are positive.
        """
        sigma = np.array([self.focal_length * lens.focal_length, self.centre, self.centre, self.k1, self.k2])
        if not np.all(sigma > 0.0):
            raise CalibrationError(f"{self}: standard deviations must be positive")
        return np.asarray(sigma**-2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A lens and how well it is known.

    Attributes:
        lens: the camera found.
        covariance: (5, 5) of PARAMETERS, prior included; where the residuals are larger than their sigmas
            allow, multiplied by chi-square over its degrees of freedom.
        undetermined: those of PARAMETERS that rest on the prior, not on the stars.
        attitudes: (m, 4) of each frame, directions into camera.
        used: of each frame (n,), which matches were believed.
        chi_square, degrees: of the residuals and the prior, by the given sigmas.
        rms_before, rms_after: px, of the distances of used matches from their stars with each frame's best
            attitude, by the lens assumed and by the one found.
    """

    lens: Lens
    covariance: FloatArray
    undetermined: tuple[str, ...]
    attitudes: FloatArray
    used: tuple[BoolArray, ...]
    chi_square: float
    degrees: int
    rms_before: float
    rms_after: float

    @property
    def sigma(self) -> dict[str, float]:
        """The standard deviation of each parameter: px, px, px, and of k1 and k2."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def rejected_count(self) -> int:
        """How many matches were not believed."""
        return sum(int(np.count_nonzero(~used)) for used in self.used)


def calibrate(
    frames: Sequence[MatchedFrame], initial: CameraModel, prior: LensPrior | None = None
) -> Calibration:
    """Return the lens that fits all frames best, begun from `initial`.

    The prior, by default `LensPrior()`, is about the pinhole of the initial focal length. Raises
    CalibrationError for malformed frames, for matches that do not fix a lens and for a fit that does
    not converge or ends at no lens.
    """
    _refuse_malformed(frames)
    begun = Lens.of(initial)
    information = (prior or LensPrior()).information(begun)
    expected = parameters_of(Lens.of(begun.ideal))
    fit = Fit(parameters_of(begun), np.array([_attitude(frame, begun, n) for n, frame in enumerate(frames)]))
    for _ in range(_ROBUST_STEPS):
        fit = step(frames, fit, _cauchy_weights(_lengths(frames, fit)), information, expected).fit
    used = _believed(_lengths(frames, fit))
    for _ in range(_MOST_SELECTIONS):
        last = _descend(frames, fit, used, information, expected)
        fit, before = last.fit, used
        used = _believed(_lengths(frames, fit))
        if all(np.array_equal(a, b) for a, b in zip(before, used, strict=True)):
            return _result(frames, begun, last, used, information, expected)
    raise CalibrationError("which matches are right does not settle: too many may be wrong")


def _descend(
    frames: Sequence[MatchedFrame],
    fit: Fit,
    used: Sequence[BoolArray],
    information: FloatArray,
    expected: FloatArray,
) -> Step:
    """Return the last step of the fit to the matches `used`."""
    weights = [chosen.astype(float) for chosen in used]
    least = max(_CONVERGED, _rounding(frames, used, fit.parameters[0]))
    for _ in range(_MOST_STEPS):
        last = step(frames, fit, weights, information, expected)
        if last.decrease < least:
            return last
        fit = last.fit
    raise CalibrationError(f"the fit does not converge in {_MOST_STEPS} steps")


def _rounding(frames: Sequence[MatchedFrame], used: Sequence[BoolArray], focal_length: float) -> float:
    """Return the chi-square of residuals that are rounding alone: with tiny sigmas a fit gets no nearer."""
    total = 0.0
    for frame, chosen in zip(frames, used, strict=True):
        length = focal_length + np.linalg.norm(frame.points[chosen], axis=1)
        total += 2.0 * float(np.sum((_ROUNDING * length / frame.sigma[chosen]) ** 2))
    return total


def _attitude(frame: MatchedFrame, lens: Lens, number: int) -> FloatArray:
    """Return a frame's attitude (4,) by a lens, matches that do not agree weighed down."""
    seen = lens.unit_vectors(frame.points)
    sigma = frame.sigma / lens.focal_length
    weight = np.ones(len(sigma))
    try:
        for _ in range(_ROBUST_STEPS):
            quaternion = solve(seen, frame.directions, sigma / np.sqrt(weight)).quaternion
            fit = Fit(parameters_of(lens), quaternion[None])
            (weight,) = _cauchy_weights([np.linalg.norm(residuals(frame, fit, 0), axis=1)])
            # No match is lost for ever: an attitude begun badly may yet come to it.
            weight = np.maximum(weight, 1e-6)
    except AttitudeError as error:
        raise CalibrationError(f"frame {number}: {error}") from error
    return quaternion


def _lengths(frames: Sequence[MatchedFrame], fit: Fit) -> list[FloatArray]:
    """Return the length of each match's residual, in sigmas, frame by frame (n,)."""
    return [np.linalg.norm(residuals(frame, fit, number), axis=1) for number, frame in enumerate(frames)]


def _spread(lengths: Sequence[FloatArray]) -> float:
    """Return the residuals' standard deviation along one axis, in sigmas, from their median; at least one.

    Raises CalibrationError where the median star is behind the camera.
    """
    median = float(np.median(np.concatenate(lengths)))
    if not median < np.inf:
        raise CalibrationError("half of the matches are of stars behind the camera: too many are wrong")
    return max(1.0, median / float(_MEDIAN_LENGTH))


def _cauchy_weights(lengths: Sequence[FloatArray]) -> list[FloatArray]:
    scale = _CAUCHY * _spread(lengths)
    return [1.0 / (1.0 + (length / scale) ** 2) for length in lengths]


def _believed(lengths: Sequence[FloatArray]) -> tuple[BoolArray, ...]:
    cut = _CUT * _spread(lengths)
    return tuple(length <= cut for length in lengths)


def _result(
    frames: Sequence[MatchedFrame],
    begun: Lens,
    last: Step,
    used: tuple[BoolArray, ...],
    prior: FloatArray,
    expected: FloatArray,
) -> Calibration:
    """Return the calibration that the last step ends with."""
    focal_length, x, y, k1, k2 = last.fit.parameters.tolist()
    try:
        lens = Lens(begun.columns, begun.rows, focal_length, (x, y), k1, k2)
    except LensError as error:
        raise CalibrationError(f"the matches fit no lens: {error}") from error
    offset = last.fit.parameters - expected
    squares = [length[chosen] ** 2 for length, chosen in zip(_lengths(frames, last.fit), used, strict=True)]
    chi_square = float(np.sum(np.concatenate(squares)) + np.sum(prior * offset**2))
    count = sum(map(len, squares))
    degrees = 2 * count + int(np.count_nonzero(prior)) - PARAMETER_COUNT - 3 * len(frames)
    if degrees <= 0:
        raise CalibrationError(f"{count} matches on {len(frames)} frames leave nothing to judge the lens by")
    covariance = np.asarray(np.linalg.inv(last.information + np.diag(prior)), dtype=np.float64)
    undetermined = _undetermined(covariance, prior, begun)
    excess = chi_square / degrees
    if excess > 1.0 + _DOUBT * np.sqrt(2.0 / degrees):
        covariance = covariance * excess
    return Calibration(
        lens,
        covariance,
        undetermined,
        last.fit.attitudes,
        used,
        chi_square,
        degrees,
        _rms(frames, Lens.of(begun.ideal), used),
        _rms(frames, lens, used),
    )


def _undetermined(covariance: FloatArray, prior: FloatArray, begun: Lens) -> tuple[str, ...]:
    """Return the parameters that are little better known than before.

    Raises CalibrationError for one without a prior that is not known to half of what any prior would say.
    """
    usual = LensPrior().information(begun)
    poor = np.diag(covariance) * np.where(prior > 0.0, prior, usual) > DETERMINED**2
    names = [name for name, is_poor in zip(PARAMETERS, poor, strict=True) if is_poor]
    if np.any(poor & (prior == 0.0)):
        raise CalibrationError(f"the matches leave {', '.join(names)} open: give a prior")
    return tuple(names)


def _rms(frames: Sequence[MatchedFrame], lens: Lens, used: Sequence[BoolArray]) -> float:
    """Return the rms distance, px, of the matches used from their stars, each frame's attitude its best."""
    squares = []
    for frame, chosen in zip(frames, used, strict=True):
        points, stars, sigma = frame.points[chosen], frame.directions[chosen], frame.sigma[chosen]
        fix = solve(lens.unit_vectors(points), stars, sigma / lens.focal_length)
        own = MatchedFrame(points, sigma, stars)
        off = residuals(own, Fit(parameters_of(lens), fix.quaternion[None]), 0) * sigma[:, None]
        squares.append(np.sum(off**2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _refuse_malformed(frames: Sequence[MatchedFrame]) -> None:
    """Raise CalibrationError for no frames and for arrays that do not fit together or are not finite."""
    if not frames:
        raise CalibrationError("no frames: give at least one")
    for number, frame in enumerate(frames):
        n = len(frame.points)
        shapes = (frame.points.shape, frame.sigma.shape, frame.directions.shape)
        if shapes != ((n, 2), (n,), (n, 3)):
            raise CalibrationError(f"frame {number}: shapes {shapes}; give (n, 2), (n,) and (n, 3)")
        if not (np.all(np.isfinite(frame.points)) and np.all(np.isfinite(frame.directions))):
            raise CalibrationError(f"frame {number}: points and directions must be finite")
