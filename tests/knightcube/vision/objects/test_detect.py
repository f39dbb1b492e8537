"""Tests of the detection of objects by the difference between their streaks and the streaks of stars.

The indicators of a deviation are compared with values computed by hand, for stars at every angle, and for
objects. Simulated frames test detections, false alarms, overlaps with stars, objects that cross, and the
attitude from a crowded sky at rest.
"""

from __future__ import annotations

import dataclasses
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import rotation_between
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_matrix
from knightcube.errors import ArgumentError, KnightCubeError
from knightcube.gnc.tracker import FrameSightings, ObjectTracker, TrackSettings
from knightcube.vision.camera.lens import CameraModel, Lens, streak_camera
from knightcube.vision.frame_job import run
from knightcube.vision.objects import detect as detect_module
from knightcube.vision.objects.detect import (
    Judge,
    ObjectReport,
    SpaceObject,
    Verdict,
    _light_beside,
    angular_displacements,
    centre_residuals,
    detect,
    detect_objects,
    evaluate,
    lengths,
    olae_residuals,
    short_regions,
    slopes,
    star_ends,
)
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.objects.star_light import Explanation, LocatedEnds, StarLight
from knightcube.vision.objects.streak_ends import measure_streaks, segment_frame
from knightcube.vision.objects.streak_images import star_paths
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings, StreakStatus
from sim_hal.star_camera import SourceTrack
from tests.flight.loop.passing import passed
from tests.knightcube.vision.objects.space_objects import (
    add_object,
    frame_with,
    motion_across,
    object_path,
    star_field,
)
from tests.knightcube.vision.satellite_frames import CAMERA, EXPOSURE, TIMES, frame_job
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_frames import expose, rate_at, read_out, star_camera, true_endpoints

_CAMERA = star_camera()
_PINHOLE = _CAMERA.pinhole
_BOUNDS = (8.0, 10.0, 10.0)
_THETAS = [2.0, 10.0, 30.0, 60.0, 80.0, 90.0]


def _stars(theta_deg: float, seed: int = 1, n: int = 14) -> tuple[FloatArray, FloatArray]:
    """Return exact ends (n, 2, 2) of star streaks in the whole field of view, and the rotation (3,).

    The longest streak has 100 px.
    """
    theta = np.deg2rad(theta_deg)
    turn = rate_at(theta, min(100.0 / _PINHOLE.focal_length / np.sin(theta), 0.3), 0.8)
    points = np.random.default_rng(seed).uniform(60.0, 960.0, (n, 2))
    return true_endpoints(_CAMERA, _PINHOLE.unit_vectors(points), turn), turn


def test_the_indicators_of_a_quarter_circle_by_hand() -> None:
    """The indicators of a quarter circle agree with values computed by hand.

    The streak from (13, 20) to (10, 23) is a quarter circle of radius 3 around (10, 20).
    """
    ends = np.array([[[13.0, 20.0], [10.0, 23.0]]])
    centre = np.array([10.0, 20.0])
    assert centre_residuals(ends, centre)[0] == pytest.approx(0.0, abs=1e-15)
    assert angular_displacements(ends, centre)[0] == pytest.approx(0.5 * np.pi)
    assert lengths(ends)[0] == pytest.approx(3.0 * np.sqrt(2.0))
    assert slopes(ends)[0] == pytest.approx(0.75 * np.pi)
    # If the centre is displaced by (1, 0), the residual is the component of this displacement along the
    # chord.
    assert abs(centre_residuals(ends, centre + np.array([1.0, 0.0]))[0]) == pytest.approx(np.sqrt(0.5))


def test_the_residual_is_that_of_olae() -> None:
    ends, _ = _stars(60.0)
    noisy = ends + np.random.default_rng(2).normal(0.0, 0.5, ends.shape)
    vectors = _PINHOLE.unit_vectors(noisy)
    solution = rotation_between(vectors[:, 0], vectors[:, 1], np.ones(len(ends)))
    found = olae_residuals(vectors, solution.rotation_vector)
    np.testing.assert_allclose(found, np.linalg.norm(solution.residuals, axis=-1), rtol=1e-6)


@pytest.mark.parametrize("theta_deg", _THETAS)
def test_a_star_at_the_same_position_is_the_same_star(theta_deg: float) -> None:
    ends, turn = _stars(theta_deg)
    vectors = _PINHOLE.unit_vectors(ends)
    np.testing.assert_allclose(_PINHOLE.project(star_ends(vectors, turn)), ends, atol=1e-8)


@pytest.mark.parametrize("theta_deg", _THETAS)
def test_exact_stars_have_no_deviations_for_any_axis(theta_deg: float) -> None:
    """The exact streaks of stars do not deviate from the expected streaks, for any rotation axis.

    In the field of view, the projection changes the slopes of the streaks by 1.8 deg and their lengths by 6
    %.
    """
    ends, turn = _stars(theta_deg)
    found = evaluate(ends[:, ::-1], np.full(len(ends), 0.1), turn, _PINHOLE, _BOUNDS)
    np.testing.assert_allclose(found.deviations, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.endpoints, ends)
    assert found.degenerate == (theta_deg > 71.6)
    assert not found.fired.any()


@pytest.mark.parametrize("theta_deg", _THETAS)
def test_deviations_are_in_standard_deviations_of_the_endpoint_errors(theta_deg: float) -> None:
    """Deviations of the ends along and across a streak have unit variance, in units of the ends' errors.

    The residual includes the deviation along the streak and the deviation across the streak.
    """
    rng = np.random.default_rng(3)
    ends, turn = _stars(theta_deg, n=14)
    long = lengths(ends) > 25.0
    sigma = rng.uniform(0.05, 0.3, len(ends))
    deviations = [
        evaluate(
            ends + sigma[:, None, None] * rng.normal(size=ends.shape), sigma, turn, _PINHOLE, _BOUNDS
        ).deviations[long]
        for _ in range(60)
    ]
    spread = np.sqrt(np.mean(np.square(deviations), axis=(0, 1)))
    # The tolerance of a fifth allows for the fitted centre, and for the stretched projection at the edge of
    # the field.
    np.testing.assert_allclose(spread, [1.0, 1.0, np.sqrt(2.0)], rtol=0.2)


