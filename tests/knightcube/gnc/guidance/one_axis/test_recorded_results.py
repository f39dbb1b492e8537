"""Tests that single-axis plans and short runs along them equal their recorded results to four digits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant
from knightcube.gnc.guidance.one_axis.vmc import StepPlan, plan
from tests.support.flights import demo_config
from tests.support.recorded_flights import unlike_record
from tests.support.recorded_results import check


def plant(current_limit: float | None = None) -> SingleAxisPlant:
    """Return the demonstration's testbed with another current limit (A)."""
    config = demo_config(1.0)
    if current_limit is not None:
        coils = configuration.replace(config.coils, current_limit=current_limit)
        config = configuration.replace(config, coils=coils)
    return plant_of(config)


_ROUNDING = 1e-10
"""Largest value that rounding gives to a path coefficient that should be exactly zero."""


def without_counts(found: StepPlan) -> StepPlan:
    """Return a plan without its number of evaluations, which depends on the rounding of the processor."""
    return replace(found, evaluations=0)


def test_a_plan_from_rest_is_as_recorded() -> None:
    check(__file__, "rest", without_counts(plan(plant(), -0.3, 0.0, -0.2, 0.0, 10.0)), 1e-3, _ROUNDING)


def test_a_plan_from_a_rotating_body_is_as_recorded() -> None:
    check(__file__, "rotating", without_counts(plan(plant(), 0.1, 0.03, -0.15, 0.0, 12.0)), 1e-3, _ROUNDING)


def test_a_plan_that_must_be_stretched_is_as_recorded() -> None:
    check(__file__, "stretched", without_counts(plan(plant(0.08), -0.3, 0.0, 0.0, 0.0, 6.0)), 1e-3, _ROUNDING)


def test_the_motion_of_the_plant_is_as_recorded() -> None:
    angle, rate = np.array([0.1, -0.4, 0.6]), np.array([0.0, 0.05, -0.1])
    check(__file__, "currents", plant().currents(angle, rate, np.array([0.0, 0.01, -0.02])))


def test_a_flight_along_its_plans_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("steps", tmp_path) == []


def test_a_flight_with_new_targets_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("commands", tmp_path) == []
