"""Tests of filter steps: integral of the commanded dipole, and steps with and without a gyro rate."""

from __future__ import annotations

import numpy as np
import pytest

from flight.bodies.orbit import propagation
from flight.bodies.orbit.propagation import DipoleHistory, OpenStep, RateByField
from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.quaternion import IDENTITY
from knightcube.gnc.estimation.free_filter import STATES, FilterEnvironment
from tests.support.compiled_forms import assert_forms_agree

NOTHING = np.zeros(3)
AROUND = FilterEnvironment(NOTHING, np.ones(3), Pressures(np.zeros((1, 3)), np.zeros((1, 3))), 1.0)


def reading(time_ns: int, rate: float) -> ImuReading:
    """Return a reading with the same rate about all axes."""
    return ImuReading(time_ns, time_ns, time_ns, IDENTITY, np.full(3, rate), NOTHING, NOTHING)


@pytest.mark.parametrize("dead_from", [0, 3, 4])
def test_a_step_averages_only_the_valid_gyro_rates(dead_from: int) -> None:
    step = OpenStep(0, acts=True)
    totals = np.outer([0.1, 0.3, 0.6, 1.0], [1.0, 0.0, 0.0])
    for k, total in enumerate(totals):
        step.add(reading((k + 1) * 100, 0.2 * k if k < dead_from else np.nan), total, listens=False)
    by_field = RateByField(np.full(3, 7.0), np.eye(3))
    found = step.close(NOTHING, 0.0, AROUND, by_field)
    assert found.samples == dead_from
    if not dead_from:
        assert (found.gyro == by_field.rate).all()
        assert found.spread is by_field.covariance
        return
    assert found.spread is None
    assert found.gyro == pytest.approx(np.full(3, 0.1 * (dead_from - 1)))
    assert found.gyro_ns == 50 * (dead_from + 1)
    # The impulse covers the whole step, even if the last reading has no rate.
    assert found.impulse[0] == pytest.approx(1.0 - totals[:dead_from, 0].mean())


def test_the_mean_dipole_is_that_on_the_wire() -> None:
    history = DipoleHistory(10 * SECOND_NS)
    assert history.at_rest_since() is not None
    history.record(0, (0.0, 0.0, 0.0), True)
    history.record(2 * SECOND_NS, (0.1, 0.0, 0.0), True)
    assert history.at_rest_since() is None
    history.record(3 * SECOND_NS, (0.0, 0.0, 0.0), True)
    assert history.mean(SECOND_NS, 5 * SECOND_NS) == pytest.approx([0.025, 0.0, 0.0])
    assert history.at_rest_since() == 3 * SECOND_NS


def test_the_impulse_of_a_dipole_is_that_by_which_a_rate_differs_from_its_mean() -> None:
    """The impulse of a dipole is the final rate minus the mean rate that the dipole causes.

    A dipole that acts in the last quarter of a second changes the mean rate of this second by an eighth of
    the change of the final rate.
    """
    history = DipoleHistory(10 * SECOND_NS)
    history.record(0, (0.0, 0.0, 0.0), True)
    history.record(3 * SECOND_NS // 4, (0.0, 0.08, 0.0), True)
    found = history.impulse(0, SECOND_NS)
    assert found == pytest.approx([0.0, 0.08 * (0.25 - 0.25**2 / 2.0), 0.0])
    history.record(2 * SECOND_NS, (0.0, 0.0, 0.0), True)
    assert history.impulse(SECOND_NS, 2 * SECOND_NS) == pytest.approx([0.0, 0.04, 0.0]), (
        "half of a constant dipole"
    )


def test_compiled_and_interpreted_covariances_of_a_propagated_estimate_agree() -> None:
    generator = np.random.default_rng(3)
    root = generator.normal(size=(STATES, STATES))
    inertia = np.diag([1.1e-3, 1.05e-3, 0.99e-3]) + 1e-5
    dipole, middle, after = (0.01, -0.02, 0.03), (0.02, -0.01, 0.015), (0.1, 0.2, 0.3)
    rotation = (0.1, -0.5, 0.1, 0.73**0.5)
    moved = (0.13, dipole, rotation, after, middle, (1e-5, 2e-5, -3e-5))
    layout = propagation._MOVING, propagation._FROM, propagation._TO, propagation._SIZE
    noise = 1e-3 * np.eye(3)
    inverse = np.linalg.inv(inertia)
    assert_forms_agree(propagation._spread, root @ root.T, inertia, inverse, moved, noise, *layout)


def test_the_compiled_motion_of_a_propagated_estimate_equals_the_plain_motion() -> None:
    inertia = ((1.1e-3, 1e-5, 0.0), (1e-5, 1.05e-3, 2e-5), (0.0, 2e-5, 0.99e-3))
    inverse = ((910.0, -9.0, 0.2), (-9.0, 950.0, -19.0), (0.2, -19.0, 1010.0))
    coils = ((1.0, 0.01, 0.0), (0.02, 0.98, 0.0), (0.0, -0.01, 1.02))
    vectors = (0.1, 0.12, -0.05), (1e-5, 2e-5, -3e-5)
    given = 0.2, (0.01, -0.02, 0.03), coils, (1e-4, -2e-4, 1e-4), inertia, inverse, *vectors
    assert_forms_agree(propagation._rotated, *given, relative=1e-14)
