"""Campaign `unlike-inertia`: the coil monitor in a tumble of a satellite that differs from its description.

Each flight releases the 3U or the KnightCube at 10 deg/s. Its moments and principal axes, coils, gyro and
magnetometer differ from the configuration within the accuracies that the configuration states. The coils are
healthy, or one of them is reversed or open from the start. From the log: which axes the monitor isolated or
corrected, when it first named the broken one, and with which sign a reversed coil was flown in the end.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary, summary
from tests.support.flights import fly
from tests.support.unlike_body import coil_judgement, configured, with_fault, without_cameras

CRAFT_FILES = ("orbit_3u", "orbit")
FAULTS = ("", *(f"coil-{axis}: {kind}" for kind in ("reversed", "open") for axis in "xyz"))
DURATION = 300.0
SOON = 30.0
"""Time (s) within which a reversed coil must be found."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft with healthy coils and with each fault."""
    return [
        Case(f"{name} {fault or 'healthy'} {k}", (seed, number, k), {"name": name, "fault": fault})
        for k in range(runs)
        for number, (name, fault) in enumerate((name, fault) for name in CRAFT_FILES for fault in FAULTS)
    ]


def run(case: Case) -> Result:
    """Fly one case and return what the monitor said."""
    rng = np.random.default_rng(case.seed)
    name, fault = case.parameters["name"], case.parameters["fault"]
    config, world = configured(name)
    with tempfile.TemporaryDirectory(prefix="unlike-inertia-") as place:
        section = with_fault(world, int(rng.integers(1, 2**31)), fault)
        flown = fly(without_cameras(config, DURATION), Path(place), section=section)
        return {"name": name, "fault": fault, **coil_judgement(flown, fault[5:6])}


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return a row for each craft and fault."""
    del folder
    cells: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        kind = result["fault"].partition(": ")[2] or "healthy"
        cells[f"{result['name']} {kind}"].append(result)
    facts: dict[str, Any] = {
        "flights": len(results),
        **{
            f"with_{key}": sum(bool(one[key]) for one in results)
            for key in ("healthy_isolated", "healthy_suspected", "healthy_corrected")
        },
    }
    for cell, own in cells.items():
        named = [one["named_s"] for one in own if one["named_s"] is not None]
        row = {
            "flights": len(own),
            "named": len(named),
            f"named_within_{SOON:.0f}_s": sum(time <= SOON for time in named),
            "named_median_s": float(np.median(named)) if named else None,
            "named_worst_s": max(named, default=None),
            "flown_reversed": sum(one["flown_with"] < 0.0 for one in own),
            "isolated": sum(one["isolated_s"] is not None for one in own),
            "speed_median_deg_s": float(np.median([one["speed_deg_s"] for one in own])),
            "speed_worst_deg_s": max(one["speed_deg_s"] for one in own),
        }
        facts |= {f"{cell}: {key}": value for key, value in row.items()}
    return summary(facts)


UNLIKE_INERTIA = Campaign(
    "unlike-inertia",
    "healthy, reversed and open coils in a tumble of a satellite that differs from its configuration",
    cases,
    run,
    summarise,
    10,
)