@pytest.mark.parametrize("theta_deg", _THETAS)
@pytest.mark.parametrize(
    ("along", "across", "expected"), [(6.0, 0.0, (False, True, True)), (0.0, 6.0, (True, False, True))]
)
def test_each_indicator_sees_its_own_part_of_a_motion(
    theta_deg: float, along: float, across: float, expected: tuple[bool, bool, bool]
) -> None:
    """Each indicator detects its own component of a motion.

    The ends of an object are displaced by 6 px relative to each other, 42 standard deviations of 0.1 px.
    """
    ends, turn = _stars(theta_deg)
    one = int(np.argmax(lengths(ends)))
    chord = ends[one, 1] - ends[one, 0]
    chord /= np.linalg.norm(chord)
    side = np.array([-chord[1], chord[0]])
    # Half of the displacement is applied to each end, so that the reference star remains the same.
    moved = 0.5 * (along * chord + across * side)
    ends[one] += [-moved, moved]
    found = evaluate(ends, np.full(len(ends), 0.1), turn, _PINHOLE, _BOUNDS)
    assert tuple(found.fired[one]) == expected
    assert not np.delete(found.fired, one, axis=0).any()


def test_a_point_has_a_wrong_displacement_and_no_direction() -> None:
    ends, turn = _stars(60.0)
    ends[3] = ends[3].mean(axis=0)
    found = evaluate(ends, np.full(len(ends), 0.1), turn, _PINHOLE, _BOUNDS)
    assert tuple(found.fired[3]) == (False, True, True)
    assert np.all(np.isfinite(found.deviations))


def test_the_lower_bound_keeps_a_quiet_frame_quiet_and_the_strict_rule_a_loud_one() -> None:
    ends, turn = _stars(60.0, n=30)
    rng = np.random.default_rng(4)
    noise = rng.normal(size=ends.shape)
    sigma = np.full(len(ends), 0.1)
    quiet = evaluate(ends + 0.1 * noise, sigma, turn, _PINHOLE, _BOUNDS)
    strict_only = evaluate(ends + 0.1 * noise, sigma, turn, _PINHOLE, (0.0, 0.0, 0.0))
    # With limits of 2.5 sigma for thirty streaks and three indicators, nearly every frame has a false alarm.
    assert strict_only.fired.any()
    assert not quiet.fired.any()
    # If errors are ten times larger than expected, the scatter within the frame prevents false alarms.
    loud = evaluate(ends + noise, sigma, turn, _PINHOLE, _BOUNDS)
    assert np.count_nonzero(np.abs(loud.deviations) > _BOUNDS) > 3 * np.count_nonzero(loud.fired)


def test_no_streaks_give_no_indicators() -> None:
    found = evaluate(np.empty((0, 2, 2)), np.empty(0), np.array([0.0, 0.03, 0.0]), _PINHOLE, _BOUNDS)
    assert found.deviations.shape == found.fired.shape == (0, 3)
    assert found.degenerate


_FRAME_CAMERA = star_camera(512)
_FOCAL = _FRAME_CAMERA.pinhole.focal_length
_SETTINGS = EndpointSettings(saturation=_FRAME_CAMERA.full_well)
_ROTATION = rate_at(np.deg2rad(60.0), 55.0 / _FOCAL, 0.4)
_PLACE = _FRAME_CAMERA.pinhole.unit_vectors(np.array([[270.0, 230.0]]))[0]
_FAINTEST = 6.0


def _detect(pixels: FloatArray, rotation: FloatArray, exposure: float = 1.0) -> ObjectReport:
    found = _turn(pixels, rotation, exposure)
    report = detect(pixels, _FRAME_CAMERA.pinhole, found, exposure, _SETTINGS, ObjectSettings())
    assert report is not None
    return report


def _turn(
    pixels: FloatArray, rotation: FloatArray, exposure: float, camera: CameraModel = _FRAME_CAMERA.pinhole
) -> FloatArray:
    """Return the maximum likelihood estimate of the rotation, with the sign of the true rotation."""
    settings = LikelihoodSettings(saturation=_SETTINGS.saturation, gain=_SETTINGS.gain)
    found = estimate_motion(pixels, streak_camera(camera), exposure, settings, rotation / exposure, 0.0)
    assert found.rate is not None
    return np.asarray(found.rate * exposure)


def _see(
    motion: FloatArray,
    magnitude: float,
    seed: int = 5,
    rotation: FloatArray = _ROTATION,
    exposure: float = 1.0,
) -> tuple[ObjectReport, FloatArray]:
    """Return the detections in a frame with one object, and the true path of the object in the image."""
    path = object_path(_FRAME_CAMERA, _PLACE, motion, rotation)
    pixels = frame_with(_FRAME_CAMERA, rotation, exposure, seed, [(path, magnitude)], _FAINTEST)
    return _detect(pixels, rotation, exposure), path


def _only(report: ObjectReport) -> SpaceObject:
    assert len(report.objects) == 1
    return report.objects[0]


@pytest.mark.parametrize(("towards", "px"), [(0.3, 25.0), (2.4, 60.0), (4.0, 25.0)])
def test_a_moving_object_is_found_with_its_ends_direction_and_rate(towards: float, px: float) -> None:
    exposure = 0.5
    motion = motion_across(_PLACE, px / _FOCAL, towards)
    report, path = _see(motion, 4.0, exposure=exposure)
    found = _only(report)
    np.testing.assert_allclose(found.endpoints, path[[0, -1]], atol=0.5)
    # The image does not show which end of a streak was exposed first. The reported order gives the smaller
    # rate, and the rate for the other order is reported too.
    assert found.relative_rate == pytest.approx(px / _FOCAL / exposure, rel=0.02)
    assert found.other_relative_rate > found.relative_rate
    np.testing.assert_allclose(found.direction, [np.cos(towards), np.sin(towards)], atol=0.03)
    assert "residual" in found.fired


@pytest.mark.parametrize("theta_deg", [60.0, 90.0])
def test_a_tracked_object_is_a_point_that_moves_among_the_stars(theta_deg: float) -> None:
    rotation = rate_at(np.deg2rad(theta_deg), 50.0 / _FOCAL / np.sin(np.deg2rad(theta_deg)), 0.9)
    report, path = _see(rotation, 6.0, rotation=rotation)
    found = _only(report)
    np.testing.assert_allclose(found.endpoints, path[[0, -1]], atol=0.3)
    assert set(found.fired) == {"displacement", "residual"}
    # Stars move by -omega x v. The object moves in the opposite direction, at the camera's rate.
    star = -np.cross(rotation, _PLACE)
    assert found.relative_rate == pytest.approx(np.linalg.norm(star), rel=0.02)
    np.testing.assert_allclose(found.direction, -star[:2] / np.linalg.norm(star[:2]), atol=0.05)


