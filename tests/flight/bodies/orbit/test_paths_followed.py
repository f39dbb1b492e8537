"""Tests that a slew along a pointing path ends at its arrival, and that the arrival is reported once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.bodies.orbit import guidance
from flight.bodies.orbit.guidance import PointingPaths
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

S = 1_000_000_000
NADIR, SUN = PointingTarget(Goal.NADIR), PointingTarget(Goal.SUN)


def table(horizon: float | None, fastest: float = 0.005) -> Any:
    """Return a table with a slew that lasts `horizon` s."""
    slew = None if horizon is None else SimpleNamespace(horizon=horizon)
    path = SimpleNamespace(quaternion=np.ones((2, 4)))
    made = SimpleNamespace(
        gain=np.ones(3), dipole=np.ones(3), torque_part=np.ones(3), path=path, slew=slew, fastest=fastest
    )
    made.below = lambda limit: made if made.fastest <= limit else None
    return cast(Any, made)


@pytest.fixture
def paths(monkeypatch: pytest.MonkeyPatch) -> PointingPaths:
    """Return paths whose control law is valid from 4 s to 500 s after the origin of its table."""
    monkeypatch.setattr(guidance, "PointingLaw", lambda *_: SimpleNamespace(span=(4.0, 500.0)))
    return PointingPaths(0.1, 0.01)


def test_a_slew_is_under_way_until_its_horizon_has_passed(paths: PointingPaths) -> None:
    assert paths.is_slewing(0, NADIR) is False
    assert paths.offer(table(100.0), NADIR, 10 * S) == ""
    assert paths.is_slewing(114 * S - 1, NADIR) is True
    assert paths.is_slewing(114 * S - 1, SUN) is False
    assert paths.has_arrived(114 * S - 1) is False
    assert paths.is_slewing(114 * S, NADIR) is False
    assert paths.has_arrived(114 * S) is True
    assert paths.has_arrived(115 * S) is False, "reported once"


def test_a_table_without_a_slew_has_no_arrival(paths: PointingPaths) -> None:
    assert paths.offer(table(None), NADIR, 0) == ""
    assert not paths.is_slewing(1, NADIR)
    assert not paths.has_arrived(10**15)


def test_a_path_ends_with_its_table(paths: PointingPaths) -> None:
    assert paths.sample(0) is None
    paths.offer(table(None), NADIR, 10 * S)
    point = paths.sample(510 * S)
    assert point is not None
    assert point.seconds == 500.0
    assert paths.sample(510 * S + 1) is None


def test_tables_that_cannot_be_followed_are_refused_with_the_reason(paths: PointingPaths) -> None:
    broken = table(None)
    broken.gain = np.array([1.0, np.nan])
    assert "finite" in paths.offer(broken, NADIR, 0)
    reason = paths.offer(table(None, fastest=0.02), NADIR, 0)
    assert f"{np.degrees(0.02):.2f} deg/s" in reason
    assert f"{np.degrees(0.01):.2f}" in reason
    assert paths.sample(0) is None


def test_the_angle_between_body_and_path_is_kept(paths: PointingPaths) -> None:
    paths.offer(table(None), NADIR, 0)
    assert paths.off == 0.0
    paths.led(np.array([0.03, 0.0, -0.04]), np.zeros(3), S)
    assert paths.off == pytest.approx(0.05)
    paths.offer(table(None), NADIR, 0)
    assert paths.off == 0.0
