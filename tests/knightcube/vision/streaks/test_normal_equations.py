"""Tests of the normal equations against dense matrices, numerical derivatives and randomly drawn noise."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import normal_equations
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import FitWindows, cut_windows
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import Shutter, StreakScene
from knightcube.vision.streaks.normal_equations import (
    ALONE,
    PRIOR,
    SHARED,
    Evaluation,
    StarEquations,
    consistent_stars,
    eliminate,
    estimates_of,
    evaluate,
    rate_covariance,
    residuals,
    solve,
    star_equations,
)
from knightcube.vision.streaks.scene_images import light_of
from tests.support.compiled_forms import assert_forms_agree

_SIZE = SHARED + ALONE

_KEPT = np.array([0, 1, 2, 6])


def _random_evaluation(stars: int = 5) -> Evaluation:
    """Return normal equations of stars that share no pixels, from random derivatives of 40 pixels each."""
    rng = np.random.default_rng(11)
    change = rng.normal(size=(stars, 40, _SIZE)) * np.array(
        [9.0, 5.0, 3.0, 2.0, 4.0, 6.0, 1.5, 1.0, 2.0, 0.7, 3.0]
    )
    residual = rng.normal(size=(stars, 40, 1))
    information = change.swapaxes(1, 2) @ change
    gradient = (change.swapaxes(1, 2) @ residual)[..., 0]
    chi2, pixels = (residual**2).sum(axis=(1, 2)), np.full(stars, 40.0)
    return Evaluation(information, gradient, chi2, pixels, [], 0, [])


def _dense(evaluation: Evaluation) -> FloatArray:
    """Return the information matrix of all parameters, with the prior, of stars that share no pixels."""
    n = len(evaluation.chi2)
    whole = np.zeros((SHARED + n * ALONE, SHARED + n * ALONE))
    for star, information in enumerate(evaluation.information):
        places = np.append(np.arange(SHARED), SHARED + star * ALONE + np.arange(ALONE))
        whole[np.ix_(places, places)] += information
    whole[range(SHARED, len(whole)), range(SHARED, len(whole))] += np.tile(PRIOR, n)
    return whole


_FREE = np.array([True, True, True, False, False, False, True])


@pytest.mark.parametrize("free", [_FREE, np.ones(SHARED, dtype=np.bool_)])
def test_the_step_solves_the_equations_of_all_parameters(free: BoolArray) -> None:
    """The step and its covariance agree with the solution of dense equations for all stars.

    Parameters that are not fitted do not change. The prior of the sky level is centred on zero.
    """
    evaluation = _random_evaluation()
    n = len(evaluation.chi2)
    sky = np.array([0.5, -3.0, 2.0, 0.0, 1.0])
    motion = CameraMotion.steady(np.array([0.0, 0.1, 0.0]))
    scene = StreakScene(motion, 1.1, np.zeros((n, 2)), np.ones(n), sky, np.ones(n, dtype=np.bool_))
    kept = np.append(np.flatnonzero(free), SHARED + np.arange(n * ALONE))
    whole = _dense(evaluation)[np.ix_(kept, kept)]
    own = evaluation.gradient[:, SHARED:].copy()
    own[:, 3] -= PRIOR[3] * sky
    right = np.append(evaluation.gradient[:, :SHARED].sum(axis=0)[free], own)
    expected, covariance = np.linalg.solve(whole, right), np.linalg.inv(whole)
    fitted = np.count_nonzero(free)
    for rounds in (0, 5):
        found = solve(evaluation, scene, free, rounds)
        assert found is not None
        assert found.shared[free] == pytest.approx(expected[:fitted])
        assert not found.shared[~free].any()
        assert found.alone.reshape(-1) == pytest.approx(expected[fitted:])
    assert found is not None
    assert found.covariance[np.ix_(free, free)] == pytest.approx(covariance[:fitted, :fitted])
    assert not found.covariance[~free].any()
    for star, joint in enumerate(found.joint):
        places = np.append(np.arange(fitted), fitted + star * ALONE + np.arange(ALONE))
        both = np.append(np.flatnonzero(free), SHARED + np.arange(ALONE))
        assert joint[np.ix_(both, both)] == pytest.approx(covariance[np.ix_(places, places)], rel=1e-5)
    rate = rate_covariance(evaluation, found.eliminated, free, 3)
    assert rate == pytest.approx(covariance[:3, :3])
    each = evaluation.information, np.flatnonzero(free)
    assert_forms_agree(normal_equations._eliminated, *each, compiled=False)


def test_the_equations_of_a_star_are_those_without_its_own_parameters() -> None:
    evaluation = _random_evaluation()
    eliminated = eliminate(evaluation, _FREE)
    assert eliminated is not None
    found = star_equations(evaluation, eliminated)
    assert found.kept.tolist() == [0, 1, 2, 6]
    kept = np.append(np.flatnonzero(_FREE), SHARED + np.arange(ALONE))
    for star, (information, gradient) in enumerate(
        zip(evaluation.information, evaluation.gradient, strict=True)
    ):
        whole = information[np.ix_(kept, kept)] + np.diag(np.append(np.zeros(4), PRIOR))
        covariance = np.linalg.inv(whole)[:4, :4]
        assert np.linalg.inv(found.information[star]) == pytest.approx(covariance, rel=1e-5)
        step = np.linalg.solve(whole, gradient[kept])[:4]
        assert np.linalg.solve(found.information[star], found.score[star]) == pytest.approx(step, rel=1e-5)


def test_singular_equations_have_no_solution() -> None:
    """Parameters without information, or with information only on their sum, are not determined.

    A star without pixels leaves the equations of the other stars as they are, and its flux is unknown.
    """
    evaluation = _random_evaluation()
    dark = replace(evaluation, information=evaluation.information.copy())
    dark.information[:, 6] = dark.information[:, :, 6] = 0.0
    assert eliminate(dark, _FREE) is None
    equal = replace(evaluation, information=evaluation.information.copy())
    equal.information[:, 1] = equal.information[:, 0]
    equal.information[:, :, 1] = equal.information[:, :, 0]
    assert eliminate(equal, _FREE) is None
    empty = replace(evaluation, information=evaluation.information.copy())
    empty.information[2] = 0.0
    others = np.delete(empty.information, 2, axis=0)
    found, expected = eliminate(empty, _FREE), eliminate(replace(evaluation, information=others), _FREE)
    assert found is not None
    assert expected is not None
    assert found.inner == pytest.approx(expected.inner)
    assert not found.gain[2].any()
    # No flux that a camera can measure is significant.
    assert found.own[2, 2, 2] > 1e20
    assert found.own[2, 3, 3] == pytest.approx(1.0 / PRIOR[3])
    each = empty.information, np.flatnonzero(_FREE)
    assert_forms_agree(normal_equations._eliminated, *each, compiled=False)


_CAMERA = Pinhole(180, 150, 700.0)
_SHUTTER = Shutter(1e-4, 70.0)


def _crossing_scene(growing: bool) -> tuple[StreakScene, FitWindows]:
    """Return streaks that share pixels, two spots near the rotation axis, and the pixels of their windows.

    The fifth star does not contribute to the motion.
    """
    rate = np.array([0.015, -0.01, 0.5])
    motion = CameraMotion(rate, 0.3 * rate if growing else np.zeros(3))
    axis = _CAMERA.project(rate[None])[0]
    stars = axis + np.array(
        [[-70.0, 5.0], [-65.0, 17.0], [20.0, 60.0], [1.0, 2.0], [-72.0, -12.0], [4.0, -1.0]]
    )
    light = np.array([9000.0, 5000.0, 7000.0, 3000.0, 4000.0, 6000.0])
    trusted = np.array([True, True, True, True, False, True])
    scene = StreakScene(motion, 1.15, stars, light, np.array([1.0, -2.0, 0.5, 3.0, 0.0, 2.0]), trusted)
    noise = np.random.default_rng(1).normal(100.0, 4.0, (150, 180)).astype(np.uint16)
    frame = reduce_frame(noise, 65535.0, 2.0)
    return scene, cut_windows(frame, _CAMERA, _SHUTTER, scene, 4.0)


def _derivatives(scene: StreakScene, windows: FitWindows, growing: bool) -> FloatArray:
    """Return numerical derivatives of the counts on all fitted pixels with respect to all parameters."""
    n = len(scene.light)

    def counts(of: StreakScene) -> FloatArray:
        return light_of(_CAMERA, _SHUTTER, of, windows).astype(float)

    def moved(change: FloatArray, star: int) -> StreakScene:
        """Return the scene with one star changed, and the motion of only this star."""
        rate, acceleration = scene.motion.rate + change[:3], scene.motion.acceleration + change[3:6]
        stars, light = scene.stars.copy(), np.zeros(n)
        stars[star] += change[7:9]
        light[star] = scene.light[star] + change[9]
        motion = CameraMotion(rate, acceleration)
        return replace(scene, motion=motion, stars=stars, light=light, width=scene.width + change[6])

    out = np.zeros((len(windows.pixels), SHARED + n * ALONE))
    steps = np.array([3e-4] * 3 + [1e-3] * 3 + [0.02, 0.05, 0.05, 10.0])
    for star in range(n):
        for k, step in enumerate(steps):
            if (k < SHARED and not scene.trusted[star]) or (3 <= k < 6 and not growing):
                continue
            up, down = (counts(moved(way * step * np.eye(10)[k], star)) for way in (1.0, -1.0))
            place = k if k < SHARED else star * ALONE + k
            out[:, place] += (up - down) / (2.0 * step)
        for view, which in (
            (windows.on_strips, windows.long[windows.strips.star]),
            (windows.on_patches, windows.spot),
        ):
            slots = view.slot[which == star][view.inside[which == star]]
            out[slots, SHARED + star * ALONE + 3] = 1.0
    return out


def test_equations_without_some_stars_are_those_of_a_scene_that_rejects_them() -> None:
    scene, windows = _crossing_scene(growing=False)
    scene, rejected = replace(scene, trusted=np.ones(len(scene.light), dtype=np.bool_)), np.arange(6) == 3
    found = evaluate(_CAMERA, _SHUTTER, scene, windows, 0.0, growing=False).without(rejected)
    other = replace(scene, trusted=~rejected)
    expected = evaluate(_CAMERA, _SHUTTER, other, windows, 0.0, growing=False)
    one, two = solve(found, scene, _FREE, 20), solve(expected, other, _FREE, 20)
    assert one is not None
    assert two is not None
    np.testing.assert_allclose(one.shared, two.shared, rtol=1e-9)
    np.testing.assert_allclose(one.alone, two.alone, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.information, expected.information, rtol=1e-12)
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-12)


@pytest.mark.parametrize("growing", [False, True])
def test_the_information_is_that_of_numerical_derivatives(growing: bool) -> None:
    """Products of the coupled information matrix equal those of numerical derivatives of the model.

    The derivatives of the model have errors of a few per cent, and those by the acceleration of 20 %. These
    errors do not change the solution.
    """
    scene, windows = _crossing_scene(growing)
    assert len(windows.long) == 4
    assert windows.spot.tolist() == [3, 5]
    assert windows.shared > 50
    found = evaluate(_CAMERA, _SHUTTER, scene, windows, 0.0, growing)
    change = _derivatives(scene, windows, growing)
    m, n = len(windows.pixels), len(scene.light)
    total = light_of(_CAMERA, _SHUTTER, scene, windows) + change[:, SHARED + 3 :: ALONE] @ scene.sky
    first = np.unique(windows.slot, return_index=True)[1][:m]
    signal = np.concatenate([windows.on_strips.signal.reshape(-1), windows.on_patches.signal.reshape(-1)])[
        first
    ]
    floor = np.concatenate([windows.on_strips.floor.reshape(-1), windows.on_patches.floor.reshape(-1)])[first]
    good = np.zeros(m, dtype=np.bool_)
    for view in (windows.on_strips, windows.on_patches):
        good[view.slot[view.inside]] = True
    weight = good / (np.maximum(total, 0.0) / 2.0 + floor)
    whole = change.T @ (weight[:, None] * change)
    whole[range(SHARED, len(whole)), range(SHARED, len(whole))] += np.tile(PRIOR, n)
    free = np.ones(SHARED, dtype=np.bool_)
    free[3:6] = growing
    crowds = found.crowds[0], found.crowds[1]
    kept = np.append(np.flatnonzero(free), SHARED + np.arange(n * ALONE))
    columns = np.array(
        [
            normal_equations._product(found.information, crowds, windows.shared, free, unit)
            for unit in np.eye(len(whole))
        ]
    )[np.ix_(kept, kept)]
    expected = whole[np.ix_(kept, kept)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    allowed = np.where(np.isin(kept, [3, 4, 5]), 0.25, 0.03)
    assert np.all(np.abs(columns - expected) < scale * np.maximum(allowed, allowed[:, None]))
    gradient = change.T @ (weight * (signal - total))
    own = np.concatenate([found.gradient[:, :SHARED].sum(axis=0), found.gradient[:, SHARED:].reshape(-1)])
    assert np.all(np.abs(own - gradient)[kept] < (1.0 + 20.0 * allowed) * np.sqrt(np.diag(expected)))
    lit = np.flatnonzero(change[:, SHARED + 3] > 0.0)
    squares = weight * (signal - total) ** 2
    assert found.chi2[0] == pytest.approx(squares[lit].sum(), rel=1e-3)
    assert found.pixels[0] == np.count_nonzero(good[lit])
    # Conjugate gradients solve the coupled equations.
    eliminated = eliminate(found, free)
    assert eliminated is not None
    right = np.where(np.isin(np.arange(len(whole)), kept), np.sqrt(np.diag(whole)), 0.0)
    arguments = found.information, crowds, windows.shared, eliminated, free, right, 60
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(normal_equations, "_CONVERGED", 1e-12)
        for rounds in (0, 2):
            assert_forms_agree(
                normal_equations.solution, *arguments[:-1], rounds, relative=1e-4, compiled=False
            )
        step = normal_equations.solution(*arguments)
        assert columns @ step[kept] == pytest.approx(right[kept], rel=1e-3, abs=1e-3 * np.abs(right).max())


def test_the_loops_sum_the_same_products_as_numpy() -> None:
    """Loops and numpy add the same products; pixels are excluded by mask, saturation and residual."""
    rng = np.random.default_rng(4)
    star, count, size = np.array([0, 0, 2]), 4, 6
    images = rng.normal(size=(3, count, size)).astype(np.float32)
    matrix = rng.normal(size=(3, count - 1, _SIZE))
    total = np.append(rng.uniform(20.0, 80.0, 12), 0.0).astype(np.float32)
    slot = rng.integers(0, 12, (3, size))
    inside = rng.uniform(size=(3, size)) > 0.2
    inside[0, 0] = inside[0, 1] = inside[0, 2] = True
    signal = (total[slot] + rng.normal(0.0, 3.0, (3, size))).astype(np.float32)
    signal[0, 0] += 500.0
    floor = rng.uniform(4.0, 9.0, (3, size)).astype(np.float32)
    ceiling = np.full((3, size), 500.0, dtype=np.float32)
    ceiling[0, 1] = total[slot[0, 1]] + 1.0
    sums = np.zeros((3, _SIZE, _SIZE)), np.zeros((3, _SIZE)), np.zeros(3), np.zeros(3)
    for clip in (0.0, 5.0):
        arguments = (
            *sums,
            np.empty((3, size), dtype=np.float32),
            images,
            (star, matrix),
            total,
            (slot, inside, signal, floor, ceiling),
            (2.0, clip),
        )
        assert_forms_agree(normal_equations._sum_products, *arguments, relative=1e-4, compiled=False)
        own = copy.deepcopy(arguments)
        normal_equations._sum_products.numpy_form(*own)
        information, gradient, chi2, pixels, weight = own[:5]
        assert (weight[0, 0] > 0.0) == (clip == 0.0)
        assert weight[0, 1] == 0.0
        good = inside & (weight > 0.0)
        variance = total[slot] / 2.0 + floor
        assert weight[good] == pytest.approx(1.0 / variance[good], rel=1e-5)
        residual = np.where(good, signal - total[slot], 0.0)
        for owner in range(3):
            whole = np.zeros((_SIZE, _SIZE))
            slope = np.zeros(_SIZE)
            for b in np.flatnonzero(star == owner):
                change = matrix[b].T @ images[b, :-1]
                whole += (change * weight[b]) @ change.T
                slope += (change * weight[b]) @ residual[b]
            assert information[owner] == pytest.approx(whole, rel=1e-4, abs=1e-4)
            assert gradient[owner] == pytest.approx(slope, rel=1e-4, abs=1e-4)
            assert chi2[owner] == pytest.approx((weight * residual**2)[star == owner].sum(), rel=1e-4)
            assert pixels[owner] == np.count_nonzero(good[star == owner])


def _weighted(
    model: float, signal: float, ceiling: float, clip: float, inside: bool = True
) -> tuple[float, float]:
    """Return weight and residual of one pixel with the gain 4 electrons/count and the noise variance 7."""
    signals, floors, ceilings = (np.array([each], dtype=np.float32) for each in (signal, 7.0, ceiling))
    pixels = np.array([1]), np.array([inside]), signals, floors, ceilings
    total = np.array([-99.0, model, -99.0], dtype=np.float32)
    weight, residual = residuals(total, pixels, (4.0, clip))
    return float(weight[0]), float(residual[0])


def test_pixels_are_weighted_by_the_variance_of_the_model() -> None:
    """The variance is that of the noise without stars plus that of the modelled photons.

    With 36 counts at 4 electrons per count, it is 7 + 9 = 16, so that the standard deviation is 4 counts.
    """
    assert _weighted(36.0, 31.0, 1e4, 0.0) == pytest.approx((1.0 / 16.0, -5.0))
    assert _weighted(-20.0, 3.0, 1e4, 0.0) == pytest.approx((1.0 / 7.0, 23.0))
    assert _weighted(36.0, 31.0, 1e4, 0.0, inside=False) == (0.0, 0.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_outliers_and_pixels_near_saturation_have_no_weight(sign: float) -> None:
    limit = 3.0 * 4.0 + normal_equations._UNRESOLVED * 36.0
    assert _weighted(36.0, 36.0 + sign * (limit - 0.1), 1e4, 3.0)[0] > 0.0
    assert _weighted(36.0, 36.0 + sign * (limit + 0.1), 1e4, 3.0) == (0.0, 0.0)
    assert _weighted(36.0, 36.0 + sign * 1000.0, 1e4, 0.0) == pytest.approx((1.0 / 16.0, sign * 1000.0))
    room = normal_equations.SATURATION_MARGIN * 4.0
    assert _weighted(36.0, 36.0, 36.0 + room + 0.1, 3.0)[0] > 0.0
    assert _weighted(36.0, 36.0, 36.0 + room - 0.1, 3.0)[0] == 0.0


def test_each_star_estimates_the_rate_along_and_across_the_axis_and_the_width() -> None:
    information = np.zeros((3, 4, 4))
    information[0] = np.diag([25.0, 16.0, 16.0, 4.0])
    information[1] = np.diag([100.0, 9.0, 9.0, 1.0])
    score = np.array([[5.0, 4.8, 6.4, -2.0], [-30.0, 0.0, 9.0, 3.0], [0.0, 0.0, 0.0, 0.0]])
    motion = CameraMotion.steady(np.array([0.2, 0.0, 0.0]))
    scene = StreakScene(motion, 1.0, np.zeros((3, 2)), np.ones(3), np.zeros(3), np.ones(3, dtype=np.bool_))
    change, deviation = estimates_of(StarEquations(_KEPT, information, score), scene)
    assert change[:, 0] == pytest.approx([0.2, -0.3, 0.0])
    assert np.hypot(change[:, 1], change[:, 2]) == pytest.approx([0.5, 1.0, 0.0])
    assert change[:, 3] == pytest.approx([-0.5, 3.0, 0.0])
    assert deviation[:2] == pytest.approx(np.array([[0.2, 0.25, 0.25, 0.5], [0.1, 1 / 3, 1 / 3, 1.0]]))
    assert np.all(deviation[2] > 1e4 * deviation[:2].max(axis=0) / 2.0)


def test_stars_far_from_the_weighted_median_disagree() -> None:
    """The limit contains the errors of the star and of the median, and the model error.

    The median of n normal values has an error of 1.25 sigma/sqrt(n).
    """
    deviations, floors = np.full((25, 2), 0.3), np.array([0.4, 0.0])
    limits = 3.0 * np.array([0.5, 0.3]) * np.hypot(1.0, 1.25 / 5.0)
    for column in (0, 1):
        for sign in (-1.0, 1.0):
            for share, agrees in ((0.99, True), (1.01, False)):
                estimates = np.full((25, 2), 7.0)
                estimates[4, column] += sign * share * limits[column]
                found = consistent_stars(estimates, deviations, floors, 3.0)
                assert found[4] == agrees
                assert found.sum() == (25 if agrees else 24)


def test_the_median_of_the_stars_is_weighted_by_their_accuracy() -> None:
    """Two accurate stars outweigh three inaccurate stars, which then disagree with the median."""
    estimates = np.array([[5.0], [5.1], [5.2], [1.0], [1.02]])
    deviations = np.array([[0.9], [0.9], [0.9], [0.1], [0.1]])
    found = consistent_stars(estimates, deviations, np.zeros(1), 3.0)
    assert found.tolist() == [False, False, False, True, True]