def test_a_saturated_tracked_object_is_found() -> None:
    found = _only(_see(_ROTATION, 4.0)[0])
    np.testing.assert_allclose(found.endpoints.mean(axis=0), [270.0, 230.0], atol=0.5)


def test_time_reversal_reverses_all_motions() -> None:
    motion = motion_across(_PLACE, 60.0 / _FOCAL, 2.4)
    path = object_path(_FRAME_CAMERA, _PLACE, motion, _ROTATION)
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 1.0, 5, [(path, 4.0)], _FAINTEST)
    forward, backward = _only(_detect(pixels, _ROTATION)), _only(_detect(pixels, -_ROTATION))
    # The fit of the ends stops when its steps are a fraction of the uncertainty of the ends.
    tenth = 0.1 * float(forward.sigma.min())
    np.testing.assert_allclose(backward.endpoints, forward.endpoints[::-1], atol=tenth)
    np.testing.assert_allclose(backward.direction, -forward.direction, atol=1e-4)
    assert backward.relative_rate == pytest.approx(forward.relative_rate, rel=1e-3)


def test_frames_without_an_object_have_none() -> None:
    for seed, theta_deg in enumerate((90.0, 30.0, 10.0)):
        theta = np.deg2rad(theta_deg)
        rotation = rate_at(theta, min(60.0 / _FOCAL / np.sin(theta), 0.2), 0.7 * seed)
        report = _detect(frame_with(_FRAME_CAMERA, rotation, 1.0, 40 + seed, [], 7.0), rotation)
        assert report.objects == ()
        assert Verdict.OBJECT not in report.verdicts + report.crowded
        assert report.verdicts.count(Verdict.STAR) >= 4


# Offset (px) of a second star along and across the streak of the first star, which has 55 px, and magnitude
# of the second star.
@pytest.mark.parametrize(
    ("along", "across", "magnitude"),
    [
        (28.0, 0.0, 4.5),
        (40.0, 0.0, 3.6),
        (0.0, 2.5, 4.0),
        (30.0, 3.0, 4.0),
        (54.0, 1.0, 4.3),
        (10.0, -4.0, 4.6),
    ],
)
def test_overlapping_streaks_of_two_stars_are_not_reported_as_an_object(
    along: float, across: float, magnitude: float
) -> None:
    directions, magnitudes = star_field(_FRAME_CAMERA, 5, _FAINTEST)
    star = -np.cross(_ROTATION, _PLACE)[:2]
    way = star / np.linalg.norm(star)
    second = np.array([270.0, 230.0]) + along * way + across * np.array([-way[1], way[0]])
    both = np.stack([_PLACE, _FRAME_CAMERA.pinhole.unit_vectors(second[None])[0]])
    directions = np.concatenate([directions, both])
    magnitudes = np.append(magnitudes, [4.0, magnitude])
    image = expose(_FRAME_CAMERA, directions, magnitudes, _ROTATION, 1.0)
    report = _detect(read_out(_FRAME_CAMERA, image, 1.0, np.random.default_rng(6)), _ROTATION)
    assert report.objects == ()
    # The pixels show that the region is a blend, so at least one verdict is STARS or UNCLEAR.
    assert {Verdict.STARS, Verdict.UNCLEAR} & set(report.verdicts + report.crowded)


@pytest.mark.parametrize("middle", [(270.0, 230.0), (20.0, 230.0)])
def test_an_object_that_crosses_a_star_is_found(middle: tuple[float, float]) -> None:
    """An object that crosses a star is found, even if the star's streak leaves the image."""
    place = _FRAME_CAMERA.pinhole.unit_vectors(np.array([middle]))[0]
    directions, magnitudes = star_field(_FRAME_CAMERA, 5, _FAINTEST)
    directions = np.concatenate([directions, place[None]])
    image = expose(_FRAME_CAMERA, directions, np.append(magnitudes, 4.0), _ROTATION, 1.0)
    star = -np.cross(_ROTATION, place)[:2]
    # In the image, the object moves perpendicularly to the path of the star.
    across = np.arctan2(star[0], -star[1])
    seen = object_path(
        _FRAME_CAMERA, place, _ROTATION + motion_across(place, 60.0 / _FOCAL, across), _ROTATION
    )
    add_object(image, _FRAME_CAMERA, seen, 3.5, 1.0)
    found = _only(_detect(read_out(_FRAME_CAMERA, image, 1.0, np.random.default_rng(7)), _ROTATION))
    error = min(np.abs(found.endpoints - ends).max() for ends in (seen[[0, -1]], seen[[-1, 0]]))
    assert error < 1.5
    assert found.fired == ()


@pytest.mark.parametrize("along", [8.0, 25.0])
@pytest.mark.parametrize("magnitude", [4.0, 6.0])
def test_a_tracked_object_on_a_star_s_streak_is_found(along: float, magnitude: float) -> None:
    """A tracked object on the streak of a star is found.

    The common region of the two objects is long, and saturated at magnitude 4.
    """
    directions, magnitudes = star_field(_FRAME_CAMERA, 5, _FAINTEST)
    directions = np.concatenate([directions, _PLACE[None]])
    image = expose(_FRAME_CAMERA, directions, np.append(magnitudes, 5.0), _ROTATION, 1.0)
    star = -np.cross(_ROTATION, _PLACE)[:2]
    way = star / np.linalg.norm(star)
    place = np.array([270.0, 230.0]) + along * way + 2.0 * np.array([-way[1], way[0]])
    direction = _FRAME_CAMERA.pinhole.unit_vectors(place[None])[0]
    add_object(
        image, _FRAME_CAMERA, object_path(_FRAME_CAMERA, direction, _ROTATION, _ROTATION), magnitude, 1.0
    )
    found = _only(_detect(read_out(_FRAME_CAMERA, image, 1.0, np.random.default_rng(7)), _ROTATION))
    np.testing.assert_allclose(found.endpoints, [place, place], atol=0.3)


