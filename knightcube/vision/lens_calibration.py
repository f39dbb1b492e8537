"""Calibration of a camera's lens from solved frames: focal length, optical axis and radial distortion.

The fit is weighted least squares in pixels over all frames at once, with the attitude of each frame unknown.
Wrong matches are first weighted down with Cauchy weights, scaled by the spread of the residuals, and then
rejected beyond five sigma. The attitudes, three small rotations per frame, are eliminated frame by frame
with the Schur complement, so that a 5 x 5 system is solved for any number of frames.

The data may not determine some parameters: in a narrow field a shift of the axis looks like a rotation of
the camera, and a single frame hardly separates the two. Each parameter therefore has a prior around the
assumed lens: the initial focal length, an axis in the image centre, no distortion. A parameter whose standard
deviation is not below half of its prior is named in `undetermined`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.attitude.solvers import solve
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.errors import FlightError, UsageError
from knightcube.vision.camera.lens import CameraModel, Lens, LensError
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.star_tracker import camera_of_field
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import FrameSolution, SolveSettings

PARAMETERS = ("focal_length", "centre_x", "centre_y", "k1", "k2")
MIN_STARS = 24
"""Smallest number of used matches for a calibration: three per parameter of the lens and of an attitude."""
_ROBUST_STEPS = 20
_MAX_STEPS = 50
_MAX_SELECTIONS = 10
_CONVERGED = 1e-6
"""Predicted decrease of the chi-square at which the fit has converged."""
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)
"""Relative rounding error of a length in a frame."""
_CUT = 5.0
"""Residual, in sigmas, above which a match is rejected."""
_CAUCHY = 2.385
"""Cauchy's constant for 95 % efficiency without wrong matches."""
_MEDIAN_LENGTH = np.sqrt(2.0 * np.log(2.0))
"""Median length of a residual of unit variance per axis (Rayleigh distribution)."""
_DETERMINED = 0.5
"""Fraction of its prior's standard deviation below which a parameter counts as determined."""
_MAX_EXCESS = 3.0
"""Excess of the chi-square, in its standard deviations, above which the given sigmas count as too small."""
_MIN_SPREAD = 1e-12
"""Smallest relative eigenvalue of a frame's attitude information."""
_MIN_INDEPENDENCE = 1e-10
"""Smallest eigenvalue of the lens information, normalised to a unit diagonal."""
_MIN_COSINE = 0.05
"""Cosine of the angle to the optical axis below which a star cannot be in the image."""
_HELD = {"k2": 1e-7, "k1": 1e-7, "centre": 1e-3}
"""Prior standard deviation (px for the centre) that holds an omitted term, in the order of omission."""
_ROUNDS = 3
"""Number of times that the images are solved: with a better lens more stars in the corners match."""
_MIN_SIGMA_PX = 0.02
"""Smallest standard deviation of a star's position (px), for the errors that its covariance lacks."""
_SETTINGS = SolveSettings(identification=IdentificationSettings(mirror=False))
"""Settings for which a mirrored image is not solved: a lens does not mirror."""
_MIN_USED = 0.5
"""Smallest used fraction of a frame's matches for a frame of the common lens."""


