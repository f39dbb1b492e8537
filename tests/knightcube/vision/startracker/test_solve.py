"""Tests of the attitude from frames with points, streaks, priors or uneven motion, or without stars."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import (
    angle_between,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Lens, Pinhole
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.star_tracker import StarTracker
from knightcube.vision.startracker import solve as solve_module
from knightcube.vision.startracker.detect import Detections
from knightcube.vision.startracker.sky_map import ASPECT
from knightcube.vision.startracker.solve import (
    ENDS,
    MEAN,
    MIDDLE,
    NODES,
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    SolveStatus,
    Weighting,
    _agrees,
    _shape_unknown,
    middle_covariance,
    solve_places,
    weighting_of,
)
from knightcube.vision.startracker.survey import DetectionSettings, FrameKind
from knightcube.vision.streaks.streak_result import FrameMotion, MotionResult, StreakStatus
from sim_hal.star_camera import StarCameraModel, render
from tests.knightcube.vision.startracker.frames import EPOCH, NARROW, SkyFrame, sky, sky_frame
from tests.support.attitude_errors import attitude_error
from tests.support.photographs import ARCSECONDS, photograph
from tests.support.star_lists import ListKind, draw

_KNOWN_TO_A_PERCENT = 0.99, 1.01
_PHOTOGRAPHS = Path(__file__).parents[5] / "shared" / "data" / "sky"
_CHI_SQUARE_3_DOF_1E_5 = 25.9


def _solve(
    frame: SkyFrame, prior: AttitudePrior | None = None, scale: tuple[float, float] = (1.0, 1.0)
) -> FrameSolution:
    rate = RatePrior(frame.rate, 1e-6)
    # The simulated lens has no distortion, so only its focal length is uncertain.
    camera, settings = NARROW.pinhole, SolveSettings(uncalibrated_lens=False)
    return solve_frame(frame.pixels, camera, scale, frame.exposure, sky(), settings, prior, rate)


def _mismatch(found: FrameSolution, truth: FloatArray) -> float:
    """Return the squared attitude error, normalised by the covariance."""
    assert found.fix is not None
    error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(truth)))
    return float(error @ np.linalg.solve(found.fix.covariance, error))


@pytest.mark.parametrize("streak_px", [0.0, 40.0])
def test_a_frame_is_solved_lost_in_space_within_its_own_covariance(streak_px: float) -> None:
    frame = sky_frame(np.random.default_rng(11), streak_px, 0.1)
    found = _solve(frame, scale=_KNOWN_TO_A_PERCENT)
    assert found.status is SolveStatus.SOLVED
    assert not found.tracked
    assert _mismatch(found, frame.attitude) < _CHI_SQUARE_3_DOF_1E_5
    _, across = attitude_error(found.fix.quaternion, frame.attitude)  # type: ignore[union-attr]  # solved
    assert across * ARCSECONDS < (1.0 if streak_px == 0.0 else 8.0)
    assert found.camera.focal_length == pytest.approx(NARROW.pinhole.focal_length, rel=1e-4)


def test_a_calibrated_lens_is_kept_lost_in_space() -> None:
    """Lost-in-space identification does not change a calibrated lens.

    The triangle that identifies the stars has its own scale, which is wrong by up to 0.1 %.
    """
    for seed in range(3):
        found = _solve(sky_frame(np.random.default_rng([31, seed]), 40.0, 0.1))
        assert found.status is SolveStatus.SOLVED
        assert found.camera.focal_length == NARROW.pinhole.focal_length


def test_a_streaked_frame_gives_the_rate_and_a_frame_at_rest_does_not() -> None:
    streaked = sky_frame(np.random.default_rng(12), 40.0, 0.1)
    motion = _solve(streaked).motion
    assert motion is not None
    assert motion.rate is not None
    assert np.linalg.norm(motion.rate) == pytest.approx(np.linalg.norm(streaked.rate), rel=0.02)
    assert _solve(sky_frame(np.random.default_rng(12), 0.0, 0.1)).motion is None


def test_the_attitudes_of_many_frames_scatter_as_their_covariances_say() -> None:
    """The squared errors of twelve frames are within the 1e-4 quantiles of chi-square.

    The errors have 36 degrees of freedom.
    """
    frames = [sky_frame(np.random.default_rng([13, number]), 0.0, 0.1) for number in range(12)]
    total = sum(_mismatch(_solve(frame, scale=_KNOWN_TO_A_PERCENT), frame.attitude) for frame in frames)
    assert 11.9 < total < 76.4


@pytest.mark.parametrize("streak_px", [0.0, 30.0])
def test_a_right_prior_is_tracked_to_the_same_attitude(streak_px: float) -> None:
    frame = sky_frame(np.random.default_rng(14), streak_px, 0.1)
    off = multiply(from_rotation_vector(np.array([2e-4, -3e-4, 1e-4])), frame.attitude)
    found = _solve(frame, AttitudePrior(off, 3e-4))
    assert found.tracked
    assert _mismatch(found, frame.attitude) < _CHI_SQUARE_3_DOF_1E_5


@pytest.mark.parametrize("seed", [2, 3, 7])
def test_a_star_that_an_unresolved_companion_displaces_does_not_dominate_the_attitude(seed: int) -> None:
    """A star of V 3.4 is displaced by a star of V 6.0 at a distance of 4.7 px, twice the width of the PSF.

    The displacement of the brightest star, 0.24 px, is eight times its standard deviation. Two other bright
    stars of the frame are not displaced. With seed 7, the displaced star does not match at first.
    """
    found = _displaced(seed)
    assert _mismatch(found, _DISPLACED) < 16.3  # exceeded with a probability of 0.1 %


def test_points_without_direction_do_not_hide_the_displacement_by_companions() -> None:
    """A lens gives no direction for a point beyond the fold of its distortion."""
    found = _displaced(2)
    expected = solve_module._shift_by_companions(found, 2.5, sky(), None)
    assert expected.max() > 0.1
    lens = Lens(800, 600, found.camera.focal_length, (399.5, 299.5), k1=-0.3)
    points = np.concatenate([found.points, [[1e5, 1e5]]])
    assert not np.isfinite(lens.unit_vectors(points[-1:])).all()
    more = replace(found, camera=lens, points=points, star=np.append(found.star, -1))
    np.testing.assert_allclose(solve_module._shift_by_companions(more, 2.5, sky(), None)[:-1], expected)


_DISPLACED = normalise(np.array([-0.54398653, 0.13602243, 0.80589714, 0.19001673]))


def _displaced(seed: int) -> FrameSolution:
    """Return the solution of a frame with a star that an unresolved companion displaces."""
    camera = StarCameraModel(columns=800, rows=600, field_of_view=float(np.radians(15.0)), psf_sigma=2.5)
    stars, times = catalogue.load(), np.array([0.0, 0.025, 0.05])
    directions, attitudes = stars.directions_at(EPOCH), np.tile(_DISPLACED, (3, 1))
    pixels = render(camera, directions, stars.magnitude, times, attitudes, np.random.default_rng(seed))
    return solve_frame(pixels, camera.pinhole, (1.0, 1.0), 0.05, sky(), SolveSettings())


def test_a_wrong_prior_does_not_change_the_solution() -> None:
    frame = sky_frame(np.random.default_rng(15), 0.0, 0.1)
    elsewhere = multiply(from_rotation_vector(np.array([0.5, 0.0, 0.0])), frame.attitude)
    found = _solve(frame, AttitudePrior(elsewhere, 3e-4))
    assert found.status is SolveStatus.SOLVED
    assert not found.tracked
    assert _mismatch(found, frame.attitude) < _CHI_SQUARE_3_DOF_1E_5


def test_an_attitude_of_four_stars_far_from_the_prior_is_not_returned() -> None:
    """An attitude far from the prior, on which only four stars agree, is not returned.

    The position of the brightest star is wrong by 1.2 px. Four stars agree on a roll that differs from the
    prior by 30 sigmas.
    """
    camera, sigma = Pinhole.from_field_of_view(512, 512, float(np.radians(20.0))), 1e-4
    prior = np.array([-0.40584763582055994, 0.7184116261147981, 0.029066639845090374, 0.5642052484779536])
    x = np.array([277.82, 104.81, 59.83, 6.82, 172.6, 204.45, 18.86, 173.75, 340.37, 466.16, 119.75])
    y = np.array([202.35, 419.96, 312.28, 245.56, 504.17, 115.91, 357.28, 459.79, 357.14, 498.42, 53.05])
    error = np.array([0.027, 0.044, 0.055, 0.065, 0.11, 0.12, 0.13, 0.16, 0.2, 0.24, 0.29])
    found = solve_places(
        np.stack([x, y], axis=1),
        error[:, None, None] ** 2 * np.eye(2),
        FrameKind.STREAKS,
        camera,
        (1.0, 1.0),
        sky(),
        SolveSettings(),
        AttitudePrior(prior, sigma),
    )
    assert found.fix is None or angle_between(found.fix.quaternion, prior) < 6.0 * sigma


@pytest.mark.parametrize(
    ("claimed", "false_stars", "accepted"),
    [(1.0, 45, True), (0.3, 100, False), (0.3, 3, True)],
    ids=["true claims", "wrong claims of the smaller part", "wrong claims of most points"],
)
def test_points_that_contradict_their_uncertainties_give_no_attitude_unless_most_of_them_match(
    claimed: float, false_stars: int, accepted: bool
) -> None:
    """Points that contradict their stated uncertainty give an attitude only if most of them match.

    The 20 to 80 stars have position errors of 1 px, but the stated standard deviation is `claimed` px.
    """
    kind = ListKind(field_deg=20.0, faintest=5.5, noise_px=1.0, false_stars=false_stars, known_deg=0.0)
    answered = 0
    for seed in range(8):
        drawn = draw(kind, sky().stars, np.random.default_rng([23, seed]))
        covariance = np.full(len(drawn.pixels), claimed**2)[:, None, None] * np.eye(2)
        found = solve_places(
            drawn.pixels, covariance, FrameKind.POINTS, drawn.camera, (1.0, 1.0), sky(), SolveSettings()
        )
        answered += found.fix is not None
        if not accepted and found.fix is None:
            assert "match no star" in found.reason or "beyond chance" in found.reason
        if accepted and found.fix is not None:
            assert _mismatch(found, drawn.attitude) < _CHI_SQUARE_3_DOF_1E_5
    assert answered >= 6 if accepted else answered == 0


def test_stars_seen_as_two_points_each_widen_the_attitude_by_their_distance() -> None:
    """If each star appears as two points, the uncertainty of the attitude covers the distance of the points.

    The points are 4 px on either side of the true position.
    """
    kind = ListKind(field_deg=20.0, faintest=5.5, noise_px=0.1, false_stars=0, known_deg=0.0)
    part = np.array([3.2, -2.4])
    single: list[FloatArray] = []
    double: list[FloatArray] = []
    for seed in range(6):
        drawn = draw(kind, sky().stars, np.random.default_rng([29, seed]))
        for points, covariances in (
            (drawn.pixels, single),
            (np.concatenate([drawn.pixels + part, drawn.pixels - part]), double),
        ):
            covariance = np.full(len(points), 0.1**2)[:, None, None] * np.eye(2)
            found = solve_places(
                points, covariance, FrameKind.POINTS, drawn.camera, (1.0, 1.0), sky(), SolveSettings()
            )
            if found.fix is None:
                continue
            assert _mismatch(found, drawn.attitude) < _CHI_SQUARE_3_DOF_1E_5
            covariances.append(found.fix.covariance[:2, :2] * drawn.camera.focal_length**2)
    assert len(single) == 6
    assert len(double) >= 4
    assert np.max(np.trace(single, axis1=1, axis2=2)) < 1.0
    turn = np.array([-part[1], part[0]])  # a shift of the image along x is a rotation about y
    for covariance in double:
        # The tolerance allows for other points that are nearby by chance.
        np.testing.assert_allclose(covariance, np.outer(turn, turn), rtol=0.05)


def test_noise_alone_shows_no_star() -> None:
    pixels = np.random.default_rng(16).normal(100.0, 10.0, (512, 512)).round().astype(np.uint16)
    found = solve_frame(pixels, NARROW.pinhole, (1.0, 1.0), 0.1, sky(), SolveSettings())
    assert found.status in {SolveStatus.NO_STARS, SolveStatus.TOO_FEW_STARS}
    assert found.fix is None
    assert found.reason


def test_points_that_are_not_stars_are_refused_with_the_reason() -> None:
    """Points that are not stars give no attitude, and the reason is reported.

    The points of a real frame are moved at random. The moved points keep their flux, but match no part of the
    sky.
    """
    rng = np.random.default_rng(17)
    pixels = rng.normal(100.0, 10.0, (1024, 1024))
    rows, columns = np.mgrid[-4:5, -4:5]
    spot = np.exp(-0.5 * (rows**2 + columns**2))
    for row, column in rng.integers(10, 1010, (40, 2)):
        pixels[row - 4 : row + 5, column - 4 : column + 5] += rng.uniform(100.0, 2000.0) * spot
    found = solve_frame(
        pixels.round().astype(np.uint16), NARROW.pinhole, (0.5, 2.0), 0.1, sky(), SolveSettings()
    )
    assert found.status is SolveStatus.NO_MATCH
    assert "beyond chance" in found.reason


@pytest.mark.skipif(not _PHOTOGRAPHS.is_dir(), reason="the photographs of ../shared/data/sky are not here")
@pytest.mark.parametrize(
    "name",
    ["esa_alt40_azi45.tiff", "hale_bopp.jpg", "tree.jpg", "virgo.jpg", "polar_05sec.jpg",
     "may8_50ms_gain40_0.png", "may8_100ms_gain12_3.png"],
)  # fmt: skip
def test_a_photograph_is_solved_to_a_minute_of_arc(name: str) -> None:
    truth = json.loads((_PHOTOGRAPHS / "truth.json").read_text())[name]
    result = photograph(_PHOTOGRAPHS, name, truth, known=True)
    assert result.solved
    assert result.arcsec < 60.0


@pytest.mark.skipif(not _PHOTOGRAPHS.is_dir(), reason="the photographs of ../shared/data/sky are not here")
def test_a_mirrored_photograph_is_solved_and_reported_as_mirrored() -> None:
    """A mirrored photograph is solved and reported as mirrored.

    The attitude refers to the unmirrored image, and the positions refer to the given image.
    """
    upright = read_image(_PHOTOGRAPHS / "esa_alt40_azi45.tiff")
    camera = type(NARROW.pinhole)(upright.shape[1], upright.shape[0], 5110.0)
    good, mirrored = (
        solve_frame(np.ascontiguousarray(pixels), camera, (0.9, 1.1), 1.0, sky(), SolveSettings())
        for pixels in (upright, upright[:, ::-1])
    )
    assert good.fix is not None
    assert mirrored.fix is not None
    assert (good.mirrored, mirrored.mirrored) == (False, True)
    assert angle_between(good.fix.quaternion, mirrored.fix.quaternion) < 1e-4
    matched = mirrored.matched
    assert np.abs(mirrored.points[matched] - mirrored.expected[matched]).max() < 5.0
    first = np.flatnonzero(good.star == mirrored.star[matched[0]])[0]
    across = upright.shape[1] - 1.0 - good.points[first, 0]
    assert mirrored.points[matched[0], 0] == pytest.approx(across, abs=0.5)


_EXPOSURE = 2.0
_TIMES = _EXPOSURE * (np.array(NODES) - 0.5)
# Three weightings as functions of time from -1 to 1: mean, ends, and middle of a least-squares parabola.
_EVEN = np.linspace(-1.0, 1.0, 401)
_PARABOLA = np.linalg.pinv(np.stack([np.ones(401), _EVEN, _EVEN**2], axis=1))[0]
_WEIGHTS = {
    "mean": (MEAN, np.full(401, 1.0 / 401.0)),
    "ends": (ENDS, np.array([0.5, *np.zeros(399), 0.5])),
    "middle": (MIDDLE, _PARABOLA),
}


def _turns(*powers: float) -> FloatArray:
    """Return rotations (4, 3) about x that are polynomials of time without a constant term."""
    angle = sum(factor * _TIMES ** (power + 1) for power, factor in enumerate(powers))
    return np.outer(angle, [1.0, 0.0, 0.0])


@pytest.mark.parametrize(("weighting", "part"), [(MEAN, 24.0), (ENDS, 8.0), (MIDDLE, np.inf)])
def test_the_attitude_error_by_a_steady_acceleration_is_its_integral(
    weighting: Weighting, part: float
) -> None:
    """The attitude error of a steady acceleration is the weighted mean of the rotation angle.

    A rotation angle a t^2 / 2, with t from -T/2 to T/2, has the mean a T^2 / 24. The mean of the rotation
    angles at both ends is a T^2 / 8, and the middle of a fitted parabola is zero.
    """
    acceleration = 0.3
    off = middle_covariance(weighting, _turns(0.0, 0.5 * acceleration), np.zeros((3, 3)), _EXPOSURE)
    assert off[0, 0] == pytest.approx((acceleration * _EXPOSURE**2 / part) ** 2, abs=1e-30)
    assert np.count_nonzero(off) == np.count_nonzero(off[0, 0])


@pytest.mark.parametrize("weighting", [MEAN, ENDS, MIDDLE])
def test_steady_and_odd_motions_do_not_change_the_attitude_at_mid_exposure(weighting: Weighting) -> None:
    assert middle_covariance(weighting, _turns(0.7, 0.0, 0.4), np.zeros((3, 3)), _EXPOSURE).max() < 1e-30


@pytest.mark.parametrize("name", list(_WEIGHTS))
def test_the_nodes_represent_the_whole_exposure(name: str) -> None:
    """If the rotation contains t^2 and t^4, the few nodes agree with sums over 401 instants."""
    weighting, fine = _WEIGHTS[name]
    time = 0.5 * _EXPOSURE * _EVEN
    off = middle_covariance(weighting, _turns(0.0, 0.2, 0.0, 0.9), np.zeros((3, 3)), _EXPOSURE)
    assert np.sqrt(off[0, 0]) == pytest.approx(abs(fine @ (0.2 * time**2 + 0.9 * time**4)), rel=0.05)


@pytest.mark.parametrize("name", list(_WEIGHTS))
def test_the_scatter_by_white_acceleration_agrees_with_the_covariance(name: str) -> None:
    """The attitude error of a white acceleration agrees with the covariance.

    In 4,000 random exposures, the acceleration is integrated twice. The variance is accurate to 10 %.
    """
    weighting, fine = _WEIGHTS[name]
    density, steps, trials = 0.03, 200, 4000
    step = 0.5 * _EXPOSURE / steps
    kicks = np.random.default_rng(1).standard_normal((2, trials, steps)) * np.sqrt(density * step)
    rate = np.cumsum(kicks, axis=2)
    angle = np.cumsum(rate, axis=2) * step
    away = np.concatenate([angle[0, :, ::-1], np.zeros((trials, 1)), angle[1]], axis=1)
    found = np.var(away @ fine)
    said = middle_covariance(weighting, np.zeros((4, 3)), density * np.eye(3), _EXPOSURE)
    assert found == pytest.approx(said[0, 0], rel=0.1)
    np.testing.assert_array_equal(said, said[0, 0] * np.eye(3))


def test_the_kind_of_motion_determines_the_time_weighting() -> None:
    rest, moved = StreakStatus.TOO_SHORT, StreakStatus.RATE
    assert weighting_of(FrameMotion(rest, 0, 1.0)) is MEAN
    assert weighting_of(MotionResult(rest, 0, 1.0)) is MEAN
    assert weighting_of(FrameMotion(moved, 0, 1.0)) is ENDS
    assert weighting_of(MotionResult(StreakStatus.AMBIGUOUS, 0, 1.0)) is ENDS
    assert weighting_of(MotionResult(moved, 0, 1.0, rate_model="accelerating")) is MIDDLE


@pytest.mark.slow
@pytest.mark.skipif(not _PHOTOGRAPHS.is_dir(), reason="needs ../shared/data/sky")
@pytest.mark.parametrize("name", ["esa_alt40_azi45.tiff", "orion2.jpg"])
@pytest.mark.parametrize(
    ("aspect", "shear", "tangential"),
    [(0.004, 0.0, 0.0), (-0.01, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.008, 0.0), (0.0, 0.0, 0.008)],
)
def test_a_distorted_photograph_is_solved_within_its_claim_or_refused(
    name: str, aspect: float, shear: float, tangential: float
) -> None:
    """A distorted photograph is solved within its uncertainty, or refused.

    The truth is the solution of the original photograph, as the distortion does not displace the image
    centre.
    """
    pixels = read_image(_PHOTOGRAPHS / name)
    rows, columns = pixels.shape
    y, x = np.mgrid[:rows, :columns].astype(float)
    u, v = (2.0 * x - columns + 1.0) / columns, (2.0 * y - rows + 1.0) / columns
    right = aspect * u + shear * v + tangential * (3.0 * u * u + v * v)
    down = -aspect * v + shear * u + 2.0 * tangential * u * v
    places = [y + 0.5 * columns * down, x + 0.5 * columns * right]
    warped = map_coordinates(pixels.astype(float), places, order=1, mode="nearest").astype(pixels.dtype)
    plain, found = StarTracker(10.8).solve(pixels), StarTracker(10.8).solve(warped)
    assert plain
    if not found:
        assert abs(aspect) > 0.01
        return
    turn = to_rotation_vector(multiply(found.quaternion, conjugate(plain.quaternion)))
    spread = np.sqrt(np.diag(found.covariance + plain.covariance))
    assert np.all(np.abs(turn) < 3.0 * spread)
    if tangential == 0.0:
        assert found.frame.bend[ASPECT:].tolist() == pytest.approx([aspect, shear], abs=0.001)
        expected = plain.field_of_view * (1.0 + aspect)
        assert found.field_of_view == pytest.approx(expected, abs=4.0 * found.field_of_view_sigma + 2e-4)


@pytest.mark.parametrize(
    ("widths", "given", "doubt_px"),
    [
        ([1.2, 1.6, 1.4, np.nan], 1.0, 0.02),
        ([0.7, 0.8, 0.9], 1.0, 0.01),
        ([1.0, 1.0], 1.0, 0.0),
        ([np.nan, np.nan], 1.0, 0.0),
        ([], 1.0, 0.0),
        ([2.0, 2.0], None, 0.0),
    ],
)
def test_stars_wider_than_the_given_spread_widen_the_attitude_across_the_boresight(
    widths: list[float], given: float | None, doubt_px: float
) -> None:
    covariance = np.diag([4e-12, 9e-12, 25e-10])
    fix = AttitudeFix(np.array([0.0, 0.0, 0.0, 1.0]), covariance, 0.0)
    solved = FrameSolution(SolveStatus.SOLVED, "", FrameKind.POINTS, NARROW.pinhole, fix=fix)
    settings = SolveSettings(detection=DetectionSettings(psf_sigma=given))
    found = cast(Detections, SimpleNamespace(width=np.array(widths)))
    wider = _shape_unknown(solved, found, settings).fix
    assert wider is not None
    added = (doubt_px / NARROW.pinhole.focal_length) ** 2
    np.testing.assert_allclose(wider.covariance, covariance + np.diag([added, added, 0.0]), rtol=1e-9)
    assert _shape_unknown(replace(solved, fix=None), found, settings).fix is None


def test_a_frame_without_an_attitude_has_none_to_widen() -> None:
    refused = FrameSolution(SolveStatus.TOO_FEW_STARS, "too few", FrameKind.POINTS, NARROW.pinhole)
    assert refused.wider(np.eye(3)) is refused


@pytest.mark.parametrize(("sigmas", "agrees"), [(0.0, True), (4.0, True), (10.0, False)])
@pytest.mark.parametrize("axis", range(3))
def test_an_attitude_agrees_with_a_prior_within_the_errors_of_both(
    sigmas: float, agrees: bool, axis: int
) -> None:
    covariance = np.diag([1e-6, 4e-6, 9e-6])
    known = np.sqrt(covariance[axis, axis] + 4e-6)
    off = from_rotation_vector(sigmas * known * np.eye(3)[axis])
    held = from_rotation_vector(np.array([0.4, -1.0, 0.3]))
    solved = FrameSolution(SolveStatus.SOLVED, "", FrameKind.POINTS, NARROW.pinhole)
    prior = AttitudePrior(held, 2e-3)
    assert _agrees(solved, prior), "without an attitude"
    fix = AttitudeFix(multiply(off, held), covariance, 0.0)
    assert _agrees(replace(solved, fix=fix), prior) is agrees
