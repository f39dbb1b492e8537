"""A request to fly and the result of the flight."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What to fly, and how. `duration` in s and `seed` replace the configuration's when given.

    `devices` is the file of a server of simulated devices that runs already; without it one is started.
    `archive` holds the runs of a board: the next of them is flown into, instead of into `out`.
    `config_problem` says why `config_path` is not the file that was asked for, empty where it is.
    `faults` are injected in simulation, beside those of the configuration, see `sim_hal.faults.grammar`.
    """

    config_path: Path
    out: Path
    realtime: bool = False
    duration: float | None = None
    seed: int | None = None
    devices: Path | None = None
    archive: Path | None = None
    faults: tuple[str, ...] = ()
    config_problem: str = ""


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a flight ended; `interrupted` when a signal asked for it.

    `restart` says why the process should be started again, empty when it should not. `faults` were injected.
    """

    folder: Path
    reason: str
    interrupted: bool
    log_error: str
    restart: str = ""
    faults: tuple[str, ...] = ()
