"""An artificial run with known results: each step is the noise-free response of a second-order system.

The body follows y(t) = 1 - exp(-z w t) (cos(wd t) + z/sqrt(1 - z^2) sin(wd t)), wd = w sqrt(1 - z^2), in each
step. The overshoot is exp(-pi z/sqrt(1 - z^2)). The coil carries `CURRENT` for the first `PULSE_S` of every
step.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flight.link.telemetry import definitions as table
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import Packer
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.plant import lgl_rule
from tests.manual_clock import ManualClock

RESISTANCE, VOLTAGE, CURRENT, PULSE_S = 23.0, 3.4, 0.1, 10.0
RELEASE_Q2 = 0.2
TARGETS = (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
DAMPING, FREQUENCY = 0.7, 0.5
RATE_BIAS = 1e-4  # bias of the estimated rate, rad/s
STAR_ERROR = 3e-5  # error of each star attitude about the suspension thread, rad, alternating in sign
STREAK_ERROR = 2e-4  # error of each streak rate about the suspension thread, rad/s, alternating in sign


@dataclass(frozen=True)
class Recipe:
    """Parameters of a run that ends after `duration` of its `planned` s, and has a new target every `hold` s.

    `bus_power` (W) is measured each second by a monitor in the coils' supply; None without a monitor.
    """

    duration: float = 700.0
    planned: float = 700.0
    hold: float = 100.0
    rate_hz: float = 40.0
    targets: tuple[float, ...] = TARGETS
    truth: bool = True
    identity: bool = True
    performance: bool = True
    commands: bool = True
    bus_power: float | None = 0.05
    utc_ns: int = 1_700_000_000_000_000_000


def second_order(t: FloatArray, damping: float, frequency: float) -> FloatArray:
    """Return the unit step response (n,) at t (n,) s."""
    root = np.sqrt(1.0 - damping**2)
    phase = frequency * root * t
    decay = np.exp(-damping * frequency * t)
    return np.asarray(1.0 - decay * (np.cos(phase) + damping / root * np.sin(phase)))


def trajectory(recipe: Recipe) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the times (n,), s, the values q2 (n,), and the rates (n,), rad/s."""
    time = np.arange(round(recipe.duration * recipe.rate_hz) + 1) / recipe.rate_hz
    index = np.minimum((time / recipe.hold).astype(int), len(recipe.targets) - 1)
    targets = np.array(recipe.targets)
    starts = np.array([RELEASE_Q2, *recipe.targets[:-1]])
    part = second_order(time - index * recipe.hold, DAMPING, FREQUENCY)
    q2 = starts[index] + (targets - starts)[index] * part
    rate = np.gradient(2.0 * np.arcsin(q2), time)
    return time, q2, rate


