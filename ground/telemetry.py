"""Reader of recorded packets from bytes or from the folder of a run; every byte is accounted for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import (
    HEADER_BYTES,
    LAYOUTS,
    SEQUENCE_MODULUS,
    Layout,
    PacketArray,
    TelemetryError,
    to_text,
    truncated_bytes,
    walk,
)
from knightcube.errors import UsageError, shown


def text_of(value: bytes) -> str:
    """Return the text of a string field. Control characters, which could affect a terminal, are replaced."""
    return shown(to_text(value))


@dataclass(frozen=True)
class ScanResult:
    """Packets found in a sequence of bytes, and the numbers of bytes in and outside packets.

    Attributes:
        packets: structured array of each packet type in order of arrival, which may be empty.
        total_bytes: number of bytes scanned.
        skipped_bytes: number of bytes that belong to no valid packet, excluding a truncated last packet.
        truncated_bytes: number of bytes at the end that look like the beginning of a packet.
        missing: number of missing packets of each type according to the sequence counts. A gap is counted
            modulo 16,384, the range of the sequence count.
        other_versions: number of valid packets whose definition has a different version, which are not
            decoded.
    """

    packets: dict[str, PacketArray]
    total_bytes: int
    skipped_bytes: int
    truncated_bytes: int
    missing: dict[str, int]
    other_versions: int

    @property
    def counts(self) -> dict[str, int]:
        """Number of packets by name of the packet types that were found."""
        return {name: len(array) for name, array in self.packets.items() if len(array)}

    @property
    def intact(self) -> bool:
        """Whether every byte belongs to a packet and no packet is missing."""
        damage = self.skipped_bytes + self.truncated_bytes + self.other_versions
        return damage + sum(self.missing.values()) == 0


def scan(data: bytes) -> ScanResult:
    """Return the packets in `data` and the account of all bytes."""
    found: dict[str, list[bytes]] = {name: [] for name in LAYOUTS}
    claimed = other_versions = last = 0
    for layout, begin, end in walk(data):
        if data[begin + HEADER_BYTES] == layout.packet.version:
            found[layout.packet.name].append(data[begin:end])
        else:
            other_versions += 1
        claimed += end - begin
        last = end
    truncated = truncated_bytes(data, last)
    joined = {name: b"".join(packets) for name, packets in found.items()}
    return ScanResult(
        packets={name: LAYOUTS[name].array(raw) for name, raw in joined.items()},
        total_bytes=len(data),
        skipped_bytes=len(data) - claimed - truncated,
        truncated_bytes=truncated,
        missing={name: _missing(LAYOUTS[name], raw) for name, raw in joined.items()},
        other_versions=other_versions,
    )


def _missing(layout: Layout, packets: bytes) -> int:
    """Return the number of packets missing between the found packets, according to their sequence counts."""
    if len(packets) <= layout.length:  # gaps need at least two packets
        return 0
    steps = np.diff(layout.sequence_counts(packets))
    return int(np.sum((steps - 1) % SEQUENCE_MODULUS))


def decode(data: bytes) -> dict[str, PacketArray]:
    """Return arrays of the packets in `data` by packet name.

    Raises TelemetryError if a byte belongs to no valid packet or a packet is of another version.
    """
    result = scan(data)
    bad = result.skipped_bytes + result.truncated_bytes
    if bad or result.other_versions:
        others = result.other_versions
        raise TelemetryError(f"{bad} bytes belong to no packet, {others} packets are of another version")
    return result.packets


@dataclass(frozen=True)
class Run:
    """The packets of the logs in the folder of a run.

    `truth` and `performance` are empty if the run has no such log.
    """

    folder: Path
    flight: ScanResult
    truth: ScanResult
    performance: ScanResult

    @property
    def logs(self) -> dict[str, ScanResult]:
        """The flight log, the truth log and the performance log, by the stems of their file names."""
        return {"flight": self.flight, "truth": self.truth, "performance": self.performance}

    def dropped_segments(self, stem: str) -> int:
        """Return the number of oldest segments that were deleted because the log exceeded its size budget."""
        names = [path.stem for path in find_segments(self.folder, stem)]
        return int(names[0].rpartition("-")[2]) - 1 if names else 0

    def __getitem__(self, name: str) -> PacketArray:
        """Return the packets of a type from the log that contains them, or an empty array."""
        for log in self.logs.values():
            if len(log.packets[name]):
                return log.packets[name]
        return LAYOUTS[name].array(b"")


def read_run(folder: Path) -> Run:
    """Read a run's folder. Raises UsageError if the folder has no flight log with a valid packet."""
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder of a run (option --out of the run)")
    if not find_segments(folder, "flight"):
        raise UsageError(f"{folder}: no flight log (flight-0001.ccsds) in this folder")
    flight, truth, performance = (_read_log(folder, stem) for stem in ("flight", "truth", "performance"))
    if not flight.counts:
        raise UsageError(f"{folder}: no valid packet in the {flight.total_bytes} bytes of the flight log")
    return Run(folder, flight, truth, performance)


def _read_log(folder: Path, stem: str) -> ScanResult:
    try:
        return scan(b"".join(path.read_bytes() for path in find_segments(folder, stem)))
    except OSError as error:
        raise UsageError(f"{folder}: the {stem} log cannot be read: {error.strerror or error}") from error
