"""Campaign `unlike-inertia`: the coil monitor on a satellite that differs from its description.

Each flight runs the loop of the 3U or of the KnightCube. The true moments, principal axes, coils, gyro and
magnetometer differ from the configuration by at most the accuracies that the configuration states. A flight
has one of two phases. In the phase `tumble`, the satellite is released at 10 deg/s and detumbled. In the
phase `slow`, it is released at 0.2 deg/s, rotates to the Sun and holds this attitude. The coils are then
driven so little that only the self-test can find a fault. The self-test runs every minute, ten times as often
as by default. The cameras are left out, because a tumble does not use them, and rendering would cost most of
the time. In the phase `slow`, the solar cells and the magnetometer give the attitude.

The coils are healthy, or one of them becomes reversed or open at a random time in the first ten seconds. The
log shows which healthy coils were suspected, isolated or corrected, and how long after its onset the fault
was handled. A reversed coil is handled when its sign is changed, and an open coil when it is isolated.

The campaign `coil-faults` evaluates the attitude estimate during coil faults on the testbed, and not the
monitor.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from flight.link.events import Mode
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from ground.campaigns.runner import Case, Result, Summary, summary
from sim_hal.settings import Simulation
from tests.studies.campaigns.statistics import grouped, median
from tests.support.flights import fly
from tests.support.unlike_body import coil_judgement, configured, with_fault, without_cameras

CRAFT_FILES = ("orbit_3u", "orbit")
DURATIONS = {
    "tumble healthy": 100.0,
    "slow healthy": 120.0,
    "tumble reversed": 50.0,
    "tumble open": 45.0,
    "slow reversed": 180.0,
    "slow open": 180.0,
}
"""Time (s) of the flights of each phase and state of the coils."""
_FIRST = 4
"""Number of coil states in the first version of this campaign; their case numbers and seeds stay the same."""
ONSET = 10.0
"""Latest time (s) at which a fault begins."""
SOON = 30.0
"""Time (s) after its onset within which a fault must be handled in a tumble."""
TEST_INTERVAL = 60.0
"""Time (s) between the self-tests of a coil in the phase `slow`."""
SLOW_SPEED = 0.0035
"""Body rate (rad/s) at the release of the phase `slow`."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft in each phase and state; the faulty axis is x, y and z in turn."""
    kinds = tuple(DURATIONS)
    return [
        Case(f"{name} {kind} {k}", (seed, number, k), {"name": name, "kind": kind, "axis": "xyz"[k % 3]})
        for k in range(runs)
        for number, (name, kind) in enumerate(
            (*product(CRAFT_FILES, kinds[:_FIRST]), *product(CRAFT_FILES, kinds[_FIRST:]))
        )
    ]


def run(case: Case) -> Result:
    """Fly one case and return what the monitor reported."""
    rng = np.random.default_rng(case.seed)
    name, kind, axis = (case.parameters[key] for key in ("name", "kind", "axis"))
    phase, _, state = kind.partition(" ")
    config, world = configured(name)
    config = without_cameras(config, DURATIONS[kind])
    if phase == "slow":
        config, world = _slow(config, world)
    fault = "" if state == "healthy" else f"coil-{axis}: {state}"
    seed, onset = int(rng.integers(1, 2**31)), float(rng.uniform(0.0, ONSET))
    with tempfile.TemporaryDirectory(prefix="unlike-inertia-") as place:
        flown = fly(config, Path(place), section=with_fault(world, seed, fault, onset))
        found = coil_judgement(flown, axis if fault else "")
    time = found["corrected_s"] if state == "reversed" else found["isolated_s"]
    if time is not None and state == "reversed" and found["flown_with"] >= 0.0:
        time = None  # the sign was changed back
    pointed = bool((flown["mode"]["mode"] == int(Mode.SUN)).any())
    return {
        **found,
        "name": name,
        "kind": kind,
        "pointed": pointed,
        "handled_s": None if time is None else time - onset,
    }


def _slow(config: OrbitConfig, world: Simulation) -> tuple[OrbitConfig, Simulation]:
    """Return configuration and world of a satellite that is released slowly and rotates to the Sun."""
    assert world.free_body is not None
    release = configuration.replace(world.free_body.release, speed=SLOW_SPEED)
    body = configuration.replace(world.free_body, release=release)
    config = configuration.replace(
        config,
        modes=configuration.replace(config.modes, acquired="sun"),
        detumble=configuration.replace(config.detumble, low_rate=0.0175, low_for=0.5),
        pointing=configuration.replace(config.pointing, coil_test=TEST_INTERVAL),
    )
    return config, configuration.replace(world, free_body=body)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each craft, phase and state of the coils.

    Slow flights that never point, because they do not find the Sun in the Earth's shadow, are left out.
    """
    facts: dict[str, Any] = {
        "flights": len(results),
        **{
            f"with_{key}": sum(bool(one[key]) for one in results)
            for key in ("healthy_isolated", "healthy_suspected", "healthy_corrected")
        },
    }
    for cell, flights in grouped(results, "name", "kind").items():
        own = [one for one in flights if one["pointed"] or "/slow " not in cell]
        row: dict[str, Any] = {"flights": len(own)}
        if not cell.endswith("healthy"):
            times = [one["handled_s"] for one in own if one["handled_s"] is not None]
            row |= {
                "handled": len(times),
                f"handled_within_{SOON:.0f}_s": sum(time <= SOON for time in times),
                "handled_median_s": median(times),
                "handled_worst_s": max(times, default=None),
            }
        facts |= {f"{cell.replace('/', ' ')}: {key}": value for key, value in row.items()}
    return summary(facts)
