"""Campaign `faults`: every fault of the catalogue in every mode, at random times, in lock-step.

Each run flies the demonstration's loop for half a minute in one mode and breaks one thing at a random time
for a random span (coils and bridges to the end), at the wire; then it tells from the log what was detected,
how the loop reacted, how long after the fault's end all was well again, what the coils carried while there
was no estimate, and whether the log is whole. A fault that meets nothing (a coil that is not driven, a
planner that is not asked) is told apart as not exercised: it cannot be seen, and does no harm. Times are of
the log and the truth, not of the events alone, which a throttle holds back.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight import config as configuration
from flight.arrays import FloatArray
from flight.events import EVENTS, EventKind, Reaction, Severity
from flight.settings import Commands, CommandStep, Config, Modes
from flight.telemetry.packets import to_text
from flight.telemetry.reader import Run
from sim_hal.faults.catalogue import CATALOGUE
from sim_hal.faults.kinds import FaultKind, Where
from sim_hal.settings import FaultEntry
from tests.campaigns.campaign import Campaign, Case, Result, Summary
from tests.scenario.flights import demo_config, demo_world, fly

DURATION = 26.0
MODES = ("boot", "safe", "detumble", "hold", "slew", "testbed-demo")
LASTING = ("coil", "bridge")
CYCLE = 0.025
BLIND_GRACE = 0.1
"""s: within this the coils are at zero after the estimate is gone."""
DRIVEN = 6.0e-3
"""A, of a coil that is driven enough for the monitor to tell."""

_KINDS: dict[str, EventKind] = {kind.name: kind for kind in EVENTS}
_LOOKS = {"camera", "vision"}
_PROVIDED = frozenset({"stream-poor"})  # follows from every other one, and later


def faults() -> list[FaultKind]:
    """Return the faults that make sense in lock-step."""
    return [kind for kind in CATALOGUE.values() if kind.where is Where.BOTH]


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights: fault by fault, mode by mode, over and over."""
    kinds = faults()
    found = []
    for number in range(runs):
        lap, place = divmod(number, len(kinds))
        kind, mode = kinds[place], MODES[(lap + place) % len(MODES)]
        found.append(Case(f"{number}", (seed, number), {"fault": kind.name, "mode": mode}))
    return found


def run(case: Case) -> Result:
    """Fly one case and tell what became of it."""
    kind, mode = CATALOGUE[case.parameters["fault"]], case.parameters["mode"]
    rng = np.random.default_rng(case.seed)
    at = 0.0 if mode == "boot" else float(rng.uniform(4.0, 11.0))
    span = None if kind.device.startswith(LASTING) else float(rng.uniform(2.0, 6.0))
    entry = FaultEntry(fault=kind.name, at=at, span=span)
    return fly_with(kind, mode, entry, int(rng.integers(1, 2**31)))


def fly_with(kind: FaultKind, mode: str, entry: FaultEntry, seed: int) -> Result:
    """Fly half a minute with one fault."""
    section = configuration.replace(demo_world(), seed=seed, faults=(entry,))
    with tempfile.TemporaryDirectory() as place:
        flown = fly(config_for(mode, kind.device in _LOOKS), Path(place) / "run", section=section)
        return {"fault": kind.name, "mode": mode, **judge(flown, kind, entry)}


def config_for(mode: str, camera: bool) -> Config:
    """Return half a minute of the demonstration in a mode; with a camera a small and quick one."""
    config = demo_config(DURATION)
    eye = None
    if camera and config.camera is not None:
        eye = configuration.replace(
            config.camera, columns=256, rows=256, exposure=0.2, period=2.0, max_age=4.5, star_tracker=None
        )
    timeline: tuple[CommandStep, ...] = ()
    initial = mode
    if mode == "slew":
        initial, timeline = "hold", (CommandStep(at=3.5, slew=-0.3), CommandStep(at=14.0, slew=0.1))
    elif mode == "boot":
        initial = "testbed-demo"
    return configuration.replace(
        config,
        camera=eye,
        modes=configuration.replace(Modes(), initial=initial),
        commands=configuration.replace(Commands(), timeline=timeline),
    )


