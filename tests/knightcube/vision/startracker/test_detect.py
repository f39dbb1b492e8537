"""Tests of star detection: stars are found, measured to the bound, and distinguished from other points.

Further tests check the detection near predicted positions, and the brightest detections in photographs.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.detect import (
    Quality,
    _among_odd,
    _worth_measuring,
    confirmed,
    detect,
    measure_near,
)
from knightcube.vision.startracker.survey import DetectionSettings, FrameKind, Method, survey
from knightcube.vision.streaks.camera_motion import CameraMotion
from sim_hal.star_camera import StarCameraModel, render
from tests.knightcube.vision.streaks.scenes import real_sky
from tests.sim_hal.star_camera.scenes import at_pixels, still
from tests.support.centroid_bound import compare, frame_of, matched, point_bound, star_places
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_bound import star_information

SMALL = StarCameraModel(columns=320, rows=256, field_of_view=np.radians(6.25))
MIDDLE = np.array([[160.3, 128.2]])


def sky(rng: np.random.Generator, shape: tuple[int, int] = (256, 320)) -> FloatArray:
    return np.asarray(rng.normal(200.0, 10.0, shape))


def add_star(frame: FloatArray, x: float, y: float, flux: float, sigma: float = 1.0) -> None:
    row, column = np.indices(frame.shape)
    bell = np.exp(-0.5 * ((column - x) ** 2 + (row - y) ** 2) / sigma**2)
    frame += flux * bell / (2.0 * np.pi * sigma**2)


def counts(frame: FloatArray, top: int = 65_535) -> Image:
    return np.clip(np.rint(frame), 0, top).astype(np.uint16)


@pytest.mark.parametrize("psf_sigma", [0.7, 1.5])
def test_psf_fits_reach_the_bound_with_honest_errors(psf_sigma: float) -> None:
    row = compare(StarCameraModel(psf_sigma=psf_sigma), 6.0, "psf", 4, 99)
    assert row.found == row.stars
    assert row.ratio < 1.15
    assert 0.8 < row.nees < 1.25
    assert row.bias < 4.0 * row.bias_error


def test_saturated_stars_are_flagged_and_fitted_on_their_wings() -> None:
    camera = StarCameraModel()
    places = star_places(np.random.default_rng(3), camera.columns)
    found = detect(frame_of(camera, places, np.full(40, 3.0), [3])).stars()
    star, detection = matched(found, places)
    assert len(star) == 40
    assert np.all(found.quality[detection] & Quality.SATURATED)
    assert np.sqrt(np.mean((found.points[detection] - places[star]) ** 2)) < 0.01


def test_the_bound_of_a_point_is_that_of_a_streak_of_length_zero() -> None:
    camera = StarCameraModel(bits=16, full_well=1e6)
    place, electrons = np.array([500.3, 480.8]), 5000.0
    floor = camera.read_noise**2 + camera.dark_current * 0.2 + 1.0 / 12.0
    still_camera = CameraMotion.steady(np.zeros(3))
    whole = star_information(camera.pinhole, still_camera, place, electrons, camera.psf_sigma, floor)
    expected = np.linalg.inv(whole[3:, 3:])[1:3, 1:3]
    assert point_bound(camera, place, electrons) == pytest.approx(expected, rel=0.01, abs=1e-8)


@pytest.mark.parametrize("method", ["psf", "window"])
def test_errors_of_both_methods_are_honest(method: Method) -> None:
    row = compare(StarCameraModel(), 6.5, method, 3, 17)
    assert 0.7 < row.nees < 1.4


def test_stars_come_brightest_first_with_their_flux() -> None:
    places = np.array([[60.0, 60.0], [200.0, 80.0], [120.0, 190.0]])
    magnitudes = np.array([7.0, 5.5, 6.5])
    found = detect(frame_of(SMALL, places, magnitudes, [5])).stars()
    assert matched(found, places[[1, 2, 0]])[1][:3].tolist() == [0, 1, 2]
    electrons = np.asarray(SMALL.electrons(magnitudes[[1, 2, 0]], 0.2))
    assert np.all(np.abs(found.flux[:3] - electrons) < 5.0 * electrons / found.signal_to_noise[:3])
    assert found.background[:3] == pytest.approx(SMALL.pedestal + 0.2 * SMALL.dark_current, abs=10.0)


@pytest.mark.parametrize("unit", [1.0, 1e-4, 300.0])
def test_a_floating_frame_gives_the_same_places_in_any_unit(unit: float) -> None:
    frame = frame_of(SMALL, MIDDLE, np.array([5.5]), [7])
    whole, floating = detect(frame).stars(), detect(frame * unit).stars()
    assert floating.points[0] == pytest.approx(whole.points[0], abs=2e-3)
    assert floating.flux[0] / unit == pytest.approx(whole.flux[0], rel=0.01)


def test_eight_bits_are_enough() -> None:
    camera = StarCameraModel(
        columns=320, rows=256, field_of_view=np.radians(6.25), bits=8, gain=20.0, pedestal=5.0
    )
    found = detect(frame_of(camera, MIDDLE, np.array([5.0]), [8])).stars()
    assert np.abs(found.points[0] - MIDDLE[0]).max() < 4.0 * found.sigma[0] < 0.2


def test_hot_pixels_are_refused_and_stars_beside_them_kept() -> None:
    rng = np.random.default_rng(4)
    frame = sky(rng)
    add_star(frame, 100.0, 100.0, 4000.0)
    add_star(frame, 200.0, 60.0, 6000.0)
    hot = rng.integers(10, 240, (30, 2))
    frame[hot[:, 0], hot[:, 1]] += 900.0
    found = detect(counts(frame))
    assert matched(found.stars(), np.array([[100.0, 100.0], [200.0, 60.0]]))[0].tolist() == [0, 1]
    assert len(found.stars()) <= 4
    assert np.count_nonzero(found.quality & Quality.HOT) >= 26


def test_two_stars_that_overlap_are_both_measured_and_flagged() -> None:
    camera = StarCameraModel(psf_sigma=1.0)
    errors = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 21])
        alone = star_places(rng, camera.columns, 30)
        around = rng.uniform(0.0, 2.0 * np.pi, 12)
        second = alone[:12] + 4.0 * np.stack([np.cos(around), np.sin(around)], axis=-1)
        places = np.concatenate([alone[:12], second])
        everything = np.concatenate([places, alone[12:]])
        found = detect(frame_of(camera, everything, np.full(len(everything), 5.5), [seed, 22])).stars()
        star, detection = matched(found, places)
        assert len(star) >= 23
        assert np.mean((found.quality[detection] & Quality.BLENDED) > 0) > 0.9
        off = found.points[detection] - places[star]
        errors.append(np.sum(off**2, axis=1) / (2.0 * found.sigma[detection] ** 2))
    assert 0.5 < np.mean(np.concatenate(errors)) < 1.3


def test_a_star_cut_by_the_border_is_flagged() -> None:
    found = detect(frame_of(SMALL, np.array([[0.4, 100.0], [150.0, 150.0]]), np.array([5.0, 5.0]), [9]))
    cut = np.linalg.norm(found.points - [0.4, 100.0], axis=1).argmin()
    assert found.quality[cut] & Quality.CLIPPED
    assert np.abs(found.points[cut] - [0.4, 100.0]).max() < 0.2


def test_a_comet_is_refused_as_extended() -> None:
    rng = np.random.default_rng(6)
    frame = sky(rng)
    for x, y in ((40.0, 50.0), (250.0, 90.0), (90.0, 200.0), (280.0, 220.0), (200.0, 30.0)):
        add_star(frame, x, y, 5000.0)
    add_star(frame, 160.0, 130.0, 60_000.0, sigma=5.0)
    found = detect(counts(frame))
    assert len(found.stars()) >= 5
    assert np.linalg.norm(found.stars().points - [160.0, 130.0], axis=1).min() > 5.0


def test_a_bright_corner_full_of_leaves_does_not_drown_the_stars() -> None:
    rng = np.random.default_rng(12)
    frame = sky(rng, (512, 512))
    stars = star_places(np.random.default_rng(1), 380, 20)
    for x, y in stars:
        add_star(frame, x, y, 3000.0)
    for x, y in rng.uniform(400.0, 505.0, (150, 2)):
        add_star(frame, x, y, 40_000.0, sigma=rng.uniform(1.6, 3.5))
    found = detect(counts(frame)).stars()
    assert len(matched(found, stars)[0]) >= 18
    assert np.count_nonzero((found.points > 390.0).all(axis=1)) <= 8


def test_tracks_of_particles_do_not_drown_the_stars() -> None:
    """Each track has several peaks, and all tracks together have more peaks than are measured."""
    rng = np.random.default_rng(14)
    frame = sky(rng, (512, 512))
    stars = star_places(np.random.default_rng(1), 512, 30)
    for x, y in stars:
        add_star(frame, x, y, 3000.0)
    for angle in rng.uniform(0.0, np.pi, 60):
        along = np.linspace(-15.0, 15.0, 61)
        x, y = rng.uniform(16.0, 496.0, 2)
        frame[(y + along * np.sin(angle)).astype(int), (x + along * np.cos(angle)).astype(int)] += (
            rng.uniform(200.0, 1000.0)
        )
    assert len(matched(detect(counts(frame)).stars(), stars)[0]) >= 18


def test_a_source_whose_place_is_undetermined_is_not_a_star() -> None:
    middle, one = np.full((2, 2), 32), np.ones(2)
    covariance = np.array([0.01 * np.eye(2), 1e30 * np.eye(2)])
    found = SimpleNamespace(points=middle + 0.1, flux=1e6 * one, flux_sigma=one, covariance=covariance)
    targets = SimpleNamespace(core=0.0 * one, middle=middle, pixels=np.zeros((64, 64)))
    real = confirmed(cast(Any, found), cast(Any, targets), DetectionSettings())
    assert real.tolist() == [True, False]


def test_a_saturated_moon_is_not_detected_as_a_star() -> None:
    frame = sky(np.random.default_rng(2), (512, 512))
    row, column = np.indices(frame.shape)
    frame[np.hypot(row - 250, column - 300) < 30.0] = 65_535.0
    add_star(frame, 80.0, 90.0, 6000.0)
    found = detect(counts(frame)).stars()
    assert np.linalg.norm(found.points - [80.0, 90.0], axis=1).min() < 0.2
    assert not np.any(np.linalg.norm(found.points - [300.0, 250.0], axis=1) < 25.0)


def test_frames_without_stars_have_hardly_any_detections() -> None:
    false = sum(len(detect(counts(sky(np.random.default_rng([seed, 1])))).stars()) for seed in range(20))
    assert false <= 3
    assert len(detect(np.full((200, 200), 7, dtype=np.uint8))) == 0
    assert len(detect(np.zeros((200, 200)))) == 0


def test_a_sky_cut_off_at_zero_gives_no_flood_of_false_stars() -> None:
    noise = np.random.default_rng(13).standard_normal((600, 600))
    frame = np.maximum(np.rint(4.0 * noise), 0.0).astype(np.uint8)
    assert len(detect(frame).stars()) <= 3


def test_frames_of_points_and_of_streaks_are_distinguished() -> None:
    assert survey(real_sky(1, 1.2, 0.001, 0.2).pixels).shape.kind is FrameKind.POINTS
    streaked = survey(real_sky(1, 1.2, 40.0, 0.2).pixels).shape
    assert streaked.kind is FrameKind.STREAKS
    assert streaked.length == pytest.approx(40.0, rel=0.25)
    noise = counts(sky(np.random.default_rng(1)))
    assert survey(noise).shape.kind is FrameKind.NEITHER


def test_streaks_are_refused_as_points() -> None:
    found = detect(real_sky(2, 1.0, 60.0, 0.2).pixels)
    assert np.count_nonzero(found.quality & Quality.STREAK) > 0.5 * len(found)


def test_no_more_stars_than_asked_for_are_returned() -> None:
    camera = StarCameraModel()
    places = star_places(np.random.default_rng(8), camera.columns)
    magnitudes = np.linspace(5.0, 6.5, 40)
    found = detect(frame_of(camera, places, magnitudes, [8]), DetectionSettings(most_stars=12)).stars()
    assert len(found) == 12
    assert np.all(np.diff(found.flux) <= 0.0)
    assert np.isin(matched(found, places)[0], np.arange(16)).all()


@pytest.mark.parametrize(
    "frame",
    [
        np.zeros((10, 100)),
        np.zeros((50, 50, 3)),
        np.full((50, 50), np.nan),
        np.zeros((50, 50), dtype=bool),
    ],
)
def test_an_array_that_is_not_a_frame_is_refused(frame: Image) -> None:
    with pytest.raises(ValueError, match="image: "):
        detect(frame)


def test_wrong_settings_are_refused() -> None:
    for wrong in ({"window": 6}, {"threshold_sigmas": 0.0}, {"psf_sigma": 50.0}, {"method": "best"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            DetectionSettings(**wrong)


def test_odd_sizes_and_unusual_cameras_are_accepted() -> None:
    for rows, columns in ((17, 16), (100, 37), (65, 1000)):
        camera = StarCameraModel(columns=columns, rows=rows, field_of_view=np.radians(columns / 51.2))
        place = np.array([[columns / 2.0, rows / 2.0]])
        pixels = render(
            camera, at_pixels(camera, place), np.array([5.5]), *still(0.2), np.random.default_rng(1)
        )
        assert np.abs(detect(pixels).points[0] - place[0]).max() < 0.2


CAMERA = StarCameraModel()
PLACES = star_places(np.random.default_rng(31), CAMERA.columns, 30)
MAGNITUDE = 6.0

TRAILED = np.array([[30.3, 40.2], [80.6, 35.1], [150.2, 60.7], [45.5, 120.4], [100.1, 150.9], [160.7, 140.3]])


def test_predicted_stars_are_measured_to_the_bound_and_named_by_their_prediction() -> None:
    rng = np.random.default_rng(1)
    ratios, nees = [], []
    electrons = float(np.asarray(CAMERA.electrons(np.array([MAGNITUDE]), 0.2))[0])
    least = np.mean([np.trace(point_bound(CAMERA, place, electrons)) / 2.0 for place in PLACES])
    for seed in range(8):
        pixels = frame_of(CAMERA, PLACES, np.full(30, MAGNITUDE), [seed, 40])
        found = measure_near(pixels, PLACES + rng.uniform(-2.0, 2.0, PLACES.shape))
        assert np.sort(found.prediction).tolist() == list(range(30))
        off = found.points - PLACES[found.prediction]
        ratios.append(np.mean(off**2) / least)
        nees.append(np.mean(off**2 / found.sigma[:, None] ** 2))
    assert np.sqrt(np.mean(ratios)) < 1.15
    assert 0.8 < np.mean(nees) < 1.25


def test_no_star_is_found_at_a_position_without_a_star() -> None:
    pixels = frame_of(CAMERA, PLACES, np.full(30, MAGNITUDE), [2, 41])
    empty = np.array([[5.0, 5.0], [700.0, 1019.0], [-50.0, 20.0], [3000.0, 10.0]])
    apart = np.linalg.norm(empty[:2, None] - PLACES, axis=-1).min()
    assert apart > 15.0
    assert len(measure_near(pixels, empty)) == 0
    assert len(measure_near(pixels, np.zeros((0, 2)))) == 0


def test_two_predictions_of_one_star_give_it_once_to_the_nearer() -> None:
    pixels = frame_of(CAMERA, PLACES, np.full(30, MAGNITUDE), [3, 41])
    found = measure_near(pixels, np.array([PLACES[4] + [2.0, 0.0], PLACES[4] - [0.3, 0.0]]))
    assert found.prediction.tolist() == [1]


def test_a_whole_frame_and_windows_give_the_same_result() -> None:
    pixels = frame_of(CAMERA, PLACES, np.linspace(3.0, 6.5, 30), [4, 41])
    whole, near = detect(pixels).stars(), measure_near(pixels, PLACES, DetectionSettings(saturation=4095.0))
    apart = np.linalg.norm(near.points[:, None] - whole.points, axis=-1)
    assert np.all(apart.min(axis=1) < 1.0 * near.sigma + 0.01)
    saturated = (near.quality & Quality.SATURATED) > 0
    assert saturated.any()
    assert not saturated.all()


def test_wrong_predictions_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        measure_near(np.zeros((50, 50)), np.array([[np.nan, 1.0]]))


def test_trailed_stars_are_measured_at_mid_exposure() -> None:
    """For trails of 3 px on a sloping background, the errors at mid-exposure agree with the covariance."""
    rng = np.random.default_rng(12)
    trail, squares, claims = np.array([2.5, 1.5]), [], []
    for _ in range(6):
        pixels = np.full((200, 200), 200.0)
        faint = [(place, 500.0) for place in rng.uniform(10.0, 190.0, (120, 2))]
        for place, flux in [*((place, 20_000.0) for place in TRAILED), *faint]:
            shares = (np.arange(15) + 0.5) / 15.0 - 0.5
            across, down = np.exp(
                -0.5 * (np.arange(200)[:, None] - (place + shares[:, None] * trail).T[:, None]) ** 2
            )
            pixels += flux / 15.0 / (2.0 * np.pi) * down @ across.T
        counts = rng.poisson(pixels).astype(np.uint16)
        settings = DetectionSettings(psf_sigma=1.0, gain=1.0, saturation=65_535.0)
        found = measure_near(counts, TRAILED + 0.3, settings, np.tile(trail, (len(TRAILED), 1)))
        assert len(found) == len(TRAILED)
        off = found.points - TRAILED[found.prediction]
        squares += np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance), off).tolist()
        claims += found.sigma.tolist()
    assert 0.7 < np.median(squares) < 2.3  # the median of a chi-square with two degrees of freedom is 1.39
    assert np.median(claims) < 0.03


SKY = Path(__file__).parents[4].parent / "shared" / "data" / "sky"
_TOLERANCE = 0.007
"""Tolerance, as a fraction of the frame's width. The lens distortion is not corrected."""
_AMONG = 80