def test_the_flashes_of_a_tumbling_object_are_one_object() -> None:
    """An object that flashes in three of five parts of its path is reported once, from end to end."""
    path = object_path(_FRAME_CAMERA, _PLACE, motion_across(_PLACE, 90.0 / _FOCAL, 0.3), _ROTATION)
    fifth = len(path) // 5
    flashes = [(path[k * fifth : (k + 1) * fifth], 4.0) for k in (0, 2, 4)]
    found = detect_objects(
        frame_with(_FRAME_CAMERA, _ROTATION, 1.0, 6, flashes, _FAINTEST),
        _FRAME_CAMERA.pinhole,
        _ROTATION,
        1.0,
        ObjectSettings(gain=_SETTINGS.gain, saturation=_SETTINGS.saturation),
    )
    assert len(found.objects) == 1
    ends = found.objects[0].endpoints
    missed = np.linalg.norm(ends[:, None] - path[[0, 5 * fifth - 1]], axis=2).min(axis=1)
    assert missed.max() < 1.0
    gap = 0.2 * float(np.linalg.norm(ends[1] - ends[0]))
    assert found.objects[0].sigma == pytest.approx(np.full(2, gap / math.sqrt(3.0)), rel=0.15)
    away = np.arccos(min(1.0, float(found.directions[0] @ _PLACE)))
    assert away < 3.0 * math.sqrt(0.5 * np.trace(found.covariance[0]))


def test_an_object_that_saturates_8_bits_is_found_without_a_stated_saturation() -> None:
    motion = motion_across(_PLACE, 25.0 / _FOCAL, 0.3)
    path = object_path(_FRAME_CAMERA, _PLACE, motion, _ROTATION)
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 1.0, 6, [(path, 2.0)], _FAINTEST)
    clipped = np.clip(np.rint(pixels / 8.0), 0, 255).astype(np.uint8)
    assert np.count_nonzero(clipped == 255) > 100
    for saturation in (None, 255.0):
        settings = ObjectSettings(gain=8.0, saturation=saturation)
        found = detect_objects(clipped, _FRAME_CAMERA.pinhole, _ROTATION, 1.0, settings)
        assert len(found.objects) == 1
        missed = np.linalg.norm(found.objects[0].endpoints[:, None] - path[[0, -1]], axis=2).min(axis=1)
        assert missed.max() < 0.5


def test_a_bright_star_whose_core_is_saturated_is_not_reported_as_an_object() -> None:
    directions, magnitudes = star_field(_FRAME_CAMERA, 5, _FAINTEST)
    directions = np.concatenate([directions, _PLACE[None]])
    image = expose(_FRAME_CAMERA, directions, np.append(magnitudes, 0.5), _ROTATION, 1.0)
    report = _detect(read_out(_FRAME_CAMERA, image, 1.0, np.random.default_rng(7)), _ROTATION)
    assert report.objects == ()


def test_a_segment_of_a_faint_star_is_not_reported_as_an_object() -> None:
    """A segment of a faint star is not reported as an object.

    At the segmentation threshold, a streak breaks into segments that together have the flux of the star.
    """
    directions, magnitudes = star_field(_FRAME_CAMERA, 5, 5.5)
    faint = np.concatenate([directions, _PLACE[None]])
    for seed in range(3):
        image = expose(_FRAME_CAMERA, faint, np.append(magnitudes, 7.9), _ROTATION, 1.0)
        pixels = read_out(_FRAME_CAMERA, image, 1.0, np.random.default_rng([8, seed]))
        assert _detect(pixels, _ROTATION).objects == ()


def test_a_frame_without_streaks_has_no_report() -> None:
    noise = np.rint(np.random.default_rng(9).normal(150.0, 12.0, (512, 512))).astype(np.uint16)
    assert detect(noise, _FRAME_CAMERA.pinhole, _ROTATION, 1.0, _SETTINGS, ObjectSettings()) is None
    found = detect_objects(noise, _FRAME_CAMERA.pinhole, _ROTATION, 1.0)
    assert not found
    assert found.reason == "fewer than 4 significant streaks"
    assert found.directions.shape == (0, 3)
    assert found.covariance.shape == (0, 3, 3)


@pytest.mark.parametrize(
    "lens",
    [_FRAME_CAMERA.pinhole, Lens(512, 512, _FOCAL, (262.0, 255.5), k1=-4.0, p1=0.05)],
    ids=["pinhole", "distorted by 7 %"],
)
def test_the_public_search_gives_the_direction_of_each_object_with_its_covariance(lens: CameraModel) -> None:
    exposure, camera = 0.5, dataclasses.replace(_FRAME_CAMERA, pinhole=streak_camera(lens))
    path = object_path(camera, _PLACE, motion_across(_PLACE, 25.0 / _FOCAL, 0.3), _ROTATION)
    pixels = frame_with(camera, _ROTATION, exposure, 5, [(path, 4.0)], _FAINTEST)
    settings = ObjectSettings(gain=_SETTINGS.gain, saturation=_SETTINGS.saturation)
    rate = _turn(pixels, _ROTATION, exposure, lens) / exposure
    found = detect_objects(pixels, lens, rate, exposure, settings)
    assert found
    assert found.reason == ""
    assert len(found.objects) == len(found.directions) == 1
    off = np.cross(found.directions[0], lens.unit_vectors(path[[0, -1]].mean(axis=0)[None])[0])
    sigma = found.objects[0].middle_sigma / lens.focal_length
    assert np.linalg.norm(off) < 3.5 * sigma < 1.0 / lens.focal_length
    spread = np.sort(np.linalg.eigvalsh(found.covariance[0]))
    assert spread == pytest.approx([0.0, sigma**2, sigma**2], abs=1e-20)
    with pytest.raises(ValueError, match="but the camera has"):
        detect_objects(pixels[1:], lens, _ROTATION, exposure)


