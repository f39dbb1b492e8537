"""Stars about predicted places."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.startracker.detection import DetectionSettings, Quality, detect, measure_near
from sim_hal.star_camera import StarCameraModel
from tests.studies.bench.centroids import frame_of, point_bound, star_places

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


def test_nothing_is_found_where_there_is_no_star() -> None:
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


def test_a_whole_frame_and_windows_say_the_same() -> None:
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


def test_stars_that_move_by_a_few_pixels_are_measured_where_they_are_in_the_middle() -> None:
    """Trails of 3 px along a slope: errors as large as claimed; faint stars are no noise of the others."""
    rng = np.random.default_rng(12)
    trail, squares, claims = np.array([2.5, 1.5]), [], []
    for _ in range(6):
        pixels = np.full((200, 200), 200.0)
        row, column = np.indices(pixels.shape)
        faint = [(place, 500.0) for place in rng.uniform(10.0, 190.0, (120, 2))]
        for place, flux in [*((place, 20_000.0) for place in TRAILED), *faint]:
            for share in (np.arange(15) + 0.5) / 15.0 - 0.5:
                x, y = place + share * trail
                bell = np.exp(-0.5 * ((column - x) ** 2 + (row - y) ** 2))
                pixels += flux / 15.0 * bell / (2.0 * np.pi)
        counts = rng.poisson(pixels).astype(np.uint16)
        settings = DetectionSettings(psf_sigma=1.0, gain=1.0, saturation=65_535.0)
        found = measure_near(counts, TRAILED + 0.3, settings, np.tile(trail, (len(TRAILED), 1)))
        assert len(found) == len(TRAILED)
        off = found.points - TRAILED[found.prediction]
        squares += np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance), off).tolist()
        claims += found.sigma.tolist()
    assert 0.7 < np.median(squares) < 2.3  # 1.39 of two degrees of freedom
    assert np.median(claims) < 0.03
