"""The joint fit: the brightest stars, and all that share their pixels."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import fdtri

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.faint_stars import FaintStars, find_faint
from knightcube.vision.streaks.frame import ExposedFrame, Float32Array
from knightcube.vision.streaks.geometry import (
    Motion,
    Scene,
    Shutter,
    close_by,
    mid_exposure,
    path_lengths,
    paths,
    positions,
    window_times,
)
from knightcube.vision.streaks.normal_equations import (
    ALONE,
    SHARED,
    Evaluation,
    OwnEstimates,
    Solution,
    Windows,
    agreed_step,
    agreeing,
    cut_windows,
    evaluate,
    light_of,
    moved,
    own_estimates,
    solve,
    window_areas,
)
from knightcube.vision.streaks.settings import LikelihoodSettings

# Beyond this no rival motion is begun. A fit in hand is finished: the whole frame may take twice as much.
_MOST = 1_600_000
# What an evaluation of the model costs whatever its pixels, and a pass over the frame, a part of its pixels.
_EVALUATION = 15_000
_PASS = 0.15


class Work:
    """The work that was done on one frame."""

    def __init__(self) -> None:
        self._spent = 0.0

    def evaluated(self, pixels: int) -> None:
        """Count an evaluation of the model on `pixels`."""
        self._spent += pixels + _EVALUATION

    def passed(self, pixels: int) -> None:
        """Count a pass over a frame of `pixels`."""
        self._spent += _PASS * pixels

    @property
    def exhausted(self) -> bool:
        """Whether nothing more may be begun."""
        return self._spent > _MOST


_LONGEST_STEP = 3.0
# An end so far, px, from where its window was cut has left the window's middle.
_DRIFT = 2.0
# Ends of untrusted stars may be farther from it; after the first round in fresh windows by any distance: all
# windows are not cut again for those whose light hardly fixes their place.
_FAINT_DRIFT = 3.2
# The growth may change by this part of the turn before that.
_GROWN = 0.1
# Converged: no shared parameter moves by more than this part of its standard deviation. The step is
# taken, and what it leaves is of second order.
SETTLED = 0.4
# Out of patience, a step that is not so much shorter than the one before ends the rounds.
_LEAST_PROGRESS = 0.7
# After this many rounds the choice of pixels left out is final.
_LOOKS = 1
# Probability of a constant rate being taken for a changing one.
_BY_CHANCE = 1e-4
# Below this part of the limit no closer test is needed.
_FAR_BELOW = 0.5
# The parameters of the change.
_GROWTHS = 3
GROWING = np.ones(SHARED, dtype=np.bool_)
_WIDEST = 6.0
# A joint fit whose point spread grows beyond this many of the first fit's has lost the streaks.
_WIDER = 1.6


@dataclass(frozen=True, slots=True)
class Rounds:
    """How a scene is fitted.

    Attributes:
        rounds: at most.
        clipped: whether pixels far beyond the noise are left out.
        tolerance: steps of an end or the width that are as good as none, px; settled: in deviations.
        conjugate: gradients at most for the pixels that stars share.
        patience: rounds that are spent whether or not they bring the fit on.
    """

    rounds: int
    clipped: bool
    tolerance: float
    settled: float
    conjugate: int
    patience: int


FIRST = Rounds(6, clipped=False, tolerance=0.1, settled=SETTLED, conjugate=4, patience=2)
ROUGH = Rounds(3, clipped=True, tolerance=0.003, settled=1.5, conjugate=6, patience=3)
LAST = Rounds(7, clipped=True, tolerance=0.003, settled=SETTLED, conjugate=12, patience=4)


@dataclass(frozen=True, slots=True, eq=False)
class ExposedCamera:
    """A frame with all that is known of how it was taken.

    Attributes:
        growing: whether the rate may change.
        course: the motion as it is known from elsewhere; None where unknown, or as good as constant.
        work: that was done on the frame.
        sigma: px, of the point spread, where the fit of its width starts.
        sense: (3,) a vector along which the camera turns, not against it; None where either will do.
    """

    frame: ExposedFrame
    pinhole: Pinhole
    shutter: Shutter
    settings: LikelihoodSettings
    sigma: float
    growing: bool = False
    sense: FloatArray | None = None
    course: Motion | None = None
    work: Work = field(default_factory=Work)

    @property
    def free(self) -> BoolArray:
        """Which shared parameters are fitted."""
        return np.array([True] * 3 + [self.growing] * 3 + [True])

    @property
    def undecided(self) -> bool:
        """Whether the pixels are yet to show that the rate changes."""
        return self.settings.rate_model == "auto" and not self.growing

    def windows(self, scene: Scene) -> Windows:
        """Return the pixels about the scene's streaks."""
        return cut_windows(self.frame, self.pinhole, self.shutter, scene, self.settings.reach)

    def evaluate(self, scene: Scene, windows: Windows, clip: float) -> Evaluation:
        """Return the normal equations."""
        self.work.evaluated(len(windows.slot))
        growth = self.growing or (self.undecided and clip > 0.0)
        return evaluate(self.pinhole, self.shutter, scene, windows, clip, growth)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A scene after its last step, with the equations of that step.

    Attributes:
        windows: its pixels; free: (SHARED,) which shared parameters were fitted.
        restless: the last step of the shared parameters, in standard deviations; 0 when the fit has settled.
        hidden: stars on its pixels that were not fitted, but taken out as they were known; None without.
    """

    scene: Scene
    solution: Solution
    evaluation: Evaluation
    restless: float
    windows: Windows
    free: BoolArray
    hidden: Scene | None = None

    def grows(self) -> bool:
        """Return whether the pixels show that the rate changes: a score test of the constant one.

        The stars' agreement on the change is held against their spread (Hotelling).
        """
        # As if no stars shared pixels first: mostly that decides.
        for conjugate, share in ((0, _FAR_BELOW), (LAST.conjugate, 1.0)):
            solution = solve(self.evaluation, self.scene, GROWING, conjugate)
            if solution is None:
                return False
            agreed, stars = agreed_step(self.evaluation, solution.shared)
            freedom = stars - _GROWTHS
            if freedom < 1:
                return False
            limit = float(fdtri(_GROWTHS, freedom, 1.0 - _BY_CHANCE)) * _GROWTHS * (stars - 1) / freedom
            if agreed <= share * limit:
                return False
        return True


def iterate(
    camera: ExposedCamera, scene: Scene, free: BoolArray, how: Rounds, windows: Windows | None = None
) -> Fit | None:
    """Return the fit after some rounds, None when the stars do not fix the motion."""
    faint_drift, cut_at = _FAINT_DRIFT if windows is None else np.inf, scene
    windows = whole = windows or camera.windows(scene)
    restless, asked, before = np.inf, np.inf, np.zeros(SHARED)
    widest = _WIDER * scene.width if how.clipped else _WIDEST
    solution, evaluation = None, None
    for turn in range(how.rounds):
        evaluation = None  # tens of MB, as is the next
        evaluation = camera.evaluate(scene, windows, camera.settings.clip if how.clipped else 0.0)
        solution = solve(evaluation, scene, free, how.conjugate)
        if solution is None:
            return None
        scene, wanted = moved(scene, solution, camera.pinhole, _LONGEST_STEP)
        if not _possible(scene) or scene.width > widest:
            return None
        deviation = np.sqrt(np.maximum(np.diag(solution.covariance)[free], 1e-30))
        restless = float(np.max(np.abs(solution.shared[free]) / deviation))
        if restless <= how.settled or wanted <= how.tolerance:
            restless = 0.0
            break
        # Steps that lead on in one direction are a long way; those to and fro lead nowhere.
        onward = (
            float(np.sum(solution.shared * before / np.maximum(np.diag(solution.covariance), 1e-30))) > 0.0
        )
        if turn >= how.patience and wanted > _LEAST_PROGRESS * asked and not onward:
            break
        asked, before = wanted, solution.shared
        if _drifted(camera, cut_at, scene, faint_drift if turn == 0 else np.inf):
            del windows, whole  # tens of MB, as are the new ones
            windows = whole = camera.windows(scene)
            cut_at = scene
        elif how.clipped and turn >= _LOOKS:
            # Pixels that come and go as they are left out and taken in would keep the fit from settling.
            windows = whole.only(*evaluation.kept)
    if solution is None or evaluation is None:
        return None
    return Fit(scene, solution, evaluation, restless, whole, free)


def _possible(scene: Scene) -> bool:
    return (
        0.3 < scene.width < _WIDEST
        and bool(np.all(np.isfinite(scene.stars)))
        and float(np.linalg.norm(scene.motion.whole)) <= np.pi
    )


def _drifted(camera: ExposedCamera, before: Scene, after: Scene, faint: float) -> bool:
    """Return whether an end of a streak has left its window's middle; untrusted ones by `faint` px.

    Windows are also cut for where a rate that changes makes the streaks slow.
    """
    grown = float(np.linalg.norm(after.motion.growth - before.motion.growth))
    if grown > _GROWN * float(np.linalg.norm(after.motion.whole)):
        return True
    n = len(before.stars)
    at = np.repeat([-0.5, 0.5], n)
    there = positions(camera.pinhole, after.motion, np.tile(after.stars, (2, 1)), at)
    was = positions(camera.pinhole, before.motion, np.tile(before.stars, (2, 1)), at)
    far = np.abs(there - was).max(axis=1).reshape(2, n).max(axis=0)
    return bool(np.any(far > np.where(after.trusted, _DRIFT, faint)))


def misfit(evaluation: Evaluation) -> float:
    """Return the median chi-square a pixel of the stars."""
    freedom = np.maximum(evaluation.pixels - ALONE - 1.0, 1.0)
    return float(np.median(evaluation.chi2 / freedom))


# The stretch judged: part of the path, its least length and its distance from the end, px.
_STRETCH = 0.1
_LEAST_STRETCH = 8.0
_FROM_END = 4.0
_SAMPLES = 24
# Within the path as many stretches are looked at.
_WITHIN = 10
_WITHIN_SAMPLES = 10
_ASIDE = np.array([-1.0, 0.0, 1.0])
# The part of a streak's light per px of length that each of the middle three pixels across has.
_MIDDLE = 0.287
_HALF = 0.5
_LEAST_VALID = 0.7
# A stretch can be judged when the light expected exceeds this many deviations of its mean.
_TELLING = 4.0
# Instants at which the progress along a path is taken.
_INSTANTS = 65
# Where a star is slower than this part of its rate, the point spread hides how much brighter its path is.
_SLOW = 0.5
# Light beyond an end is a trail from this part of the streak's mean brightness on.
_TRAIL = 0.08
# Part of a streak that may be dark for reasons of its own.
_DARK = 0.15


def true_ends(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> FloatArray:
    """Return (n, 2) 1 for the ends that are where they should be, 0 for those that are not.

    `times` (n, 2) are when stars (n, 2) of `light` (n,) counts begin and end to be exposed. Ends that are not
    on the detector, and those of streaks too short to judge, are NaN.
    """
    out = np.full((len(stars), 2), np.nan)
    length = path_lengths(pinhole, motion, stars)
    long = length > 2.0 * (_FROM_END + _LEAST_STRETCH)
    if not long.any():
        return out
    stars, light, times, length = stars[long], light[long], times[long], length[long]
    stretch = np.maximum(_STRETCH * length, _LEAST_STRETCH)
    away = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * stretch[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        steady, there, speed = ending(pinhole, motion, stars, times[:, end])
        part = relative_brightness(motion, sign, _FROM_END / speed, (_FROM_END + stretch) / speed)
        expected = expected_brightness(light, length) * part
        time = sign * away / speed[:, None]
        within, beyond = (brightness(frame, pinhole, steady, there, t)[0] for t in (-time, time))
        known = np.isfinite(within) & np.isfinite(beyond)
        true = (within > _HALF * expected) & (beyond < _HALF * expected)
        out[long, end] = np.where(known, true, np.nan)
    return out


def trailing(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> float:
    """Return the part of the stars that can be judged whose light goes on, faintly, beyond an end.

    Arguments as of `true_ends`. A rate that changes otherwise than assumed leaves a short streak with a dim
    tail.
    """
    faint = _TRAIL * expected_brightness(light, path_lengths(pinhole, motion, stars))
    away = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * _LEAST_STRETCH
    judged, lit = np.zeros(len(stars), dtype=np.bool_), np.zeros(len(stars), dtype=np.bool_)
    for end, sign in ((0, -1.0), (1, 1.0)):
        steady, there, speed = ending(pinhole, motion, stars, times[:, end])
        mean, deviation = brightness(frame, pinhole, steady, there, sign * away / speed[:, None])
        known = np.isfinite(mean) & (faint > _TELLING * deviation)
        judged |= known
        lit |= known & (mean > faint)
    return float(np.mean(lit[judged])) if judged.any() else 0.0


def ending(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: FloatArray
) -> tuple[Motion, FloatArray, FloatArray]:
    """Return a steady motion through ends of paths, where those are (n, 2) px, and its speed (n,) there.

    `times` (n,) are those of the ends. Where the rate changes the path itself may be at rest there.
    """
    there = positions(pinhole, motion, stars, times)
    steady = Motion.steady(motion.whole)
    velocity = paths(pinhole, steady, there, np.zeros(len(there))).velocity
    return steady, there, np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-3)


def relative_brightness(motion: Motion, sign: float, near: FloatArray, far: FloatArray) -> FloatArray:
    """Return how bright (n,) the path is from `near` to `far` (n,) of its end, over its mean.

    Distances are in parts of the path; `sign` is 1 for the last end, -1 for the first.
    """
    time = np.linspace(-0.5, 0.5, _INSTANTS)
    progress = np.maximum.accumulate(motion.progress(time))
    # A little more with time, so that a rest has its duration.
    progress += 1e-9 * np.arange(_INSTANTS)
    end = progress[-1 if sign > 0.0 else 0]
    begin, stop = (np.interp(end - sign * distance, progress, time) for distance in (near, far))
    return np.asarray(np.abs(stop - begin) / np.maximum(far - near, 1e-9))


def unbroken(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> FloatArray:
    """Return 1 for each star that is bright all along its path on the detector, else 0, in one row (k,).

    Arguments as of `true_ends`; stars too short or too faint to judge are left out.
    """
    length = path_lengths(pinhole, motion, stars)
    long = length > _WITHIN * _LEAST_STRETCH
    if not long.any():
        return np.empty(0)
    stars, light, times, length = stars[long], light[long], times[long], length[long]
    share = (np.arange(_WITHIN * _WITHIN_SAMPLES) + 0.5) / (_WITHIN * _WITHIN_SAMPLES)
    time = times[:, :1] + (times[:, 1:] - times[:, :1]) * share
    each = np.repeat(stars, _WITHIN, axis=0)
    mean, deviation = brightness(frame, pinhole, motion, each, time.reshape(len(each), _WITHIN_SAMPLES))
    rate = np.clip(motion.pace(time.reshape(-1)), _SLOW, None).reshape(len(each), _WITHIN_SAMPLES)
    expected = np.repeat(expected_brightness(light, length), _WITHIN) * np.mean(1.0 / rate, axis=1)
    known = np.isfinite(mean) & (expected > _TELLING * deviation)
    dark = (known & (mean < _HALF * expected)).reshape(-1, _WITHIN).sum(axis=1)
    known_of = known.reshape(-1, _WITHIN).sum(axis=1)
    judged = known_of > 0
    return np.asarray(dark[judged] <= _DARK * known_of[judged], dtype=float)


def expected_brightness(light: FloatArray, length: FloatArray) -> FloatArray:
    """Return the mean counts (n,) that `brightness` finds on streaks of `light` (n,) and `length` (n,) px."""
    return np.asarray(_MIDDLE * light / length)


def brightness(
    frame: ExposedFrame, pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the mean counts (n,) of pixels about a stretch of the path, at `time` (n, s), and its deviation.

    NaN where too few are seen.
    """
    samples = time.shape[1]
    there = paths(pinhole, motion, np.repeat(stars, samples, axis=0), time.reshape(-1))
    way = there.velocity / np.maximum(np.linalg.norm(there.velocity, axis=1, keepdims=True), 1e-3)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    points = there.position[:, None] + _ASIDE[:, None] * normal[:, None]
    pixel = np.rint(points).astype(np.int64)
    seen = pinhole.contains(pixel.astype(float))
    index = np.where(seen, pixel[..., 1] * pinhole.columns + pixel[..., 0], 0)
    seen &= ~frame.bad[index]
    count = seen.reshape(len(stars), -1).sum(axis=1)
    enough = count >= _LEAST_VALID * samples * len(_ASIDE)
    total = np.where(seen, frame.signal[index], 0.0).reshape(len(stars), -1).sum(axis=1)
    variance = np.where(seen, frame.floor[index], 0.0).reshape(len(stars), -1).sum(axis=1)
    count = np.maximum(count, 1)
    return np.where(enough, total / count, np.nan), np.sqrt(variance) / count


