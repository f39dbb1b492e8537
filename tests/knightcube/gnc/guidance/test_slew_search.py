"""Tests of initial guesses of slews: their momenta are feasible and end at the target, outside the cones."""

from __future__ import annotations

import math
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.gnc.guidance import slew_search
from knightcube.gnc.guidance.slew_model import MINIMUM_TIME, AttitudeEnd, SlewPath
from knightcube.gnc.guidance.slew_search import (
    LAST_BARRIER,
    HorizonContinuation,
    SlewSearch,
    SlewSolver,
    SolvedPath,
    guesses,
    transferred,
)
from tests.support.random_slews import slews
from tests.support.small_slews import HEAT, LIMIT, small_slew


def test_first_guesses_need_no_torque_along_the_field_end_in_the_target_and_keep_the_cones() -> None:
    """Initial guesses need no torque along the field, end at the target and avoid the cones.

    In case 0 of `bench orbit_slews --cones --seed 43` every path without limits passes through a cone.
    """
    (_, task), *_ = slews(1, 43, True)
    solver = SlewSolver(task)
    equations = solver.equations(task.horizon, 24)
    kept, scale = solver.kept(equations), task.horizon
    found = guesses(equations, task.craft, kept)
    end = task.end(task.horizon)
    assert isinstance(end, AttitudeEnd)
    for guess in found[:3]:
        q, rate = guess.states[:, :4], guess.states[:, 4:] / scale
        momentum = np.einsum("nji,nj->ni", attitude_matrix(q), rate @ task.craft.inertia)
        torque = np.gradient(momentum, scale / 48.0, axis=0)
        field = equations.around.field
        along = np.abs(np.sum(torque * field, axis=1)) / np.linalg.norm(field, axis=1)
        assert along[1:-1].max() < 0.03 * np.linalg.norm(torque, axis=1).max()
        assert float(angle_between(q[-1], end.quaternion)) < 0.1
        assert kept.values(q[1:]).min() > -0.02


def test_guesses_are_the_same_each_time() -> None:
    (_, task), *_ = slews(1, 43, False)
    solver = SlewSolver(task)
    equations = solver.equations(task.horizon, 10)
    first, then = (guesses(equations, task.craft, solver.kept(equations)) for _ in range(2))
    assert len(first) == len(then) > 3
    np.testing.assert_array_equal(first[0].states, then[0].states)


class Model:
    """A solver for a slew whose shortest duration is known, with the heat of a scaled rotation.

    The dipoles of a slew of T s are proportional to 1/T^2, and its heat to 1/T^3.
    """

    def __init__(self, shortest: float, heat: float = 1e6) -> None:
        self.shortest, self.heat = shortest, heat
        self.work, self.share, self.extra = 0.0, 1.0, np.zeros((1, 20))
        self.asked: list[tuple[int, float, float]] = []
        self.refuses: set[int] = set()  # numbers of intervals on which no path is found
        self.free_is_kept = True

    def path(self, horizon: float, count: int = 10, factor: float = 1.0) -> Any:
        """Return a path whose heat is `factor` times that of the best path."""
        return SimpleNamespace(horizon=horizon, factor=factor, equations=SimpleNamespace(count=count))

    def energy(self, found: Any) -> float:
        return float(found.factor * self.heat / found.horizon**3)

    def peak(self, found: Any) -> float:
        return float((self.shortest / found.horizon) ** 2)

    def is_kept(self, found: Any) -> bool:
        return self.peak(found) <= 1.0

    def equations(self, time: float, count: int) -> Any:
        return SimpleNamespace(scale=time, count=count)

    def limited(self, start: Any, count: int, time: float, last: float) -> Any:
        self.work += 10.0
        self.asked.append((count, time, last))
        shortest = self.shortest / math.sqrt(self.share)
        if time < shortest * (1.0 - 1e-9) or count in self.refuses:
            return None
        return self.path(time, count, start.factor)


def continuation(model: Model, budget: float = 1e9, **changes: Any) -> HorizonContinuation:
    """Return the continuation of a small slew with the solver `model`."""
    return HorizonContinuation(small_slew(nodes=24, **changes), cast(Any, model), budget)


def test_a_minimum_time_slew_is_shortened_to_nearly_the_shortest_duration() -> None:
    model = Model(100.0)
    found = continuation(model, time_cost=MINIMUM_TIME).shortened(
        [model.path(400.0), model.path(300.0)], 1.0, MINIMUM_TIME
    )
    assert found is not None
    assert 100.0 <= found.horizon <= 100.5, "within half a per cent"
    assert found.equations.count == 24, "on the fine grid"
    assert model.asked[-1][2] == LAST_BARRIER


