"""Campaign `faults`: every fault of the catalogue in every mode, at random times, in lock-step.

Each run flies the demonstration's loop for half a minute in one mode. It injects one fault on the device
lines, at a random time and for a random duration; faults of coils and bridges last to the end. The campaign
then evaluates the log (`fault_judgement`): whether a specific event reported the fault, whether the reaction
of the table followed, and whether the log is complete. It also evaluates how long after the end of the fault
the flight recovered, and which currents the coils carried without measurements. A fault of an unused part (a
coil that is not driven, a planner without a request) has no effect and counts as not exercised. Exercised
faults that no event reported are listed with the number of their flight (the case number).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from ground.campaigns.runner import Case, Result, Summary, summary
from sim_hal.faults.catalogue import CATALOGUE, FaultKind, Where
from sim_hal.faults.schedule import fitted
from sim_hal.settings import FaultEntry
from tests.studies.campaigns.fault_judgement import OWN, judge, part_of
from tests.studies.campaigns.statistics import grouped
from tests.support.flights import DURATION, config_for, demo_config, demo_world, fly

MODES = ("boot", "safe", "detumble", "hold", "slew", "testbed-demo")
LASTING = ("coil", "bridge")

COIL_FIELD = ((5e-4, 0.0, 0.0), (0.0, 5e-4, 0.0), (0.0, 0.0, 5e-4))
"""Field that the coils cause at the magnetometer (T/A): 0.07 mT at full current, in a total field of 0.45
mT."""

_LOOKS = {"camera", "vision"}


def faults() -> list[FaultKind]:
    """Return the faults of the testbed's devices in lock-step.

    The campaign `orbit-faults` covers the faults of the magnetometer.
    """
    config = demo_config(30.0)
    both = [kind for kind in CATALOGUE.values() if kind.where is Where.BOTH]
    return [kind for kind in both if fitted(kind.device, config) and part_of(kind) in OWN]


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights in which all faults and all modes occur in turn."""
    kinds = faults()
    found = []
    for number in range(runs):
        lap, place = divmod(number, len(kinds))
        kind, mode = kinds[place], MODES[(lap + place) % len(MODES)]
        found.append(Case(f"{number}", (seed, number), {"fault": kind.name, "mode": mode}))
    return found


def run(case: Case) -> Result:
    """Run one case, and return its evaluation."""
    kind, mode = CATALOGUE[case.parameters["fault"]], case.parameters["mode"]
    rng = np.random.default_rng(case.seed)
    at = 0.0 if mode == "boot" else float(rng.uniform(4.0, 11.0))
    span = None if kind.device.startswith(LASTING) else float(rng.uniform(2.0, 6.0))
    entry = FaultEntry(fault=kind.name, at=at, span=span)
    return {"number": case.key, **fly_with(kind, mode, entry, int(rng.integers(1, 2**31)))}


def fly_with(kind: FaultKind, mode: str, entry: FaultEntry, seed: int) -> Result:
    """Fly half a minute with one fault."""
    section = configuration.replace(demo_world(), seed=seed, faults=(entry,), coil_field=COIL_FIELD)
    with tempfile.TemporaryDirectory() as place:
        flown = fly(config_for(mode, kind.device in _LOOKS, DURATION), Path(place) / "run", section=section)
        return {"fault": kind.name, "mode": mode, **judge(flown, kind, entry)}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each fault, and all defects found."""
    rows = {name: _row(own) for name, own in grouped(results, "fault").items()}
    facts: dict[str, Any] = {"runs": len(results), "faults": rows}
    for name in ("task_failed", "service_failing"):
        facts[name] = sum(result[name] for result in results)
    facts["logs_intact"] = sum(result["log_intact"] for result in results)
    facts["detected"] = sum(row["detected"] for row in facts["faults"].values())
    facts["exercised"] = sum(row["exercised"] for row in facts["faults"].values())
    facts["not_reported"] = [_named(one) for one in results if one["exercised"] and one["detected_s"] is None]
    facts["wrong_reaction"] = [_named(one) for one in results if one["reaction_right"] is False]
    return summary(facts)


def _named(result: Result) -> str:
    """Return the parameters with which a flight can be repeated."""
    others = f"; reported: {', '.join(result['others'])}" if result["others"] else ""
    span = f"{result['at']:.2f} to {result['end']:.2f} s"
    return f"{result['fault']}, {result['mode']}, {span}, number {result.get('number', '-')}{others}"


def _row(own: Sequence[Result]) -> dict[str, Any]:
    exercised = [result for result in own if result["exercised"]]
    seen = [result for result in exercised if result["detected_s"] is not None]
    back = [result["recovered_s"] for result in exercised]
    asked = [result["reaction_right"] for result in own if result["reaction_right"] is not None]
    finite = [value for value in back if value is not None]
    return {
        "runs": len(own),
        "exercised": len(exercised),
        "detected": len(seen),
        "detected_s": _median_and_worst([result["detected_s"] for result in seen]),
        "events": sorted({result["event"] for result in seen}),
        "reactions_right": sum(asked),
        "reactions_asked": len(asked),
        "reactions": sorted({word for result in seen for word in result["reactions"]}),
        "recovered_s": _median_and_worst(finite),
        "not_recovered": len(back) - len(finite),
        "blind_current_a": max(result["blind_current_a"] for result in own),
        "largest_current_a": max(result["largest_current_a"] for result in own),
        "logs_intact": sum(result["log_intact"] for result in own),
    }


def _median_and_worst(values: Sequence[float]) -> list[float] | None:
    return [float(np.median(values)), float(max(values))] if values else None
