"""Tests that objects are tracked without a star catalogue, by the common motion of the stars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from flight.schema.devices import ObjectTracking, StarTrackerSection
from flight.schema.document import FOLDER
from ground.messages import orbits_of
from ground.telemetry import Run
from sim_hal.settings import Simulation
from tests.scenario.object_flights import _LINES, _PIXEL, _place, two_objects
from tests.support.flights import demo_config, demo_world, event_names, fly


def flown(folder: Path, q2: float, seconds: float, tracker: StarTrackerSection | None = None) -> Run:
    """Return a flight that slews from q2 = 0.2 to `q2`, with two objects."""
    config, world = demo_config(seconds), demo_world()
    assert config.camera is not None
    assert world.release is not None
    camera = configuration.replace(
        config.camera, exposure=0.2, period=1.0, objects=ObjectTracking(), star_tracker=tracker
    )
    steps = (configuration.replace(config.steps[0], q2=q2),)
    release = configuration.replace(world.release, q2=0.2, rate=0.0)
    section = configuration.replace(world, release=release, objects=two_objects())
    return fly(configuration.replace(config, camera=camera, steps=steps), folder, section=section)


def test_two_objects_are_tracked_through_a_slew_with_honest_claims(tmp_path: Path) -> None:
    run = flown(tmp_path, 0.23, 11.5)
    assert not len(run["stars"]), "no star is identified"
    assert (run["streak"]["status"] == b"rate").sum() >= 5, "the stars are streaks during the slew"
    tracks = run["track"]
    assert set(tracks["number"].tolist()) == {1, 2}, "both objects, and no false track"
    assert tracks["relative"].all()
    assert np.isnan(tracks["magnitude"]).all()
    owners = set()
    for number in (1, 2):
        track = tracks[tracks["number"] == number]
        true = [_place(line, track["middle_ns"] * 1e-9) for line in _LINES]
        away = [np.linalg.norm(track["direction"] - place, axis=1) for place in true]
        own = int(np.argmin([one[-1] for one in away]))
        owners.add(own)
        assert track["seen"].all()
        claim = np.sqrt(0.5 * track["covariance"][:, :3].sum(axis=1))
        assert (away[own] < 3.5 * claim).all()
        assert claim.max() < 4.0 * _PIXEL, "the estimated attitude is known to some pixels"
        # The rate of the object is measured relative to the stars, so the attitude error does not matter.
        rate = np.degrees(np.linalg.norm(track["rate"], axis=1))
        sigma = np.degrees(np.sqrt(0.5 * track["rate_covariance"][:, :3].sum(axis=1)))
        assert (np.abs(rate - _LINES[own].rate_deg) < 3.5 * sigma).all()
        assert sigma[-1] < 1e-3
    assert owners == {0, 1}
    assert all("without identified stars" in one.reason for one in orbits_of(run))


def test_a_damaged_sky_index_leaves_detection_by_motion(
    tmp_path: Path,
) -> None:
    """With a damaged sky index, objects are still detected by their motion.

    The file exists when the flight is opened, but it does not contain a sky index.
    """
    index = tmp_path / "sky.index"
    index.write_bytes(b"not an index")
    run = flown(tmp_path / "run", 0.2, 6.5, StarTrackerSection(index=str(index)))
    names = event_names(run)
    assert "vision-failed" in names
    assert any(b"stars are not identified" in row["text"] for row in run["event"])
    assert set(run["track"]["number"].tolist()) == {1, 2}


@pytest.mark.slow
def test_a_satellite_follows_an_object_without_a_star_catalogue(tmp_path: Path) -> None:
    """A satellite without a star catalogue follows an object that passes at 0.4 deg/s.

    The attitude of the KnightCube is coarse.
    """
    path, seconds = FOLDER / "orbit_object_1u.yaml", 57.0
    config = as_orbit(configuration.load(path))
    assert config.camera is not None
    camera = configuration.replace(config.camera, star_tracker=None)
    config = configuration.replace(config, camera=camera, duration=seconds)
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    run = fly(config, tmp_path, section=section)
    names = event_names(run)
    assert names.count("object-found") == names.count("object-followed") == 1
    assert "object-lost" not in names
    assert set(run["track"]["number"].tolist()) == {1}, "the object, and no false track"
    assert run["track"]["seen"].mean() > 0.9
    last = run["truth"]["time_ns"] > (seconds - 20.0) * 1e9
    turned = np.degrees(np.linalg.norm(run["truth"]["rate"][last], axis=1))
    assert turned.min() > 0.3, "the body turns with the object"
    seen = run["sightings"][run["sightings"]["middle_ns"] > (seconds - 20.0) * 1e9]
    centre = np.array([0.5 * (camera.columns - 1), 0.5 * (camera.rows - 1)])
    away = np.hypot(seen["x"] - centre[0], seen["y"] - centre[1])
    near = np.nanmin(away[seen["found"] > 0], axis=1)
    assert np.median(near) < 80.0, "the object is within 3 deg of the boresight"
