"""Campaign `unlike-inertia`: the coil monitor in a tumble whose inertia is not the configured one.

Each flight releases the 3U or the KnightCube at 10 deg/s. Its principal moments are drawn uniformly within
10 % of the configured ones, its principal axes within 5 degrees; impossible tensors are redrawn. The coils
are healthy, or one of them is reversed or open from the start. From the log: which axes the monitor isolated,
when it first named the broken one, and when it isolated it.
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
from tests.support.unlike_body import coil_judgement, configured, with_other_body, without_cameras

CRAFT_FILES = ("orbit_3u", "orbit")
FAULTS = ("", *(f"coil-{axis}: {kind}" for kind in ("reversed", "open") for axis in "xyz"))
MOMENTS, AXES_DEG = 0.1, 5.0
DURATION = 300.0


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
    moments = drawn_moments(np.array(config.craft.inertia), rng)
    with tempfile.TemporaryDirectory(prefix="unlike-inertia-") as place:
        section = with_other_body(world, moments, AXES_DEG, int(rng.integers(1, 2**31)), fault)
        flown = fly(without_cameras(config, DURATION), Path(place), section=section)
        return {"name": name, "fault": fault, **coil_judgement(flown, fault[5:6])}


def drawn_moments(believed: np.ndarray[Any, np.dtype[np.float64]], rng: np.random.Generator) -> list[float]:
    """Return possible principal moments within `MOMENTS` of the believed ones (3,) kg m^2."""
    while True:
        moments = believed * (1.0 + MOMENTS * rng.uniform(-1.0, 1.0, 3))
        if 2.0 * moments.max() < moments.sum():
            return [float(moment) for moment in moments]


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return a row for each craft and fault."""
    del folder
    cells: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        cells[f"{result['name']} {result['fault'] or 'healthy'}"].append(result)
    wrong = [one for one in results if one["healthy_isolated"]]
    suspected = [one for one in results if one["healthy_suspected"]]
    facts = {
        "flights": len(results),
        "with_healthy_isolated": len(wrong),
        "with_healthy_suspected": len(suspected),
    }
    return summary(facts)


UNLIKE_INERTIA = Campaign(
    "unlike-inertia",
    "healthy, reversed and open coils in a tumble whose inertia is not the configured one",
    cases,
    run,
    summarise,
    10,
)
