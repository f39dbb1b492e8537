"""Slews with known optima, and a model of the motion that shares no code with the planner.

Problems, magnetic fields and optima in the file come from an independent direct collocation. `flown`
integrates the equations of motion that the file states as `model`.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.slew_model import (
    AttitudeEnd,
    EnvironmentAt,
    SlewCraft,
    SlewEnvironment,
    SlewTask,
)
from knightcube.gnc.guidance.slew_plan import SlewPlan

FILE = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "optimum_orbit.json"
STEPS = 20
"""Number of integration steps per collocation interval of a plan."""


@cache
def recorded() -> dict[str, Any]:
    """Return the content of the file of slews; skip the test if the file is missing."""
    if not FILE.exists():
        pytest.skip(f"no optima of slews at {FILE}")
    content: dict[str, Any] = json.loads(FILE.read_text())
    return content


def problem(name: str) -> dict[str, Any]:
    """Return the problem with the given name."""
    found: dict[str, Any] = next(one for one in recorded()["problems"] if one["name"] == name)
    return found


def matrix(q: FloatArray) -> FloatArray:
    """Return the attitude matrix (3, 3) of a quaternion by the textbook formula of Euler parameters."""
    v, s = np.asarray(q[:3]), float(q[3])
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray((s * s - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) - 2.0 * s * cross)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product (3,) of two vectors. The general function of numpy takes ten times longer."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def along_of(case: dict[str, Any]) -> EnvironmentAt:
    """Return the function that gives the magnetic field and the position of a problem at given times."""
    file = recorded()
    orbit = file["orbit"][case["orbit"]]
    radius = file["earth_radius"] + orbit["altitude"]
    motion = float(np.sqrt(file["mu"] / radius**3))
    tilt, node = np.radians([orbit["inclination_deg"], orbit["raan_deg"]])
    rise = np.array([np.cos(node), np.sin(node), 0.0])
    ahead = np.array([-np.sin(node) * np.cos(tilt), np.cos(node) * np.cos(tilt), np.sin(tilt)])
    series = np.array(file["fields"][f"{case['orbit']}-{case['u0_deg']:g}"])

    def along(times: FloatArray) -> SlewEnvironment:
        argument = np.radians(case["u0_deg"]) + motion * times
        position = radius * (np.outer(np.cos(argument), rise) + np.outer(np.sin(argument), ahead))
        return SlewEnvironment(chebyshev.chebval(2.0 * times / file["window_s"] - 1.0, series).T, position)

    return along


def task_of(case: dict[str, Any], horizon: float, **options: Any) -> SlewTask:
    """Return the planner's task of a problem with a duration of `horizon` s."""
    craft = recorded()["craft"][case["craft"]]
    end = AttitudeEnd(np.array(case["qf"]), matrix(np.array(case["qf"])).T @ np.array(case["wf"]))
    model = SlewCraft(
        np.diag(craft["inertia"]),
        np.full(3, craft["m_max"]),
        np.full(3, craft["watt_per_Am2_squared"]),
    )
    options.setdefault("longest", 3.0 * horizon)
    start = np.array(case["q0"]), np.array(case["w0"])
    return SlewTask(model, along_of(case), *start, lambda _: end, horizon, **options)


def flown(plan: SlewPlan, task: SlewTask) -> FloatArray:
    """Return the final state (7,) of a body on which only the dipoles of the plan act.

    The integrator is the Runge-Kutta method of fourth order with STEPS steps per collocation interval.
    """
    inertia, inverse, mu = task.craft.inertia, np.linalg.inv(task.craft.inertia), 3.986004418e14
    steps = STEPS * task.nodes
    times = np.linspace(0.0, plan.horizon, 2 * steps + 1)
    around, dipoles = task.along(times), plan.path.dipoles(times)

    def flow(k: int, x: FloatArray) -> FloatArray:
        """Return the derivative (7,) of the state at time `times[k]`."""
        q, w, attitude = x[:4], x[4:], matrix(x[:4])
        place = attitude @ around.position[k]
        tide = 3.0 * mu / float(place @ place) ** 2.5 * _cross(place, inertia @ place)
        torque = _cross(dipoles[k], attitude @ around.field[k]) + tide
        turning = 0.5 * (q[3] * w - _cross(w, q[:3]))
        faster = inverse @ (torque - _cross(w, inertia @ w))
        return np.array([*turning, -0.5 * w @ q[:3], *faster])

    x, step = np.concatenate([task.quaternion, task.rate]), plan.horizon / steps
    for k in range(0, 2 * steps, 2):
        first = flow(k, x)
        second = flow(k + 1, x + 0.5 * step * first)
        third = flow(k + 1, x + 0.5 * step * second)
        x = x + step / 6.0 * (first + 2.0 * (second + third) + flow(k + 2, x + step * third))
    return x


def off_degrees(q: FloatArray, wanted: FloatArray) -> float:
    """Return the angle (deg) between two attitudes (4,)."""
    turn = matrix(q / np.linalg.norm(q)) @ matrix(wanted).T
    return float(np.degrees(2.0 * np.arcsin(min(1.0, np.linalg.norm(turn - np.eye(3)) / np.sqrt(8.0)))))