def test_a_time_cost_ends_the_shortening_at_the_best_duration() -> None:
    """The total cost k/T^3 + c T of heat and time is minimal at T^4 = 3 k/c."""
    model = Model(20.0, heat=1e6)
    cost = 3e6 / 80.0**4
    found = continuation(model, time_cost=cost).shortened([model.path(300.0)], 1.0, cost)
    assert found is not None
    value = model.energy(found) + cost * found.horizon
    best = 1e6 / 80.0**3 + cost * 80.0
    assert value <= 1.03 * best
    assert found.horizon == pytest.approx(80.0, rel=0.15)


def test_a_slew_is_shortened_no_further_than_the_requested_duration() -> None:
    model = Model(100.0)
    found = continuation(model, horizon=150.0).shortened([model.path(300.0)], 150.0, MINIMUM_TIME)
    assert found is not None
    assert found.horizon == pytest.approx(150.0)
    assert min(time for _, time, _ in model.asked) >= 150.0


def test_without_a_path_within_the_limits_nothing_is_found() -> None:
    model = Model(600.0)
    assert continuation(model, longest=640.0).shortened([model.path(300.0)], 1.0, MINIMUM_TIME) is not None
    model.refuses = {10}
    assert continuation(model).shortened([model.path(300.0)], 1.0, MINIMUM_TIME) is None
    assert continuation(model).shortened([], 1.0, MINIMUM_TIME) is None
    model.asked.clear()
    assert continuation(model, longest=500.0).shortened([model.path(300.0)], 1.0, MINIMUM_TIME) is None
    assert model.asked == [], "all durations are too long"


def test_a_continuation_beyond_its_budget_returns_the_best_path_so_far() -> None:
    model = Model(100.0)
    few = continuation(model, budget=25.0).shortened([model.path(700.0)], 1.0, MINIMUM_TIME)
    assert few is not None
    assert few.horizon > 105.0
    assert model.work < 60.0


def test_a_path_is_lengthened_if_the_fine_grid_has_none_of_its_duration() -> None:
    model = Model(100.0)
    model.refuses = {24}
    search = continuation(model)
    assert search.shortened([model.path(300.0)], 150.0, MINIMUM_TIME) is None
    fine = [time for count, time, _ in model.asked if count == 24]
    assert len(set(np.round(fine, 6))) == 3, "the duration, and two longer ones"
    assert max(fine) == pytest.approx(1.1 * min(fine))
    assert 16 in {count for count, *_ in model.asked}, "by an intermediate grid"


def test_a_coarse_path_without_limits_leads_to_a_path_on_the_fine_grid() -> None:
    model = Model(100.0)
    model.free = lambda equations, guess: model.path(equations.scale, equations.count)  # type: ignore[attr-defined]
    limited = continuation(model).within(model.path(90.0))
    assert limited is None, "too short"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slew_search, "transferred", lambda start, equations: start)
        model.asked.clear()
        free = continuation(model).within(model.path(200.0))
        assert free is not None
        assert (free.horizon, free.equations.count) == (200.0, 24)
        assert model.asked == [], "a path within the limits needs no limits"
        model.free = lambda equations, guess: None  # type: ignore[attr-defined]
        bound = continuation(model).within(model.path(200.0))
    assert bound is not None
    assert [(count, time) for count, time, _ in model.asked] == [(10, 200.0), (24, 200.0)]


def test_paths_of_the_same_heat_count_once_in_the_order_of_their_heats() -> None:
    model = Model(100.0)
    paths = [model.path(200.0, factor=factor) for factor in (2.0, 1.0, 1.00005, 3.0, 1.001)]
    found = continuation(model).distinct(paths)
    assert [cast(Any, path).factor for path in found] == [1.0, 1.001, 2.0, 3.0]
    assert continuation(model).distinct([]) == []


@pytest.mark.parametrize(
    ("peak", "horizon", "longest", "expected"),
    [
        (1.02, 240.0, 720.0, 240.0),  # the same duration with smaller dipoles
        (1.6, 240.0, 720.0, None),  # too far beyond the limit
        (1.02, 236.0, 720.0, "longer"),  # no smaller dipoles at this duration
        (1.02, 236.0, 237.0, None),  # no time to be longer
    ],
)
def test_a_path_beyond_its_limit_gets_smaller_dipoles_or_more_time(
    peak: float, horizon: float, longest: float, expected: float | str | None
) -> None:
    model = Model(236.0)
    search = continuation(model, horizon=horizon, longest=longest)
    found = search.eased(model.path(horizon), peak)
    if peak < 1.5:
        assert model.share == pytest.approx(1.0 / peak)
    if expected is None:
        assert found is None
    elif expected == "longer":
        assert found is not None
        assert 236.0 < found.horizon < 1.1 * 236.0
        assert found.horizon >= 236.0 * math.sqrt(peak)
    else:
        assert found is not None
        assert found.horizon == expected


