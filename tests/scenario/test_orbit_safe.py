"""Tests that a satellite in SAFE detumbles and then points to the Sun by solar strings, gyro and field."""

from __future__ import annotations

import numpy as np
import pytest

from flight.link.events import Mode
from flight.schema import reader as configuration
from flight.schema.sections import Commands, CommandStep
from ground.telemetry import Run
from tests.scenario.mode_flights import currents, entered, modes_of
from tests.scenario.orbit_flights import orbit_config, speed, world
from tests.support.flights import event_names, fly

SPEED, SLOW = 0.05, 0.042
DURATION = 45.0
"""Duration (s) of the flight, in which detumbling starts after 5 s and the body is slow after 15 s."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = configuration.replace(orbit_config(DURATION, tumble_rate=0.045), camera=None, gps=None)
    config = configuration.replace(
        config,
        detumble=configuration.replace(config.detumble, low_rate=SLOW, low_for=2.0),
        commands=Commands(timeline=(CommandStep(at=1.0, mode="safe"),)),
    )
    return fly(config, tmp_path_factory.mktemp("safe"), section=world(SPEED))


def test_safe_damps_the_rotation_and_remains_the_mode(flown: Run) -> None:
    assert modes_of(flown)[-1] is Mode.SAFE
    time, since = flown["truth"]["time_ns"] * 1e-9, entered(flown, Mode.SAFE)
    assert since < 2.0
    assert speed(flown)[time > DURATION - 1.0].max() < SLOW
    assert currents(flown, since + 7.0, DURATION).any()


def test_the_sun_is_reported_as_found_without_camera_and_orbit(flown: Run) -> None:
    assert event_names(flown).count("sun-found") == 1
    assert "control-lost" not in event_names(flown)


def test_the_coils_pause_for_the_magnetometer(flown: Run) -> None:
    truth = flown["truth"]
    inside = (truth["time_ns"] * 1e-9 > 10.0) & (truth["time_ns"] * 1e-9 < DURATION)
    resting = np.abs(truth["current"][inside]).max(axis=1) < 1e-3
    assert 0.05 < np.mean(resting) < 0.3