needs_photographs = pytest.mark.skipif(
    not SKY.is_dir(), reason="the photographs of ../shared/data/sky are missing"
)


def catalogue_places(truth: dict[str, float], shape: tuple[int, ...]) -> FloatArray:
    """Return the pixels of the brightest stars in the field, by the roll convention of cedar-solve."""
    ra, dec, roll = (np.radians(truth[name]) for name in ("ra", "dec", "roll"))
    boresight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(boresight, east)
    right = -east * np.cos(roll) - north * np.sin(roll)
    down = east * np.sin(roll) - north * np.cos(roll)
    stars = catalogue.load()
    camera = stars.directions_at(2019.0) @ np.stack([right, down, boresight]).T
    pinhole = Pinhole.from_field_of_view(shape[1], shape[0], float(np.radians(truth["fov"])))
    places = pinhole.project(camera)
    return places[pinhole.contains(places)][:_AMONG]


@needs_photographs
@pytest.mark.parametrize(
    "name",
    [
        "esa_alt40_azi-135.tiff",
        "esa_alt40_azi45.tiff",
        "esa_alt60_azi135.tiff",
        "hale_bopp.jpg",
        "orion2.jpg",
        "pleiades.jpg",
        "polar_05sec.jpg",
        "test2_g100_e50ms.jpg",
    ],
)
def test_nearly_all_of_the_twenty_brightest_detections_are_bright_catalogue_stars(name: str) -> None:
    pixels = read_image(SKY / name)
    found = detect(pixels).stars()
    places = catalogue_places(json.loads((SKY / "truth.json").read_text())[name], pixels.shape)
    apart = np.linalg.norm(found.points[:20, None] - places, axis=-1).min(axis=1)
    assert np.count_nonzero(apart < max(4.0, _TOLERANCE * pixels.shape[1])) >= 15
    assert survey(pixels).shape.kind is FrameKind.POINTS


