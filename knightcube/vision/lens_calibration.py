"""Calibration of a camera lens from solved frames: focal length, optical axis and radial distortion.

The fit is a weighted least-squares fit in pixels to all frames at once, with an unknown attitude for each
frame. Wrong matches first get small Cauchy weights, which are scaled by the spread of the residuals. After
the robust steps, matches with residuals above five standard deviations are rejected. The three attitude
parameters of each frame are eliminated frame by frame with the Schur complement. After this elimination, the
normal equations have five unknowns for any number of frames.

Frames do not always determine all lens parameters. In a narrow field, a shift of the optical axis has nearly
the same effect as a rotation of the camera, so that a single frame hardly separates the two. Each lens
parameter therefore has a prior around an ideal lens with the initial focal length, the optical axis in the
image centre and no distortion. Parameters whose standard deviation exceeds half the prior standard deviation
are listed in `undetermined`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, brief
from knightcube.astro.attitude.solvers import solve
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import ArgumentError
from knightcube.vision.camera.lens import SHAPE_TERMS, CameraModel, Lens, LensError
from knightcube.vision.frame import grey_image
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.lens_knowledge import (
    MIN_COSINE,
    NONE,
    PARAMETERS,
    CalibrationError,
    FitStep,
    LensFit,
    MatchedFrame,
    UndeterminedAttitudeError,
    accepted_matches,
    cauchy_weights,
    matched_frame,
    parameters_of,
    residual_lengths,
    residuals,
    step,
)
from knightcube.vision.star_tracker import camera_of_field
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import FrameSolution, SolveSettings

MIN_STARS = 24
"""Minimum number of accepted star matches: three per parameter (five of the lens, three of an attitude)."""
_ROBUST_STEPS = 20
_MAX_STEPS = 50
_MAX_SELECTIONS = 10
_CONVERGED = 1e-6
"""Predicted decrease of chi-square at which the fit is converged."""
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)
"""Rounding error of a computed star position, as a fraction of focal length plus coordinates (px)."""
_DETERMINED = 0.5
"""Ratio of posterior to prior standard deviation below which a lens parameter counts as determined."""
_MAX_EXCESS = 3.0
"""Excess of chi-square, in its standard deviations, above which star position errors are increased."""
_HELD = {"k2": 1e-7, "k1": 1e-7, "centre": 1e-3}
"""Prior standard deviations that fix omitted lens terms (px for the centre).

Lens terms are omitted in the order k2, k1, centre.
"""
_USUAL_SHAPE = 0.02
"""Prior standard deviation of aspect, shear and the tangential distortion of image corners, as fractions."""
_SHOWN = 18.4
"""Chi-square (2 degrees of freedom, probability 1e-4) above which a pair of lens terms is significant."""
_SIXTH_POWER = 0.1
"""Prior standard deviation of the sixth-power distortion of an image corner, as a fraction."""
_ROUNDS = 3
"""Number of passes over the images. Each pass identifies the stars with the lens of the previous pass.

