"""Campaign `robust-controllers`: the step demonstration in worlds that differ from the loop's model.

Each run draws a world: inertia within 20 %, field and coil resistance within 10 %, a thread stiffness of 0 to
3 times that of the demonstration (which the loop does not model), a gyro bias, noise of up to 3 times,
readings that are one to three cycles late, 5 % of damaged packets, and an IMU that is silent for up to a
second, once in a slew and once in a hold. Every controller of `COMPARED` is simulated in the same worlds. All
controllers are tuned by one criterion in the world that the loop models. Each flight runs the whole loop in
lock-step on the emulated devices. A flight has two steps of the demonstration, 65 s each: the slew from the
release, and the first change of q2 by 0.1. All results refer to the true body.

While the unit is silent the coils are at zero, and the thread alone rotates the body by k theta t^2 / (2 J),
up to half a degree in a second. This rotation is called the excursion. The steady state excludes the silent
intervals and `RECOVERY` s after each.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.testbed import Step, TestbedConfig
from ground import report
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from ground.report.steps import STEADY_STATE_S
from ground.telemetry import Run
from sim_hal.emulators.serial_line import LineFaults
from sim_hal.settings import ImuNoise, Simulation, Thread, Truth
from tests.studies.campaigns.controllers import CONTROLLERS
from tests.support.flights import Rigged, demo_world, event_names, fly

STEPS = (Step(at=0.0, q2=-0.3), Step(at=65.0, q2=-0.2))
DURATION = 130.0
LOST_DEG = 5.0
"""Error (deg) in the last 30 s above which a body counts as lost."""

RECOVERY = 5.0
"""Time (s) after a silent interval that the steady state excludes."""

CYCLE_NS = 25_000_000
DAMAGED = 0.05
GYRO_BIAS = math.radians(30.0) / 3600.0
"""Largest gyro bias (rad/s): three times the 10 deg/h of the VN-100's data sheet."""

COMPARED = ("this loop", "thesis", "pid", "adaptive")
FIGURES = ("steady_state_deg", "excursion_deg", "settling_s", "overshoot_percent", "rise_s")


def cases(runs: int, seed: int) -> list[Case]:
    """Return every controller in each of `runs` worlds."""
    return [
        Case(f"{name}/{run}", (seed, run), {"controller": name}) for run in range(runs) for name in COMPARED
    ]


def draw(seed: tuple[int, ...]) -> dict[str, Any]:
    """Return one world; values without a unit in their name are factors of the demonstration's values."""
    rng = np.random.default_rng(seed)

    def about_one(share: float) -> float:
        return 1.0 + share * float(rng.uniform(-1.0, 1.0))

    return {
        "inertia": about_one(0.2),
        "field": about_one(0.1),
        "resistance": about_one(0.1),
        "stiffness": float(rng.uniform(0.0, 3.0)),
        "noise": float(rng.uniform(1.0, 3.0)),
        "gyro_bias_rad_s": (GYRO_BIAS * rng.uniform(-1.0, 1.0, 3)).tolist(),
        "delay_cycles": int(rng.integers(1, 4)),
        "dropouts_s": [
            [float(rng.uniform(begin, end)), float(rng.uniform(0.1, 1.0))]
            for begin, end in ((1.0, 9.0), (15.0, 60.0), (66.0, 74.0), (80.0, 95.0))
        ],
        "seed": int(rng.integers(1, 2**31)),
    }


def world_of(drawn: dict[str, Any], config: TestbedConfig) -> Simulation:
    """Return the simulation settings of a random world."""
    base = demo_world()
    ohms = config.coils.resistance
    factor = drawn["resistance"]
    return configuration.replace(
        base,
        seed=drawn["seed"],
        thread=Thread(stiffness=drawn["stiffness"] * base.thread.stiffness, damping=base.thread.damping),
        imu=ImuNoise(
            quaternion_noise=drawn["noise"] * base.imu.quaternion_noise,
            rate_noise=drawn["noise"] * base.imu.rate_noise,
            gyro_bias=tuple(drawn["gyro_bias_rad_s"]),
        ),
        truth=Truth(
            inertia=drawn["inertia"] * config.plant.inertia,
            field=drawn["field"] * config.plant.field,
            resistance=(factor * ohms[0], factor * ohms[1], factor * ohms[2]),
        ),
    )


