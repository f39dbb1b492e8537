"""Tests of the correction of streak lengths, the selection of fitted stars, and the steps of the fit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import joint_fit
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import window_areas
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import Shutter, StreakScene, path_lengths, paths, positions
from knightcube.vision.streaks.joint_fit import (
    ROUGH,
    FitProblem,
    StreakFit,
    WorkBudget,
    find_light_ends,
    iterate,
    stretched,
)
from knightcube.vision.streaks.normal_equations import (
    ALONE,
    SHARED,
    WIDTH,
    EliminatedEquations,
    Evaluation,
    Solution,
    solve,
)
from knightcube.vision.streaks.scene_images import light_of
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, real_sky
from tests.support.compiled_forms import assert_forms_agree

_STARS = 16


def _seen(theta: float, length: float, turned: float) -> tuple[FitProblem, StreakScene, CameraMotion]:
    """Return a frame, a scene whose motion is `turned` times the true motion, and the true motion."""
    sky = real_sky(21, np.radians(theta), length, 0.2)
    frame = reduce_frame(sky.pixels, SATURATION, CAMERA.gain)
    camera = FitProblem(frame, CAMERA.pinhole, Shutter(), LikelihoodSettings(), 1.0)
    order = np.argsort(-sky.electrons, kind="stable")[:_STARS]
    true = CameraMotion.steady(sky.rate * sky.exposure)
    motion = CameraMotion.steady(turned * true.rate)
    light, everyone = sky.electrons[order] / CAMERA.gain, np.ones(_STARS, dtype=np.bool_)
    return camera, StreakScene(motion, 1.04, sky.stars[order], light, np.zeros(_STARS), everyone), true


@pytest.mark.parametrize(("theta", "length"), [(90.0, 120.0), (60.0, 300.0), (20.0, 300.0)])
def test_the_light_ends_at_the_ends_of_the_true_motion(theta: float, length: float) -> None:
    camera, scene, _ = _seen(theta, length, 1.0)
    beyond, _ = find_light_ends(camera, scene)
    assert np.count_nonzero(np.isfinite(beyond)) >= 8
    assert float(np.nanmedian(np.abs(beyond))) < 2.0
    assert stretched(camera, scene) is None


@pytest.mark.parametrize("turned", [0.96, 1.04])
@pytest.mark.parametrize(("theta", "length"), [(90.0, 200.0), (60.0, 300.0)])
def test_a_motion_of_wrong_length_is_corrected(theta: float, length: float, turned: float) -> None:
    camera, scene, true = _seen(theta, length, turned)
    mended = stretched(camera, scene)
    assert mended is not None
    assert np.linalg.norm(mended.motion.rate - true.rate) < 0.006 * np.linalg.norm(true.rate)
    assert stretched(camera, mended) is None


def test_stars_with_one_correct_end_are_moved_between_their_ends() -> None:
    """Stars with one correct end are moved, so that their centres are between their ends.

    The rotation is 4 % too large and the first ends are correct, so that the centres are wrong by 6 px.
    """
    camera, scene, true = _seen(90.0, 300.0, 1.0)
    ahead = positions(camera.pinhole, true, scene.stars, np.full(_STARS, 0.02))
    off = replace(scene, motion=CameraMotion.steady(1.04 * true.rate), stars=ahead)
    assert float(np.median(np.linalg.norm(ahead - scene.stars, axis=1))) > 5.0
    mended = stretched(camera, off)
    assert mended is not None
    assert float(np.median(np.linalg.norm(mended.stars - scene.stars, axis=1))) < 1.5


_CROWD = 40
_TRUSTED = 12
_ROOM = 20


def _taken(theta: float, length: float) -> tuple[FitProblem, StreakScene]:
    """Return a frame and its brightest stars at their true positions. The first stars are trusted."""
    sky = real_sky(7, np.radians(theta), length, 1.0)
    frame = reduce_frame(sky.pixels, SATURATION, CAMERA.gain)
    camera = FitProblem(frame, CAMERA.pinhole, Shutter(), LikelihoodSettings(), 1.0)
    order = np.argsort(-sky.electrons, kind="stable")[:_CROWD]
    width = float(np.sqrt(CAMERA.psf_sigma**2 + 1.0 / 12.0))
    trusted = np.arange(len(order)) < _TRUSTED
    motion = CameraMotion.steady(sky.rate * sky.exposure)
    light = sky.electrons[order] / CAMERA.gain
    return camera, StreakScene(motion, width, sky.stars[order], light, np.zeros(len(order)), trusted)


@pytest.mark.parametrize(("theta", "length"), [(90.0, 60.0), (60.0, 400.0), (30.0, 400.0), (3.0, 250.0)])
def test_the_number_of_pixels_of_windows_is_predicted(theta: float, length: float) -> None:
    """The predicted number of pixels in windows is within a third of the true number.

    The tested streaks are straight, oblique, curved, or only partly visible.
    """
    camera, scene = _taken(theta, length)
    windows = camera.windows(scene)
    taken = windows.strips.index.size + windows.patches.index.size
    foreseen = float(window_areas(camera.pinhole, scene, camera.settings.reach).sum())
    assert 0.67 * taken < foreseen < 1.5 * taken


def test_the_brightest_stars_are_fitted_while_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The brightest stars are fitted up to the limit of pixels.

    The result does not depend on the order of the stars, and the rate error agrees with its covariance.
    """
    camera, scene = _taken(60.0, 300.0)
    room = float(window_areas(camera.pinhole, scene, camera.settings.reach)[:_ROOM].sum())
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", room * 1.001)
    done = joint_fit.joint_fit(camera, scene.select(np.arange(len(scene.light))[::-1]))
    assert done is not None
    assert len(done.scene.light) == _ROOM
    apart = np.linalg.norm(done.scene.stars[:, None] - scene.stars[:_ROOM], axis=2).min(axis=0)
    assert np.median(apart) < 1.0
    error = (done.scene.motion.rate - scene.motion.rate)[:3]
    assert error @ np.linalg.solve(done.solution.covariance[:3, :3], error) < 25.0


