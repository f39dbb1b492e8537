"""Tests that paths about one axis, slews and attitude laws equal their recorded results.

To save time, the slews have few collocation nodes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from knightcube.astro.quaternion import normalise
from knightcube.gnc.guidance.attitude_law import BodyAxes, law_of, references
from knightcube.gnc.guidance.plant import SingleAxisPlant
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import (
    AttitudeEnd,
    BoresightEnd,
    Cone,
    EndConditions,
    SlewTask,
)
from knightcube.gnc.guidance.slew_plan import plan_task
from knightcube.gnc.guidance.slew_search import SlewSolver, guesses
from knightcube.gnc.guidance.vmc import StepPlan, plan
from tests.support.flights import demo_config
from tests.support.random_slews import orbit, slews
from tests.support.recorded_flights import unlike_record
from tests.support.recorded_results import check
from tests.support.recorded_slews import matrix, problem, task_of

SLEW = "E-cube-3u-sso-y90-300"


def task(nodes: int = 8, **changes: Any) -> SlewTask:
    """Return the task of a slew by 90 deg."""
    case = problem(SLEW)
    return replace(task_of(case, case["T"], nodes=nodes), **changes)


def test_a_slew_of_a_large_satellite_is_as_recorded() -> None:
    check(__file__, "3U", plan_task(task()), 1e-4)


def test_a_slew_of_a_small_satellite_is_as_recorded() -> None:
    case = problem("E-knightcube-1u-sso-y90-300")
    check(__file__, "1U", plan_task(task_of(case, case["T"], nodes=8)), 1e-4)


def test_a_slew_to_a_boresight_is_as_recorded() -> None:
    axis = np.array([0.0, 0.0, 1.0])
    direction = matrix(np.array(problem(SLEW)["qf"])).T @ axis
    end = BoresightEnd(axis, direction, np.zeros(3))
    check(__file__, "boresight", plan_task(task(end=lambda _: end)), 1e-4)


def test_a_slew_beside_a_cone_is_as_recorded() -> None:
    towards = normalise(np.array([0.3, -0.6, 0.7]))
    cone = Cone("Sun", np.array([0.0, -1.0, 0.0]), lambda times: np.tile(towards, (len(times), 1)), 0.3)
    check(__file__, "cone", plan_task(task(cones=(cone,))), 1e-4)


def test_a_random_slew_is_as_recorded() -> None:
    *_, (_, random) = slews(3, 5, False)
    check(__file__, "random", plan_task(replace(random, nodes=10)), 1e-4)


def test_the_first_guesses_of_a_slew_are_as_recorded() -> None:
    (_, random), *_ = slews(1, 43, True)
    solver = SlewSolver(random)
    equations = solver.equations(random.horizon, 10)
    kept = solver.kept(equations)
    found = guesses(equations, random.craft, kept)
    check(__file__, "guesses", found)
    trajectory = found[0]
    check(
        __file__,
        "equations",
        [
            equations.cost(trajectory),
            equations.remainders(trajectory),
            equations.ends_missed(trajectory),
            equations.linear(trajectory),
            kept.values(trajectory.states[1:, :4]),
            kept.slopes(trajectory.states[1:, :4]),
        ],
    )


def test_the_conditions_at_the_end_are_as_recorded() -> None:
    rng = np.random.default_rng(31)
    x, pull = rng.normal(size=7), rng.normal(size=6)
    ends = (
        AttitudeEnd(normalise(rng.normal(size=4)), 1e-3 * rng.normal(size=3)),
        BoresightEnd(np.array([0.6, 0.0, 0.8]), normalise(rng.normal(size=3)), 1e-3 * rng.normal(size=3)),
    )
    found = []
    for end in ends:
        conditions = EndConditions(end, 120.0)
        missed = conditions.miss(x)
        found.append([missed, conditions.slope(x), conditions.curvature(pull[: len(missed)]), end.misses()])
    check(__file__, "ends", found)


def test_the_attitude_of_each_goal_is_as_recorded() -> None:
    axes, path = BodyAxes(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])), orbit("SSO")
    times = np.linspace(100.0, 4000.0, 9)
    targets = {
        "nadir": PointingTarget(Goal.NADIR, roll=0.2),
        "velocity": PointingTarget(Goal.VELOCITY),
        "sun": PointingTarget(Goal.SUN, roll=-0.4),
        "inertial": PointingTarget(Goal.INERTIAL, (0.5, -0.5, 0.5, 0.5)),
        "ground": PointingTarget(Goal.GROUND, (0.8, 0.2), 0.1),
    }
    found: dict[str, Any] = {}
    for name, target in targets.items():
        law = law_of(target, axes, normalise(np.array([0.1, -0.3, 0.2, 0.9])), path, 100.0)
        found[name] = [references(law, path, times), target.text]
    check(__file__, "laws", found)


def plant(current_limit: float | None = None) -> SingleAxisPlant:
    """Return the testbed of the demonstration with a changed current limit (A)."""
    config = demo_config(1.0)
    if current_limit is not None:
        coils = configuration.replace(config.coils, current_limit=current_limit)
        config = configuration.replace(config, coils=coils)
    return plant_of(config)


_ROUNDING = 1e-10
"""Largest rounding error of a path coefficient that is zero in exact arithmetic."""


def without_counts(found: StepPlan) -> StepPlan:
    """Return a plan without its number of evaluations, which depends on the processor's rounding."""
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
