"""Joint fit of the motion and the brightest stars, together with the fainter stars on the same pixels.

The fit iterates until the steps of the shared parameters are small. The fit covers only a few pixels beyond
the ends of the streaks. The fit can therefore converge to a wrong rotation angle. If the fitted rotation is
too small, the model may match only one end of every streak. The function `true_ends` detects flux beyond the
modelled streak ends. If the fitted rotation is too large, the modelled streaks extend over dark pixels. The
function `unbroken` detects gaps, which are dark segments within a streak. If a modelled streak end lies more
than a few point-spread widths beyond the true end, the pixels around it contain no starlight, and the fit
does not move the modelled end to the true end. The function `stretched` therefore searches a longer distance
for the true ends and corrects the streak length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import fdtri

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.faint_stars import FaintStars, find_faint
from knightcube.vision.streaks.fit_windows import FitWindows, cut_windows, star_pixels, window_areas
from knightcube.vision.streaks.frame import ReducedFrame
from knightcube.vision.streaks.geometry import (
    Shutter,
    StreakScene,
    exposure_bounds,
    mid_exposure_positions,
    near_streaks,
    path_lengths,
    paths,
    positions,
    sensitivities,
)
from knightcube.vision.streaks.normal_equations import (
    ALONE,
    SHARED,
    WIDTH,
    Evaluation,
    Solution,
    consistent_stars,
    estimates_of,
    evaluate,
    solve,
    star_equations,
)
from knightcube.vision.streaks.scene_images import light_images, light_of
from knightcube.vision.streaks.streak_result import LikelihoodSettings

# Number of processed pixels per frame after which no further motion is fitted.
# A fit in progress is completed, so that the number of processed pixels can reach twice this limit.
_MOST_WORK = 2_000_000
# Fixed work of one evaluation of the model, expressed as a number of processed pixels.
_EVALUATION = 15_000
# Ratio of the work per pixel in an evaluation with a vibration to the work per pixel without one.
_VIBRATING = 6
# Ratio of the work per pixel in a pass over the frame to the work per pixel in a model evaluation.
_PASS = 0.15


class WorkBudget:
    """Work spent on one frame, counted in pixels so that results do not depend on the machine's speed."""

    def __init__(self) -> None:
        self._spent = 0.0

    def evaluated(self, pixels: int) -> None:
        """Add the work of one model evaluation on `pixels` pixels to the work spent on the frame."""
        self._spent += pixels + _EVALUATION

    def passed(self, pixels: int) -> None:
        """Add the work of one pass over a frame with `pixels` pixels to the work spent on the frame."""
        self._spent += _PASS * pixels

    @property
    def exhausted(self) -> bool:
        """Whether the work exceeds the limit after which no further motion is fitted."""
        return self._spent > _MOST_WORK


# Largest displacement (px) of a streak end in one iteration of the fit.
_LONGEST_STEP = 3.0
# Displacement (px) of a streak end after which the pixels of the fit windows are selected again.
_DRIFT = 2.0
# Displacement (px) of a star without effect on the motion after which the first iteration selects pixels
# again. Later iterations ignore the displacements of such stars, which are often poorly known.
_FAINT_DRIFT = 3.2
# Change of the angular acceleration, as a fraction of the rotation, above which pixels are selected again.
_GROWN = 0.1
# Largest step of the shared parameters (standard deviations) after which the fit counts as converged.
SETTLED = 0.4
# Largest ratio of the lengths of a step and the preceding step that counts as progress of the fit.
_LEAST_PROGRESS = 0.7
# Number of iterations after which the set of pixels excluded as outliers is fixed.
_LOOKS = 1
# Probability of a false alarm of the score test for a changing rate.
_BY_CHANCE = 1e-4
# Fraction of the score test's threshold below which an approximate statistic confirms a constant rate.
_FAR_BELOW = 0.5
# Number of acceleration components, which is the number of degrees of freedom of the score test.
_GROWTHS = 3
GROWING = np.ones(SHARED, dtype=np.bool_)
"""Mask of the shared parameters that are free in a fit with a changing rate."""
# Largest point-spread width (px) in a joint fit.
_WIDEST = 6.0
# Largest ratio of the fitted to the initial point-spread width in a joint fit.
_WIDEST_RATIO = 1.6


@dataclass(frozen=True, slots=True)
class IterationLimits:
    """Limits of the iteration.

    Attributes:
        rounds: maximum number of iterations of the fit.
        clipped: whether pixels with residuals far beyond the noise are excluded from the fit.
        tolerance: largest step (px) of a streak end or of the width at which the fit is converged.
        settled: largest step (standard deviations) of the shared parameters at which the fit is converged.
        conjugate: maximum number of conjugate-gradient iterations for the coupling of stars.
        patience: number of iterations before the first check of the fit's progress.
    """

    rounds: int
    clipped: bool
    tolerance: float
    settled: float
    conjugate: int
    patience: int


