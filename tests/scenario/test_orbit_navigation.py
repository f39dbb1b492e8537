"""Tests that a satellite acquires its attitude by star camera, in a world that differs from its model."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from ground.report import format_report, summarise
from ground.report.orbit import FINE, AttitudeErrors, attitude_errors, camera_errors
from ground.telemetry import Run
from sim_hal.settings import FaultEntry
from tests.scenario.orbit_flights import ACQUIRED, NEAR_REST, navigating, orbit_config, skyward, world
from tests.support.flights import event_names, fly


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return fly(navigating(), tmp_path_factory.mktemp("acquired"), section=skyward())


@pytest.fixture(scope="module")
def settled(flown: Run) -> AttitudeErrors:
    """Return the attitude errors after `ACQUIRED` s."""
    found = attitude_errors(flown)
    later = found.times > ACQUIRED
    return AttitudeErrors(found.times[later], found.error[later], found.sigma[later])


def test_the_attitude_becomes_fine_lost_in_space_and_stays_fine(flown: Run) -> None:
    packets = flown["navigation"]
    after = packets[packets["time_ns"] > ACQUIRED * 1e9]
    assert len(after) > 30
    assert (after["knowledge"] == FINE).all()
    assert after["refused"][-1] == 0
    assert "attitude-knowledge" in event_names(flown)


def test_the_attitude_of_the_star_camera_is_within_a_hundredth_of_a_degree_and_its_claim(flown: Run) -> None:
    found = camera_errors(flown)
    later = found.times > ACQUIRED
    error, sigma = found.error[later], found.sigma[later]
    assert len(error) > 2
    assert np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1)))) < 0.01
    assert np.degrees(sigma).max() < 0.02
    assert (np.abs(error) < 5.0 * sigma).all()


def test_the_attitude_of_the_body_is_within_the_accuracy_of_the_mounting_and_its_claim(
    settled: AttitudeErrors,
) -> None:
    """The attitude error is within the accuracy of the mounting, and within the stated uncertainty.

    The mountings of the cameras are known to 0.1 deg about each axis.
    """
    angle = np.degrees(np.linalg.norm(settled.error, axis=1))
    assert np.sqrt(np.mean(angle**2)) < 0.15
    assert np.degrees(settled.sigma).max() < 0.06
    assert (np.abs(settled.error) < 5.0 * settled.sigma).all()


def test_the_biases_of_the_inertial_unit_are_estimated(flown: Run) -> None:
    last = flown["navigation"][-1]
    assert last["gyro_bias"] == pytest.approx(flown_bias(flown), abs=1.5e-4)


def flown_bias(run: Run) -> np.ndarray:
    """Return the mean gyro error (3,) of the IMU: its configured bias plus its random bias."""
    imu, truth = run["imu"], run["truth"]
    rates = [
        np.interp(imu["sample_time_ns"], truth["time_ns"], truth["rate"][:, axis].astype(float))
        for axis in range(3)
    ]
    return np.asarray(np.mean(imu["rate"] - np.column_stack(rates), axis=0))


def test_a_receiver_without_power_is_reported_and_the_orbit_stays_known(flown: Run) -> None:
    assert "gps-lost" in event_names(flown)
    assert (flown["navigation"]["placed"][2:] == 1).all()


def test_the_report_shows_how_well_the_attitude_was_known(flown: Run, tmp_path: Path) -> None:
    summary = summarise(flown)["knowledge"]
    assert summary["share"]["fine"] > 0.6
    assert summary["fine_error_worst_rad"] < np.radians(0.3)
    assert "Attitude knowledge" in format_report(summarise(flown))


@pytest.mark.parametrize("days", [3.0, -5.0])
def test_a_wall_clock_that_is_days_off_is_corrected_by_the_first_fix(days: float, tmp_path: Path) -> None:
    """The first GPS fix corrects a wall clock that is days off.

    The packet `run` is recorded a second time, with the UTC of the GPS receiver.
    """
    quiet = world(NEAR_REST, FaultEntry(fault=f"clock: stepped (by={86_400.0 * days})"))
    receiver = configuration.replace(quiet.orbit_devices, gps_start=3.0)
    config = configuration.replace(orbit_config(6.0), camera=None)
    run = fly(config, tmp_path, section=configuration.replace(quiet, orbit_devices=receiver))
    true_ns = round(datetime.fromisoformat(quiet.utc).timestamp()) * 10**9 + 10**9
    assert abs(int(run["run"]["utc_ns"][-1]) - true_ns) < 2e8
    assert summarise(run)["run"]["utc_ns"] == run["run"]["utc_ns"][-1]
    assert run["fix"]["clock_off"] == pytest.approx(86_400.0 * days, abs=0.3)
    assert "clock-off" in event_names(run)
    assert run["navigation"]["placed"].tolist() == ([0, 1, 1, 1, 1, 1] if days > 0.0 else [0, 0, 0, 1, 1, 1])
