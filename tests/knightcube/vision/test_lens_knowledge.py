"""Tests of the lens estimate from solved frames: accuracy, covariance, a changed lens, and its use.

Star positions are computed with the true lens by `Lens.project`, not with the equations under test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision import lens_knowledge
from knightcube.vision.camera.lens import CameraKnowledge, Lens, Pinhole
from knightcube.vision.frame_job import FrameFound, FrameJob, TrackerSettings
from knightcube.vision.lens_knowledge import (
    CalibrationError,
    LensFit,
    LensKnowledge,
    MatchedFrame,
    axes_turn,
    parameters_of,
)
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    SolveStatus,
)
from knightcube.vision.startracker.survey import FrameKind
from knightcube.vision.streaks.streak_result import (
    FrameMotion,
    LikelihoodSettings,
    MotionResult,
    StreakStatus,
)

DESCRIBED = Pinhole(640, 480, 1800.0)
KNOWN = CameraKnowledge(centre=3.0, distortion=0.006)
NOISE = 0.05


@dataclass(frozen=True)
class TrueCamera:
    """A lens, and the line time (s) of its shutter."""

    lens: Lens
    line_time: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator, focal: float = 0.0) -> TrueCamera:
        square = (np.hypot(*DESCRIBED.centre) / DESCRIBED.focal_length) ** 2
        centre = np.array(DESCRIBED.centre) + rng.normal(0.0, KNOWN.centre, 2)
        k1 = rng.normal(0.0, KNOWN.distortion) / square
        length = DESCRIBED.focal_length * (1.0 + focal)
        return cls(Lens(640, 480, length, (centre[0], centre[1]), k1), abs(rng.normal(0.0, 20e-6)))

    def values(self) -> FloatArray:
        return np.array(
            [self.lens.focal_length, *self.lens.centre, self.lens.k1, self.lens.k2, self.line_time]
        )


def frame_of(
    camera: TrueCamera,
    known: LensKnowledge,
    rng: np.random.Generator,
    stars: int = 25,
    wrong: int = 0,
    status: StreakStatus = StreakStatus.RATE,
) -> tuple[FrameSolution, SkyIndex]:
    """Return a frame of streaks in a random field, solved with the shutter of `known`, and its stars."""
    true = normalise(rng.normal(size=4))
    pixels = rng.uniform([0.0, 0.0], [639.0, 479.0], (stars, 2))
    directions = camera.lens.unit_vectors(pixels) @ attitude_matrix(true)
    velocity = rng.uniform(-600.0, 600.0, 2)
    assumed, sigma = known.shutter
    row = (pixels[:, 1:] - 239.5) * velocity
    points = pixels + row * (camera.line_time - assumed) + rng.normal(0.0, NOISE, pixels.shape)
    points[:wrong] += 15.0
    start = multiply(from_rotation_vector(rng.normal(0.0, 1e-4, 3)), true)
    motion = MotionResult(status, 0, 0.2, line_time_sigma=sigma, psf_sigma=1.3)
    solution = FrameSolution(
        SolveStatus.SOLVED,
        "",
        FrameKind.STREAKS,
        known.camera,
        points,
        np.tile(NOISE**2 * np.eye(2), (stars, 1, 1)),
        row * sigma if sigma else np.empty((0, 2)),
        np.arange(stars),
        fix=AttitudeFix(start, 1e-8 * np.eye(3), 0.0),
        motion=motion,
        psf_sigma=1.3,
    )
    return solution, cast(SkyIndex, SimpleNamespace(stars=SimpleNamespace(direction=directions)))


def learned(camera: TrueCamera, known: LensKnowledge, rng: np.random.Generator, frames: int) -> LensKnowledge:
    for _ in range(frames):
        known = known.update(*frame_of(camera, known, rng), elapsed=5.0)
    return known


def nees(known: LensKnowledge, camera: TrueCamera) -> float:
    values, covariance = known.learned
    unit = np.sqrt(np.diag(covariance))[:6]
    error = (values[:6] - camera.values()) / unit
    return float(error @ np.linalg.solve(covariance[:6, :6] / np.outer(unit, unit), error))


@pytest.mark.parametrize("scale_error", [0.0, 0.05])
def test_ten_frames_shrink_an_honest_covariance_of_the_lens(scale_error: float) -> None:
    """Ten frames reduce the covariance of the lens, which agrees with the errors.

    The normalised squared error has six degrees of freedom, or five with an exact focal length.
    """
    found, sigmas = [], []
    for seed in range(5):
        rng = np.random.default_rng((31, seed))
        camera = TrueCamera.drawn(rng, rng.uniform(-scale_error, scale_error))
        known = learned(camera, LensKnowledge.of(DESCRIBED, KNOWN, scale_error=scale_error), rng, 10)
        assert known.usable
        assert known.contradictions == 0
        found.append(nees(known, camera))
        sigmas.append(known.sigma / known.spread)
    # The mean of five chi-squares with 5 or 6 degrees of freedom has a standard deviation of at most 1.6.
    assert 1.5 < np.mean(found) < 10.5
    # A shift d of the optical axis displaces a star at a corner, 400 px from the axis, by only 0.05 d. With
    # 250 stars of 0.05 px, the error of the axis is at least 0.06 px, and some tenths of a pixel if the
    # distortion is unknown.
    shrunk = np.median(sigmas, axis=0)
    assert np.all(shrunk[[1, 2]] < 0.25)
    assert shrunk[9] < 0.01


def test_a_changed_lens_is_noticed_by_the_next_frame_and_learned_again() -> None:
    rng = np.random.default_rng(41)
    first = TrueCamera.drawn(rng)
    known = learned(first, LensKnowledge.of(DESCRIBED, KNOWN), rng, 10)
    centre = first.lens.centre
    after = TrueCamera(Lens(640, 480, 1800.0, (centre[0] + 4.0, centre[1]), first.lens.k1 + 0.08), 1e-6)
    noticed = known.update(*frame_of(after, known, rng), elapsed=5.0)
    assert noticed.contradictions == 1
    assert not noticed.usable
    assert np.allclose(noticed.sigma, noticed.spread)
    again = learned(after, noticed, rng, 10)
    assert again.contradictions == 1
    assert nees(again, after) < 20.0 < nees(again, first)


def test_an_unchanged_lens_is_not_contradicted() -> None:
    rng = np.random.default_rng(51)
    camera = TrueCamera.drawn(rng)
    known = learned(camera, LensKnowledge.of(DESCRIBED, KNOWN), rng, 30)
    assert known.contradictions == 0
    assert known.frames == 30


def test_wrong_matches_do_not_move_the_lens() -> None:
    rng = np.random.default_rng(61)
    camera = TrueCamera.drawn(rng)
    known = LensKnowledge.of(DESCRIBED, KNOWN)
    for _ in range(8):
        known = known.update(*frame_of(camera, known, rng, wrong=3))
    assert known.frames == 8
    assert nees(known, camera) < 20.0


def test_stars_that_scatter_beyond_their_claimed_errors_teach_no_more_than_the_scatter_permits() -> None:
    claims = []
    for share in (1.0, 0.1):
        rng = np.random.default_rng(62)
        camera = TrueCamera.drawn(rng)
        known = LensKnowledge.of(DESCRIBED, KNOWN)
        for _ in range(3):
            frame, sky = frame_of(camera, known, rng)
            known = known.update(replace(frame, covariance=share * frame.covariance), sky)
        assert known.frames == 3
        assert nees(known, camera) < 20.0
        claims.append(np.sqrt(known.learned[1].diagonal()[:4]))
    assert np.all(claims[1] > 0.7 * claims[0])


def test_frames_that_cannot_teach_change_nothing() -> None:
    rng = np.random.default_rng(71)
    camera, known = TrueCamera.drawn(rng), LensKnowledge.of(DESCRIBED, KNOWN)
    assert known.update(*frame_of(camera, known, rng, stars=5)) is known
    # If the direction of the rotation is unknown, the effect of an unknown line time has an unknown sign.
    ambiguous = frame_of(camera, known, rng, status=StreakStatus.AMBIGUOUS)
    assert known.update(*ambiguous) is known


def test_a_line_time_that_is_zero_within_its_error_is_fitted_as_a_global_shutter() -> None:
    rng = np.random.default_rng(81)
    still = TrueCamera(TrueCamera.drawn(rng).lens)
    known = learned(still, LensKnowledge.of(DESCRIBED, KNOWN), rng, 10)
    time, sigma = known.shutter
    assert time == 0.0
    assert abs(known.values[9]) <= sigma < 5e-7
    rolling = TrueCamera(still.lens, 2.5e-5)
    time, sigma = learned(rolling, LensKnowledge.of(DESCRIBED, KNOWN), rng, 10).shutter
    assert abs(time - 2.5e-5) < 4.0 * sigma < 2e-6


def test_the_width_of_the_point_spread_is_learned() -> None:
    rng = np.random.default_rng(91)
    known = learned(TrueCamera.drawn(rng), LensKnowledge.of(DESCRIBED, KNOWN), rng, 10)
    assert known.psf_sigma == pytest.approx(1.3, abs=0.03)


def test_stored_values_start_the_next_boot_unless_they_are_implausible() -> None:
    rng = np.random.default_rng(101)
    camera, begun = TrueCamera.drawn(rng), LensKnowledge.of(DESCRIBED, KNOWN)
    known = learned(camera, begun, rng, 10)
    after = begun.restored(*known.learned, 0.1)
    assert after is not None
    assert after.usable
    assert np.array_equal(after.learned[0], known.learned[0])
    expected = np.hypot(known.sigma[1], 0.1 * begun.spread[1])
    assert after.sigma[1] == pytest.approx(expected)
    values, covariance = known.learned
    assert begun.restored(values + np.array([0.0, 30.0, 0.0, 0.0, 0.0, 0.0, 0.0]), covariance, 0.1) is None
    assert begun.restored(values[:6], covariance[:6, :6], 0.1) is None


def test_the_accuracy_of_the_lens_contains_the_scatter_of_the_corner() -> None:
    """The stated accuracy of the distortion equals the scatter of an image corner for random lenses.

    The accuracy of the distortion is the relative error of the distance of an image corner from the optical
    axis.
    """
    rng = np.random.default_rng(111)
    known: Any = learned(TrueCamera.drawn(rng), LensKnowledge.of(DESCRIBED, KNOWN, scale_error=0.02), rng, 5)
    values, covariance = known.learned
    unit = np.sqrt(np.diag(covariance))
    root = unit[:, None] * np.linalg.cholesky(covariance / np.outer(unit, unit))
    drawn = values + (root @ rng.normal(size=(7, 2000))).T
    tangent = np.hypot(*DESCRIBED.centre) / values[0]
    radius = drawn[:, 0] * tangent * (1.0 + drawn[:, 3] * tangent**2 + drawn[:, 4] * tangent**4)
    assert known.accuracy.distortion == pytest.approx(np.std(radius) / np.mean(radius), rel=0.1)
    assert known.accuracy.psf_sigma == unit[6]


def test_the_configured_axis_shows_the_same_direction_through_the_learned_lens() -> None:
    lens = Lens(640, 480, 1790.0, (323.5, 234.0), -0.2)
    turn = axes_turn(DESCRIBED, lens)
    shown = lens.unit_vectors(np.array([DESCRIBED.centre]))[0]
    assert np.allclose(attitude_matrix(turn) @ [0.0, 0.0, 1.0], shown, atol=1e-12)
    assert abs(turn[2]) < 1e-15, "no rotation about the boresight"
    # Both stars are near the axis, where the estimated lens changes directions only by its scale.
    pixels = np.array(DESCRIBED.centre) + np.array([[40.0, 0.0], [0.0, -40.0]])
    there = lens.unit_vectors(pixels) @ attitude_matrix(turn)
    assert np.allclose(there[:, :2] / there[:, 2:], (pixels - DESCRIBED.centre) / 1790.0, atol=2e-5)


def test_rate_and_attitude_of_a_frame_are_in_the_axes_of_the_configured_lens() -> None:
    """Rate and attitude of a frame are in the axes of the configured lens.

    A star at the configured optical axis has the same direction in the body as without an estimated lens.
    """
    rng = np.random.default_rng(121)
    camera = TrueCamera(Lens(640, 480, 1800.0, (324.0, 236.0)))
    known = learned(camera, LensKnowledge.of(DESCRIBED, KNOWN), rng, 12)
    true, rate = normalise(rng.normal(size=4)), np.array([0.01, -0.02, 0.005])
    star = camera.lens.unit_vectors(np.array([DESCRIBED.centre]))[0] @ attitude_matrix(true)
    found = FrameFound(
        FrameMotion(StreakStatus.RATE, 1, 0.2, rate=rate, covariance=np.diag([1e-10, 2e-10, 9e-10])),
        FrameSolution(
            SolveStatus.SOLVED, "", FrameKind.STREAKS, known.camera, fix=AttitudeFix(true, np.eye(3), 0.0)
        ),
        turn=known.turn,
    ).in_configured_axes()
    assert found.solution is not None
    assert found.solution.fix is not None
    seen = attitude_matrix(found.solution.fix.quaternion) @ star
    # The optical axis, estimated to a fraction of a pixel, is 5.7 px from its configured position.
    assert np.allclose(seen, [0.0, 0.0, 1.0], atol=1.5 / 1800.0)
    assert found.motion.rate is not None
    turned = attitude_matrix(found.solution.fix.quaternion) @ attitude_matrix(true).T @ rate
    assert np.allclose(found.motion.rate, turned)


def test_the_priors_of_a_frame_are_in_the_axes_of_the_configured_lens() -> None:
    rng = np.random.default_rng(131)
    known = learned(TrueCamera.drawn(rng), LensKnowledge.of(DESCRIBED, KNOWN), rng, 10)
    attitude, rate = (
        AttitudePrior(normalise(rng.normal(size=4)), 1e-3),
        RatePrior(np.array([0.1, 0.2, 0.3]), 1e-3),
    )
    job = FrameJob(
        np.zeros((480, 640)),
        DESCRIBED,
        0.2,
        LikelihoodSettings(),
        TrackerSettings(SolveSettings(), (0.9, 1.1)),
        rate,
        attitude,
        lens=(known, 5.0),
    )
    through = job.with_lens()
    assert through.attitude_prior is not None
    assert through.rate_prior is not None
    turn = attitude_matrix(known.turn)
    assert np.allclose(
        attitude_matrix(through.attitude_prior.quaternion), turn @ attitude_matrix(attitude.quaternion)
    )
    assert np.allclose(through.rate_prior.rate, turn @ rate.rate)
    assert through.tracker is not None
    assert through.tracker.scale == (1.0, 1.0)
    assert through.camera == known.camera
    assert replace(job, lens=(LensKnowledge.of(DESCRIBED, KNOWN), 0.0)).with_lens().camera is DESCRIBED


@pytest.mark.parametrize(("estimated", "used"), [(0.1, 0.3), (1.2, 1.2), (7.0, 6.0)])
def test_an_extreme_estimated_width_of_the_stars_is_limited_for_the_detection(
    estimated: float, used: float
) -> None:
    """Otherwise no frame of a very sharp camera would be processed any more."""
    rng = np.random.default_rng(131)
    known = learned(TrueCamera.drawn(rng), LensKnowledge.of(DESCRIBED, KNOWN), rng, 10)
    known = replace(known, values=np.array([*known.values[:-1], estimated]))
    assert known.psf_sigma == estimated
    tracker = TrackerSettings(SolveSettings(), (0.9, 1.1))
    job = FrameJob(np.zeros((480, 640)), DESCRIBED, 0.2, LikelihoodSettings(), tracker, None, None)
    through = replace(job, lens=(known, 5.0)).with_lens()
    assert through.tracker is not None
    assert through.tracker.solve.detection.psf_sigma == used


def _matched(lens: Lens, count: int, seed: int, late: bool) -> tuple[MatchedFrame, FloatArray]:
    """Return stars with correlated position errors, and the attitude of their frame."""
    rng = np.random.default_rng(seed)
    attitude = normalise(rng.normal(size=4))
    seen = lens.unit_vectors(rng.uniform([20.0, 20.0], [620.0, 460.0], (count, 2)))
    root = rng.normal(size=(count, 2, 2)) * 0.1 + 0.3 * np.eye(2)
    covariance = root @ root.swapaxes(1, 2)
    points = lens.project(seen) + np.einsum("nij,nj->ni", root, rng.normal(size=(count, 2)))
    sigma = np.sqrt(0.5 * np.trace(covariance, axis1=1, axis2=2))
    by_line = 1e5 * rng.normal(size=(count, 2)) if late else None
    return MatchedFrame(points, sigma, seen @ attitude_matrix(attitude), covariance, by_line), attitude


@pytest.mark.parametrize("late", [False, True])
def test_a_step_of_the_calibration_solves_the_equations_of_lens_and_attitudes(late: bool) -> None:
    """The step solves dense equations with numerical derivatives by all lens parameters and rotations.

    The information about the lens is that after elimination of the rotations.
    """
    lens = Lens(640, 480, 1800.0, (321.0, 238.0), 0.03, -0.01, 0.002, -0.001, 0.0005, -0.0003)
    frames, attitudes = zip(
        *(_matched(lens, count, seed, late) for seed, count in enumerate((14, 9))), strict=True
    )
    start = parameters_of(lens) + np.array([2.0, 1.0, -1.0, 0.01, 0.02, 1e-3, 1e-3, 1e-4, 2e-4])
    start = np.append(start, 1e-6) if late else start
    fit = LensFit(start, np.array(attitudes))
    rng = np.random.default_rng(5)
    weights = [rng.uniform(0.2, 1.0, len(frame.points)) for frame in frames]
    steps = np.array([1e-2, 1e-3, 1e-3, 1e-5, 1e-4, 1e-6, 1e-6, 1e-6, 1e-6, 1e-9])[: len(start)]
    count = len(start)

    def missed(change: FloatArray) -> FloatArray:
        turned = [
            multiply(from_rotation_vector(change[count + 3 * k : count + 3 * k + 3]), attitude)
            for k, attitude in enumerate(attitudes)
        ]
        moved = LensFit(start + change[:count], np.array(turned))
        parts = [
            np.sqrt(weight)[:, None] * lens_knowledge.residuals(frame, moved, k)
            for k, (frame, weight) in enumerate(zip(frames, weights, strict=True))
        ]
        return np.concatenate(parts).reshape(-1)

    every = np.append(steps, np.full(6, 1e-6))
    design = -np.stack([(missed(d) - missed(-d)) / (2.0 * d.sum()) for d in np.diag(every)], axis=1)
    prior = 1.0 / (np.array([5.0, 3.0, 3.0, 0.02, 0.05, 1e-3, 1e-3, 1e-3, 1e-3, 1e-5])[:count]) ** 2
    expected = start + 0.3 * np.array([5.0, 3.0, 3.0, 0.02, 0.05, 1e-3, 1e-3, 1e-3, 1e-3, 1e-5])[:count]
    normal, gradient = design.T @ design, design.T @ missed(np.zeros(count + 6))
    own, cross = normal[count:, count:], normal[count:, :count]
    information = normal[:count, :count] - cross.T @ np.linalg.solve(own, cross)
    normal[range(count), range(count)] += prior
    gradient[:count] += prior * (expected - start)
    solved = np.linalg.solve(normal, gradient)
    found = lens_knowledge.step(frames, fit, weights, prior, expected)
    scale = np.sqrt(np.outer(np.diag(information), np.diag(information)))
    assert found.information / scale == pytest.approx(information / scale, abs=1e-4)
    assert found.fit.parameters - start == pytest.approx(solved[:count], rel=1e-3, abs=1e-9)
    for k, attitude in enumerate(attitudes):
        turned = multiply(from_rotation_vector(solved[count + 3 * k : count + 3 * k + 3]), attitude)
        matrix = attitude_matrix(found.fit.attitudes[k]) @ attitude_matrix(turned).T
        assert matrix == pytest.approx(np.eye(3), abs=1e-6)
    assert found.decrease == pytest.approx(float(gradient @ solved), rel=1e-3)
    dense = lens_knowledge.step(frames, fit, weights, np.diag(prior), expected)
    assert dense.fit.parameters == pytest.approx(found.fit.parameters)


def test_frames_that_do_not_determine_the_lens_are_refused() -> None:
    lens = Lens(640, 480, 1800.0, (321.0, 238.0))
    frame, attitude = _matched(lens, 12, 3, False)
    fit = LensFit(parameters_of(lens), attitude[None])
    nothing = np.zeros(9)
    few = frame.select(np.arange(12) < 5)
    with pytest.raises(CalibrationError, match="do not separate"):
        lens_knowledge.step([few], fit, [np.ones(5)], nothing, fit.parameters)
    one = frame.select(np.arange(12) < 1)
    with pytest.raises(CalibrationError, match="frame 0: its matches do not determine its attitude"):
        lens_knowledge.step([one], fit, [np.ones(1)], np.ones(9), fit.parameters)


def test_wrong_matches_get_small_weights_and_are_not_accepted() -> None:
    """The spread is the median length of the residuals, relative to that of normal errors, and at least 1.

    The median length of two-dimensional normal errors is sqrt(2 ln 2).
    """
    median = np.sqrt(2.0 * np.log(2.0))
    lengths = [np.array([0.1, 0.2, 3.0 * median]), np.array([3.0 * median, 40.0, 50.0])]
    assert lens_knowledge.residual_spread(lengths) == pytest.approx(3.0)
    assert lens_knowledge.residual_spread([np.array([0.1, 0.2, 9.0])]) == 1.0
    scale = 3.0 * lens_knowledge._CAUCHY
    for weight, length in zip(lens_knowledge.cauchy_weights(lengths), lengths, strict=True):
        assert weight == pytest.approx(scale**2 / (scale**2 + length**2))
    limit = 3.0 * lens_knowledge._CUT
    close = [np.array([0.999 * limit, 3.0 * median, 3.0 * median]), np.array([1.001 * limit, 0.1])]
    assert lens_knowledge.residual_spread(close) == pytest.approx(3.0)
    assert [mask.tolist() for mask in lens_knowledge.accepted_matches(close)] == [
        [True, True, True],
        [False, True],
    ]
    with pytest.raises(CalibrationError, match="behind the camera"):
        lens_knowledge.residual_spread([np.array([1.0, np.inf, np.inf])])


def test_stars_beside_the_camera_have_infinite_residuals() -> None:
    lens = Lens(640, 480, 1800.0, (321.0, 238.0), 0.02)
    frame, attitude = _matched(lens, 4, 6, True)
    fit = LensFit(np.append(parameters_of(lens), 0.0), attitude[None])
    usual = lens_knowledge.residuals(frame, fit, 0)
    assert usual == pytest.approx(
        frame.weighted(frame.points - lens.project(frame.directions @ attitude_matrix(attitude).T))
    )
    behind = replace(frame, directions=frame.directions * np.array([[1.0], [-1.0], [1.0], [1.0]]))
    found = lens_knowledge.residuals(behind, fit, 0)
    assert np.isinf(found[1]).all()
    assert found[[0, 2, 3]] == pytest.approx(usual[[0, 2, 3]])
    assert frame.late is not None
    late = LensFit(np.append(parameters_of(lens), 2e-6), attitude[None])
    assert lens_knowledge.residuals(frame, late, 0) == pytest.approx(
        usual - frame.weighted(2e-6 * frame.late)
    )
