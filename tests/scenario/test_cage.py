"""Tests of a slew in the coil cage with the field nearly along body x, so that coil x has little torque."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.document import ConfigError, config_path
from flight.schema.sections import Config
from ground.report.signals import true_attitude
from ground.telemetry import Run
from sim_hal.settings import Simulation
from tests.support.flights import event_names, fly

TEXT = config_path("cage").read_text(encoding="utf-8")


def _cage() -> tuple[Config, Simulation]:
    section = configuration.simulation_section(TEXT, "cage", Simulation)
    assert section is not None
    return configuration.parse(TEXT).shortened(40.0), section


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return the first 40 s of a slew from q2 = 0.2, with an initial rate of -0.1 rad/s, to q2 = -0.3."""
    config, section = _cage()
    return fly(config, tmp_path_factory.mktemp("cage"), section=section)


def test_both_coils_bring_the_slew_to_its_target(flown: Run) -> None:
    attitude = true_attitude(flown)
    assert attitude is not None
    end = attitude.time > 30.0
    assert np.degrees(np.abs(2.0 * np.arcsin(attitude.q2[end]) - 2.0 * np.arcsin(-0.3))).max() < 0.2
    currents = np.abs(flown["control"]["current_written"]).max(axis=0)
    assert currents[2] > 0.02
    assert currents[1] == 0.0
    assert set(event_names(flown)) <= {"started", "target", "stopped"}


def test_the_magnetometer_measures_the_field_of_the_cage_in_body_axes(flown: Run) -> None:
    """The magnetometer measures the field of the cage, rotated by the attitude of the body.

    By the table of `OrbitField`, the initial field of 0.225 mT is 67 deg from -z. The body is at 23 deg.
    """
    field = flown["imu"]["field"][0].astype(float)
    assert np.hypot(field[0], field[2]) == pytest.approx(2.25e-4, rel=0.05)
    # In body axes, the direction of the field changes by the angle of the body's rotation.
    towards = np.degrees(np.arctan2(field[0], -field[2]))
    assert towards == pytest.approx(67.0 + np.degrees(2.0 * np.arcsin(0.2)), abs=3.0)


def test_a_world_with_a_cage_needs_the_sections_of_the_cage(tmp_path: Path) -> None:
    config, section = _cage()
    with pytest.raises(ConfigError, match=r"simulation.cage.*is missing"):
        fly(config, tmp_path, section=configuration.replace(section, cage=None))
