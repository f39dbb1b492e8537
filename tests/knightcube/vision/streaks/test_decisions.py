"""Tests of the decisions of the rate estimator: streak check, sign of the rotation, and reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import estimate, first_fits
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.estimate import StreakVerdict, check_streaks, with_rate, with_stars
from knightcube.vision.streaks.faint_stars import FaintStars
from knightcube.vision.streaks.first_fits import alike
from knightcube.vision.streaks.first_guess import MotionGuess
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import Course, Shutter, StreakScene, path_lengths, positions
from knightcube.vision.streaks.joint_fit import FitProblem, StreakFit
from knightcube.vision.streaks.normal_equations import (
    ALONE,
    SHARED,
    EliminatedEquations,
    Evaluation,
    Solution,
)
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from knightcube.vision.streaks.uncertainty import RotationUncertainty
from knightcube.vision.streaks.vibration import CommonMotion

_PINHOLE = Pinhole(160, 140, 800.0)
_MOTION = CameraMotion.steady(np.array([0.02, -0.03, 0.05]))


def _problem(**settings: object) -> FitProblem:
    noise = np.random.default_rng(2).normal(100.0, 4.0, (140, 160)).astype(np.uint16)
    chosen = replace(LikelihoodSettings(), **settings)  # type: ignore[arg-type]  # named settings
    return FitProblem(reduce_frame(noise, 60000.0, 1.0), _PINHOLE, Shutter(), chosen, 1.0)


def _scene(stars: FloatArray, light: FloatArray, trusted: int) -> StreakScene:
    n = len(stars)
    return StreakScene(_MOTION, 1.1, stars, light, np.zeros(n), np.arange(n) < trusted)


_NOBODY = FaintStars(np.empty((0, 2)), np.empty(0), np.empty(0))


def test_motions_are_alike_if_they_are_equal_or_opposite_within_half_a_percent() -> None:
    one = np.array([0.0, 0.3, 0.4])
    for share, equal in ((0.9, True), (1.1, False)):
        off = np.array([share * first_fits._SAME_MOTION * 0.5, 0.0, 0.0])
        assert alike(one, one + off) == equal
        assert alike(one, -one + off) == equal


@pytest.mark.parametrize(
    ("ends", "lit", "verdict"),
    [
        # `ends` of each streak: 1 correct, 0 wrong, NaN outside the frame. `lit`: 1 if a streak has no gaps.
        ([[1, 1]] * 8, [1] * 8, StreakVerdict.CONFIRMED),
        ([[1, 1]] * 3 + [[0, 0]] * 5, [1] * 8, StreakVerdict.REJECTED),
        ([[1, 1]] * 3 + [[np.nan, 0]] * 5, [1] * 8, StreakVerdict.REJECTED),
        ([[1, 1]] * 2 + [[np.nan, 0]] * 2, [1] * 8, StreakVerdict.DOUBTFUL),
        ([[1, 1]] * 3 + [[np.nan, 0]] * 3, [1] * 8, StreakVerdict.CONFIRMED),
        ([[1, np.nan]] * 8, [1] * 8, StreakVerdict.DOUBTFUL),
        ([[np.nan, np.nan]] * 8, [1] * 8, StreakVerdict.CONFIRMED),
        ([[1, 1]] * 2, [0] * 1 + [1] * 7, StreakVerdict.CONFIRMED),
        ([[1, 1]] * 2, [0] * 2 + [1] * 6, StreakVerdict.DOUBTFUL),
        ([[1, 1]] * 3, [0] * 2 + [1] * 6, StreakVerdict.CONFIRMED),
        ([[1, 1]] * 8, [0] * 3 + [1] * 5, StreakVerdict.REJECTED),
    ],
)
def test_a_motion_is_confirmed_by_its_streak_ends_and_by_streaks_without_gaps(
    ends: list[list[float]], lit: list[float], verdict: StreakVerdict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wrong ends or gaps reject a motion or make it doubtful, unless three streaks have two correct ends."""
    monkeypatch.setattr(estimate, "true_ends", lambda *_: np.array(ends, dtype=float))
    monkeypatch.setattr(estimate, "unbroken", lambda *_: np.array(lit, dtype=float))
    stars = np.random.default_rng(1).uniform(50.0, 90.0, (8, 2))
    scene = _scene(stars, np.full(8, 5000.0), 8)
    monkeypatch.setattr(estimate, "chained_stars", lambda *_: np.zeros(8, dtype=np.bool_))
    assert check_streaks(_problem(), scene, _NOBODY) is verdict


