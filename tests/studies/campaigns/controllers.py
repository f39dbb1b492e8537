"""Campaigns `controllers` and `robust-controllers`: the step demonstration under each controller.

All controllers run on the same simulated hardware with the same noise. They are this project's loop, this
loop with paths of minimum supply energy, the loop of the thesis, PID and adaptive control. PID and adaptive
control receive the targets instead of a path. `tests.studies.tune_controllers` (at commit 5e5e847b) tuned all
their gains by one criterion: minimum power with every step settled in 9 s and overshoots of at most 1 %.

`controllers` flies the 700 s step demonstration with the same seeds for all controllers. The thesis states a
power of 0.10 W for its own loop, 0.15 W for PID and 0.66 W for adaptive control on its testbed (ch. 5,
Hardware Results). Two definitions of power are used (`knightcube.gnc.guidance.plant`). V |I| is the power
that the chopped coils draw from their supply of 3.4 V; it is comparable to the powers of the thesis. R I^2 of
the mean current is the cost that the paths minimise. The thesis states no stiffness of its thread. On a
thread of 4.2e-5 N m/rad the thesis's loop draws the stated 0.10 W (as R I^2). The controllers of `STIFF` are
also simulated on this thread; its PID and adaptive control are tuned for it. The lower bound of the power is
the optimum for a known plant, in which each target is reached at rest 10 s after its command and held. It is
computed by direct collocation (tests.support.collocation_oracle). A controller that reaches its targets later
may use less power.

`robust-controllers` flies two steps of the demonstration, 65 s each, in worlds that differ from the loop's
model. Inertia differs by up to 20 %, and field and coil resistance by up to 10 %. The stiffness of the
thread, which the loop does not model, is 0 to 3 times that of the demonstration. The gyro has a bias, the
noise is up to 3 times that of the demonstration, readings are one to three cycles late, and 5 % of the
packets are damaged. The IMU is silent for up to a second, once in a slew and once in a hold. While the unit
is silent the coils are at zero, and the thread alone rotates the body by k theta t^2 / (2 J), up to half a
degree in a second. This rotation is called the excursion. The steady state excludes the silent intervals and
`RECOVERY` s after each. All results refer to the true body.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.bodies import PidGains, Step, TestbedConfig
from ground import report
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.report.steps import STEADY_STATE_S
from ground.telemetry import Run
from sim_hal.emulators.serial_line import LineFaults
from sim_hal.settings import ImuNoise, Simulation, Thread, Truth
from tests.studies.campaigns.statistics import grouped, mean
from tests.support.flights import Rigged, demo_config, demo_world, event_names, fly, thesis_config
from tests.support.ideal_power import clairvoyant_power

DURATION = 700.0
FIGURES = ("steady_state_deg", "overshoot_percent", "rise_s", "settling_s")
THESIS_W = {"thesis": 0.10, "pid": 0.15, "adaptive": 0.66}


def this_loop() -> TestbedConfig:
    """Return the demonstration with the project's controllers, without camera."""
    return demo_config(DURATION, camera=False)


def thesis_loop() -> TestbedConfig:
    """Return the loop of the thesis: its guidance and its tracker, with the estimates of the filter."""
    return thesis_config(DURATION)


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


def adaptive() -> TestbedConfig:
    """Return the demonstration under tuned adaptive control [tune_controllers, 2026-11-23]."""
    return towards_steps(tracker="adaptive", bandwidth=0.319, adaptation=33.2, reference_bandwidth=0.584)