FIRST = IterationLimits(6, clipped=False, tolerance=0.1, settled=SETTLED, conjugate=4, patience=2)
ROUGH = IterationLimits(3, clipped=True, tolerance=0.003, settled=1.5, conjugate=6, patience=3)
LAST = IterationLimits(7, clipped=True, tolerance=0.003, settled=SETTLED, conjugate=12, patience=4)


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """A frame with the camera data and settings for a fit of motion and stars.

    The initial standard deviation of the point spread is `sigma`, px. If the fit is `growing`, the angular
    acceleration is fitted. The rotation vector must have a positive component along `sense` (3,), unless
    `sense` is None. The `course` is the motion from the navigation filter, or None if it is unknown or nearly
    uniform. The attribute `work` counts the computing work spent on this frame so far.
    """

    frame: ReducedFrame
    pinhole: Pinhole
    shutter: Shutter
    settings: LikelihoodSettings
    sigma: float
    growing: bool = False
    sense: FloatArray | None = None
    course: CameraMotion | None = None
    work: WorkBudget = field(default_factory=WorkBudget)

    @property
    def free(self) -> BoolArray:
        """Mask (SHARED,) of the parameters that are fitted, among the parameters common to all stars."""
        return np.array([True] * 3 + [self.growing] * 3 + [True])

    @property
    def undecided(self) -> bool:
        """Whether a score test decides between a constant and a changing rate."""
        return self.settings.rate_model == "auto" and not self.growing

    def windows(self, scene: StreakScene) -> FitWindows:
        """Return the fit windows, which contain the pixels near the streaks of `scene`."""
        return cut_windows(self.frame, self.pinhole, self.shutter, scene, self.settings.reach)

    def evaluate(self, scene: StreakScene, windows: FitWindows, clip: float) -> Evaluation:
        """Return the normal equations for `scene`, see `normal_equations.evaluate`."""
        times = _VIBRATING if scene.motion.vibration.exists else 1
        self.work.evaluated(len(windows.slot) * len(scene.profile.widths) * times)
        tested = self.undecided and clip > 0.0
        return evaluate(self.pinhole, self.shutter, scene, windows, clip, self.growing, tested)


@dataclass(frozen=True, slots=True, eq=False)
class StreakFit:
    """A fitted scene with the solution and the normal equations of the last step.

    The normal equations are those of the scene `before` the last step. The attribute `last_step` is the last
    step of the motion, in standard deviations, or 0 if the fit is converged. The mask `free` (SHARED,)
    selects the fitted parameters among the shared parameters. The stars `hidden` were subtracted from the
    frame instead of fitted; None if the fit did not subtract stars.
    """

    scene: StreakScene
    before: StreakScene
    solution: Solution
    evaluation: Evaluation
    last_step: float
    windows: FitWindows
    free: BoolArray
    hidden: StreakScene | None = None

    def grows(self) -> bool:
        """Return whether a score test rejects a constant rate.

        If the scatter of the stars' estimates exceeds their noise, the significance is computed from the
        scatter (Hotelling's T-squared test). Therefore, a single blended star cannot make the step of the
        shared parameters significant.
        """
        # In most cases, an approximation without the coupling of stars on shared pixels is sufficient.
        for conjugate, share in ((0, _FAR_BELOW), (LAST.conjugate, 1.0)):
            solution = solve(self.evaluation, self.scene, GROWING, conjugate)
            if solution is None:
                return False
            each = star_equations(self.evaluation, solution.eliminated)
            part = solution.shared[each.kept]
            asked, due = each.score @ part, np.einsum("i,nij,j->n", part, each.information, part)
            stars = int(np.count_nonzero(due > 0.0))
            freedom = stars - _GROWTHS
            if freedom < 1:
                return False
            spread = float(np.sum((asked - due) ** 2)) * stars / max(stars - 1, 1)
            agreed = float(due.sum()) ** 2 / max(float(due.sum()), spread, 1e-300)
            limit = float(fdtri(_GROWTHS, freedom, 1.0 - _BY_CHANCE)) * _GROWTHS * (stars - 1) / freedom
            if agreed <= share * limit:
                return False
        return True


def iterate(
    camera: FitProblem,
    scene: StreakScene,
    free: BoolArray,
    how: IterationLimits,
    windows: FitWindows | None = None,
    known: Evaluation | None = None,
) -> StreakFit | None:
    """Return the fit of all stars and the shared parameters in the mask `free`, or None if it fails.

    An additional first iteration uses the normal equations `known` of `scene`, unless they are None.
    """
    faint_drift, cut_at = _FAINT_DRIFT if windows is None else np.inf, scene
    windows = whole = windows or camera.windows(scene)
    last_step, previous, before = np.inf, np.inf, np.zeros(SHARED)
    clip, widest = (camera.settings.clip, _WIDEST_RATIO * scene.width) if how.clipped else (0.0, _WIDEST)
    before_step, solution, evaluation = scene, None, None
    for turn in range(how.rounds + (known is not None)):
        evaluation = None  # The old normal equations, tens of MB, are freed before the next evaluation.
        evaluation, known = known or camera.evaluate(scene, windows, clip), None
        solution = solve(evaluation, scene, free, how.conjugate)
        if solution is None:
            return None
        before_step, (scene, wanted) = scene, _stepped(scene, solution, camera.pinhole)
        valid = 0.3 < scene.width < _WIDEST and scene.width <= widest and bool(np.isfinite(scene.stars).all())
        if not valid or not np.linalg.norm(scene.motion.rotation) <= np.pi:
            return None
        steps = np.abs(solution.shared / np.sqrt(np.maximum(np.diag(solution.covariance), 1e-30)))[free]
        # The width, the last parameter, oscillates if the set of excluded pixels changes with it.
        last_step = float(np.max(steps[:-1] if how.clipped else steps, initial=0.0))
        if np.max(steps) <= how.settled or wanted <= how.tolerance:
            last_step = 0.0
            break
        # Two consecutive steps of the fit in the same direction also count as progress.
        variance = np.maximum(np.diag(solution.covariance), 1e-30)
        onward = float(np.sum(solution.shared * before / variance)) > 0.0
        if turn >= how.patience and wanted > _LEAST_PROGRESS * previous and not onward:
            break
        previous, before = wanted, solution.shared
        if _drifted(camera, cut_at, scene, faint_drift if turn == 0 else np.inf):
            # The old fit windows, tens of MB, are freed before new fit windows are selected.
            del windows, whole
            windows = whole = camera.windows(scene)
            cut_at = scene
        elif how.clipped and turn >= _LOOKS:
            # The fit cannot converge while the set of pixels excluded as outliers changes.
            windows = whole.only(*evaluation.kept)
    if solution is None or evaluation is None:
        return None
    return StreakFit(scene, before_step, solution, evaluation, last_step, whole, free)


