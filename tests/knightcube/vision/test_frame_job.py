"""Tests of the job of the image-processing worker, which must never return a wrong rate or attitude."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.bodies.streak_methods import CornerEstimator
from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.reference.corner_streaks import StreakResult, StreakSettings
from knightcube.vision import frame_job
from knightcube.vision.camera.lens import CameraModel, Lens, Pinhole
from knightcube.vision.frame import Bins
from knightcube.vision.frame_job import (
    FrameFound,
    FrameJob,
    StreakEstimator,
    TrackerSettings,
    in_whole_image,
    run,
)
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    SolveStatus,
    solve_motion,
)
from knightcube.vision.startracker.survey import DetectionSettings, FrameKind
from knightcube.vision.startracker.tracking import PRIOR_SIGMAS
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from tests.flight.loop.passing import passed
from tests.knightcube.vision.startracker.frames import EPOCH, NARROW, SkyFrame, sky, sky_frame

_TRACKER = TrackerSettings(SolveSettings(), (1.0, 1.0))
_ESTIMATORS: list[LikelihoodSettings | StreakEstimator] = [
    LikelihoodSettings(saturation=65_535),
    CornerEstimator(StreakSettings()),
]
# Angle (rad) of a rotation about the boresight that moves the corner of the frame by one pixel.
_RIGHT = 1.0 / NARROW.pinhole.half_diagonal / NARROW.pinhole.focal_length


@cache
def _frame(streak_px: float) -> SkyFrame:
    return sky_frame(np.random.default_rng(41), streak_px, 0.5)


def _job(frame: SkyFrame, estimator: LikelihoodSettings | StreakEstimator) -> FrameJob:
    rate = RatePrior(frame.rate, 1e-5)
    return FrameJob(frame.pixels, NARROW.pinhole, frame.exposure, estimator, _TRACKER, rate, None, None)


def _prior(frame: SkyFrame) -> AttitudePrior:
    return AttitudePrior(multiply(from_rotation_vector(np.array([2e-4, -1e-4, 1e-4])), frame.attitude), 3e-4)


def _assert_right(solution: FrameSolution | None, truth: FloatArray) -> None:
    assert solution is not None
    assert solution.status is SolveStatus.SOLVED
    assert solution.fix is not None
    assert angle_between(solution.fix.quaternion, truth) < _RIGHT


@pytest.mark.parametrize("estimator", _ESTIMATORS, ids=["likelihood", "harris"])
@pytest.mark.parametrize("streak_px", [0.0, 40.0], ids=["at rest", "streaks"])
@pytest.mark.parametrize("known", [False, True], ids=["lost", "prior"])
def test_every_branch_gives_the_right_attitude_and_its_method(
    estimator: LikelihoodSettings | StreakEstimator, streak_px: float, known: bool
) -> None:
    frame = _frame(streak_px)
    found = run(replace(_job(frame, estimator), attitude_prior=_prior(frame) if known else None))
    _assert_right(found.solution, frame.attitude)
    assert found.solution is not None
    assert found.solution.tracked is known
    if streak_px:
        assert found.motion.status is StreakStatus.RATE
        assert found.motion.rate == pytest.approx(frame.rate, abs=0.05 * float(np.linalg.norm(frame.rate)))
    else:
        assert found.motion.status is StreakStatus.TOO_SHORT
        assert found.motion.rate is None


@pytest.mark.parametrize("estimator", _ESTIMATORS, ids=["likelihood", "harris"])
def test_a_streaked_frame_without_a_known_rate_is_solved(
    estimator: LikelihoodSettings | StreakEstimator,
) -> None:
    """A frame with streaks and without a known rate is solved.

    Without a prior rate, the sign of the rotation is unknown. The attitude at mid-exposure does not depend on
    this sign.
    """
    frame = _frame(40.0)
    found = run(replace(_job(frame, estimator), rate_prior=None))
    assert found.motion.status is StreakStatus.AMBIGUOUS
    _assert_right(found.solution, frame.attitude)


def test_a_wrong_prior_does_not_change_the_attitude() -> None:
    frame = _frame(0.0)
    elsewhere = AttitudePrior(multiply(from_rotation_vector(np.array([0.3, 0.0, 0.0])), frame.attitude), 1e-3)
    found = run(replace(_job(frame, LikelihoodSettings()), attitude_prior=elsewhere))
    _assert_right(found.solution, frame.attitude)
    assert found.solution is not None
    assert not found.solution.tracked


@pytest.mark.parametrize("estimator", _ESTIMATORS, ids=["likelihood", "harris"])
@pytest.mark.parametrize(
    ("level", "status"), [(0, StreakStatus.BLACK), (65_535, StreakStatus.SATURATED)], ids=["black", "white"]
)
def test_an_empty_frame_gives_neither_attitude_nor_rate(
    estimator: LikelihoodSettings | StreakEstimator, level: int, status: StreakStatus
) -> None:
    job = _job(_frame(0.0), estimator)
    found = run(replace(job, pixels=np.full_like(job.pixels, level)))
    assert found == FrameFound(found.motion, None)
    assert found.motion.status is status


@pytest.mark.parametrize("estimator", _ESTIMATORS, ids=["likelihood", "harris"])
def test_repeated_pixels_are_reported_as_a_frozen_camera(
    estimator: LikelihoodSettings | StreakEstimator,
) -> None:
    job = _job(_frame(0.0), estimator)
    again = run(replace(job, previous_checksum=run(replace(job, tracker=None)).motion.checksum))
    assert again.motion.status is StreakStatus.FROZEN
    assert again.solution is None


@pytest.mark.parametrize("estimator", _ESTIMATORS, ids=["likelihood", "harris"])
def test_without_a_tracker_the_result_is_the_motion_only(
    estimator: LikelihoodSettings | StreakEstimator,
) -> None:
    frame = _frame(40.0)
    found = run(replace(_job(frame, estimator), tracker=None))
    assert found.solution is None
    kind = MotionResult if isinstance(estimator, LikelihoodSettings) else StreakResult
    assert isinstance(found.motion, kind)
    assert found.motion.rate == pytest.approx(frame.rate, abs=0.05 * float(np.linalg.norm(frame.rate)))


def test_the_stars_of_a_solved_frame_of_streaks_serve_a_second_fit() -> None:
    job = _job(_frame(40.0), LikelihoodSettings(saturation=65_535))
    first, found = run(replace(job, tracker=None)).motion, run(job)
    assert isinstance(first, MotionResult)
    assert isinstance(job.estimator, LikelihoodSettings)
    solved = solve_motion(first, job.camera, _TRACKER.scale, sky(), _TRACKER.solve)
    better = refit_with_catalogue(job.pixels, solved, sky(), _TRACKER.solve, job.estimator)
    assert better.motion is not None
    assert found.solution is not None
    assert found.motion is found.solution.motion
    assert found.motion.status is first.status
    assert found.motion.rate is not None
    assert better.motion.rate is not None
    assert first.rate is not None
    assert np.array_equal(found.motion.rate, better.motion.rate)
    assert not np.array_equal(found.motion.rate, first.rate)
    assert found.solution.fix is not None
    assert better.fix is not None
    assert np.array_equal(found.solution.fix.quaternion, better.fix.quaternion)


def test_a_job_and_its_result_can_be_sent_between_processes() -> None:
    job = pickle.loads(pickle.dumps(_job(_frame(0.0), LikelihoodSettings())))
    found = passed(run(job))
    _assert_right(found.solution, _frame(0.0).attitude)


def test_an_index_that_is_missing_is_reported_with_its_cure_and_the_motion_is_estimated(
    tmp_path: Path,
) -> None:
    job = _job(_frame(0.0), LikelihoodSettings())
    tracker = replace(_TRACKER, index=tmp_path / "sky.index")
    found = run(replace(job, tracker=tracker))
    assert "startracker.index.build" in found.problem
    assert found.solution is None
    assert found.motion.status is run(replace(job, tracker=None)).motion.status
    assert found.field is None, "no objects are searched for"


def _small_job(**changed: Any) -> FrameJob:
    """Return a job of a camera with a focal length of 1,000 px and an exposure of 0.2 s."""
    usual = FrameJob(
        np.zeros((40, 50), np.uint16),
        Pinhole(50, 40, 1000.0),
        0.2,
        LikelihoodSettings(line_time=2e-5),
        _TRACKER,
        RatePrior(np.array([0.0, 0.004, 0.003]), 1e-3),
        AttitudePrior(np.array([0.0, 0.0, 0.0, 1.0]), 1e-3),
    )
    return replace(usual, **changed)


def test_short_streaks_are_predicted_with_the_uncertainty_of_the_rate() -> None:
    """The longest predicted streak is that of the rate plus PRIOR_SIGMAS standard deviations."""
    longest = (0.005 + PRIOR_SIGMAS * 1e-3) * 0.2 * 1000.0
    assert frame_job._predicted_within(_small_job(), 1.01 * longest)
    assert not frame_job._predicted_within(_small_job(), 0.99 * longest)
    assert frame_job._predicted_within(_small_job(rate_prior=None), 0.1)
    assert not frame_job._predicted_within(_small_job(attitude_prior=None), 100.0)


def test_short_trails_need_a_precise_prediction() -> None:
    found = frame_job._short_trails(_small_job())
    assert found is not None
    assert found.turn == pytest.approx([0.0, 0.0008, 0.0006])
    assert (found.delay, found.delay_sigma) == pytest.approx((1e-4, 0.0))
    for share, known in ((0.98, True), (1.02, False)):
        sigma = share * frame_job._KNOWN_PX / (0.2 * 1000.0)
        job = _small_job(rate_prior=RatePrior(np.zeros(3), sigma))
        assert (frame_job._short_trails(job) is not None) == known
    assert frame_job._short_trails(_small_job(rate_prior=None)) is None
    unstated = frame_job._short_trails(_small_job(estimator=LikelihoodSettings()))
    assert unstated is not None
    assert (unstated.delay, unstated.delay_sigma) == pytest.approx(
        (0.0, LikelihoodSettings().line_time_sigma / 0.2)
    )
    other = frame_job._short_trails(_small_job(estimator=CornerEstimator(StreakSettings())))
    assert other is not None
    assert (other.delay, other.delay_sigma) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("status", "rate", "rests"),
    [
        (StreakStatus.TOO_SHORT, 9.0, True),
        (StreakStatus.TOO_FEW, 9.0, True),
        (StreakStatus.FAILED, 0.004, True),
        (StreakStatus.FAILED, 9.0, False),
        (StreakStatus.RATE, 0.004, False),
        (StreakStatus.FAILED, None, False),
    ],
)
def test_stars_are_at_rest_by_the_pixels_or_by_the_prediction(
    status: StreakStatus, rate: float | None, rests: bool
) -> None:
    prior = None if rate is None else RatePrior(np.array([0.0, rate, 0.0]), 1e-5)
    motion = MotionResult(status, 1, 0.2)
    assert frame_job._shows_no_motion(_small_job(rate_prior=prior), motion) == rests


class _Lens:
    """A stand-in for an estimate of the lens that counts updates and contradictions."""

    def __init__(self, contradicted: bool, updates: tuple[float, ...] = ()) -> None:
        self.contradicted, self.updates = contradicted, updates
        self.contradictions = 1 if contradicted and updates else 0
        self.usable, self.turn = False, np.array([0.0, 0.0, 0.0, 1.0])

    def update(self, *arguments: Any) -> _Lens:
        elapsed = arguments[3] if len(arguments) > 3 else 0.0
        return _Lens(self.contradicted, (*self.updates, elapsed))


@pytest.mark.parametrize("contradicted", [False, True])
def test_a_frame_that_contradicts_the_lens_is_solved_again(
    contradicted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[FrameJob] = []
    solution = FrameSolution(SolveStatus.SOLVED, "", FrameKind.POINTS, Pinhole(50, 40, 1000.0))

    def attitude_and_rate(job: FrameJob, *_: object) -> FrameFound:
        solved.append(job)
        return FrameFound(MotionResult(StreakStatus.TOO_SHORT, 1, 0.2), solution)

    monkeypatch.setattr(frame_job, "attitude_and_rate", attitude_and_rate)
    lens: Any = _Lens(contradicted)
    job = _small_job(lens=(lens, 7.0))
    found: Any = frame_job.run_with_lens(job, _TRACKER, sky())
    assert found.lens.updates == ((7.0, 0.0) if contradicted else (7.0,))
    assert len(solved) == (2 if contradicted else 1)
    plain = frame_job.run_with_lens(_small_job(), _TRACKER, sky())
    assert plain.lens is None
    monkeypatch.setattr(
        frame_job, "attitude_and_rate", lambda *_: FrameFound(MotionResult(StreakStatus.FAILED, 1, 0.2), None)
    )
    assert frame_job.run_with_lens(job, _TRACKER, sky()).lens is lens


def test_the_facts_of_a_frame_are_plain_values() -> None:
    rate = np.array([0.01, -0.02, 0.03])
    motion = MotionResult(StreakStatus.RATE, 1, 0.2, rate=rate, covariance=np.eye(3))
    camera = Pinhole(50, 40, 1000.0)
    solution = FrameSolution(
        SolveStatus.NO_MATCH,
        "",
        FrameKind.POINTS,
        camera,
        points=np.array([[1.26, 3.44], [5.0, 6.0]]),
        star=np.array([4, -1]),
    )
    facts = frame_job._facts(_small_job(), FrameFound(motion, solution))
    assert facts == {
        "exposure_s": 0.2,
        "streaks": "rate",
        "rate_rad_s": rate.tolist(),
        "stars": "no-match",
        "identified": 1,
        "attitude": None,
        "objects": None,
        "star_points": [[1.3, 3.4]],
        "object_points": [],
    }
    ambiguous = replace(motion, status=StreakStatus.AMBIGUOUS)
    facts = frame_job._facts(_small_job(), FrameFound(ambiguous, None))
    assert (facts["rate_rad_s"], facts["stars"], facts["identified"], facts["star_points"]) == (
        None,
        None,
        0,
        [],
    )


@pytest.mark.parametrize(
    "coarse", [Pinhole(50, 33, 70.0), Lens(50, 33, 70.0, (25.5, 15.0), k1=0.02, p1=0.001, aspect=0.01)]
)
def test_the_solution_of_a_binned_image_holds_for_the_whole_image(coarse: CameraModel) -> None:
    """The centre of a bin and the corresponding pixel of the whole image have the same direction."""
    points = np.array([[3.0, 4.0], [40.25, 20.5]])
    found = FrameSolution(
        SolveStatus.SOLVED,
        "",
        FrameKind.POINTS,
        coarse,
        points=points,
        expected=points + 0.1,
        covariance=np.tile(np.diag([0.01, 0.04]), (2, 1, 1)),
        late=points - 3.0,
        psf_sigma=1.5,
    )
    bins = Bins.centred((101, 152), 3)
    assert bins is not None
    whole = in_whole_image(found, bins, (101, 152))
    # The margins are one column and one row at each end.
    assert whole.points == pytest.approx(1.0 + 1.0 + 3.0 * points)
    assert whole.expected == pytest.approx(whole.points + 0.3)
    assert whole.covariance == pytest.approx(9.0 * found.covariance)
    assert whole.late == pytest.approx(3.0 * found.late)
    assert whole.psf_sigma == pytest.approx(4.5)
    assert (whole.camera.columns, whole.camera.rows, whole.camera.focal_length) == (152, 101, 210.0)
    assert whole.camera.project(coarse.unit_vectors(points)) == pytest.approx(whole.points)
    again = whole.camera.binned(bins.columns, bins.rows, 3)
    assert again.project(coarse.unit_vectors(points)) == pytest.approx(points)


_DEFOCUSED = Lens(512, 512, 1450.0, (255.5, 255.5), k1=-0.1)


def _defocused_frame(camera: CameraModel, turn: FloatArray, delay: float) -> tuple[Image, FloatArray]:
    """Return a frame whose stars are rings of 5 to 9 px, and its attitude (4,) at mid-exposure.

    The camera rotates by `turn` (3,), rad, during the exposure, and each row is exposed later than the row
    above it by the fraction `delay` of the exposure. Each pixel is the mean of 4 x 4 points.
    """
    rng = np.random.default_rng(3)
    attitude, stars = normalise(rng.normal(size=4)), catalogue.load()
    bright = stars.magnitude < 7.0
    directions, light = stars.directions_at(EPOCH)[bright], 4e5 * 10.0 ** (-0.4 * stars.magnitude[bright])
    middle = camera.project(directions @ attitude_matrix(attitude).T)
    near = camera.contains(middle, 20.0)
    directions, light, middle = directions[near], light[near], middle[near]
    fine = (np.arange(4 * 512) - 1.5) / 4.0
    image = np.zeros((4 * 512, 4 * 512))
    for fraction in np.linspace(-0.5, 0.5, 7):
        late = fraction + delay * (middle[:, 1] - 255.5)
        rotated = multiply(from_rotation_vector(late[:, None] * turn), attitude)
        points = [
            camera.project(direction @ attitude_matrix(at).T)
            for direction, at in zip(directions, rotated, strict=True)
        ]
        for (x, y), counts in zip(points, light, strict=True):
            columns, rows = np.abs(fine - x) < 10.0, np.abs(fine - y) < 10.0
            apart = np.hypot(fine[columns] - x, fine[rows][:, None] - y)
            ring = np.exp(-0.5 * ((apart - 3.5) / 0.6) ** 2)
            image[np.ix_(rows, columns)] += ring * counts / (7.0 * ring.sum())
    light = image.reshape(512, 4, 512, 4).sum(axis=(1, 3))
    return rng.poisson(light + 100.0).astype(np.uint16), attitude


@pytest.mark.parametrize(
    ("camera", "length", "delay"),
    [(_DEFOCUSED.ideal, 0.0, 0.0), (_DEFOCUSED, 0.0, 0.0), (_DEFOCUSED.ideal, 3.0, 8e-4)],
    ids=["pinhole", "lens", "rolling shutter"],
)
def test_an_attitude_follows_from_the_rings_of_defocused_stars(
    camera: CameraModel, length: float, delay: float
) -> None:
    turn = np.array([0.6, 0.8, 0.0]) * length / camera.focal_length
    pixels, attitude = _defocused_frame(camera, turn, delay)
    settings = SolveSettings(detection=DetectionSettings(psf_sigma=1.0, gain=1.0))
    estimator = LikelihoodSettings(saturation=65_535, line_time=delay)
    job = FrameJob(
        pixels,
        camera,
        1.0,
        estimator,
        TrackerSettings(settings, (1.0, 1.0)),
        RatePrior(turn, 1e-5),
        AttitudePrior(multiply(from_rotation_vector(np.array([2e-4, -1e-4, 1e-4])), attitude), 3e-4),
    )
    solution = run(job).solution
    assert solution is not None
    assert solution.fix is not None
    error = to_rotation_vector(multiply(solution.fix.quaternion, conjugate(attitude)))
    assert error @ np.linalg.solve(solution.fix.covariance, error) < 16.3  # 99.9 % of chi-square(3)
    matched = solution.matched
    assert len(matched) >= 10
    off = solution.points[matched] - solution.expected[matched]
    assert np.median(np.hypot(*off.T)) < 0.3
    assert np.sqrt(np.diag(solution.fix.covariance))[:2].max() * camera.focal_length < 0.3
    assert np.hypot(*error[:2]) * camera.focal_length < 0.3