def test_chains_and_trails_reject_a_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "true_ends", lambda _, scene: np.ones((len(scene.stars), 2)))
    monkeypatch.setattr(estimate, "unbroken", lambda *_: np.ones(8))
    scene = _scene(np.random.default_rng(1).uniform(50.0, 90.0, (9, 2)), np.full(9, 5000.0), 8)
    for count, verdict in ((3, StreakVerdict.CONFIRMED), (4, StreakVerdict.REJECTED)):
        chained = (np.arange(9) < count) | (np.arange(9) == 8)
        monkeypatch.setattr(estimate, "chained_stars", lambda *_, chained=chained: chained)
        assert check_streaks(_problem(), scene, _NOBODY) is verdict
    monkeypatch.setattr(estimate, "chained_stars", lambda *_: np.zeros(9, dtype=np.bool_))
    growing = replace(scene, motion=CameraMotion(_MOTION.rate, 0.5 * _MOTION.rate))
    slowly = replace(scene, motion=CameraMotion(_MOTION.rate, 0.3 * _MOTION.rate))
    for share, verdict in ((0.45, StreakVerdict.CONFIRMED), (0.55, StreakVerdict.REJECTED)):
        monkeypatch.setattr(estimate, "trailing_fraction", lambda *_, share=share: share)
        assert check_streaks(_problem(), growing, _NOBODY) is verdict
        assert check_streaks(_problem(), slowly, _NOBODY) is StreakVerdict.CONFIRMED
    # If no streak end is confirmed, trails reject any motion, also one with a nearly constant rate.
    monkeypatch.setattr(estimate, "true_ends", lambda _, scene: np.full((len(scene.stars), 2), np.nan))
    assert check_streaks(_problem(), slowly, _NOBODY) is StreakVerdict.REJECTED
    monkeypatch.setattr(estimate, "trailing_fraction", lambda *_: 0.45)
    assert check_streaks(_problem(), slowly, _NOBODY) is StreakVerdict.CONFIRMED


def test_a_motion_is_doubtful_if_most_flux_of_complete_streaks_contradicts_it() -> None:
    """Stars fainter than those of the motion, and stars at the border, do not contradict the motion."""
    stars = np.array([[60.0, 60.0], [80.0, 70.0], [90.0, 50.0], [3.0, 70.0]])
    for others, disagree in ((5500.0, False), (6500.0, True)):
        light = np.array([6000.0, others, 3000.0, 9e4])
        assert estimate._most_disagree(_problem(), _scene(stars, light, 1)) == disagree


def test_a_star_with_two_confirmed_ends_does_not_contradict_the_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = _scene(np.array([[60.0, 60.0], [80.0, 70.0]]), np.array([6000.0, 9000.0]), 1)
    for ends, disagree in (([1.0, 1.0], False), ([1.0, np.nan], True), ([0.0, 1.0], True)):
        monkeypatch.setattr(estimate, "true_ends", lambda *_, ends=ends: np.array([ends]))
        assert estimate._most_disagree(_problem(), scene) == disagree


def _candidate(rate: list[float] | None, excess: list[float], place: float = 0.0) -> estimate._Candidate:
    covariance = None if rate is None else 1e-8 * np.eye(3)
    result = MotionResult(
        StreakStatus.AMBIGUOUS if rate is not None else StreakStatus.FAILED,
        1,
        0.2,
        rate=None if rate is None else np.array(rate),
        covariance=covariance,
    )
    middles = 40.0 * np.arange(len(excess))[:, None] + np.array([place, 0.0])
    return estimate._Candidate(result, np.zeros(3), StreakVerdict.CONFIRMED, middles, np.array(excess))


def _rolling(
    one: estimate._Candidate | None,
    other: estimate._Candidate | None,
    prior: FloatArray | None = None,
    sigma: float = 1e-3,
) -> tuple[MotionResult | None, list[float]]:
    """Return the result if the senses +x and -x give `one` and `other`, and the senses tried."""
    asked: list[float] = []

    def fit_along(sense: FloatArray) -> estimate._Candidate | None:
        asked.append(float(sense[0]))
        return one if sense[0] > 0.0 else other

    return estimate._rolling_result(fit_along, np.array([1.0, 0.0, 0.0]), prior, sigma, 3.0), asked


def test_a_rolling_shutter_shows_the_sign_of_the_rotation() -> None:
    """The sign with the smaller residuals of most streaks is chosen, if the difference is significant."""
    ahead, back = [0.1, 0.002, 0.0], [-0.1, 0.002, 0.0]
    better, worse = [0.0] * 12, [20.0] * 12
    for excess, expected in (((better, worse), ahead), ((worse, better), back)):
        found, asked = _rolling(_candidate(ahead, excess[0]), _candidate(back, excess[1], 2.9))
        assert found is not None
        assert found.rate == pytest.approx(expected)
        assert asked == [1.0, -1.0]
    unclear = (
        ([0.0] * 4, [12.0] * 4, 0.0),  # the difference is below 50
        ([0.0] * 3, [900.0, -900.0, 60.0], 0.0),  # the streaks contradict each other
        (better, worse, 3.1),  # the stars have different positions
    )
    for one, other, apart in unclear:
        found, _ = _rolling(_candidate(ahead, one), _candidate(back, other, apart))
        assert found is not None
        assert found.status is StreakStatus.AMBIGUOUS
        # The mean of the first rate and the opposite of the second, with half of the difference as error.
        assert found.rate == pytest.approx([0.1, 0.0, 0.0])
        assert found.covariance == pytest.approx(1e-8 * np.eye(3) + np.diag([0.0, 0.002**2, 0.0]))


