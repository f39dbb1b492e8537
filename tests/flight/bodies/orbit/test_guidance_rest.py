"""Tests that the rest of a slew is planned again, and that the new plan follows the old without a jump."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.bodies.orbit.guidance import (
    MOST_WAITS,
    REST,
    REST_AGAIN_NS,
    LearnedBody,
    ObjectAim,
    PlannedCraft,
    PointingPaths,
    PointingPlanner,
    PointingTargetLaw,
)
from flight.loop.body import Target
from flight.loop.executive import JobResult
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.earth.disturbance import box_areas
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.control.pointing_job import PointingJob
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.guidance.attitude_law import BodyAxes
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.flight.bodies.orbit.guidance_tables import AWAY, NADIR, STILL
from tests.knightcube.gnc.control.pointing_cases import INERTIA, LIMIT, ORBIT, WEIGHTS, X, Z
from tests.knightcube.gnc.control.pointing_requests import WISH, planned

RESIDUAL = np.array([1e-3, 0.0, 0.0])
SUN = PointingTarget(Goal.SUN)
LEARNED = INERTIA + 1e-4 * np.ones((3, 3))
COILS = CoilMap.equal(2.0 * LIMIT, 1.0, 20.0)
ESTIMATE = SimpleNamespace(quaternion=np.array([0.0, 0.0, 0.0, 1.0]), rate=np.zeros(3))


@pytest.fixture(scope="module")
def slew() -> PointingTable:
    """Return the table of a slew that begins 10 s after the origin of its job."""
    return planned(np.zeros(9))


class Flight:
    """A planner without a worker. The submitted jobs are kept in a list."""

    def __init__(self, inertia: Any = LEARNED) -> None:
        self.jobs: list[PointingJob] = []
        self.events: list[str] = []
        self.usable = np.ones(3, dtype=bool)

        def submit(_: str, job: PointingJob) -> bool:
            self.jobs.append(job)
            return True

        services = SimpleNamespace(
            jobs=SimpleNamespace(submit=submit),
            events=SimpleNamespace(report=lambda event, *_: self.events.append(event.name)),
        )
        self.paths = PointingPaths(LIMIT, 0.1)
        self.planner = PointingPlanner(
            PlannedCraft(INERTIA, BodyAxes(Z, X), WEIGHTS, COILS, 0.5, WISH),
            self.paths,
            cast(Any, SimpleNamespace(state=lambda _: ORBIT)),
            lambda: LearnedBody(inertia, np.zeros(9), RESIDUAL),
            lambda: self.usable,
            ObjectAim(None, LIMIT, cast(Any, services.events)),
            cast(Any, services),
        )

    def serve(self, now: float, goal: Any = NADIR) -> None:
        target = Target(0, PointingTargetLaw(goal, self.paths))
        self.planner.serve(cast(Any, ESTIMATE), target, round(now * SECOND_NS))

    def finish(self, now: float, value: Any, outcome: str = "done") -> None:
        result = SimpleNamespace(outcome=outcome, value=value, error="worker died")
        self.planner.finish(cast(JobResult, result), round(now * SECOND_NS))


def test_the_rest_is_planned_again_every_few_seconds_with_the_learned_body(slew: PointingTable) -> None:
    flight = Flight()
    flight.paths.offer(slew, NADIR, 0)
    flight.serve(9.0)
    assert not flight.jobs, "the slew has not begun"
    flight.serve(40.0)
    flight.serve(41.0)
    (job,) = flight.jobs
    assert job.running is not None
    assert job.running.path is slew.slew
    assert job.running.since == pytest.approx(30.0)
    assert job.slew is not None
    assert job.slew.residual is RESIDUAL
    np.testing.assert_array_equal(job.inertia, LEARNED)
    np.testing.assert_array_equal(job.areas, box_areas(INERTIA))
    flight.finish(41.0, replace(slew, path=replace(slew.path, times=slew.path.times - 8.0)))
    again = 40.0 + REST_AGAIN_NS / SECOND_NS
    flight.serve(again - 0.1)
    assert len(flight.jobs) == 1
    flight.serve(again)
    assert len(flight.jobs) == 2


def test_after_plans_that_improve_nothing_the_rest_is_planned_again_later(slew: PointingTable) -> None:
    flight = Flight()
    flight.paths.offer(slew, NADIR, 0)
    flight.serve(40.0)
    again = 40.0
    for count, waits in enumerate([*range(2, MOST_WAITS + 1), MOST_WAITS], 1):
        flight.finish(again + 0.1, None)
        again += waits * REST_AGAIN_NS / SECOND_NS
        flight.serve(again - 0.1)
        assert len(flight.jobs) == count
        flight.serve(again)
        assert len(flight.jobs) == count + 1


def test_when_a_coil_fails_the_rest_is_planned_at_once(slew: PointingTable) -> None:
    flight = Flight()
    flight.paths.offer(slew, NADIR, 0)
    flight.serve(40.0)
    flight.finish(40.1, None)
    flight.serve(41.0)
    assert len(flight.jobs) == 1
    flight.usable = np.array([True, True, False])
    flight.serve(41.1)
    assert len(flight.jobs) == 2
    flight.finish(41.2, None)
    flight.serve(42.0)
    assert len(flight.jobs) == 2, "the rest is planned once with the changed coils"


def test_near_its_end_a_slew_is_not_planned_again(slew: PointingTable) -> None:
    assert slew.slew is not None
    last = 10.0 + (1.0 - REST) * slew.slew.horizon
    for now, count in ((last - 1.0, 1), (last + 1.0, 0)):
        flight = Flight()
        flight.paths.offer(slew, NADIR, 0)
        flight.serve(now)
        assert len(flight.jobs) == count


def test_a_new_plan_is_followed_from_its_start_or_if_it_is_late_from_the_present_time(
    slew: PointingTable,
) -> None:
    for arrives, expected in ((41.0, 50.0), (55.0, 55.0)):
        flight = Flight()
        flight.paths.offer(slew, NADIR, 0)
        flight.serve(40.0)
        before = flight.paths.sample(round(arrives * SECOND_NS))
        rest = replace(slew, path=replace(slew.path, times=slew.path.times - 0.5))
        flight.finish(arrives, rest)
        assert before is not None
        end_ns = round((40.0 + 9.5) * SECOND_NS)
        if arrives < 49.5:
            still = flight.paths.sample(end_ns - 1)
            assert still is not None
            assert still.law is before.law
        point = flight.paths.sample(round(expected * SECOND_NS))
        assert point is not None
        assert point.law is not before.law
        assert point.seconds == pytest.approx(expected - 40.0), "the times of the rest count from its job"
        assert flight.planner.counts() == (1, 0)


def test_without_a_plan_for_the_rest_the_current_plan_continues(slew: PointingTable) -> None:
    for value, outcome, events in ((None, "done", []), (None, "died", ["planner-failed"])):
        flight = Flight()
        flight.paths.offer(slew, NADIR, 0)
        flight.serve(40.0)
        before = flight.paths.sample(50 * SECOND_NS)
        flight.finish(41.0, value, outcome)
        point = flight.paths.sample(50 * SECOND_NS)
        assert before is not None
        assert point is not None
        assert point.law is before.law
        assert flight.paths.is_slewing(50 * SECOND_NS, NADIR)
        assert flight.events == events


def test_a_rest_is_dropped_if_the_body_has_left_its_path_or_has_another_target(slew: PointingTable) -> None:
    flight = Flight()
    flight.paths.offer(slew, NADIR, 0)
    flight.serve(40.0)
    flight.paths.led(AWAY, STILL, 41 * SECOND_NS)
    flight.finish(41.0, slew)
    assert flight.planner.counts() == (0, 0)
    flight = Flight()
    flight.paths.offer(slew, NADIR, 0)
    flight.serve(40.0)
    flight.paths.offer(slew, SUN, round(40.5 * SECOND_NS))
    before = flight.paths.sample(60 * SECOND_NS)
    flight.finish(41.0, slew)
    point = flight.paths.sample(60 * SECOND_NS)
    assert before is not None
    assert point is not None
    assert point.law is before.law


def test_an_inertia_that_no_body_has_is_not_planned_with(slew: PointingTable) -> None:
    flight = Flight(INERTIA - 0.006 * np.eye(3))
    flight.paths.offer(slew, NADIR, 0)
    flight.serve(40.0)
    np.testing.assert_array_equal(flight.jobs[0].inertia, INERTIA)