def test_a_slew_of_free_duration_beyond_its_limit_takes_longer() -> None:
    model = Model(100.0)
    found = continuation(model, time_cost=1.0).eased(model.path(150.0), 1.1)
    assert found is not None
    assert found.horizon > 150.0 * math.sqrt(1.1)


def test_cones_are_widened_where_a_path_crosses_them_and_at_the_point_before() -> None:
    model = Model(100.0)
    model.extra = np.full((1, 20), 0.001)
    depths = np.zeros((1, 20))
    depths[0, 7], depths[0, 19] = 0.01, 0.02
    found = continuation(model).widened(model.path(150.0, 24), depths)
    assert found is not None
    assert (found.horizon, found.equations.count) == (150.0, 24)
    added = model.extra[0] - 0.001
    assert np.flatnonzero(added > 0.0).tolist() == [6, 7, 18], "the last point is not widened"
    assert added[6] == added[7] >= 0.01
    assert added[18] >= 0.02
    assert np.all(added[[6, 7]] < 0.02)


@cache
def _solved() -> SolvedPath:
    task = small_slew()
    solver = SlewSolver(task)
    equations = solver.equations(240.0, 10)
    for guess in guesses(equations, task.craft, solver.kept(equations)):
        found = solver.free(solver.equations(240.0, 10), guess)
        if found is not None:
            return found
    raise AssertionError("no guess converges")


def solved_slew() -> tuple[SlewSolver, SolvedPath]:
    """Return a new solver, and a converged path of 240 s without dipole limit."""
    return SlewSolver(small_slew()), _solved()


def test_heat_and_largest_dipole_of_a_path_are_those_of_its_dipoles() -> None:
    solver, found = solved_slew()
    dipoles = solver.unit * found.at.dipoles
    share = (np.arange(500) + 0.5)[:, None] / 500.0
    between = [dipoles[k] + share * (dipoles[k + 1] - dipoles[k]) for k in range(10)]
    power = np.concatenate(between) ** 2 @ HEAT
    assert solver.unit == pytest.approx(0.1)
    assert solver.energy(found) == pytest.approx(240.0 * float(power.mean()), rel=1e-5)
    assert solver.peak(found) == pytest.approx(float((np.abs(dipoles) / LIMIT).max()))
    assert found.horizon == 240.0
    assert solver.is_kept(found)
    assert (solver.work, solver.steps) == (0, 0)
    limited = solver.limited(found, 10, 240.0, LAST_BARRIER)
    assert limited is not None
    assert solver.work == 10 * solver.steps > 0
    assert solver.energy(limited) == pytest.approx(solver.energy(found), rel=1e-3)
    solver.share = 0.9 * solver.peak(found)
    tight = solver.limited(found, 10, 240.0, LAST_BARRIER)
    assert tight is not None
    assert solver.peak(tight) <= solver.share * (1.0 + 1e-6)
    assert solver.energy(tight) >= solver.energy(found)


def test_a_transferred_path_keeps_its_shape_and_scales_its_dipoles() -> None:
    solver, found = solved_slew()
    same = transferred(found, solver.equations(300.0, 10))
    np.testing.assert_array_equal(same.states, found.at.states)
    np.testing.assert_allclose(same.dipoles, found.at.dipoles * (240.0 / 300.0) ** 2)
    finer = transferred(found, solver.equations(240.0, 20))
    assert finer.states.shape == (41, 7)
    np.testing.assert_allclose(finer.states[::2], found.at.states, atol=1e-9)
    np.testing.assert_allclose(finer.dipoles[::2], found.at.dipoles, atol=1e-12)
    np.testing.assert_allclose(
        finer.dipoles[1::2], 0.5 * (found.at.dipoles[1:] + found.at.dipoles[:-1]), atol=1e-12
    )


def test_a_similar_path_leads_to_the_path_of_the_task() -> None:
    solver, found = solved_slew()
    times = np.linspace(0.0, 240.0, 21)
    states, dipoles = found.at.states, solver.unit * found.at.all_dipoles()
    path = SlewPath(times, states[:, :4], states[:, 4:] / 240.0, np.zeros((21, 3)), dipoles)
    before = solver.steps
    again = solver.again(path)
    assert again is not None
    assert solver.steps - before <= 12
    assert solver.energy(again) == pytest.approx(solver.energy(found), rel=1e-3)
    np.testing.assert_allclose(again.at.states, states, atol=2e-3)


