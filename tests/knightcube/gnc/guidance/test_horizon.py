"""Which horizon a path gets, where it begins, and what it allows for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.one_axis.path import FARTHEST
from knightcube.gnc.guidance.one_axis.plant import angle_of, q2_of
from knightcube.gnc.guidance.one_axis.vmc import FINE_NODES, PlanStatus, StepPlan, plan
from tests.knightcube.gnc.guidance.oracle import solve
from tests.knightcube.gnc.guidance.problems import (
    KNIGHTCUBE,
    THESIS,
    Problem,
    feasible_problems,
    known_optima,
)
from tests.knightcube.gnc.guidance.shortest import shortest_time
from tests.studies.bench.plan import largest_ratio

CARRIED = replace(KNIGHTCUBE, stiffness=2e-5, damping=2e-6, disturbance=-3e-3)


def test_the_shortest_times_are_the_published_ones() -> None:
    """Twenty problems solved by collocation elsewhere: the shooting that the tests use agrees to 1e-3."""
    for known in known_optima():
        assert shortest_time(known.problem.slew(1.0)) == pytest.approx(known.shortest, rel=1e-3)


def test_from_a_tenth_above_the_shortest_horizon_on_paths_are_optimal_and_within_the_limits() -> None:
    """A slice of `python -m tests.studies.bench plan`: thread, disturbance and moving ends among them."""
    costs = []
    for problem, shortest in feasible_problems(40, seed=11):
        found = problem.planned()
        assert found.status is PlanStatus.OPTIMAL, shortest
        assert largest_ratio(problem, found) <= 1.001
        optimum = solve(problem.slew(problem.horizon))
        assert optimum is not None
        costs.append(found.energy / optimum.energy)
    assert np.median(costs) <= 1.001
    assert max(costs) <= 1.01


def test_a_horizon_just_long_enough_is_kept_or_stretched_by_less_than_a_percent() -> None:
    for problem, _ in feasible_problems(15, seed=4, share=(1.0, 1.03)):
        found = problem.planned()
        assert problem.horizon <= found.horizon * (1.0 + 1e-9) <= 1.015 * problem.horizon
        assert largest_ratio(problem, found) <= 1.001


@settings(max_examples=15, deadline=None)
@given(st.floats(1e-3, 2e-2), st.floats(2e-5, 2e-3))
def test_a_price_of_time_buys_the_horizon_of_the_closed_form(angle: float, price: float) -> None:
    """With cos(theta) = 1 the least energy is 12 R (a/g)^2 / T^3; the price is its slope."""
    gain = KNIGHTCUBE.torque_constant / KNIGHTCUBE.inertia
    expected = (36.0 * KNIGHTCUBE.resistance * (angle / gain) ** 2 / price) ** 0.25
    found = plan(KNIGHTCUBE, 0.0, 0.0, q2_of(angle), 0.0, 10.0, time_price=price)
    assert found.horizon == pytest.approx(max(expected, 1.0), rel=0.01)
    assert found.horizon_asked == found.horizon
    assert found.status is PlanStatus.OPTIMAL


def test_no_horizon_nearby_is_better_at_the_price() -> None:
    """Against the collocation oracle at other horizons, energy and price of time added."""
    price = 0.2
    for problem, _ in feasible_problems(10, seed=3):
        found = problem.planned(time_price=price)
        total = found.energy + price * found.horizon
        assert largest_ratio(problem, found) <= 1.001
        for factor in (0.8, 0.9, 0.95, 1.05, 1.1, 1.25):
            other = solve(problem.slew(factor * found.horizon))
            if other is not None:
                assert total <= 1.001 * (other.energy + price * factor * found.horizon)


def test_the_dearer_the_time_the_shorter_the_horizon_down_to_the_shortest() -> None:
    horizons = [THESIS.planned(time_price=price).horizon for price in (0.01, 0.1, 1.0, 100.0)]
    assert horizons == sorted(horizons, reverse=True)
    shortest = shortest_time(THESIS.slew(1.0))
    assert shortest < horizons[-1] < 1.015 * shortest


@pytest.mark.parametrize("price", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_price_is_refused(price: float) -> None:
    with pytest.raises(PlanningError, match="time_price"):
        THESIS.planned(time_price=price)


def rest_of(problem: Problem, found: StepPlan, share: float) -> tuple[Problem, int]:
    """Return the remaining path after `share` of it, from a little off it, and the time elapsed in ns."""
    elapsed_ns = round(share * found.horizon * 1e9)
    at = found.path.sample(elapsed_ns)
    left = Problem(
        problem.plant,
        q2_of(at.angle) + 1e-4,
        at.rate + 1e-4,
        problem.end_q2,
        problem.end_rate,
        found.horizon - elapsed_ns * 1e-9,
    )
    return left, elapsed_ns


def test_the_last_path_makes_the_next_plan_cheaper_and_changes_nothing_else() -> None:
    cold_total = warm_total = 0
    for problem, _ in feasible_problems(12, seed=3, share=(1.1, 1.25)):
        first = problem.planned()
        left, elapsed_ns = rest_of(problem, first, 0.3)
        cold = left.planned(nodes=FINE_NODES)
        warm = left.planned(nodes=FINE_NODES, last=first.path.starting_at(-elapsed_ns))
        assert warm.energy == pytest.approx(cold.energy, rel=1e-5)
        np.testing.assert_allclose(warm.node_q2, cold.node_q2, atol=1e-4)
        cold_total += cold.evaluations
        warm_total += warm.evaluations
    # How many it takes differs a little with the processor's rounding.
    assert warm_total < 0.9 * cold_total


def test_a_last_path_that_does_not_fit_does_no_harm() -> None:
    other = plan(KNIGHTCUBE, -0.4, 0.02, 0.4, 0.0, 16.0).path
    nan = replace(other, series=tuple((math.nan, b, c) for _, b, c in other.series))
    for last in (other.starting_at(-3_000_000_000), other.starting_at(-20_000_000_000), other, nan):
        found = THESIS.planned(last=last)
        assert found.energy == pytest.approx(THESIS.planned().energy, rel=1e-3)


def test_the_planned_current_flies_the_body_under_thread_and_disturbance_to_its_moving_end() -> None:
    """Open loop: the path's current in the equation of motion, by Runge-Kutta, ends where the plan ends."""
    found = plan(CARRIED, 0.1, 0.01, -0.2, 0.015, 11.0)
    count = 2200
    step = found.horizon / count
    edges = np.minimum(np.linspace(0.0, found.horizon, 2 * count + 1), found.horizon * (1.0 - 1e-12))
    current = CARRIED.currents(*found.path.motion(edges))
    state = np.array([angle_of(0.1), 0.01])

    def slope(x: FloatArray, amperes: float) -> FloatArray:
        pull = 80 * 0.0081 * 4.5e-4 * amperes * math.cos(x[0])
        return np.array([x[1], (pull - 2e-5 * x[0] - 2e-6 * x[1]) / 1.05e-3 - 3e-3])

    for i in range(count):
        first, middle, end = current[2 * i : 2 * i + 3].tolist()
        k1 = slope(state, first)
        k2 = slope(state + 0.5 * step * k1, middle)
        k3 = slope(state + 0.5 * step * k2, middle)
        k4 = slope(state + step * k3, end)
        state = state + step / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    np.testing.assert_allclose(state, [angle_of(-0.2), 0.015], atol=1e-6)


def test_past_a_moving_end_the_path_coasts_on_as_far_as_the_coil_turns_the_body() -> None:
    path = plan(KNIGHTCUBE, 0.1, 0.0, 0.2, 0.02, 9.0).path
    at_end, later = path.sample(9_000_000_000), path.sample(14_000_000_000)
    assert at_end.angle == pytest.approx(angle_of(0.2))
    assert later.angle == pytest.approx(angle_of(0.2) + 5.0 * 0.02)
    assert (later.rate, later.acceleration) == (0.02, 0.0)
    stopped = path.sample(200_000_000_000)
    assert (stopped.angle, stopped.rate) == (FARTHEST, 0.0)
    times = np.array([0.0, 4.0, 9.0, 14.0, 200.0])
    together = np.array(path.motion(times)).T
    one_by_one = [path.sample(round(t * 1e9)) for t in times.tolist()]
    np.testing.assert_allclose(together, [(s.angle, s.rate, s.acceleration) for s in one_by_one], atol=1e-8)
