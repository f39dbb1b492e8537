"""The ground's end of files: commands for them, and their transfers over a terminal.

What came is on disk at any moment, so that a session that ends, or is killed, is gone on with by the next.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable
from pathlib import Path

from flight.app.run import utc_ns
from flight.link.files.store import Store
from flight.link.files.transfer import CRC32, GROUND, LONGEST_FILE, NOBODY, SATELLITE, Entity, Progress
from flight.link.files.units import DOWN, UP, Metadata, PduError, UnitPacker, is_unit, unit_of
from flight.link.frames import LONGEST_FRAME, TELECOMMAND_HEADER
from flight.link.process import directives
from flight.link.process.commanding import Report, Stage
from flight.link.process.directives import Directive
from flight.link.security import OVERHEAD_BYTES
from flight.link.telemetry.definitions import TRANSFER, VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, to_text
from ground.link.terminal import Terminal, report_of
from knightcube.errors import FlightError

_BLOCK = 64
"""Counters reserved at once: another process's command in between costs what is left of them."""
_AGAIN_NS = 5_000_000_000
_BURST_S = 0.05
_FRAME_BYTES = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + CRC_BYTES
_REPORTED = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")
_TRANSFER = LAYOUTS[TRANSFER.name]


class FileSession:
    """Commands and transfers of one terminal. For one thread.

    Attributes:
        entity: the ground's end of the transfers.
        received: the folder of the files that came.
        heard_ns: when anything came last.
    """

    def __init__(self, terminal: Terminal, store: Store, spi: int, rate: float, now_ns: int) -> None:
        """`rate` is in bytes/s of frames up. Raises FlightError."""
        self._terminal = terminal
        self._rate = rate
        self._sealer = terminal.sealer(spi, _BLOCK)
        self._units = UnitPacker(UP)
        self.entity = Entity(GROUND, store, _anything, LONGEST_FILE, now_ns)
        self.received = store.received
        self.heard_ns = now_ns
        self._said: dict[tuple[int, int], str] = {}
        self._asked: tuple[Directive, int] | None = None
        self._counters: set[int] = set()
        self._reports: deque[Report] = deque()
        self._credit, self._credit_ns = 0.0, now_ns

    def ask(self, directive: Directive, now_ns: int) -> None:
        """Send a command, and again until it is answered."""
        self._asked = (directive, now_ns + _AGAIN_NS)
        self._counters.add(self._send(directives.pack(directive, utc_ns())))

    def put(self, path: Path, name: str, now_ns: int) -> Progress:
        """Begin to send a file up, or go on with it. Raises FlightError."""
        return self.entity.send(path, name, SATELLITE, CRC32, utc_ns(), now_ns, NOBODY)

    def take(self, packets: Iterable[tuple[int, bytes]], now_ns: int) -> None:
        """Take virtual channel and packet of telemetry that came."""
        for _, packet in packets:
            self.heard_ns = now_ns
            if is_unit(packet, DOWN):
                self._take(packet, now_ns)
            elif packet[:2] == _REPORTED:
                self._note(report_of(packet))
            elif packet[:2] == _TRANSFER.identifier.to_bytes(2, "big"):
                (row,) = _TRANSFER.array(packet)
                self._said[int(row["source"]), int(row["number"])] = to_text(row["text"])

    def go_on(self, now_ns: int) -> None:
        """Send what is due, within the rate. Raises FlightError."""
        if self._asked is not None and now_ns >= self._asked[1]:
            self.ask(self._asked[0], now_ns)
        self._credit += self._rate * (now_ns - self._credit_ns) * 1e-9
        self._credit = min(self._credit, max(self._rate * _BURST_S, 2.0 * LONGEST_FRAME))
        self._credit_ns = now_ns
        while self._credit > 0.0 and (unit := self.entity.unit(now_ns)) is not None:
            packet = self._units.pack(unit, utc_ns())
            self._send(packet)
            self._credit -= len(packet) + _FRAME_BYTES
        self.entity.keep(now_ns)

    def reports(self) -> list[Report]:
        """Return the reports on what was asked since the last call."""
        found = list(self._reports)
        self._reports.clear()
        return found

    def said_of(self, progress: Progress) -> str:
        """Return why a transfer ended; of one that the satellite refused its own words."""
        return self._said.get((progress.source, progress.number), "") or progress.said

    def close(self, now_ns: int) -> None:
        """Keep what came."""
        self.entity.close(now_ns)

    def _take(self, packet: bytes, now_ns: int) -> None:
        try:
            self.entity.take(unit_of(packet), now_ns)
        except PduError:  # of a satellite with another release: what it means cannot be known
            return

    def _note(self, report: Report) -> None:
        if report.counter in self._counters:
            if report.stage is not Stage.ACCEPTED:
                self._asked = None
            self._reports.append(report)

    def _send(self, packet: bytes) -> int:
        return self._terminal.send_by(self._sealer, packet)


def sum_of(path: Path) -> bytes:
    """Return the SHA-256 of a file. Raises FlightError."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError as error:
        raise FlightError(f"{path}: {error.strerror or error}") from error


def failed(reports: list[Report]) -> str:
    """Return why a command failed, empty where it has not."""
    bad = (report.text for report in reports if report.stage in {Stage.REFUSED, Stage.FAILED})
    return next(bad, "")


def _anything(_: Metadata) -> str:
    return ""
