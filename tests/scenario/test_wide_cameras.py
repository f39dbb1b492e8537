"""Tests that Sun and limb in horizon cameras give a fine attitude without a star camera."""

from __future__ import annotations

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from ground.report.orbit import COARSE, attitude_errors
from ground.telemetry import Run
from tests.scenario.orbit_flights import orbit_config, world
from tests.support.flights import CONFIG, event_names, fly

DURATION, SETTLED = 30.0, 15.0
"""Duration (s) of the flight, and time (s) from which the attitude must be fine."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    whole = as_orbit(configuration.load(CONFIG.parent / "orbit.yaml"))
    often = tuple(configuration.replace(camera, period=4.0) for camera in whole.wide_cameras)
    config = configuration.replace(orbit_config(DURATION), camera=None, wide_cameras=often)
    return fly(config, tmp_path_factory.mktemp("wide"), section=world(0.005))


def test_sun_and_horizon_are_found_and_used(flown: Run) -> None:
    packets = flown["directions"]
    assert len(packets) >= 4
    assert (packets["frames"] == 0b111111).all()
    assert packets["sun_used"].any()
    assert packets["nadir_used"].any()
    assert np.isfinite(packets["nadir"][packets["nadir_cameras"] > 0]).all()
    assert "wide-lost" not in event_names(flown)


def test_the_attitude_is_better_than_by_solar_strings_and_within_its_claim(flown: Run) -> None:
    assert (flown["navigation"]["knowledge"][4:] >= COARSE).all()
    errors = attitude_errors(flown)
    later = errors.times > SETTLED
    assert later.any()
    assert (np.abs(errors.error[later]) < 4.5 * errors.sigma[later]).all()
    assert np.degrees(np.linalg.norm(errors.error[later], axis=1)).max() < 0.5