class Guesses:
    """A solver whose guesses converge after given numbers of Newton steps."""

    def __init__(self, needed: dict[str, int], lacks: dict[str, float]) -> None:
        self.needed, self.lacks = needed, lacks
        self.steps, self.work, self.share, self.extra = 0, 0.0, 1.0, np.zeros((0, 20))
        self.asked: list[tuple[str, float, int]] = []

    def equations(self, scale: float, count: int) -> Any:
        return SimpleNamespace(scale=scale, count=count)

    def kept(self, equations: Any) -> None:
        return None

    def descent(self, equations: Any, guess: str) -> Any:
        return SimpleNamespace(
            guess=guess,
            scale=equations.scale,
            lack=self.lacks.get(guess, 0.0),
            is_over=guess == "over",
            done=0,
        )

    def found(self, descent: Any, maximum: int, enough: float = 0.0) -> Any:
        self.asked.append((descent.guess, descent.scale, maximum))
        self.steps += maximum
        descent.done += maximum
        if descent.done < self.needed[descent.guess]:
            return None
        return SimpleNamespace(guess=descent.guess, horizon=descent.scale)

    def energy(self, found: Any) -> float:
        return {"a": 1.0, "b": 2.0, "c": 3.0, "late": 0.5}[found.guess]

    def peak(self, found: Any) -> float:
        return 10.0 * self.energy(found)


def searched(
    solver: Guesses, names: list[str], monkeypatch: pytest.MonkeyPatch, **changes: Any
) -> tuple[SlewSearch, list[tuple[str, float]]]:
    """Return a search with a given solver, and guess and duration of each path found; no limit is checked."""
    search = SlewSearch(small_slew(horizon=240.0, longest=240.0, **changes), 10, 5000)
    search.solver = cast(Any, solver)
    search._walker = cast(
        Any,
        SimpleNamespace(
            distinct=lambda paths: sorted(paths, key=solver.energy),
            within=lambda start: start,
            shortened=lambda *_: None,
        ),
    )
    monkeypatch.setattr(slew_search, "guesses", lambda *_: names)
    return search, [(cast(Any, path).guess, path.horizon) for path in search.paths()]


def test_a_guess_with_large_violations_is_tried_after_all_others(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Guesses({"late": 20, "a": 8}, {"late": 1.6})
    search, found = searched(solver, ["late", "a"], monkeypatch)
    assert found == [("a", 240.0), ("late", 240.0)]
    assert search.tried == 2
    assert [guess for guess, *_ in solver.asked] == ["late", "a", "late"]


def test_a_guess_with_small_violations_is_continued_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Guesses({"a": 20}, {"a": 1.4})
    _, found = searched(solver, ["a"], monkeypatch)
    assert found == [("a", 240.0)]
    assert len(solver.asked) == 2


def test_a_guess_that_ends_without_a_path_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Guesses({"over": 999}, {"over": 9.0})
    search, found = searched(solver, ["over"], monkeypatch)
    assert (found, search.tried, len(solver.asked)) == ([], 1, 1)


def test_the_path_of_least_heat_of_three_is_tried_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solver = Guesses({"a": 8, "b": 8, "c": 8}, {})
    search, found = searched(solver, ["c", "a", "b", "b"], monkeypatch)
    assert found == [("a", 240.0), ("b", 240.0)]
    assert search.tried == 4
    assert search.least == 10.0


def test_after_many_steps_without_a_path_the_remaining_guesses_are_deferred(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solver = Guesses({"c": 8, "over": 999}, {"over": 9.0})
    solver.lacks["c"] = 0.1
    search, found = searched(solver, ["over"] * 16 + ["c"] * 3, monkeypatch)
    assert search.tried == 16, "at most sixteen guesses are tried"
    assert found == []
    other = Guesses({"c": 8, "over": 999}, {"over": 9.0})
    other.steps = 0
    _, found = searched(other, ["over"] * 15 + ["c"], monkeypatch)
    assert found == [("c", 240.0)]


def test_corrections_of_one_path_are_limited_and_reset_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Guesses({"a": 8}, {})
    search, _ = searched(solver, [], monkeypatch)
    path, depths = cast(Any, object()), np.zeros((0, 20))
    search._walker = cast(
        Any, SimpleNamespace(eased=lambda found, peak: found, widened=lambda found, inside: found)
    )
    made = [
        search.eased(path, 1.1),
        search.widened(path, depths),
        search.eased(path, 1.1),
        search.widened(path, depths),
    ]
    assert made == [path] * 4
    assert search.eased(path, 1.1) is None
    assert search.widened(path, depths) is None
    solver.share = 0.5
    assert list(search._tried([path])) == [path]
    assert solver.share == 1.0
    assert search.eased(path, 1.1) is path