With a better lens model, more stars in the image corners match.
"""
_FIRST_SETTINGS = SolveSettings()
"""Settings of the star tracker in the first pass, which recognises mirrored images."""
_SETTINGS = SolveSettings(identification=IdentificationSettings(mirror=False))
"""Settings of the star tracker in later passes, which do not accept mirrored images."""
_REVERSED = "it is mirrored, but the other pictures are not"
_MIN_USED = 0.5
"""Minimum fraction of accepted star matches for a frame to be included in the fit of the common lens."""


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Prior standard deviations around the assumed lens. An infinite standard deviation means no prior.

    Attributes:
        focal_length: relative error of the focal length. The default `focal_length` allows any lens with a
            roughly known field of view.
        centre: error of the optical axis in the image, per axis, px. The default `centre` allows for the
            position error of a sensor that was mounted by hand.
        k1, k2: errors of the radial distortion coefficients. The defaults allow any lens except a fisheye.
        pixels: errors of the aspect and the shear of the pixels. The default `pixels` means square pixels.
        tangential: errors of the tangential distortion coefficients p1 and p2, by default zero.
    """

    focal_length: float = 0.1
    centre: float = 50.0
    k1: float = 1.0
    k2: float = 3.0
    pixels: float = NONE
    tangential: float = NONE

    def information(self, lens: Lens) -> FloatArray:
        """Return the prior information (9,) on PARAMETERS, as inverse variances.

        Raises CalibrationError unless all standard deviations are positive.
        """
        pairs = [self.pixels] * 2 + [self.tangential] * 2
        focal_length = self.focal_length * lens.focal_length
        sigma = np.array([focal_length, self.centre, self.centre, self.k1, self.k2, *pairs])
        if not np.all(sigma > 0.0):
            raise CalibrationError(f"{self}: standard deviations must be positive")
        return np.asarray(sigma**-2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated lens and its uncertainty.

    Attributes:
        lens: calibrated camera model.
        covariance: covariance (9, 9) of the lens parameters PARAMETERS, including the prior, multiplied by
            chi-square per degree of freedom if the residuals exceed their standard deviations significantly.
        undetermined: names of the PARAMETERS that are determined by the prior instead of the stars.
        attitudes: attitudes (m, 4) of the frames, from reference axes to camera axes.
        used: for each frame, mask (n,) of the accepted matches of stars.
        chi_square: chi-square of the residuals and the prior.
        degrees: number of degrees of freedom of `chi_square`.
        rms_before: rms residual of the accepted matches with the assumed lens, px.
        rms_after: rms residual of the accepted matches with the calibrated lens, px.
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
        """The standard deviations of the fitted lens parameters, in px for the first three."""
        sigmas = zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True)
        return {name: sigma for name, sigma in sigmas if name not in SHAPE_TERMS or sigma > 2.0 * NONE}

    @property
    def stars(self) -> int:
        """Number of used matches."""
        return sum(int(np.count_nonzero(used)) for used in self.used)

    @property
    def rejected_count(self) -> int:
        """The number of rejected matches of stars."""
        return sum(map(len, self.used)) - self.stars


def calibrate(
    frames: Sequence[MatchedFrame], initial: CameraModel, prior: LensPrior | None = None
) -> Calibration:
    """Return the lens that fits all frames best, starting from the camera `initial`.

    The prior, by default `LensPrior()`, is centred on a pinhole with the initial focal length. Raises
    CalibrationError for malformed frames, and if the fit does not converge to a valid lens.
    """
    _refuse_malformed(frames)
    begun = Lens.of(initial)
    information = (prior or LensPrior()).information(begun)
    expected = parameters_of(Lens.of(begun.ideal))
    attitudes = np.array([_attitude(frame, begun, number) for number, frame in enumerate(frames)])
    fit = LensFit(parameters_of(begun), attitudes)
    for _ in range(_ROBUST_STEPS):
        fit = step(frames, fit, cauchy_weights(residual_lengths(frames, fit)), information, expected).fit
    used = accepted_matches(residual_lengths(frames, fit))
    for _ in range(_MAX_SELECTIONS):
        last = _converged(frames, fit, used, information, expected)
        fit, before = last.fit, used
        used = accepted_matches(residual_lengths(frames, fit))
        if all(np.array_equal(a, b) for a, b in zip(before, used, strict=True)):
            return _result(frames, begun, last, used, information, expected)
    raise CalibrationError(
        f"the set of rejected matches still changes after {_MAX_SELECTIONS} fits: too many may be wrong"
    )


def _refuse_malformed(frames: Sequence[MatchedFrame]) -> None:
    """Raise CalibrationError if there are no frames, or for arrays with wrong shapes or non-finite values."""
    if not frames:
        raise CalibrationError("no frames: give at least one")
    for number, frame in enumerate(frames):
        n = len(frame.points)
        shapes = (frame.points.shape, frame.sigma.shape, frame.directions.shape)
        if shapes != ((n, 2), (n,), (n, 3)):
            raise CalibrationError(
                f"frame {number}: points, sigma and directions have shapes {shapes}: "
                "give (n, 2), (n,) and (n, 3)"
            )
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
            (weight,) = cauchy_weights(residual_lengths([frame], fit))
            # Weights stay positive, so that a correct match can regain weight after a poor initial attitude.
            weight = np.maximum(weight, 1e-6)
    except AttitudeError as error:
        raise CalibrationError(f"frame {number}: {error}") from error
    return quaternion


