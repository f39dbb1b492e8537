"""Tests of the identification of frames in which few stars are detected, from the light of faint stars."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.vision.camera.lens import CameraModel, Lens, Pinhole
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.attitude_fit import StarField
from knightcube.vision.startracker.detect import Detections, detect
from knightcube.vision.startracker.faint_stars import (
    _LEVELS,
    FrameLight,
    LightMatch,
    _evidence,
    _Search,
    match_by_light,
)
from knightcube.vision.startracker.solve import (
    FrameSolution,
    SolveSettings,
    SolveStatus,
    solve_faint,
    solve_points,
    star_field,
)
from knightcube.vision.startracker.survey import FrameKind
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.startracker.frames import NARROW, SkyFrame, sky, sky_frame
from tests.support.compiled_forms import assert_forms_agree

_EXPOSURE = 0.0012
_FIXED = 1.0, 1.0
_CHI_SQUARE_3_DOF_1E_6 = 30.7


@cache
def _dim_frame(seed: int) -> SkyFrame:
    """Return a frame of such a short exposure that in most frames too few stars are detected."""
    return sky_frame(np.random.default_rng([39, seed]), 0.0, _EXPOSURE)


def _field(found: Detections, scale: tuple[float, float] = _FIXED) -> StarField:
    camera: CameraModel = NARROW.pinhole
    seen = FrameSolution(SolveStatus.NO_STARS, "", FrameKind.POINTS, camera, found.points, found.covariance)
    return star_field(seen, found.flux, scale)


def test_frames_with_too_few_detected_stars_are_answered_and_the_answers_are_right() -> None:
    alone = answered = 0
    for seed in range(16):
        frame = _dim_frame(seed)
        given = NARROW.pinhole, _FIXED
        alone += solve_points(detect(frame.pixels).stars(), *given, sky(), SolveSettings()).fix is not None
        found = solve_frame(frame.pixels, *given, _EXPOSURE, sky(), SolveSettings())
        if found.fix is None:
            continue
        answered += 1
        error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(frame.attitude)))
        assert error @ np.linalg.solve(found.fix.covariance, error) < _CHI_SQUARE_3_DOF_1E_6
    assert alone <= 6
    assert answered >= alone + 5


@pytest.mark.parametrize("width", [0.1, math.nan])
def test_a_width_measured_in_few_stars_may_be_extreme(width: float) -> None:
    """A width beyond the range of the detection settings raises no exception."""
    frames = [_dim_frame(seed) for seed in range(16)]
    found = [replace(detect(frame.pixels).stars(), psf_sigma=width) for frame in frames]
    answers = [
        solve_faint(frame.pixels, one, NARROW.pinhole, _FIXED, sky(), SolveSettings())
        for frame, one in zip(frames, found, strict=True)
    ]
    assert any(answers)


def test_a_camera_unlike_the_assumed_one_gives_no_wrong_attitude() -> None:
    """The camera has wide stars, three hot spots, a nonlinear response, and clips noise at black."""
    camera = StarCameraModel(field_of_view=NARROW.field_of_view, psf_sigma=1.6)
    faint = 0
    for seed in range(16):
        generator = np.random.default_rng([77, seed])
        frame = sky_frame(generator, 0.0, 0.003, camera=camera)
        counts = frame.pixels.astype(float) - camera.pedestal
        for column, row in generator.integers(5, 1015, (3, 2)):
            spot = generator.uniform(60.0, 300.0) * np.outer([0.5, 1.0, 0.5], [0.5, 1.0, 0.5])
            counts[row - 1 : row + 2, column - 1 : column + 2] += spot
        counts = np.sign(counts) * np.abs(counts) ** 0.85
        pixels = np.clip(np.rint(counts / 6.0), 0.0, 255.0).astype(np.uint8)
        found = solve_frame(pixels, camera.pinhole, _FIXED, 0.003, sky(), SolveSettings())
        if found.fix is not None:
            faint += found.faint
            error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(frame.attitude)))
            assert error @ np.linalg.solve(found.fix.covariance, error) < _CHI_SQUARE_3_DOF_1E_6
    assert faint >= 2


def test_the_light_of_a_sky_that_is_not_the_catalogue_s_matches_no_attitude() -> None:
    """Fields with left and right swapped are not in the catalogue; the bound stays near one or above."""
    lowest = 0.0
    for seed in range(8):
        pixels = np.ascontiguousarray(_dim_frame(seed).pixels[:, ::-1])
        found = match_by_light(
            _field(detect(pixels).stars()), sky(), FrameLight.of(pixels, NARROW.pinhole), 1.0
        )
        lowest = min(lowest, 0.0 if found is None else found.log10_chance)
    assert lowest > -1.5


def test_the_mean_likelihood_ratio_at_random_positions_is_not_above_one() -> None:
    light = FrameLight.of(_dim_frame(0).pixels, NARROW.pinhole)
    count = np.bincount(light.level.ravel(), minlength=_LEVELS + 1)[:_LEVELS]
    mean = np.exp(light.log_ratio[:, :_LEVELS]) @ (count / count.sum())
    np.testing.assert_allclose(mean[:10], 1.0, atol=0.02)
    assert np.all(mean < 1.02)


def test_the_image_scale_is_found_within_its_range_and_a_wide_range_is_refused() -> None:
    frame = sky_frame(np.random.default_rng(40), 0.0, 0.003)
    light, found = FrameLight.of(frame.pixels, NARROW.pinhole), detect(frame.pixels).stars()
    near = match_by_light(_field(found, (0.98, 1.02)), sky(), light, -4.5)
    assert near is not None
    assert abs(near.scale - 1.0) < 0.002
    assert _pointing_error(near, frame) < 1e-3
    assert match_by_light(_field(found, (0.8, 1.2)), sky(), light, -4.5) is None
    assert match_by_light(_field(found.select(np.array([0]))), sky(), light, -4.5) is None


def _pointing_error(found: LightMatch, frame: SkyFrame) -> float:
    """Return the angle, rad, between the found and the true boresight."""
    return math.acos(min(1.0, float(found.matrix[2] @ attitude_matrix(frame.attitude)[2])))


def test_the_light_of_a_distorting_lens_is_at_the_positions_of_an_ideal_camera() -> None:
    ideal = NARROW.pinhole
    lens = Lens(ideal.columns, ideal.rows, ideal.focal_length, ideal.centre, k1=-1.5)
    pixels = np.full((ideal.rows, ideal.columns), 100, dtype=np.uint16)
    pixels += np.random.default_rng(1).integers(0, 5, pixels.shape, dtype=np.uint16)
    direction = ideal.unit_vectors(np.array([[80.0, 60.0], [900.0, 700.0]]))
    for column, row in np.rint(lens.project(direction)).astype(int):
        pixels[row, column] += 500
    light = FrameLight.of(pixels, lens)
    assert np.all(np.abs(lens.project(direction) - [[80.0, 60.0], [900.0, 700.0]]).max(axis=1) > 3.0)
    for column, row in np.rint(ideal.project(direction)).astype(int):
        assert light.level[row, column] == _LEVELS - 1


def test_a_narrow_strip_has_no_more_pairs_of_guide_stars_than_a_field(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A narrow strip needs more guide stars than a field, but the number of their pairs is limited."""
    monkeypatch.setattr("knightcube.vision.startracker.faint_stars._MOST_PAIRS", 1e5)
    strip = Pinhole(NARROW.pinhole.columns, 24, NARROW.pinhole.focal_length)
    pixels = np.random.default_rng(2).poisson(100.0, (24, strip.columns)).astype(np.uint16)
    points = np.array([[100.0, 12.0], [900.0, 12.0]])
    seen = FrameSolution(
        SolveStatus.NO_STARS, "", FrameKind.POINTS, strip, points, np.tile(np.eye(2), (2, 1, 1))
    )
    field = star_field(seen, np.array([1e4, 5e3]), _FIXED)
    search = _Search(field, sky(), FrameLight.of(pixels, strip))
    assert 0.5e5 < len(search.guide.stars) < 1.2e5


@pytest.mark.parametrize("scale", [_FIXED, (0.99, 1.01)])
def test_all_forms_find_the_same_evidence(scale: tuple[float, float]) -> None:
    frame = _dim_frame(1)
    field, light = _field(detect(frame.pixels).stars(), scale), FrameLight.of(frame.pixels, NARROW.pinhole)
    search = _Search(field, sky(), light)
    pair, stars = next(search.pairs())
    assert_forms_agree(
        _evidence,
        field.direction[pair],
        *scale,
        sky().stars.direction,
        sky().stars.magnitude,
        stars[:300],
        search.guide.neighbours,
        5.0,
        NARROW.pinhole.focal_length,
        light.without(search.points[pair]),
        light.log_ratio,
    )
