"""Tests that rendered frames of stars and objects equal the recorded frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from sim_hal.settings import FreeBodySection, LineOfSight, ObjectState, SkyObject, SkySection, Tumble
from sim_hal.star_camera import (
    SourceTrack,
    StarCameraModel,
    expected_electrons,
    render,
    scatter_hot_pixels,
)
from sim_hal.star_camera.image import AttitudeHistory
from sim_hal.star_camera.objects import SkyObjects, aberrated, directions, hidden_by_earth, view
from sim_hal.worlds.free_body import FreeBody
from sim_hal.worlds.world import OrbitingWorld
from tests.sim_hal.star_camera.scenes import at_pixels, turning
from tests.support.recorded_results import check

MODEL = StarCameraModel(columns=160, rows=120, field_of_view=np.radians(4.0))
PLACES = np.array([[20.3, 30.7], [80.1, 60.4], [140.6, 100.2], [100.0, 20.5], [-3.0, 50.0]])
MAGNITUDES = [3.0, 1.5, 4.0, 2.5, 0.5]
UTC = "2026-03-20T12:00:00Z"


def frame(model: StarCameraModel, rate: tuple[float, float, float], seed: int = 5) -> FloatArray:
    """Return a frame of five stars."""
    return render(
        model, at_pixels(model, PLACES), MAGNITUDES, *turning(rate, 0.5), np.random.default_rng(seed)
    )


def test_frames_at_rest_and_in_motion_are_as_recorded() -> None:
    check(__file__, "still", frame(MODEL, (0.0, 0.0, 0.0)), 1e-4)
    check(__file__, "moving", frame(MODEL, (0.01, -0.02, 0.05)), 1e-4)


def test_frames_of_other_cameras_are_as_recorded() -> None:
    rng = np.random.default_rng(6)
    models = {
        "hot": scatter_hot_pixels(MODEL, 40, 2000.0, rng),
        "8 bits": replace(MODEL, bits=8, gain=12.0, pedestal=15.0),
        "thesis": replace(MODEL, psf="bilinear", noise="uniform"),
        "stray light": replace(MODEL, background_gradient=(0.3, -0.2), dark_current=500.0),
        "rolling": replace(MODEL, line_time=1e-3),
        "wide spread": replace(MODEL, psf_sigma=2.3, full_well=900.0),
    }
    found = {name: frame(model, (0.01, -0.02, 0.05)) for name, model in models.items()}
    check(__file__, "cameras", found, 1e-4)


def test_the_expected_light_of_sources_with_tracks_is_as_recorded() -> None:
    times, attitudes = turning((0.0, 0.01, 0.0), 0.5, 5)
    ways = at_pixels(MODEL, PLACES[1] + np.linspace(0.0, 30.0, 5)[:, None] * [1.0, 0.5])
    tracks = [SourceTrack(times, ways, 2.0)]
    stars = at_pixels(MODEL, PLACES)
    check(__file__, "tracks", expected_electrons(MODEL, stars, MAGNITUDES, times, attitudes, tracks), 1e-4)


def test_the_history_of_an_attitude_is_as_recorded() -> None:
    times, attitudes = turning((0.2, -0.1, 0.4), 1.0, 7)
    history = AttitudeHistory(times, attitudes)
    at = np.linspace(0.0, 1.0, 11)
    check(
        __file__,
        "history",
        [history.at(at), history.matrices_at(at), history.knots(1e-5, 0.05), history.span],
    )


def world() -> OrbitingWorld:
    """Return a world in orbit."""
    return FreeBody(FreeBodySection(craft="cubesat_3u"), lambda: np.zeros(3), seed=1, utc=UTC)


def test_the_tracks_of_objects_in_the_sky_are_as_recorded() -> None:
    line = LineOfSight(right_ascension_deg=30.0, declination_deg=-20.0, rate_deg=0.5, towards_deg=40.0)
    here = world().surroundings()
    x, y, z = (np.array(here.position) + np.array([4e5, 1e5, -2e5])).tolist()
    u, v, w = (1.01 * np.array(here.velocity)).tolist()
    state = ObjectState(position=(x, y, z), velocity=(u, v, w))
    entries = [
        SkyObject(magnitude=4.0, line_of_sight=line),
        SkyObject(magnitude=3.0, line_of_sight=line, tumble=Tumble(period=3.0, amplitude=1.5)),
        SkyObject(magnitude=5.0, state=state),
    ]
    sky = SkyObjects(entries, UTC, 0, world())
    sky.begin(2_000_000_000)
    found = [sky.tracks(start, np.linspace(0.0, 0.8, 4)) for start in (2_500_000_000, 9_000_000_000)]
    check(__file__, "objects", found)


def test_directions_and_shadow_of_objects_are_as_recorded() -> None:
    rng = np.random.default_rng(7)
    observer = np.array([7e6, 1e5, -2e5])
    targets = observer + 3e6 * rng.normal(size=(12, 3))
    here = world().surroundings()
    found = [
        directions(observer, targets),
        hidden_by_earth(observer, targets),
        aberrated(turning((0.1, 0.2, 0.0), 1.0, 4)[1], np.array([1e4, -2e4, 3e4])),
        view(MODEL.pinhole, np.eye(3), here, SkySection()),
        view(MODEL.pinhole, -np.eye(3), here, SkySection()),
    ]
    check(__file__, "sight", found)
