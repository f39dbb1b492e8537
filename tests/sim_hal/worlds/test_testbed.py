"""Tests that the simulated testbed obeys its equation of motion, and has the field of a Helmholtz pair."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flight.schema import reader
from flight.schema.bodies import as_testbed
from flight.schema.document import config_path
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, attitude_matrix
from sim_hal.worlds.testbed import Testbed, TestbedModel, helmholtz_field

SECOND = 1_000_000_000


def bed(
    current: FloatArray, angle: float = 0.0, rate: float = 0.0, stiffness: float = 0.0, damping: float = 0.0
) -> Testbed:
    model = TestbedModel(
        inertia=1.05e-3,
        dipole_per_ampere=80 * 0.0081,
        field=4.5e-4,
        stiffness=stiffness,
        damping=damping,
        resistance=(23.0, 20.0, 17.0),
        supply_voltage=3.4,
    )
    world = Testbed(model, angle, rate, lambda: current)
    world.release_at(0)
    world.advance_to(0)
    return world


def test_a_free_body_turns_at_constant_rate() -> None:
    world = bed(np.zeros(3), angle=0.1, rate=-0.02)
    world.advance_to(10 * SECOND)
    assert world.angle == pytest.approx(0.1 - 0.2, abs=1e-12)


def test_the_body_does_not_move_before_its_release() -> None:
    model = TestbedModel(1.05e-3, 0.648, 4.5e-4, 0.0, 0.0, (23.0, 23.0, 23.0), 3.4)
    world = Testbed(model, 0.3, -0.1, lambda: np.array([0.1, 0.0, 0.0]))
    world.advance_to(2 * SECOND)
    assert (world.angle, world.rate, world.energy) == (0.3, 0.0, 0.0)
    world.release_at(3 * SECOND)
    world.advance_to(4 * SECOND)
    free = bed(np.array([0.1, 0.0, 0.0]), angle=0.3, rate=-0.1)
    free.advance_to(SECOND)
    assert (world.angle, world.rate) == pytest.approx((free.angle, free.rate), abs=1e-12)
    assert world.energy == pytest.approx(0.23)


def test_the_body_on_the_thread_swings_with_the_period_of_a_torsion_pendulum() -> None:
    world = bed(np.zeros(3), angle=0.3, stiffness=1e-5)
    period = 2 * math.pi * math.sqrt(1.05e-3 / 1e-5)
    world.advance_to(round(period * SECOND))
    assert (world.angle, world.rate) == pytest.approx((0.3, 0.0), abs=1e-7)


def test_damping_takes_the_rate_down_exponentially() -> None:
    world = bed(np.zeros(3), rate=0.1, damping=2e-6)
    world.advance_to(100 * SECOND)
    assert world.rate == pytest.approx(0.1 * math.exp(-2e-6 / 1.05e-3 * 100.0), rel=1e-9)


def test_one_coil_under_constant_current_keeps_the_energy_of_a_dipole_in_a_field() -> None:
    """Under a constant current, the energy J w^2/2 - n A B I sin(theta) is constant.

    The torque is n A B I cos(theta) (5.4).
    """
    world = bed(np.array([0.1, 0.0, 0.0]))
    world.advance_to(9 * SECOND)
    torque_constant = 80 * 0.0081 * 4.5e-4
    energy = 0.5 * 1.05e-3 * world.rate**2 - torque_constant * 0.1 * math.sin(world.angle)
    assert world.angle > 0.5
    assert energy == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("angle", [-0.7, 0.0, 0.4])
def test_the_torque_is_the_cross_product_of_dipole_and_field(angle: float) -> None:
    """The torque is the cross product of dipole and field.

    The rate 1 ms after the start from rest is compared with m x B, where B is in body axes.
    """
    current = np.array([0.07, 0.05, -0.03])
    world = bed(current, angle=angle)
    field_body = attitude_matrix(about_axis_y(angle)) @ np.array([0.0, 0.0, -4.5e-4])
    torque = np.cross(80 * 0.0081 * current, field_body)[1]
    world.advance_to(SECOND // 1000)
    assert world.rate == pytest.approx(torque / 1.05e-3 * 1e-3, rel=1e-4)


def test_field_and_specific_force_in_body_axes_agree_with_the_attitude() -> None:
    motion = bed(np.zeros(3), angle=0.6, rate=0.02).motion(0)
    matrix = attitude_matrix(motion.quaternion)
    np.testing.assert_allclose(motion.field_body, matrix @ [0.0, 0.0, -4.5e-4], atol=1e-18)
    np.testing.assert_allclose(motion.specific_force_body, matrix @ [0.0, -9.80665, 0.0], atol=1e-12)
    np.testing.assert_array_equal(motion.rate, [0.0, 0.02, 0.0])


def test_energy_of_coils_and_of_the_supply_are_integrated() -> None:
    world = bed(np.array([0.1, -0.05, 0.02]))
    world.advance_to(2 * SECOND)
    assert world.energy == pytest.approx(2 * (23 * 0.01 + 20 * 0.0025 + 17 * 0.0004))
    assert world.supply_energy == pytest.approx(2 * 3.4 * 0.17)


def test_the_result_does_not_depend_on_the_time_steps() -> None:
    whole, pieces = (bed(np.array([0.1, 0, 0]), angle=0.2, rate=-0.1, stiffness=1e-5) for _ in range(2))
    whole.advance_to(5 * SECOND)
    for k in range(1, 1001):
        pieces.advance_to(k * 5 * SECOND // 1000)
    assert pieces.angle == pytest.approx(whole.angle, abs=1e-10)


RADIUS, CURRENT, MEASURED = 0.15, 2.19, 9.98e-4
"""Radius (m), current (A) and field (T) by the thesis: "approximately 15 cm", "9.98 gauss ... at a current
of 2.19 A"."""
TURNS = 76
"""Number of turns of each coil, from eq. 5.34 and the measured field. The thesis does not state the number of
turns."""


def test_the_measured_field_is_that_of_76_turns() -> None:
    assert helmholtz_field(TURNS, CURRENT, RADIUS) == pytest.approx(MEASURED, rel=2e-3)
    for other in (TURNS - 1, TURNS + 1):
        assert helmholtz_field(other, CURRENT, RADIUS) != pytest.approx(MEASURED, rel=1e-2)


def test_the_field_that_is_flown_takes_0_99_ampere() -> None:
    """The field of the thesis requires 0.99 A in the coils of the testbed.

    The thesis states 4.5 gauss, "approximately 9 times Earth's ambient magnetic field strength".
    """
    flown = as_testbed(reader.load(config_path("step_simulation"))).plant.field
    current = CURRENT * flown / MEASURED
    assert current == pytest.approx(0.99, abs=0.005)
    assert helmholtz_field(TURNS, current, RADIUS) == pytest.approx(4.5e-4, rel=2e-3)
    assert flown == pytest.approx(9 * 0.5e-4)


def test_the_field_is_that_of_biot_and_savart_summed_over_two_loops() -> None:
    """The field is the sum of mu0 I R^2 / (2 (R^2 + z^2)^1.5) for two loops at z = R / 2."""
    mu, radius = 1.25663706127e-6, 0.3  # value of CODATA 2022
    loop = mu * radius**2 / (2.0 * (radius**2 + (radius / 2.0) ** 2) ** 1.5)
    assert helmholtz_field(10, 2.0, radius) == pytest.approx(2 * 10 * 2.0 * loop, rel=1e-8)
