"""Campaign `controllers`: the 700 s step demonstration under each controller, on the same seeds.

The thesis states a power of 0.10 W for its own loop, 0.15 W for PID and 0.66 W for adaptive control on its
testbed (ch. 5, Hardware Results). In this campaign all controllers run on the same simulated hardware with
the same noise. They are this project's loop, this loop with paths of minimum supply energy, the loop of the
thesis, the loop of the thesis on raw readings (without filter), PID and adaptive control. PID and adaptive
control receive the targets instead of a path. `python -m tests.studies.tune_controllers` tunes all their
gains by one criterion: minimum power with every step settled in 9 s and overshoots of at most 1 %. An
adaptive controller that is tuned by its bandwidth alone and a PID with three equal poles are added for
comparison.

Two definitions of power are used (`knightcube.gnc.guidance.plant`). V |I| is the power that the
chopped coils draw from their supply of 3.4 V; it is comparable to the powers of the thesis. R I^2 of the mean
current is the cost that the paths minimise.

The thesis states no stiffness of its thread. On a thread of 4.2e-5 N m/rad the thesis's loop draws the stated
0.10 W (as R I^2). The controllers of `STIFF` are also simulated with a body on this thread, for which PID and
adaptive control are then tuned.

The lower bound of the power is the clairvoyant optimum, computed by direct collocation
(tests.support.collocation_oracle): the whole plant is known, and each target is reached at rest 10 s after
its command and held. A controller that reaches its targets later may use less power.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.testbed import PidGains, TestbedConfig
from ground import report
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from sim_hal.settings import Simulation, Thread
from tests.support.flights import demo_config, demo_world, fly, thesis_config
from tests.support.ideal_power import clairvoyant_power

DURATION = 700.0
FIGURES = ("steady_state_deg", "overshoot_percent", "rise_s", "settling_s")
THESIS_W = {"thesis": 0.10, "thesis, raw readings": 0.10, "pid": 0.15, "adaptive": 0.66}


def this_loop() -> TestbedConfig:
    """Return the demonstration with the project's controllers, without camera."""
    return demo_config(DURATION, camera=False)


def thesis_loop() -> TestbedConfig:
    """Return the loop of the thesis: its guidance and its tracker, which use the estimates of the filter."""
    return thesis_config(DURATION)


def raw_thesis_loop() -> TestbedConfig:
    """Return the thesis's loop with unfiltered readings: the filter assumes readings without noise."""
    config = thesis_config(DURATION)
    unit = configuration.replace(config.inertial_unit, angle_noise=3e-4, rate_noise=3e-5)
    estimation = configuration.replace(
        config.estimation, current_noise=0.1, disturbance_walk=1.0, gate_sigma=1e9
    )
    return configuration.replace(config, inertial_unit=unit, estimation=estimation)


def towards_steps(**control: Any) -> TestbedConfig:
    """Return the demonstration with a given controller that receives the targets instead of a path."""
    config = this_loop()
    return configuration.replace(
        config,
        guidance=configuration.replace(config.guidance, strategy="step"),
        control=configuration.replace(config.control, **control),
    )


def supply_saving() -> TestbedConfig:
    """Return the demonstration with paths of minimum supply energy."""
    config = this_loop()
    return configuration.replace(config, guidance=configuration.replace(config.guidance, cost="supply"))


def pid() -> TestbedConfig:
    """Return the demonstration under tuned PID control [tune_controllers, 2026-11-23]."""
    gains = PidGains(proportional=0.4851, integral=0.09534, derivative=1.0)
    return towards_steps(tracker="pid", gains=gains, target_weight=0.187)


def limit_pid() -> TestbedConfig:
    """Return the demonstration under PID control that is tuned without margins.

    It reaches the limits of the criterion: each step settles in 9 s and overshoots by 1 %.

    The gains are those of `tune_controllers --settling 9 --overshoot 0.01` [2026-11-26].
    """
    gains = PidGains(proportional=0.462, integral=0.08826, derivative=1.0)
    return towards_steps(tracker="pid", gains=gains, target_weight=0.1871)


def stiff_pid() -> TestbedConfig:
    """Return PID control with the gains of `tune_controllers --stiffness 4.2e-5` [2026-11-26]."""
    gains = PidGains(proportional=0.4475, integral=0.09449, derivative=0.9996)
    return towards_steps(tracker="pid", gains=gains, target_weight=0.1707)


def stiff_adaptive() -> TestbedConfig:
    """Return adaptive control tuned for the stiff thread, on which it cannot settle within 9 s."""
    return towards_steps(tracker="adaptive", bandwidth=0.9991, adaptation=363.2, reference_bandwidth=0.526)


def placed_pid() -> TestbedConfig:
    """Return the demonstration under PID control with three equal poles."""
    return towards_steps(tracker="pid", bandwidth=0.76)


