"""Tests that after a kill, a flight process restarts with the parameters that its filter had estimated."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from flight.schema.devices import CameraAccuracy
from ground.telemetry import Run
from sim_hal.settings import Simulation
from tests.scenario.orbit_flights import GYRO_BIAS, navigating, skyward
from tests.support.flights import Rigged, event_names, fly

KILLED, AGAIN = 40.0, 16.0
"""Durations (s) of the first run, which is killed, and of the second run."""
LATER = "2026-03-20T12:10:00Z"


def _config(state: Path, duration: float) -> OrbitConfig:
    begun = navigating()
    section = configuration.replace(begun.state, folder=str(state), period=1.0)
    assert begun.camera is not None
    uncalibrated = configuration.replace(begun.camera, accuracy=CameraAccuracy(), line_time=None)
    return configuration.replace(begun, state=section, elements=None, duration=duration, camera=uncalibrated)


def _world(utc: str | None = None) -> Simulation:
    section = skyward() if utc is None else configuration.replace(skyward(), utc=utc)
    receiver = configuration.replace(section.orbit_devices, gps_start=1.0)
    return configuration.replace(section, orbit_devices=receiver)


def _first_error(run: Run) -> float:
    """Return the error (rad/s) of the first estimate of the gyro bias."""
    bias = run["navigation"]["gyro_bias"]
    known = bias[np.isfinite(bias[:, 0])]
    return float(np.linalg.norm(known[0] - GYRO_BIAS))


def test_the_gyro_bias_is_known_at_once_after_a_kill(tmp_path: Path) -> None:
    """After a kill, the gyro bias is known at once, from the files that were on the disk at the kill."""
    disk, left = tmp_path / "disk", tmp_path / "left"

    def kill(rigged: Rigged) -> None:
        def copy() -> None:
            shutil.copytree(disk, left)

        rigged.at(KILLED, copy)

    first = fly(_config(disk, KILLED + 2.0), tmp_path / "first", kill, section=_world())
    again = fly(_config(left, AGAIN), tmp_path / "again", section=_world(LATER))
    assert _first_error(first) > 4e-4, "nothing was known of it"
    assert _first_error(again) < 1e-4
    assert "unclean-shutdown" in event_names(again)
    assert "learned-refused" not in event_names(again)
    assert np.isfinite(again["navigation"]["gyro_bias"][-1]).all()
    # The optical axis, which is configured with an accuracy of 2 px, is also known at once after the restart.
    axis, known = first["lens"]["centre"][-1] - 255.5, first["lens"]["sigma"][-1, 1:3]
    assert len(first["lens"]) > 3
    assert np.all(np.abs(axis) < 5.0 * known)
    assert np.all(known < 1.0)
    assert np.all(again["lens"]["sigma"][0, 1:3] < np.hypot(known, 0.3 * 2.0))
    assert again["lens"]["contradictions"][-1] == 0
