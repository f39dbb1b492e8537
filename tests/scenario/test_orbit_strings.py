"""Solar strings in the loop: with them the attitude is coarse without a camera; dead ones are reported."""

from __future__ import annotations

import numpy as np
import pytest

from flight.schema import reader as configuration
from ground.report.knowledge import COARSE, attitude_errors
from ground.telemetry.reader import Run
from sim_hal.settings import FaultEntry
from tests.scenario.flights import event_names, fly
from tests.scenario.test_orbit import orbit_config, world

DEAD = 6.0
"""When all strings give no current, s."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = configuration.replace(orbit_config(24.0), camera=None, gps=None)
    dead = FaultEntry(fault="strings: dead", at=DEAD)
    return fly(config, tmp_path_factory.mktemp("strings"), section=world(0.008, dead))


def test_sun_and_field_give_a_coarse_attitude_that_holds_without_the_sun(flown: Run) -> None:
    assert (flown["navigation"]["knowledge"][4:] == COARSE).all()
    errors = attitude_errors(flown)
    assert len(errors.times)
    assert (np.abs(errors.error) < 4.0 * errors.sigma).all()
    assert np.degrees(errors.sigma).max() < 5.0


def test_dead_strings_are_reported(flown: Run) -> None:
    assert "sun-unclear" in event_names(flown)
    assert "strings-lost" not in event_names(flown)
