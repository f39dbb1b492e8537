"""Tests of the times at which slews and paths are planned, and of the part of a path that is executed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.bodies.orbit.guidance import (
    LearnedBody,
    ObjectAim,
    PlannedCraft,
    PointingPaths,
    PointingPlanner,
    PointingTargetLaw,
)
from flight.loop.body import Target
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import BoolArray
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.control.pointing_job import PointingJob, SlewRequest
from knightcube.gnc.control.pointing_law import LEAVING
from knightcube.gnc.guidance.attitude_law import AttitudeReferences, BodyAxes
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.flight.bodies.orbit.guidance_tables import AWAY, NADIR, STILL
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LIMIT,
    ORBIT,
    WEIGHTS,
    X,
    Z,
)

RESIDUAL = np.array([1e-3, 0.0, 0.0])
WISH = SlewRequest(300.0, np.ones(3), np.zeros(3), Z)
SUN = PointingTarget(Goal.SUN)


@pytest.fixture
def paths() -> PointingPaths:
    return PointingPaths(LIMIT, 0.1)


ALL = np.ones(3, dtype=bool)
COILS = CoilMap(0.8 * np.eye(3), np.full(3, 0.5), np.array([10.0, 20.0, 30.0]))
"""Coils with a dipole limit of 2 LIMIT on each axis. They are driven for half of the time."""


def planned(paths: PointingPaths, goal: PointingTarget, now_ns: int, usable: BoolArray = ALL) -> PointingJob:
    """Return the job that a planner submits for a target."""
    (job,) = submitted(paths, goal, now_ns, requested=True, usable=usable)
    return job


def submitted(
    paths: PointingPaths,
    goal: PointingTarget,
    now_ns: int,
    *,
    requested: bool,
    usable: BoolArray = ALL,
    texts: list[str] | None = None,
) -> list[PointingJob]:
    """Return the jobs that a planner submits for a goal if only the given coils (n,) are usable.

    The texts of the planner's events are appended to `texts`.
    """
    jobs: list[PointingJob] = []

    def submit(_: str, job: PointingJob) -> bool:
        jobs.append(job)
        return True

    services = SimpleNamespace(
        jobs=SimpleNamespace(submit=submit),
        events=SimpleNamespace(report=lambda _, __, text: texts.append(text) if texts is not None else None),
    )
    craft = PlannedCraft(INERTIA, BodyAxes(Z, X), WEIGHTS, COILS, 0.5, WISH)
    planner = PointingPlanner(
        craft,
        paths,
        cast(Any, SimpleNamespace(state=lambda _: ORBIT)),
        lambda: LearnedBody(INERTIA, np.zeros(9), RESIDUAL),
        lambda: usable,
        ObjectAim(None, LIMIT, cast(Any, services.events)),
        cast(Any, services),
    )
    if requested:
        planner.request(now_ns)
    estimate = SimpleNamespace(quaternion=np.array([0.0, 0.0, 0.0, 1.0]), rate=np.zeros(3))
    planner.serve(cast(Any, estimate), Target(0, PointingTargetLaw(goal, paths)), now_ns)
    return jobs


def test_slews_are_planned_with_the_coils_that_are_not_isolated(paths: PointingPaths) -> None:
    whole = planned(paths, SUN, 0)
    assert whole.slew is not None
    assert whole.slew.limit is not None
    np.testing.assert_allclose(whole.limit, [0.2] * 3)
    np.testing.assert_allclose(whole.slew.limit, [0.2] * 3)
    np.testing.assert_allclose(whole.slew.heat, np.diag([10.0, 20.0, 30.0]) / 0.8**2)
    crippled = planned(paths, SUN, 0, np.array([True, False, True]))
    assert crippled.slew is not None
    assert crippled.slew.limit is not None
    np.testing.assert_allclose(crippled.limit, [0.2, 0.1, 0.2])
    np.testing.assert_allclose(crippled.slew.limit, [0.2, 0.006, 0.2], rtol=1e-6)
    heat = np.diag(crippled.slew.heat)
    np.testing.assert_allclose(heat[[0, 2]], np.array([10.0, 30.0]) / 0.8**2)
    assert heat[1] > 500.0 * heat[0]


def test_a_slew_is_refused_with_its_reason_if_one_coil_works(paths: PointingPaths) -> None:
    texts: list[str] = []
    usable = np.array([False, False, True])
    assert submitted(paths, SUN, 0, requested=True, usable=usable, texts=texts) == []
    assert len(texts) == 1
    assert texts[0].startswith("no plan: all coils lie along [0.00, 0.00, 1.00]")


def test_a_path_that_leaves_its_target_for_a_time_does_not_start_a_slew(
    table: Any, paths: PointingPaths
) -> None:
    before = planned(paths, NADIR, 0).slew
    assert before is not None
    assert before.residual is RESIDUAL
    paths.offer(table, NADIR, 0)
    assert planned(paths, NADIR, SECOND_NS).slew is None
    assert planned(paths, SUN, SECOND_NS).slew is not None


def test_a_body_far_from_its_path_gets_a_new_slew(table: Any, paths: PointingPaths) -> None:
    paths.offer(table, NADIR, 0)
    paths.led(AWAY, STILL, SECOND_NS)
    assert planned(paths, NADIR, 2 * SECOND_NS).slew is not None


def test_a_body_that_leaves_its_path_is_planned_for_again(table: Any, paths: PointingPaths) -> None:
    paths.offer(table, NADIR, 0)
    paths.led(0.9 * LEAVING * X, STILL, SECOND_NS)
    assert not submitted(paths, NADIR, 2 * SECOND_NS, requested=False)
    paths.led(1.1 * LEAVING * X, STILL, 3 * SECOND_NS)
    (job,) = submitted(paths, NADIR, 4 * SECOND_NS, requested=False)
    assert job.slew is None


def test_a_path_is_followed_until_it_rotates_too_fast(table: Any, paths: PointingPaths) -> None:
    count = len(table.dipole)
    late, soon = (replace(table, path=_fast_from(table.path, part * count // 10)) for part in (6, 2))
    assert paths.offer(late, NADIR, 0) == ""
    sample = paths.sample(SECOND_NS)
    assert sample is not None
    first, last = sample.law.span
    assert first == table.path.times[0]
    assert last == table.path.times[6 * count // 10 - 1]
    assert "detumbled" in paths.offer(soon, NADIR, 0)
    assert sample.law is paths.sample(SECOND_NS).law  # type: ignore[union-attr] # it was not replaced


def _fast_from(path: AttitudeReferences, place: int) -> AttitudeReferences:
    """Return a copy of a path that rotates at 0.2 rad/s from the sample number `place` on."""
    rate = path.rate.copy()
    rate[place:] = [0.2, 0.0, 0.0]
    return replace(path, rate=rate)