def _stepped(scene: StreakScene, solution: Solution, pinhole: Pinhole) -> tuple[StreakScene, float]:
    """Return the scene after a step of the fit that is limited to `_LONGEST_STEP` px at each streak end.

    The second returned value is the largest displacement (px) of a streak end by the unlimited step, or the
    change (px) of the point-spread width if that is larger.
    """
    stars, time = np.tile(scene.stars, (2, 1)), np.repeat([-0.5, 0.5], len(scene.stars))
    growing = bool(solution.shared[3:6].any())
    change = sensitivities(pinhole, scene.motion, stars, time, growing)
    along = change.reshape(-1, 8) @ np.append(solution.shared[:6], [0.0, 0.0])
    ends = float(np.hypot(along[::2], along[1::2]).max(initial=0.0))
    share = min(
        1.0, _LONGEST_STEP / max(ends, 1e-9), 0.3 * scene.width / max(abs(solution.shared[WIDTH]), 1e-9)
    )
    step = solution.alone * share
    far = np.hypot(step[:, 0], step[:, 1])
    step[:, :2] *= np.minimum(1.0, _LONGEST_STEP / np.maximum(far, 1e-9))[:, None]
    shared = share * solution.shared
    turn, growth = scene.motion.rate + shared[:3], scene.motion.acceleration + shared[3:6]
    after = replace(
        scene,
        motion=replace(scene.motion, rate=turn, acceleration=growth),
        width=scene.width + float(shared[WIDTH]),
        stars=scene.stars + step[:, :2],
        light=np.maximum(scene.light + step[:, 2], 0.3 * scene.light),
        sky=scene.sky + step[:, 3],
    )
    return after, max(ends, abs(float(solution.shared[WIDTH])))


def _drifted(camera: FitProblem, before: StreakScene, after: StreakScene, faint: float) -> bool:
    """Return whether new fit windows are needed, because streak ends moved or the acceleration changed.

    New windows are needed if a streak end moved by more than `_DRIFT` px. For stars that have no effect on
    the motion, the limit is `faint` px.
    """
    grown = float(np.linalg.norm(after.motion.acceleration - before.motion.acceleration))
    if grown > _GROWN * float(np.linalg.norm(after.motion.rotation)):
        return True
    n = len(before.stars)
    at = np.repeat([-0.5, 0.5], n)
    there = positions(camera.pinhole, after.motion, np.tile(after.stars, (2, 1)), at)
    was = positions(camera.pinhole, before.motion, np.tile(before.stars, (2, 1)), at)
    far = np.abs(there - was).max(axis=1).reshape(2, n).max(axis=0)
    return bool(np.any(far > np.where(after.trusted, _DRIFT, faint)))


def misfit(evaluation: Evaluation, stars: IntArray | slice = slice(None)) -> float:
    """Return the median chi-square per degree of freedom of the selected `stars`, or NaN for no stars."""
    freedom = np.maximum(evaluation.pixels[stars] - ALONE - 1.0, 1.0)
    return float(np.median(evaluation.chi2[stars] / freedom)) if len(freedom) else float("nan")


# Length of the segments compared at each streak end, as a fraction of the path length.
_STRETCH = 0.1
# Minimum length (px) of the segments compared at each streak end.
_LEAST_STRETCH = 8.0
# Distance (px) between a streak end and the compared segments, which lie on both sides of the end.
_FROM_END = 4.0
# Number of samples along a segment of a path at a streak end.
_SAMPLES = 24
# Number of segments into which a streak is divided in the search for gaps (dark segments).
_WITHIN = 10
# Number of samples in each segment of a streak that is searched for gaps.
_WITHIN_SAMPLES = 10
# Distances (px) from a star's path at which the pixels are sampled.
_ASIDE = np.array([-1.0, 0.0, 1.0])
# Number of central pixels across a streak whose mean counts are the intensity of the streak.
_MIDDLE = 3
# Ratio of measured to expected intensity below which a segment of a streak counts as dark.
_HALF = 0.5
# Minimum fraction of usable pixels in a streak segment whose intensity is measured.
_LEAST_VALID = 0.7
# Minimum expected intensity (standard deviations) of a segment for the test whether it is dark.
_LEAST_SIGNIFICANCE = 4.0
# Number of instants of the exposure at which the rotation angle is evaluated.
_INSTANTS = 65
# Intensity on both sides of a streak end, as a multiple of the streak's intensity, that hides the end.
_HIDDEN = 3.0
# Lower limit of the star's speed from which the intensity is predicted, as a fraction of the mean speed. The
# PSF keeps the intensity finite at points at which the star is nearly at rest.
_SLOW = 0.5
# Minimum intensity beyond a streak end that counts as a trail, as a fraction of the mean intensity.
_TRAIL = 0.08
# Largest fraction of dark segments in a streak without gaps.
_DARK = 0.15