def test_a_prior_rate_decides_on_the_sign_of_the_rotation() -> None:
    ahead, back = _candidate([0.1, 0.0, 0.0], [0.0]), _candidate([-0.1, 0.0, 0.0], [0.0])
    for prior, expected in ((0.05, 0.1), (-0.05, -0.1)):
        found, asked = _rolling(ahead, back, np.array([prior, 0.0, 0.0]))
        assert found is not None
        assert found.status is StreakStatus.RATE
        assert found.rate == pytest.approx([expected, 0.0, 0.0])
        assert asked == [np.sign(prior)]
    # A prior rate that is not significant does not decide the sense of the rotation.
    assert _rolling(ahead, back, np.array([0.05, 0.0, 0.0]), 1.0)[1] == [1.0, -1.0]
    failed = _candidate(None, [0.0])
    found, asked = _rolling(failed, back, np.array([0.05, 0.0, 0.0]))
    assert (found is failed.result, asked) == (True, [1.0])
    # If only one sign can be fitted, the other may still be correct.
    for other in (None, failed):
        found, _ = _rolling(ahead, other)
        assert found is not None
        assert (found.status, found.rate, found.covariance) == (StreakStatus.FAILED, None, None)
        assert "give a prior rate" in found.reason
    assert _rolling(None, None)[0] is None


@pytest.mark.parametrize("delay", [1e-3, -1e-3, 0.0])
def test_the_error_of_the_motion_from_navigation_is_in_the_covariance(
    monkeypatch: pytest.MonkeyPatch, delay: float
) -> None:
    """The result uses the motion from navigation and its error, unless the pixels contradict this motion."""
    turn = np.array([0.1, 0.0, 0.0])
    course = Course(np.stack([turn, 0.0 * turn, turn]), 1e-4)
    camera = replace(_problem(), shutter=Shutter(delay, 70.0), course=_MOTION)
    monkeypatch.setattr(estimate, "guess_axis", lambda *_: (turn / 0.1, None))
    follows = [True]

    def best(problem: FitProblem, *_: object) -> estimate._Candidate:
        lost = problem.course is not None and not follows[0]
        return _candidate(None if lost else [0.5, 0.0, 0.0], [0.0])

    monkeypatch.setattr(estimate, "_best_motion", best)
    seen: Any = MotionResult(StreakStatus.FAILED, 1, 0.2)
    found = estimate._in_direction(camera, seen, cast(Any, None), turn / 0.2, 1e-3, course)
    assert found is not None
    assert found.status is StreakStatus.RATE
    assert found.course is course
    assert found.covariance == pytest.approx(1e-8 * np.eye(3) + course.covariance(0.2))
    follows[0] = False
    found = estimate._in_direction(camera, seen, cast(Any, None), turn / 0.2, 1e-3, course)
    assert found is not None
    assert found.course is None
    assert found.covariance == pytest.approx(1e-8 * np.eye(3))


_STARS = np.array([[60.0, 60.0], [80.0, 75.0], [95.0, 50.0], [95.9, 50.3], [40.0, 100.0]])
_LIGHT = np.array([6000.0, 5000.0, 3000.0, 2500.0, 6.0])


def _fit() -> StreakFit:
    """Return a fit of five stars, of which the fourth is near the third, and the fifth not significant."""
    rng = np.random.default_rng(3)
    root = (
        rng.normal(size=(5, SHARED + ALONE, 30)) * np.array([3e3] * 6 + [90.0, 30.0, 20.0, 0.1, 1.0])[:, None]
    )
    information = root @ root.swapaxes(1, 2)
    kept = np.array([0, 1, 2, 6])
    own = np.linalg.inv(information[:, SHARED:, SHARED:])
    gain = information[:, kept, SHARED:] @ own
    inner = np.linalg.inv(
        (information[:, kept[:, None], kept] - gain @ information[:, SHARED:][:, :, kept]).sum(0)
    )
    solution = Solution(np.zeros(SHARED), np.zeros((5, ALONE)), EliminatedEquations(kept, own, gain, inner))
    chi2 = np.array([110.0, 230.0, 95.0, 100.0, 100.0])
    evaluation = Evaluation(information, np.zeros((5, 11)), chi2, np.full(5, 105.0), [], 0, [])
    scene = _scene(_STARS, _LIGHT, 2)
    camera = _problem()
    return StreakFit(scene, scene, solution, evaluation, 0.0, camera.windows(scene), camera.free)


