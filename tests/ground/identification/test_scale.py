"""Tests of the absolute scale of inertia, dipole and field, and of its uncertainty.

The motion determines only ratios of the constants to the inertia. The prior and the magnetometer determine
the scale.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from flight.schema.reader import parse
from flight.schema.testbed import as_testbed
from ground.identification.fit import (
    AbsolutePlant,
    MotionConstants,
    PlantFit,
    PlantPrior,
    PriorValue,
    absolute,
    config_text,
    excitation_config,
    plant_section,
    plant_text,
    prior_of,
)
from ground.identification.record import HorizontalField
from tests.ground.identification.conftest import Identified
from tests.ground.identification.worlds import believed, drawn, scale_error
from tests.support import flights

PRIOR = prior_of(believed())


def scaled(found: PlantFit, prior: PlantPrior, field: float | None) -> AbsolutePlant:
    measured = None if field is None else HorizontalField(field, 0.0, 100)
    return absolute(found, prior, measured)


def test_over_many_worlds_the_uncertainty_of_all_constants_is_true(identified: list[Identified]) -> None:
    """The mean chi-square of 80 worlds that are drawn from the prior is in its expected band.

    The constants from the motion are the true constants plus random errors of the stated covariance.
    """
    rng = np.random.default_rng(3)
    _, _, made = identified[0]
    squares, keep = [], [0, 1, 2, 4, 5]
    for _ in range(80):
        world = drawn(rng)
        noise = rng.multivariate_normal(np.zeros(6), made.covariance, method="cholesky")
        found = replace(made, constants=MotionConstants.of(world.constants.to_array() + noise))
        plant = scaled(found, PRIOR, world.field * world.magnetometer)
        error = scale_error(world, plant)[keep]
        squares.append(error @ np.linalg.solve(plant.covariance[np.ix_(keep, keep)], error))
    low, high = chi2.ppf([0.001, 0.999], 5 * 80) / 80
    assert low < np.mean(squares) < high


def test_the_ratios_of_the_motion_are_kept(identified: list[Identified]) -> None:
    for world, _, made in identified:
        plant = scaled(made, PRIOR, world.field)
        gain = plant.torque_constant.value / plant.inertia.value
        assert gain == pytest.approx(made.constants.gain, abs=0.1 * made.sigma("gain"))
        ratio = plant.stiffness.value / plant.inertia.value
        assert ratio == pytest.approx(made.constants.torsion, abs=0.1 * made.sigma("torsion"))


def test_an_inertia_known_for_sure_makes_the_torque_constant_of_the_motion(
    identified: list[Identified],
) -> None:
    world, _, made = identified[0]
    sure = replace(PRIOR, inertia=PriorValue(world.inertia, 1e-9))
    plant = scaled(made, sure, None)
    assert plant.inertia.value == pytest.approx(world.inertia)
    assert plant.inertia.own_prior == pytest.approx(1.0)
    expected = made.constants.gain * world.inertia
    assert plant.torque_constant.value == pytest.approx(expected, rel=1e-4)
    assert plant.torque_constant.sigma == pytest.approx(made.sigma("gain") * world.inertia, rel=1e-3)


def test_without_a_magnetometer_the_field_is_as_uncertain_as_believed_and_says_so(
    identified: list[Identified],
) -> None:
    world, _, made = identified[0]
    blind, seeing = scaled(made, PRIOR, None), scaled(made, PRIOR, world.field)
    assert blind.field.sigma > 3.0 * seeing.field.sigma
    assert blind.inertia.sigma > seeing.inertia.sigma
    assert "magnetometer" in seeing.sources()["field"]
    assert "magnetometer" not in blind.sources()["field"]


def test_the_share_of_the_prior_is_how_much_the_answer_follows_it(identified: list[Identified]) -> None:
    """If the prior changes by 1 %, the result changes by 1 % times the stated weight of the prior."""
    world, _, made = identified[0]
    before = scaled(made, PRIOR, world.field)
    moved = replace(PRIOR, inertia=replace(PRIOR.inertia, value=PRIOR.inertia.value * 1.01))
    after = scaled(made, moved, world.field)
    follows = np.log(after.inertia.value / before.inertia.value) / np.log(1.01)
    assert before.inertia.own_prior == pytest.approx(follows, abs=1e-6)
    assert 0.0 < follows < 1.0


def test_the_fragment_takes_the_place_of_the_plant_section(identified: list[Identified]) -> None:
    world, _, made = identified[0]
    plant = scaled(made, PRIOR, world.field)
    head, rest = flights.TEXT.split("plant:", 1)
    _, tail = rest.split("inertial_unit:", 1)
    config = as_testbed(parse(head + plant_text(plant, 80, "a test") + "\ninertial_unit:" + tail))
    section = config.plant
    gain = section.coil_turns * section.coil_area * section.field / section.inertia
    assert gain == pytest.approx(made.constants.gain, rel=1e-5)
    assert section.thread_stiffness == pytest.approx(plant.stiffness.value, rel=1e-5)


def test_a_thread_that_comes_out_less_than_zero_is_none(identified: list[Identified]) -> None:
    _, _, made = identified[0]
    loose = replace(made, constants=replace(made.constants, torsion=-1e-7))
    plant = scaled(loose, PRIOR, None)
    assert plant_section(plant, 80).thread_stiffness == 0.0
    assert "set to zero" in plant_text(plant, 80, "a test")


def test_the_configuration_of_the_flight_survives_its_way_through_yaml() -> None:
    config = excitation_config(flights.demo_config(700.0), 200.0)
    assert parse(config_text(config)) == config
    assert config.camera is None
    assert config.control.tracker == "excitation"