def adaptive() -> TestbedConfig:
    """Return the demonstration under tuned adaptive control [tune_controllers, 2026-11-23]."""
    return towards_steps(tracker="adaptive", bandwidth=0.319, adaptation=33.2, reference_bandwidth=0.584)


def by_bandwidth() -> TestbedConfig:
    """Return the demonstration under adaptive control tuned by its bandwidth alone."""
    return towards_steps(tracker="adaptive", bandwidth=1.0, adaptation=10.0, reference_bandwidth=0.56)


CONTROLLERS: dict[str, Callable[[], TestbedConfig]] = {
    "this loop": this_loop,
    "this loop, supply": supply_saving,
    "thesis": thesis_loop,
    "thesis, raw readings": raw_thesis_loop,
    "pid": pid,
    "pid, at the limits": limit_pid,
    "pid, three poles": placed_pid,
    "adaptive": adaptive,
    "adaptive, bandwidth": by_bandwidth,
}

STIFF: dict[str, Callable[[], TestbedConfig]] = {
    "this loop": this_loop,
    "thesis": thesis_loop,
    "pid": stiff_pid,
    "adaptive": stiff_adaptive,
}
STIFF_THREAD = Thread(stiffness=4.2e-5, damping=2e-6)
"""Suspension thread with which the thesis's loop needs the stated mean power of 0.10 W, as R I^2."""
OURS, THICK = "", "stiff "
THREADS = {OURS: CONTROLLERS, THICK: STIFF}


def cases(runs: int, seed: int) -> list[Case]:
    """Return every controller on each of `runs` seeds, and those of `STIFF` on the stiff thread."""
    drawn = [(thread, name) for thread, names in THREADS.items() for name in names]
    return [
        Case(
            f"{thread}{name}/{run}",
            (seed, run),
            {"controller": name, "thread": thread, "flight_seed": seed + run},
        )
        for run in range(runs)
        for thread, name in drawn
    ]


def world(thread: str, seed: int = 1) -> Simulation:
    """Return the demonstration's simulated world with one of the two threads."""
    simulated = configuration.replace(demo_world(), seed=seed)
    return simulated if thread == OURS else configuration.replace(simulated, thread=STIFF_THREAD)


def run(case: Case) -> Result:
    """Fly one demonstration."""
    thread = case.parameters["thread"]
    config = THREADS[thread][case.parameters["controller"]]()
    with tempfile.TemporaryDirectory() as place:
        flown = fly(config, Path(place) / "run", section=world(thread, case.parameters["flight_seed"]))
        summary = report.summarise(flown)
    rows = summary["steps"]
    return {
        **case.parameters,
        "steady_state_deg": _worst(rows, "steady_state_deg"),
        "overshoot_percent": _worst(rows, "overshoot_percent"),
        "rise_s": _worst(rows[1:], "rise_s"),
        "settling_s": _worst(rows, "settling_s"),
        "heat_w": summary["power"]["heat_average_w"],
        "supply_w": summary["power"]["supply_average_w"],
    }


def _worst(rows: Sequence[dict[str, Any]], key: str) -> float:
    """Return the largest value of a key over all steps, or infinity if a step has none."""
    return max(np.inf if row[key] is None else row[key] for row in rows)


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return each controller's mean power and worst step results by thread, and the power's lower bound."""
    facts: dict[str, Any] = {}
    for thread, names in THREADS.items():
        if own := [result for result in results if result["thread"] == thread]:
            floor = clairvoyant_power(this_loop(), world(thread))
            facts[f"{thread}clairvoyant_w"] = floor
            facts[f"{thread}controllers"] = {name: _figures(own, name, floor) for name in names}
    return summary(facts)


def _figures(results: Sequence[Result], name: str, floor: float) -> dict[str, Any]:
    """Return a controller's results on one thread, with its power relative to this project's loop."""
    own = [result for result in results if result["controller"] == name]
    if not own:
        return {"seeds": 0}
    heat = float(np.mean([result["heat_w"] for result in own]))
    seeds = {result["flight_seed"] for result in own}
    ours = [r["heat_w"] for r in results if r["controller"] == "this loop" and r["flight_seed"] in seeds]
    worst = {key: float(max(result[key] for result in own)) for key in FIGURES}
    return {
        "seeds": len(own),
        "supply_w": float(np.mean([result["supply_w"] for result in own])),
        "thesis_w": THESIS_W.get(name),
        "heat_w": heat,
        "over_floor": heat / floor,
        "over_this_loop": heat / float(np.mean(ours)) if ours else None,
        **{key: value if np.isfinite(value) else None for key, value in worst.items()},
    }


CONTROLLERS_CAMPAIGN = Campaign(
    "controllers",
    "the step demonstration under each controller on the same seeds, with the optimum as floor",
    cases,
    run,
    summarise,
    default_runs=3,
)
