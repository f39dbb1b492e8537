"""Tests of the public planners: a single-axis step and a three-axis slew."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from knightcube import (
    ArgumentError,
    GeomagneticError,
    Goal,
    OrbitError,
    PointingTarget,
    SingleAxisPlant,
    plan_slew,
    plan_step,
)
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import PlanningError, UsageError
from knightcube.gnc.guidance import slew_plan
from knightcube.gnc.guidance.plant import FARTHEST

PLANT = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.148, stiffness=1e-5, damping=2e-6)
NADIR, SUN = PointingTarget(Goal.NADIR), PointingTarget(Goal.SUN)
NAN = float("nan")
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
    """The planned current of a step moves a body to the planned end of the step.

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
            {"plant": FREE, "start_rate": 0.05, "horizon": 86_400.0, "max_stretch": 1.0},
            "use another horizon or a larger current limit",
        ),
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
    """The current in the error message is a lower bound; 2 % above it, this small step is possible."""
    step: dict[str, Any] = {"start_angle": -0.05, "end_angle": 0.05, "horizon": 12.0, "max_stretch": 1.0}
    with pytest.raises(PlanningError) as refused:
        plan_step(replace(FREE, current_limit=1e-4), **step, end_rate=end_rate)
    least = float(str(refused.value).partition("at least about ")[2].split()[0])
    with pytest.raises(PlanningError):
        plan_step(replace(FREE, current_limit=0.98 * least), **step, end_rate=end_rate)
    assert plan_step(replace(FREE, current_limit=1.02 * least), **step, end_rate=end_rate).horizon == 12.0


@pytest.mark.parametrize("name", ["start_angle", "end_angle", "horizon", "start_rate", "max_stretch"])
@pytest.mark.parametrize("value", ["1.0", [1.0], 1j])
def test_an_argument_of_a_step_with_another_type_is_named(name: str, value: object) -> None:
    with pytest.raises(ArgumentError, match=f"^{name}: .*: give a number"):
        plan_step(**STEP | {name: value})


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