class CalibrationError(FlightError):
    """Frames that do not determine a lens."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFrame:
    """Stars identified in one frame, of which a few may be wrong.

    Attributes:
        points: measured positions (n, 2), px.
        sigma: standard deviations (n,) of the positions along one axis, px.
        directions: unit vectors (n, 3) of the stars in any reference frame.
    """

    points: FloatArray
    sigma: FloatArray
    directions: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """Parameters (5,) of a lens and attitudes (m, 4) of the frames, from reference to camera."""

    parameters: FloatArray
    attitudes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FitStep:
    """Result of one Gauss-Newton step.

    Attributes:
        fit: lens and attitudes after the step.
        decrease: decrease of the chi-square that the linear model predicts.
        information: information (5, 5) of the stars about the lens, with unknown attitudes.
    """

    fit: LensFit
    decrease: float
    information: FloatArray


def parameters_of(lens: Lens) -> FloatArray:
    """Return the parameters (5,) of a lens."""
    return np.array([lens.focal_length, *lens.centre, lens.k1, lens.k2])


def residuals(frame: MatchedFrame, fit: LensFit, number: int) -> FloatArray:
    """Return measured minus predicted positions (n, 2), in sigmas, of the frame with that number.

    The residual of a star beside or behind the camera is infinite.
    """
    focal_length, x, y, k1, k2 = fit.parameters
    in_camera = frame.directions @ attitude_matrix(fit.attitudes[number]).T
    ahead = in_camera[:, 2:] > _MIN_COSINE
    tangent = in_camera[:, :2] / np.where(ahead, in_camera[:, 2:], 1.0)
    square = np.sum(tangent**2, axis=1, keepdims=True)
    predicted = focal_length * tangent * (1.0 + square * (k1 + square * k2)) + np.array([x, y])
    return np.where(ahead, (frame.points - predicted) / frame.sigma[:, None], np.inf)


def step(
    frames: Sequence[MatchedFrame],
    fit: LensFit,
    weights: Sequence[FloatArray],
    prior: FloatArray,
    expected: FloatArray,
) -> FitStep:
    """Return the fit after one Gauss-Newton step.

    Args:
        frames: the frames.
        fit: lens and attitudes before the step.
        weights: factors (n,) of the squared residuals of each frame.
        prior: information (5,) about the difference of each parameter from `expected`.
        expected: parameters (5,) of the prior.

    Raises CalibrationError if a frame does not determine its attitude or the data do not determine the lens.
    """
    information, gradient = np.zeros((len(PARAMETERS), len(PARAMETERS))), np.zeros(len(PARAMETERS))
    turns, decrease = [], 0.0
    for number, frame in enumerate(frames):
        lens, turn, misfit = _linearised(frame, fit, number, weights[number])
        own = turn.T @ turn
        if np.linalg.eigvalsh(own)[0] <= _MIN_SPREAD * np.trace(own):
            raise CalibrationError(f"frame {number}: its matches do not determine its attitude")
        inverse = np.linalg.inv(own)
        free, coupling = inverse @ (turn.T @ misfit), inverse @ (turn.T @ lens)
        turns.append((free, coupling))
        decrease += float(free @ (turn.T @ misfit))
        beyond = lens - turn @ coupling  # the effect of the lens that no rotation can have
        information += beyond.T @ beyond
        gradient += beyond.T @ misfit
    gradient += prior * (expected - fit.parameters)
    total = information + np.diag(prior)
    size = np.sqrt(np.diag(total))
    if not np.all(size > 0.0):
        raise CalibrationError("a parameter of the lens has no information: give a prior")
    scaled = total / np.outer(size, size)
    if not np.linalg.eigvalsh(scaled)[0] > _MIN_INDEPENDENCE:
        raise CalibrationError("the matches do not separate the lens's parameters: give a prior")
    change = np.asarray(np.linalg.solve(scaled, gradient / size) / size)
    attitudes = [
        normalise(multiply(from_rotation_vector(free - coupling @ change), attitude))
        for (free, coupling), attitude in zip(turns, fit.attitudes, strict=True)
    ]
    moved = LensFit(fit.parameters + change, np.array(attitudes))
    return FitStep(moved, decrease + float(gradient @ change), information)


def _linearised(
    frame: MatchedFrame, fit: LensFit, number: int, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the weighted derivatives by the lens (2n, 5) and by the rotation (2n, 3), and residuals (2n,).

    A direction with tangent u in the camera is imaged at f u s(|u|^2); a rotation moves a direction v by
    v x rotation.
    """
    misfit = residuals(frame, fit, number)
    usable = (weight > 0.0) & np.isfinite(misfit[:, 0])
    focal_length, _, _, k1, k2 = fit.parameters
    v = frame.directions[usable] @ attitude_matrix(fit.attitudes[number]).T
    u = v[:, :2] / v[:, 2:]
    square = np.sum(u**2, axis=1)
    stretch, slope = 1.0 + square * (k1 + square * k2), k1 + 2.0 * square * k2
    lens = np.zeros((len(u), 2, len(PARAMETERS)))
    lens[:, :, 0] = u * stretch[:, None]
    lens[:, 0, 1] = lens[:, 1, 2] = 1.0
    lens[:, :, 3] = focal_length * u * square[:, None]
    lens[:, :, 4] = lens[:, :, 3] * square[:, None]
    by_tangent = focal_length * (
        stretch[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * u[:, :, None] * u[:, None, :]
    )
    x, y = u.T
    one = np.ones_like(x)
    by_turn = np.array([[x * y, -one - x * x, y], [one + y * y, -x * y, -x]])
    turn = np.einsum("nij,jkn->nik", by_tangent, by_turn)
    scale = np.sqrt(weight[usable])
    over = (scale / frame.sigma[usable])[:, None, None]
    return (
        (lens * over).reshape(-1, len(PARAMETERS)),
        (turn * over).reshape(-1, 3),
        (misfit[usable] * scale[:, None]).ravel(),
    )


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Prior standard deviations around the assumed lens; infinity means no prior.

    Attributes:
        focal_length: relative; the default allows any lens whose field of view is roughly known.
        centre: along one axis, px; the default allows a sensor positioned by hand.
        k1, k2: the defaults allow any lens except a fisheye.
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
    """A lens and its uncertainty.

    Attributes:
        lens: the calibrated camera.
        covariance: covariance (5, 5) of PARAMETERS, prior included. If the residuals are larger than their
            sigmas allow, it is multiplied by the chi-square per degree of freedom.
        undetermined: those of PARAMETERS that are determined by the prior, not by the stars.
        attitudes: attitudes (m, 4) of the frames, from reference to camera.
        used: which matches (n,) of each frame were not rejected.
        chi_square: chi-square of the residuals and the prior.
        degrees: degrees of freedom.
        rms_before: rms distance of the used matches from their stars with the assumed lens, px.
        rms_after: the same with the calibrated lens, px.
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
        """Standard deviation of each parameter, in px for the first three."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def stars(self) -> int:
        """Number of used matches."""
        return sum(int(np.count_nonzero(used)) for used in self.used)

    @property
    def rejected_count(self) -> int:
        """Number of rejected matches."""
        return sum(map(len, self.used)) - self.stars


def calibrate(
    frames: Sequence[MatchedFrame], initial: CameraModel, prior: LensPrior | None = None
) -> Calibration:
    """Return the lens that fits all frames best, starting from `initial`.

    The prior, by default `LensPrior()`, is around the pinhole with the initial focal length. Raises
    CalibrationError for malformed frames, for matches that do not determine a lens, and if the fit does not
    converge or does not result in a valid lens.
    """
    _refuse_malformed(frames)
    begun = Lens.of(initial)
    information = (prior or LensPrior()).information(begun)
    expected = parameters_of(Lens.of(begun.ideal))
    attitudes = np.array([_attitude(frame, begun, number) for number, frame in enumerate(frames)])
    fit = LensFit(parameters_of(begun), attitudes)
    for _ in range(_ROBUST_STEPS):
        fit = step(frames, fit, _cauchy_weights(_lengths(frames, fit)), information, expected).fit
    used = _accepted(_lengths(frames, fit))
    for _ in range(_MAX_SELECTIONS):
        last = _converged(frames, fit, used, information, expected)
        fit, before = last.fit, used
        used = _accepted(_lengths(frames, fit))
        if all(np.array_equal(a, b) for a, b in zip(before, used, strict=True)):
            return _result(frames, begun, last, used, information, expected)
    raise CalibrationError(
        f"the set of rejected matches still changes after {_MAX_SELECTIONS} fits: too many may be wrong"
    )


def _refuse_malformed(frames: Sequence[MatchedFrame]) -> None:
    """Raise CalibrationError for no frames and for arrays of wrong shapes or with values not finite."""
    if not frames:
        raise CalibrationError("no frames: give at least one")
    for number, frame in enumerate(frames):
        n = len(frame.points)
        shapes = (frame.points.shape, frame.sigma.shape, frame.directions.shape)
        if shapes != ((n, 2), (n,), (n, 3)):
            raise CalibrationError(f"frame {number}: shapes {shapes}; give (n, 2), (n,) and (n, 3)")
        if not (np.all(np.isfinite(frame.points)) and np.all(np.isfinite(frame.directions))):
            raise CalibrationError(f"frame {number}: points and directions must be finite")


def _attitude(frame: MatchedFrame, lens: Lens, number: int) -> FloatArray:
    """Return a robust estimate of a frame's attitude (4,) with a given lens."""
    in_camera = lens.unit_vectors(frame.points)
    sigma = frame.sigma / lens.focal_length
    weight = np.ones(len(sigma))
    try:
        for _ in range(_ROBUST_STEPS):
            quaternion = solve(in_camera, frame.directions, sigma / np.sqrt(weight)).quaternion
            fit = LensFit(parameters_of(lens), quaternion[None])
            (weight,) = _cauchy_weights(_lengths([frame], fit))
            # No weight becomes zero: a match may agree later although the first attitude was poor.
            weight = np.maximum(weight, 1e-6)
    except AttitudeError as error:
        raise CalibrationError(f"frame {number}: {error}") from error
    return quaternion


def _lengths(frames: Sequence[MatchedFrame], fit: LensFit) -> list[FloatArray]:
    """Return the lengths (n,) of the residuals of each frame, in sigmas."""
    return [np.linalg.norm(residuals(frame, fit, number), axis=1) for number, frame in enumerate(frames)]


def _spread(lengths: Sequence[FloatArray]) -> float:
    """Return the standard deviation of the residuals along one axis from their median, at least one sigma.

    Raises CalibrationError if the median star is behind the camera.
    """
    median = float(np.median(np.concatenate(lengths)))
    if not median < np.inf:
        raise CalibrationError("half of the matched stars are behind the camera: too many matches are wrong")
    return max(1.0, median / float(_MEDIAN_LENGTH))


def _cauchy_weights(lengths: Sequence[FloatArray]) -> list[FloatArray]:
    scale = _CAUCHY * _spread(lengths)
    return [1.0 / (1.0 + (length / scale) ** 2) for length in lengths]


def _accepted(lengths: Sequence[FloatArray]) -> tuple[BoolArray, ...]:
    cut = _CUT * _spread(lengths)
    return tuple(length <= cut for length in lengths)


def _converged(
    frames: Sequence[MatchedFrame],
    fit: LensFit,
    used: Sequence[BoolArray],
    information: FloatArray,
    expected: FloatArray,
) -> FitStep:
    """Return the last step of the fit to the matches `used`."""
    least = 0.0  # the chi-square of pure rounding errors, below which tiny sigmas cannot bring the fit
    for frame, chosen in zip(frames, used, strict=True):
        length = fit.parameters[0] + np.linalg.norm(frame.points[chosen], axis=1)
        least += 2.0 * float(np.sum((_ROUNDING * length / frame.sigma[chosen]) ** 2))
    weights = [chosen.astype(float) for chosen in used]
    for _ in range(_MAX_STEPS):
        last = step(frames, fit, weights, information, expected)
        if last.decrease < max(_CONVERGED, least):
            return last
        fit = last.fit
    raise CalibrationError(f"the fit does not converge in {_MAX_STEPS} steps")


def _result(
    frames: Sequence[MatchedFrame],
    begun: Lens,
    last: FitStep,
    used: tuple[BoolArray, ...],
    prior: FloatArray,
    expected: FloatArray,
) -> Calibration:
    """Return the calibration after the last step."""
    focal_length, x, y, k1, k2 = last.fit.parameters.tolist()
    try:
        lens = Lens(begun.columns, begun.rows, focal_length, (x, y), k1, k2)
    except LensError as error:
        raise CalibrationError(f"the fitted parameters are not those of a lens: {error}") from error
    offset = last.fit.parameters - expected
    squares = [length[chosen] ** 2 for length, chosen in zip(_lengths(frames, last.fit), used, strict=True)]
    chi_square = float(np.sum(np.concatenate(squares)) + np.sum(prior * offset**2))
    count = sum(map(len, squares))
    degrees = 2 * count + int(np.count_nonzero(prior)) - len(PARAMETERS) - 3 * len(frames)
    if degrees <= 0:
        raise CalibrationError(f"{count} matches in {len(frames)} frames are too few to check the lens")
    covariance = np.asarray(np.linalg.inv(last.information + np.diag(prior)), dtype=np.float64)
    usual = LensPrior().information(begun)
    poor = np.diag(covariance) * np.where(prior > 0.0, prior, usual) > _DETERMINED**2
    undetermined = tuple(name for name, is_poor in zip(PARAMETERS, poor, strict=True) if is_poor)
    if np.any(poor & (prior == 0.0)):
        raise CalibrationError(f"the matches do not determine {', '.join(undetermined)}: give a prior")
    excess = chi_square / degrees
    if excess > 1.0 + _MAX_EXCESS * np.sqrt(2.0 / degrees):
        covariance = covariance * excess
    rms_before, rms_after = (_rms(frames, one, used) for one in (Lens.of(begun.ideal), lens))
    attitudes = last.fit.attitudes
    return Calibration(
        lens, covariance, undetermined, attitudes, used, chi_square, degrees, rms_before, rms_after
    )


def _rms(frames: Sequence[MatchedFrame], lens: Lens, used: Sequence[BoolArray]) -> float:
    """Return the rms distance, px, of the used matches from their stars with each frame's best attitude."""
    squares = []
    for frame, chosen in zip(frames, used, strict=True):
        points, stars, sigma = frame.points[chosen], frame.directions[chosen], frame.sigma[chosen]
        fix = solve(lens.unit_vectors(points), stars, sigma / lens.focal_length)
        own = MatchedFrame(points, sigma, stars)
        off = residuals(own, LensFit(parameters_of(lens), fix.quaternion[None]), 0) * sigma[:, None]
        squares.append(np.sum(off**2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


@dataclass(frozen=True, slots=True)
class OmittedTerm:
    """A term that the stars do not determine.

    Attributes:
        values: last fitted values; one for k1 and k2, x and y for the centre.
        sigmas: their standard deviations.
        assumed: values of the calibrated lens instead.
    """

    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    assumed: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class DeterminedLens:
    """A calibration with only those terms that the stars determine.

    Attributes:
        calibration: the calibration; omitted terms have their assumed values and almost no uncertainty.
        omitted: omitted terms by "k1", "k2", "centre".
        accuracy: accuracy of the lens by the keys of a configuration's `camera.accuracy`, without the keys
            that the stars do not determine.
    """

    calibration: Calibration
    omitted: dict[str, OmittedTerm]
    accuracy: dict[str, float]


def calibrate_determined(frames: Sequence[MatchedFrame], initial: CameraModel) -> DeterminedLens:
    """Return the lens of the frames with only the determined terms, starting from `initial`.

    Terms are omitted one at a time, k2 first, if they are undetermined or if a distortion is smaller than its
    standard deviation. The other terms are then fitted again. Raises CalibrationError.
    """
    prior = LensPrior()
    whole = found = calibrate(frames, initial, prior)
    omitted: dict[str, OmittedTerm] = {}
    while (term := _next_omitted(found, omitted)) is not None:
        lens, sigma = found.lens, found.sigma
        if term == "centre":
            sigmas = sigma["centre_x"], sigma["centre_y"]
            omitted[term] = OmittedTerm(lens.centre, sigmas, lens.ideal.centre)
        else:
            omitted[term] = OmittedTerm((getattr(lens, term),), (sigma[term],), (0.0,))
        prior = replace(prior, **{term: _HELD[term]})
        # The fit starts at the assumed values, which the held terms do not leave.
        assumed: dict[str, Any] = {
            name: gone.assumed if name == "centre" else gone.assumed[0] for name, gone in omitted.items()
        }
        found = calibrate(frames, replace(lens, **assumed), prior)
    return DeterminedLens(found, omitted, lens_accuracy(whole, found, omitted))


def _next_omitted(found: Calibration, omitted: dict[str, OmittedTerm]) -> str | None:
    """Return the next term to omit, or None if the stars determine all fitted terms."""
    fitted = [term for term in _HELD if term not in omitted]
    for term in fitted:
        if any(name.startswith(term) for name in found.undetermined):
            return term
    highest = next((term for term in ("k2", "k1") if term in fitted), None)
    if highest is not None and abs(getattr(found.lens, highest)) < found.sigma[highest]:
        return highest
    return None


def lens_accuracy(
    whole: Calibration, found: Calibration, omitted: dict[str, OmittedTerm]
) -> dict[str, float]:
    """Return the accuracy of a lens by the keys of `camera.accuracy`.

    The accuracy of focal length and centre is that of the fit `found` without the omitted terms; the change
    of the focal length from the fit of all terms, `whole`, is added to its error. The distortion is the
    relative displacement of an image corner: its uncertainty with all terms and the difference of the fits.
    """
    lens, sigma = found.lens, found.sigma
    changed = whole.lens.focal_length - lens.focal_length
    accuracy = {"focal_length": math.hypot(sigma["focal_length"], changed) / lens.focal_length}
    if "centre" not in omitted:
        accuracy["centre"] = math.hypot(sigma["centre_x"], sigma["centre_y"]) / math.sqrt(2.0)
    square = (math.hypot(*lens.ideal.centre) / lens.focal_length) ** 2
    by_terms = np.array([1.0 / lens.focal_length, 0.0, 0.0, square, square**2])
    variance = float(by_terms @ whole.covariance @ by_terms)
    difference = float(by_terms @ (parameters_of(whole.lens) - parameters_of(lens)))
    distortion, assumed = math.hypot(math.sqrt(variance), difference), LensPrior()
    if distortion < _DETERMINED * math.hypot(assumed.k1 * square, assumed.k2 * square**2):
        accuracy["distortion"] = distortion
    return accuracy


def calibrate_one_lens(
    frames: Sequence[MatchedFrame], initial: CameraModel, focal_lengths: FloatArray, sigmas: FloatArray
) -> tuple[DeterminedLens, dict[int, str]]:
    """Return the lens of the frames that agree on one, and the reasons to exclude others, by their numbers.

    A frame with another focus or zoom, or with a wrong solution, is excluded if its focal length differs from
    the median by more than 5 sigma and 1 %, or if the fit rejects more than half of its matches.

    Args:
        frames: the frames.
        initial: the camera from which the fit starts.
        focal_lengths: focal length (m,) of each frame alone, px.
        sigmas: their standard deviations (m,), px.

    Raises CalibrationError as `calibrate`.
    """
    usual = float(np.median(focal_lengths))
    different = np.abs(focal_lengths - usual) > np.maximum(5.0 * sigmas, 0.01 * usual)
    excluded = {
        number: f"its focal length is {focal_lengths[number]:.1f} px, that of the others {usual:.1f} px"
        for number in np.flatnonzero(different).tolist()
    }
    while True:
        kept = [number for number in range(len(frames)) if number not in excluded]
        found = calibrate([frames[number] for number in kept], initial)
        parts = np.array([used.mean() for used in found.used])
        worst = int(parts.argmin())
        if parts[worst] >= _MIN_USED or len(kept) == 1:
            return calibrate_determined([frames[number] for number in kept], initial), excluded
        excluded[kept[worst]] = f"the lens of the other frames fits {parts[worst]:.0%} of its stars"


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationImage:
    """One image of a calibration.

    Attributes:
        solution: the stars and the attitude of the image, or why it is not solved.
        excluded: reason to exclude a solved image; empty otherwise.
    """

    solution: FrameSolution
    excluded: str = ""

    @property
    def reason(self) -> str:
        """The reason why the image is not used; empty if it is used."""
        return self.excluded or ("" if self.solution.fix is not None else self.solution.reason)


@dataclass(frozen=True, slots=True, eq=False)
class LensCalibration:
    """The outcome of `calibrate_lens`. It is true (`if found:`) if a lens was determined.

    Attributes:
        determined: lens, standard deviations, omitted terms and accuracy; None if no image was solved.
        images: the images in the given order, each with its solution or the reason to exclude it.
    """

    determined: DeterminedLens | None
    images: tuple[CalibrationImage, ...]

    def __bool__(self) -> bool:
        """Return whether a lens was determined."""
        return self.determined is not None

    @property
    def lens(self) -> Lens | None:
        """The calibrated lens, for `StarTracker(camera=...)`; None if no image was solved."""
        return None if self.determined is None else self.determined.calibration.lens


def calibrate_lens(
    images: Sequence[Image],
    *,
    fov_deg: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> LensCalibration:
    """Return the lens of a camera from images of the night sky: focal length, axis and radial distortion.

    All images must be of one camera at one focus. Images that do not fit are excluded. Ten images with stars
    in the corners are worth more than a hundred without. Terms that the stars do not determine are omitted.

    Args:
        images: arrays (rows, columns) of counts, all of one shape.
        fov_deg: approximate field of view across the columns, deg; None: any from 4 to 60 deg.
        progress: called before each image with the round and the number of the image, both from 1.

    Raises:
        UsageError: without images, or for images of different shapes.
        InputError: for a field of view that is not between 1 and 120 deg.
        CalibrationError: if the solved images do not determine a lens.
    """
    if len({image.shape for image in images}) != 1:
        raise UsageError("a calibration needs images of one camera, all of one shape")
    sky = default_index()
    model: CameraModel
    model, scale = camera_of_field(fov_deg, None, images[0].shape)
    lens: DeterminedLens | None = None
    outcomes: list[CalibrationImage] = []
    for round_number in range(1, _ROUNDS + 1):
        outcomes = []
        for number, image in enumerate(images, start=1):
            if progress is not None:
                progress(round_number, number)
            outcomes.append(CalibrationImage(solve_frame(image, model, scale, 1.0, sky, _SETTINGS)))
        solved = [number for number, outcome in enumerate(outcomes) if outcome.solution.fix is not None]
        if not solved:
            return LensCalibration(None, tuple(outcomes))
        solutions = [outcomes[number].solution for number in solved]
        focal_lengths = np.array([solution.camera.focal_length for solution in solutions])
        sigmas = focal_lengths * np.array([solution.scale_sigma for solution in solutions])
        median = int(np.argsort(focal_lengths)[len(solved) // 2])
        initial = solutions[median].camera if lens is None else model
        matches = [_matches(solution, sky) for solution in solutions]
        lens, excluded = calibrate_one_lens(matches, initial, focal_lengths, sigmas)
        for number, reason in excluded.items():
            outcomes[solved[number]] = replace(outcomes[solved[number]], excluded=reason)
        model, scale = lens.calibration.lens, (0.999, 1.001)
    return LensCalibration(lens, tuple(outcomes))


def _matches(solution: FrameSolution, sky: SkyIndex) -> MatchedFrame:
    """Return the identified stars of a solution."""
    matched = solution.matched
    variance = 0.5 * np.trace(solution.covariance[matched], axis1=1, axis2=2) + _MIN_SIGMA_PX**2
    directions = sky.stars.direction[solution.star[matched]]
    return MatchedFrame(solution.points[matched], np.sqrt(variance), directions)