def _converged(
    frames: Sequence[MatchedFrame],
    fit: LensFit,
    used: Sequence[BoolArray],
    information: FloatArray,
    expected: FloatArray,
) -> FitStep:
    """Return the last step of the converged fit to the accepted matches `used`."""
    # Chi-square of the rounding errors; the fit has converged if chi-square decreases by less.
    least = 0.0
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
    """Return the calibration from the last step of the fit."""
    focal_length, x, y, k1, k2, *shape = last.fit.parameters.tolist()
    # Lens terms that the prior fixes at zero are set to exactly zero.
    shape = [value if known < NONE**-2 / 4.0 else 0.0 for value, known in zip(shape, prior[5:], strict=True)]
    try:
        lens = Lens(begun.columns, begun.rows, focal_length, (x, y), k1, k2, *shape)
    except LensError as error:
        raise CalibrationError(f"the fitted parameters do not describe a lens: {error}") from error
    offset = last.fit.parameters - expected
    squares = [
        length[chosen] ** 2 for length, chosen in zip(residual_lengths(frames, last.fit), used, strict=True)
    ]
    chi_square = float(np.sum(np.concatenate(squares)) + np.sum(prior * offset**2))
    count = sum(map(len, squares))
    degrees = 2 * count + int(np.count_nonzero(prior)) - len(PARAMETERS) - 3 * len(frames)
    if degrees <= 0:
        raise CalibrationError(f"{count} matches in {len(frames)} frames are too few to check the lens")
    covariance = np.asarray(np.linalg.inv(last.information + np.diag(prior)), dtype=np.float64)
    usual = LensPrior().information(begun)
    poor = np.diag(covariance) * np.where(prior > 0.0, prior, usual) > _DETERMINED**2
    held = prior > NONE**-2 / 4.0
    held[:5] = False
    undetermined = tuple(np.array(PARAMETERS)[poor & ~held].tolist())
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
    """Return the rms residual (px) of the accepted matches with each frame's best attitude."""
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
    """A lens term that the stars do not determine, with its last fitted `values` and their `sigmas`.

    In the calibrated lens, the term has the values `assumed`: one value for k1 or k2, and two values (x and
    y) for the centre.
    """

    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    assumed: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class DeterminedLens:
    """A calibration that includes only the lens terms determined by the stars.

    Attributes:
        calibration: calibration in which small prior standard deviations fix the omitted terms at assumed
            values.
        omitted: omitted lens terms by their names "k1", "k2" and "centre".
        accuracy: standard deviations of the lens parameters by the keys of `camera.accuracy` in a
            configuration. A key of `accuracy` is missing if the stars do not determine its lens term.
    """

    calibration: Calibration
    omitted: dict[str, OmittedTerm]
    accuracy: dict[str, float]


def calibrate_determined(frames: Sequence[MatchedFrame], initial: CameraModel) -> DeterminedLens:
    """Return the lens fitted to the frames with only those lens terms that the frames determine.

    The fit starts from the lens `initial`. Lens terms are omitted one at a time, starting with k2, if they
    are undetermined or if a distortion coefficient is smaller than its standard deviation. The remaining
    terms are fitted again after each omission. Raises CalibrationError.
    """
    prior = _shape_prior(frames, initial)
    whole = found = calibrate(frames, initial, prior)
    beyond = _sixth_power(frames, whole, prior)
    omitted: dict[str, OmittedTerm] = {}
    while (term := _next_omitted(found, omitted)) is not None:
        lens, sigma = found.lens, found.sigma
        if term == "centre":
            sigmas = sigma["centre_x"], sigma["centre_y"]
            omitted[term] = OmittedTerm(lens.centre, sigmas, lens.ideal.centre)
        else:
            omitted[term] = OmittedTerm((getattr(lens, term),), (sigma[term],), (0.0,))
        prior = replace(prior, **{term: _HELD[term]})
        # The fit starts at the assumed values, and small prior standard deviations fix the omitted terms.
        assumed: dict[str, Any] = {
            name: gone.assumed if name == "centre" else gone.assumed[0] for name, gone in omitted.items()
        }
        found = calibrate(frames, replace(lens, **assumed), prior)
    changed = _sixth_power(frames, found, prior)[:-1]
    found = replace(found, covariance=found.covariance + np.outer(changed, changed))
    return DeterminedLens(found, omitted, lens_accuracy(whole, found, omitted, beyond))


