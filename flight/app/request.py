"""A request to fly and the result of the flight."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flight.loop.flight_status import FlightEnding


@dataclass(frozen=True, slots=True)
class RunRequest:
    """A request to fly. `duration` in s and `seed` replace the configuration's when given.

    `devices` is the file of a running server of simulated devices; without it, a server is started.
    `archive` holds the runs of a board: the flight's folder is the archive's next, instead of `out`.
    `accepted` flies `config_path` only if it is the accepted file, else the last one that flew.
    `faults` are injected in simulation, in addition to the configuration's, see `sim_hal.faults.schedule`.
    """

    config_path: Path
    out: Path
    realtime: bool = False
    duration: float | None = None
    seed: int | None = None
    devices: Path | None = None
    archive: Path | None = None
    faults: tuple[str, ...] = ()
    accepted: bool = False


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a flight ended; `interrupted` when by a signal.

    `ending` is how the loop stood. `restart` says why the process should be restarted, empty when it should
    not. `faults` were injected.
    """

    folder: Path
    reason: str
    interrupted: bool
    log_error: str
    ending: FlightEnding
    restart: str = ""
    faults: tuple[str, ...] = ()