def make_run(folder: Path, recipe: Recipe | None = None) -> Path:
    """Write the logs of an artificial run into `folder`, and return the run."""
    recipe = recipe or Recipe()
    clock, packer = ManualClock(0), Packer()
    logs = {
        stem: FlightLog(folder, stem, clock=clock, sync_period_ns=None)
        for stem, wanted in (("flight", True), ("truth", recipe.truth), ("performance", recipe.performance))
        if wanted
    }
    time, q2, rate = trajectory(recipe)
    stamps = np.round(time * 1e9).astype(np.int64).tolist()
    current = np.where(time % recipe.hold < PULSE_S, CURRENT, 0.0)
    spent = np.concatenate([[0.0], np.cumsum(current[:-1] * np.diff(time))])  # charge, A s
    if recipe.identity:
        logs["flight"].write(_identity(packer, recipe))
    frame = round(5.0 * recipe.rate_hz)
    per_hold = round(recipe.hold * recipe.rate_hz)
    for i, stamp in enumerate(stamps):
        clock.sleep_until_ns(stamp)
        step = min(i // per_hold, len(recipe.targets) - 1)
        if recipe.commands and i == step * per_hold:
            logs["flight"].write(
                packer.pack(table.TARGET, stamp, index=step, q2=recipe.targets[step], rate=0.0)
            )
            logs["flight"].write(_plan(packer, stamp, step + 1, q2[i], recipe.targets[step]))
            logs["flight"].write(_event(packer, stamp))
        if i and i % frame == 0:
            exposed = rate[i - round(recipe.rate_hz) : i + 1]
            logs["flight"].write(_streak(packer, stamp, i // frame, exposed))
            logs["flight"].write(_stars(packer, stamp, i // frame, q2[i]))
        if recipe.bus_power is not None and i % round(recipe.rate_hz) == 0:
            logs["flight"].write(_housekeeping(packer, stamp, recipe.bus_power))
        logs["flight"].write(_control(packer, stamp, i, q2[i], rate[i], current[i]))
        if recipe.truth:
            logs["truth"].write(_truth(packer, stamp, q2[i], rate[i], current[i], spent[i]))
        if recipe.performance:
            logs["performance"].write(
                packer.pack(table.CYCLE_TIMING, stamp, cycle=i, lateness=1e-5 * (i % 7), execution=5e-4)
            )
    if recipe.performance:
        _performance(packer, logs["performance"], stamps[-1], len(stamps))
    for log in logs.values():
        log.close()
    return folder


def _identity(packer: Packer, recipe: Recipe) -> bytes:
    return packer.pack(
        table.RUN,
        0,
        config_name="made-up",
        config_crc=0x12345678,
        software="0.2.0",
        seed=7,
        utc_ns=recipe.utc_ns,
        simulated=recipe.truth,
        realtime=False,
        control_period_ns=round(1e9 / recipe.rate_hz),
        duration=recipe.planned,
        coil_resistance=(RESISTANCE, float("nan"), float("nan")),
        supply_voltage=VOLTAGE,
        current_limit=0.148,
    )


def _control(packer: Packer, stamp: int, cycle: int, q2: float, rate: float, current: float) -> bytes:
    return packer.pack(
        table.CONTROL,
        stamp,
        cycle=cycle,
        state=1,
        estimate_age=0.01,
        angle=2.0 * np.arcsin(q2),
        q2=q2,
        rate=rate + RATE_BIAS,
        angle_sigma=1e-3,
        rate_sigma=RATE_BIAS,
        target_q2=0.0,
        path_q2=q2,
        path_rate=rate,
        path_acceleration=0.0,
        plan=1,
        current_command=(current, 0.0, 0.0),
        current_written=(current, 0.0, 0.0),
        saturated=False,
    )


def _housekeeping(packer: Packer, stamp: int, bus_power: float) -> bytes:
    values: dict[str, object] = {
        field.name: 0 if field.count == 1 else [0] * field.count for field in table.HOUSEKEEPING.fields
    }
    return packer.pack(table.HOUSEKEEPING, stamp, {**values, "coil_power": bus_power})


def _truth(packer: Packer, stamp: int, q2: float, rate: float, current: float, spent: float) -> bytes:
    sign = -1.0 if stamp % 2_000_000_000 == 0 else 1.0  # q and -q represent the same attitude
    return packer.pack(
        table.TRUTH,
        stamp,
        quaternion=(0.0, sign * q2, 0.0, sign * np.sqrt(1.0 - q2**2)),
        rate=(0.0, rate, 0.0),
        current=(current, 0.0, 0.0),
        energy=RESISTANCE * CURRENT * spent,
        supply_energy=VOLTAGE * spent,
    )


def _plan(packer: Packer, stamp: int, number: int, start: float, target: float) -> bytes:
    """Return a plan of eight nodes on a cubic from rest to rest."""
    part = 0.5 * (lgl_rule(8).nodes + 1.0)
    node_q2 = np.full(table.MAX_NODES, np.nan)
    node_q2[:8] = start + (target - start) * (3.0 * part**2 - 2.0 * part**3)
    return packer.pack(
        table.PLAN,
        stamp,
        number=number,
        accepted=number != 2,
        status="stretched" if number == 1 else "infeasible" if number == 2 else "optimal",
        origin_ns=stamp,
        horizon_asked=10.0,
        horizon=13.0 if number == 1 else 10.0,
        start_q2=start,
        start_rate=0.0,
        target_q2=target,
        cost=0.1,
        peak_current=CURRENT,
        evaluations=100,
        nodes=8,
        node_q2=node_q2,
    )


def _streak(packer: Packer, stamp: int, sequence: int, rates: FloatArray) -> bytes:
    """Return the packet of the mean rate over the last second, with an error of `STREAK_ERROR`."""
    mean = float(np.mean(0.5 * (rates[1:] + rates[:-1])))
    error = STREAK_ERROR if sequence % 2 == 0 else -STREAK_ERROR
    variance = STREAK_ERROR**2 / 3.0  # only one of three axes has an error, so e' P^-1 e / 3 is 1
    return packer.pack(
        table.STREAK,
        stamp,
        sequence=sequence,
        exposure_start_ns=stamp - 1_000_000_000,
        exposure=1.0,
        status="rate",
        streaks=12,
        used=10,
        length=30.0,
        rate=(0.0, mean + error, 0.0),
        covariance=(variance, variance, variance, 0.0, 0.0, 0.0),
        residual=1e-5,
        accepted=True,
    )


def _stars(packer: Packer, stamp: int, sequence: int, q2: float) -> bytes:
    """Return the packet of an attitude with the error `STAR_ERROR` about the thread."""
    half = np.arcsin(q2) + 0.5 * (STAR_ERROR if sequence % 2 == 0 else -STAR_ERROR)
    variance = STAR_ERROR**2 / 3.0
    return packer.pack(
        table.STARS,
        stamp,
        sequence=sequence,
        middle_ns=stamp,
        status="solved",
        tracked=True,
        found=30,
        matched=25,
        quaternion=(0.0, np.sin(half), 0.0, np.cos(half)),
        covariance=(variance, variance, variance, 0.0, 0.0, 0.0),
        log10_false_alarm=-50.0,
        accepted=True,
    )


def _event(packer: Packer, stamp: int) -> bytes:
    return packer.pack(
        table.EVENT, stamp, code=40, severity=0, suppressed=1, name="target", text="a new attitude"
    )


def _performance(packer: Packer, log: FlightLog, stamp: int, cycles: int) -> None:
    for name, period in (("housekeeping", 1.0), ("control", 0.025)):
        for count in (cycles // 2, cycles):
            values = {"period": period, "cycles": count, "slips": 3, "overruns": 1, "mean": 5e-4, "max": 2e-3}
            log.write(packer.pack(table.RATE_GROUP, stamp, values, name=name))
    for execution in (0.010, 0.012, 0.020):
        log.write(packer.pack(table.JOB_TIMING, stamp, name="planner", execution=execution, outcome="done"))