def judge(flown: Run, kind: FaultKind, entry: FaultEntry) -> Result:
    """Tell from a flight's logs what a fault did."""
    at = entry.at or 0.0
    span = entry.span or (DURATION - at)
    end = at if kind.momentary else min(at + span, DURATION)
    told = [(float(event["time_ns"]) * 1e-9, to_text(event["name"])) for event in flown["event"]]
    warned = [
        (time, name)
        for time, name in told
        if at - 1e-6 <= time < DURATION - CYCLE
        and _KINDS[name].severity is not Severity.INFORMATION
        and name not in _PROVIDED
    ]
    reactions = {_KINDS[name].reaction for _, name in warned} - {Reaction.NOTE}
    time, current = flown["truth"]["time_ns"] * 1e-9, np.abs(flown["truth"]["current"]).max(axis=1)
    control = flown["control"]
    return {
        "at": at,
        "end": end,
        "exercised": bool(warned) or _is_exercised(flown, kind, at, end),
        "detected_s": warned[0][0] - at if warned else None,
        "event": warned[0][1] if warned else None,
        "reactions": sorted(reaction.name.lower().replace("_", " ") for reaction in reactions),
        "recovered_s": _recovered(flown, kind, at, end, told),
        "blind_current_a": _blind_current(control, time, current),
        "largest_current_a": float(current.max()),
        "task_failed": any(name == "task-failed" for _, name in told),
        "log_intact": all(log.intact for log in flown.logs.values())
        and len(control) == round(DURATION / CYCLE),
    }


def _is_exercised(flown: Run, kind: FaultKind, at: float, end: float) -> bool:
    """Tell whether the broken thing was asked for anything while it was broken."""
    control = flown["control"]
    time = control["time_ns"] * 1e-9
    inside = (time >= at) & (time < max(end, at + 1.0))
    written = np.abs(control["current_written"][inside])
    device, _, axis = kind.device.partition("-")
    if device in {"coil", "bridge"}:
        own = written[:, "xyz".index(axis)]
        return kind.kind.endswith("high") or bool((own > DRIVEN).sum() * CYCLE > 2.5)
    if device in {"pwm"} and kind.kind in {"stuck", "delayed", "bits"}:
        return bool((written > DRIVEN).any(axis=1).sum() * CYCLE > 1.0)
    if kind.name == "monitor: delayed":
        return False  # it is written to only when it has lost its set-up
    if device in {"planner", "vision"}:
        jobs = flown["job_timing"]
        when = jobs["time_ns"] * 1e-9
        mine = np.array([to_text(name) == device for name in jobs["name"]], dtype=bool)
        late = 2.0 if kind.kind == "endless" else 0.1  # results are told when they come
        return bool((mine & (when >= at) & (when < end + late)).any())
    return True


def _recovered(
    flown: Run, kind: FaultKind, at: float, end: float, told: Sequence[tuple[float, str]]
) -> float | None:
    """Return how long after the fault's end the device's data are good again; None for never."""
    house = flown["housekeeping"]
    found: float | None = 0.0
    match kind.device.partition("-")[0]:
        case "imu":
            found = _steady(flown["imu"]["time_ns"] * 1e-9, end, 0.06)
        case "pwm" | "bus":
            found = _obeyed(flown, end)
        case "monitor":
            found = _first(house["time_ns"][np.isfinite(house["coil_current"])] * 1e-9, end)
        case "camera":
            grown = np.flatnonzero(np.diff(house["frames"].astype(int)) > 0) + 1
            found = _first(house["time_ns"][grown] * 1e-9, end)
        case "coil" | "bridge":
            found = _first(np.array([time for time, name in told if name == "coil-broken"]), at)
        case "disk":
            found = _first(np.array([time for time, name in told if name == "log-recovered"]), end)
        case _:
            pass
    return found


def _first(times: FloatArray, end: float) -> float | None:
    later = times[times >= end - 1e-6]
    return float(later[0] - end) if len(later) else None


def _steady(times: FloatArray, end: float, gap: float, count: int = 8) -> float | None:
    """Return when after `end` samples come without a gap again."""
    later = times[times >= end - 1e-6]
    short = np.diff(later) < gap
    for first in range(len(short) - count):
        if short[first : first + count].all():
            return float(later[first] - end)
    return None