@pytest.mark.parametrize(
    ("rate", "exposure", "message"),
    [
        (np.full(3, np.nan), 0.5, "rate: .*give finite"),
        (np.full(3, np.inf), 0.5, "rate: .*give finite"),
        (0.1, 0.5, "rate: an array of shape"),
        (_ROTATION, math.nan, "exposure: nan"),
        (_ROTATION, -1.0, "exposure: -1.0: give a positive"),
        (_ROTATION, 0.0, "exposure: 0.0"),
    ],
)
def test_the_public_search_refuses_a_wrong_rate_or_exposure(rate: Any, exposure: float, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        detect_objects(np.zeros((512, 512), np.uint16), _FRAME_CAMERA.pinhole, rate, exposure)


@pytest.mark.parametrize("turn", [1_000.0 * _ROTATION, np.array([0.0, 0.0, 3.2]), np.array([0.7, 0.0, 0.0])])
def test_a_rotation_that_leaves_no_star_in_the_image_is_answered_without_a_search(
    turn: FloatArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 1.0, 5, [], _FAINTEST)
    monkeypatch.setattr(detect_module, "detect", lambda *_: pytest.fail("the image was searched"))
    found = detect_objects(pixels, _FRAME_CAMERA.pinhole, turn, 1.0)
    assert not found
    assert "no star remains in the image" in found.reason
    assert found.directions.shape == (0, 3)


@pytest.mark.parametrize("wrong", [0.5, 1.3, 3.0, -2.0])
def test_a_wrong_rate_is_named_and_gives_no_false_objects(wrong: float) -> None:
    path = object_path(_FRAME_CAMERA, _PLACE, motion_across(_PLACE, 25.0 / _FOCAL, 0.3), _ROTATION)
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 0.5, 5, [(path, 4.0)], _FAINTEST)
    settings = ObjectSettings(gain=_SETTINGS.gain, saturation=_SETTINGS.saturation)
    rate = wrong * _turn(pixels, _ROTATION, 0.5) / 0.5
    found = detect_objects(pixels, _FRAME_CAMERA.pinhole, rate, 0.5, settings)
    assert found.objects == ()
    assert "the streaks deviate from the rate by" in found.reason


def test_tracks_of_cosmic_rays_are_named_as_a_cause_of_streaks_unlike_the_stars() -> None:
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 0.5, 5, [], _FAINTEST).astype(np.float64)
    rng, (rows, columns) = np.random.default_rng(3), pixels.shape
    for _ in range(60):
        along, angle = np.arange(0.0, 40.0, 0.5), rng.uniform(0.0, np.pi)
        x = rng.uniform(50.0, columns - 50.0) + along * np.cos(angle)
        y = rng.uniform(50.0, rows - 50.0) + along * np.sin(angle)
        np.add.at(pixels, (y.astype(int), x.astype(int)), 2000.0)
    settings = ObjectSettings(gain=_SETTINGS.gain, saturation=_SETTINGS.saturation)
    rate, whole = _ROTATION / 0.5, pixels.clip(0.0, 65_535.0).astype(np.uint16)
    found = detect_objects(whole, _FRAME_CAMERA.pinhole, rate, 0.5, settings)
    assert found.objects == ()
    assert "cosmic rays or hot columns" in found.reason
    agreeing = re.search(r"(\d+) of (\d+) agree", found.reason)
    assert agreeing is not None
    assert 4 <= int(agreeing[1]) < 0.5 * int(agreeing[2])


def test_the_public_search_accepts_numbers_of_every_type() -> None:
    path = object_path(_FRAME_CAMERA, _PLACE, motion_across(_PLACE, 25.0 / _FOCAL, 0.3), _ROTATION)
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 0.5, 5, [(path, 4.0)], _FAINTEST)
    settings = ObjectSettings(gain=_SETTINGS.gain, saturation=_SETTINGS.saturation)
    rate = _turn(pixels, _ROTATION, 0.5) / 0.5
    usual = detect_objects(pixels, _FRAME_CAMERA.pinhole, rate, 0.5, settings)
    for image in (pixels.astype(np.int32), pixels.astype(np.float32)):
        same = detect_objects(image, _FRAME_CAMERA.pinhole, rate, 0.5, settings)
        np.testing.assert_array_equal(same.directions, usual.directions)
    assert settings.saturation is not None
    scaled = dataclasses.replace(settings, gain=7.3 * settings.gain, saturation=settings.saturation / 7.3)
    found = detect_objects(pixels / 7.3, _FRAME_CAMERA.pinhole, rate, 0.5, scaled)
    assert found.objects[0].flux == pytest.approx(usual.objects[0].flux / 7.3, rel=0.05)
    np.testing.assert_allclose(found.directions, usual.directions, atol=0.3 / _FOCAL)


def test_an_object_below_the_required_significance_is_not_reported() -> None:
    path = object_path(_FRAME_CAMERA, _PLACE, motion_across(_PLACE, 60.0 / _FOCAL, 2.4), _ROTATION)
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 1.0, 5, [(path, 4.0)], _FAINTEST)
    deaf = dataclasses.replace(ObjectSettings(), improvement=1e9, crossing_improvement=1e9)
    report = detect(pixels, _FRAME_CAMERA.pinhole, _ROTATION, 1.0, _SETTINGS, deaf)
    assert report is not None
    assert report.objects == ()
    assert Verdict.UNCLEAR in report.verdicts + report.crowded


def test_the_report_can_be_sent_between_processes() -> None:
    report, _ = _see(motion_across(_PLACE, 60.0 / _FOCAL, 2.4), 4.0)
    copy = passed(report)
    np.testing.assert_array_equal(copy.objects[0].endpoints, report.objects[0].endpoints)


def test_pixels_that_cannot_be_solved_for_leave_the_streak_unclear(monkeypatch: pytest.MonkeyPatch) -> None:
    def give_up(*_: object, **__: object) -> None:
        raise KnightCubeError("the fit does not converge")

    monkeypatch.setattr("knightcube.vision.objects.star_light.brightnesses", give_up)
    report, _ = _see(motion_across(_PLACE, 60.0 / _FOCAL, 2.4), 4.0)
    assert report.objects == ()
    assert Verdict.UNCLEAR in report.verdicts


HELD: FloatArray = np.array([0.5, -0.1, 0.3, np.sqrt(0.65)])
MEETING = np.array([251.3, 262.8])
"""Position (px) at which the objects meet after 7 s."""
MOTIONS = np.array([[8.0, 2.0], [5.0, -5.5]])
"""Image motions (px/s), equal to 0.33 and 0.30 deg/s."""
MAGNITUDE = 4.5


def _looking_at(right_ascension_deg: float, declination_deg: float) -> FloatArray:
    """Return the attitude (4,) of a camera with a given boresight and north up."""
    right, up = np.radians([right_ascension_deg, declination_deg])
    sight = np.array([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)])
    east = np.array([-np.sin(right), np.cos(right), 0.0])
    return from_matrix(np.array([-east, np.cross(sight, -east), sight]))


def _places(since: FloatArray) -> FloatArray:
    """Return the positions (k, 2, 2), px, of both objects at times (k,), s, from their encounter."""
    return np.asarray(MEETING + since[:, None, None] * MOTIONS)


