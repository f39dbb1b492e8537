"""Tests of the coil cage model in the flight software: its field, and the torques of two coils."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flight.bodies.testbed.control import CageField, CageTracker, ThreadEstimate, local_frame, plant_of
from flight.loop.body import CoilCommand
from flight.schema import reader as configuration
from flight.schema.bodies import Cage, TestbedConfig, as_testbed
from flight.schema.document import ConfigError, config_path
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, attitude_matrix
from knightcube.gnc.estimation.estimate import NOMINAL
from knightcube.gnc.guidance.plant import PathSample
from sim_hal.clock import SimClock
from sim_hal.rig import utc_ns
from sim_hal.settings import Simulation
from sim_hal.worlds.testbed import OrbitField

TEXT = config_path("cage").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def config() -> TestbedConfig:
    return as_testbed(configuration.parse(TEXT))


@pytest.fixture(scope="module")
def section() -> Simulation:
    found = configuration.simulation_section(TEXT, "cage", Simulation)
    assert found is not None
    return found


def _field(config: TestbedConfig, section: Simulation) -> CageField:
    assert config.cage is not None
    return CageField(config.cage, config.plant.field, SimClock(utc_ns(section.utc)))


def test_the_predicted_field_is_the_simulators_within_what_models_and_coils_differ(
    config: TestbedConfig, section: Simulation
) -> None:
    """The field of the flight software (WMM2025, SGP4) is within 1.5 uT of the simulator's.

    The simulator uses IGRF-14, a ring current and an orbit with J2.
    """
    assert section.cage is not None
    assert config.cage is not None
    believed, true = (
        _field(config, section),
        OrbitField(section.cage, config.cage.scale, section.utc, section.seed),
    )
    directions = []
    for seconds in (0.0, 7.0, 23.0, 24.0, 900.0, 2_400.0, 3_900.0, 5_600.0, 5_599.0):
        x, y, z = believed.at(round(seconds * SECOND_NS))
        assert y == 0.0
        there = np.array(true.at(seconds)) / section.cage.gain
        assert np.array([x, z]) == pytest.approx(there, abs=1.5e-6)
        directions.append(np.arctan2(x, z))
    assert np.ptp(np.unwrap(directions[3:8])) > 4.0


def test_the_axes_of_the_local_frame_are_nadir_and_the_direction_of_flight() -> None:
    frame = local_frame(np.array([7e6, 0.0, 0.0]), np.array([10.0, 7.5e3, 0.0]))
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    assert frame @ np.array([-1.0, 0.0, 0.0]) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)
    assert frame @ np.array([0.0, 1.0, 0.0]) == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    # The axis y points opposite to the orbit normal, which is +z.
    assert frame[1] == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)


class _Fixed:
    """A test double of field model, sensor and tracker, with constant field, angle and current."""

    def __init__(self, field: FloatArray, angle: float, current: float) -> None:
        self._field, self._angle, self._current = field, angle, current

    def at(self, _: int) -> FloatArray:
        return self._field

    def read(self, whole: Any) -> ThreadEstimate:
        return ThreadEstimate(0, self._angle, 0.0, 0.0, 0, whole, NOMINAL)

    def command(self, _: Any, __: Any) -> CoilCommand:
        currents = np.array([self._current, 0.0, 0.0])
        return CoilCommand(currents, currents, False)

    def reset(self) -> None:
        """Do nothing, because the law has no state."""


@pytest.mark.parametrize("direction", np.linspace(0.0, 2.0 * np.pi, 9))
def test_two_coils_make_the_torque_of_one_coil_in_any_field_with_less_current(
    config: TestbedConfig, direction: float
) -> None:
    """Two coils give the commanded torque of coil x in any field, with less current than coil x.

    Two coils give a torque even if the field is along body x, where coil x alone gives no torque.
    """
    plant, dipole = plant_of(config), config.plant.coil_turns * config.plant.coil_area
    for angle in (-0.6, 0.0, 0.4):
        field = 1.1 * config.plant.field * np.array([np.sin(direction), 0.0, np.cos(direction)])
        fixed: Any = _Fixed(field, angle, 0.1)
        estimate: Any = type("Now", (), {"time_ns": 0})
        found = CageTracker(fixed, fixed, plant, fixed, dipole).command(estimate, PathSample(0.0, 0.0, 0.0))
        torque = np.cross(dipole * found.currents, attitude_matrix(about_axis_y(angle)) @ field)
        assert torque[1] == pytest.approx(plant.torque_constant * 0.1 * np.cos(angle), rel=1e-9)
        assert not found.saturated
        assert np.linalg.norm(found.currents) <= 0.1 * np.cos(angle)
        assert found.dipole == pytest.approx(dipole * found.currents)


def test_plans_assume_no_larger_field_than_that_of_the_cage(
    config: TestbedConfig, section: Simulation
) -> None:
    strong = configuration.replace(config, plant=configuration.replace(config.plant, field=4.5e-4))
    with pytest.raises(ConfigError, match=r"plant.field.*must not exceed 0.000189 T"):
        _field(strong, section)
    assert config.cage is not None
    none = configuration.replace(config, cage=Cage(elements=("1 nothing", "2 nothing")))
    with pytest.raises(ConfigError, match=r"cage.elements.*not valid two-line elements"):
        _field(none, section)
