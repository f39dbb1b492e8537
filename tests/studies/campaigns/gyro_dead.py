"""Campaign `gyro-dead`: step demonstration and orbit flights in which the gyro gives no valid rate.

The gyro fails at a random time in the first minute. In every third flight it fails before the start. The
coils disturb the magnetometer by 5e-4 T/A. With its camera the testbed has star attitudes and streak rates;
without it, only the magnetometer and the plant model. A step counts as reached if the true angle stays within
0.5 deg of the target in the last 70 s of the step.

The cells `orbit` are flights of `config/orbit.yaml` from a tumble of 3 deg/s to nadir, at a random position
of the orbit. Body, coils and sensors differ from the configuration within the stated accuracies. They have
neither horizon cameras nor solar cells. The estimate uses star attitudes, streak rates, the magnetometer and
the dynamic model. The error of the nadir axis is evaluated from the end of the slew on.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.link import events
from flight.link.events import Mode
from flight.schema import reader as configuration
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.report.orbit import attitude_errors, pointing_errors
from ground.report.signals import seconds
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import FaultEntry
from tests.support.flights import demo_config, demo_world, event_names, fly
from tests.support.unlike_body import configured, released

LIMIT = math.radians(0.5)
ORBIT_SECONDS = 1_500.0
"""Duration (s) of a flight in orbit; the slew to nadir ends in this time."""
SETTLED = 30.0
"""Time (s) from the start of a step to the start of its evaluation."""
_COILS = ((5e-4, 0.0, 0.0), (0.0, 5e-4, 0.0), (0.0, 0.0, 5e-4))


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights with the camera and as many without it."""
    found = []
    for number in range(runs):
        draw = np.random.default_rng((seed, number))
        at = 0.0 if number % 3 == 0 else float(draw.uniform(1.0, 60.0))
        place = {"at": at, "duration": ORBIT_SECONDS, "place_deg": float(draw.uniform(0.0, 360.0))}
        found.append(Case(f"orbit/{number}", (seed, number, 2), place))
        for camera in (True, False):
            parameters = {"camera": camera, "at": at, "duration": 700.0}
            name = "camera" if camera else "dark"
            found.append(Case(f"{name}/{number}", (seed, number, int(camera)), parameters))
    return found


def run(case: Case) -> Result:
    """Fly the demonstration once, and compare the estimate with the truth."""
    given = case.parameters
    if "place_deg" in given:
        return {**given, **in_orbit(case)}
    entry = FaultEntry(fault="imu: gyro-dead", at=given["at"])
    seed = int(np.random.default_rng(case.seed).integers(1, 2**31))
    section = configuration.replace(demo_world(), seed=seed, coil_field=_COILS, faults=(entry,))
    with tempfile.TemporaryDirectory() as place:
        config = demo_config(given["duration"], camera=given["camera"])
        return {**given, **judged(fly(config, Path(place) / "run", section=section), given["at"])}


def in_orbit(case: Case) -> Result:
    """Fly the satellite once, and compare attitude, rate and nadir axis with the truth."""
    given = case.parameters
    config, world = configured("orbit")
    nadir = configuration.replace(config.targets[-1], at=0.0)
    config = configuration.replace(
        config,
        elements=None,
        duration=given["duration"],
        targets=(nadir,),
        wide_cameras=(),
        solar_strings=None,
    )
    seed = int(np.random.default_rng(case.seed).integers(1, 2**31))
    world = released(world, seed, given["place_deg"], math.radians(given.get("speed_deg", 3.0)))
    world = configuration.replace(world, faults=(FaultEntry(fault="imu: gyro-dead", at=given["at"]),))
    with tempfile.TemporaryDirectory() as place:
        return judged_in_orbit(fly(config, Path(place) / "run", section=world), given["at"])


def judged_in_orbit(flown: Run, at: float) -> Result:
    """Return the errors and the NEES per axis of an orbit flight whose gyro fails at `at` s."""
    packets, truth, names = flown["attitude"], flown["truth"], event_names(flown)
    known = np.isfinite(packets["rate"][:, 0]) & (seconds(packets) > at + 1.0)
    rate = np.column_stack([np.interp(seconds(packets), seconds(truth), one) for one in truth["rate"].T])
    off_rate = ((packets["rate"] - rate) / packets["rate_sigma"])[known]
    errors, pointing = attitude_errors(flown), pointing_errors(flown)
    blind = errors.times > at + 1.0
    ends = seconds(flown["event"][flown["event"]["code"] == events.SLEW_ENDED.code])
    arrived = bool(len(ends) and len(pointing.times) and pointing.times[-1] > ends[0])
    nadir = np.degrees(np.linalg.norm(pointing.error[:, :2], axis=1))
    modes = flown["mode"]
    slowed = seconds(modes)[modes["before"] == int(Mode.DETUMBLE)]
    return {
        "detumbled_s": float(slowed[0] if len(slowed) else seconds(packets)[-1]),
        "arrived": arrived,
        "nadir_rms_deg": float(np.sqrt(np.mean(nadir[pointing.times > ends[0]] ** 2))) if arrived else 180.0,
        "lost": bool(not len(nadir) or nadir[-1] > 30.0 or modes["mode"][-1] == int(Mode.SAFE)),
        "error_rms_deg": math.degrees(math.sqrt(3.0 * _mean_square(errors.error[blind]))),
        "nees_attitude": _mean_square(errors.error[blind] / errors.sigma[blind]),
        "nees_rate": _mean_square(off_rate),
        "rates": int(flown["streak"]["accepted"].sum()),
        "stars": int(flown["stars"]["accepted"].sum()),
        "safe": bool(np.isin(int(Mode.SAFE), modes["mode"])),
        "reported": "gyro-lost" in names,
        "failed": names.count("task-failed"),
    }


def _mean_square(values: FloatArray) -> float:
    """Return the mean square of values, or zero without values."""
    return float(np.mean(values**2)) if values.size else 0.0


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


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return three rows: testbed flights with camera, testbed flights without it, and orbit flights."""
    rows: list[dict[str, Any]] = []
    for camera in (True, False):
        own = [result for result in results if result.get("camera") is camera]
        if own:
            sums = {key: sum(one[key] for one in own) for key in ("steps", "reached", "reported", "failed")}
            keys = ("worst_deg", "nees_angle", "nees_rate", "error_rms_deg", "off_share", "pauses")
            largest = {key: max(one[key] for one in own) for key in keys}
            rows.append({"camera": camera, "flights": len(own), **sums, **largest})
    if own := [result for result in results if "place_deg" in result]:
        counted = ("arrived", "lost", "safe", "reported", "failed", "rates", "stars")
        sums = {key: sum(one[key] for one in own) for key in counted}
        errors = ("detumbled_s", "nadir_rms_deg", "error_rms_deg", "nees_attitude", "nees_rate")
        largest = {key: max(one[key] for one in own) for key in errors}
        means = {f"mean_{key}": float(np.mean([one[key] for one in own])) for key in errors[3:]}
        rows.append({"orbit": True, "flights": len(own), **sums, **largest, **means})
    return summary({"rows": rows})