def test_a_slew_far_beyond_the_limit_is_not_tried_at_each_start(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[object] = []
    plan_task = slew_plan.plan_task

    def counted(task: Any) -> Any:
        tried.append(task)
        return plan_task(task)

    monkeypatch.setattr(slew_plan, "plan_task", counted)
    with pytest.raises(PlanningError, match="check that inertia is in kg") as caught:
        plan_slew(**SLEW | {"inertia": [11.0, 10.5, 9.9]}, window=1200.0)
    assert len(tried) == 1
    assert caught.value.is_hopeless
    assert type(caught.value) is PlanningError, "a user can name the class of the error"


def test_a_slew_that_is_longer_than_a_third_of_the_longest_needs_no_limit() -> None:
    assert plan_slew(**SLEW | {"duration": 7000.0, "nodes": 8}).plan.horizon == pytest.approx(7000.0)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"goal": PointingTarget(Goal.OBJECT)}, "known only in flight"),
        ({"start": "sun"}, "start: 'sun': give a PointingTarget"),
        ({"cones": {"venus": 0.1}}, "unknown exclusion cone 'venus'"),
        ({"cones": {"sun": -1.0}}, r"cones\['sun'\]: -1.0 rad: must be 0 to below pi"),
        ({"cones": {"moon": 15.0}}, r"cones\['moon'\]: 15.0 rad: .* math.radians converts degrees"),
        ({"cones": {"moon": NAN}}, r"cones\['moon'\]: nan rad"),
        ({"window": -1.0}, "window"),
        ({"window": NAN}, "window is nan s: must be 0 to 20000 s"),
        ({"window": "300"}, "window: '300': give a number"),
        ({"duration": np.array([600.0])}, r"duration: array\(\[600.\]\): give a number"),
        ({"longest": "900"}, "longest: '900': give a number"),
        ({"time_cost": True}, "time_cost: True: give a number"),
        ({"cones": {"sun": "0.3"}}, r"cones\['sun'\]: '0.3' rad: must be"),
        ({"duration": NAN}, "duration is nan s, .* must satisfy 1 <= duration <= longest <= 20000 s"),
        ({"duration": 1e12}, "duration is 1000000000000.0 s"),
        ({"longest": 300.0}, "duration is 600.0 s, longest 300.0 s: must satisfy"),
        ({"nodes": 24.5}, "nodes is 24.5: must be an integer from 8 to 96"),
        (
            {"inertia": [[1e-3, 1e-4, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-3]]},
            "inertia: is not symmetric",
        ),
        ({"inertia": np.diag([1e-3, 1e-3, 0.1])}, "inertia: has .* the largest must not exceed the sum"),
        (
            {"inertia": 1e-3},
            r"inertia: an array of shape \(\): give .* of shape \(3, 3\) or \(3,\)",
        ),
        ({"inertia": [1e-3, NAN, 1e-3]}, "inertia: .*nan.* give finite numbers"),
        ({"dipole_limit": 0.1}, r"dipole_limit: an array of shape \(\): give finite numbers of shape \(3,\)"),
        ({"dipole_limit": [0.1, 0.0, 0.1]}, r"dipole limits are \[0.1, 0.0, 0.1\] A m\^2: all must be above"),
        ({"heat": 50.0}, r"heat: an array of shape \(\)"),
        ({"heat": [50.0, -50.0, 50.0]}, r"heat is \[50.0, -50.0, 50.0\]: the heating power of every"),
        ({"heat": [[50.0, 9.0, 0.0], [0.0, 50.0, 0.0], [0.0, 0.0, 50.0]]}, "heat: .* must be symmetric"),
        ({"pointing_axis": (0.0, 0.0, 0.0)}, "pointing_axis: .* whose length is not zero"),
        ({"across_axis": (0.0, NAN, 0.0)}, "across_axis: .*nan.* give finite numbers"),
        ({"across_axis": (0.0, 0.0, 3.0)}, "across_axis: .* must not be parallel to pointing_axis"),
        ({"camera_axis": (0.0, 1.0)}, r"camera_axis: an array of shape \(2,\)"),
        (
            {"inertia": [11.0, 10.5, 9.9]},
            r"600 s needs 249 times the dipole limit: check that inertia is in kg m\^2 and the dipole",
        ),
        ({"elements": SLEW["elements"][0]}, "elements: '1 99999U.* give the two lines"),
        ({"time": "2026-03-20"}, "time: '2026-03-20': give a datetime"),
    ],
)
def test_an_impossible_slew_is_refused_with_the_reason(wrong: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        plan_slew(**SLEW | wrong)


@pytest.mark.parametrize(
    ("wrong", "error", "reason"),
    [
        (
            {"time": datetime(1999, 1, 1)},
            GeomagneticError,
            "year 1999.00: WMM2025 is valid from 2025",
        ),
        ({"time": datetime(2060, 1, 1)}, GeomagneticError, "year 2060.00"),
        ({"time": datetime(2029, 12, 31, 22), "window": 2e4}, GeomagneticError, "year 2030.00"),
        (
            {"time": datetime(2028, 1, 1)},
            OrbitError,
            "of 2026-03-20 do not give the orbit on 2028-01-01",
        ),
        (
            {"time": datetime(2025, 1, 1)},
            OrbitError,
            "of 2026-03-20 do not give the orbit on 2025-01-01",
        ),
    ],
)
def test_a_slew_at_a_time_without_known_field_or_orbit_is_refused(
    wrong: dict[str, Any], error: type[Exception], reason: str
) -> None:
    with pytest.raises(error, match=reason):
        plan_slew(**SLEW | wrong)


def test_a_free_roll_does_not_move_a_goal_out_of_its_cone() -> None:
    """A camera on the pointing axis sees the Sun at any roll; one 60 deg from it can avoid a cone of 50 deg.

    The remedy is another goal, not a longer time.
    """
    reason = "all of these, .* end in the exclusion cone of the Sun: choose another goal or time"
    with pytest.raises(PlanningError, match=reason):
        plan_slew(**SLEW, cones={"sun": 0.5})
    beside = np.array([np.sin(np.radians(60.0)), 0.0, np.cos(np.radians(60.0))])
    found = plan_slew(**SLEW, camera_axis=beside, cones={"sun": np.radians(50.0)})
    assert found.plan.clearance[0] >= 0.0


def test_a_slew_depends_on_the_directions_of_the_axes_and_not_on_their_lengths() -> None:
    """Axes of any length, and principal moments instead of a tensor, give the same plan."""
    axes: dict[str, Any] = {"pointing_axis": [0.0, 0.6, 0.8], "across_axis": [1.0, 0.0, 0.0]}
    cones: dict[str, Any] = {"camera_axis": [0.0, 0.0, 1.0], "cones": {"moon": 0.2}}
    unit = plan_slew(**SLEW, **axes, **cones)
    scaled = plan_slew(
        **SLEW | {"inertia": [1.10e-3, 1.05e-3, 0.99e-3]},
        pointing_axis=(0.0, 3.0, 4.0),
        across_axis=(2.0, 0.0, 0.0),
        camera_axis=(0.0, 0.0, 0.5),
        cones={"moon": 0.2},
    )
    assert scaled.plan.energy == pytest.approx(unit.plan.energy, rel=1e-9)
    assert scaled.plan.clearance == pytest.approx(unit.plan.clearance, abs=1e-9)


def test_dipoles_are_linear_between_the_times_of_a_slew() -> None:
    """A motion that is integrated with linear dipoles ends within 0.001 deg of the slew's end."""
    found = plan_slew(**SLEW)
    path, along = found.plan.path, found.task.along
    inertia = np.diag(SLEW["inertia"])

    def flow(time: float, state: FloatArray) -> FloatArray:
        q, w = state[:4], state[4:]
        around = along(np.array([time]))
        down, gradient = around.gradient()
        turned = attitude_matrix(q / np.linalg.norm(q))
        dipole = np.array([np.interp(time, path.times, part) for part in path.dipole.T])
        e = turned @ down[0]
        torque = np.cross(dipole, turned @ around.field[0]) + gradient[0] * np.cross(e, inertia * e)
        torque -= np.cross(w, inertia * w)
        vector = 0.5 * (q[3] * w + np.cross(q[:3], w))
        return np.concatenate([vector, [-0.5 * q[:3] @ w], torque / inertia])

    begin = np.concatenate([path.quaternion[0], path.rate[0]])
    end = solve_ivp(flow, (0.0, path.horizon), begin, rtol=1e-9, atol=1e-12, max_step=5.0).y[:4, -1]
    off = np.sin(np.radians(0.5e-3))  # half of 0.001 deg, the length of the difference of quaternions
    assert np.linalg.norm(end / np.linalg.norm(end) - path.quaternion[-1]) < off
