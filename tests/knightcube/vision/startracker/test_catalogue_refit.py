"""Tests of the second fit, with all catalogue stars: accuracy, covariance, and rejection."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, from_rotation_vector, multiply, to_rotation_vector
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker import catalogue_refit
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    SolveSettings,
    SolveStatus,
    solve_motion,
)
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import Shutter, StreakScene
from knightcube.vision.streaks.joint_fit import FitProblem
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.startracker.frames import SkyFrame, sky, sky_frame

_CAMERA = StarCameraModel(field_of_view=float(np.deg2rad(20.0)))
_LIKELIHOOD = LikelihoodSettings(saturation=float(_CAMERA.highest_count), gain=_CAMERA.gain, line_time=0.0)
_SETTINGS = SolveSettings(likelihood=_LIKELIHOOD)
_STREAK_PX, _EXPOSURE = 450.0, 0.2
_SEEDS = (5, 6, 8)
_MILKY_WAY = 16


@cache
def _first(seed: int, streak_px: float = _STREAK_PX) -> tuple[SkyFrame, FrameSolution]:
    """Return a frame with streaks of nearly half the field of view, and the solution of the first fit."""
    frame = sky_frame(np.random.default_rng([77, seed]), streak_px, _EXPOSURE, _CAMERA)
    motion = estimate_motion(frame.pixels, _CAMERA.pinhole, _EXPOSURE, _LIKELIHOOD, frame.rate, 0.0)
    prior = AttitudePrior(multiply(from_rotation_vector(np.array([2e-4, -1e-4, 1e-4])), frame.attitude), 3e-4)
    return frame, solve_motion(motion, _CAMERA.pinhole, (1.0, 1.0), sky(), _SETTINGS, prior)


@cache
def _second(seed: int) -> FrameSolution:
    frame, first = _first(seed)
    return refit_with_catalogue(frame.pixels, first, sky(), _SETTINGS, _LIKELIHOOD)


def _error(solution: FrameSolution, truth: FloatArray) -> FloatArray:
    assert solution.fix is not None
    return to_rotation_vector(multiply(solution.fix.quaternion, conjugate(truth)))


def _rate_error(solution: FrameSolution, frame: SkyFrame) -> float:
    assert solution.motion is not None
    assert solution.motion.rate is not None
    return float(np.linalg.norm(solution.motion.rate - frame.rate) / np.linalg.norm(frame.rate))


def test_the_second_fit_improves_attitude_and_rate() -> None:
    """The second fit has smaller rms errors of attitude and rate than the first fit, over three frames.

    In these frames, undetected stars bias the first fit.
    """
    errors = []
    for seed in _SEEDS:
        frame, first = _first(seed)
        bound = frame.attitude_bound(30)
        least = float(np.sqrt(bound[0, 0] + bound[1, 1]))
        both = first, _second(seed)
        errors.append([float(np.linalg.norm(_error(one, frame.attitude)[:2])) / least for one in both])
        errors[-1] += [_rate_error(one, frame) for one in both]
    before, after, rate_before, rate_after = np.sqrt(np.mean(np.square(errors), axis=0))
    assert after < 1.0
    assert after < 0.8 * before
    assert rate_after < 0.65 * rate_before


def test_stars_rejected_because_of_hidden_stars_are_accepted_again() -> None:
    for seed in _SEEDS:
        first, second = _first(seed)[1].motion, _second(seed).motion
        assert first is not None
        assert second is not None
        assert second.used_count > first.used_count


def test_the_errors_agree_with_the_covariance() -> None:
    """The normalised squared error is below the 99.9 % quantile of a chi-square with 9 degrees of freedom."""
    squares = 0.0
    for seed in _SEEDS:
        error, fix = _error(_second(seed), _first(seed)[0].attitude), _second(seed).fix
        assert fix is not None
        squares += float(error @ np.linalg.solve(fix.covariance, error))
    assert squares < 27.9


def test_the_second_fit_needs_little_memory_in_the_milky_way() -> None:
    """In the Milky Way, the second fit examines only close pairs of the 1200 stars, to save memory.

    The memory of the worker is limited.
    """
    frame, first = _first(_MILKY_WAY, 120.0)
    tracemalloc.start()
    try:
        refit_with_catalogue(frame.pixels, first, sky(), _SETTINGS, _LIKELIHOOD)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 45 * 2**20


def test_a_star_missing_in_the_catalogue_stays_untrusted() -> None:
    """A star that is missing in the catalogue is not trusted.

    The second brightest of the identified stars is removed from the catalogue.
    """
    frame, first = _first(_SEEDS[0])
    struck = int(np.sort(first.star[first.matched])[1])
    known = sky()
    kept = np.delete(np.arange(len(known.stars)), struck)
    stars = replace(
        known.stars,
        hip=known.stars.hip[kept],
        direction=known.stars.direction[kept],
        magnitude=known.stars.magnitude[kept],
    )
    without = replace(known, stars=stars, motion=known.motion[kept])
    number = np.where(np.isin(first.star, [-1, struck]), -1, np.searchsorted(kept, first.star))
    renumbered = replace(first, star=number)
    motion = refit_with_catalogue(frame.pixels, renumbered, without, _SETTINGS, _LIKELIHOOD).motion
    assert motion is not None
    assert motion is not first.motion
    place = first.points[first.star == struck][0]
    apart = np.linalg.norm(motion.stars - place, axis=1)
    assert apart.min() < 1.0
    assert not motion.used[apart.argmin()]


def test_a_contradicting_second_rate_is_rejected() -> None:
    """A second rate that contradicts the first rate is rejected.

    In the test, the first rate is wrong by 1 % but has a small covariance, so the correct second rate is
    rejected.
    """
    frame, first = _first(_SEEDS[0])
    motion = first.motion
    assert motion is not None
    assert motion.rate is not None
    assert motion.covariance is not None
    off = replace(first, motion=replace(motion, rate=1.01 * motion.rate))
    assert refit_with_catalogue(frame.pixels, off, sky(), _SETTINGS, _LIKELIHOOD) is off


def test_unsolved_uncalibrated_and_unstreaked_frames_are_not_fitted_again() -> None:
    frame, first = _first(_SEEDS[0])
    for other in (
        replace(first, status=SolveStatus.NO_MATCH),
        replace(first, scale_sigma=1e-4),
        replace(first, motion=None),
    ):
        assert refit_with_catalogue(frame.pixels, other, sky(), _SETTINGS, _LIKELIHOOD) is other


@pytest.mark.parametrize("line_time", [1e-9, -1e-9])
def test_a_rate_of_unknown_sign_under_a_rolling_shutter_is_not_fitted_again(line_time: float) -> None:
    frame, first = _first(_SEEDS[0])
    assert first.motion is not None
    unclear = replace(first, motion=replace(first.motion, status=StreakStatus.AMBIGUOUS))
    rolling = replace(_LIKELIHOOD, line_time=line_time)
    assert refit_with_catalogue(frame.pixels, unclear, sky(), _SETTINGS, rolling) is unclear


_PINHOLE = Pinhole(200, 160, 900.0)
_COURSE = CameraMotion.steady(np.array([0.0, 0.04, 0.0]))
"""A rotation that moves stars by 36 px to the left."""


def test_known_stars_are_ordered_by_their_flux_within_the_frame() -> None:
    """The fraction inside the frame is computed at nine instants; stars outside the frame are dropped."""
    places = np.array([[100.0, 80.0], [0.0, 80.0], [100.0, 400.0], [60.0, 50.0], [216.0, 30.0]])
    light = np.array([450.0, 900.0, 9000.0, 700.0, 8000.0])
    found = catalogue_refit._Known.seen(_PINHOLE, _COURSE, places, light, 9)
    inside = {100.0: 1.0, 0.0: 5.0 / 9.0, 60.0: 1.0, 216.0: 1.0 / 9.0}
    expected = sorted(((light[k] * inside[places[k, 0]], k) for k in (0, 1, 3, 4)), reverse=True)
    order = [k for _, k in expected]
    assert found.places.tolist() == places[order].tolist()
    assert found.light.tolist() == light[order].tolist()
    assert found.inside == pytest.approx([inside[x] for x in places[order, 0]])
    few = catalogue_refit._Known.seen(_PINHOLE, _COURSE, places, light, 2)
    assert few.places.tolist() == places[order[:2]].tolist()


def test_of_two_stars_within_two_pixels_the_fainter_is_a_twin() -> None:
    places = np.array([[50.0, 50.0], [80.0, 20.0], [51.2, 51.5], [81.5, 21.5], [50.9, 90.0], [49.0, 49.0]])
    known = catalogue_refit._Known(places, np.linspace(9.0, 1.0, 6), np.ones(6))
    # The third and the last star are less than 2 px from the first, and the fourth 2.1 px from the second.
    assert known.twins().tolist() == [False, False, True, False, False, True]


def test_measured_stars_without_a_catalogue_star_are_foreign() -> None:
    """A measured star is known if a catalogue star of similar flux is near it, or near its streak."""
    known = catalogue_refit._Known(np.array([[100.0, 80.0]]), np.array([1000.0]), np.ones(1))
    cases = (
        ([104.9, 80.0], 1000.0, False),
        ([100.0, 85.1], 1000.0, True),
        ([104.9, 80.0], 3300.0, False),
        ([104.9, 80.0], 3400.0, True),
        ([130.0, 82.0], 1000.0, False),  # on the circle of the streak, within its length of 36 px
        ([70.0, 78.0], 1000.0, False),
        ([140.0, 80.0], 1000.0, True),
        ([120.0, 83.0], 1000.0, True),
    )
    for place, flux, foreign in cases:
        motion = MotionResult(StreakStatus.RATE, 1, 0.2, stars=np.array([place]), flux=np.array([flux]))
        assert (catalogue_refit._foreign(_PINHOLE, _COURSE, motion, known).tolist() == [0]) == foreign


def test_hidden_stars_are_subtracted_and_their_errors_added_to_the_noise() -> None:
    scene = StreakScene(
        _COURSE,
        1.1,
        np.array([[100.0, 80.0], [60.0, 40.0]]),
        np.array([5000.0, 3000.0]),
        np.zeros(2),
        np.zeros(2, dtype=np.bool_),
    )
    frame = reduce_frame(np.full((160, 200), 100, np.uint16), 60000.0, 1.0)
    camera = FitProblem(frame, _PINHOLE, Shutter(), LikelihoodSettings(), 1.0)
    left = catalogue_refit._without(camera, scene)
    light = frame.signal - left.signal
    assert light.sum() == pytest.approx(8000.0, rel=0.02)
    column, row = np.arange(32_000) % 200, np.arange(32_000) // 200
    bright = light > 1.0
    assert np.all(np.minimum(np.abs(row - 80), np.abs(row - 40))[bright] <= 6)
    assert np.ptp(column[bright & (row > 60)]) == pytest.approx(36.0, abs=6.0)
    added = (catalogue_refit._LIGHT_ERROR * light) ** 2
    assert left.floor - frame.floor == pytest.approx(added, rel=1e-3, abs=1e-3)
    nobody = scene.select(np.zeros(2, dtype=np.bool_))
    assert catalogue_refit._without(camera, nobody) is frame
