"""Objects in flight: sighted among the stars, tracked, reported; and nothing is tracked in an empty sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix
from flight.schema import reader as configuration
from flight.schema.devices import ObjectTracking
from ground.telemetry.reader import Run
from sim_hal.settings import LineOfSight, SkyObject
from tests.scenario.flights import demo_config, demo_world, event_names, fly

_DURATION = 9.5
_HELD = np.array([0.0, 0.2, 0.0, np.sqrt(0.96)])
_PIXEL = np.radians(20.0) / 1024


def _flight(folder: Path, objects: tuple[SkyObject, ...]) -> Run:
    """Return a flight at rest with a frame of 0.2 s each second."""
    config = demo_config(_DURATION)
    camera = configuration.replace(config.camera, exposure=0.2, period=1.0, objects=ObjectTracking())
    step = configuration.replace(config.steps[0], q2=0.2)
    world = demo_world()
    release = configuration.replace(world.release, q2=0.2, rate=0.0)
    section = configuration.replace(world, release=release, objects=objects)
    return fly(configuration.replace(config, camera=camera, steps=(step,)), folder, section=section)


def _line(across_deg: float, rate_deg: float, towards_deg: float) -> LineOfSight:
    """Return the line of sight to an object that begins this far from the boresight, along the camera's x."""
    angle = np.radians(across_deg)
    seen = np.array([np.sin(angle), 0.0, np.cos(angle)]) @ attitude_matrix(_HELD)
    return LineOfSight(
        right_ascension_deg=float(np.degrees(np.arctan2(seen[1], seen[0]))),
        declination_deg=float(np.degrees(np.arcsin(seen[2]))),
        rate_deg=rate_deg,
        towards_deg=towards_deg,
    )


def _place(line: LineOfSight, time: FloatArray) -> FloatArray:
    """Return the true directions (n, 3), by the definition of right ascension and position angle."""
    ra, dec = np.radians([line.right_ascension_deg, line.declination_deg])
    start = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(start, east)
    towards = np.radians(line.towards_deg)
    ahead = np.cos(towards) * north + np.sin(towards) * east
    angle = np.radians(line.rate_deg) * time[:, None]
    return np.asarray(np.cos(angle) * start + np.sin(angle) * ahead)


def test_two_objects_are_found_and_tracked_to_a_fraction_of_a_pixel(tmp_path: Path) -> None:
    lines = (_line(-3.0, 0.3, 40.0), _line(3.0, 0.1, 250.0))
    brightness = (3.0, 4.5)
    objects = tuple(
        SkyObject(magnitude=m, line_of_sight=line) for m, line in zip(brightness, lines, strict=True)
    )
    run = _flight(tmp_path, objects)
    assert event_names(run).count("object-found") >= 1
    tracks = run["track"]
    assert set(tracks["number"].tolist()) == {1, 2}
    for number in (1, 2):
        track = tracks[tracks["number"] == number]
        true = [_place(line, track["middle_ns"] * 1e-9) for line in lines]
        away = [np.linalg.norm(track["direction"] - place, axis=1) for place in true]
        own = int(np.argmin([one[-1] for one in away]))
        assert away[own].max() < 0.3 * _PIXEL
        rate = np.degrees(np.linalg.norm(track["rate"][-1]))
        assert abs(rate - lines[own].rate_deg) < 0.01
        assert abs(track["magnitude"][-1] - brightness[own]) < 0.3
        assert track["seen"].all()


def test_a_sky_without_objects_has_no_track(tmp_path: Path) -> None:
    run = _flight(tmp_path, ())
    assert len(run["sightings"]) >= 8
    assert not len(run["track"])
    assert "object-found" not in event_names(run)
