"""Objects among the stars: found when they are there, quiet when they are not, overlaps told apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects.detect import ObjectReport, SpaceObject, Verdict, detect
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.settings import LikelihoodSettings
from tests.flight.loop.executive.passing import passed
from tests.knightcube.vision.objects.space_objects import (
    add_object,
    frame_with,
    motion_across,
    object_path,
    star_field,
)
from tests.knightcube.vision.streaks.frames import expose, rate_at, read_out, star_camera

_CAMERA = star_camera(512)
_FOCAL = _CAMERA.pinhole.focal_length
_SETTINGS = StreakSettings(saturation=_CAMERA.full_well)
_ROTATION = rate_at(np.deg2rad(60.0), 55.0 / _FOCAL, 0.4)
_PLACE = _CAMERA.pinhole.unit_vectors(np.array([[270.0, 230.0]]))[0]
_FAINTEST = 6.0


def _detect(pixels: FloatArray, rotation: FloatArray, exposure: float = 1.0) -> ObjectReport:
    found = _turn(pixels, rotation, exposure)
    report = detect(pixels, _CAMERA.pinhole, found, exposure, _SETTINGS, ObjectSettings())
    assert report is not None
    return report


def _turn(pixels: FloatArray, rotation: FloatArray, exposure: float) -> FloatArray:
    """Return the rotation that the likelihood finds; the true one decides its sign."""
    settings = LikelihoodSettings(saturation=_SETTINGS.saturation, gain=_SETTINGS.gain)
    found = estimate_motion(pixels, _CAMERA.pinhole, exposure, settings, rotation / exposure, 0.0)
    assert found.rate is not None
    return np.asarray(found.rate * exposure)


def _see(
    motion: FloatArray,
    magnitude: float,
    seed: int = 5,
    rotation: FloatArray = _ROTATION,
    exposure: float = 1.0,
) -> tuple[ObjectReport, FloatArray]:
    """Return what is found in a frame with one object, and its true path in the image."""
    path = object_path(_CAMERA, _PLACE, motion, rotation)
    pixels = frame_with(_CAMERA, rotation, exposure, seed, [(path, magnitude)], _FAINTEST)
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
    # The ends' order is the one of slower motion; both rates are told.
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
    # Against the stars, which go as -omega x v: the object goes the other way at the camera's own rate.
    star = -np.cross(rotation, _PLACE)
    assert found.relative_rate == pytest.approx(np.linalg.norm(star), rel=0.02)
    np.testing.assert_allclose(found.direction, -star[:2] / np.linalg.norm(star[:2]), atol=0.05)


def test_a_saturated_tracked_object_is_found() -> None:
    found = _only(_see(_ROTATION, 4.0)[0])
    np.testing.assert_allclose(found.endpoints.mean(axis=0), [270.0, 230.0], atol=0.5)


def test_with_time_reversed_everything_moves_the_other_way() -> None:
    motion = motion_across(_PLACE, 60.0 / _FOCAL, 2.4)
    path = object_path(_CAMERA, _PLACE, motion, _ROTATION)
    pixels = frame_with(_CAMERA, _ROTATION, 1.0, 5, [(path, 4.0)], _FAINTEST)
    forward, backward = _only(_detect(pixels, _ROTATION)), _only(_detect(pixels, -_ROTATION))
    np.testing.assert_allclose(backward.direction, -forward.direction, atol=1e-9)
    np.testing.assert_allclose(backward.endpoints, forward.endpoints[::-1])
    assert backward.relative_rate == pytest.approx(forward.relative_rate)


def test_frames_without_an_object_have_none() -> None:
    for seed, theta_deg in enumerate((90.0, 30.0, 10.0)):
        theta = np.deg2rad(theta_deg)
        rotation = rate_at(theta, min(60.0 / _FOCAL / np.sin(theta), 0.2), 0.7 * seed)
        report = _detect(frame_with(_CAMERA, rotation, 1.0, 40 + seed, [], 7.0), rotation)
        assert report.objects == ()
        assert Verdict.OBJECT not in report.verdicts + report.crowded
        assert report.verdicts.count(Verdict.STAR) >= 4


# A second star so many px along and across the first one's streak of 55 px, and its magnitude.
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
def test_overlapping_streaks_of_two_stars_are_no_object(
    along: float, across: float, magnitude: float
) -> None:
    directions, magnitudes = star_field(_CAMERA, 5, _FAINTEST)
    star = -np.cross(_ROTATION, _PLACE)[:2]
    way = star / np.linalg.norm(star)
    second = np.array([270.0, 230.0]) + along * way + across * np.array([-way[1], way[0]])
    both = np.stack([_PLACE, _CAMERA.pinhole.unit_vectors(second[None])[0]])
    directions = np.concatenate([directions, both])
    magnitudes = np.append(magnitudes, [4.0, magnitude])
    image = expose(_CAMERA, directions, magnitudes, _ROTATION, 1.0)
    report = _detect(read_out(_CAMERA, image, 1.0, np.random.default_rng(6)), _ROTATION)
    assert report.objects == ()
    # It was noticed, not overlooked: some region is stars, or unclear, by its pixels.
    assert {Verdict.STARS, Verdict.UNCLEAR} & set(report.verdicts + report.crowded)


def test_an_object_that_crosses_a_star_is_found() -> None:
    directions, magnitudes = star_field(_CAMERA, 5, _FAINTEST)
    directions = np.concatenate([directions, _PLACE[None]])
    image = expose(_CAMERA, directions, np.append(magnitudes, 4.0), _ROTATION, 1.0)
    star = -np.cross(_ROTATION, _PLACE)[:2]
    # In the image it goes straight across the star's own path.
    across = np.arctan2(star[0], -star[1])
    seen = object_path(_CAMERA, _PLACE, _ROTATION + motion_across(_PLACE, 60.0 / _FOCAL, across), _ROTATION)
    add_object(image, _CAMERA, seen, 3.5, 1.0)
    found = _only(_detect(read_out(_CAMERA, image, 1.0, np.random.default_rng(7)), _ROTATION))
    error = min(np.abs(found.endpoints - ends).max() for ends in (seen[[0, -1]], seen[[-1, 0]]))
    assert error < 1.5
    assert found.fired == ()


@pytest.mark.parametrize("along", [8.0, 25.0])
@pytest.mark.parametrize("magnitude", [4.0, 6.0])
def test_a_tracked_object_on_a_star_s_streak_is_found(along: float, magnitude: float) -> None:
    """The region of the two is long, and saturated at magnitude 4."""
    directions, magnitudes = star_field(_CAMERA, 5, _FAINTEST)
    directions = np.concatenate([directions, _PLACE[None]])
    image = expose(_CAMERA, directions, np.append(magnitudes, 5.0), _ROTATION, 1.0)
    star = -np.cross(_ROTATION, _PLACE)[:2]
    way = star / np.linalg.norm(star)
    place = np.array([270.0, 230.0]) + along * way + 2.0 * np.array([-way[1], way[0]])
    direction = _CAMERA.pinhole.unit_vectors(place[None])[0]
    add_object(image, _CAMERA, object_path(_CAMERA, direction, _ROTATION, _ROTATION), magnitude, 1.0)
    found = _only(_detect(read_out(_CAMERA, image, 1.0, np.random.default_rng(7)), _ROTATION))
    np.testing.assert_allclose(found.endpoints, [place, place], atol=0.3)


def test_a_bright_star_whose_core_is_saturated_is_no_object() -> None:
    directions, magnitudes = star_field(_CAMERA, 5, _FAINTEST)
    directions = np.concatenate([directions, _PLACE[None]])
    image = expose(_CAMERA, directions, np.append(magnitudes, 0.5), _ROTATION, 1.0)
    report = _detect(read_out(_CAMERA, image, 1.0, np.random.default_rng(7)), _ROTATION)
    assert report.objects == ()


def test_a_piece_of_a_faint_star_is_no_object() -> None:
    """At the limit of segmentation a streak falls into pieces; their light is a star's."""
    directions, magnitudes = star_field(_CAMERA, 5, 5.5)
    faint = np.concatenate([directions, _PLACE[None]])
    for seed in range(3):
        image = expose(_CAMERA, faint, np.append(magnitudes, 7.9), _ROTATION, 1.0)
        pixels = read_out(_CAMERA, image, 1.0, np.random.default_rng([8, seed]))
        assert _detect(pixels, _ROTATION).objects == ()