CONTROLLERS: dict[str, Callable[[], TestbedConfig]] = {
    "this loop": this_loop,
    "this loop, supply": supply_saving,
    "thesis": thesis_loop,
    "pid": pid,
    "pid, at the limits": limit_pid,
    "adaptive": adaptive,
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
    """Return `CONTROLLERS` with each of `runs` seeds, and `STIFF` with each seed on the stiff thread."""
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
    _, found = _flown(config, world(thread, case.parameters["flight_seed"]))
    rows = found["steps"]
    return {
        **case.parameters,
        **{key: _worst(*(row[key] for row in rows)) for key in FIGURES},
        # The first slew starts at the release and is not a step, so its rise time does not count.
        "rise_s": _worst(*(row["rise_s"] for row in rows[1:])),
        "heat_w": found["power"]["heat_average_w"],
        "supply_w": found["power"]["supply_average_w"],
    }


def _flown(
    config: TestbedConfig, section: Simulation, prepare: Callable[[Rigged], None] = lambda _: None
) -> tuple[Run, dict[str, Any]]:
    """Return the log and the report of a flight."""
    with tempfile.TemporaryDirectory() as place:
        flown = fly(config, Path(place) / "run", prepare, section=section)
        return flown, report.summarise(flown)


def _worst(*values: float | None) -> float:
    """Return the largest value, or infinity if the value of a step is missing."""
    return max(math.inf if value is None else value for value in values)


def summarise(results: Sequence[Result], _: Path) -> Summary:
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


STEPS = (Step(at=0.0, q2=-0.3), Step(at=65.0, q2=-0.2))
TWO_STEPS_S = 130.0
LOST_DEG = 5.0
"""Error (deg) in the last 30 s above which a body counts as lost."""

RECOVERY = 5.0
"""Time (s) after a silent interval that the steady state excludes."""

CYCLE_NS = 25_000_000
DAMAGED = 0.05
GYRO_BIAS = math.radians(30.0) / 3600.0
"""Largest gyro bias (rad/s): three times the 10 deg/h of the VN-100's data sheet."""

COMPARED = ("this loop", "thesis", "pid", "adaptive")
ROBUST = ("steady_state_deg", "excursion_deg", "settling_s", "overshoot_percent", "rise_s")


def robust_cases(runs: int, seed: int) -> list[Case]:
    """Return every controller in each of `runs` worlds."""
    return [
        Case(f"{name}/{run}", (seed, run), {"controller": name}) for run in range(runs) for name in COMPARED
    ]


def draw(seed: tuple[int, ...]) -> dict[str, Any]:
    """Return one world; values without a unit in their name are relative to the demonstration's values."""
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


def robust_run(case: Case) -> Result:
    """Run a flight in one world with one controller."""
    name = case.parameters["controller"]
    return {"controller": name, **fly_world(draw(case.seed), CONTROLLERS[name]())}


def fly_world(drawn: dict[str, Any], config: TestbedConfig) -> Result:
    """Run the two steps in a random world with the loop of `config`; return the results."""
    config = configuration.replace(config, steps=STEPS, duration=TWO_STEPS_S)
    flown, found = _flown(config, world_of(drawn, config), lambda rigged: disturb(rigged, drawn))
    names = event_names(flown)
    slew, tenth = found["steps"]
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
        "heat_w": found["power"]["heat_average_w"],
        "events": {name: names.count(name) for name in sorted(set(names))},
    }


def _steady_state(flown: Run, dropouts: Sequence[Sequence[float]]) -> float:
    """Return the largest error (deg) in the last 30 s of each step, excluding disturbed intervals."""
    time = flown["truth"]["time_ns"] * 1e-9
    angle = 2.0 * np.arcsin(np.clip(flown["truth"]["quaternion"][:, 1], -1.0, 1.0))
    judged = np.zeros(len(time), dtype=bool)
    error = np.empty(len(time))
    for step, end in zip(STEPS, (*(step.at for step in STEPS[1:]), TWO_STEPS_S), strict=True):
        judged |= (time >= end - STEADY_STATE_S) & (time < end)
        own = (time >= step.at) & (time < end)
        error[own] = angle[own] - 2.0 * math.asin(step.q2)
    for begin, span in dropouts:
        judged &= (time < begin) | (time > begin + span + RECOVERY)
    return math.degrees(float(np.abs(error[judged]).max()))


def robust_summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return median, 95th percentile and worst value of each result by controller."""
    facts: dict[str, Any] = {}
    for name, mine in grouped(results, "controller").items():
        facts[name] = {"worlds": len(mine), "lost": sum(result["lost"] for result in mine)}
        facts[name]["heat_w"] = mean([result["heat_w"] for result in mine])
        for key in ROBUST:
            levels = np.quantile([result[key] for result in mine], (0.5, 0.95, 1.0), method="lower").tolist()
            facts[name][key] = [level if math.isfinite(level) else None for level in levels]
    return summary(facts)
