"""Tests of slews by coils alone, against the optima of another method and an independent integrator."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from unittest.mock import Mock

import numpy as np
import pytest

from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.errors import PlanningError
from knightcube.gnc.guidance import slew_plan
from knightcube.gnc.guidance.attitude_law import BodyAxes
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import (
    MINIMUM_TIME,
    AttitudeEnd,
    BoresightEnd,
    Cone,
    SlewCraft,
)
from knightcube.gnc.guidance.slew_plan import SlewOrder, SlewStatus, plan_near, plan_order, plan_task
from knightcube.gnc.guidance.slew_search import SlewSearch
from tests.support.circular_orbits import circular
from tests.support.random_slews import clearance, slews
from tests.support.recorded_slews import (
    flown,
    matrix,
    off_degrees,
    problem,
    task_of,
)
from tests.support.small_slews import small_slew


@pytest.mark.parametrize(
    "name", ["E-cube-3u-sso-y90-300", "E-cube-3u-sso-nadir-600", "E-knightcube-1u-sso-y90-300"]
)
def test_a_slew_costs_what_the_optimum_does_and_its_dipoles_end_in_the_target(name: str) -> None:
    case = problem(name)
    task = task_of(case, case["T"])
    plan = plan_task(task)
    assert plan.status is SlewStatus.OPTIMAL
    assert plan.energy <= 1.0005 * case["energy_J"]
    assert plan.peak <= 1.001
    end = flown(plan, task)
    assert off_degrees(end[:4], np.array(case["qf"])) <= 0.005
    np.testing.assert_allclose(end[4:], case["wf"], atol=2e-7)


def test_a_horizon_that_does_not_suffice_is_stretched_and_the_limit_kept() -> None:
    case = problem("T-knightcube-1u-iss-B90")
    task = task_of(case, 0.98 * case["T"], longest=2.0 * case["T"], nodes=16)
    plan = plan_task(task)
    assert plan.status is SlewStatus.STRETCHED
    assert case["T"] * 0.999 < plan.horizon < 1.02 * case["T"]
    assert plan.peak <= 1.001


def test_a_slew_of_least_time_is_found_although_the_first_path_cannot_be_flown() -> None:
    """A slew of minimum time is found, although its first path is too short and cannot be integrated."""
    case = problem("T-knightcube-1u-sso-y180")
    task = task_of(case, case["T"], time_cost=MINIMUM_TIME)
    plan = plan_task(task)
    assert plan.horizon <= 1.02 * case["T"]
    assert plan.peak <= 1.001
    assert off_degrees(flown(plan, task)[:4], np.array(case["qf"])) <= 0.005


def test_if_no_guess_leads_to_a_path_a_longer_slew_is_shortened_to_the_requested_horizon() -> None:
    """If no initial guess leads to a path of the requested duration, a longer slew is planned and shortened.

    The slew is case 21 of `bench orbit_slews`.
    """
    *_, (_, task) = slews(22, 1, False)
    plan = plan_task(task)
    assert plan.status is SlewStatus.OPTIMAL
    assert plan.horizon == pytest.approx(task.horizon)
    assert plan.peak <= 1.001


def test_a_boresight_with_a_free_roll_reaches_its_direction_and_keeps_out_of_a_cone() -> None:
    case = problem("E-cube-3u-sso-y90-300")
    axis = np.array([0.0, 0.0, 1.0])
    direction = matrix(np.array(case["qf"])).T @ axis
    task = replace(task_of(case, case["T"]), end=lambda _: BoresightEnd(axis, direction, np.zeros(3)))
    free = plan_task(task)
    assert free.energy < case["energy_J"]
    assert matrix(flown(free, task)[:4]) @ direction == pytest.approx(axis, abs=1e-4)
    middle = free.path.references(np.array([0.5 * free.horizon])).quaternion[0]
    way = matrix(middle).T @ axis
    cone = Cone("Sun", axis, lambda times: np.broadcast_to(way, (len(times), 3)), np.radians(20.0))
    around = plan_task(replace(task, cones=(cone,)))
    assert around.clearance[0] >= 0.0
    assert around.energy > free.energy


def test_a_slew_is_led_around_cones_that_every_path_without_limits_crosses() -> None:
    """A slew is led around the cones, although every path without limits passes through a cone.

    The slew is case 0 of `bench orbit_slews --cones --seed 43`.
    """
    (_, task), *_ = slews(1, 43, True)
    plan = plan_task(task)
    assert plan.status is SlewStatus.OPTIMAL
    assert plan.peak <= 1.001
    assert clearance(task, plan) >= 0.0


@pytest.mark.parametrize(("seed", "case"), [(43, 18), (43, 40), (44, 44)])
def test_slews_are_planned_although_all_initial_guesses_cross_cones(seed: int, case: int) -> None:
    """Slews are planned although all initial guesses by rotations about the field pass through cones.

    In the first two of the three slews, all rotations about the field pass through cones.
    """
    *_, (_, task) = slews(case + 1, seed, True)
    plan = plan_task(task)
    assert plan.peak <= 1.001
    assert clearance(task, plan) >= 0.0
    end = task.end(plan.horizon)
    assert isinstance(end, AttitudeEnd)
    assert off_degrees(flown(plan, task)[:4], end.quaternion) <= 0.005


def test_a_path_beyond_the_limit_when_flown_takes_longer() -> None:
    """A path whose dipoles with feedback exceed their limit is planned again with a longer duration.

    In case 27 of `bench orbit_slews --seed 44` the dipoles exceed their limit by 1.4 %.
    """
    *_, (_, task) = slews(28, 44, False)
    plan = plan_task(task)
    assert plan.status is SlewStatus.STRETCHED
    assert plan.peak <= 1.001
    assert plan.horizon < 1.2 * task.horizon


def test_a_plan_near_that_of_nearly_the_same_task_takes_a_tenth_of_the_steps() -> None:
    (_, task), *_ = slews(1, 43, True)
    plan = plan_task(task)
    turned = replace(task, craft=replace(task.craft, torque=np.array([2e-9, -1e-9, 1e-9])))
    again = plan_task(turned, plan.path)
    assert again.horizon == pytest.approx(task.horizon)
    assert again.steps < 30
    assert again.energy < 1.05 * plan_task(turned).energy
    assert clearance(turned, again) >= 0.0


def test_a_plan_near_a_path_that_grazes_a_cone_needs_no_correction(monkeypatch: pytest.MonkeyPatch) -> None:
    *_, (_, task) = slews(4, 44, True)
    plan = plan_task(task)
    monkeypatch.setattr(SlewSearch, "widened", Mock(side_effect=AssertionError("corrected")))
    again = plan_near(task, plan.path)
    assert again is not None
    assert 0.0 <= clearance(task, plan) < np.radians(0.1)
    assert clearance(task, again) >= 0.0
    assert again.energy < 1.001 * plan.energy


@pytest.mark.parametrize(("duration", "given", "longest"), [(200.0, None, 600.0), (200.0, 250.0, 250.0)])
def test_a_slew_may_last_three_times_the_requested_duration_unless_a_longest_one_is_given(
    duration: float, given: float | None, longest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned = Mock(side_effect=PlanningError("not planned"))
    monkeypatch.setattr(slew_plan, "plan_order", planned)
    elements = (
        "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
        "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
    )
    with pytest.raises(PlanningError, match="not planned"):
        slew_plan.plan_slew(
            inertia=np.eye(3),
            dipole_limit=np.ones(3),
            heat=np.ones(3),
            elements=elements,
            time=datetime(2026, 3, 20, 12, 0),
            start=PointingTarget(Goal.NADIR),
            goal=PointingTarget(Goal.SUN),
            duration=duration,
            longest=given,
        )
    order, ephemeris, first = planned.call_args.args
    assert order.longest == longest
    assert ephemeris.times[-1] >= first + longest


def test_a_refusal_names_the_cone_in_which_the_ends_lie() -> None:
    case = problem("E-cube-3u-sso-y90-300")
    task = task_of(case, 20.0, longest=60.0, nodes=8)
    axis = np.array([1.0, 0.0, 0.0])
    there = matrix(task.end(20.0).quaternion)[0]  # type: ignore[union-attr]
    cone = Cone("Moon", axis, lambda times: np.tile(there, (len(times), 1)), 0.05)
    with pytest.raises(PlanningError, match=r"all of these, from 20 s on, end in .* cone of the Moon"):
        plan_task(replace(task, cones=(cone,)))


def test_tasks_that_no_path_can_fulfil_are_refused_with_the_reason() -> None:
    case = problem("E-cube-3u-sso-y90-300")
    task = task_of(case, 300.0)
    cone = Cone(
        "Moon",
        np.array([1.0, 0.0, 0.0]),
        lambda times: np.tile(matrix(task.quaternion)[0], (len(times), 1)),
        0.1,
    )
    for wrong, reason in (
        (replace(task, quaternion=2.0 * task.quaternion), "must have length 1"),
        (replace(task, rate=np.array([0.0, np.nan, 0.0])), "finite"),
        (replace(task, longest=100.0), "longest"),
        (replace(task, cones=(cone,)), "5.7 deg inside the exclusion cone of the Moon"),
        (replace(task, horizon=20.0, longest=24.0, nodes=8), "no slew within"),
    ):
        with pytest.raises(PlanningError, match=reason):
            plan_task(wrong)


def test_a_slew_with_coupled_heat_costs_what_it_does_in_the_axes_of_the_coils() -> None:
    """In axes rotated from the coils' axes, the heat has a full matrix, and the optimum has the same heat."""
    orbit, heat, inertia = circular(3_000.0), np.array([3.0, 30.0, 12.0]), np.array([0.0066, 0.0333, 0.0300])
    turn = attitude_matrix(from_rotation_vector(np.array([0.5, -0.7, 0.3])))
    order = SlewOrder(
        SlewCraft(np.diag(inertia), np.full(3, 1.0), heat),
        BodyAxes(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])),
        np.array([0.0, 0.0, 1.0]),
        PointingTarget(Goal.NADIR, roll=0.0),
        PointingTarget(Goal.SUN, roll=0.0),
        600.0,
        600.0,
        nodes=24,
    )
    along = plan_order(order, orbit, 20.0).plan
    turned = SlewCraft(turn @ np.diag(inertia) @ turn.T, np.full(3, 1.0), turn @ np.diag(heat) @ turn.T)
    axes = BodyAxes(turn[:, 2], turn[:, 0])
    tilted = plan_order(replace(order, craft=turned, axes=axes, camera=turn[:, 2]), orbit, 20.0).plan
    assert tilted.energy == pytest.approx(along.energy, rel=1e-4)
    assert tilted.path.heat(turned.weights) == pytest.approx(tilted.energy, rel=1e-3)
    # A plan that ignores the off-diagonal elements of the heat matrix has more heat.
    alone = replace(turned, weights=np.diag(turned.weights))
    careless = plan_order(replace(order, craft=alone, axes=axes, camera=turn[:, 2]), orbit, 20.0).plan
    assert careless.path.heat(turned.weights) > 1.02 * along.energy


