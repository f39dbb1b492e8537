"""Campaign `soak`: hours of simulated operation in lock-step with repeated faults.

Each run is some hours of the demonstration's loop without a break. A new target attitude is commanded every
50 to 150 s. About once a minute a fault of the catalogue is injected on the device lines for some seconds. A
command puts isolated axes back into use. Memory and files may not grow beyond their budget, and no coil may
carry more than its limit. After a last minute without faults, the body must point to its target. `--hours 24`
is four flights of six hours: long enough to show growing memory, and short enough that an interrupted
campaign loses little.
"""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.bodies import Step, TestbedConfig
from flight.schema.sections import Commands, CommandStep, Telemetry
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.telemetry import Run
from sim_hal.settings import FaultEntry
from tests.studies.campaigns.faults import faults
from tests.support.flights import Rigged, demo_config, demo_world, event_names, fly

HOUR_S = 3600.0
FLIGHT_HOURS = 6
QUIET_S = 60.0
POINTING_DEG = 0.5
MEMORY_BYTES_PER_HOUR = 8 << 20
BUDGET_BYTES = 4 << 20
_SEGMENT_BYTES = 256 << 10
_UNHEARD = ("camera", "vision", "disk")
"""Parts that receive no faults: the flight has no camera, and a full disk would lose the records of other
faults."""


def cases(hours: int, seed: int) -> list[Case]:
    """Return flights of six hours; the last flight may be shorter."""
    begins = range(0, hours, FLIGHT_HOURS)
    return [
        Case(f"from-hour-{begin}", (seed, begin), {"seconds": HOUR_S * min(FLIGHT_HOURS, hours - begin)})
        for begin in begins
    ]


def run(case: Case) -> Result:
    """Fly for the duration of the case."""
    seconds = case.parameters["seconds"]
    rng = np.random.default_rng(case.seed)
    entries, cleared = break_things(rng, seconds - QUIET_S)
    config = config_for(rng, seconds, cleared)
    section = configuration.replace(demo_world(), seed=int(rng.integers(1, 2**31)), faults=entries)
    memory: list[tuple[float, int]] = []

    def look() -> None:
        memory.append(((len(memory) + 2) * 0.05 * seconds, resident_bytes()))

    def look_on(rigged: Rigged) -> None:
        for share in range(2, 20):
            rigged.at(0.05 * share * seconds, look)

    with tempfile.TemporaryDirectory() as place, without_what_is_there():
        folder = Path(place) / "run"
        flown = fly(config, folder, look_on, section=section)
        size = sum(path.stat().st_size for path in folder.glob("flight-*"))
        return {
            "seconds": seconds,
            "faults": len(entries),
            "log_bytes": size,
            "memory_slope": _slope(memory),
            "largest_current_a": float(np.abs(flown["truth"]["current"]).max()),
            "current_limit_a": config.coils.current_limit,
            "pointing_deg": _pointing(flown, config),
            "log_intact": all(log.intact for log in flown.logs.values()),
            "task_failed": event_names(flown).count("task-failed"),
        }


def break_things(
    rng: np.random.Generator, until: float
) -> tuple[tuple[FaultEntry, ...], tuple[CommandStep, ...]]:
    """Return random faults, and the commands that put isolated axes back into use."""
    kinds = [kind for kind in faults() if kind.device not in _UNHEARD]
    entries, cleared = [], []
    time = 0.0
    while (time := time + float(rng.uniform(10.0, 80.0))) < until:
        kind = kinds[int(rng.integers(len(kinds)))]
        span = float(rng.uniform(0.5, 8.0))
        entries.append(FaultEntry(fault=kind.name, at=time, span=span))
        time += span
        if kind.device.startswith(("coil", "bridge")):
            cleared.append(CommandStep(at=time + 5.0, clear="coil-broken"))
    return tuple(entries), tuple(cleared)


def config_for(rng: np.random.Generator, seconds: float, cleared: tuple[CommandStep, ...]) -> TestbedConfig:
    """Return the configuration with a sequence of target attitudes and a small log."""
    base = demo_config(seconds, camera=False)
    times, time = [0.0], 0.0
    while (time := time + float(rng.uniform(50.0, 150.0))) < seconds - QUIET_S:
        times.append(time)
    steps = tuple(Step(at=at, q2=float(rng.uniform(-0.3, 0.3))) for at in times)
    last = CommandStep(at=seconds - QUIET_S, clear="coil-broken")
    return configuration.replace(
        base,
        steps=steps,
        commands=configuration.replace(Commands(), timeline=(*cleared, last)),
        telemetry=configuration.replace(Telemetry(), segment_bytes=_SEGMENT_BYTES, budget_bytes=BUDGET_BYTES),
    )


@contextmanager
def without_what_is_there() -> Iterator[None]:
    """Exclude present objects from garbage collection, which would last longer than the flight."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def resident_bytes() -> int:
    """Return the resident memory (bytes) of this process after a garbage collection."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _slope(memory: Sequence[tuple[float, int]]) -> float:
    """Return the growth of the memory (bytes per hour) in the second half of its samples."""
    half = np.array(memory[len(memory) // 2 :], dtype=float)
    return float(np.polyfit(half[:, 0], half[:, 1], 1)[0]) * HOUR_S


def _pointing(flown: Run, config: TestbedConfig) -> float:
    """Return the angle (deg) between the body and its last target in the last ten seconds."""
    truth = flown["truth"]
    late = truth["time_ns"] * 1e-9 > config.duration - 10.0
    angle = 2.0 * np.arcsin(np.clip(truth["quaternion"][late, 1], -1.0, 1.0))
    return float(np.degrees(np.abs(angle - 2.0 * np.arcsin(config.steps[-1].q2)).max()))


def broken(result: Result) -> list[str]:
    """Return the limits that a run exceeded."""
    found = {
        "memory": result["memory_slope"] > MEMORY_BYTES_PER_HOUR * HOUR_S / result["seconds"],
        "log size": result["log_bytes"] > BUDGET_BYTES,
        "current": result["largest_current_a"] > result["current_limit_a"] * (1.0 + 1e-9),
        "pointing": not result["pointing_deg"] < POINTING_DEG,
        "log": not result["log_intact"],
        "exceptions": result["task_failed"] > 0,
    }
    return [name for name, wrong in found.items() if wrong]


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the worst value of each result, and the flights that exceeded a limit."""
    worst: dict[str, Any] = {
        key: max(result[key] for result in results)
        for key in ("memory_slope", "log_bytes", "largest_current_a", "pointing_deg")
    }
    wrong = {str(flight): broken(result) for flight, result in enumerate(results) if broken(result)}
    faults_met = sum(result["faults"] for result in results)
    hours = sum(result["seconds"] for result in results) / HOUR_S
    return summary({"hours": hours, "faults": faults_met, **worst, "broken": wrong})
