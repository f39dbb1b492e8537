"""Tests of the public planners: a single-axis step and a three-axis slew."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from knightcube import Goal, PointingTarget, SingleAxisPlant, plan_slew, plan_step
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import PlanningError, UsageError
from knightcube.gnc.guidance.plant import FARTHEST

PLANT = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.148, stiffness=1e-5, damping=2e-6)
NADIR, SUN = PointingTarget(Goal.NADIR), PointingTarget(Goal.SUN)
AT = datetime(2026, 3, 20, 12, 0, tzinfo=UTC)
SLEW: dict[str, Any] = {
    "inertia": np.diag([1.10e-3, 1.05e-3, 0.99e-3]),
    "dipole_limit": [0.1, 0.1, 0.1],
    "heat": [50.0, 50.0, 50.0],
    "elements": (
        "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
        "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
    ),
    "time": AT,
    "start": NADIR,
    "goal": SUN,
    "duration": 600.0,
}


def test_the_current_of_a_step_moves_the_body_to_its_end() -> None:
    """The planned current of a step moves a body to the end of the step.

    The equation of motion J w' = n A B I cos(theta) - k theta - c w is integrated independently.
    """
    found = plan_step(PLANT, start_angle=0.2, end_angle=-0.6, horizon=12.0, start_rate=0.01, end_rate=-0.02)

    def flow(time: float, state: list[float]) -> list[float]:
        angle, rate = state
        current = PLANT.currents(*found.path.motion(np.array([min(time, 12.0 - 1e-9)])))[0]
        torque = 2.916e-4 * current * np.cos(angle) - 1e-5 * angle - 2e-6 * rate
        return [rate, torque / 1.05e-3]

    end = solve_ivp(flow, (0.0, 12.0), [0.2, 0.01], rtol=1e-9, atol=1e-9).y[:, -1]
    assert end == pytest.approx([-0.6, -0.02], abs=1e-5)
    times = np.linspace(0.0, 12.0 - 1e-9, 4001)
    current = PLANT.currents(*found.path.motion(times))
    assert found.energy == pytest.approx(np.trapezoid(23.0 * current**2, times), rel=1e-4)
    assert found.peak_current == pytest.approx(np.abs(current).max(), rel=1e-3)


def test_a_step_minimises_the_selected_energy_and_a_time_cost_shortens_it() -> None:
    step: dict[str, Any] = {"start_angle": 0.0, "end_angle": 0.5, "horizon": 12.0}
    heat, supply = (plan_step(PLANT, **step, minimise=kind) for kind in ("heat", "supply"))
    assert heat.energy < supply.energy
    assert supply.supplied < heat.supplied
    slow, fast = (plan_step(PLANT, **step, time_cost=cost) for cost in (0.001, 0.1))
    assert fast.horizon < slow.horizon
    with pytest.raises(PlanningError, match="horizon"):
        plan_step(PLANT, start_angle=0.0, end_angle=0.5, horizon=-1.0)


STEP: dict[str, Any] = {"plant": PLANT, "start_angle": 0.0, "end_angle": 0.5, "horizon": 12.0}
FREE = SingleAxisPlant(2.5e-3, 5e-4, 30.0, 0.1)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (
            {"end_angle": 2.0 * np.pi - 1.0},
            r"end_angle is 5.28319 rad: must be -1.4955 to 1.4955 rad.* not wrap",
        ),
        ({"end_angle": 45.0}, "end_angle is 45 rad: .*; 45 deg would be 0.7854 rad"),
        ({"end_angle": -6.0}, "end_angle is -6 rad: must be"),
        ({"end_angle": 2.0}, "end_angle is 2 rad: must be"),
        ({"start_angle": 7.0}, "start_angle is 7 rad: must be"),
        ({"start_angle": float("nan")}, "start_angle is nan rad: must be"),
        ({"minimise": "time"}, "minimise is 'time': give 'heat' or 'supply'"),
        ({"nodes": 24.5}, "nodes is 24.5: it must be an integer from 8 to 40"),
        (
            {"plant": replace(FREE, current_limit=1e-9)},
            "at least about 0.00193 A: use a larger current",
        ),
        ({"plant": replace(PLANT, current_limit=1e-3)}, "0.0195 A would hold the end angle, which exceeds"),
        (
            {"plant": replace(PLANT, current_limit=0.04), "max_stretch": 1.0},
            "a longer horizon or a larger current",
        ),
    ],
)
def test_an_impossible_step_is_refused_with_the_reason(wrong: dict[str, Any], reason: str) -> None:
    """Angles beyond the range of the coil are refused, because sin(angle/2) would give another angle."""
    with pytest.raises(PlanningError, match=reason) as refused:
        plan_step(**STEP | wrong)
    assert "q2" not in str(refused.value)


@pytest.mark.parametrize("end_rate", [0.0, -0.02])
def test_the_current_that_a_refusal_asks_for_is_needed_and_nearly_sufficient(end_rate: float) -> None:
    """The current in the error message is a lower bound, from which a small step is possible at 2 % more."""
    step: dict[str, Any] = {"start_angle": -0.05, "end_angle": 0.05, "horizon": 12.0, "max_stretch": 1.0}
    with pytest.raises(PlanningError) as refused:
        plan_step(replace(FREE, current_limit=1e-4), **step, end_rate=end_rate)
    least = float(str(refused.value).partition("at least about ")[2].split()[0])
    with pytest.raises(PlanningError):
        plan_step(replace(FREE, current_limit=0.98 * least), **step, end_rate=end_rate)
    assert plan_step(replace(FREE, current_limit=1.02 * least), **step, end_rate=end_rate).horizon == 12.0


def test_steps_between_the_ends_of_the_range_are_planned() -> None:
    found = plan_step(PLANT, start_angle=-FARTHEST, end_angle=FARTHEST, horizon=60.0)
    assert found.path.motion(np.array([0.0, found.horizon]))[0] == pytest.approx([-FARTHEST, FARTHEST])


def test_a_slew_leads_from_nadir_to_the_sun_within_the_limits() -> None:
    found = plan_slew(**SLEW, cones={"moon": np.radians(15.0)})
    path, around = found.plan.path, found.task.along(np.array([0.0, found.plan.horizon]))
    down = -around.position[0] / np.linalg.norm(around.position[0])
    assert attitude_matrix(path.quaternion[0]) @ down == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    # The equinox is at 14:46 UTC, 2.6 h after the end of the slew, so the Sun's ecliptic longitude of date is
    # -0.107 deg. The longitude of J2000 is smaller by the precession of 26.2 years, which is 0.366 deg.
    longitude, obliquity = np.radians([-0.473, 23.44])
    sun = np.array([1.0, np.sin(longitude) * np.cos(obliquity), np.sin(longitude) * np.sin(obliquity)])
    sun /= np.linalg.norm(sun)
    assert attitude_matrix(path.quaternion[-1]) @ sun == pytest.approx([0.0, 0.0, 1.0], abs=2e-4)
    assert np.abs(path.dipole).max() <= 0.1
    assert found.plan.clearance[0] >= 0.0
    assert found.begin == 0.0


def test_a_slew_starts_at_the_best_time_of_its_window() -> None:
    """A slew starts at the best time of its window.

    The time may have any time zone. Without a time zone, the time is UTC.
    """
    fixed = plan_slew(**SLEW)
    zone = timezone(timedelta(hours=2))
    later = plan_slew(**SLEW | {"time": AT.astimezone(zone)}, window=1200.0)
    assert 0.0 <= later.begin <= 1200.0
    assert later.plan.energy <= fixed.plan.energy
    assert later.compared > 1
    naive = plan_slew(**SLEW | {"time": AT.replace(tzinfo=None)})
    assert naive.plan.energy == fixed.plan.energy


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"goal": PointingTarget(Goal.OBJECT)}, "known only in flight"),
        ({"cones": {"venus": 0.1}}, "unknown exclusion cone 'venus'"),
        ({"window": -1.0}, "window"),
    ],
)
def test_an_impossible_slew_is_refused_with_the_reason(wrong: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        plan_slew(**SLEW | wrong)