# Looked at is this part of a streak's length to either side of its end, between this many px, in this many
# steps.
_REACH = 0.08
_LEAST_REACH, _MOST_REACH = 10.0, 40.0
_STEPS = 41
# An end can be judged when its stretch of light stands out by this many deviations.
_TELLING_EDGE = 5.0
# Light of others counts at most this many times the star's own.
_CAP = 2.0
# This many streaks at least must be too long or too short, by this many px, by the same to this many, and
# this many times as many as are as long as they should be.
_LEAST_STREAKS = 3
_LEAST_OFF = 4.0
_ALIKE = 3.0
_MORE = 2
# Beyond this change of the rate, in parts of it, the light is too uneven.
_MOST_STRETCHED_GROWTH = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """By how many px (n, 2) streaks go on beyond where they should end, NaN where unknown."""

    beyond: FloatArray
    length: FloatArray

    @property
    def stretch(self) -> float:
        """The part of itself by which the motion is too small, 0 where streaks do not agree against it."""
        off = self.beyond.sum(axis=1)
        known = np.isfinite(off)
        off, length = off[known], self.length[known]
        wrong = off[np.abs(off) > _LEAST_OFF]
        if len(wrong) < _LEAST_STREAKS:
            return 0.0
        agree = np.abs(wrong[:, None] - off) < _ALIKE
        most = agree[np.argmax(agree.sum(axis=1))]
        if most.sum() < max(_LEAST_STREAKS, _MORE * np.count_nonzero(np.abs(off) <= _LEAST_OFF)):
            return 0.0
        return float(np.median(off[most] / length[most]))


