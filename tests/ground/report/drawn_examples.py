"""Plots of artificial runs. `drawn_examples.json` contains descriptions of the plots.

`python -m tests.ground.report.drawn_examples` writes new descriptions after an intended change of the plots.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from flight.bodies.testbed.control import plant_of
from flight.link import events
from flight.link.events import Mode
from ground.report import figures, panels
from ground.report.panels import RunSignals
from ground.telemetry import Run
from knightcube.astro.quaternion import from_rotation_vector
from knightcube.gnc.guidance.plant import lgl_rule
from knightcube.gnc.guidance.slew_model import Cone, SlewCraft, SlewEnvironment, SlewPath
from knightcube.gnc.guidance.slew_plan import SlewStatus
from knightcube.gnc.guidance.vmc import plan
from tests.ground.report.drawn_figure import described
from tests.support.flights import demo_config
from tests.support.packed_run import Rows, packed_run

RECORD = Path(__file__).with_suffix(".json")
NAN4 = [math.nan] * 4
CONTROL_S = 0.1


def attitude(x: float, y: float, z: float) -> list[float]:
    """Return the attitude quaternion of a rotation vector (rad)."""
    return [float(part) for part in from_rotation_vector(np.array([x, y, z]))]


def run_of_a_testbed(truth: bool = True) -> Run:
    """Return a run of six seconds on a testbed that rotates to two targets in a rotating field."""
    times = [CONTROL_S * k for k in range(60)]

    def angle(t: float) -> float:
        return 0.4 - 0.15 * t + 0.03 * math.sin(3.0 * t)

    def current(t: float) -> list[float]:
        return [0.05 * math.sin(2.0 * t), 0.0, -0.02 * math.cos(t)]

    control: Rows = [
        (
            t,
            {
                "q2": math.sin(0.5 * angle(t)) + 1e-3,
                "rate": -0.1 + 0.01 * t,
                "rate_sigma": 1e-3 + 2e-4 * t,
                "angle": angle(t),
                "angle_sigma": 2e-3,
                "current_written": current(t),
            },
        )
        for t in times
    ]
    true: Rows = [
        (
            t,
            {
                "quaternion": attitude(0.0, angle(t), 0.0),
                "rate": [0.0, -0.11 + 0.012 * t, 0.0],
                "energy": 0.02 * t + 1e-3 * t**2,
                "supply_energy": 0.05 * t + 2e-3 * t**2,
            },
        )
        for t in times
    ]
    part = 0.5 * (lgl_rule(8).nodes + 1.0)
    plans: Rows = [
        (
            at,
            {
                "number": number,
                "accepted": number != 2,
                "origin_ns": round(at * 1e9),
                "horizon": 2.5,
                "nodes": 8,
                "node_q2": [*(0.2 - 0.1 * number * part**2).tolist(), *([math.nan] * 32)],
            },
        )
        for number, at in ((1, 0.2), (2, 0.4), (3, 3.1), (4, 3.6))
    ]
    streaks: Rows = [
        (
            t,
            {
                "exposure_start_ns": round((t - 0.5) * 1e9),
                "exposure": 0.4,
                "status": "rate",
                "sequence": k,
                "rate": [0.0, -0.1 + 0.02 * k, 0.0],
                "covariance": [1e-6, 4e-6 * (k + 1), 1e-6, 0.0, 0.0, 0.0],
            },
        )
        for k, t in enumerate((1.0, 2.0, 3.5, 5.0))
    ]
    imu: Rows = [
        (0.025 * k, {"field": [3e-5 * math.sin(0.006 * k), 1e-6, -4e-5 * math.cos(0.006 * k)]})
        for k in range(240)
    ]
    return packed_run(
        run=[
            (
                0.0,
                {
                    "coil_resistance": [20.0, 10.0, 30.0],
                    "supply_voltage": 3.0,
                    "current_limit": 0.09,
                    "control_period_ns": 25_000_000,
                },
            )
        ],
        control=control,
        target=[(0.1, {"index": 0, "q2": 0.1}), (3.0, {"index": 1, "q2": -0.2})],
        plan=plans,
        streak=streaks,
        imu=imu,
        housekeeping=[(t, {"coil_power": 0.04 + 0.01 * t}) for t in (1.0, 2.0, 4.0)],
        cycle_timing=[
            (t, {"lateness": 1e-5 * (1 + k % 7), "execution": 4e-4 + 1e-5 * k}) for k, t in enumerate(times)
        ],
        job_timing=[
            (t, {"name": name, "execution": 0.01 * t})
            for t, name in ((1.0, "planner"), (2.0, "vision"), (3.0, "planner"))
        ],
        truth=true if truth else (),
    )


def run_in_orbit(truth: bool = True) -> Run:
    """Return a run of forty minutes in orbit with detumbling, a shadow and two targets."""
    times = [20.0 * k for k in range(120)]

    def error(t: float) -> list[float]:
        size = math.exp(-t / 600.0) + 1e-3
        return [0.4 * size, -0.2 * size, 0.1 * size * math.cos(t / 300.0)]

    spin: Rows = [
        (
            t,
            {
                "known": int(t > 40.0),
                "rate": [0.1 * math.exp(-t / 200.0), 0.01, 0.002],
                "rate_sigma": 2e-3,
                "field": [2e-5 * math.cos(t / 50.0), 3e-5, -1e-5],
                "dipole": [0.05, -0.02 * math.sin(t / 70.0), 0.01],
            },
        )
        for t in times
    ]
    poses: Rows = [
        (
            t,
            {
                "mode": int(Mode.POINT) if t > 500.0 else int(Mode.DETUMBLE),
                "rate": [0.01, 2e-3, 1e-3],
                "quaternion": attitude(0.3 + error(t)[0], -0.2, 1.0) if t > 300.0 else NAN4,
                "target": attitude(0.3, -0.2, 1.0),
                "angle_sigma": [1e-3, 2e-3 + 1e-6 * t, 1.5e-3],
                "dipole": [0.03 * math.sin(t / 90.0), 0.01, 0.0] if t % 60.0 else [0.0, 0.0, 0.0],
            },
        )
        for t in times
    ]
    true: Rows = [
        (
            t,
            {
                "quaternion": attitude(0.3 + 0.9 * error(t)[0], -0.2, 1.0 + 0.1 * error(t)[1]),
                "rate": [0.12 * math.exp(-t / 200.0), 0.012, 1e-3],
                "energy": 1e-3 * t,
                "supply_energy": 3e-3 * t + 0.1,
            },
        )
        for t in times
    ]
    sky: Rows = [
        (
            t,
            {
                "utc": 2461000.5 + t / 86400.0,
                "sunlit": float(not 800.0 < t < 1500.0),
                "position": [7e6 * math.cos(t / 900.0), 1e6, 6.9e6 * math.sin(t / 900.0)],
                "field": [2e-5, 1e-5 * math.sin(t / 800.0), 3e-5],
            },
        )
        for t in times
    ]

    def track(t: float, number: int, seen: bool) -> tuple[float, dict[str, Any]]:
        longitude, latitude = -0.4 + 1e-3 * t * number, 0.2 * number + 2e-4 * t
        level = math.cos(latitude)
        return t, {
            "number": number,
            "middle_ns": round((t - 0.2) * 1e9),
            "seen": int(seen),
            "direction": [level * math.cos(longitude), level * math.sin(longitude), math.sin(latitude)],
            "rate": [1e-3 * number, 2e-4, 1e-5 * t],
            "magnitude": 4.0 + 0.01 * t,
        }

    def event(t: float, kind: events.EventKind, text: str = "") -> tuple[float, dict[str, Any]]:
        return t, {"code": kind.code, "name": kind.name, "text": text}

    return packed_run(
        spin=spin,
        attitude=poses,
        navigation=[(t, {"knowledge": 0 if t < 300.0 else 1 if t < 700.0 else 2}) for t in times],
        mode=[
            (0.0, {"mode": int(Mode.BOOT)}),
            (40.0, {"mode": int(Mode.DETUMBLE)}),
            (320.0, {"mode": int(Mode.ACQUIRE)}),
            (500.0, {"mode": int(Mode.POINT)}),
        ],
        event=[
            event(500.0, events.TARGET, "sun"),
            event(1500.0, events.TARGET, "nadir"),
            event(900.0, events.SLEW_ENDED),
        ],
        track=[track(t, number, t != 120.0) for t in (60.0, 120.0, 180.0, 240.0) for number in (1, 2)],
        imu=[
            (t, {"field": [1e-5, 2e-5 * math.cos(t / 100.0), -3e-5], "rate": [0.1, 0.02, 0.0]}) for t in times
        ],
        run=[
            (
                0.0,
                {
                    "coil_resistance": [20.0, 20.0, 20.0],
                    "supply_voltage": 3.0,
                    "control_period_ns": 25_000_000,
                },
            )
        ],
        control=[(t, {"current_written": [0.02, -0.01 * math.sin(t), 0.0]}) for t in times],
        truth=true if truth else (),
        orbit_truth=sky if truth else (),
    )


def planned_slew(limit: float = 0.02) -> tuple[Any, Any]:
    """Return an artificial slew across the edge of the sky map with two keep-out cones, and its command."""
    times = np.linspace(0.0, 200.0, 9)
    angle = 2.4 * (times / 200.0) ** 2 * (3.0 - 2.0 * times / 200.0)
    rate = 2.4 * 6.0 * (times / 200.0) * (1.0 - times / 200.0) / 200.0
    turn = 2.4 * 6.0 * (1.0 - 2.0 * times / 200.0) / 200.0**2
    axis = np.array([0.2, 0.1, 1.0]) / math.sqrt(1.05)
    path = SlewPath(
        times,
        np.array([from_rotation_vector(axis * (a + 1.9)) for a in angle]),
        rate[:, None] * axis,
        turn[:, None] * axis,
        np.stack([0.01 * np.sin(times / 40.0), 0.004 + 0.0 * times, 1e-5 * times], axis=1),
    )

    def along(at: Any) -> SlewEnvironment:
        field = np.stack([2e-5 + 0.0 * at, 1e-5 * np.sin(at / 90.0), -3e-5 * np.cos(at / 90.0)], axis=1)
        return SlewEnvironment(
            field, np.stack([7e6 * np.cos(at / 900.0), 0.0 * at, 7e6 * np.sin(at / 900.0)], axis=1)
        )

    def towards(x: float, y: float, z: float) -> Callable[[Any], Any]:
        return lambda at: np.stack([x + 1e-3 * at, y + 0.0 * at, z + 0.0 * at], axis=1) / math.hypot(x, y, z)

    camera = np.array([0.0, -1.0, 0.0])
    cones = (
        Cone("Sun", camera, towards(0.9, 0.3, 0.1), 0.4),
        Cone("Earth", camera, towards(-0.2, 0.5, -0.8), 0.15),
    )
    craft = SlewCraft(
        np.diag([1.1e-3, 1.05e-3, 1.0e-3]),
        np.array([limit, limit, 1.5 * limit]),
        np.array([50.0, 60.0, 70.0]),
        residual=np.array([1e-4, -2e-4, 5e-5]),
        torque=np.array([1e-9, 2e-9, -1e-9]),
    )
    task = SimpleNamespace(cones=cones, craft=craft, along=along)
    made = SimpleNamespace(
        plan=SimpleNamespace(
            path=path, horizon=200.0, horizon_asked=150.0, energy=0.123456, status=SlewStatus.STRETCHED
        ),
        task=task,
    )
    pointing = np.array([0.6, 0.0, 0.8])
    return made, SimpleNamespace(axes=SimpleNamespace(pointing=pointing), camera=camera)


def identified() -> tuple[Any, Any]:
    """Return an artificial identification record and its fit."""
    time = np.arange(0.0, 4.0, 0.1)
    taken = np.arange(0, 40, 2)
    error = np.stack([0.01 * np.sin(time[taken]), 0.002 * np.cos(time[taken])], axis=1)
    covariance = np.zeros((len(taken), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = 1e-4, 4e-6 * (1.0 + time[taken])
    record = SimpleNamespace(
        time=time,
        angle=0.3 * np.cos(time),
        switch_time=np.array([0.0, 1.5, 3.0]),
        current=np.array([0.1, -0.05, 0.02]),
    )
    return record, SimpleNamespace(
        innovations=SimpleNamespace(taken=taken, error=error, covariance=covariance)
    )


def _comparison() -> Figure:
    figure = Figure()
    axes = figure.subplots(3)
    for run, name, colour in (
        (run_of_a_testbed(), "A", panels.BLUE),
        (run_of_a_testbed(False), "B", panels.ORANGE),
    ):
        panels.compared(axes, RunSignals(run), name, colour)
    return figure


def _path() -> Figure:
    plant = plant_of(demo_config(1.0))
    return figures.path_figure(plan(plant, -0.3, 0.0, -0.2, 0.0, 10.0), plant)


def _testbed(picture: Callable[[RunSignals], Figure | None], truth: bool = True) -> Figure:
    figure = picture(RunSignals(run_of_a_testbed(truth)))
    assert figure is not None
    return figure


def _orbit(picture: Callable[[RunSignals], Figure | None], truth: bool = True) -> Figure:
    figure = picture(RunSignals(run_in_orbit(truth)))
    assert figure is not None
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "overview": lambda: _testbed(figures._overview),
    "overview without the truth": lambda: _testbed(figures._overview, False),
    "rate": lambda: _testbed(figures._rate),
    "rate without the truth": lambda: _testbed(figures._rate, False),
    "paths": lambda: _testbed(figures._paths),
    "cycle times": lambda: _testbed(figures._cycle_times),
    "attitude": lambda: _testbed(figures._attitude),
    "current": lambda: _testbed(figures._current),
    "power": lambda: _testbed(figures._power),
    "cage": lambda: _testbed(figures.cage_figure),
    "comparison": _comparison,
    "path": _path,
    "fit": lambda: figures.fit_figure(*identified()),
    "spin": lambda: _orbit(figures.spin_figure),
    "spin without the truth": lambda: _orbit(figures.spin_figure, False),
    "knowledge": lambda: _orbit(figures.knowledge_figure),
    "pointing": lambda: _orbit(figures.pointing_figure),
    "pointing without the truth": lambda: _orbit(figures.pointing_figure, False),
    "track": lambda: _orbit(figures.track_figure),
    "objects": lambda: _orbit(figures.objects_figure),
    "slew": lambda: figures.slew_figure(*planned_slew()),
    "slew far from its limits": lambda: figures.slew_figure(*planned_slew(5.0)),
}
"""Plots by name."""


def recorded(name: str) -> Any:
    """Return the recorded description of a plot."""
    return json.loads(RECORD.read_text(encoding="utf-8"))[name]


def rounded(value: Any) -> Any:
    """Return a description as it is read back from JSON, with seven digits of each number."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return float(f"{value:.7g}") if isinstance(value, float) else value


def main() -> None:
    """Write the descriptions of all plots."""
    lines = [
        f"{json.dumps(name)}: {json.dumps(rounded(described(make())))}" for name, make in PICTURES.items()
    ]
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    sys.stdout.write(f"wrote {RECORD}\n")


if __name__ == "__main__":
    main()
