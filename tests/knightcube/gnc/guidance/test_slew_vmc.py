"""Tests of slews planned by virtual motion camouflage, against recorded optima and finite differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply, normalise
from knightcube.errors import PlanningError
from knightcube.gnc.guidance import slew_plan, slew_vmc
from knightcube.gnc.guidance.slew_model import BoresightEnd, Cone, SlewPath, SlewTask
from knightcube.gnc.guidance.slew_plan import SlewPlan, SlewStatus
from knightcube.gnc.guidance.slew_vmc import (
    ObservedPaths,
    VmcProgram,
    mrp_motion,
    mrp_slopes,
    plan_near,
    plan_task,
    prey_paths,
)
from knightcube.gnc.guidance.vmc_program import SamplePoints, discretisation
from tests.support.recorded_slews import flown, matrix, off_degrees, problem, task_of
from tests.support.small_slews import END_RATE, HEAT, INERTIA, LIMIT, START, TARGET, small_slew


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
    axis = np.array([0.0, 1.0, 0.0])
    cone = Cone("Sun", axis, lambda times: np.broadcast_to(np.array([0.6, 0.0, 0.8]), (len(times), 3)), 0.3)
    task = small_slew(cones=(cone,))
    program = VmcProgram(task, task.horizon, np.array(smooth_states()), count=10)
    rng = np.random.default_rng(5)
    y, way = 0.1 * rng.normal(size=(2, program.size))
    for values in (program.heat, program.along_field, program.excess):
        step = 1e-4
        slope = (np.asarray(values(y + step * way)[0]) - values(y - step * way)[0]) / (2.0 * step)
        found = values(y)[1] @ way
        np.testing.assert_allclose(found, slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


def test_the_motion_is_that_of_the_path_to_which_the_parameters_belong() -> None:
    """A motion is the polynomial through the nodes, plus the basis times the parameters y."""
    task = small_slew()
    rule = discretisation(10).rule
    rng = np.random.default_rng(3)
    nodes, basis, y = rng.normal(size=(10, 3)), rng.normal(size=(10, 3, 4)), rng.normal(size=4)
    at_nodes = SamplePoints.at(rule, rule.nodes)
    given = task, task.horizon, task.quaternion, np.empty((0, 1)), at_nodes
    path, first, second = ObservedPaths(*given, nodes, basis).motion(y)
    np.testing.assert_allclose(path, nodes + basis @ y, atol=1e-12)
    np.testing.assert_allclose(first, 2.0 * rule.differentiation @ path, atol=1e-9)
    np.testing.assert_allclose(second, 2.0 * rule.differentiation @ first, atol=1e-7)


def smooth_states(count: int = 49) -> FloatArray:
    """Return states (n, 7) of a rotation about the eigenaxis from START to TARGET, in one unit of time."""
    share = np.linspace(0.0, 1.0, count)[:, None]
    whole = np.array([0.8, -0.5, 0.6])
    turned = from_rotation_vector(share**2 * (3.0 - 2.0 * share) * whole)
    attitude = multiply(turned, np.broadcast_to(START, (count, 4)))
    return np.concatenate([attitude, 6.0 * share * (1.0 - share) * whole], axis=1)


def smooth_path(horizon: float) -> SlewPath:
    """Return the same rotation as a path, without dipole moments."""
    states = smooth_states()
    none = np.zeros((len(states), 3))
    times = np.linspace(0.0, horizon, len(states))
    return SlewPath(times, states[:, :4], states[:, 4:] / horizon, none, none)


@cache
def free_plan() -> tuple[SlewTask, SlewPlan]:
    """Return a task without cones and with a dipole limit above its optimum, and its plan."""
    task = small_slew(horizon=120.0, nodes=24)
    plan = plan_near(task, smooth_path(120.0))
    assert plan is not None
    return task, plan


def test_a_plan_from_a_rotation_about_the_eigenaxis_has_the_heat_of_the_collocation() -> None:
    """The plan ends at the target when its dipoles act on a body, and all its numbers describe its path."""
    task, plan = free_plan()
    assert (plan.status, plan.horizon, plan.horizon_asked) == (SlewStatus.OPTIMAL, 120.0, 120.0)
    end = flown(plan, task)
    assert off_degrees(end[:4], TARGET) <= 0.005
    np.testing.assert_allclose(matrix(end[:4]).T @ end[4:], END_RATE, atol=2e-6)
    times = np.linspace(0.0, 120.0, 40_001)
    dipoles = plan.path.dipoles(times)
    assert plan.energy == pytest.approx(120.0 * float((dipoles**2 @ HEAT).mean()), rel=1e-3)
    assert plan.peak == pytest.approx(float((np.abs(plan.path.dipole) / LIMIT).max()))
    assert 0.0 < plan.peak < 1.0
    assert plan.clearance == ()
    assert plan.steps >= 1
    other = slew_plan.plan_near(task, plan.path)
    assert other is not None
    assert plan.energy == pytest.approx(other.energy, rel=3e-3)


def test_a_dipole_limit_that_the_free_optimum_exceeds_is_kept_at_more_heat() -> None:
    task, free = free_plan()
    limit = 0.9 * free.peak * LIMIT
    tight = replace(task, craft=replace(task.craft, limit=limit))
    plan, other = plan_near(tight, free.path), slew_plan.plan_near(tight, free.path)
    assert plan is not None
    assert other is not None
    assert 0.98 <= plan.peak <= 1.001
    assert plan.peak == pytest.approx(float((np.abs(plan.path.dipole) / limit).max()))
    assert free.energy < plan.energy
    assert plan.energy == pytest.approx(other.energy, rel=3e-3)
    assert off_degrees(flown(plan, tight)[:4], TARGET) <= 0.005


def test_a_path_around_a_cone_keeps_out_of_it_and_has_more_heat() -> None:
    task, free = free_plan()
    axis = np.array([0.0, 0.0, 1.0])
    before, way, after = (
        matrix(q).T @ axis for q in free.path.references(np.array([59.0, 60.0, 61.0])).quaternion
    )
    beside = normalise(np.cross(way, after - before))
    way = np.cos(0.14) * way + np.sin(0.14) * beside
    ends = [float(np.arccos(axis @ matrix(q) @ way)) for q in (START, TARGET)]
    cone = Cone("Sun", axis, lambda times: np.tile(way, (len(times), 1)), 0.15)
    assert min(ends) > 0.3, "both ends are outside"
    plan = plan_near(replace(task, cones=(cone,)), free.path)
    assert plan is not None
    times = np.linspace(0.0, 120.0, 500)
    angles = np.arccos([axis @ matrix(q) @ way for q in plan.path.references(times).quaternion])
    assert angles.min() >= 0.15
    assert plan.clearance[0] == pytest.approx(angles.min() - 0.15, abs=1e-3)
    assert plan.clearance[0] < 0.02, "the path passes the cone closely"
    assert plan.energy > free.energy


@pytest.mark.parametrize("opposite", [False, True])
def test_a_boresight_end_takes_the_roll_of_least_rotation(opposite: bool) -> None:
    """Paths end at the given direction, even if the initial guess ends at the opposite direction."""
    axis = normalise(np.array([1.0, 2.0, 3.0]))
    direction = (-1.0 if opposite else 1.0) * matrix(TARGET).T @ axis
    direction = (
        direction if opposite else matrix(from_rotation_vector(np.array([0.1, 0.0, -0.1]))) @ direction
    )
    rate = np.array([2e-4, -3e-4, 1e-4])
    task = small_slew(end=lambda _: BoresightEnd(axis, direction, rate))
    program = VmcProgram(task, 100.0, np.array(smooth_states()), count=12)
    states, _ = program.trajectory(np.zeros(program.size), np.array([0.0, 1.0]))
    np.testing.assert_allclose(matrix(states[0, :4]), matrix(START), atol=1e-9)
    np.testing.assert_allclose(states[0, 4:], 100.0 * task.rate, atol=1e-9)
    np.testing.assert_allclose(matrix(states[1, :4]) @ direction, axis, atol=1e-9)
    np.testing.assert_allclose(matrix(states[1, :4]).T @ states[1, 4:], 100.0 * rate, atol=1e-9)
    turn = off_degrees(states[1, :4], TARGET)
    least = 180.0 if opposite else np.degrees(np.arccos(axis @ matrix(TARGET) @ direction))
    assert turn == pytest.approx(least, abs=1e-5)


def test_the_dipoles_of_a_path_cause_its_motion_with_least_heat() -> None:
    """The dipoles give the needed torque normal to the field; more dipole along the field only costs heat."""
    cone = Cone(
        "Sun", np.array([0.0, 1.0, 0.0]), lambda times: np.tile([0.6, 0.0, 0.8], (len(times), 1)), 0.3
    )
    task = small_slew(cones=(cone,))
    grid, rng = discretisation(10), np.random.default_rng(2)
    nodes, basis = 0.1 * rng.normal(size=(10, 3)), rng.normal(size=(10, 3, 4))
    samples = SamplePoints.at(grid.rule, np.array([-1.0, -0.3, 0.2, 1.0]))
    paths = ObservedPaths(task, 150.0, START, np.array([[0.01]]), samples, nodes, basis)
    y = 0.05 * rng.normal(size=4)
    q, w, a = paths.turned(paths.motion(y))
    values, _ = paths.values(y)
    around = task.along(np.array([0.0, 0.35, 0.6, 1.0]) * 150.0)
    unit = float(LIMIT.mean())
    for k in range(4):
        turn, rate, faster = matrix(q[k]), w[k] / 150.0, a[k] / 150.0**2
        field, down = turn @ around.field[k], turn @ around.position[k]
        tide = 3.0 * 3.986004418e14 / np.linalg.norm(down) ** 5 * np.cross(down, INERTIA @ down)
        needed = INERTIA @ faster + np.cross(rate, INERTIA @ rate) - tide
        strength = np.linalg.norm(field)
        dipole = unit * values[k, :3]
        across = needed - (needed @ field) / strength**2 * field
        np.testing.assert_allclose(np.cross(dipole, field), across, rtol=1e-7, atol=1e-18)
        assert abs((HEAT * dipole) @ field) < 1e-9 * np.linalg.norm(HEAT * dipole) * strength
        assert unit * values[k, 3] * strength == pytest.approx((needed @ field) / strength, rel=1e-7)
        cosine = float(turn[1] @ np.array([0.6, 0.0, 0.8]))
        assert values[k, 4] == pytest.approx(np.cos(0.31) - cosine, abs=1e-9)


def test_rodrigues_parameters_give_the_motion_of_the_quaternion() -> None:
    """A rotation vector along a fixed axis has a known motion, and any motion satisfies q' = [w, 0] q / 2."""
    axis, times = normalise(np.array([1.0, -2.0, 2.0])), np.array([0.3, 1.1, 2.0])
    angle, speed, faster = 0.4 * times**2, 0.8 * times, np.full(3, 0.8)
    tangent, square = np.tan(angle / 4.0), 1.0 + np.tan(angle / 4.0) ** 2
    first = 0.25 * square * speed
    second = 0.25 * square * faster + 0.5 * tangent * square * (0.25 * speed) * speed
    x = np.stack([part[:, None] * axis for part in (tangent, first, second)])
    q, w, a = mrp_motion(x)
    np.testing.assert_allclose(q, from_rotation_vector(angle[:, None] * axis), atol=1e-12)
    np.testing.assert_allclose(w, speed[:, None] * axis, atol=1e-12)
    np.testing.assert_allclose(a, faster[:, None] * axis, atol=1e-12)
    rng = np.random.default_rng(4)
    p, v, bend = 0.4 * rng.normal(size=(3, 5, 3))
    q, w, a = mrp_motion(np.stack([p, v, bend]))
    np.testing.assert_allclose(mrp_slopes(p, w), v, atol=1e-12)
    step = 1e-4
    after, later, _ = mrp_motion(np.stack([p + step * v + 0.5 * step**2 * bend, v + step * bend, bend]))
    before, sooner, _ = mrp_motion(np.stack([p - step * v + 0.5 * step**2 * bend, v - step * bend, bend]))
    slope = 0.5 * multiply(np.concatenate([w, np.zeros((5, 1))], axis=1), q)
    np.testing.assert_allclose((after - before) / (2.0 * step), slope, atol=1e-7)
    np.testing.assert_allclose((later - sooner) / (2.0 * step), a, atol=1e-6)


