"""Tests of slews planned by virtual motion camouflage, against recorded optima and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.errors import PlanningError
from knightcube.gnc.guidance.slew_model import BoresightEnd, Cone
from knightcube.gnc.guidance.slew_plan import SlewStatus
from knightcube.gnc.guidance.slew_vmc import (
    ObservedPaths,
    VmcProgram,
    plan_near,
    plan_task,
    prey_paths,
)
from knightcube.gnc.guidance.vmc_program import SamplePoints, discretisation
from tests.support.recorded_slews import flown, matrix, off_degrees, problem, task_of


def test_a_slew_needs_the_heat_of_the_recorded_optimum_and_its_dipoles_reach_the_target() -> None:
    case = problem("E-cube-3u-sso-nadir-600")
    task = task_of(case, case["T"])
    plan = plan_task(task)
    assert plan.status is SlewStatus.OPTIMAL
    assert plan.energy == pytest.approx(case["energy_J"], rel=2e-3)
    assert plan.peak == pytest.approx(case["peak_share"], rel=0.03)
    end = flown(plan, task)
    assert off_degrees(end[:4], np.array(case["qf"])) <= 0.005
    np.testing.assert_allclose(end[4:], case["wf"], atol=2e-7)
    again = plan_near(task, plan.path)
    assert again is not None
    assert again.energy == pytest.approx(plan.energy, rel=1e-4)


def test_a_boresight_end_with_a_free_roll_reaches_the_direction_with_less_heat() -> None:
    case = problem("E-cube-3u-sso-y90-300")
    axis = np.array([0.0, 0.0, 1.0])
    direction = matrix(np.array(case["qf"])).T @ axis
    task = replace(task_of(case, case["T"]), end=lambda _: BoresightEnd(axis, direction, np.zeros(3)))
    plan = plan_task(task)
    assert plan.energy < case["energy_J"]
    assert matrix(flown(plan, task)[:4]) @ direction == pytest.approx(axis, abs=1e-4)


def test_a_slew_shorter_than_the_least_time_is_refused_with_the_durations() -> None:
    case = problem("T-knightcube-1u-iss-B90")
    task = task_of(case, 0.6 * case["T"], longest=0.6 * case["T"])
    with pytest.raises(
        PlanningError, match=r"virtual motion camouflage: no slew .* over 51\.\d+ to 51\.\d+ s"
    ):
        plan_task(task)
    with pytest.raises(PlanningError, match="slews of a given duration"):
        plan_task(replace(task, time_cost=1.0))


def test_the_gradients_of_heat_and_constraints_equal_finite_differences() -> None:
    case = problem("E-knightcube-1u-iss-B90-300")
    axis = np.array([0.0, 1.0, 0.0])
    cone = Cone("Sun", axis, lambda times: np.broadcast_to(np.array([0.6, 0.0, 0.8]), (len(times), 3)), 0.3)
    task = task_of(case, case["T"], cones=(cone,))
    program = VmcProgram(task, case["T"], next(iter(prey_paths(task, case["T"]))), count=10)
    rng = np.random.default_rng(5)
    y, way = 0.1 * rng.normal(size=(2, program.size))
    for values in (program.heat, program.along_field, program.excess):
        step = 1e-4
        slope = (np.asarray(values(y + step * way)[0]) - values(y - step * way)[0]) / (2.0 * step)
        found = values(y)[1] @ way
        np.testing.assert_allclose(found, slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


def test_the_motion_is_that_of_the_path_to_which_the_parameters_belong() -> None:
    """A motion is the polynomial through the nodes, plus the basis times the parameters y."""
    case = problem("E-knightcube-1u-iss-B90-300")
    task = task_of(case, case["T"])
    rule = discretisation(10).rule
    rng = np.random.default_rng(3)
    nodes, basis, y = rng.normal(size=(10, 3)), rng.normal(size=(10, 3, 4)), rng.normal(size=4)
    at_nodes = SamplePoints.at(rule, rule.nodes)
    given = task, case["T"], task.quaternion, np.empty((0, 1)), at_nodes
    path, first, second = ObservedPaths(*given, nodes, basis).motion(y)
    np.testing.assert_allclose(path, nodes + basis @ y, atol=1e-12)
    np.testing.assert_allclose(first, 2.0 * rule.differentiation @ path, atol=1e-9)
    np.testing.assert_allclose(second, 2.0 * rule.differentiation @ first, atol=1e-7)
