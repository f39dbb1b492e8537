"""Tests that solar strings, of which one is dead, give a coarse attitude without a camera."""

from __future__ import annotations

import numpy as np
import pytest

from flight.schema import reader as configuration
from ground.report.orbit import COARSE, attitude_errors
from ground.telemetry import Run
from sim_hal.settings import FaultEntry
from tests.scenario.orbit_flights import orbit_config, world
from tests.support.flights import fly

DEAD = 6.0
"""Time (s) from which one solar string gives no current."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = configuration.replace(orbit_config(24.0), camera=None, gps=None)
    dead = FaultEntry(fault="strings: dead", at=DEAD)
    return fly(config, tmp_path_factory.mktemp("strings"), section=world(0.008, dead))


def test_sun_and_field_give_a_coarse_attitude_although_a_string_fails(flown: Run) -> None:
    assert (flown["navigation"]["knowledge"][4:] == COARSE).all()
    errors = attitude_errors(flown)
    assert len(errors.times)
    assert (np.abs(errors.error) < 4.0 * errors.sigma).all()
    assert np.degrees(errors.sigma).max() < 5.0