def test_the_heat_of_a_path_is_the_integral_of_its_dipoles_and_whitened() -> None:
    task = small_slew()
    program = VmcProgram(task, 240.0, np.array(smooth_states()), count=12)
    share = np.linspace(0.0, 1.0, 2001)
    y = 0.3 * np.random.default_rng(1).normal(size=program.size)
    _, dipoles = program.trajectory(y, share)
    power = (float(LIMIT.mean()) * dipoles) ** 2 @ HEAT
    assert program.heat(y)[0] == pytest.approx(240.0 * np.trapezoid(power, share), rel=1e-4)
    assert program.size == 3 * (12 - 4)
    program.share = 0.5
    excess, _ = program.excess(y)
    unit = float(LIMIT.mean())
    assert excess[:, :6].max() == pytest.approx(
        float(np.abs(unit * dipoles / LIMIT).max()) / 0.5 - 1.0, rel=0.05
    )
    assert excess.shape == (24, 6)


def test_guesses_begin_with_the_rotation_about_the_eigenaxis() -> None:
    task = small_slew()
    first, second, *_ = prey_paths(task, 240.0)
    np.testing.assert_allclose(matrix(first[0, :4]), matrix(START), atol=1e-9)
    np.testing.assert_allclose(matrix(first[-1, :4]), matrix(TARGET), atol=1e-9)
    np.testing.assert_allclose(first[[0, -1], 4:], 0.0, atol=1e-12)
    whole = np.array([0.8, -0.5, 0.6])
    half = from_rotation_vector(0.5 * whole)
    middle = len(first) // 2
    np.testing.assert_allclose(matrix(first[middle, :4]), matrix(multiply(half, START)), atol=1e-9)
    np.testing.assert_allclose(first[middle, 4:], 1.875 * whole, rtol=1e-9)
    assert off_degrees(second[-1, :4], TARGET) < 10.0


