"""Tests of when the planner submits jobs, what it reports, and what it does with the results."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from flight.bodies.orbit.guidance import (
    LearnedBody,
    ObjectAim,
    PlannedCraft,
    PointingPaths,
    PointingPlanner,
    PointingTargetLaw,
    PointingTargets,
)
from flight.loop.body import Target
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.quaternion import from_rotation_vector, multiply, normalise
from knightcube.errors import UsageError
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.control.pointing_job import STEADY, SlewRequest
from knightcube.gnc.guidance.attitude_law import BodyAxes
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.knightcube.gnc.control.pointing_cases import INERTIA, LIMIT, ORBIT, WEIGHTS, X, Z

S = SECOND_NS
NADIR, SUN = PointingTarget(Goal.NADIR), PointingTarget(Goal.SUN)
COILS = CoilMap(0.8 * np.eye(3), np.full(3, 0.5), np.array([10.0, 20.0, 30.0]))


class Bench:
    """A planner whose paths, worker and orbit the test sets."""

    def __init__(self) -> None:
        self.jobs: list[Any] = []
        self.reports: list[tuple[str, int, str]] = []
        self.orbit: Any = ORBIT
        self.takes = True
        self.paths = Mock()
        self.paths.astray = SimpleNamespace(since=None, ready=False, leaving=False)
        self.paths.is_slewing.return_value = self.paths.has_arrived.return_value = False
        self.paths.attitude.return_value = None
        self.paths.offer.return_value = ""
        self.paths.off = 0.0
        services = SimpleNamespace(
            jobs=SimpleNamespace(submit=self._submit),
            events=SimpleNamespace(report=lambda kind, at, text: self.reports.append((kind.name, at, text))),
        )
        self.sizes, self.residual = np.arange(9.0), np.array([1e-3, 2e-3, 3e-3])
        self.planner = PointingPlanner(
            PlannedCraft(
                INERTIA, BodyAxes(Z, X), WEIGHTS, COILS, 0.5, SlewRequest(300.0, np.ones(3), np.zeros(3), Z)
            ),
            cast(Any, self.paths),
            cast(Any, SimpleNamespace(state=lambda now_ns: self.orbit)),
            lambda: LearnedBody(1.1 * INERTIA, self.sizes, self.residual),
            lambda: np.ones(3, dtype=bool),
            ObjectAim(None, LIMIT, cast(Any, services.events)),
            cast(Any, services),
        )
        self.estimate = SimpleNamespace(
            quaternion=normalise(np.array([0.1, 0.2, 0.3, 0.9])), rate=np.array([0.01, 0.02, 0.03])
        )

    def _submit(self, worker: str, job: Any) -> bool:
        assert worker == "planner"
        self.jobs.append(job)
        return self.takes

    def serve(self, now_ns: int, goal: PointingTarget = NADIR, known: bool = True) -> int:
        """Run the planner at a time; return the number of jobs that it has submitted so far."""
        estimate = cast(Any, self.estimate) if known else None
        target = Target(0, PointingTargetLaw(goal, cast(PointingPaths, self.paths)))
        self.planner.serve(estimate, target, now_ns)
        return len(self.jobs)

    def finish(self, value: Any, now_ns: int, outcome: str = "done") -> None:
        """Return a result of the worker."""
        self.planner.finish(cast(Any, SimpleNamespace(outcome=outcome, error="why", value=value)), now_ns)


def test_a_job_has_the_state_of_body_orbit_and_target() -> None:
    bench = Bench()
    assert bench.serve(5 * S) == 0, "nothing was requested"
    bench.planner.request(5 * S)
    assert bench.serve(5 * S, known=False) == 0
    assert bench.planner.busy_since_ns() is None
    assert bench.serve(6 * S, SUN) == 1
    (job,) = bench.jobs
    assert (job.number, job.origin_ns, job.target) == (1, 6 * S, SUN)
    assert bench.planner.busy_since_ns() == 6 * S
    assert job.orbit is ORBIT
    np.testing.assert_array_equal(job.inertia, 1.1 * INERTIA)
    assert job.quaternion is bench.estimate.quaternion
    assert job.rate is bench.estimate.rate
    assert job.sizes is bench.sizes
    np.testing.assert_allclose(job.limit, [0.2] * 3)
    assert job.slew is not None
    assert job.slew.residual is bench.residual
    assert job.areas.sum() == pytest.approx(2.0)


@pytest.mark.parametrize("way", ["aim", "request", "replan", "leaving", "ready"])
def test_a_plan_is_made_on_request_and_for_a_body_that_leaves_its_path(way: str) -> None:
    bench = Bench()
    if way == "replan":
        bench.planner.replan(cast(Any, None))
    elif way in {"aim", "request"}:
        getattr(bench.planner, way)(*([cast(Any, None)] if way == "aim" else []), 5 * S)
    else:
        setattr(bench.paths.astray, way, True)
    assert bench.serve(5 * S) == 1
    bench.planner.request(6 * S)
    assert bench.serve(6 * S) == 1, "the worker is busy"
    bench.finish(SimpleNamespace(slew=None), 7 * S)
    assert bench.planner.counts() == (1, 0)
    assert bench.planner.busy_since_ns() is None


def test_a_busy_worker_is_asked_again() -> None:
    bench = Bench()
    bench.takes = False
    bench.planner.request(5 * S)
    bench.serve(5 * S)
    bench.takes = True
    assert bench.serve(5 * S + 1) == 2
    assert [job.number for job in bench.jobs] == [1, 1]
    bench.finish(SimpleNamespace(slew=None), 7 * S)
    bench.planner.request(20 * S)
    bench.serve(20 * S)
    assert bench.jobs[-1].number == 2


def test_without_an_orbit_a_plan_is_requested_again_after_ten_seconds() -> None:
    bench = Bench()
    bench.orbit = None
    bench.planner.request(5 * S)
    for now_ns in (5 * S, 15 * S - 1, 15 * S):
        bench.serve(now_ns)
    assert [(at, text) for _, at, text in bench.reports] == [
        (5 * S, "no plan: the orbit is not known"),
        (15 * S, "no plan: the orbit is not known"),
    ]
    assert bench.planner.counts() == (0, 2)
    bench.orbit = ORBIT
    assert bench.serve(25 * S) == 1


def test_a_new_target_does_not_wait() -> None:
    bench = Bench()
    bench.orbit = None
    bench.planner.request(5 * S)
    bench.serve(5 * S)
    bench.orbit = ORBIT
    bench.planner.aim(cast(Any, None), 6 * S)
    assert bench.serve(6 * S) == 1


def test_a_failed_or_refused_plan_is_reported_with_its_number_and_made_again() -> None:
    bench = Bench()
    bench.planner.request(5 * S)
    bench.serve(5 * S)
    bench.finish(None, 6 * S, "timed-out")
    assert bench.reports[-1][1:] == (6 * S, "plan 1: timed-out: why")
    assert bench.serve(16 * S - 1) == 1
    assert bench.serve(16 * S) == 2
    bench.paths.offer.return_value = "too fast"
    table = SimpleNamespace(slew=None)
    bench.finish(table, 17 * S)
    assert bench.reports[-1][1:] == (17 * S, "plan 2: too fast")
    bench.paths.offer.assert_called_once_with(table, NADIR, 16 * S)
    assert bench.planner.counts() == (0, 2)
    bench.finish(table, 18 * S)
    assert len(bench.reports) == 2, "no job was running"


def test_a_slew_is_reported_with_its_duration_and_its_largest_rate() -> None:
    bench = Bench()
    bench.planner.request(5 * S)
    bench.serve(5 * S, SUN)
    rates = np.radians([[0.1, 0.0, 0.0], [0.3, 0.0, 0.4], [0.0, 0.2, 0.0]])
    bench.finish(SimpleNamespace(slew=SimpleNamespace(rate=rates, horizon=312.4)), 7 * S)
    ((name, at, text),) = bench.reports
    assert (name, at) == ("slew-begun", 7 * S)
    assert text == f"to {SUN.text} in 312 s, 0.50 deg/s at most"


def test_the_end_of_a_slew_is_reported_and_a_new_path_planned() -> None:
    bench = Bench()
    bench.paths.has_arrived.return_value, bench.paths.off = True, np.radians(1.25)
    assert bench.serve(5 * S) == 1
    assert bench.reports == [("slew-ended", 5 * S, "1.25 deg from its path")]


def test_a_body_far_off_its_path_is_reported_once_and_planned_for_when_it_is_slow() -> None:
    bench = Bench()
    bench.paths.astray.since, bench.paths.off = 1.0, np.radians(50.0)
    bench.planner.request(4 * S)
    for now_ns in (5 * S, 6 * S):
        assert bench.serve(now_ns) == 0
    ((name, _, text),) = bench.reports
    assert name == "astray"
    assert text.startswith("the attitude is 50 deg from its path")
    bench.paths.astray.ready = True
    assert bench.serve(7 * S) == 1
    bench.paths.astray.ready = False
    bench.finish(SimpleNamespace(slew=None), 8 * S)
    bench.paths.offer.assert_not_called()
    bench.paths.astray.since = None
    assert bench.serve(30 * S) == 2, "the plan from before the damping is made again"
    bench.finish(SimpleNamespace(slew=None), 31 * S)
    bench.paths.astray.since = 1.0
    bench.serve(40 * S)
    assert [name for name, *_ in bench.reports] == ["astray"] * 2, "a new departure is reported"


def test_a_planned_path_is_continued_without_a_slew() -> None:
    bench = Bench()
    bench.paths.attitude.return_value = np.array([0.0, 0.0, 0.0, 1.0])
    bench.planner.request(5 * S)
    bench.serve(5 * S)
    assert bench.jobs[0].slew is None
    assert (bench.jobs[0].span is STEADY) is (bench.jobs[0].slew is None)


def targets(looks: bool = True) -> tuple[PointingTargets, Mock]:
    """Return targets at mission times of 0, 10 and 20 s, and their paths."""
    paths = Mock()
    timed = [(0.0, NADIR), (10.0, SUN), (20.0, PointingTarget(Goal.NADIR, roll=0.5))]
    return PointingTargets(timed, paths, looks), paths


def test_the_configured_target_is_that_of_the_mission_time() -> None:
    found, _ = targets()
    indices = [found.configured(at).index for at in (-1, 0, 10 * S - 1, 10 * S, 20 * S, 99 * S)]
    assert indices == [0, 0, 0, 1, 2, 2]


def test_a_command_is_a_pointing_goal_and_an_object_needs_a_search() -> None:
    found, _ = targets()
    commanded = found.commanded(SUN, 3)
    assert commanded.index != found.commanded(SUN, 4).index
    assert commanded.law.text == SUN.text
    with pytest.raises(UsageError, match="target q2 is for the testbed"):
        found.commanded(0.2, 1)
    target = PointingTarget(Goal.OBJECT)
    assert found.commanded(target, 1).law.text == target.text
    with pytest.raises(UsageError, match="does not search for objects"):
        targets(looks=False)[0].commanded(target, 1)


def test_the_error_is_the_angle_to_the_planned_attitude() -> None:
    found, paths = targets()
    q = normalise(np.array([0.1, 0.2, 0.3, 0.9]))
    estimate = cast(Any, SimpleNamespace(quaternion=q, rate=np.array([0.03, 0.0, 0.04]), time_ns=7))
    paths.attitude.return_value = multiply(from_rotation_vector(np.array([0.0, 0.3, 0.0])), q)
    target = found.configured(0)
    assert found.error(estimate, target) == pytest.approx(0.3)
    paths.attitude.assert_called_once_with(NADIR, 7)
    paths.attitude.return_value = None
    assert found.error(estimate, target) == 0.0, "there is no path yet"
    assert found.speed(estimate) == pytest.approx(0.05)
    assert found.can_hold(estimate)
    assert found.error_when_due(estimate, target, 7) is None
    held = found.hold_here(estimate, 7)
    assert cast(Any, held.law).target.numbers == pytest.approx(tuple(q))