def _sixth_power(frames: Sequence[MatchedFrame], found: Calibration, prior: LensPrior) -> FloatArray:
    """Return the changes (10,) of PARAMETERS and sixth-power distortion if the fit includes this distortion.

    The sixth-power distortion is the displacement of an image corner, as a fraction of its distance from the
    image centre. The changes are zero unless the stars show a significant sixth-power distortion.
    """
    lens = found.lens
    corner = math.hypot(*lens.ideal.centre) / lens.focal_length
    extended = []
    for frame, attitude in zip(frames, found.attitudes, strict=True):
        in_camera = frame.directions @ attitude_matrix(attitude).T
        tangent = in_camera[:, :2] / np.maximum(in_camera[:, 2:], MIN_COSINE)
        power = np.sum((tangent / corner) ** 2, axis=1, keepdims=True) ** 3
        extended.append(replace(frame, late=lens.focal_length * tangent * power))
    begun = np.append(parameters_of(lens), 0.0)
    expected = np.append(parameters_of(Lens.of(lens.ideal)), 0.0)
    information = np.append(prior.information(lens), _SIXTH_POWER**-2)
    weights = [used.astype(float) for used in found.used]
    last = step(extended, LensFit(begun, found.attitudes), weights, information, expected)
    changes = last.fit.parameters - begun
    variance = np.linalg.inv(last.information + np.diag(information))[-1, -1]
    shown = changes[-1] ** 2 > _SHOWN * variance * max(found.chi_square / found.degrees, 1.0)
    return changes if shown else np.zeros_like(changes)


def _shape_prior(frames: Sequence[MatchedFrame], initial: CameraModel) -> LensPrior:
    """Return the prior in which aspect and shear, and p1 and p2, are free if they are significant."""
    corner = math.hypot(*initial.ideal.centre) / initial.focal_length
    free = LensPrior(pixels=_USUAL_SHAPE, tangential=_USUAL_SHAPE / corner)
    try:
        found = calibrate(frames, initial, free)
    except CalibrationError:
        return LensPrior()
    values = parameters_of(found.lens)
    shown = {}
    for name, terms in (("pixels", slice(5, 7)), ("tangential", slice(7, 9))):
        size = values[terms] @ np.linalg.solve(found.covariance[terms, terms], values[terms])
        names = PARAMETERS[terms]
        if float(size) > _SHOWN and not set(names) & set(found.undetermined):
            shown[name] = getattr(free, name)
    return replace(LensPrior(), **shown)


def _next_omitted(found: Calibration, omitted: dict[str, OmittedTerm]) -> str | None:
    """Return the next lens term to omit, or None if the stars determine all fitted terms."""
    fitted = [term for term in _HELD if term not in omitted]
    for term in fitted:
        if any(name.startswith(term) for name in found.undetermined):
            return term
    highest = next((term for term in ("k2", "k1") if term in fitted), None)
    if highest is not None and abs(getattr(found.lens, highest)) < found.sigma[highest]:
        return highest
    return None


def lens_accuracy(
    whole: Calibration, found: Calibration, omitted: dict[str, OmittedTerm], beyond: FloatArray | None = None
) -> dict[str, float]:
    """Return the standard deviations of lens parameters by the keys of `camera.accuracy` in a configuration.

    The standard deviations of focal length and centre are taken from the fit `found`, which does not include
    the omitted terms. The standard deviation of the focal length includes the difference from the focal
    length of the fit `whole`, which includes all terms. The distortion is expressed as the displacement of an
    image corner, as a fraction of the distance of the corner from the image centre. The standard deviation of
    the distortion includes the uncertainty of the fit with all terms, the difference between the two fits,
    and the changes `beyond` (10,) of `_sixth_power`.
    """
    lens, sigma = found.lens, found.sigma
    changed = whole.lens.focal_length - lens.focal_length
    accuracy = {"focal_length": math.hypot(sigma["focal_length"], changed) / lens.focal_length}
    if "centre" not in omitted:
        accuracy["centre"] = math.hypot(sigma["centre_x"], sigma["centre_y"]) / math.sqrt(2.0)
    square = (math.hypot(*lens.ideal.centre) / lens.focal_length) ** 2
    by_terms = np.array([1.0 / lens.focal_length, 0.0, 0.0, square, square**2, 0.0, 0.0, 0.0, 0.0])
    variance = float(by_terms @ whole.covariance @ by_terms)
    difference = float(by_terms @ (parameters_of(whole.lens) - parameters_of(lens)))
    error = 0.0 if beyond is None else float(by_terms @ beyond[:-1] + beyond[-1])
    distortion, assumed = math.hypot(math.sqrt(variance), difference, error), LensPrior()
    if distortion < _DETERMINED * math.hypot(assumed.k1 * square, assumed.k2 * square**2):
        accuracy["distortion"] = distortion
    return accuracy