def true_ends(camera: FitProblem, scene: StreakScene) -> FloatArray:
    """Return 1 for each confirmed and 0 for each wrong end of the streaks of `scene`, as an array (n, 2).

    A streak end is confirmed if the pixels on its inner side contain starlight and the pixels on its outer
    side do not, or if the intensity decreases at the end by as much as expected, in spite of light of other
    stars. The value is NaN for an end outside the detector, for the ends of very short or very faint streaks,
    and for an end that is hidden by brighter streaks.
    """
    out = np.full((len(scene.stars), 2), np.nan)
    length = path_lengths(camera.pinhole, scene.motion, scene.stars)
    long = length > 2.0 * (_FROM_END + _LEAST_STRETCH)
    if not long.any():
        return out
    scene, length = scene.select(long), length[long]
    instants = np.linspace(-0.5, 0.5, _INSTANTS)
    # A small linear term makes the rotation angle strictly increasing even while the camera is at rest.
    progress = np.maximum.accumulate(scene.motion.progress(instants)) + 1e-9 * np.arange(_INSTANTS)
    stretch = np.maximum(_STRETCH * length, _LEAST_STRETCH)
    away = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * stretch[:, None]
    for end, sign, steady, there, speed in _end_motions(camera, scene):
        # The expected intensity of a streak segment is proportional to the time that the star spends in it.
        near, far = _FROM_END / speed, (_FROM_END + stretch) / speed
        last = progress[-1 if sign > 0.0 else 0]
        begin, stop = (np.interp(last - sign * distance, progress, instants) for distance in (near, far))
        relative = np.abs(stop - begin) / np.maximum(far - near, 1e-9)
        expected = expected_brightness(scene, length) * relative
        time = sign * away / speed[:, None]
        (within, error), (beyond, other) = (brightness(camera, steady, there, t) for t in (-time, time))
        known = expected > _LEAST_SIGNIFICANCE * np.hypot(error, other)
        known &= np.isfinite(within) & (np.fmin(within, beyond) < _HIDDEN * expected) & np.isfinite(beyond)
        half = _HALF * expected
        true = ((within > half) & (beyond < half)) | (within - beyond > half)
        out[long, end] = np.where(known, true, np.nan)
    return out


def trailing_fraction(camera: FitProblem, scene: StreakScene) -> float:
    """Return the fraction of the tested stars with a trail, which is faint flux beyond a streak end.

    A wrong angular acceleration in the fit causes trails of flux beyond streak ends.
    """
    length = path_lengths(camera.pinhole, scene.motion, scene.stars)
    faint = _TRAIL * expected_brightness(scene, length)
    away = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * _LEAST_STRETCH
    judged, lit = np.zeros((2, len(scene.stars)), dtype=np.bool_)
    for _, sign, steady, there, speed in _end_motions(camera, scene):
        mean, deviation = brightness(camera, steady, there, sign * away / speed[:, None])
        known = np.isfinite(mean) & (faint > _LEAST_SIGNIFICANCE * deviation)
        judged |= known
        lit |= known & (mean > faint)
    return float(np.mean(lit[judged])) if judged.any() else 0.0


def _end_motions(
    camera: FitProblem, scene: StreakScene
) -> Iterator[tuple[int, float, CameraMotion, FloatArray, FloatArray]]:
    """Yield five values for the first ends of all streaks, and then for the second ends.

    The values are the index of the end (0 or 1), the sign of the time beyond the end (-1 or 1), the uniform
    motion, the positions of the ends (n, 2), px, and the speeds (n,), px per exposure. The paths are
    extrapolated with a uniform motion, because the star may have no speed at a streak end.
    """
    times = exposure_bounds(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    steady = CameraMotion.steady(scene.motion.rotation)
    for end, sign in ((0, -1.0), (1, 1.0)):
        there = positions(camera.pinhole, scene.motion, scene.stars, times[:, end])
        velocity = paths(camera.pinhole, steady, there, np.zeros(len(there))).velocity
        yield end, sign, steady, there, np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-3)


