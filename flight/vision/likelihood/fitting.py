"""The two fits of a frame: the brightest stars under rival hypotheses, then all that share their pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flight.arrays import BoolArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.agreement import Opinions, agreeing, opinions
from flight.vision.likelihood.blobs import Blobs
from flight.vision.likelihood.ends import true_ends
from flight.vision.likelihood.exposed_frame import ExposedFrame
from flight.vision.likelihood.first_guess import guess_motions
from flight.vision.likelihood.matched_filter import FaintStars, close_by, find_faint
from flight.vision.likelihood.motion import Motion, paths
from flight.vision.likelihood.normal_equations import ALONE, Evaluation, evaluate, light_of
from flight.vision.likelihood.scene import Scene, path_lengths, window_times
from flight.vision.likelihood.settings import LikelihoodSettings
from flight.vision.likelihood.shutter import Shutter
from flight.vision.likelihood.solution import Solution, moved, solve
from flight.vision.likelihood.streak_model import Float32Array
from flight.vision.likelihood.windows import Windows, cut_windows

_FIRST_STARS = 12
_FIRST_ROUNDS = 12
_ROUGH_ROUNDS = 3
_LAST_ROUNDS = 8
_LONGEST_STEP = 3.0
# Steps of an end or the width that are as good as none, px.
_FIRST_TOLERANCE = 0.1
_LAST_TOLERANCE = 0.003
# Converged: no shared parameter moves by more than this part of its standard deviation.
_SETTLED = 0.2
# A hypothesis with so many stars, this part of which it explains, needs no rival.
_MANY = 5
_MOST = 0.6
_WORST_FIRST = 12.0
# A star is explained when no more than this part of its light is left; none counts more than so many sigmas.
_LEFT_OVER = 0.01
_ENOUGH = 200.0
# Regions longer than a hypothesis allows speak against it, but may be two streaks in one.
_CONTRADICTION = 0.6
_CALM = 2.0
# Ends in place of a hypothesis of the wrong turn: it may have one of the two of each streak.
_BY_CHANCE = 0.4
_WIDEST = 6.0
_CONJUGATE = 12
# A star is trusted within so many deviations; ends (px) and width (px) are never modelled better than this.
_TRUST_SIGMAS = 3.5
_END_FLOOR = 0.01
_WIDTH_FLOOR = 0.002
# How wrong the light of a faint star found along the motion may be on a pixel, as part of it.
_DOUBT = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class ExposedCamera:
    """A frame with all that is known of how it was taken."""

    frame: ExposedFrame
    pinhole: Pinhole
    shutter: Shutter
    settings: LikelihoodSettings

    @property
    def free(self) -> BoolArray:
        """Which shared parameters the settings ask to fit."""
        growing = self.settings.rate_model == "accelerating"
        return np.array([True] * 3 + [growing] * 3 + [True])

    def windows(self, scene: Scene) -> Windows:
        """Return the pixels about the scene's streaks."""
        return cut_windows(self.pinhole, self.shutter, scene, self.settings.reach)

    def evaluate(self, scene: Scene, windows: Windows, clip: float) -> Evaluation:
        """Return the normal equations."""
        growing = self.settings.rate_model == "accelerating"
        return evaluate(self.frame, self.pinhole, self.shutter, scene, windows, clip, growing)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A scene after its last step, with the equations of that step.

    Attributes:
        restless: the last step of what is shared, in standard deviations; 0 when it was as good as none.
    """

    scene: Scene
    solution: Solution
    evaluation: Evaluation
    restless: float


def first_fit(camera: ExposedCamera, blobs: Blobs) -> Scene | None:
    """Return the brightest stars under the first hypothesis of the motion that they bear out."""
    settings = camera.settings
    best: tuple[float, Fit] | None = None
    free = np.array([True] * 3 + [False] * 3 + [True])
    width = float(np.hypot(settings.psf_sigma, 0.29))
    for guess in guess_motions(blobs, camera.pinhole, _FIRST_STARS):
        count = len(guess.light)
        everyone = np.ones(count, dtype=np.bool_)
        scene = Scene(Motion.steady(guess.turn), width, guess.stars, guess.light, np.zeros(count), everyone)
        done = _iterate(camera, scene, free, _FIRST_ROUNDS, 0.0, _FIRST_TOLERANCE)
        if done is None:
            continue
        evidence, share = _borne_out(done)
        ends = _ending(camera, done.scene)
        explained = evidence * (1.0 - _CONTRADICTION * guess.contradicted) * max(ends - _BY_CHANCE, 0.02)
        if best is None or explained > best[0]:
            best = explained, done
        if done.restless <= _SETTLED and min(share, ends) > _MOST and count >= _MANY:
            break
    if best is None or _misfit(best[1].evaluation) > _WORST_FIRST:
        return None
    return best[1].scene


def still_fit(camera: ExposedCamera, blobs: Blobs) -> Fit | None:
    """Return the stars of a camera at rest: their centroids, and the width of the point spread."""
    count = min(len(blobs), camera.settings.most_stars)
    width = float(np.hypot(camera.settings.psf_sigma, 0.29))
    everyone = np.ones(count, dtype=np.bool_)
    still = Motion.steady(np.zeros(3))
    scene = Scene(still, width, blobs.centre[:count], blobs.flux[:count], np.zeros(count), everyone)
    free = np.array([False] * 6 + [True])
    return _iterate(camera, scene, free, _FIRST_ROUNDS, camera.settings.clip, _LAST_TOLERANCE)


def _ending(camera: ExposedCamera, scene: Scene) -> float:
    """Return what part of the streaks' ends is seen where it should be; 1 when none can be told."""
    times = window_times(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    ends = true_ends(camera.frame, camera.pinhole, scene.motion, scene.stars, scene.light, times)
    return float(np.mean(ends)) if len(ends) else 1.0


def _borne_out(done: Fit) -> tuple[float, float]:
    """Return how much light a fit explains, in sigmas squared, and what part of the stars.

    A turn of the wrong size leaves an end of each streak over, or makes one of nothing: a good part of its
    light. No single star outweighs the rest.
    """
    light = done.scene.light**2 / np.maximum(done.solution.joint[:, 9, 9], 1e-30)
    left = done.evaluation.chi2 - done.evaluation.pixels
    good = left < _LEFT_OVER * light + done.evaluation.pixels
    calm = 1.0 if done.restless < _CALM else 0.3
    return calm * float(np.sum(np.minimum(light, _ENOUGH**2)[good])), float(np.mean(good))


def _iterate(
    camera: ExposedCamera,
    scene: Scene,
    free: BoolArray,
    rounds: int,
    clip: float,
    tolerance: float,
    conjugate: int = 0,
) -> Fit | None:
    """Return the fit after at most `rounds` steps, None when the stars do not fix the motion."""
    windows = camera.windows(scene)
    cut_at = scene
    restless = np.inf
    solution, evaluation = None, None
    for _ in range(rounds):
        evaluation = camera.evaluate(scene, windows, clip)
        solution = solve(evaluation, scene, free, conjugate)
        if solution is None:
            return None
        scene, wanted = moved(scene, solution, camera.pinhole, _LONGEST_STEP)
        if not (0.3 < scene.width < _WIDEST) or not np.all(np.isfinite(scene.stars)):
            return None
        if float(np.linalg.norm(scene.motion.turn)) > np.pi:
            return None
        deviation = np.sqrt(np.diag(solution.covariance)[free])
        restless = float(np.max(np.abs(solution.shared[free]) / deviation)) if wanted > tolerance else 0.0
        if restless <= _SETTLED:
            break
        if _drifted(camera, cut_at, scene):
            windows, cut_at = camera.windows(scene), scene
    if solution is None or evaluation is None:
        return None
    return Fit(scene, solution, evaluation, restless)


def _drifted(camera: ExposedCamera, before: Scene, after: Scene) -> bool:
    """Tell whether an end of a streak has left the middle of its window."""
    for time in (-0.5, 0.5):
        at = np.full(len(before.stars), time)
        there = paths(camera.pinhole, after.motion, after.stars, at).position
        was = paths(camera.pinhole, before.motion, before.stars, at).position
        if float(np.max(np.abs(there - was), initial=0.0)) > 0.7:
            return True
    return False


def _misfit(evaluation: Evaluation) -> float:
    """Return the median chi-square a pixel of the stars."""
    freedom = np.maximum(evaluation.pixels - ALONE - 1.0, 1.0)
    return float(np.median(evaluation.chi2 / freedom))


def last_fit(camera: ExposedCamera, first: Scene) -> tuple[Fit | None, FaintStars]:
    """Return the joint fit of the brightest stars, and the faint ones that it left to the matched filter."""
    settings = camera.settings
    modelled = _modelled(camera, first)
    faint = find_faint(
        camera.frame, modelled, camera.pinhole, first.motion, settings.faint_sigmas, settings.most_faint
    )
    whole = first.with_stars(faint.stars, faint.light)
    order = np.argsort(-whole.light, kind="stable")
    bright, rest = order[: settings.most_stars], order[settings.most_stars :]
    scene, others = whole.select(bright), whole.select(rest)
    scene = replace(scene, trusted=np.ones(len(bright), dtype=np.bool_))
    near = np.flatnonzero(
        close_by(camera.pinhole, scene.motion, others.stars, scene.stars, 2.0 * settings.reach * scene.width)
    )
    fitted = others.select(near[: settings.most_neighbours])
    scene = scene.with_stars(fitted.stars, fitted.light)
    accounted = _accounted(camera, others.select(near[settings.most_neighbours :]))
    done = _iterate(accounted, scene, camera.free, _ROUGH_ROUNDS, settings.clip, _LAST_TOLERANCE, _CONJUGATE)
    if done is not None:
        scene = replace(done.scene, trusted=_trusted(camera, done))
        done = _iterate(
            accounted, scene, camera.free, _LAST_ROUNDS, settings.clip, _LAST_TOLERANCE, _CONJUGATE
        )
    rest = np.delete(rest, near[: settings.most_neighbours])
    rest = rest[rest >= len(first.light)] - len(first.light)
    return done, FaintStars(faint.stars[rest], faint.light[rest], faint.significance[rest])


def _trusted(camera: ExposedCamera, rough: Fit) -> BoolArray:
    """Return which stars keep a say in what is shared: those that agree with most; all when too few do."""
    said = opinions(rough.evaluation, rough.scene, camera.free)
    before = rough.scene.trusted
    if said is None:
        return before
    had = np.flatnonzero(before)
    moved = path_lengths(camera.pinhole, rough.scene.motion, rough.scene.stars[had])
    turn = float(np.linalg.norm(rough.scene.motion.turn))
    angle = _END_FLOOR * turn / max(float(np.median(moved)), 1.0)
    floors = np.array([angle, angle, angle, _WIDTH_FLOOR])
    agree = agreeing(Opinions(said.change[had], said.deviation[had]), floors, _TRUST_SIGMAS)
    if np.count_nonzero(agree) < max(camera.settings.least_stars, len(had) // 3):
        return before
    after = before.copy()
    after[had] = agree
    return after


def _accounted(camera: ExposedCamera, others: Scene) -> ExposedCamera:
    """Return the camera with a frame less the light of `others`, which is not known to the last electron."""
    if not len(others.light):
        return camera
    frame, light = camera.frame, _modelled(camera, others)
    doubt = np.square(np.float32(_DOUBT) * light)
    return replace(camera, frame=replace(frame, signal=frame.signal - light, floor=frame.floor + doubt))


def _modelled(camera: ExposedCamera, scene: Scene) -> Float32Array:
    return light_of(camera.frame, camera.pinhole, camera.shutter, scene, camera.windows(scene))
