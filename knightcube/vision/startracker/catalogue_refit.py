"""Second fit of the streaks of an identified frame, with all stars of the catalogue, including faint stars.

In a frame of long streaks, most stars are fainter than the noise of a pixel. The light of faint stars
overlaps the bright streaks and displaces their measured positions. A close pair of stars is measured as one
star. After a frame is identified, the positions of all stars are known from the catalogue. The catalogue
magnitudes of all stars are converted to counts by means of the measured stars. Stars that are too faint to be
fitted, or too near to a brighter star, are subtracted from the frame, and the uncertainty of their brightness
is added to the noise. The initial positions of the fitted stars are their catalogue positions. Light sources
that are not in the catalogue are fitted but do not affect the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import Pinhole, streak_camera
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.sky_map import SkyMap, apparent
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    SolveSettings,
    SolveStatus,
    solve_motion,
)
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.estimate import StreakVerdict, with_rate, with_stars
from knightcube.vision.streaks.frame import ReducedFrame, reduce_frame
from knightcube.vision.streaks.geometry import (
    Shutter,
    StreakScene,
    azimuth_differences,
    near_streaks,
    path_lengths,
    polar_angles,
    positions,
)
from knightcube.vision.streaks.joint_fit import FitProblem, joint_fit
from knightcube.vision.streaks.scene_images import light_of
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus

# Distance below which streaks overlap, in half-widths of the pixel strip around a bright streak.
_NEAR = 1.4
# Distance (px) below which two stars are too close to be fitted separately.
_TWIN = 2.0
# Largest distance (px) between a measured star and its catalogue star, and minimum ratio of their fluxes.
_SAME, _ALIKE = 5.0, 0.3
# Distance (px) from a catalogue star's streak within which a measured star counts as part of the streak.
_BESIDE = 2.5
# Relative error of a star's flux that is predicted from the catalogue.
_LIGHT_ERROR = 0.15
# Number of stars that are subtracted from the frame in one batch.
_AT_ONCE = 25
# Number of instants of the exposure at which it is tested whether a star is in the frame.
_INSTANTS = 9
# Factor by which the maximum number of pixels is larger in the second fit, which includes more stars.
_ROOM = 1.7
# Largest chi-square of the difference between the rates of both fits (1 false alarm in 100,000 frames).
_ONE_MOTION = 25.9
# Standard deviation (px) added to that of the fitted attitude when the stars are identified again.
_PRIOR_PX = 1.0


def refit_with_catalogue(
    pixels: Image,
    solution: FrameSolution,
    sky: SkyIndex,
    settings: SolveSettings,
    likelihood: LikelihoodSettings,
) -> FrameSolution:
    """Return a solution with motion and attitude fitted again, or the same solution if the new fit fails.

    The other arguments must be those with which `solution` was computed. A solution with a fitted focal
    length is returned unchanged.
    """
    motion, fix = solution.motion, solution.fix
    if motion is None or fix is None or solution.status is not SolveStatus.SOLVED or solution.scale_sigma:
        return solution
    again = refit_motion(pixels, motion, solution, sky, settings, likelihood)
    if again is None:
        return solution
    sigma = np.sqrt(np.linalg.eigvalsh(fix.covariance)[-1]) + _PRIOR_PX / solution.camera.focal_length
    prior = AttitudePrior(fix.quaternion, float(sigma))
    better = solve_motion(again, solution.camera, (1.0, 1.0), sky, settings, prior)
    if better.status is not SolveStatus.SOLVED or not better.tracked:
        return solution
    return replace(better, tracked=solution.tracked, log10_false_alarm=solution.log10_false_alarm)


def refit_motion(
    pixels: Image,
    motion: MotionResult,
    solution: FrameSolution,
    sky: SkyIndex,
    settings: SolveSettings,
    likelihood: LikelihoodSettings,
) -> MotionResult | None:
    """Return `motion` fitted again with all catalogue stars, or None if the fit fails or changes the rate."""
    # With a rolling shutter, an ambiguous streak permits two rates.
    # The result contains the mean of both rates, which is not a valid initial value.
    between = likelihood.delay_per_row != 0.0 and motion.status is not StreakStatus.RATE
    if motion.rate is None or motion.covariance is None or between:
        return None
    pinhole, exposure = streak_camera(solution.camera), motion.exposure
    # The rotation during the exposure includes mean rate, acceleration and higher-order terms.
    growth = np.zeros(3) if motion.acceleration is None else motion.acceleration * exposure**2
    shape = np.zeros((0, 3)) if motion.course is None else motion.course.terms[2:]
    course = CameraMotion.between(motion.rate * exposure, growth, shape)
    most = likelihood.most_stars + likelihood.most_neighbours + likelihood.most_faint
    known = _known_stars(motion, solution, sky, settings, course, (pinhole, most))
    if known is None:
        return None
    camera = FitProblem(
        reduce_frame(pixels, likelihood.saturation, likelihood.gain),
        pinhole,
        Shutter(likelihood.delay_per_row / exposure, pinhole.centre[1]),
        likelihood,
        motion.psf_sigma,
        motion.rate_model == "accelerating",
    )
    scene, hidden = _scenes(camera, course, known, motion)
    camera = replace(camera, frame=_without(camera, hidden))
    done = joint_fit(camera, scene, _ROOM)
    if done is None:
        return None
    # With `hidden` set to None, `with_rate` does not repeat the fit with fewer streaks.
    done = replace(done, hidden=None)
    refit = with_rate(with_stars(motion, camera, done), camera, done, StreakVerdict.CONFIRMED)
    if refit.status is not StreakStatus.AMBIGUOUS or refit.rate is None or refit.covariance is None:
        return None
    assumed = np.zeros((3, 3)) if motion.course is None else motion.course.covariance(exposure)
    covariance = refit.covariance + assumed
    apart = refit.rate - motion.rate
    if not apart @ np.linalg.solve(motion.covariance + covariance, apart) < _ONE_MOTION:
        return None
    # Faint streaks that are not among the streaks of the new fit are kept.
    worst = np.linalg.norm(motion.faint_endpoints[:, None] - refit.endpoints, axis=-1).max(axis=-1)
    left = (worst > _SAME).all(axis=1)
    return replace(
        refit,
        status=motion.status,
        covariance=covariance,
        faint_endpoints=motion.faint_endpoints[left],
        faint_flux=motion.faint_flux[left],
        faint_significance=motion.faint_significance[left],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """Catalogue stars in and around a frame: positions (n, 2) at mid-exposure, px, and fluxes (n,), counts.

    The fraction `inside` (n,) of each star's path lies in the frame.
    """

    places: FloatArray
    light: FloatArray
    inside: FloatArray

    @classmethod
    def seen(
        cls, pinhole: Pinhole, course: CameraMotion, places: FloatArray, light: FloatArray, most: int
    ) -> _Known:
        """Return at most `most` stars in the frame, ordered by decreasing flux within the frame."""
        n = len(places)
        time = np.tile(np.linspace(-0.5, 0.5, _INSTANTS), n)
        there = positions(pinhole, course, np.repeat(places, _INSTANTS, axis=0), time)
        inside = pinhole.contains(there).reshape(n, _INSTANTS).mean(axis=1)
        order = np.argsort(-light * inside, kind="stable")
        order = order[inside[order] > 0.0][:most]
        return cls(places[order], light[order], inside[order])

    def twins(self) -> BoolArray:
        """Return which stars (n,) are too close to a brighter star to be fitted separately."""
        order = np.argsort(self.places[:, 0], kind="stable")
        fainter = np.zeros(len(order), dtype=np.bool_)
        for places_on in range(1, len(order)):
            one, two = order[:-places_on], order[places_on:]
            gap = self.places[two] - self.places[one]
            if not (gap[:, 0] < _TWIN).any():
                break
            close = np.hypot(gap[:, 0], gap[:, 1]) < _TWIN
            fainter[np.maximum(one, two)[close]] = True
        return fainter


def _known_stars(
    motion: MotionResult,
    solution: FrameSolution,
    sky: SkyIndex,
    settings: SolveSettings,
    course: CameraMotion,
    seen_by: tuple[Pinhole, int],
) -> _Known | None:
    """Return the catalogue stars in the frame, or None if no fitted star is identified.

    The argument `seen_by` contains the camera model of the streak fit and the maximum number of stars. The
    counts of a star of magnitude zero are determined from the identified stars.
    """
    matched = solution.matched
    apart = np.linalg.norm(solution.points[matched, None] - motion.stars, axis=-1)
    fitted = apart.argmin(axis=1)
    used = motion.used[fitted]
    if solution.fix is None or not used.any():
        return None
    magnitude = sky.stars.magnitude
    zero = np.median(np.log10(motion.flux[fitted[used]]) + 0.4 * magnitude[solution.star[matched[used]]])
    (pinhole, most), matrix = seen_by, attitude_matrix(solution.fix.quaternion)
    reach = min(pinhole.half_diagonal + 0.5 * float(np.linalg.norm(course.rotation)), 0.5 * np.pi)
    near = np.flatnonzero(matrix[2].astype(np.float32) @ sky.coarse > np.cos(reach))
    direction = sky.stars.direction[near]
    if settings.velocity is not None:
        direction = apparent(direction, settings.velocity)
    places = SkyMap(solution.camera, solution.fix.quaternion, solution.bend).pixels(direction)
    return _Known.seen(pinhole, course, places, 10.0 ** (float(zero) - 0.4 * magnitude[near]), most)


def _scenes(
    camera: FitProblem, course: CameraMotion, known: _Known, motion: MotionResult
) -> tuple[StreakScene, StreakScene]:
    """Return the stars to fit and the stars to subtract; the brightest fitted stars determine the motion."""
    settings = camera.settings
    width = float(np.sqrt(motion.psf_sigma**2 + 1.0 / 12.0))
    leading = np.arange(len(known.light)) < settings.most_stars
    room = _NEAR * settings.reach * width
    near = leading | near_streaks(camera.pinhole, course, known.places, known.places[leading], room)
    twin = known.twins()
    path = path_lengths(camera.pinhole, course, known.places) + 2.0 * np.sqrt(np.pi) * width
    light = known.light * known.inside
    floor = float(np.median(camera.frame.floor)) * 2.0 * np.sqrt(np.pi) * width * path * known.inside
    seen = light > settings.faint_sigmas * np.sqrt(floor + light / camera.frame.gain)
    fitted = np.flatnonzero(near & (leading | seen) & ~twin)[: settings.most_stars + settings.most_neighbours]
    hidden = near.copy()
    hidden[fitted] = False
    foreign = _foreign(camera.pinhole, course, motion, known)

    def scene(k: IntArray | BoolArray) -> StreakScene:
        sky, profile = np.zeros(len(known.light[k])), motion.psf_profile
        return StreakScene(course, width, known.places[k], known.light[k], sky, leading[k], profile)

    fit, subtracted = scene(fitted), scene(hidden)
    return fit.with_stars(motion.stars[foreign], motion.flux[foreign]), subtracted


def _foreign(pinhole: Pinhole, course: CameraMotion, motion: MotionResult, known: _Known) -> IntArray:
    """Return the indices of measured stars that are not near a catalogue star or its streak.

    The streak of a catalogue star is also examined because the first fit may divide it into two stars.
    """
    near = np.linalg.norm(motion.stars[:, None] - known.places, axis=2) < _SAME
    polar, azimuth = polar_angles(pinhole, course, motion.stars)
    known_polar, known_azimuth = polar_angles(pinhole, course, known.places)
    beside = np.abs(polar[:, None] - known_polar) * pinhole.focal_length < _BESIDE
    near |= beside & (
        azimuth_differences(azimuth[:, None], known_azimuth) < float(np.linalg.norm(course.rotation))
    )
    alike = known.light > _ALIKE * motion.flux[:, None]
    return np.flatnonzero(~(near & alike).any(axis=1))


def _without(camera: FitProblem, hidden: StreakScene) -> ReducedFrame:
    """Return the frame with the `hidden` stars subtracted and their uncertainty added to the noise."""
    frame = camera.frame
    if not len(hidden.light):
        return frame
    light = np.zeros_like(frame.signal)
    for begin in range(0, len(hidden.light), _AT_ONCE):
        some = hidden.select(np.arange(begin, min(begin + _AT_ONCE, len(hidden.light))))
        windows = camera.windows(some)
        light[windows.pixels] += light_of(camera.pinhole, camera.shutter, some, windows)
    signal = frame.signal - light
    light *= np.float32(_LIGHT_ERROR)
    light *= light
    light += frame.floor
    return replace(frame, signal=signal, floor=light)