def unbroken(camera: FitProblem, scene: StreakScene) -> FloatArray:
    """Return an array (k,) with 1 for each tested star whose streak has no gaps, otherwise 0.

    Only the part of a star's path that is on the detector is tested for gaps. Stars with very short or very
    faint streaks are not tested.
    """
    length = path_lengths(camera.pinhole, scene.motion, scene.stars)
    long = length > _WITHIN * _LEAST_STRETCH
    if not long.any():
        return np.empty(0)
    scene, length = scene.select(long), length[long]
    times = exposure_bounds(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    share = (np.arange(_WITHIN * _WITHIN_SAMPLES) + 0.5) / (_WITHIN * _WITHIN_SAMPLES)
    time = times[:, :1] + (times[:, 1:] - times[:, :1]) * share
    each = np.repeat(scene.stars, _WITHIN, axis=0)
    mean, deviation = brightness(camera, scene.motion, each, time.reshape(len(each), _WITHIN_SAMPLES))
    rate = np.clip(scene.motion.relative_rate(time.reshape(-1)), _SLOW, None)
    rate = rate.reshape(len(each), _WITHIN_SAMPLES)
    expected = np.repeat(expected_brightness(scene, length), _WITHIN) * np.mean(1.0 / rate, axis=1)
    known = np.isfinite(mean) & (expected > _LEAST_SIGNIFICANCE * deviation)
    dark = (known & (mean < _HALF * expected)).reshape(-1, _WITHIN).sum(axis=1)
    known_of = known.reshape(-1, _WITHIN).sum(axis=1)
    judged = known_of > 0
    return np.asarray(dark[judged] <= _DARK * known_of[judged], dtype=float)


def expected_brightness(scene: StreakScene, length: FloatArray) -> FloatArray:
    """Return the expected intensity (n,), counts, of the n streaks of `scene` with the `length` (n,), px."""
    share = math.erf(0.5 * _MIDDLE / (math.sqrt(2.0) * scene.width)) / _MIDDLE
    return np.asarray(share * scene.light / length)


def brightness(
    camera: FitProblem, motion: CameraMotion, stars: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean counts (n,) of pixels along path segments, and the standard errors (n,) of these means.

    The argument `time` (n, s) contains s sampling times for each of the n path segments. The mean of a
    segment with too few usable pixels is NaN.
    """
    frame, pinhole, samples = camera.frame, camera.pinhole, time.shape[1]
    there = paths(pinhole, motion, np.repeat(stars, samples, axis=0), time.reshape(-1))
    position, velocity = np.ascontiguousarray(there.position.T), np.ascontiguousarray(there.velocity.T)
    shape = pinhole.columns, pinhole.rows
    return _band_means(position, velocity, (frame.signal, frame.floor, frame.bad), shape, samples)


_FramePixels = tuple[Float32Array, Float32Array, BoolArray]
"""Signal, noise variance (`floor`) and bad pixels of a `ReducedFrame`, as flat arrays."""


def _band_means_numpy(
    position: FloatArray, velocity: FloatArray, frame: _FramePixels, shape: tuple[int, int], samples: int
) -> tuple[FloatArray, FloatArray]:
    """Return the result of `brightness`, given the positions and velocities (2, n * samples) of all samples.

    The argument `shape` contains the numbers of columns and rows of the frame.
    """
    (columns, rows), (signal, floor, bad) = shape, frame
    way = velocity / np.maximum(np.hypot(velocity[0], velocity[1]), 1e-3)
    x = np.rint(position[0] - _ASIDE[:, None] * way[1]).astype(np.int64)
    y = np.rint(position[1] + _ASIDE[:, None] * way[0]).astype(np.int64)
    seen = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    index = np.where(seen, y * columns + x, 0)
    seen &= ~bad[index]

    def summed(values: FloatArray | BoolArray | Float32Array) -> FloatArray:
        by_segment = values.reshape(len(_ASIDE), -1, samples)
        return np.asarray(by_segment.sum(axis=(0, 2), dtype=np.float64))

    count = summed(seen)
    enough = count >= _LEAST_VALID * samples * len(_ASIDE)
    total, variance = summed(np.where(seen, signal[index], 0.0)), summed(np.where(seen, floor[index], 0.0))
    count = np.maximum(count, 1.0)
    return np.where(enough, total / count, np.nan), np.sqrt(variance) / count


@compiled_form_of(_band_means_numpy)
def _band_means(
    position: FloatArray, velocity: FloatArray, frame: _FramePixels, shape: tuple[int, int], samples: int
) -> tuple[FloatArray, FloatArray]:
    (columns, rows), (signal, floor, bad) = shape, frame
    segments = position.shape[1] // samples
    mean, deviation = np.empty(segments), np.empty(segments)
    for n in range(segments):
        total, variance, count = 0.0, 0.0, 0
        for m in range(n * samples, (n + 1) * samples):
            speed = max(math.sqrt(velocity[0, m] ** 2 + velocity[1, m] ** 2), 1e-3)
            for side in range(len(_ASIDE)):
                x = round(position[0, m] - _ASIDE[side] * (velocity[1, m] / speed))
                y = round(position[1, m] + _ASIDE[side] * (velocity[0, m] / speed))
                if 0 <= x < columns and 0 <= y < rows and not bad[y * columns + x]:
                    total, variance = total + signal[y * columns + x], variance + floor[y * columns + x]
                    count += 1
        enough = count >= _LEAST_VALID * samples * len(_ASIDE)
        mean[n], deviation[n] = total / count if enough else np.nan, math.sqrt(variance) / max(count, 1)
    return mean, deviation


# Half the length of the search range around a modelled streak end, as a fraction of the path length.
_REACH = 0.08
# Minimum and maximum of half the length (px) of the search range around a streak end.
_LEAST_REACH, _MOST_REACH = 10.0, 40.0
# Number of samples in the search range for a streak end.
_STEPS = 41
# Minimum significance (standard deviations) of the flux near a streak end for the end to be measured.
_EDGE_SIGNIFICANCE = 5.0
# Upper limit of a sample's intensity (multiple of its expectation), which limits the effect of other stars.
_CAP = 2.0
# Minimum number of streaks with a wrong length for a correction of the rotation angle.
_LEAST_STREAKS = 3
# Length error (px) above which the length of a streak counts as wrong.
_LEAST_OFF = 4.0
# Difference (px) between the length errors of two streaks below which these errors count as equal.
_ALIKE = 3.0
# Minimum ratio of consistently wrong to correct streak lengths for a correction of the rotation angle.
_MORE = 2
# Largest relative change of the rate for which the rotation angle is corrected.
_MOST_STRETCHED_CHANGE = 0.5


def find_light_ends(camera: FitProblem, scene: StreakScene) -> tuple[FloatArray, FloatArray]:
    """Return the distances (n, 2), px, of measured from modelled streak ends, and path lengths (n,), px.

    A distance is positive outwards, and NaN if the streak end cannot be measured.
    """
    motion, stars = scene.motion, scene.stars
    length = path_lengths(camera.pinhole, motion, stars)
    beyond = np.full((len(stars), 2), np.nan)
    long = np.flatnonzero(length > 2.0 * _LEAST_REACH)
    if not len(long):
        return beyond, length
    stars, own = stars[long], np.maximum(length[long], 1.0)
    reach = np.clip(_REACH * own, _LEAST_REACH, _MOST_REACH)
    outward = np.linspace(-1.0, 1.0, _STEPS) * reach[:, None]
    times = exposure_bounds(camera.pinhole, motion, camera.shutter, stars)
    expected = expected_brightness(scene.select(long), own)[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        time = times[:, end, None] + sign * outward / own[:, None]
        repeated = np.repeat(stars, _STEPS, axis=0)
        mean, deviation = brightness(camera, motion, repeated, time.reshape(-1, 1))
        mean, deviation = mean.reshape(-1, _STEPS), np.maximum(deviation.reshape(-1, _STEPS), 1e-6)
        seen = np.minimum(np.maximum(mean, -expected), _CAP * expected)
        # The log-likelihood ratio of starlight to a dark background is summed outwards.
        explained = np.cumsum((seen - 0.5 * expected) * expected / deviation**2, axis=1)
        last = np.argmax(explained, axis=1)
        sure = np.sum((expected / deviation) ** 2, axis=1) > _EDGE_SIGNIFICANCE**2
        known = np.isfinite(mean).all(axis=1) & sure
        found = outward[np.arange(len(last)), last] + 0.5 * (outward[:, 1] - outward[:, 0])
        beyond[long, end] = np.where(known, found, np.nan)
    return beyond, length


def stretched(camera: FitProblem, scene: StreakScene) -> StreakScene | None:
    """Return `scene` with the rotation corrected so that modelled and measured streak ends agree.

    Returns None if no correction is needed, or if the rate changes so much that the intensity varies along a
    streak. Each star is moved to the midpoint of its measured ends. If only one end is in the frame, the star
    is moved to half a streak length from this end.
    """
    if abs(scene.motion.relative_acceleration) > _MOST_STRETCHED_CHANGE:
        return None
    beyond, length = find_light_ends(camera, scene)
    off = beyond.sum(axis=1)
    known = np.isfinite(off)
    off, own = off[known], length[known]
    wrong = off[np.abs(off) > _LEAST_OFF]
    if len(wrong) < _LEAST_STREAKS:
        return None
    agree = np.abs(wrong[:, None] - off) < _ALIKE
    most = agree[np.argmax(agree.sum(axis=1))]
    if most.sum() < max(_LEAST_STREAKS, _MORE * np.count_nonzero(np.abs(off) <= _LEAST_OFF)):
        return None
    stretch = float(np.median(off[most] / own[most]))
    if stretch == 0.0:
        return None
    off = beyond / np.maximum(length, 1.0)[:, None]
    # Each measured streak end gives the time at which the uncorrected path reaches the true midpoint.
    middle = np.stack([0.5 * stretch - off[:, 0], off[:, 1] - 0.5 * stretch], axis=-1)
    known = np.isfinite(middle)
    time = np.where(known, middle, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    moved = positions(camera.pinhole, scene.motion, scene.stars, time)
    motion = replace(scene.motion, rate=scene.motion.rate + stretch * scene.motion.rotation)
    return replace(scene, motion=motion, stars=moved)


# Largest ratio of the rate's change to the mid-exposure rate; the ratio is 2 for a motion from or to rest.
_MOST_CHANGE = 2.2
# Deviation (standard deviations) from the majority above which a star is excluded from the motion fit.
_TRUST_SIGMAS = 3.5
# Model error (px) of the ends of a streak, assumed when the motions of the stars are compared.
_END_FLOOR = 0.01
# Model error (px) of the width of a streak, assumed when the motions of the stars are compared.
_WIDTH_FLOOR = 0.002
# Distance between two streaks below which they are fitted together, in half widths of a strip of pixels.
_NEAR = 1.4
# Displacement (px) of the streak ends during the fit above which the search for faint stars is repeated.
_FAR = 6.0
# Maximum number of searches for faint stars.
_MOST_REPEATS = 2
# Error of the modelled counts of a subtracted star on a pixel, as a fraction of these counts.
_SUBTRACTION_ERROR = 0.35
# Maximum total number of pixels in all fit windows, counted once per window, to limit memory and time.
_MOST_PIXELS = 60_000
# Fraction of this number for the brightest streaks in a fit of only these and their neighbours.
_BRIGHTEST_SHARE = 0.5
# Minimum number of bright streaks in a fit of the brightest streaks with all their neighbours.
_LEAST_BRIGHTEST = 10
# Minimum significance (standard deviations) of a faint star that could shift the ends of bright streaks.
_HIDDEN_SIGMAS = 4.5
# Number of stars subtracted from the frame in one batch, which limits the memory.
_AT_ONCE = 64


def final_fit(camera: FitProblem, first: StreakFit) -> tuple[StreakFit | None, FaintStars]:
    """Return the joint fit of the brightest stars, and the faint stars that were not fitted.

    The search for faint stars is repeated if the fit differs much from the motion of the fit `first`, or if
    modelled and measured streak ends disagree. A fit is rejected if its streaks have wrong ends after the
    second search.
    """
    other = None
    for _ in range(_MOST_REPEATS):
        done, faint = _fit_from(camera, first)
        if done is None:
            break
        leading = np.flatnonzero(done.scene.trusted)
        scene = done.scene.select(leading)
        other = stretched(camera, scene)
        if other is None and not _far(camera, first.scene, scene):
            break
        if camera.work.exhausted:
            return None, faint
        scene = scene if other is None else other
        scene = scene.select(np.argsort(-scene.light, kind="stable")[: len(first.scene.light)])
        first = replace(done, scene=scene, windows=camera.windows(scene))
    else:
        done = done if other is None else None
    return done, faint


def _far(camera: FitProblem, before: StreakScene, after: StreakScene) -> bool:
    """Return whether streak ends moved so far that the search for faint stars must be repeated."""
    changed = float(np.linalg.norm(after.motion.rotation - before.motion.rotation))
    turn = float(np.linalg.norm(after.motion.rotation))
    length = float(np.median(path_lengths(camera.pinhole, after.motion, before.stars)))
    return length * changed / max(turn, 1e-12) > _FAR


def _fit_from(camera: FitProblem, first: StreakFit) -> tuple[StreakFit | None, FaintStars]:
    """Return the joint fit of the bright stars, and the detected faint stars that it does not include.

    Faint stars are detected as streaks along the motion of the fit `first`. A constant rate is fitted unless
    the settings or the pixels require a changing rate.
    """
    settings, before = camera.settings, first.scene
    if before.motion.accelerates:
        camera = replace(camera, growing=True)
    camera.work.passed(camera.frame.signal.size)
    light = light_of(camera.pinhole, camera.shutter, before, first.windows)
    modelled, sigmas = (first.windows.pixels, light), min(_HIDDEN_SIGMAS, settings.faint_sigmas)
    most = settings.most_faint
    faint = find_faint(camera.frame, modelled, camera.pinhole, before.motion, sigmas, most)
    stars = mid_exposure_positions(camera.pinhole, before.motion, camera.shutter, faint.stars)
    faint = replace(faint, stars=stars)
    whole = before.with_stars(faint.stars, faint.light)
    order = np.argsort(-whole.light, kind="stable")
    bright, rest = order[: settings.most_stars], order[settings.most_stars :]
    scene, others = whole.select(bright), whole.select(rest)
    scene = replace(scene, trusted=np.ones(len(bright), dtype=np.bool_))
    distance = _NEAR * settings.reach * scene.width
    near = np.flatnonzero(near_streaks(camera.pinhole, scene.motion, others.stars, scene.stars, distance))
    fitted = others.select(near[: settings.most_neighbours])
    scene = scene.with_stars(fitted.stars, fitted.light)
    beyond = others.select(near[settings.most_neighbours :])
    done = joint_fit(_subtracted(camera, beyond), scene)
    if done is not None and done.hidden is not None:
        done = replace(done, hidden=done.hidden.with_stars(beyond.stars, beyond.light))
    rest = np.delete(rest, near[: settings.most_neighbours])
    rest = rest[rest >= len(before.light)] - len(before.light)
    rest = rest[faint.significance[rest] >= settings.faint_sigmas]
    return done, FaintStars(faint.stars[rest], faint.light[rest], faint.significance[rest])


def joint_fit(camera: FitProblem, scene: StreakScene, room: float = 1.0) -> StreakFit | None:
    """Return the fit of `scene` with the motion of the majority of stars; None if the fit fails.

    A score test on the pixels decides between a constant and a changing rate. Stars without effect on the
    motion are fitted as well, in descending order of brightness, until all fit windows together contain
    `room` times `_MOST_PIXELS` pixels. Stars that are not fitted are subtracted from the frame.
    """
    fitted = _affordable(camera, scene, room)
    hidden = scene.select(~fitted)
    camera, scene = _subtracted(camera, hidden), scene.select(fitted)
    done = iterate(camera, scene, camera.free, ROUGH)
    if done is not None and camera.undecided and done.grows():
        camera = replace(camera, growing=True)
        done = iterate(camera, done.scene, camera.free, LAST, done.windows)
    if done is None or _excessive(done.scene.motion):
        return None
    trusted = _trusted(camera, done)
    start = replace(done.before, trusted=trusted)
    windows, known = [done.windows], [done.evaluation.without(done.scene.trusted & ~trusted)]
    del done  # The old fit is deleted and its windows are removed from the list, which frees tens of MB.
    done = iterate(camera, start, camera.free, LAST, windows.pop(), known.pop())
    if done is not None and camera.undecided and done.grows():
        done = iterate(replace(camera, growing=True), done.scene, GROWING, LAST, done.windows)
    return None if done is None or _excessive(done.scene.motion) else replace(done, hidden=hidden)


def refit(camera: FitProblem, last: StreakFit) -> StreakFit | None:
    """Return the joint fit repeated from `last` with another `camera`, or None if it does not succeed.

    The repeated fit starts with all bright stars included in the fit of the motion.
    """
    scene = last.scene
    leading = np.arange(len(scene.light)) < max(camera.settings.most_stars, 1)
    scene = replace(scene, trusted=scene.trusted | leading)
    hidden = last.hidden
    return joint_fit(camera, scene if hidden is None else scene.with_stars(hidden.stars, hidden.light))


def brightest_fit(camera: FitProblem, last: StreakFit) -> StreakFit | None:
    """Fit the brightest streaks of `last` again, together with all stars on the pixels of these streaks.

    Faint stars hidden in a bright streak shift the fitted streak ends. The joint fit omits such faint stars
    if they would exceed the limit on the number of fitted pixels. A fit of fewer bright streaks, but with all
    faint stars on their pixels, is then more accurate. Returns None if the joint fit included all stars, or
    if the new fit does not succeed or diverges.
    """
    others, scene = last.hidden, last.scene
    if others is None or not len(others.light):
        return None
    camera = replace(camera, growing=bool(last.free[3]))
    order = np.argsort(-scene.light * scene.trusted, kind="stable")[: np.count_nonzero(scene.trusted)]
    areas = np.cumsum(window_areas(camera.pinhole, scene.select(order), camera.settings.reach))
    leading = order[: max(_LEAST_BRIGHTEST, int(np.count_nonzero(areas < _BRIGHTEST_SHARE * _MOST_PIXELS)))]
    first, rest = scene.select(leading), scene.select(np.setdiff1d(np.arange(len(scene.light)), leading))
    stars, light = (np.concatenate(both) for both in ((rest.stars, others.stars), (rest.light, others.light)))
    distance = _NEAR * camera.settings.reach * scene.width
    near = near_streaks(camera.pinhole, scene.motion, stars, first.stars, distance)
    whole = first.with_stars(stars[near], light[near])
    fitted = _affordable(camera, whole, 1.0)
    camera = _subtracted(camera, whole.select(~fitted))
    done = iterate(camera, whole.select(fitted), last.free, replace(LAST, settled=ROUGH.settled))
    lost = done is None or _excessive(done.scene.motion) or _far(camera, scene, done.scene)
    return None if lost else done


def _excessive(motion: CameraMotion) -> bool:
    """Return whether the angular acceleration of a motion exceeds the range of the model.

    A motion estimated by the navigation filter is never rejected.
    """
    if motion.higher_terms.any():
        return False
    return float(np.linalg.norm(motion.acceleration)) > _MOST_CHANGE * float(np.linalg.norm(motion.rate))


def _trusted(camera: FitProblem, rough: StreakFit) -> BoolArray:
    """Return a mask (n,) of the stars in the motion fit that agree with the majority.

    If too few stars agree, the mask contains all stars in the motion fit.
    """
    equations = star_equations(rough.evaluation, rough.solution.eliminated)
    change, deviation = estimates_of(equations, rough.scene)
    before = rough.scene.trusted
    had = np.flatnonzero(before)
    length = path_lengths(camera.pinhole, rough.scene.motion, rough.scene.stars[had])
    turn = float(np.linalg.norm(rough.scene.motion.rotation))
    angle = _END_FLOOR * turn / max(float(np.median(length)), 1.0)
    floors = np.array([angle, angle, angle, _WIDTH_FLOOR])
    agree = consistent_stars(change[had], deviation[had], floors, _TRUST_SIGMAS)
    if np.count_nonzero(agree) < max(camera.settings.least_stars, len(had) // 3):
        return before
    after = before.copy()
    after[had] = agree
    return after


def _affordable(camera: FitProblem, scene: StreakScene, more: float) -> BoolArray:
    """Return a mask (n,) of the stars in the motion fit and of other bright stars within the pixel limit."""
    room = window_areas(camera.pinhole, scene, camera.settings.reach)
    order = np.lexsort((-scene.light, ~scene.trusted))
    needed = np.empty(len(room))
    needed[order] = np.cumsum(room[order])
    return np.asarray(scene.trusted | (needed <= more * _MOST_PIXELS))


def _subtracted(camera: FitProblem, others: StreakScene) -> FitProblem:
    """Return `camera` with the stars `others` subtracted and their model errors added to the noise."""
    if not len(others.light):
        return camera
    signal, floor = camera.frame.signal.copy(), camera.frame.floor.copy()
    count = len(others.light)
    for some in np.split(np.arange(count), range(_AT_ONCE, count, _AT_ONCE)):
        scene = others.select(some)
        pixels = star_pixels(camera.pinhole, camera.shutter, scene, camera.settings.reach)
        streaks, spots = light_images(camera.pinhole, camera.shutter, scene, pixels)
        strips, patches = pixels.strips, pixels.patches
        light = scene.light[pixels.long[strips.star]]
        _subtract(signal, floor, (strips.index, strips.inside), streaks[:, 0], light)
        _subtract(
            signal, floor, (patches.index, patches.inside), spots.astype(np.float32), scene.light[pixels.spot]
        )
    return replace(camera, frame=replace(camera.frame, signal=signal, floor=floor))


def _subtract_numpy(
    signal: Float32Array,
    floor: Float32Array,
    pixels: tuple[IntArray, BoolArray],
    images: Float32Array,
    light: FloatArray,
) -> None:
    """Subtract stars from the frame's `signal`, and add the squared errors of their model to its `floor`.

    The modelled counts are the `images` (b, l, k) of stars of unit flux, multiplied by the flux `light` (b,)
    of the star of each block. The pair `pixels` contains the attributes `index` and `inside` of `Strips` or
    `Patches`.
    """
    index, inside = pixels
    counts, at = (images * light.astype(np.float32)[:, None, None])[inside], index[inside]
    np.subtract.at(signal, at, counts)
    np.add.at(floor, at, np.square(np.float32(_SUBTRACTION_ERROR) * counts))


@compiled_form_of(_subtract_numpy)
def _subtract(
    signal: Float32Array,
    floor: Float32Array,
    pixels: tuple[IntArray, BoolArray],
    images: Float32Array,
    light: FloatArray,
) -> None:
    (index, inside), error = pixels, np.float32(_SUBTRACTION_ERROR)
    for b in range(len(images)):
        flux = np.float32(light[b])
        for i in range(images.shape[1]):
            for k in range(images.shape[2]):
                if inside[b, i, k]:
                    counts = images[b, i, k] * flux
                    signal[index[b, i, k]] -= counts
                    floor[index[b, i, k]] += (error * counts) ** 2