def calibrate_one_lens(
    frames: Sequence[MatchedFrame], initial: CameraModel, focal_lengths: FloatArray, sigmas: FloatArray
) -> tuple[DeterminedLens, dict[int, str]]:
    """Return the common lens of the frames, and the reasons for excluding frames, by frame index.

    The arrays `focal_lengths` (m,) and `sigmas` (m,), px, contain the focal length determined from each frame
    alone, and its standard deviation. A frame is excluded if it was taken with another focus or zoom, or if
    its solution is wrong: if its focal length differs from the median by more than 5 standard deviations and
    by more than 1 %, or if a fit rejects more than half of its matches. Raises CalibrationError for the same
    reasons as `calibrate`.
    """
    # For an even number of frames, the median is the upper middle value, so that at least one frame is kept.
    usual = float(np.sort(focal_lengths)[len(focal_lengths) // 2])
    different = np.abs(focal_lengths - usual) > np.maximum(5.0 * sigmas, 0.01 * usual)
    excluded = {
        number: f"its focal length is {focal_lengths[number]:.1f} px, that of the others {usual:.1f} px"
        for number in np.flatnonzero(different).tolist()
    }
    while True:
        kept = [number for number in range(len(frames)) if number not in excluded]
        try:
            found = calibrate([frames[number] for number in kept], initial)
        except UndeterminedAttitudeError as error:
            if len(kept) == 1:
                raise
            excluded[kept[error.frame]] = "the lens of the other frames fits none of its stars"
            continue
        parts = np.array([used.mean() for used in found.used])
        worst = int(parts.argmin())
        if parts[worst] >= _MIN_USED or len(kept) == 1:
            return calibrate_determined([frames[number] for number in kept], initial), excluded
        excluded[kept[worst]] = f"the lens of the other frames fits {parts[worst]:.0%} of its stars"


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationImage:
    """One image of a lens calibration, with its solution.

    The attribute `excluded` states why a solved image is not used, and is empty for all other images.
    """

    solution: FrameSolution
    excluded: str = ""

    @property
    def reason(self) -> str:
        """The reason why the image is not used for the calibration.

        For an image that is used, `reason` is empty.
        """
        return self.excluded or ("" if self.solution.fix is not None else self.solution.reason)


@dataclass(frozen=True, slots=True, eq=False)
class LensCalibration:
    """Result of `calibrate_lens`. A `LensCalibration` is true (`if found:`) if a lens was determined.

    Attributes:
        determined: lens, standard deviations, omitted terms and accuracy, or None if no image was solved.
        images: images in the given order, each with its solution or the reason for excluding it.
        mirrored: whether the images show the mirrored sky. For mirrored images, `lens` describes the given
            images, but the solutions refer to the images after left and right are swapped.
    """

    determined: DeterminedLens | None
    images: tuple[CalibrationImage, ...]
    mirrored: bool = False

    def __bool__(self) -> bool:
        """Return whether a lens was determined."""
        return self.determined is not None

    def __repr__(self) -> str:
        """Return one line of text with the lens and the number of images."""
        return f"<LensCalibration of {len(self.images)} images: {self.lens or 'no lens was determined'}>"

    @property
    def lens(self) -> Lens | None:
        """The calibrated lens, for use as `StarTracker(camera=...)`, or None if no image was solved."""
        return None if self.determined is None else self.determined.calibration.lens


def calibrate_lens(
    images: Sequence[Image],
    *,
    fov_deg: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> LensCalibration:
    """Return the lens of a camera from images of the night sky.

    All images must be taken by one camera at one focus setting. Copies of an image, and images that do not
    fit the lens of the other images, are excluded. Ten images with stars in the corners give a better
    calibration than a hundred images without stars in the corners. Lens terms that the stars do not determine
    are omitted. If most images show a mirrored sky, because of a mirror or a reversed order of the rows, all
    images are mirrored back.

    Args:
        images: arrays (rows, columns) of counts, or colour images (rows, columns, 3), all of one shape.
        fov_deg: approximate field of view across the columns, deg. If it is None, 4 to 60 deg are tried.
        progress: function that is called before each image with the number of the pass and the number of the
            image, both counted from 1.

    Raises:
        UsageError: if no image is given, or if the images have different shapes.
        ArgumentError: if an image is not an array of 16 x 16 or more finite numbers without a mask.
        InputError: if the field of view is not between 1 and 120 deg.
        CalibrationError: if the solved images do not determine a lens.
    """
    images = _grey_images(images)
    if not (progress is None or callable(progress)):
        raise ArgumentError("progress", f"{brief(progress)}: give a function of two numbers")
    sky = default_index()
    model: CameraModel
    model, scale = camera_of_field(fov_deg, None, images[0].shape)
    lens: DeterminedLens | None = None
    outcomes: list[CalibrationImage] = []
    reversed_images: list[int] = []
    for round_number in range(1, _ROUNDS + 1):
        outcomes = []
        for number, image in enumerate(images, start=1):
            if progress is not None:
                progress(round_number, number)
            settings = _FIRST_SETTINGS if round_number == 1 else _SETTINGS
            outcomes.append(CalibrationImage(solve_frame(image, model, scale, 1.0, sky, settings)))
        solved = [number for number, outcome in enumerate(outcomes) if outcome.solution.fix is not None]
        reversed_images += [number for number in solved if outcomes[number].solution.mirrored]
        if lens is None and 2 * len(reversed_images) > len(solved):
            turned = [image[:, ::-1] for image in images]
            return _mirrored_back(calibrate_lens(turned, fov_deg=fov_deg, progress=progress))
        for number, reason in (_repeated(images) | dict.fromkeys(reversed_images, _REVERSED)).items():
            outcomes[number] = replace(outcomes[number], excluded=reason)
        solved = [number for number in solved if not outcomes[number].excluded]
        if not solved:
            return LensCalibration(None, tuple(outcomes))
        solutions = [outcomes[number].solution for number in solved]
        focal_lengths = np.array([solution.camera.focal_length for solution in solutions])
        sigmas = focal_lengths * np.array([solution.scale_sigma for solution in solutions])
        median = int(np.argsort(focal_lengths)[len(solved) // 2])
        initial = solutions[median].camera if lens is None else model
        matches = [matched_frame(solution, sky) for solution in solutions]
        lens, excluded = calibrate_one_lens(matches, initial, focal_lengths, sigmas)
        for number, reason in excluded.items():
            outcomes[solved[number]] = replace(outcomes[solved[number]], excluded=reason)
        model, scale = lens.calibration.lens, (0.999, 1.001)
    return LensCalibration(lens, tuple(outcomes))


def _grey_images(images: Sequence[Image]) -> list[Image]:
    """Return the images as grey images.

    Raises ArgumentError, with the number of the image from 1, for an unsuitable image or another shape.
    """
    if not np.iterable(images):
        raise ArgumentError("images", f"{brief(images)}: give a sequence of images")
    found: list[Image] = []
    for number, image in enumerate(images, start=1):
        try:
            found.append(grey_image(image))
        except ArgumentError as error:
            raise ArgumentError(f"images, number {number}", error.problem) from None
        if found[-1].shape != found[0].shape:
            shapes = f"an array of shape {found[-1].shape}, but the first image has {found[0].shape}"
            raise ArgumentError(f"images, number {number}", f"{shapes}: give images of one camera")
    if not found:
        raise ArgumentError("images", "no image: give images of the night sky")
    return found


def _repeated(images: Sequence[Image]) -> dict[int, str]:
    """Return the reasons, by image index, for excluding images with the same pixels as an earlier image.

    The errors of such images are not independent.
    """
    first: dict[bytes, int] = {}
    found: dict[int, str] = {}
    for number, image in enumerate(images):
        earlier = first.setdefault(hashlib.sha256(image.tobytes()).digest(), number)
        if earlier != number:
            found[number] = f"it has the pixels of picture {earlier + 1}: give different pictures"
    return found


def _mirrored_back(found: LensCalibration) -> LensCalibration:
    """Return the calibration of mirrored images, given that of the images with reversed rows (`found`)."""
    if found.determined is None:
        return replace(found, mirrored=True)
    determined = found.determined
    calibration = determined.calibration
    last = calibration.lens.columns - 1.0
    lens = calibration.lens
    centre = last - lens.centre[0], lens.centre[1]
    lens = replace(lens, centre=centre, shear=-lens.shear, p2=-lens.p2)
    sign = np.array([-1.0 if name in ("centre_x", "shear", "p2") else 1.0 for name in PARAMETERS])
    covariance = calibration.covariance * np.outer(sign, sign)
    omitted = dict(determined.omitted)
    if "centre" in omitted:
        x, y = omitted["centre"].values
        omitted["centre"] = replace(omitted["centre"], values=(last - x, y))
    calibration = replace(calibration, lens=lens, covariance=covariance)
    return replace(
        found, determined=replace(determined, calibration=calibration, omitted=omitted), mirrored=True
    )