def test_the_result_contains_the_fitted_stars_and_their_streaks() -> None:
    """The ends of the streaks follow from the motion; their covariance is that of motion and star.

    A star near a brighter star, and a star that is not significant, are omitted.
    """
    last, camera = _fit(), _problem(psf_sigma=1.3)
    found = with_stars(MotionResult(StreakStatus.FAILED, 7, 0.2), camera, last)
    assert found.stars == pytest.approx(_STARS[:3])
    assert found.flux == pytest.approx(_LIGHT[:3])
    assert found.used.tolist() == [True, True, False]
    joint = last.solution.joint
    assert found.significance == pytest.approx(_LIGHT[:3] / np.sqrt(joint[:3, 9, 9]))
    assert found.star_covariance == pytest.approx(joint[:3, 7:9, 7:9])
    for end, time in enumerate((-0.5, 0.5)):
        times = np.full(3, time)
        assert found.endpoints[:, end] == pytest.approx(positions(_PINHOLE, _MOTION, _STARS[:3], times))
        design = np.zeros((3, 2, 11))
        for k, step in ((0, 1e-5), (1, 1e-5), (2, 1e-5), (7, 1e-2), (8, 1e-2)):
            moved = []
            for way in (1.0, -1.0):
                change = way * step * np.eye(11)[k]
                motion = CameraMotion.steady(_MOTION.rate + change[:3])
                moved.append(positions(_PINHOLE, motion, _STARS[:3] + change[7:9], times))
            design[:, :, k] = (moved[0] - moved[1]) / (2.0 * step)
        covariance = design @ joint[:3] @ design.swapaxes(1, 2)
        assert found.endpoint_covariance[:, end] == pytest.approx(
            covariance, rel=1e-2, abs=1e-3 * covariance.max()
        )
    assert found.directions[:, 0] == pytest.approx(_PINHOLE.unit_vectors(found.endpoints[:, 0]))
    assert found.directions[:, 1] == pytest.approx(_PINHOLE.unit_vectors(_STARS[:3]))
    assert found.directions[:, 2] == pytest.approx(_PINHOLE.unit_vectors(found.endpoints[:, 1]))
    assert found.length == pytest.approx(np.median(path_lengths(_PINHOLE, _MOTION, _STARS[:2])))
    assert found.psf_sigma == pytest.approx(np.sqrt(1.1**2 - 1.0 / 12.0))
    assert found.misfit == pytest.approx(1.1)
    assert found.rate_model == "constant"
    spread = np.sqrt(np.median(np.trace(found.endpoint_covariance[:, 0], axis1=1, axis2=2)))
    assert found.residual == pytest.approx(spread / 800.0)
    assert (found.checksum, found.exposure) == (7, 0.2)


def _known(**changed: object) -> RotationUncertainty:
    usual = RotationUncertainty(_MOTION.rate, 1e-8 * np.eye(3), 0.001, CommonMotion(), 0.0)
    return replace(usual, **changed)  # type: ignore[arg-type]  # named attributes


def _rated(
    monkeypatch: pytest.MonkeyPatch,
    known: RotationUncertainty,
    change: Callable[[MotionResult], MotionResult] = lambda result: result,
    verdict: StreakVerdict = StreakVerdict.CONFIRMED,
    last_step: float = 0.0,
    reversed_: float = 0.0,
) -> MotionResult:
    monkeypatch.setattr(estimate, "rotation_uncertainty", lambda *_: known)
    monkeypatch.setattr(estimate, "reversal_improvement", lambda *_: reversed_)
    last, camera = _fit(), _problem()
    seen = with_stars(MotionResult(StreakStatus.FAILED, 7, 0.2), camera, last)
    return with_rate(change(seen), camera, replace(last, last_step=last_step), verdict)


def _moved(result: MotionResult, stars: list[int], place: float) -> MotionResult:
    """Return the result with the leftmost end of some streaks moved to the column `place`."""
    moved = result.stars.copy()
    for _ in range(5):
        # The point-spread width is 1.1 px, so that an end is visible at column 1.7 or more.
        first = positions(_PINHOLE, _MOTION, moved, np.full(len(moved), -0.5))
        last = positions(_PINHOLE, _MOTION, moved, np.full(len(moved), 0.5))
        moved[stars, 0] += place - np.minimum(first, last)[stars, 0]
    return replace(result, stars=moved)


def test_an_accepted_motion_has_a_rate_with_its_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    found = _rated(monkeypatch, _known())
    assert found.status is StreakStatus.AMBIGUOUS
    assert found.reason == ""
    assert found.rate == pytest.approx(_MOTION.rate / 0.2)
    assert found.covariance == pytest.approx(1e-8 / 0.04 * np.eye(3))
    assert found.acceleration is None


