"""Campaign `orbit-faults`: every fault of a satellite's devices in every mode, in lock-step.

Each run flies the loop of config/orbit.yaml for 100 s in one mode, with all disturbances. It injects one
fault on the device lines, at a random time and for a random duration; faults of coils and bridges last to the
end. Some runs have a wrong initial condition instead: an element set that is a week old, no element set, or a
wall clock that is wrong from the start. The campaign checks whether a specific event reported the fault, and
whether the body meets the requirements of its mode at the end. It checks the current of coils that were
driven without valid readings, without a valid field, or without a valid attitude. It also checks for how long
the coils were driven by an attitude whose error exceeded both five claimed standard deviations and 0.1 deg. A
fault of an unused part (a coil that is not driven, a camera that is idle) counts as not exercised.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from sim_hal.faults.catalogue import CATALOGUE, FaultKind, Where
from sim_hal.faults.schedule import fitted
from sim_hal.settings import FaultEntry
from tests.studies.campaigns.orbit_fault_flights import MODES, config_for, world_for
from tests.studies.campaigns.orbit_fault_judgement import judge
from tests.support.flights import fly

LASTING = ("coil", "bridge")
ZERO = 1e-3
BEYOND = 1.0
"""Longest time (s) for which an attitude error may exceed its claimed sigmas while the coils act."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A flight with wrong initial conditions: its element set, and faults from the start."""

    elements: str
    faults: tuple[str, ...]


CONDITIONS: Mapping[str, Condition] = {
    "elements: a week old": Condition("old", ()),
    "elements: a week old, no receiver": Condition("old", ("gps: no-fix",)),
    "elements: none, no receiver": Condition("none", ("gps: no-fix for 20",)),
    "clock: 5 min wrong, late receiver": Condition("", ("clock: stepped (by=300)", "gps: no-fix for 20")),
}


def faults() -> list[str]:
    """Return the names of the faults that are meaningful in orbit, and of the conditions."""
    config = config_for("point")
    both = [kind for kind in CATALOGUE.values() if kind.where is Where.BOTH]
    return [kind.name for kind in both if fitted(kind.device, config)] + list(CONDITIONS)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights in which all faults and all modes occur in turn."""
    names = faults()
    found = []
    for number in range(runs):
        lap, place = divmod(number, len(names))
        name, mode = names[place], MODES[(lap + place) % len(MODES)]
        found.append(Case(f"{number} {name} {mode}", (seed, number), {"fault": name, "mode": mode}))
    return found


def run(case: Case) -> Result:
    """Run one case, and return its evaluation."""
    name, mode = case.parameters["fault"], case.parameters["mode"]
    rng = np.random.default_rng(case.seed)
    kind, at, span = _when(name, mode, rng)
    condition = CONDITIONS.get(name, Condition("", (name,)))
    entries = tuple(FaultEntry(fault=text, at=at, span=span) for text in condition.faults)
    facts = fly_with(kind, mode, entries, int(rng.integers(1, 2**31)), condition.elements)
    return {"number": case.seed[-1], "fault": name, "mode": mode, **facts}


def fly_with(
    kind: FaultKind, mode: str, entries: tuple[FaultEntry, ...], seed: int, elements: str = ""
) -> Result:
    """Run a flight with faults that start and end together, and evaluate them as one fault of `kind`."""
    config = config_for(mode, elements, replans=kind.device == "planner", wide_often=kind.device == "wide")
    at = entries[0].at or 0.0 if entries else 0.0
    span = entries[0].span if entries else None
    end = at if kind.momentary else min(at + (span or config.duration), config.duration)
    with tempfile.TemporaryDirectory(prefix="orbit-faults-") as place:
        flown = fly(config, Path(place), section=world_for(mode, seed, entries))
        return judge(flown, kind, mode, at, end)


def _when(name: str, mode: str, rng: np.random.Generator) -> tuple[FaultKind, float, float | None]:
    """Return the kind of fault to evaluate, and the fault's start and duration (s).

    The fault starts before the first plan, before the first attitude, or after both.
    """
    if name in CONDITIONS:
        device, _, kind = name.partition(": ")
        return FaultKind(device, kind, name, None), 0.0, None
    known = CATALOGUE[name]
    if known.device == "planner":
        at = float(rng.uniform(0.5, 3.0))
    else:
        at = float(rng.uniform(*(0.05, 0.6) if mode == "acquire" else (18.0, 26.0)))
    lasting = known.device.startswith(LASTING) or known.momentary
    return known, at, None if lasting else float(rng.uniform(9.0, 16.0))


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each fault with a cell for each mode, and all defects found."""
    by_cell: dict[str, dict[str, list[Result]]] = {}
    for result in results:
        by_cell.setdefault(result["fault"], {}).setdefault(result["mode"], []).append(result)
    exercised = [r for r in results if r["exercised"]]
    defects = {
        "not reported": [
            r for r in exercised if r["told_s"] is None and not r["fault"].startswith("elements")
        ],
        "not working again at the end": [r for r in results if not r["works"]],
        "current while blind": [r for r in results if r["blind_current_a"] > ZERO],
        "driven by a false attitude": [r for r in results if r["beyond_s"] > BEYOND],
        "an exception": [r for r in results if r["task_failed"]],
        "a log not whole": [r for r in results if not r["log_intact"]],
    }
    facts: dict[str, Any] = {"runs": len(results), "exercised": len(exercised)}
    facts["told"] = sum(r["told_s"] is not None for r in exercised)
    facts["defects"] = {name: [_named(r) for r in found] for name, found in defects.items()}
    return summary(facts)


def _named(result: Result) -> str:
    """Return the parameters with which a flight can be repeated."""
    span = f"{result['at']:.2f} to {result['end']:.2f} s"
    figures = f"blind {1e3 * result['blind_current_a']:.0f} mA, beyond {result['beyond_s']:.1f} s"
    said = ", ".join(result["reported"]) or "nothing"
    return (
        f"{result['fault']}, {result['mode']}, {span}, number {result['number']}; {figures}; reported: {said}"
    )
