"""Tests that the testbed's noise model agrees with the errors of its coil current."""

from __future__ import annotations

import numpy as np
import pytest

from flight.bodies.testbed import body
from tests.support.flights import demo_config


def test_the_acceleration_noise_is_the_scatter_of_the_rate_by_current_errors_in_each_cycle() -> None:
    """The acceleration noise is the random walk of the rate by 40 independent current errors a second."""
    config = demo_config(10.0)
    plant, error = config.plant, config.estimation.current_noise
    torque = plant.coil_turns * plant.coil_area * plant.field * error
    scatter = np.sqrt(40.0) * 0.025 * torque / plant.inertia
    density = body.TestbedEstimation(config, {}).angular_acceleration_psd(0)
    assert np.sqrt(density * 1.0) == pytest.approx(scatter * np.eye(3))