def test_the_plan_of_least_heat_of_the_shortest_possible_duration_is_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[float] = []
    bent = smooth_states()
    bent[:, :4] = multiply(
        from_rotation_vector(np.outer(np.sin(np.linspace(0.0, np.pi, 49)), [0, 0, 0.6])), bent[:, :4]
    )

    def preys(_: SlewTask, horizon: float) -> Iterator[FloatArray]:
        asked.append(horizon)
        if horizon > 100.0:
            yield from (smooth_states(), bent)

    monkeypatch.setattr(slew_vmc, "prey_paths", preys)
    task = small_slew(horizon=86.0, nodes=24)
    plan = plan_task(task)
    assert asked == [86.0, pytest.approx(120.4)]
    assert (plan.status, plan.horizon_asked) == (SlewStatus.STRETCHED, 86.0)
    assert plan.horizon == pytest.approx(120.4)
    each = [slew_vmc._planned(task, 120.4, states) for states in (smooth_states(), bent)]
    assert plan.energy == pytest.approx(min(one.energy for one in each if one is not None))

    def none(_: SlewTask, horizon: float) -> Iterator[FloatArray]:
        asked.append(horizon)
        return iter(())

    monkeypatch.setattr(slew_vmc, "prey_paths", none)
    asked.clear()
    with pytest.raises(PlanningError, match=r"over 86 to 100 s, from 0 guesses"):
        plan_task(replace(task, longest=100.0))
    assert len(asked) == 2, "the requested and the longest duration"


def test_durations_whose_end_lies_in_a_cone_are_not_planned() -> None:
    axis = np.array([1.0, 0.0, 0.0])
    cone = Cone("Moon", axis, lambda times: np.tile(matrix(TARGET)[0], (len(times), 1)), 0.05)
    refusal = r"camouflage: .* over 240 to 720 s, from 0 guesses; all of these, from 240 s on, end in .* Moon"
    with pytest.raises(PlanningError, match=refusal):
        plan_task(small_slew(cones=(cone,)))


def test_a_task_of_wrong_values_is_refused() -> None:
    for planner in (plan_task, lambda task: plan_near(task, smooth_path(240.0))):
        with pytest.raises(PlanningError, match="slews of a given duration"):
            planner(small_slew(time_cost=1.0))
        with pytest.raises(PlanningError, match="must have length 1"):
            planner(small_slew(quaternion=1.1 * START))