def test_two_equally_bright_objects_that_cross_keep_their_tracks() -> None:
    tracker, own = ObjectTracker(TrackSettings()), {}
    focal = CAMERA.pinhole.focal_length
    for second in range(15):
        ways = _places(second - 7.0 + TIMES)
        satellites = [
            SourceTrack(TIMES, CAMERA.pinhole.unit_vectors(ways[:, k]) @ attitude_matrix(HELD), MAGNITUDE)
            for k in range(2)
        ]
        sighted = run(frame_job(HELD, np.zeros(3), satellites, seed=second)).objects
        assert sighted is not None
        assert len(sighted.points) <= 2
        frame = sighted.directions, sighted.covariance, sighted.magnitudes, sighted.attitude
        tracker.ingest(FrameSightings(second * 1_000_000_000, *frame))
        true = CAMERA.pinhole.unit_vectors(_places(np.array([second - 7.0]))[0]) @ attitude_matrix(HELD)
        away = {
            track.number: focal * np.linalg.norm(true - track.line.direction, axis=1)
            for track in tracker.objects
        }
        own[second] = {number: int(off.argmin()) for number, off in away.items()}
        assert all(off.min() < 1.0 for off in away.values())
    assert own[14] == own[5]
    assert sorted(own[14].values()) == [0, 1]


@pytest.mark.parametrize(("right", "up"), [(-131.5, -72.95), (102.7, -39.5)])
@pytest.mark.parametrize("rate_deg", [0.0, 0.3])
def test_a_crowded_sky_at_rest_or_nearly_so_has_an_attitude(right: float, up: float, rate_deg: float) -> None:
    """A crowded sky at rest, or with streaks of up to 1.5 px, gives an attitude.

    In such frames, faint regions merge into long regions.
    """
    held = _looking_at(right, up)
    turn = np.array([0.0, np.radians(rate_deg), 0.0])
    found = run(frame_job(held, turn, []))
    assert found.motion.status is not StreakStatus.RATE
    assert found.solution is not None
    assert found.solution.fix is not None
    assert angle_between(found.solution.fix.quaternion, held) < 0.3 / CAMERA.pinhole.focal_length
    assert found.objects is not None
    assert not len(found.objects.points)
    assert EXPOSURE * turn[1] * CAMERA.pinhole.focal_length < 1.6


def test_a_star_is_explained_as_well_without_an_object_as_with_one() -> None:
    pixels = frame_with(_FRAME_CAMERA, _ROTATION, 1.0, 5, [], _FAINTEST)
    segmented = segment_frame(pixels, _SETTINGS)
    streaks = measure_streaks(segmented, _SETTINGS)
    turn = _turn(pixels, _ROTATION, 1.0)
    for ends in streaks.endpoints[:3]:
        light = StarLight(segmented, ends, turn, _FRAME_CAMERA.pinhole, 1.0, 1.0, np.inf)
        found = light.explain(ends)
        assert found.chi_square <= light.chi_square
        assert found.misfit <= found.misfit_of_stars * 1.05
        assert found.misfit_of_stars < 2.5
        assert light.chi_square < 2.5 * light.pixels


def test_a_line_that_another_star_continues_may_begin_a_star() -> None:
    """A segment is accepted as a part of a star's streak although another star's streak continues it.

    Two star streaks on one line overlap by a fifth of their length.
    """
    pinhole = _FRAME_CAMERA.pinhole
    image = np.zeros((512, 512))
    first, second = star_paths(np.stack([_PLACE] * 2), _ROTATION, np.array([0.5, -0.3]), pinhole)
    for path in (first, second):
        add_object(image, _FRAME_CAMERA, path, 3.0, 0.5)
    pixels = read_out(_FRAME_CAMERA, image, 0.5, np.random.default_rng(3))
    segmented = segment_frame(pixels, _SETTINGS)
    judge = Judge(segmented, _ROTATION, pinhole, 0.5, _SETTINGS, ObjectSettings())
    part = 2 * len(first) // 3
    flux = part / len(first) * _FRAME_CAMERA.zero_magnitude * 10.0**-1.2 * 0.5
    assert judge.begins_a_star(first[[0, part]], flux)
    assert not judge.begins_a_star(first[[0, part]], 4.0 * flux)
    assert not judge.begins_a_star(first[[0, part]] + np.array([[0.0, 0.0], [4.0, -4.0]]), flux)


def test_a_spot_among_streaks_is_a_short_region_in_its_place() -> None:
    """A spot among streaks is a short region at its true position.

    Both the spot and the box of its region are far from the left and upper borders of the frame.
    """
    rng = np.random.default_rng(4)
    image = rng.normal(100.0, 2.0, (200, 300))
    rows, columns = np.mgrid[:200, :300]
    image += 400.0 * np.exp(-0.5 * ((columns - 171.3) ** 2 + (rows - 82.6) ** 2))
    segmented = segment_frame(image, _SETTINGS)
    ends, sigma, label = short_regions(
        segmented, _ROTATION, _FRAME_CAMERA.pinhole, _SETTINGS, ObjectSettings()
    )
    assert ends.shape == (1, 2, 2)
    np.testing.assert_allclose(ends[0], [[171.3, 82.6]] * 2, atol=0.2)
    assert sigma == pytest.approx(np.array([1.0]), abs=0.5)
    assert segmented.regions.labels[83, 171] == label[0]


def test_all_forms_find_the_same_light_beside_a_path() -> None:
    draw = np.random.default_rng(2)
    region = draw.integers(0, 60, (200, 2))
    ends = np.array([[10.0, 20.0], [45.0, 38.0]])
    for half, reach in (([0.0, 0.0], 3.0), ([1.5, -3.0], 6.0), ([0.0, 0.0], 100.0)):
        assert_forms_agree(_light_beside, region, draw.uniform(0.0, 9.0, 200), ends, np.array(half), reach)
    assert_forms_agree(_light_beside, region, np.ones(200), ends[[0, 0]], np.zeros(2), 2.0)


