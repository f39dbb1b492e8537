"""Campaign `coil-faults`: accuracy of the filter while a coil does not carry the commanded current.

Each run flies 20 s of the demonstration's loop in lock-step, without a camera, through two slews. It breaks
one coil or one leg of a bridge at a random time, for 3 s or to the end. The IMU has no fault. The campaign
reports how long the error of the estimated rate or angle exceeds 5 of its claimed standard deviations, during
the fault and after it. It also reports until how long after the onset the filter rejects measurements of the
healthy IMU, and how often control was lost.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.link import events
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.sections import Commands, CommandStep, Config, Modes
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.telemetry import Run
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from sim_hal.faults.catalogue import CATALOGUE
from sim_hal.faults.schedule import fitted
from sim_hal.settings import FaultEntry
from tests.studies.campaigns.statistics import grouped
from tests.support.flights import demo_config, demo_world, fly

DURATION = 20.0
SPAN = 3.0
SIGMAS = 5.0
LONGEST_BEYOND = 0.25
"""Longest time (s) for which the error may exceed `SIGMAS` after the onset or the end of a fault."""
LONGEST_REFUSAL = 0.5
"""Time (s) after the onset after which the filter must accept all measurements of the healthy IMU."""


def faults() -> list[str]:
    """Return the faults of coils and bridges, by name."""
    config = demo_config(DURATION)
    kinds = [kind for kind in CATALOGUE.values() if kind.device.startswith(("coil", "bridge"))]
    return [kind.name for kind in kinds if fitted(kind.device, config)]


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each fault that lasts 3 s, and of each fault that lasts to the end."""
    return [
        Case(
            f"{name} {span or 'lasting'} {k}", (seed, number, span is None, k), {"fault": name, "span": span}
        )
        for k in range(runs)
        for number, name in enumerate(faults())
        for span in (SPAN, None)
    ]


def run(case: Case) -> Result:
    """Run one case, and evaluate its estimate."""
    rng = np.random.default_rng(case.seed)
    fault, span = case.parameters["fault"], case.parameters["span"]
    entry = FaultEntry(fault=fault, at=float(rng.uniform(4.0, 11.0)), span=span)
    section = configuration.replace(demo_world(), seed=int(rng.integers(1, 2**31)), faults=(entry,))
    slews = (-0.3, 0.1) if rng.random() < 0.5 else (0.25, -0.2)
    with tempfile.TemporaryDirectory() as place:
        flown = fly(config_for(slews), Path(place) / "run", section=section)
        return {"fault": fault, "span": span, "at": entry.at, **judge(flown, entry)}


def config_for(slews: tuple[float, float]) -> Config:
    """Return the configuration of 20 s of the demonstration without camera, with slews at 3.5 and 12 s."""
    first, second = (CommandStep(at=at, slew=slew) for at, slew in zip((3.5, 12.0), slews, strict=True))
    return configuration.replace(
        demo_config(DURATION, camera=False),
        modes=configuration.replace(Modes(), initial="hold"),
        commands=configuration.replace(Commands(), timeline=(first, second)),
    )


def judge(flown: Run, entry: FaultEntry) -> Result:
    """Return durations of excessive errors, rejections of the healthy IMU, and losses of control."""
    beyond, times = estimate_beyond(flown)
    period = float(np.median(np.diff(times)))
    begin = entry.at or 0.0
    end = begin + entry.span if entry.span is not None else DURATION
    event = flown["event"]
    names = [to_text(name) for name in event["name"]]
    refused = event["time_ns"][np.array([name == events.IMU_REFUSED.name for name in names], bool)]
    refused_s = refused / SECOND_NS - begin
    return {
        "beyond_s": period * int(beyond[(times >= begin) & (times < end)].sum()),
        "beyond_after_end_s": period * int(beyond[times >= end].sum()),
        "beyond_before_s": period * int(beyond[times < begin].sum()),
        "refusals": len(refused_s),
        "last_refusal_s": max(refused_s.tolist(), default=None),
        "control_lost": names.count(events.CONTROL_LOST.name),
        "found_s": min(
            (
                time
                for kind in (events.COIL_BROKEN, events.COIL_CORRECTED)
                if (time := _first(event, names, kind.name, begin)) is not None
            ),
            default=None,
        ),
    }


def estimate_beyond(flown: Run) -> tuple[np.ndarray[Any, np.dtype[np.bool_]], FloatArray]:
    """Return, for each cycle with an estimate, whether the error exceeds the limit, and its time (s)."""
    control, truth = flown["control"], flown["truth"]
    known = np.isfinite(control["rate"])
    control = control[known]
    times = control["time_ns"] / SECOND_NS
    real = truth["time_ns"] / SECOND_NS
    angle = 2.0 * np.arctan2(truth["quaternion"][:, 1], truth["quaternion"][:, 3])
    off_rate = np.abs(control["rate"] - np.interp(times, real, truth["rate"][:, 1])) / control["rate_sigma"]
    off_angle = np.abs(control["angle"] - np.interp(times, real, angle)) / control["angle_sigma"]
    return (off_rate > SIGMAS) | (off_angle > SIGMAS), times


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row of results for each fault."""
    facts: dict[str, Any] = {"faults": {}}
    for name, own in grouped(results, "fault", "span").items():
        facts["faults"][name] = {
            "flights": len(own),
            "beyond_s": max(one["beyond_s"] for one in own),
            "beyond_after_end_s": max(one["beyond_after_end_s"] for one in own),
            "refusals": sum(one["refusals"] for one in own),
            "last_refusal_s": max((one["last_refusal_s"] or 0.0 for one in own), default=0.0),
            "control_lost": sum(one["control_lost"] for one in own),
            "found_s": max((one["found_s"] for one in own if one["found_s"] is not None), default=None),
        }
    facts["flights"] = len(results)
    facts["beyond"] = sum(
        max(one["beyond_s"], one["beyond_after_end_s"]) >= LONGEST_BEYOND for one in results
    )
    facts["refused_late"] = sum((one["last_refusal_s"] or 0.0) > LONGEST_REFUSAL for one in results)
    return summary(facts)


def _first(event: Any, names: Sequence[str], name: str, after: float) -> float | None:
    """Return the mission time (s) of the first event named `name` after a given time, or None."""
    at = event["time_ns"][np.array([one == name for one in names], bool)] / SECOND_NS - after
    return min(at[at >= 0.0].tolist(), default=None)
