"""Tests that the satellite's target is set by mission time, by a command, or to the present attitude."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.bodies.orbit.guidance import PointingPaths, PointingTargetLaw, PointingTargets, target_of
from flight.loop.body import COMMANDED, KEPT, Target, TargetLaw
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

SUN, NADIR, OBJECT = (PointingTarget(goal) for goal in (Goal.SUN, Goal.NADIR, Goal.OBJECT))


def targets(*, looks_for_objects: bool = False) -> PointingTargets:
    return PointingTargets([(0.0, SUN), (60.0, NADIR)], PointingPaths(1.0, 0.1), looks_for_objects)


@pytest.mark.parametrize(
    ("second", "goal"), [(-1.0, SUN), (0.0, SUN), (59.9, SUN), (60.0, NADIR), (1e6, NADIR)]
)
def test_the_configured_target_changes_at_its_mission_time(second: float, goal: PointingTarget) -> None:
    assert target_of(targets().configured(round(second * 1e9))) == goal


def test_a_commanded_direction_is_a_target_with_the_command_s_number() -> None:
    found = targets().commanded(NADIR, 3)
    assert (found.index, target_of(found), found.law.text) == (COMMANDED + 3, NADIR, NADIR.text)


def test_a_satellite_refuses_a_q2_and_an_object_without_a_camera_that_searches() -> None:
    with pytest.raises(UsageError, match="q2 is for the testbed"):
        targets().commanded(0.3, 1)
    with pytest.raises(UsageError, match="star camera does not search"):
        targets().commanded(OBJECT, 1)
    assert target_of(targets(looks_for_objects=True).commanded(OBJECT, 1)) == OBJECT


def test_the_present_attitude_is_an_inertial_target_that_no_packet_numbers() -> None:
    quaternion = np.array([0.0, 0.6, 0.0, 0.8])
    estimate = cast("Any", SimpleNamespace(quaternion=quaternion, rate=np.array([0.0, 3.0, 4.0])))
    held = targets().hold_here(estimate, 0)
    assert (held.index, target_of(held).goal) == (KEPT, Goal.INERTIAL)
    assert target_of(held).numbers == (0.0, 0.6, 0.0, 0.8)
    assert targets().speed(estimate) == pytest.approx(5.0)
    assert targets().can_hold(estimate)
    assert targets().error_when_due(estimate, held, 10**12) is None


def test_the_error_is_the_angle_to_the_path_and_zero_before_there_is_a_path() -> None:
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    estimate = cast("Any", SimpleNamespace(quaternion=identity, time_ns=0))
    assert np.isnan(PointingTargetLaw(SUN, PointingPaths(1.0, 0.1)).quaternion(0)).all()
    assert targets().error(estimate, targets().configured(0)) == 0.0
    turned = SimpleNamespace(quaternion=lambda _: np.array([np.sin(0.1), 0.0, 0.0, np.cos(0.1)]), text="")
    assert targets().error(estimate, Target(0, cast("TargetLaw", turned))) == pytest.approx(0.2)