def disturb(rigged: Rigged, drawn: dict[str, Any]) -> None:
    """Delay the line, damage its packets, and silence it in the drawn intervals."""
    wire = rigged.lock.line.to_host
    usual = LineFaults(cut_probability=DAMAGED, delay_ns=drawn["delay_cycles"] * CYCLE_NS)

    def become(faults: LineFaults) -> None:
        wire.faults = faults

    # Delays begin after the release, because late samples of the held body would look like samples of the
    # flight.
    rigged.at(0.5, lambda: become(usual))
    for begin, span in drawn["dropouts_s"]:
        rigged.at(begin, lambda: become(LineFaults(silent=True)))
        rigged.at(begin + span, lambda: become(usual))


def run(case: Case) -> Result:
    """Run a flight in one world with one controller."""
    name = case.parameters["controller"]
    return {"controller": name, **fly_world(draw(case.seed), CONTROLLERS[name]())}


def fly_world(drawn: dict[str, Any], config: TestbedConfig) -> Result:
    """Run the two steps in a random world with the loop of `config`; return the results."""
    config = configuration.replace(config, steps=STEPS, duration=DURATION)
    with tempfile.TemporaryDirectory() as place:
        flown = fly(
            config,
            Path(place) / "run",
            lambda rigged: disturb(rigged, drawn),
            section=world_of(drawn, config),
        )
        summary = report.summarise(flown)
        names = event_names(flown)
    slew, tenth = summary["steps"]
    excursion = _worst(slew["steady_state_deg"], tenth["steady_state_deg"])
    # None means that a tolerance band was never entered, or that an attitude exceeded all limits.
    figures = {
        "steady_state_deg": _steady_state(flown, drawn["dropouts_s"]),
        "excursion_deg": excursion,
        "settling_s": _worst(slew["settling_s"], tenth["settling_s"]),
        "overshoot_percent": _worst(slew["overshoot_percent"], tenth["overshoot_percent"]),
        "rise_s": _worst(tenth["rise_s"]),
    }
    return {
        "world": drawn,
        **figures,
        "lost": not excursion < LOST_DEG,
        "heat_w": summary["power"]["heat_average_w"],
        "events": {name: names.count(name) for name in sorted(set(names))},
    }


def _steady_state(flown: Run, dropouts: Sequence[Sequence[float]]) -> float:
    """Return the largest error (deg) in the last 30 s of each step, excluding disturbed intervals."""
    time = flown["truth"]["time_ns"] * 1e-9
    angle = 2.0 * np.arcsin(np.clip(flown["truth"]["quaternion"][:, 1], -1.0, 1.0))
    judged = np.zeros(len(time), dtype=bool)
    error = np.empty(len(time))
    for step, end in zip(STEPS, (*(step.at for step in STEPS[1:]), DURATION), strict=True):
        judged |= (time >= end - STEADY_STATE_S) & (time < end)
        own = (time >= step.at) & (time < end)
        error[own] = angle[own] - 2.0 * math.asin(step.q2)
    for begin, span in dropouts:
        judged &= (time < begin) | (time > begin + span + RECOVERY)
    return math.degrees(float(np.abs(error[judged]).max()))


def _worst(*values: float | None) -> float:
    return max(math.inf if value is None else value for value in values)


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return median, 95th percentile and worst value of each result by controller."""
    facts: dict[str, Any] = {}
    for name in COMPARED:
        mine = [result for result in results if result["controller"] == name]
        if not mine:
            continue
        facts[name] = {"worlds": len(mine), "lost": sum(result["lost"] for result in mine)}
        facts[name]["heat_w"] = float(np.mean([result["heat_w"] for result in mine]))
        for key in FIGURES:
            levels = np.quantile([result[key] for result in mine], (0.5, 0.95, 1.0), method="lower").tolist()
            facts[name][key] = [level if math.isfinite(level) else None for level in levels]
    return summary(facts)


ROBUST_CONTROLLERS = Campaign(
    "robust-controllers",
    "the tuned controllers in worlds unlike the loop's belief: dynamics, noise, delays, drop-outs",
    cases,
    run,
    summarise,
    20,
)
