"""Reads the flight log for the link: what is new in the newest run, and stretches of any run."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from flight.link.telemetry.archive import find_runs
from flight.link.telemetry.definitions import RUN
from flight.link.telemetry.packets import HEADER_BYTES, LAYOUTS, LONGEST_PACKET
from flight.link.telemetry.segments import find_segments
from flight.link.telemetry.walk import walk

_STEM = "flight"
_CHUNK = 1 << 16
_LOOK_BACK = 1 << 14
_LOOKS = 25
"""After this many reads that found nothing the reader looks for a new segment or run."""
_UNORDERED_NS = 5_000_000_000
"""Packets of several rate groups stand in the log nearly in order of time."""
_TIME = struct.Struct(">q")


def time_of(packet: bytes) -> int:
    """Return the mission time of a packet, ns."""
    return int(_TIME.unpack_from(packet, HEADER_BYTES + 1)[0])


class _PacketStream:
    """Whole packets of bytes that come in pieces."""

    def __init__(self) -> None:
        self._rest = b""

    def add(self, data: bytes) -> list[bytes]:
        data = self._rest + data
        last, found = 0, []
        for _, begin, last in walk(data):
            found.append(data[begin:last])
        self._rest = data[max(last, len(data) - LONGEST_PACKET) :]
        return found


class LogFollower:
    """Follows the newest run of an archive, or one run.

    Attributes:
        place: folder of the archive, or of the run.
    """

    def __init__(self, place: Path) -> None:
        """Begin near the end of the newest run under `place`; it may come later."""
        self.place = place
        self._run: Path | None = None
        self._path: Path | None = None
        self._offset = 0
        self._stream = _PacketStream()
        self._idle = 0
        self.label = b""
        """The packet that says what is flown, empty while it is not known."""
        self._attach(at_end=True)

    def folder(self, number: int) -> Path | None:
        """Return the folder of a run of the archive, of the newest for 0; None where there is none."""
        if number == 0:
            return self._run
        return next((run for run in _runs(self.place) if int(run.name.partition("-")[2]) == number), None)

    def new(self) -> list[bytes]:
        """Return the packets that came since the last call, 64 kB of them at most."""
        data = b"" if self._path is None else _read(self._path, self._offset)
        self._offset += len(data)
        self._idle = 0 if data else self._idle + 1
        if self._idle >= _LOOKS or (self._path is None and self._idle):
            self._idle = 0
            self._go_on()
        return self._stream.add(data) if data else []

    def _go_on(self) -> None:
        """Turn to the next segment, or to a newer run, where there is one."""
        if self._path is not None:
            number = _number(self._path)
            later = [path for path in _segments(self._path.parent) if _number(path) > number]
            if later:
                self._path, self._offset = later[0], 0
                return
        self._attach()

    def _attach(self, *, at_end: bool = False) -> None:
        runs = _runs(self.place)
        newest = runs[-1] if runs else self.place
        segments = _segments(newest)
        if newest == self._run or not segments:
            return
        self._run, self._path, self._offset = newest, segments[0], 0
        self._stream = _PacketStream()
        head = _PacketStream().add(_read(segments[0], 0)[:LONGEST_PACKET])
        identifier = LAYOUTS[RUN.name].identifier.to_bytes(2, "big")
        self.label = next((packet for packet in head if packet[:2] == identifier), b"")
        if at_end:
            with suppress(OSError):
                self._offset = max(0, segments[-1].stat().st_size - _LOOK_BACK)
                self._path = segments[-1]


def stretch(folder: Path, begin: float, end: float) -> Iterator[bytes]:
    """Yield the packets of a run from `begin` to `end` s of mission time; b"" is a break."""
    begin_ns, end_ns = begin * 1e9, end * 1e9
    for path in _segments_from(folder, begin_ns):
        stream, offset = _PacketStream(), 0
        while data := _read(path, offset):
            offset += len(data)
            packets = stream.add(data)
            yield from (packet for packet in packets if begin_ns <= time_of(packet) <= end_ns)
            if packets and time_of(packets[-1]) > end_ns + _UNORDERED_NS:
                return
            yield b""


def _segments_from(folder: Path, begin_ns: float) -> list[Path]:
    """Return the segments from the one on in which a time may stand."""
    segments = _segments(folder)
    while len(segments) > 1:
        first = _PacketStream().add(_read(segments[1], 0)[: 2 * LONGEST_PACKET])
        if first and time_of(first[0]) + _UNORDERED_NS > begin_ns:
            break
        segments = segments[1:]
    return segments


def _runs(archive: Path) -> list[Path]:
    """Return the folders of an archive's runs, none of an archive that cannot be read now."""
    try:
        return find_runs(archive)
    except OSError:
        return []


def _segments(folder: Path) -> list[Path]:
    """Return the segments of a run's flight log, none of a folder that cannot be read now."""
    try:
        return find_segments(folder, _STEM)
    except OSError:
        return []


def _number(path: Path) -> int:
    """Return the number at the end of the name of a segment or a run."""
    return int(path.stem.rpartition("-")[2])


def _read(path: Path, offset: int) -> bytes:
    """Return at most 64 kB of a file; nothing of one that is gone or cannot be read now, nor of a FIFO."""
    try:
        with open(path, "rb", opener=_at_once) as file:
            file.seek(offset)
            return file.read(_CHUNK)
    except OSError:
        return b""


def _at_once(path: str, flags: int) -> int:
    """Open a file without waiting, as a FIFO in its place would."""
    return os.open(path, flags | os.O_NONBLOCK)