def test_light_beside_the_path_of_a_star_is_that_of_pixels_beyond_the_reach() -> None:
    """The path of the star is a parabola through both ends, here sampled finely."""
    draw = np.random.default_rng(3)
    region, light = draw.integers(0, 60, (300, 2)), draw.uniform(1.0, 9.0, 300)
    ends, half = np.array([[10.0, 20.0], [45.0, 38.0]]), np.array([1.5, -3.0])
    part = np.linspace(0.0, 1.0, 4001)[:, None]
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    bend = half - (half @ along) * along
    path = ends[0] + part * (ends[1] - ends[0]) + 4.0 * part * (1.0 - part) * bend
    distance = np.linalg.norm(region[:, None] - path, axis=2).min(axis=1)
    clear = np.abs(distance - 6.0) > 0.4
    count, other = _light_beside(region[clear], light[clear], ends, half, 6.0)
    assert count == np.count_nonzero(distance[clear] > 6.0)
    assert other == pytest.approx(light[clear][distance[clear] > 6.0].sum())


def _judge(objects: ObjectSettings | None = None) -> Judge:
    frame = np.random.default_rng(1).normal(400.0, 10.0, (512, 512)).astype(np.uint16)
    segmented = segment_frame(frame, _SETTINGS)
    return Judge(segmented, _ROTATION, _FRAME_CAMERA.pinhole, 2.0, _SETTINGS, objects or ObjectSettings())


def _light(**values: Any) -> Any:
    usual: dict[str, Any] = {"chi_square": 5000.0, "pixels": 1000, "expected": 900.0}
    return SimpleNamespace(**(usual | values))


@pytest.mark.parametrize(
    ("gained", "remains", "misfit", "of_stars", "uniform", "expected"),
    [
        (600.0, 1000.0, 1.2, 5.0, False, True),
        (599.0, 1000.0, 1.2, 5.0, False, False),
        (600.0, 1799.0, 1.2, 5.0, False, True),
        (600.0, 1801.0, 1.2, 5.0, False, False),
        (600.0, 1000.0, 2.4, 4.9, False, True),
        (600.0, 1000.0, 2.5, 4.9, False, False),
        (600.0, 1000.0, 2.4, 4.7, False, False),
        (600.0, 149.0, 2.4, 2.5, True, True),
        (600.0, 149.0, 2.4, 2.5, False, False),
        (600.0, 151.0, 2.4, 2.5, True, False),
        (600.0, 1000.0, 3.9, 40.0, False, True),
        (600.0, 1000.0, 4.1, 40.0, False, False),
    ],
)
def test_an_object_decreases_chi_square_and_explains_its_pixels(
    gained: float, remains: float, misfit: float, of_stars: float, uniform: bool, expected: bool
) -> None:
    """An object decreases chi-square, fits twice as well as stars, and explains most remaining light."""
    light = _light(chi_square=900.0 + remains + gained)
    found = Explanation(900.0 + remains, remains, misfit, of_stars, 1e4)
    assert _judge()._is_object(light, found, 600.0, uniform) == expected


@pytest.mark.parametrize(("uniform", "unexplained"), [(True, 1700.0), (True, 1900.0), (False, 1700.0)])
def test_light_in_other_regions_does_not_count_for_a_uniform_streak(
    uniform: bool, unexplained: float
) -> None:
    light = _light(chi_square=6500.0)
    found = Explanation(5900.0, unexplained, 1.0, 2.5, 1e4)
    assert _judge()._is_object(light, found, 600.0, uniform) == (uniform and unexplained < 1800.0)


@pytest.mark.parametrize(
    ("chi_square", "unexplained", "misfit", "found"),
    [
        (3299.0, 2399.0, 1.3, True),
        (3301.0, 2399.0, 1.3, False),
        (3301.0, 2399.0, 1.1, True),
        (3301.0, 2401.0, 1.1, False),
    ],
)
def test_beside_bright_regions_only_a_uniform_streak_is_an_object(
    chi_square: float, unexplained: float, misfit: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The light that remains is compared with the decrease of chi-square by the object, which is 600."""
    ends = np.array([[60.0, 80.0], [300.0, 250.0]])
    rough = Explanation(chi_square, unexplained, 1.0, 9.0, 1e4)
    light = _light(chi_square=chi_square + 600.0, explain=lambda _: rough)
    located = LocatedEnds(ends, np.ones(2), misfit), light, rough
    monkeypatch.setattr(Judge, "_located", lambda *_: located)
    assert (_judge()._candidate(ends, (), light, (), 600.0) is not None) == found


def test_stars_explain_pixels_with_a_small_chi_square() -> None:
    judge = _judge()
    assert judge._only_stars(_light(chi_square=1299.0), 300.0)
    assert not judge._only_stars(_light(chi_square=1301.0), 300.0)
    assert judge._only_stars(_light(chi_square=2499.0), 1600.0)
    assert not judge._only_stars(_light(chi_square=2501.0), 1600.0)
    assert judge._stars_or_unclear(_light(chi_square=2500.0)).verdict is Verdict.STARS
    assert judge._stars_or_unclear(_light(chi_square=2501.0)).verdict is Verdict.UNCLEAR


def test_a_streak_with_the_ends_of_a_star_moves_like_a_star() -> None:
    ends = true_endpoints(_FRAME_CAMERA, _PLACE[None], _ROTATION)[0]
    judge = _judge()
    for within in (1.0, 2.0):
        for way in (ends, ends[::-1]):
            assert judge._moves_like_a_star(way, within)
        off = ends + np.array([[0.0, 0.0], [2.2 * within, 0.0]])
        assert not judge._moves_like_a_star(off, within)
        near = ends + np.array([[0.0, 0.0], [0.9 * within, 0.0]])
        assert judge._moves_like_a_star(near, within)


def test_the_motion_among_the_stars_is_that_without_the_rotation() -> None:
    """The ends of a star's streak do not move among the stars, another point moves by its distance."""
    judge = _judge()
    ends = true_endpoints(_FRAME_CAMERA, _PLACE[None], _ROTATION)[0]
    rate, _ = judge._among_stars(ends)
    assert rate == pytest.approx(0.0, abs=1e-9)
    still = dataclasses.replace(judge, rotation=np.zeros(3))
    middle = np.array(_FRAME_CAMERA.pinhole.centre)
    rate, direction = still._among_stars(np.array([middle, middle + np.array([3.0, -4.0])]))
    assert rate == pytest.approx(np.arctan(5.0 / _FOCAL) / 2.0)
    assert direction == pytest.approx([0.6, -0.8], abs=1e-6)


@pytest.mark.parametrize(
    ("fired", "gain", "few", "candidate", "verdict"),
    [
        (False, 0.0, 5000.0, False, Verdict.STAR),
        (True, 299.0, 1200.0, False, Verdict.STARS),
        (True, 299.0, 1400.0, False, Verdict.STARS),
        (True, 299.0, 2600.0, False, Verdict.UNCLEAR),
        (True, 301.0, 2600.0, True, Verdict.OBJECT),
        (True, 301.0, 2600.0, False, Verdict.UNCLEAR),
        (True, 301.0, 2400.0, False, Verdict.STARS),
    ],
)
def test_a_streak_is_classified_by_its_pixels_if_an_indicator_fires(
    fired: bool,
    gain: float,
    few: float,
    candidate: bool,
    verdict: Verdict,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found: Any = SimpleNamespace(flux=1.0) if candidate else None
    light = _light(chi_square=few, chi_square_with=lambda _: few - gain)
    monkeypatch.setattr(Judge, "_light", lambda *_, **__: light)
    monkeypatch.setattr(Judge, "_candidate", lambda *_: found)
    judged = _judge().streak(np.zeros((2, 2)), ("centre",) if fired else ())
    assert judged.verdict is verdict
    assert judged.candidate is found
    # The light of a region that stars explain partly is kept, so that the rest of the region is searched.
    assert (judged.light is light) == (verdict in {Verdict.STARS, Verdict.UNCLEAR})


def test_a_region_with_many_corners_is_unclear_and_one_with_a_line_may_be_an_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    corners = np.array([[100.0, 100.0], [140.0, 110.0], [120.0, 150.0]])
    asked: list[FloatArray] = []

    def with_line(ends: FloatArray) -> float:
        asked.append(ends)
        return 2000.0 if np.abs(ends - corners[[0, 2]]).max() < 1.0 else 4000.0

    found: Any = SimpleNamespace(flux=1.0)
    light = _light(chi_square=5000.0, chi_square_with=with_line)
    monkeypatch.setattr(Judge, "_light", lambda *_, **__: light)
    tested: list[FloatArray] = []

    def candidate(_: Judge, ends: FloatArray, *__: object) -> Any:
        tested.append(ends)
        return found

    monkeypatch.setattr(Judge, "_candidate", candidate)
    judge = _judge()
    judged = judge.crowd(corners)
    assert judged.verdict is Verdict.OBJECT
    assert judged.candidate is found
    assert len(asked) == 3
    # The line is extended beyond both corners by the bias of the corner detector.
    outward = (corners[0] - corners[2]) / np.linalg.norm(corners[0] - corners[2])
    bias = _SETTINGS.endpoint_bias
    assert tested[0] == pytest.approx(np.array([corners[0] + bias * outward, corners[2] - bias * outward]))
    assert judge.crowd(np.tile(corners, (3, 1))[:7]).verdict is Verdict.UNCLEAR
    near = corners[0] + np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 4.0]])
    assert judge.crowd(near).verdict is Verdict.UNCLEAR
    monkeypatch.setattr(Judge, "_candidate", lambda *_: None)
    assert judge.crowd(corners).verdict is Verdict.UNCLEAR
    small = _light(chi_square=1590.0, chi_square_with=with_line)
    monkeypatch.setattr(Judge, "_light", lambda *_, **__: small)
    assert judge.crowd(corners).verdict is Verdict.STARS