def test_a_frame_without_streaks_has_no_report() -> None:
    noise = np.rint(np.random.default_rng(9).normal(150.0, 12.0, (512, 512))).astype(np.uint16)
    assert detect(noise, _CAMERA.pinhole, _ROTATION, 1.0, _SETTINGS, ObjectSettings()) is None


def test_an_object_weaker_than_asked_is_not_called_one() -> None:
    path = object_path(_CAMERA, _PLACE, motion_across(_PLACE, 60.0 / _FOCAL, 2.4), _ROTATION)
    pixels = frame_with(_CAMERA, _ROTATION, 1.0, 5, [(path, 4.0)], _FAINTEST)
    deaf = dataclasses.replace(ObjectSettings(), improvement=1e9, crossing_improvement=1e9)
    report = detect(pixels, _CAMERA.pinhole, _ROTATION, 1.0, _SETTINGS, deaf)
    assert report is not None
    assert report.objects == ()
    assert Verdict.UNCLEAR in report.verdicts + report.crowded


def test_the_report_travels_between_processes() -> None:
    report, _ = _see(motion_across(_PLACE, 60.0 / _FOCAL, 2.4), 4.0)
    copy = passed(report)
    np.testing.assert_array_equal(copy.objects[0].endpoints, report.objects[0].endpoints)


def test_pixels_that_cannot_be_solved_for_leave_the_streak_unclear(monkeypatch: pytest.MonkeyPatch) -> None:
    def give_up(*_: object, **__: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr("knightcube.vision.objects.star_light.nnls", give_up)
    report, _ = _see(motion_across(_PLACE, 60.0 / _FOCAL, 2.4), 4.0)
    assert report.objects == ()
    assert Verdict.UNCLEAR in report.verdicts