@needs_photographs
def test_leaves_are_not_among_the_stars() -> None:
    """Leaves of a tree, in the upper right corner of the image, are not detected as stars."""
    found = detect(read_image(SKY / "tree.jpg")).stars()
    in_tree = (found.points[:, 0] > 310.0) & (found.points[:, 1] < 310.0)
    assert np.count_nonzero(in_tree[:20]) <= 5
    assert np.count_nonzero(~in_tree) >= 14
    assert survey(read_image(SKY / "tree.jpg")).shape.kind is not FrameKind.STREAKS


@needs_photographs
def test_a_noisy_raw_frame_gives_few_false_stars_and_a_dark_one_too() -> None:
    for name in ("may8_50ms_gain40_0.png", "may8_100ms_gain12_3.png"):
        assert 5 <= len(detect(read_image(SKY / name)).stars()) <= 60


@pytest.mark.parametrize("most", [8, 40, 400])
def test_the_compiled_choice_of_peaks_equals_that_in_numpy(most: int) -> None:
    draw = np.random.default_rng(4)
    place, height = draw.integers(0, 200, (60, 2)), -np.sort(-(10.0 ** draw.uniform(1.0, 5.0, 60)))
    core = np.where(draw.uniform(size=60) < 0.2, draw.uniform(1.0, 6.0, 60), 0.0)
    given = place, height, core, draw.random(60) < 0.7, 200, 200, most
    assert 8 <= len(_worth_measuring.numpy_form(*given)) < 60
    assert_forms_agree(_worth_measuring, *given, compiled=most == 40)


def test_the_compiled_search_of_odd_neighbourhoods_equals_that_in_numpy() -> None:
    draw = np.random.default_rng(5)
    odd, points = draw.random(80) < 0.6, draw.uniform(0.0, 150.0, (80, 2))
    assert 5 < np.count_nonzero(_among_odd.numpy_form(odd, points)) < 75
    assert_forms_agree(_among_odd, odd, points)