def test_a_small_cost_of_time_gives_a_slow_slew_of_little_heat() -> None:
    """With a small cost of time, the optimal slew is slow, although much faster slews exist.

    A plan with a fixed duration bounds the cost of the plan with a free duration.
    """
    task = small_slew(nodes=8, horizon=240.0)
    cost = 0.02
    fixed, free = plan_task(task), plan_task(replace(task, time_cost=cost))
    assert free.energy + cost * free.horizon <= 1.01 * (fixed.energy + cost * fixed.horizon)
    assert free.horizon > 180.0
    assert free.peak < 0.5


def test_a_slew_over_a_whole_orbit_ends_in_its_target() -> None:
    """Over 6,000 s, the gravity gradient amplifies errors of the integration a thousand times.

    The dipoles of the plan are integrated in the environment of the task, in steps of 12.5 s.
    """
    *_, (_, task) = slews(2, 75, False)
    task = replace(task, horizon=6000.0, longest=6000.0)
    plan = plan_task(task)
    end = task.end(plan.horizon)
    assert isinstance(end, AttitudeEnd)
    assert off_degrees(flown(plan, task)[:4], end.quaternion) <= 0.005


def test_a_refusal_of_a_slew_in_long_intervals_states_the_number_of_nodes() -> None:
    text = slew_plan.refusal(small_slew(horizon=12_000.0, longest=20_000.0, nodes=24), 16)
    assert text.endswith(
        "in intervals of 500 s, the field rotates too far: give at least 48 nodes, or a shorter duration"
    )
    assert "nodes" not in slew_plan.refusal(small_slew(), 16)