@pytest.mark.parametrize(
    ("first", "sigma", "known"),
    [
        ((60.0, 80.0), 0.5, True),
        ((60.0, 80.0), 2.9, True),
        ((60.0, 80.0), 3.1, False),
        ((1.6, 80.0), 0.5, True),
        ((1.4, 80.0), 0.5, False),
        ((60.0, 510.0), 0.5, False),
    ],
)
def test_an_object_has_accurate_ends_inside_the_image(
    first: tuple[float, float], sigma: float, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A streak that the border truncates, or whose ends are vague, may belong to two stars."""
    ends = np.array([first, (300.0, 250.0)])
    found = LocatedEnds(ends, np.array([0.2, sigma]), 1.0)
    fitted = Explanation(900.0, 0.0, 1.0, 9.0, 1e4)
    light = _light(located=lambda *_: found, explain=lambda _: fitted)
    monkeypatch.setattr(Judge, "_light", lambda *_: light)
    located = _judge()._located(ends, light, (), 600.0)
    assert (located is not None) == known


@pytest.mark.parametrize(
    ("alone", "beside_stars", "reported"),
    [
        (1.3, None, 1.3),
        (1.5, None, None),
        (1.5, 1.2, 1.2),
        (1.5, 1.6, 1.5),
        (None, None, None),
        (None, 1.2, 1.2),
    ],
)
def test_a_poorly_fitted_object_is_reported_only_if_it_remains_beside_fitted_stars(
    alone: float | None, beside_stars: float | None, reported: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = np.array([[60.0, 80.0], [300.0, 250.0]])

    def located(_: Judge, __: FloatArray, light: Any, stars: list[FloatArray], ___: float) -> Any:
        misfit = beside_stars if stars else alone
        if misfit is None:
            return None
        return LocatedEnds(ends, np.ones(2), misfit), light, Explanation(900.0, 0.0, misfit, 9.0, misfit)

    light = _light(explain=lambda _: Explanation(900.0, 0.0, 1.0, 9.0, 1e4))
    judge = _judge()
    own = dataclasses.replace(judge.segmented.regions, label=np.array([7]))
    judge = dataclasses.replace(judge, segmented=dataclasses.replace(judge.segmented, regions=own))
    monkeypatch.setattr(Judge, "_located", located)
    monkeypatch.setattr(Judge, "_light", lambda *_: light)
    monkeypatch.setattr(Judge, "_patch", lambda *_: None)
    monkeypatch.setattr(detect_module, "region_along", lambda *_: 7)
    monkeypatch.setattr(detect_module, "fit_stars", lambda *_: ([ends], None))
    found = judge._candidate(ends, (), light, (), 600.0)
    assert (None if found is None else found.flux) == reported


def test_light_that_stars_do_not_explain_is_searched() -> None:
    judge = _judge()
    limit = judge.objects.crossing_improvement
    for excess, explained in ((limit - 1.0, True), (limit + 1.0, False)):
        light = _light(excess=lambda _, excess=excess: excess)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Judge, "_pixels_of", lambda *_: np.zeros((0, 2), np.int64))
            one = detect_module.Judgement(Verdict.STARS, light=light)
            assert judge.explained(one, 3) == explained
    assert not judge.explained(detect_module.Judgement(Verdict.STAR), 3)
