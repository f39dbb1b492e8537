"""Tests that a KnightCube finds an object, follows it, and predicts its motion while the camera is blind.

The flight of `config/orbit_object_1u.yaml` renders frames, and runs image processing, tracking, planner and
coils. This module integrates the true motion of the object.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from ground.messages import write_tracking_data
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import DAY, SPEED_OF_LIGHT, UNIX_EPOCH, earth_velocity
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.settings import FaultEntry, Simulation
from tests.support.flights import event_names, fly
from tests.support.short_arcs import flow

CONFIG = Path(__file__).resolve().parents[2] / "config" / "orbit_object_1u.yaml"
DURATION, BLIND, GAP = 75.0, 48.0, 10.0
"""Duration (s) of the run, and start and duration (s) of the interval in which the camera is blind."""
HALF_FIELD, PIXEL = 10.0, np.radians(20.0) / 512
BORESIGHT = np.array([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    text = CONFIG.read_text(encoding="utf-8")
    section = configuration.simulation_section(text, CONFIG.name, Simulation)
    assert section is not None
    section = configuration.replace(section, faults=(FaultEntry(fault="camera: off", at=BLIND, span=GAP),))
    config = configuration.replace(as_orbit(configuration.parse(text)), duration=DURATION)
    return fly(config, tmp_path_factory.mktemp("pass"), section=section)


def _shown(run: Run, times: FloatArray) -> FloatArray:
    """Return the object's apparent directions (n, 3), corrected like star directions, at times (n,), s."""
    section = configuration.simulation_section(CONFIG.read_text(encoding="utf-8"), CONFIG.name, Simulation)
    assert section is not None
    start = section.objects[0].state
    assert start is not None
    truth = run["orbit_truth"]
    begun = datetime.fromisoformat(section.utc).timestamp() / DAY + UNIX_EPOCH
    late = float(truth["utc"][0] - begun) * DAY - float(truth["time_ns"][0]) * 1e-9
    own = CubicHermiteSpline(truth["time_ns"] * 1e-9, truth["position"], truth["velocity"])(times)
    first = np.concatenate([start.position, start.velocity])
    span = (0.0, DURATION + late + 1.0)
    flown = solve_ivp(flow, span, first, "DOP853", rtol=1e-11, atol=1e-4, dense_output=True).sol
    state = flown(times + late).T
    way = state[:, :3] - own
    # The directions account for light time, and for the Earth's motion around the Sun (aberration).
    moved = state[:, 3:] + earth_velocity(begun)
    way = way - np.linalg.norm(way, axis=1, keepdims=True) / SPEED_OF_LIGHT * moved
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


def _followed(run: Run) -> float:
    """Return the mission time (s) at which the pursuit of the object began."""
    events = run["event"]
    (index,) = (k for k, name in enumerate(event_names(run)) if name == "object-followed")
    return float(events["time_ns"][index]) * 1e-9


def test_the_object_is_found_once_and_never_lost(flown: Run) -> None:
    names = event_names(flown)
    assert names.count("object-found") == names.count("object-followed") == 1
    assert names.count("camera-lost") == names.count("camera-recovered") == 1
    assert not {"object-lost", "object-escapes", "planner-failed", "tumbling", "control-lost"} & set(names)
    assert set(flown["track"]["number"].tolist()) == {1}
    assert _followed(flown) < 35.0


def test_the_object_is_kept_in_the_field_and_followed_while_the_camera_is_off(flown: Run) -> None:
    truth = flown["truth"]
    times = truth["time_ns"] * 1e-9
    after = times > _followed(flown)
    shown = np.array([attitude_matrix(q).T @ BORESIGHT for q in truth["quaternion"][after]])
    off = np.degrees(np.arccos(np.sum(shown * _shown(flown, times[after]), axis=1)))
    assert off.max() < HALF_FIELD
    blind = (times[after] > BLIND) & (times[after] < BLIND + GAP)
    assert off[blind].max() < 4.0
    assert off[-1] < 4.0
    # The body must continue to rotate with the object while the camera is blind.
    turn = np.degrees(np.linalg.norm(truth["rate"][after][blind], axis=1))
    assert turn.min() > 0.3


def test_the_errors_of_the_track_agree_with_its_covariance(flown: Run) -> None:
    track = flown["track"]
    again = track["middle_ns"] * 1e-9 > BLIND + GAP
    assert track["seen"][again].mean() > 0.8
    first = track[np.flatnonzero(again)[0]]
    assert first["seen"]
    true = _shown(flown, track["middle_ns"] * 1e-9)
    xx, yy, zz = track["covariance"][:, :3].T
    claim = np.sqrt(0.5 * (xx + yy + zz))
    away = np.linalg.norm(track["direction"] - true, axis=1)
    assert claim.max() < 0.1 * PIXEL
    # With two degrees of freedom, the expected mean of the normalised squared error is 2.
    assert np.mean((away / claim) ** 2) < 4.0


def test_the_message_of_the_pass_is_read_by_a_reader_of_other_authors(flown: Run, tmp_path: Path) -> None:
    reader = pytest.importorskip("ccsds_ndm.ndm_io").NdmIo()
    path, observer = write_tracking_data(flown, tmp_path / "pass.tdm")
    (orbit,) = reader.from_path(observer).body.segment
    assert len(orbit.data.state_vector) > 30
    (segment,) = reader.from_path(path).body.segment
    one, two = (
        [getattr(item, name) for item in segment.data.observation if getattr(item, name)]
        for name in ("angle_1", "angle_2")
    )
    right, up = (np.radians([float(item.value) for item in items]) for items in (one, two))
    seen = np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], axis=1)
    zero = int(flown["run"]["utc_ns"][-1]) * 1e-9
    epochs = [item.epoch for item in segment.data.observation if item.angle_1]
    times = np.array([datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp() - zero for text in epochs])
    assert len(seen) > 30
    assert np.linalg.norm(seen - _shown(flown, times), axis=1).max() < 0.15 * PIXEL
