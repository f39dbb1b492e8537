"""A run: its request, its folder with configuration and logs, and its result."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from flight.link.telemetry.log import DISK_TROUBLE, FlightLog, begin_run, find_runs, open_segment
from flight.schema.sections import Config
from hal.buses.system import SystemClock
from hal.interfaces.wires import SECOND_NS, Rig
from knightcube.errors import UsageError

if TYPE_CHECKING:  # most commands that use this module do not need the flight loop, which is slow to load
    from flight.loop.flight_loop import FlightEnding


@dataclass(frozen=True, slots=True)
class RunRequest:
    """A request to fly. If given, `duration` (s) and `seed` replace those of the configuration.

    The file `devices` belongs to a running server of simulated devices; without it, a server is started. The
    folder `archive` contains the runs of a flight computer; if it is given, its next run folder is used
    instead of `out`. If `accepted` is true and the file `config_path` is damaged, the last flown
    configuration is used instead. The simulated `faults` are injected in addition to those of the
    configuration (`sim_hal.faults.schedule`).
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
    """The result of a flight. The flag `interrupted` states whether a signal ended the flight.

    The attribute `ending` is the state of the loop at the end of the flight. The text `restart` states why
    the process should be restarted; it is empty if no restart is needed. The attribute `faults` contains the
    text of each injected fault. The attribute `devices_late` contains how many events of the simulated
    devices were late, and the largest delay (s).
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


_NEWEST = 4
"""Number of newest runs whose folders are searched for the number of the last boot."""


def default_folder(config_path: Path) -> Path:
    """Return the default folder of a run, which is named after its configuration and the time."""
    return Path("runs") / f"{config_path.stem}-{datetime.fromtimestamp(utc_ns() * 1e-9, UTC):%Y%m%d-%H%M%S}"


def begin_folder(request: RunRequest, text: str, config: Config) -> tuple[RunRequest, list[Path]]:
    """Create the folder of the run, which is the next folder of the archive if there is an archive.

    Return the request with the path of the new folder, and the folders of the newest earlier runs.

    Raises UsageError for a folder that already contains a run, and for a folder that cannot be written. A
    flight computer with an archive flies despite disk errors, and its logs wait until the disk works.
    """
    earlier: list[Path] = []
    if request.archive is not None:
        earlier = find_runs(request.archive)[-_NEWEST:]
        logs_bytes = (2 if config.simulation is None else 3) * config.telemetry.budget_bytes
        run = begin_run(request.archive, config.telemetry.archive_bytes, logs_bytes)
        request = replace(request, out=run.folder)
    out = request.out
    if any(out.glob("*.ccsds")):
        raise UsageError(f"{out} already contains a run: give another folder, or remove this one")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "config.yaml").write_text(text, encoding="utf-8")
    except OSError as error:
        if request.archive is not None and error.errno in DISK_TROUBLE:
            return request, earlier
        raise UsageError(f"{out}: cannot be written: {error.strerror or error}") from error
    return request, earlier


def open_log(folder: Path, stem: str, rig: Rig, config: Config, stack: ExitStack, patient: bool) -> FlightLog:
    """Open a log of the run, which is synchronised to disk once a second in real time."""
    log = FlightLog(
        folder,
        stem,
        clock=rig.clock,
        segment_bytes=config.telemetry.segment_bytes,
        budget_bytes=config.telemetry.budget_bytes,
        sync_period_ns=SECOND_NS if rig.realtime else None,
        patient=patient,
        opener=open_segment if rig.host is None else rig.host.opener(open_segment),
    )
    stack.callback(log.close)
    return log