@pytest.mark.parametrize(
    ("known", "options", "text"),
    [
        ({}, {"last_step": 2.1}, "the fit did not converge"),
        ({"aside": 0.5}, {"change": lambda one: replace(one, misfit=4.2)}, "misfit 4.2"),
        ({}, {"verdict": StreakVerdict.REJECTED}, "segments"),
        ({"common_motion": CommonMotion(0.06, 0.01)}, {}, "0.06 px across and 1 %"),
        ({"common_motion": CommonMotion(0.01, 0.06)}, {}, "0.01 px across and 6 %"),
        ({"model_error": 0.0081}, {}, "uncertain by 0.8 %"),
        ({}, {"reversed_": 31.0}, "reversed within the exposure"),
        ({}, {"change": lambda one: _moved(one, [0, 1], 1.6)}, "no streak has both ends in the frame"),
    ],
)
def test_a_rejected_motion_has_a_reason(
    known: dict[str, object], options: dict[str, object], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = _rated(monkeypatch, _known(**known), **options)  # type: ignore[arg-type]  # named options
    assert found.status is StreakStatus.FAILED
    assert text in found.reason
    assert found.rate is None


@pytest.mark.parametrize(
    ("known", "options"),
    [
        ({}, {"last_step": 1.9}),
        ({"aside": 0.44}, {"change": lambda one: replace(one, misfit=4.2)}),
        ({"aside": 0.5}, {"change": lambda one: replace(one, misfit=3.9)}),
        ({}, {"verdict": StreakVerdict.DOUBTFUL}),
        ({"common_motion": CommonMotion(0.049, 0.049)}, {}),
        ({"model_error": 0.0079}, {}),
        ({}, {"reversed_": 29.0}),
        ({}, {"change": lambda one: _moved(one, [0, 1], 1.8)}),
        ({}, {"change": lambda one: _moved(one, [0], 1.6)}),
    ],
)
def test_a_motion_within_all_limits_is_accepted(
    known: dict[str, object], options: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = _rated(monkeypatch, _known(**known), **options)  # type: ignore[arg-type]  # named options
    assert found.status is StreakStatus.AMBIGUOUS
    assert found.rate is not None


def test_few_or_short_streaks_give_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    def few(result: MotionResult) -> MotionResult:
        return replace(result, used=np.array([True, False, False]))

    found = _rated(monkeypatch, _known(), few)
    assert (found.status, found.reason) == (StreakStatus.TOO_FEW, "1 streaks agree, at least 2 are needed")
    short = _rated(monkeypatch, _known(), lambda result: replace(result, length=2.9))
    assert (short.status, short.reason) == (
        StreakStatus.TOO_SHORT,
        "streaks of 2.9 px are too short for a rate",
    )
    assert _rated(monkeypatch, _known(), lambda result: replace(result, length=3.1)).rate is not None
    # The rotation is less than five standard deviations from zero.
    size = float(np.linalg.norm(_MOTION.rate))
    for share, status in ((4.9, StreakStatus.TOO_SHORT), (5.1, StreakStatus.AMBIGUOUS)):
        covariance = (size / share) ** 2 * np.eye(3)
        assert _rated(monkeypatch, _known(covariance=covariance)).status is status


def test_double_images_reject_a_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """A streak is double if another star within 8 px has at least 30 % of its flux."""

    def beside(distance: float, share: float, count: int) -> Callable[[MotionResult], MotionResult]:
        def changed(result: MotionResult) -> MotionResult:
            stars = np.concatenate([result.stars[:2], result.stars[:count] + np.array([distance, 0.0])])
            flux = np.concatenate([result.flux[:2], share * result.flux[:count]])
            return replace(result, stars=stars, flux=flux, used=np.arange(len(flux)) < 2)

        return changed

    for change, rejected in (
        (beside(7.9, 0.31, 2), True),
        (beside(8.1, 0.31, 2), False),
        (beside(7.9, 0.29, 2), False),
        (beside(7.9, 0.31, 1), True),
    ):
        found = _rated(monkeypatch, _known(), change)
        assert ("most streaks are double" in found.reason) == rejected


def test_a_scan_confirms_the_angle_of_a_motion() -> None:
    rotation = np.array([0.06, 0.0, 0.08])
    assert first_fits.has_angle(rotation, [0.104, 0.3])
    assert not first_fits.has_angle(rotation, [0.106, 0.1])
    assert not first_fits.has_angle(rotation, [0.094])
    assert not first_fits.has_angle(rotation, [])


def test_a_scan_of_a_frame_without_streaks_gives_no_fit() -> None:
    assert list(first_fits.fits_near_angles(_problem(), _MOTION.rotation, [0.4, 0.2])) == []


def _guessed(angle: float) -> Any:
    """Return a stand-in for a preliminary fit with the rotation angle `angle` about z."""
    motion = CameraMotion.steady(np.array([0.0, 0.0, angle]))
    return SimpleNamespace(scene=SimpleNamespace(motion=motion), evaluation=None)


def _first_fit(explained: float, convincing: bool, angle: float, *, shaken: bool = False) -> Any:
    return SimpleNamespace(explained=explained, convincing=convincing, fit=_guessed(angle), shaken=shaken)


def _searched(
    monkeypatch: pytest.MonkeyPatch,
    tried: list[tuple[float, bool, float] | None],
    rescanned: list[tuple[float, bool, float]],
    lit: float = 0.0,
    misfit: float = 1.0,
    disturbed: dict[float, tuple[float, bool, float]] | None = None,
) -> list[float]:
    """Return the angles of the first fits for guesses given as (chi-square, is convincing, angle).

    The keys of `disturbed` are the angles of the fits whose residuals may show a vibration, and its values
    are the fits with a vibration.
    """
    again = disturbed or {}
    fits = [None if one is None else _first_fit(*one, shaken=one[2] in again) for one in tried]
    results = iter(fits)
    monkeypatch.setattr(first_fits, "_guesses", lambda *_: iter(range(len(tried))))
    monkeypatch.setattr(first_fits, "_tried", lambda *_: next(results))
    monkeypatch.setattr(
        first_fits,
        "_disturbed",
        lambda _, first: _first_fit(*again[float(first.fit.scene.motion.rotation[2])]),
    )
    monkeypatch.setattr(first_fits, "misfit", lambda *_: misfit)
    monkeypatch.setattr(first_fits, "likely_angles", lambda *_: [one[2] for one in rescanned])
    monkeypatch.setattr(
        first_fits, "fits_near_angles", lambda *_: iter([_first_fit(*one) for one in rescanned])
    )
    regions: Any = SimpleNamespace(lit=lit)
    found = first_fits.first_fits(_problem(), regions, None)
    return [float(fit.scene.motion.rotation[2]) for fit in found]


def test_convincing_guesses_come_before_the_others_in_the_order_of_their_evidence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    doubtful, sure, other = (2e3, False, 0.1), (9e3, True, 0.2), (5e3, False, 0.3)
    assert _searched(monkeypatch, [doubtful, sure, None, other], []) == [0.2, 0.3, 0.1]
    # A convincing fit does not come first if an unconvincing fit explains more; then the frame is scanned.
    assert _searched(monkeypatch, [(9.5e3, False, 0.1), sure], [(8e3, False, 0.5)]) == [0.1, 0.2, 0.5]
    # Equal motions are fitted once, and poor fits are dropped.
    assert _searched(monkeypatch, [sure, (8e3, True, 0.2005), other], []) == [0.2, 0.3]
    assert _searched(monkeypatch, [doubtful, other], [], misfit=12.1) == []
    # If no guess is convincing, the whole frame is scanned until a fit is convincing.
    scans = [(1e3, False, 0.6), (7e3, True, 0.7), (9e3, True, 0.8)]
    assert _searched(monkeypatch, [doubtful, other], scans) == [0.7, 0.3, 0.1, 0.6]
    assert _searched(monkeypatch, [], scans) == []
    assert _searched(monkeypatch, [None], scans) == []


def test_a_vibration_is_fitted_only_if_no_guess_is_convincing_without_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For a wrong guess, a fit with a vibration would exhaust the work that a frame is allowed."""
    wrong, sure = (4e3, False, 0.1), (9e3, True, 0.2)
    asked: list[float] = []

    class Asked(dict[float, tuple[float, bool, float]]):
        def __getitem__(self, angle: float) -> tuple[float, bool, float]:
            asked.append(angle)
            return super().__getitem__(angle)

    again = Asked({0.1: (5e3, True, 0.11), 0.3: (6e3, True, 0.31)})
    found = _searched(monkeypatch, [wrong, sure], [], disturbed=again)
    assert found[0] == 0.2
    # The most likely fit whose residuals may show a vibration is tried first, even if it is convincing.
    asked.clear()
    doubtful = (5e3, True, 0.3)
    assert _searched(monkeypatch, [wrong, doubtful], [], disturbed=again)[0] == 0.31
    assert asked == [0.3, 0.1]
    # If the fit with a vibration is not convincing either, the order of the fits does not change.
    asked.clear()
    none = Asked({0.1: (4e3, False, 0.1)})
    assert _searched(monkeypatch, [wrong, (3e3, False, 0.2)], [], disturbed=none) == [0.1, 0.2]


@pytest.mark.parametrize(
    ("lit", "explained", "scans", "chosen"),
    [
        (0.06, 9e3, [(9.1e3, True, 0.3)], 0.3),
        (0.05, 9e3, [(9.1e3, True, 0.3)], 0.2),
        (0.06, 1.1e5, [(2e5, True, 0.3)], 0.2),
        (0.06, 9e3, [(8.9e3, True, 0.3)], 0.2),
        (0.06, 9e3, [(9.1e3, True, 0.2095)], 0.2),
        (0.06, 9e3, [(9.1e3, True, 0.2105)], 0.2105),
        (0.06, 9e3, [(9.1e3, False, 0.3), (9.5e3, False, 0.4)], 0.4),
        (0.06, 9e3, [(9.1e3, True, 0.3), (9.5e3, False, 0.4)], 0.3),
    ],
)
def test_a_crowded_frame_is_scanned_for_a_likelier_angle(
    lit: float,
    explained: float,
    scans: list[tuple[float, bool, float]],
    chosen: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A scan of the whole frame replaces a fit if many pixels are bright and another angle explains more."""
    assert _searched(monkeypatch, [(explained, True, 0.2)], scans, lit)[0] == chosen


def test_the_first_confirmed_motion_is_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    """A doubtful motion is accepted if a scan or another fit gives the same motion."""
    names = StreakVerdict.CONFIRMED, StreakVerdict.DOUBTFUL, StreakVerdict.REJECTED

    def best(fits: list[tuple[int, float]], scanned: list[tuple[int, float]], angles: list[float]) -> Any:
        verdicts = {angle: names[which] for which, angle in [*fits, *scanned]}

        def fitted(_: object, seen: MotionResult, fit: Any) -> estimate._Candidate:
            angle = float(fit.scene.motion.rotation[2])
            result = replace(seen, status=StreakStatus.AMBIGUOUS, rate=fit.scene.motion.rotation)
            rotation = np.array([0.0, 0.0, round(angle, 2)])
            return estimate._Candidate(result, rotation, verdicts[angle], np.empty((0, 2)), np.empty(0))

        monkeypatch.setattr(estimate, "_fitted", fitted)
        monkeypatch.setattr(estimate, "first_fits", lambda *_: iter([_guessed(angle) for _, angle in fits]))
        monkeypatch.setattr(estimate, "likely_angles", lambda *_: angles)
        monkeypatch.setattr(
            estimate, "fits_near_angles", lambda *_: iter([_first_fit(1.0, True, a) for _, a in scanned])
        )
        regions: Any = None
        return estimate._best_motion(_problem(), MotionResult(StreakStatus.FAILED, 1, 0.2), regions, None)

    assert best([], [], []) is None
    assert best([(0, 0.1), (0, 0.2)], [], []).rotation[2] == 0.1
    assert best([(1, 0.1), (0, 0.2)], [], [0.1]).rotation[2] == 0.1
    assert best([(1, 0.1), (0, 0.2)], [], [0.3]).rotation[2] == 0.2
    assert best([(2, 0.1), (0, 0.2)], [], [0.1]).rotation[2] == 0.2
    assert best([(1, 0.1), (0, 0.2)], [(0, 0.3)], [0.3]).rotation[2] == 0.3
    assert best([(2, 0.1)], [(1, 0.3)], [0.3]).rotation[2] == 0.3
    assert best([(1, 0.1)], [(1, 0.1001)], [0.4]).rotation[2] == 0.1
    failed = best([(1, 0.1)], [(1, 0.2)], [0.4])
    assert failed.result.status is StreakStatus.FAILED
    assert failed.result.rate is None
    assert failed.result.reason == "no motion is consistent with the brightness and the ends of the streaks"
    assert best([(1, 0.1), (2, 0.2), (0, 0.3)], [], [0.4]).result.status is StreakStatus.FAILED


def _attempt(
    monkeypatch: pytest.MonkeyPatch,
    ends: float = 1.0,
    last_step: float = 0.0,
    contradicted: float = 0.0,
    misfit: float = 1.0,
    chi2: float = 120.0,
    count: int = 4,
) -> Any:
    """Return the evidence for a guess of four stars, of which the first is badly fitted."""
    joint = np.zeros((4, 11, 11))
    joint[:, 9, 9] = [1.0, 4.0, 1.0, 25.0]
    done = SimpleNamespace(
        scene=SimpleNamespace(light=np.array([900.0, 90.0, 300.0, 500.0])),
        solution=SimpleNamespace(joint=joint),
        evaluation=SimpleNamespace(chi2=np.array([1e5, chi2, chi2, chi2]), pixels=np.full(4, 110.0)),
        last_step=last_step,
    )
    correct = np.full((10, 2), np.nan)
    correct[:, 0] = np.arange(10) < 10.0 * ends
    monkeypatch.setattr(first_fits, "iterate", lambda *_: done)
    monkeypatch.setattr(first_fits, "true_ends", lambda *_: correct)
    monkeypatch.setattr(first_fits, "unbroken", lambda *_: np.empty(0))
    monkeypatch.setattr(first_fits, "misfit", lambda *_: misfit)
    stars, light = np.full((count, 2), 60.0), np.full(count, 900.0)
    found = first_fits._tried(_problem(), MotionGuess(_MOTION, stars, light, contradicted))
    assert found is not None
    return found


def test_the_evidence_for_a_guess_is_its_explained_chi_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """The evidence sums the squared significances of well-fitted stars, each at most 200 squared.

    The evidence is multiplied by the fraction of correct ends minus 0.4, which a wrong angle may reach by
    chance.
    """
    squares = 45.0**2 + 200.0**2 + 100.0**2
    found = _attempt(monkeypatch)
    assert found.explained == pytest.approx(squares * 0.6)
    assert found.convincing
    half = _attempt(monkeypatch, ends=0.7)
    assert half.explained == pytest.approx(squares * 0.3)
    assert half.convincing
    wrong = _attempt(monkeypatch, ends=0.6)
    assert wrong.explained == pytest.approx(squares * 0.2)
    assert not wrong.convincing
    assert _attempt(monkeypatch, ends=0.2).explained == pytest.approx(squares * 0.02)
    assert _attempt(monkeypatch, last_step=2.1).explained == pytest.approx(0.3 * squares * 0.6)
    assert _attempt(monkeypatch, last_step=1.9).explained == pytest.approx(squares * 0.6)
    assert _attempt(monkeypatch, contradicted=0.5).explained == pytest.approx(squares * 0.6 * 0.7)
    # A star is well fitted if its excess chi-square is at most its pixels plus 1 % of its evidence.
    assert _attempt(monkeypatch, chi2=110.0 + 110.0 + 19.0).explained == pytest.approx(squares * 0.6)
    assert _attempt(monkeypatch, chi2=110.0 + 110.0 + 22.0).explained == pytest.approx(
        (squares - 45.0**2) * 0.6
    )
    assert not _attempt(monkeypatch, count=2).convincing
    assert _attempt(monkeypatch, count=3).convincing


def test_a_poor_fit_with_correct_ends_may_be_a_vibration(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _attempt(monkeypatch, misfit=2.6).shaken
    assert not _attempt(monkeypatch, misfit=2.4).shaken
    assert not _attempt(monkeypatch, ends=0.5, misfit=2.6).shaken


@pytest.mark.parametrize(("misfit", "explained"), [(11.0, 50.0), (13.0, 70.0)])
def test_a_profile_is_learned_if_a_vibration_does_not_explain_a_very_poor_fit(
    misfit: float, explained: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    first: Any = SimpleNamespace(
        fit=SimpleNamespace(free=np.zeros(SHARED, dtype=np.bool_)), guess=0, ends=1.0
    )
    known: Any = {"first": 20.0, "vibration": 50.0, "profile": 70.0}
    monkeypatch.setattr(first_fits, "misfit", lambda *_: misfit)
    monkeypatch.setattr(first_fits, "with_vibration", lambda *_: SimpleNamespace(evaluation="vibration"))
    monkeypatch.setattr(first_fits, "fit_profile", lambda *_: SimpleNamespace(evaluation="profile"))
    monkeypatch.setattr(first_fits, "_judged", lambda fit, *_: _first_fit(known[fit.evaluation], False, 0.1))
    assert first_fits._disturbed(_problem(), first).explained == explained


def test_a_rejected_motion_is_fitted_again_with_a_vibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """The vibration is searched in the fit of the brightest trusted stars, and must confirm the motion."""
    rejected = replace(_candidate([0.1, 0.0, 0.0], [0.0]), verdict=StreakVerdict.REJECTED)
    confirmed, shaken = _candidate([0.1, 0.0, 0.0], [0.0]), _candidate([0.2, 0.0, 0.0], [0.0])
    first = replace(_fit(), scene=_fit().scene.select(np.arange(1)))
    searched: list[StreakFit] = []

    def fitted(
        last: StreakFit | None, found: estimate._Candidate, after: estimate._Candidate, shows: bool = True
    ) -> estimate._Candidate:
        results = iter([(last, found), (last, after)])
        monkeypatch.setattr(estimate, "_candidate", lambda *_: next(results))

        def vibrating(_: FitProblem, start: StreakFit) -> StreakFit | None:
            searched.append(start)
            return start if shows else None

        monkeypatch.setattr(estimate, "with_vibration", vibrating)
        return estimate._fitted(_problem(), MotionResult(StreakStatus.FAILED, 1, 0.2), first)

    whole = _fit()
    assert fitted(whole, confirmed, shaken) is confirmed
    assert not searched
    assert fitted(whole, rejected, shaken) is shaken
    # The preliminary fit had one star, so only the brightest trusted star of the joint fit is used.
    assert searched[0].scene.light.tolist() == [6000.0]
    assert searched[0].hidden is None
    assert fitted(None, rejected, shaken) is shaken
    assert searched[1] is first
    again = replace(rejected, rotation=np.ones(3))
    assert fitted(whole, rejected, again) is rejected
    assert fitted(whole, rejected, shaken, shows=False) is rejected