def find_edges(camera: ExposedCamera, scene: Scene) -> Edges:
    """Return where the streaks of `scene` end in the frame, beside where its motion puts their ends."""
    motion, stars = scene.motion, scene.stars
    length = path_lengths(camera.pinhole, motion, stars)
    beyond = np.full((len(stars), 2), np.nan)
    long = np.flatnonzero(length > 2.0 * _LEAST_REACH)
    if not len(long):
        return Edges(beyond, length)
    stars, own = stars[long], np.maximum(length[long], 1.0)
    reach = np.clip(_REACH * own, _LEAST_REACH, _MOST_REACH)
    outward = np.linspace(-1.0, 1.0, _STEPS) * reach[:, None]
    times = window_times(camera.pinhole, motion, camera.shutter, stars)
    expected = expected_brightness(scene.light[long], own)[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        time = times[:, end, None] + sign * outward / own[:, None]
        mean, deviation = brightness(
            camera.frame, camera.pinhole, motion, np.repeat(stars, _STEPS, axis=0), time.reshape(-1, 1)
        )
        mean, deviation = mean.reshape(-1, _STEPS), np.maximum(deviation.reshape(-1, _STEPS), 1e-6)
        seen = np.minimum(np.maximum(mean, -expected), _CAP * expected)
        # What light explains more than darkness does, from the inside on.
        explained = np.cumsum((seen - 0.5 * expected) * expected / deviation**2, axis=1)
        last = np.argmax(explained, axis=1)
        sure = np.sum((expected / deviation) ** 2, axis=1) > _TELLING_EDGE**2
        known = np.isfinite(mean).all(axis=1) & sure
        found = outward[np.arange(len(last)), last] + 0.5 * (outward[:, 1] - outward[:, 0])
        beyond[long, end] = np.where(known, found, np.nan)
    return Edges(beyond, length)


def stretched(camera: ExposedCamera, scene: Scene) -> Scene | None:
    """Return `scene` with a motion by which its streaks end where their light does; None when they do.

    Also None where the rate changes so much that the light along a streak is not alike.
    A star stays where its ends are, or the one that is on the detector.
    """
    if abs(scene.motion.relative_growth) > _MOST_STRETCHED_GROWTH:
        return None
    edges = find_edges(camera, scene)
    stretch = edges.stretch
    if stretch == 0.0:
        return None
    off = edges.beyond / np.maximum(edges.length, 1.0)[:, None]
    # Mid-exposure, in exposures of the old motion, from the one end and from the other.
    middle = np.stack([0.5 * stretch - off[:, 0], off[:, 1] - 0.5 * stretch], axis=-1)
    known = np.isfinite(middle)
    time = np.where(known, middle, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    moved = positions(camera.pinhole, scene.motion, scene.stars, time)
    motion = replace(scene.motion, turn=scene.motion.turn + stretch * scene.motion.whole)
    return replace(scene, motion=motion, stars=moved)


# A rate that changes by more than this part of itself is beyond the model: 2 is from rest, or to it.
_MOST_GROWTH = 2.2
# A star is trusted within this many deviations; ends (px) and width (px) are never modelled better than this.
_TRUST_SIGMAS = 3.5
_END_FLOOR = 0.01
_WIDTH_FLOOR = 0.002
# Streaks this many reaches beside a bright one's are fitted with it: farther ones touch only its window's
# edge.
_NEAR = 1.4
# Ends that move by more px than this from the first fit to the last make the stars to be found again.
_FAR = 6.0
_MOST_REPEATS = 2
# How wrong the light of a faint star found along the motion may be on a pixel, as part of it.
_DOUBT = 0.35
# Pixels of all windows that a fit looks at, those that stars share once for each: what a crowd of long
# streaks needs of memory and time is bounded so, and the brightest stars hold most of the information.
_MOST_PIXELS = 60_000
# Streaks that are fitted anew with all on their pixels take this part of that, but are so many at least.
_BARED_SHARE = 0.5
_LEAST_BARED = 10
# Stars that share a bright one's pixels are sought down to this significance: what they hide moves its ends.
_HIDDEN_SIGMAS = 4.5
# This many stars' light is taken out at a time.
_AT_ONCE = 16


def last_fit(camera: ExposedCamera, first: Fit) -> tuple[Fit | None, FaintStars]:
    """Return the joint fit of the brightest stars, and the faint ones that it left to the matched filter.

    Where it comes far from `first`, the stars found along that motion are not where they seemed: once more.
    Likewise from where the streaks really end, where the fit has other ends. A fit that they contradict again
    is dropped.
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


def _far(camera: ExposedCamera, before: Scene, after: Scene) -> bool:
    """Return whether the ends of the streaks have moved by more than the fit can follow."""
    changed = float(np.linalg.norm(after.motion.whole - before.motion.whole))
    turn = float(np.linalg.norm(after.motion.whole))
    length = float(np.median(path_lengths(camera.pinhole, after.motion, before.stars)))
    return length * changed / max(turn, 1e-12) > _FAR


def _fit_from(camera: ExposedCamera, first: Fit) -> tuple[Fit | None, FaintStars]:
    """Return the joint fit of the stars that are found along the motion of `first`, and the faint ones left.

    Of the models of the rate the fit takes the constant one unless the settings or the pixels demand the
    other.
    """
    settings, before = camera.settings, first.scene
    if not before.motion.constant:
        camera = replace(camera, growing=True)
    faint = _found_along(camera, first)
    whole = before.with_stars(faint.stars, faint.light)
    order = np.argsort(-whole.light, kind="stable")
    bright, rest = order[: settings.most_stars], order[settings.most_stars :]
    scene, others = whole.select(bright), whole.select(rest)
    scene = replace(scene, trusted=np.ones(len(bright), dtype=np.bool_))
    near = np.flatnonzero(
        close_by(
            camera.pinhole, scene.motion, others.stars, scene.stars, _NEAR * settings.reach * scene.width
        )
    )
    fitted = others.select(near[: settings.most_neighbours])
    scene = scene.with_stars(fitted.stars, fitted.light)
    beyond = others.select(near[settings.most_neighbours :])
    done = joint_fit(_accounted(camera, beyond), scene)
    if done is not None and done.hidden is not None:
        done = replace(done, hidden=done.hidden.with_stars(beyond.stars, beyond.light))
    rest = np.delete(rest, near[: settings.most_neighbours])
    rest = rest[rest >= len(before.light)] - len(before.light)
    rest = rest[faint.significance[rest] >= settings.faint_sigmas]
    return done, FaintStars(faint.stars[rest], faint.light[rest], faint.significance[rest])


def _found_along(camera: ExposedCamera, first: Fit) -> FaintStars:
    """Return the streaks along the motion of `first`, less its own, by their places at mid-exposure."""
    settings, motion = camera.settings, first.scene.motion
    camera.work.passed(camera.frame.signal.size)
    light = light_of(camera.pinhole, camera.shutter, first.scene, first.windows)
    faint = find_faint(
        camera.frame,
        (first.windows.pixels, light),
        camera.pinhole,
        motion,
        min(_HIDDEN_SIGMAS, settings.faint_sigmas),
        settings.most_faint,
    )
    return replace(faint, stars=mid_exposure(camera.pinhole, motion, camera.shutter, faint.stars))


def joint_fit(camera: ExposedCamera, scene: Scene, room: float = 1.0) -> Fit | None:
    """Return the fit of `scene` by the stars that agree, under the rate's model that the pixels ask for.

    Of the untrusted stars the brightest are fitted, as far as there is room, `room` times as much as usual;
    the others' light is taken out as it is known. None where the fit fails.
    """
    fitted = _affordable(camera, scene, room)
    hidden = scene.select(~fitted)
    camera, scene = _accounted(camera, hidden), scene.select(fitted)
    done = iterate(camera, scene, camera.free, ROUGH)
    if done is not None and camera.undecided and done.grows():
        camera = replace(camera, growing=True)
        done = iterate(camera, done.scene, camera.free, LAST, done.windows)
    if done is None or _beyond(done.scene.motion):
        return None
    scene, windows = replace(done.scene, trusted=_trusted(camera, done)), [done.windows]
    del done  # equations of tens of MB; the windows too are let go where new ones are cut
    done = iterate(camera, scene, camera.free, LAST, windows.pop())
    if done is not None and camera.undecided and done.grows():
        done = iterate(replace(camera, growing=True), done.scene, GROWING, LAST, done.windows)
    return None if done is None or _beyond(done.scene.motion) else replace(done, hidden=hidden)


def refit(camera: ExposedCamera, last: Fit) -> Fit | None:
    """Return the joint fit again, from the result `last` on, with all its brightest stars trusted.

    `camera` differs from that of `last` in how it draws paths.
    """
    scene = last.scene
    leading = np.arange(len(scene.light)) < max(camera.settings.most_stars, 1)
    scene = replace(scene, trusted=scene.trusted | leading)
    hidden = last.hidden
    return joint_fit(camera, scene if hidden is None else scene.with_stars(hidden.stars, hidden.light))


def bared_fit(camera: ExposedCamera, last: Fit) -> Fit | None:
    """Return a fit of the brightest streaks of `last` and all that lies on their pixels.

    Stars that are hidden in a streak move its ends: where the joint fit had no room for them, fewer streaks
    with all of those know the motion better. None where it had room, and where the fit fails or goes astray.
    """
    others, scene = last.hidden, last.scene
    if others is None or not len(others.light):
        return None
    camera = replace(camera, growing=bool(last.free[3]))
    order = np.argsort(-scene.light * scene.trusted, kind="stable")[: np.count_nonzero(scene.trusted)]
    areas = np.cumsum(window_areas(camera.pinhole, scene.select(order), camera.settings.reach))
    leading = order[: max(_LEAST_BARED, int(np.count_nonzero(areas < _BARED_SHARE * _MOST_PIXELS)))]
    first, rest = scene.select(leading), scene.select(np.setdiff1d(np.arange(len(scene.light)), leading))
    stars, light = (np.concatenate(both) for both in ((rest.stars, others.stars), (rest.light, others.light)))
    distance = _NEAR * camera.settings.reach * scene.width
    near = close_by(camera.pinhole, scene.motion, stars, first.stars, distance)
    whole = first.with_stars(stars[near], light[near])
    fitted = _affordable(camera, whole, 1.0)
    camera = _accounted(camera, whole.select(~fitted))
    done = iterate(camera, whole.select(fitted), last.free, LAST)
    lost = done is None or _beyond(done.scene.motion) or _far(camera, scene, done.scene)
    return None if lost else done


def _beyond(motion: Motion) -> bool:
    """Return whether the rate changes by more than the model can describe; known otherwise, it does not."""
    if motion.shape.any():
        return False
    return float(np.linalg.norm(motion.growth)) > _MOST_GROWTH * float(np.linalg.norm(motion.turn))


def _trusted(camera: ExposedCamera, rough: Fit) -> BoolArray:
    """Return which stars stay trusted: those that agree with most; all when too few do."""
    estimates = own_estimates(rough.evaluation, rough.scene, camera.free)
    before = rough.scene.trusted
    if estimates is None:
        return before
    had = np.flatnonzero(before)
    moved = path_lengths(camera.pinhole, rough.scene.motion, rough.scene.stars[had])
    turn = float(np.linalg.norm(rough.scene.motion.whole))
    angle = _END_FLOOR * turn / max(float(np.median(moved)), 1.0)
    floors = np.array([angle, angle, angle, _WIDTH_FLOOR])
    agree = agreeing(OwnEstimates(estimates.change[had], estimates.deviation[had]), floors, _TRUST_SIGMAS)
    if np.count_nonzero(agree) < max(camera.settings.least_stars, len(had) // 3):
        return before
    after = before.copy()
    after[had] = agree
    return after


def _affordable(camera: ExposedCamera, scene: Scene, more: float) -> BoolArray:
    """Return which stars (n,) the fit has room for: the trusted, of the others the brightest."""
    room = window_areas(camera.pinhole, scene, camera.settings.reach)
    order = np.lexsort((-scene.light, ~scene.trusted))
    needed = np.empty(len(room))
    needed[order] = np.cumsum(room[order])
    return np.asarray(scene.trusted | (needed <= more * _MOST_PIXELS))


def _accounted(camera: ExposedCamera, others: Scene) -> ExposedCamera:
    """Return the camera with a frame less the light of `others`, which is not known to the last electron."""
    if not len(others.light):
        return camera
    signal, floor = camera.frame.signal.copy(), camera.frame.floor.copy()
    count = len(others.light)
    for some in np.split(np.arange(count), range(_AT_ONCE, count, _AT_ONCE)):
        pixels, light = _modelled(camera, others.select(some))
        signal[pixels] -= light
        floor[pixels] += np.square(np.float32(_DOUBT) * light)
    return replace(camera, frame=replace(camera.frame, signal=signal, floor=floor))


def _modelled(camera: ExposedCamera, scene: Scene) -> tuple[IntArray, Float32Array]:
    """Return the pixels (m,) about the stars of `scene`, and its light there."""
    windows = camera.windows(scene)
    return windows.pixels, light_of(camera.pinhole, camera.shutter, scene, windows)