def _obeyed(flown: Run, end: float) -> float | None:
    """Return when after `end` the coils carry what the log says is written to them, half a second long."""
    control, truth = flown["control"], flown["truth"]
    count = min(len(control), len(truth) - 1)
    # The truth's sample at a cycle's start is of the current before its command.
    told, real = control["current_written"][:count], truth["current"][1 : count + 1]
    agrees = (np.abs(told - real) < 8e-3).all(axis=1)
    time = control["time_ns"][:count] * 1e-9
    for first in np.flatnonzero(time >= end - 1e-6):
        if agrees[first : first + 20].all():
            return float(time[first] - end)
    return None


def _blind_current(control: Any, time: FloatArray, current: FloatArray) -> float:
    """Return the largest current in A while the loop had no estimate for longer than the grace."""
    blind = np.isnan(control["angle"])
    cycles = round(BLIND_GRACE / CYCLE)
    since = np.array([blind[max(0, place - cycles) : place + 1].all() for place in range(len(blind))])
    begun = np.flatnonzero(~blind)
    if not len(begun):
        begun = np.array([0])
    moments = control["time_ns"][since & (np.arange(len(blind)) > max(begun[0], cycles))] * 1e-9
    if not len(moments):
        return 0.0
    return float(np.interp(moments, time, current).max())


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return a row for each fault, and what is wrong over all."""
    del folder
    by_fault: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        by_fault[result["fault"]].append(result)
    lines = [
        f"{len(results)} flights of {DURATION:g} s; detected: of those in which it met anything",
        f"{'fault':22}{'detected':>10}{'in, s (worst)':>16}  {'first event':18}{'reaction':28}"
        f"{'recovered in, s':>16}{'blind mA':>10}{'log':>8}",
    ]
    facts: dict[str, Any] = {"runs": len(results), "faults": {}}
    for name, own in by_fault.items():
        row = _row(own)
        facts["faults"][name] = row
        lines.append(
            f"{name:22}{row['detected']:>5}/{row['exercised']:<4}{_range(row['detected_s']):>16}  "
            f"{', '.join(row['events'])[:17]:18}{', '.join(row['reactions'])[:27]:28}"
            f"{_range(row['recovered_s']):>16}{1e3 * row['blind_current_a']:10.1f}"
            f"{row['logs_intact']:>5}/{len(own)}"
        )
    facts["task_failed"] = sum(result["task_failed"] for result in results)
    facts["logs_intact"] = sum(result["log_intact"] for result in results)
    facts["detected"] = sum(row["detected"] for row in facts["faults"].values())
    facts["exercised"] = sum(row["exercised"] for row in facts["faults"].values())
    lines.append(
        f"detected {facts['detected']} of {facts['exercised']} that met anything; unhandled exceptions in "
        f"{facts['task_failed']} flights; log whole in {facts['logs_intact']} of {len(results)}"
    )
    return Summary("\n".join(lines) + "\n", facts)


def _row(own: Sequence[Result]) -> dict[str, Any]:
    exercised = [result for result in own if result["exercised"]]
    seen = [result for result in exercised if result["detected_s"] is not None]
    back = [result["recovered_s"] for result in exercised]
    finite = [value for value in back if value is not None]
    return {
        "runs": len(own),
        "exercised": len(exercised),
        "detected": len(seen),
        "detected_s": _median_and_worst([result["detected_s"] for result in seen]),
        "events": sorted({result["event"] for result in seen}),
        "reactions": sorted({word for result in seen for word in result["reactions"]}),
        "recovered_s": _median_and_worst(finite),
        "not_recovered": len(back) - len(finite),
        "blind_current_a": max(result["blind_current_a"] for result in own),
        "largest_current_a": max(result["largest_current_a"] for result in own),
        "logs_intact": sum(result["log_intact"] for result in own),
    }


def _median_and_worst(values: Sequence[float]) -> list[float] | None:
    return [float(np.median(values)), float(max(values))] if values else None


def _range(pair: list[float] | None) -> str:
    return "-" if pair is None else f"{pair[0]:.2f} ({pair[1]:.2f})"


FAULTS = Campaign(
    "faults",
    "every fault of the catalogue in every mode at random times",
    cases,
    run,
    summarise,
    default_runs=1000,
)
