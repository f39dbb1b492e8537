"""Campaign `gyro-dead`: the step demonstration of the testbed while the gyro gives no valid rate.

The gyro fails at a random time in the first minute, in every third flight before the start. The coils disturb
the magnetometer by 5e-4 T/A. With the camera the flight has star attitudes and streak rates, without it only
the magnetometer and the plant model. A step is reached if the true angle stays within 0.5 deg of the target
in the last 70 s of the step.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from ground.telemetry import Run
from sim_hal.settings import FaultEntry
from tests.support.flights import demo_config, demo_world, event_names, fly

LIMIT = math.radians(0.5)
SETTLED = 30.0
"""Time (s) after the start of a step from which the error counts."""
_COILS = ((5e-4, 0.0, 0.0), (0.0, 5e-4, 0.0), (0.0, 0.0, 5e-4))


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights with the camera and as many without it."""
    found = []
    for number in range(runs):
        draw = np.random.default_rng((seed, number))
        at = 0.0 if number % 3 == 0 else float(draw.uniform(1.0, 60.0))
        for camera in (True, False):
            parameters = {"camera": camera, "at": at, "duration": 700.0}
            name = "camera" if camera else "dark"
            found.append(Case(f"{name}/{number}", (seed, number, int(camera)), parameters))
    return found


def run(case: Case) -> Result:
    """Fly the demonstration once, and compare the estimate with the truth."""
    given = case.parameters
    entry = FaultEntry(fault="imu: gyro-dead", at=given["at"])
    seed = int(np.random.default_rng(case.seed).integers(1, 2**31))
    section = configuration.replace(demo_world(), seed=seed, coil_field=_COILS, faults=(entry,))
    with tempfile.TemporaryDirectory() as place:
        config = demo_config(given["duration"], camera=given["camera"])
        return {**given, **judged(fly(config, Path(place) / "run", section=section), given["at"])}


def judged(flown: Run, at: float) -> Result:
    """Return the errors of a flight whose gyro fails at `at` s."""
    control, truth = flown["control"], flown["truth"]
    angle = 2.0 * np.arctan2(truth["quaternion"][:, 1], truth["quaternion"][:, 3])
    true, rate = (
        np.interp(control["time_ns"], truth["time_ns"], values) for values in (angle, truth["rate"][:, 1])
    )
    time = control["time_ns"] * 1e-9
    blind = (time > at + 1.0) & np.isfinite(control["angle"])
    target = control["target_q2"]
    starts = np.flatnonzero(np.diff(target, prepend=np.nan) != 0.0)
    worst = []
    for begin, end in zip(starts, [*starts[1:], len(time)], strict=True):
        settled = slice(begin + round(SETTLED / 0.025), end)
        if settled.start < end:
            worst.append(float(np.abs(2.0 * np.arcsin(target[settled]) - true[settled]).max()))
    squares = {
        name: ((control[name] - values) / control[f"{name}_sigma"])[blind] ** 2
        for name, values in (("angle", true), ("rate", rate))
    }
    names = event_names(flown)
    return {
        "steps": len(worst),
        "reached": sum(error < LIMIT for error in worst),
        "worst_deg": math.degrees(max(worst, default=0.0)),
        "nees_angle": float(squares["angle"].mean()),
        "nees_rate": float(squares["rate"].mean()),
        "error_rms_deg": math.degrees(float(np.sqrt(np.mean((control["angle"] - true)[blind] ** 2)))),
        "off_share": float(np.mean(control["state"][blind] == 0)),
        "pauses": names.count("control-lost"),
        "reported": "gyro-lost" in names,
        "failed": names.count("task-failed"),
    }


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return a row for the flights with the camera and a row for those without it."""
    del folder
    rows: list[dict[str, Any]] = []
    for camera in (True, False):
        own = [result for result in results if result["camera"] is camera]
        if own:
            sums = {key: sum(one[key] for one in own) for key in ("steps", "reached", "reported", "failed")}
            keys = ("worst_deg", "nees_angle", "nees_rate", "error_rms_deg", "off_share", "pauses")
            largest = {key: max(one[key] for one in own) for key in keys}
            rows.append({"camera": camera, "flights": len(own), **sums, **largest})
    return summary({"rows": rows})


GYRO_DEAD = Campaign(
    "gyro-dead",
    "the step demonstration without a gyro, with and without the camera: steps reached, errors, NEES",
    cases,
    run,
    summarise,
    20,
)
