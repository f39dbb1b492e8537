"""Reads the folder of a run: the flight log, and the logs of the truth and of the performance beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flight.link.telemetry.archive import find_segments
from flight.link.telemetry.packets import LAYOUTS, PacketArray
from ground.telemetry.scanner import ScanResult, scan
from knightcube.errors import UsageError


@dataclass(frozen=True)
class Run:
    """What a run left in its folder; `truth` and `performance` are empty where nobody wrote them."""

    folder: Path
    flight: ScanResult
    truth: ScanResult
    performance: ScanResult

    @property
    def logs(self) -> dict[str, ScanResult]:
        """The three logs by their stems."""
        return {"flight": self.flight, "truth": self.truth, "performance": self.performance}

    def dropped_segments(self, stem: str) -> int:
        """Return how many of a log's oldest segments had to go to keep its budget."""
        names = [path.stem for path in find_segments(self.folder, stem)]
        return int(names[0].rpartition("-")[2]) - 1 if names else 0

    def __getitem__(self, name: str) -> PacketArray:
        """Return the packets of a name from the log that has them; an empty array when none does."""
        for log in self.logs.values():
            if len(log.packets[name]):
                return log.packets[name]
        return LAYOUTS[name].array(b"")


def read_run(folder: Path) -> Run:
    """Read a run's folder. Raises UsageError when it holds no flight log, or one without a valid packet."""
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder that a run was written to (--out)")
    if not find_segments(folder, "flight"):
        raise UsageError(f"{folder}: no flight log (flight-0001.ccsds) in this folder")
    flight, truth, performance = (_read_log(folder, stem) for stem in ("flight", "truth", "performance"))
    run = Run(folder, flight, truth, performance)
    if not run.flight.counts:
        raise UsageError(f"{folder}: not one valid packet in {run.flight.total_bytes} bytes of flight log")
    return run


def _read_log(folder: Path, stem: str) -> ScanResult:
    try:
        return scan(b"".join(path.read_bytes() for path in find_segments(folder, stem)))
    except OSError as error:
        raise UsageError(f"{folder}: the {stem} log cannot be read: {error.strerror or error}") from error
