"""A run: its request, its default folder, and its result."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from hal.buses.system import SystemClock

if TYPE_CHECKING:  # most commands that use this module do not need the flight loop, which is slow to load
    from flight.loop.flight_loop import FlightEnding


@dataclass(frozen=True, slots=True)
class RunRequest:
    """A request to fly. If given, `duration` (s) and `seed` replace the configured values.

    The file `devices` belongs to a running server of simulated devices; if it is None, a server is started.
    The folder `archive` contains the runs of a flight computer; if it is given, its next run folder is used
    instead of `out`. If `accepted` is true and the file `config_path` is damaged, the last flown
    configuration is used instead. The simulated `faults` are injected in addition to the configured faults
    (`sim_hal.faults.schedule`). A `trial` of a simulated configuration uses no command socket and no stored
    state, so that it does not affect another flight of the same configuration.
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
    trial: bool = False


@dataclass(frozen=True, slots=True)
class RunResult:
    """The result of a flight. The flag `interrupted` states whether a signal ended the flight.

    The attribute `ending` is the state of the loop at the end of the flight. The text `restart` states why
    the process should be restarted; it is empty if no restart is needed. The attribute `faults` contains the
    text of each injected fault. The attribute `devices_late` contains the number of delayed events of the
    simulated devices, and the largest delay (s).
    """

    folder: Path
    reason: str
    interrupted: bool
    log_error: str
    ending: FlightEnding
    restart: str = ""
    faults: tuple[str, ...] = ()
    devices_late: tuple[int, float] | None = None


def utc_ns() -> int:
    """Return the machine's UTC, in ns since 1970."""
    return SystemClock().utc_ns()


def default_folder(config_path: Path) -> Path:
    """Return the default folder of a run, which is named after its configuration and the time.

    If the folder exists already, because another flight began in the same second, a number is added.
    """
    name = f"{config_path.stem}-{datetime.fromtimestamp(utc_ns() * 1e-9, UTC):%Y%m%d-%H%M%S}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(folder for folder in (Path("runs") / one for one in names) if not folder.exists())