def test_trusted_stars_are_fitted_without_regard_to_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trusted stars are fitted regardless of the limit of pixels.

    With a limit of one pixel, only the trusted stars are fitted.
    """
    camera, scene = _taken(60.0, 300.0)
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", 1.0)
    done = joint_fit.joint_fit(camera, scene)
    assert done is not None
    assert len(done.scene.light) == _TRUSTED


def test_a_step_without_rejected_stars_needs_no_further_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """If known equations omit some stars, the first step is that of a fit without these stars."""
    camera, scene = _taken(1.1, 60.0)
    once = replace(ROUGH, rounds=1)
    rough = iterate(camera, scene, camera.free, once)
    assert rough is not None
    trusted = scene.trusted.copy()
    trusted[1] = False
    expected = iterate(camera, replace(scene, trusted=trusted), camera.free, once)
    assert expected is not None
    monkeypatch.setattr(joint_fit, "evaluate", None)
    start, known = replace(rough.before, trusted=trusted), rough.evaluation.without(~trusted)
    found = iterate(camera, start, camera.free, replace(once, rounds=0), rough.windows, known)
    assert found is not None
    np.testing.assert_array_equal(found.scene.trusted, trusted)
    assert not np.array_equal(found.scene.motion.rate, rough.scene.motion.rate)
    np.testing.assert_allclose(found.scene.motion.rate, expected.scene.motion.rate, rtol=1e-9)
    np.testing.assert_allclose(found.scene.stars, expected.scene.stars, rtol=1e-9)


def test_a_fit_with_a_much_wider_point_spread_is_rejected() -> None:
    """A fit whose point spread is twice as wide as initially assumed is rejected as a wrong model."""
    camera, scene = _taken(60.0, 300.0)
    assert joint_fit.joint_fit(camera, scene) is not None
    assert joint_fit.joint_fit(camera, replace(scene, width=0.5 * scene.width)) is None


_SMALL = Pinhole(120, 100, 700.0)


def _small_problem(image: FloatArray | None = None, **settings: object) -> FitProblem:
    noise = np.random.default_rng(2).normal(100.0, 4.0, (100, 120)) if image is None else image
    frame = reduce_frame(np.rint(noise).astype(np.uint16), 60000.0, 1.0)
    chosen = replace(LikelihoodSettings(), **settings)  # type: ignore[arg-type]  # named settings
    return FitProblem(frame, _SMALL, Shutter(), chosen, 1.0)


def _small_scene() -> StreakScene:
    """Return three stars with streaks of about 30 px. The last star does not determine the motion."""
    stars = np.array([[30.0, 40.0], [60.0, 50.0], [90.0, 70.0]])
    light, trusted = np.array([4000.0, 3000.0, 2000.0]), np.array([True, True, False])
    motion = CameraMotion.steady(np.array([0.02, 0.04, 0.01]))
    return StreakScene(motion, 1.1, stars, light, np.array([1.0, 2.0, 3.0]), trusted)


def test_work_is_counted_in_pixels() -> None:
    """The work is exhausted by one pass, or one evaluation, more than fit into the limit."""
    for spend, pixels, work in (
        (WorkBudget.passed, 1_000_000, joint_fit._PASS * 1e6),
        (WorkBudget.evaluated, 10_000, 10_000.0 + joint_fit._EVALUATION),
    ):
        fitting = int(joint_fit._MOST_WORK / work)
        for times, exhausted in ((fitting, False), (fitting + 1, True)):
            budget = WorkBudget()
            for _ in range(times):
                spend(budget, pixels)
            assert budget.exhausted == exhausted


def test_the_acceleration_is_fitted_if_the_rate_changes() -> None:
    camera = _small_problem()
    assert camera.free.tolist() == [True, True, True, False, False, False, True]
    assert replace(camera, growing=True).free.all()
    assert camera.undecided
    assert not replace(camera, growing=True).undecided
    assert not _small_problem(rate_model="constant").undecided


def _solution(shared: list[float], alone: FloatArray) -> Solution:
    nothing = EliminatedEquations(
        np.zeros(0, np.int64), np.zeros((3, 4, 4)), np.zeros((3, 0, 4)), np.zeros((0, 0))
    )
    return Solution(np.array(shared), alone, nothing)


def test_a_step_of_the_fit_is_limited_at_the_ends_of_the_streaks() -> None:
    """The step of the shared parameters moves no streak end by more than 3 px."""
    scene = _small_scene()
    alone = np.array([[0.5, -1.0, 100.0, 0.2], [30.0, 40.0, -9000.0, 1.0], [0.0, 0.0, 50.0, -1.0]])
    small = _solution([1e-4, 2e-4, -1e-4, 0.0, 0.0, 0.0, 0.02], alone)
    after, wanted = joint_fit._stepped(scene, small, _SMALL)
    assert after.motion.rate == pytest.approx([0.0201, 0.0402, 0.0099])
    assert after.motion.acceleration == pytest.approx(np.zeros(3))
    assert after.width == pytest.approx(1.12)
    # The position of a star moves by 3 px at most, and its flux keeps at least 30 %.
    assert after.stars == pytest.approx(scene.stars + np.array([[0.5, -1.0], [1.8, 2.4], [0.0, 0.0]]))
    assert after.light == pytest.approx([4100.0, 900.0, 2050.0])
    assert after.sky == pytest.approx([1.2, 3.0, 2.0])
    time = np.repeat([-0.5, 0.5], 3)
    stars = np.tile(scene.stars, (2, 1))
    moved = positions(_SMALL, after.motion, stars, time) - positions(_SMALL, scene.motion, stars, time)
    assert wanted == pytest.approx(np.linalg.norm(moved, axis=1).max(), rel=0.02)
    large = _solution([1e-2, 2e-2, -1e-2, 0.01, 0.0, 0.0, 0.02], alone)
    limited, wanted = joint_fit._stepped(scene, large, _SMALL)
    share = joint_fit._LONGEST_STEP / wanted
    assert share < 0.5
    assert limited.motion.rate == pytest.approx(scene.motion.rate + share * large.shared[:3])
    assert limited.motion.acceleration == pytest.approx(share * large.shared[3:6])
    assert limited.width == pytest.approx(1.1 + share * 0.02)
    assert limited.light[0] == pytest.approx(4000.0 + share * 100.0)
    wide, wanted = joint_fit._stepped(scene, _solution([0.0] * 6 + [-2.0], 0.0 * alone), _SMALL)
    assert wanted == 2.0
    assert wide.width == pytest.approx(0.7 * 1.1)


def test_windows_are_cut_again_if_the_streak_ends_have_moved() -> None:
    camera, scene = _small_problem(), _small_scene()

    def drifted(after: StreakScene, faint: float = 50.0) -> bool:
        return joint_fit._drifted(camera, scene, after, faint)

    assert not drifted(scene)
    for share, moved in ((0.98, False), (1.02, True)):
        way = share * joint_fit._DRIFT
        for star, expected in ((1, moved), (2, False)):
            for axis in (0, 1):
                stars = scene.stars.copy()
                stars[star, axis] -= way
                assert drifted(replace(scene, stars=stars)) == expected
        stars = scene.stars.copy()
        stars[2, 0] += way
        assert drifted(replace(scene, stars=stars), joint_fit._DRIFT) == moved
    size = float(np.linalg.norm(scene.motion.rate))
    for share, moved in ((0.95, False), (1.05, True)):
        growth = np.array([0.0, 0.0, share * joint_fit._GROWN * size])
        assert drifted(replace(scene, motion=CameraMotion(scene.motion.rate, growth))) == moved


def _evaluation(stars: int, steps: FloatArray) -> Evaluation:
    """Return noisy normal equations whose solutions are the `steps` (n, 7) of the shared parameters."""
    rng = np.random.default_rng(9)
    root = rng.normal(size=(stars, SHARED + ALONE, 60))
    information = root @ root.swapaxes(1, 2)
    whole = np.concatenate([steps, np.zeros((stars, ALONE))], axis=1)
    noise = (root @ rng.normal(size=(stars, 60, 1)))[..., 0]
    gradient = np.einsum("nij,nj->ni", information, whole) + noise
    return Evaluation(information, gradient, np.full(stars, 100.0), np.full(stars, 105.0), [], 0, [])


def _grows(evaluation: Evaluation) -> bool:
    n = len(evaluation.chi2)
    motion = CameraMotion.steady(np.array([0.02, 0.04, 0.01]))
    scene = StreakScene(motion, 1.1, np.zeros((n, 2)), np.ones(n), np.zeros(n), np.ones(n, dtype=np.bool_))
    camera = _small_problem()
    windows = camera.windows(_small_scene())
    still = _solution([0.0] * 7, np.zeros((3, 4)))
    return StreakFit(scene, scene, still, evaluation, 0.0, windows, camera.free).grows()


def test_the_rate_changes_if_the_stars_agree_on_a_change() -> None:
    """A change on which all stars agree is significant, and noise and the change of a single star are not."""
    n = 12
    none = np.zeros((n, SHARED))
    assert not _grows(_evaluation(n, none))
    common = none.copy()
    common[:, 3:6] = [0.6, -0.5, 0.4]
    assert _grows(_evaluation(n, common))
    single = none.copy()
    single[4, 3:6] = [12.0, -10.0, 8.0]
    assert not _grows(_evaluation(n, single))
    # With three stars, the scatter of the stars is not known.
    assert not _grows(_evaluation(3, common[:3]))


def test_the_misfit_is_the_median_chi_square_per_degree_of_freedom() -> None:
    evaluation = replace(
        _evaluation(3, np.zeros((3, SHARED))),
        chi2=np.array([100.0, 300.0, 7.0]),
        pixels=np.array([55.0, 105.0, 5.0]),
    )
    assert joint_fit.misfit(evaluation) == pytest.approx(3.0)
    assert joint_fit.misfit(evaluation, np.array([0, 1])) == pytest.approx(2.5)
    assert joint_fit.misfit(evaluation, np.array([2])) == pytest.approx(7.0)
    assert np.isnan(joint_fit.misfit(evaluation, np.zeros(0, np.int64)))


def test_a_large_change_of_the_rate_is_excessive_unless_it_is_known() -> None:
    rate = np.array([0.3, 0.0, 0.4])
    limit = joint_fit._MOST_CHANGE * 0.5
    assert not joint_fit._excessive(CameraMotion(rate, np.array([0.0, 0.99 * limit, 0.0])))
    excessive = CameraMotion(rate, np.array([0.0, 1.01 * limit, 0.0]))
    assert joint_fit._excessive(excessive)
    assert not joint_fit._excessive(replace(excessive, higher_terms=np.ones((1, 3))))


def test_the_search_is_repeated_if_streak_ends_moved_far() -> None:
    camera, scene = _small_problem(), _small_scene()
    length = float(np.median(path_lengths(_SMALL, scene.motion, scene.stars)))
    for share, far in ((0.97, False), (1.03, True)):
        grown = scene.motion.rate * (1.0 + share * joint_fit._FAR / length)
        before = replace(scene, motion=CameraMotion.steady(2.0 * scene.motion.rate - grown))
        assert joint_fit._far(camera, before, scene) == far


def test_subtracted_stars_leave_noise_and_their_model_errors() -> None:
    """The frame without the stars has no streaks, and more noise at the positions of the stars."""
    camera, scene = _small_problem(), _small_scene()
    flat = np.full((100, 120), 100.0)
    windows = camera.windows(scene)
    light = np.zeros(12_000)
    light[windows.pixels] = light_of(_SMALL, Shutter(), scene, windows)
    lit = _small_problem(flat + light.reshape(100, 120))
    after = joint_fit._subtracted(lit, scene)
    near = light > 5.0
    assert np.abs(lit.frame.signal[near]).max() > 30.0
    assert np.abs(after.frame.signal[near]).max() < 3.0
    added = (joint_fit._SUBTRACTION_ERROR * light[near]) ** 2
    assert after.frame.floor[near] - lit.frame.floor[near] == pytest.approx(added, rel=1e-3, abs=1e-3)
    assert np.array_equal(after.frame.signal[light == 0.0], lit.frame.signal[light == 0.0])
    nobody = scene.select(np.zeros(3, dtype=np.bool_))
    assert joint_fit._subtracted(lit, nobody) is lit


def test_stars_are_subtracted_from_pixels_inside_the_frame() -> None:
    """The counts of both stars are subtracted from shared pixels; their squared model errors are added."""
    signal, floor = np.full(4, 100.0, np.float32), np.full(4, 9.0, np.float32)
    index, inside = np.array([[[1, 2]], [[2, 0]]]), np.array([[[True, True]], [[True, False]]])
    images, light = np.array([[[0.1, 0.2]], [[0.3, 0.4]]], np.float32), np.array([10.0, 100.0])
    arguments = signal, floor, (index, inside), images, light
    assert_forms_agree(joint_fit._subtract, *arguments, relative=1e-6, compiled=False)
    joint_fit._subtract(*arguments)
    assert signal == pytest.approx(np.array([100.0, 99.0, 68.0, 100.0]))
    error = joint_fit._SUBTRACTION_ERROR**2
    assert floor == pytest.approx(9.0 + error * np.array([0.0, 1.0, 904.0, 0.0]))


def test_the_brightest_stars_are_affordable_after_those_of_the_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera, scene = _small_problem(), _small_scene()
    scene = replace(scene, light=np.array([10.0, 20.0, 30.0]), trusted=np.array([True, False, False]))
    areas = window_areas(_SMALL, scene, camera.settings.reach)
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", float(areas[0] + areas[2]) * 1.001)
    assert joint_fit._affordable(camera, scene, 1.0).tolist() == [True, False, True]
    assert joint_fit._affordable(camera, scene, 0.99).tolist() == [True, False, False]
    assert joint_fit._affordable(camera, scene, 2.0).all()


def _along_a_row(*stars: tuple[float, float], width: float = 1.1) -> tuple[FitProblem, StreakScene]:
    """Return a frame of streaks of 70 px along row 50 without noise, and its stars (x, counts)."""
    column, across = np.arange(120.0), np.arange(100.0) - 50.0
    signal, motion = np.zeros((100, 120)), CameraMotion.steady(np.array([0.0, 0.1, 0.0]))
    for x, counts in stars:
        inside = np.clip(np.minimum(column + 0.5, x + 35.0) - np.maximum(column - 0.5, x - 35.0), 0.0, 1.0)
        profile = np.exp(-0.5 * (across / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
        signal += counts / 70.0 * profile[:, None] * inside
    camera = _small_problem()
    floor, nowhere = np.full(12_000, 16.0, dtype=np.float32), np.zeros(12_000, dtype=np.bool_)
    frame = replace(camera.frame, signal=signal.astype(np.float32).reshape(-1), floor=floor, bad=nowhere)
    places, n = np.array([[x, 50.0] for x, _ in stars]), len(stars)
    light = np.array([each for _, each in stars])
    scene = StreakScene(motion, width, places, light, np.zeros(n), np.ones(n, dtype=np.bool_))
    return replace(camera, frame=frame), scene


@pytest.mark.parametrize(
    ("light", "other", "last"),
    [
        (7000.0, 0.0, 1.0),
        (7000.0, 1.5, 1.0),  # the intensity decreases from 2.5 to 1.5 at the last end
        (7000.0, 20.0, np.nan),  # a much brighter streak hides the end
        (500.0, 0.0, np.nan),  # the streak is too faint
    ],
)
def test_an_end_is_confirmed_by_the_decrease_of_the_intensity(
    light: float, other: float, last: float
) -> None:
    """The streak of the second star begins at the centre of the first and continues beyond its end."""
    camera, scene = _along_a_row((60.0, light), (96.0, other * light))
    ends = joint_fit.true_ends(camera, scene)[0]
    # The motion is towards lower columns, so that the first end is at column 95.
    np.testing.assert_equal(ends[0], last)
    # With three quarters of the rotation, the streak continues beyond both ends.
    short = replace(scene, motion=CameraMotion.steady(0.75 * scene.motion.rate), light=0.75 * scene.light)
    assert not np.any(joint_fit.true_ends(camera, short)[0] == 1.0)


@pytest.mark.parametrize("width", [0.66, 1.04, 2.1])
def test_the_expected_intensity_is_that_of_the_central_pixels(width: float) -> None:
    camera, scene = _along_a_row((60.0, 7000.0), width=width)
    time = np.linspace(-0.3, 0.3, 31)[None]
    seen = joint_fit.brightness(camera, scene.motion, scene.stars, time)[0]
    assert joint_fit.expected_brightness(scene, np.array([70.0])) == pytest.approx(seen, rel=0.06)


def test_the_last_step_is_that_of_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """If only the width oscillates, even by several standard deviations, the motion counts as converged."""
    camera, scene = _taken(60.0, 300.0)
    done = iterate(camera, scene, camera.free, ROUGH)
    assert done is not None
    sign = [1.0]

    def oscillating(*arguments: Any) -> Solution | None:
        found = solve(*arguments)
        assert found is not None
        sign[0] = -sign[0]
        deviation = np.sqrt(np.diag(found.covariance))
        shared = moved[0] * deviation * camera.free
        shared[WIDTH] = sign[0] * 5.0 * deviation[WIDTH]
        return replace(found, shared=shared)

    monkeypatch.setattr(joint_fit, "solve", oscillating)
    for moved in ([0.5], [3.0]):
        again = iterate(camera, done.scene, camera.free, replace(ROUGH, tolerance=0.0))
        assert again is not None
        assert again.last_step == pytest.approx(moved[0])


def test_the_brightness_along_a_path_is_the_mean_of_three_rows_of_pixels() -> None:
    """A band of pixels in a linear image has the expected mean. Its error is that of the mean of samples."""
    row, column = np.mgrid[:100, :120]
    camera = _small_problem()
    frame = replace(
        camera.frame,
        signal=(2.0 * column + 3.0 * row).astype(np.float32).reshape(-1),
        floor=np.full(12_000, 16.0, dtype=np.float32),
        bad=np.zeros(12_000, dtype=np.bool_),
    )
    camera = replace(camera, frame=frame)
    motion = CameraMotion.steady(np.array([0.0, 0.05, 0.0]))
    stars, time = np.array([[60.0, 50.0], [10.0, 50.0]]), np.linspace(-0.4, 0.2, 11)
    mean, deviation = joint_fit.brightness(camera, motion, stars, np.tile(time, (2, 1)))
    place = paths(_SMALL, motion, np.tile(stars[:1], (11, 1)), time).position
    assert mean[0] == pytest.approx(np.mean(2.0 * place[:, 0] + 3.0 * 50.0), abs=1.0)
    assert deviation[0] == pytest.approx(np.sqrt(16.0 / 33.0))
    # The second path leaves the frame on more than 30 % of its length.
    assert place[0, 0] - place[-1, 0] == pytest.approx(0.6 * 35.0, rel=0.02)
    away = np.tile(np.linspace(0.0, 0.5, 10), (2, 1))
    assert np.isfinite(joint_fit.brightness(camera, motion, stars, 0.6 * away)[0]).all()
    assert np.isnan(joint_fit.brightness(camera, motion, stars, away)[0]).tolist() == [False, True]
    bad = frame.bad.copy().reshape(100, 120)
    bad[:, 64:] = True
    lost = replace(camera, frame=replace(frame, bad=bad.reshape(-1)))
    assert np.isnan(joint_fit.brightness(lost, motion, stars, np.tile(time, (2, 1)))[0]).tolist() == [
        True,
        False,
    ]
    path = paths(_SMALL, motion, np.repeat(stars, 11, axis=0), np.tile(time, 2))
    arguments = np.ascontiguousarray(path.position.T), np.ascontiguousarray(path.velocity.T)
    pixels = frame.signal, frame.floor, bad.reshape(-1)
    assert_forms_agree(
        joint_fit._band_means, *arguments, pixels, (120, 100), 11, relative=1e-5, compiled=False
    )


@pytest.mark.parametrize(
    ("fits", "stretches", "far", "exhausted", "expected"),
    [
        ([True], [False], [False], False, 1),
        ([True, True], [True, False], [False, False], False, 2),
        ([True, True], [False, False], [True, False], False, 2),
        ([True, True], [False, False], [True, True], False, 2),
        ([True, True], [True, True], [False, False], False, None),
        ([False], [False], [False], False, None),
        ([True], [True], [False], True, None),
    ],
)
def test_the_search_for_faint_stars_is_repeated_once(
    fits: list[bool],
    stretches: list[bool],
    far: list[bool],
    exhausted: bool,
    expected: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The search is repeated if streak ends are wrong or moved far; the fit fails if they remain wrong."""
    scene, made = _small_scene(), []

    def fitted(_: FitProblem, first: StreakFit) -> tuple[Any, str]:
        made.append(first)
        works = fits[len(made) - 1]
        return (replace(first, last_step=float(len(made))) if works else None), f"faint {len(made)}"

    monkeypatch.setattr(joint_fit, "_fit_from", fitted)
    monkeypatch.setattr(joint_fit, "stretched", lambda _, one: one if stretches[len(made) - 1] else None)
    monkeypatch.setattr(joint_fit, "_far", lambda *_: far[len(made) - 1])
    camera = _small_problem()
    if exhausted:
        camera.work.passed(10_000_000_000)
    windows = camera.windows(scene)
    evaluation = _evaluation(3, np.zeros((3, SHARED)))
    still = _solution([0.0] * 7, np.zeros((3, 4)))
    start = StreakFit(scene, scene, still, evaluation, 0.0, windows, camera.free)
    done, faint = joint_fit.final_fit(camera, start)
    assert (None if done is None else int(done.last_step)) == expected
    assert len(made) == len(fits)
    found: Any = faint
    assert found == f"faint {len(fits)}"
    if len(made) > 1:
        # The second search starts from the trusted stars, the brightest first.
        assert made[1].scene.light.tolist() == [4000.0, 3000.0]


def test_a_repeated_fit_includes_all_bright_stars(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[StreakScene] = []
    monkeypatch.setattr(joint_fit, "joint_fit", lambda _, scene: asked.append(scene))
    scene = replace(_small_scene(), trusted=np.array([False, False, True]))
    camera = _small_problem(most_stars=1)
    hidden = scene.select(np.array([0]))
    last: Any = SimpleNamespace(scene=scene, hidden=None)
    joint_fit.refit(camera, last)
    joint_fit.refit(camera, SimpleNamespace(**(vars(last) | {"hidden": hidden})))  # type: ignore[arg-type]  # a stand-in
    assert asked[0].trusted.tolist() == [True, False, True]
    assert asked[1].trusted.tolist() == [True, False, True, False]
    assert asked[1].light.tolist() == [4000.0, 3000.0, 2000.0, 4000.0]
