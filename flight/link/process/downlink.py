"""Telemetry downlink of the link process, limited to the data rate of the line.

Reports have the highest priority, followed by live telemetry, and then by files and playback, which
alternate. Live telemetry is read from the growing flight log. Time intervals of recorded runs are played back
on command. If live telemetry exceeds the data rate, only the newest packet of each periodic type is kept for
sending. The archive on board keeps all packets.
"""

from __future__ import annotations

import os
import struct
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from flight.link.coding import pseudo_random
from flight.link.files.transfer import DiskTimer
from flight.link.frames import TELEMETRY_HEADER, IdleFramer, MasterCount, Seal, TelemetryFramer
from flight.link.process.commanding import Report, Stage
from flight.link.process.directives import Play
from flight.link.security import OVERHEAD_BYTES
from flight.link.telemetry.definitions import COMMAND, EVENT, MODE, PLAN, RUN, STARS, STREAK, TARGET
from flight.link.telemetry.log import find_runs, find_segments
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, LONGEST_PACKET, walk
from hal.interfaces.wires import Clock
from knightcube.errors import KnightCubeError

_Read = TypeVar("_Read")

_STEM = "flight"
_CHUNK = 1 << 16
_LOOK_BACK = 1 << 14
_LOOKS = 25
"""Number of reads without new data after which the reader checks for a new segment or run."""
_UNORDERED_NS = 5_000_000_000
"""Maximum time (ns) by which packets of different rate groups can be out of order in the log."""
_TIME = struct.Struct(">q")
_LABEL = LAYOUTS[RUN.name].identifier.to_bytes(2, "big")
"""First bytes of each packet of type `run`."""


def time_of(packet: bytes) -> int:
    """Return the mission time (ns) in the secondary header of a packet."""
    return int(_TIME.unpack_from(packet, HEADER_BYTES + 1)[0])


class _PacketStream:
    """Decoder that splits a byte stream into complete packets."""

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
    """Reader of new log packets; `place` is the folder of a run, or an archive, whose newest run is read."""

    def __init__(self, place: Path) -> None:
        """Begin near the end of the newest run in the folder `place`. The run may also be created later."""
        self.place = place
        self._run: Path | None = None
        self._path: Path | None = None
        self._offset = 0
        self._stream = _PacketStream()
        self._idle = 0
        self.label = b""
        """The newest packet `run` of the present run as bytes; empty until a run is found."""
        self._is_read = False
        self.is_live = False
        """Whether the newest packets are live: the reader had reached the end of the log before reading
        them."""
        self._attach(at_end=True)

    def folder(self, number: int) -> Path | None:
        """Return the folder of a run by its number, or of the newest run for 0, or None if there is none."""
        if number == 0:
            return self._run
        return next((run for run in _runs(self.place) if int(run.name.partition("-")[2]) == number), None)

    def new(self) -> list[bytes]:
        """Return the packets written to the log since the last call, at most 64 kB per call."""
        data = b"" if self._path is None else _read(self._path, self._offset)
        self._offset += len(data)
        self._idle = 0 if data else self._idle + 1
        self.is_live = self._is_read
        self._is_read = self._path is not None and len(data) < _CHUNK
        if self._idle >= _LOOKS or (self._path is None and self._idle):
            self._idle = 0
            self._go_on()
        packets = self._stream.add(data) if data else []
        self.label = next((packet for packet in reversed(packets) if packet[:2] == _LABEL), self.label)
        return packets

    def _go_on(self) -> None:
        """Continue with the next segment, or with a newer run if the current run has no further segment.

        If the current segment was removed, the flight has begun a new log, which is read from its oldest
        segment.
        """
        is_gone = self._path is not None and _is_gone(self._path, self._offset)
        if self._path is not None and not is_gone:
            number = _number(self._path)
            later = [path for path in _segments(self._path.parent) if _number(path) > number]
            if later:
                self._path, self._offset = later[0], 0
                return
        self._attach(again=is_gone)

    def _attach(self, *, at_end: bool = False, again: bool = False) -> None:
        runs = _runs(self.place)
        newest = runs[-1] if runs else self.place
        segments = _segments(newest)
        if (newest == self._run and not again) or not segments:
            return
        self._run, self._path, self._offset = newest, segments[0], 0
        self._stream = _PacketStream()
        head = _PacketStream().add(_read(segments[0], 0)[:LONGEST_PACKET])
        self.label = next((packet for packet in head if packet[:2] == _LABEL), b"")
        self._is_read = self.is_live = False
        if at_end:
            with suppress(OSError):
                self._offset = max(0, segments[-1].stat().st_size - _LOOK_BACK)
                self._path = segments[-1]


def stretch(
    folder: Path, begin: float, end: float, missing: list[str], now_ns: Callable[[], int]
) -> Iterator[bytes]:
    """Yield packets of mission time `begin` to `end` (s), and b"" after each read, to allow pauses.

    Failed accesses to the disk are repeated. The list `missing` receives each part of the log that cannot be
    read; the rest of its segment is skipped.
    """
    begin_ns, end_ns = begin * 1e9, end * 1e9

    def repeated(access: Callable[[], _Read], name: str) -> Generator[bytes, None, _Read | None]:
        disk = DiskTimer(now_ns())
        while True:
            try:
                if not disk.waits(now_ns()):
                    return access()
            except OSError as error:
                if disk.failed(error, now_ns()):
                    missing.append(f"{name}: {error.strerror or error}")
                    return None
            yield b""

    segments = yield from repeated(partial(_segments_from, folder, begin_ns), folder.name)
    for path in segments or ():
        stream, offset = _PacketStream(), 0
        while data := (
            yield from repeated(partial(_portion, path, offset), f"{path.name} from byte {offset}")
        ):
            offset += len(data)
            packets = stream.add(data)
            yield from (packet for packet in packets if begin_ns <= time_of(packet) <= end_ns)
            if packets and time_of(packets[-1]) > end_ns + _UNORDERED_NS:
                return
            yield b""


def _segments_from(folder: Path, begin_ns: float) -> list[Path]:
    """Return the segments of a run that can contain packets of mission time `begin_ns` or later.

    Raises OSError if the folder cannot be listed.
    """
    segments, begin = find_segments(folder, _STEM), 0
    for number, path in enumerate(segments[1:], 1):
        if head := _PacketStream().add(_read(path, 0)[: 2 * LONGEST_PACKET]):
            if time_of(head[0]) + _UNORDERED_NS > begin_ns:
                break
            begin = number
    return segments[begin:]


def _runs(archive: Path) -> list[Path]:
    """Return the folders of all runs in an archive, or an empty list if the archive cannot be read."""
    try:
        return find_runs(archive)
    except OSError:
        return []


def _segments(folder: Path) -> list[Path]:
    """Return the segments of a run's flight log, or an empty list if the folder cannot be read."""
    try:
        return find_segments(folder, _STEM)
    except OSError:
        return []


def _number(path: Path) -> int:
    """Return the number at the end of a segment's file name."""
    return int(path.stem.rpartition("-")[2])


def _is_gone(path: Path, offset: int) -> bool:
    """Return whether a file is missing or shorter than `offset`, or False if the disk fails."""
    try:
        return path.stat().st_size < offset
    except FileNotFoundError:
        return True
    except OSError:
        return False


def _read(path: Path, offset: int) -> bytes:
    """Return at most 64 kB of a file, or empty bytes if the file cannot be read."""
    with suppress(OSError):
        return _portion(path, offset)
    return b""


def _portion(path: Path, offset: int) -> bytes:
    """Return at most 64 kB of a file. Raises OSError."""
    with open(path, "rb", opener=_at_once) as file:
        file.seek(offset)
        return file.read(_CHUNK)


def _at_once(path: str, flags: int) -> int:
    """Open a file without blocking, even if the path is a FIFO."""
    return os.open(path, flags | os.O_NONBLOCK)


LIVE, PLAYBACK, FILES = 0, 1, 2
"""Numbers of the virtual channels for live telemetry, playback and files."""

_SINGLE = {
    LAYOUTS[packet.name].identifier.to_bytes(2, "big")
    for packet in (RUN, TARGET, MODE, PLAN, STREAK, STARS, EVENT, COMMAND)
}
"""Identifiers of the packet types that are thinned out only when the queue is four times as long as for other
types."""

_BURST_S = 0.1
_WAITING_S = 0.5
_URGENT = 256
"""Maximum number of queued reports. If the queue is full, a new report replaces the oldest report."""
_FLUSH_NS = 200_000_000


class LiveQueue:
    """Queue of live telemetry packets; `thinned` counts packets replaced by newer packets of their type."""

    def __init__(self, room: float) -> None:
        """Create a queue that keeps only the newest packet of each type once it contains `room` bytes.

        For the packet types in `_SINGLE`, this limit is four times as large.
        """
        self._room = room
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._newest: dict[bytes, bytes] = {}
        self.thinned = 0

    def add(self, packet: bytes) -> None:
        """Add a packet to the queue."""
        kind, room = packet[:2], self._room * (4 if packet[:2] in _SINGLE else 1)
        if self._bytes + len(packet) <= room and (kind in _SINGLE or not self._newest):
            self._waiting.append(packet)
            self._bytes += len(packet)
        else:
            self.thinned += self._newest.pop(kind, None) is not None
            self._newest[kind] = packet

    def take(self) -> bytes | None:
        """Return the next packet, or None if the queue is empty."""
        if self._waiting:
            packet = self._waiting.popleft()
            self._bytes -= len(packet)
            return packet
        return self._newest.pop(next(iter(self._newest))) if self._newest else None


class Downlink:
    """Generator of telemetry frames at the data rate of the line.

    Attributes:
        sent: number of generated telemetry frames.
        displaced: number of queued reports that were replaced by newer reports.
        played_ns: mission time (ns) that the playback has reached.
    """

    def __init__(
        self,
        spacecraft: int,
        frame_bytes: int,
        rate: float,
        seal: Seal,
        files: Callable[[], bytes | None],
        idle_rate: float = 0.0,
    ) -> None:
        """Make frames of `frame_bytes` bytes at a data rate of `rate` bytes/s.

        The function `files` returns the next packet of the file transfers, or None if no packet is due.
        Frames of idle data raise the data rate to `idle_rate`, bytes/s.
        """
        room = frame_bytes - TELEMETRY_HEADER.size - OVERHEAD_BYTES - CRC_BYTES
        master = MasterCount()
        self._live = TelemetryFramer(spacecraft, LIVE, room, master, seal)
        self._replay = TelemetryFramer(spacecraft, PLAYBACK, room, master, seal)
        self._filed = TelemetryFramer(spacecraft, FILES, room, master, seal)
        self._idle = IdleFramer(spacecraft, frame_bytes, master, pseudo_random("long"))
        self._idle_rate, self._idle_credit = idle_rate, 0.0
        self._files = files
        self._files_first = True
        self._frame_bytes, self._rate = frame_bytes, rate
        self._credit = 0.0
        self._credit_ns: int | None = None
        self._begun_ns = 0
        self._urgent: deque[bytes] = deque(maxlen=_URGENT)
        self._queue = LiveQueue(rate * _WAITING_S)
        self._source: Iterator[bytes] | None = None
        self.sent = self.displaced = self.played_ns = 0

    @property
    def thinned(self) -> int:
        """Number of live packets dropped because of the limited data rate."""
        return self._queue.thinned

    @property
    def waiting(self) -> int:
        """Number of queued reports."""
        return len(self._urgent)

    @property
    def frame_s(self) -> float:
        """Time (s) between two frames at the data rate of the line."""
        return self._frame_bytes / self._rate

    @property
    def playing(self) -> bool:
        """Whether a playback is running."""
        return self._source is not None

    def report(self, packet: bytes) -> None:
        """Queue a report packet, which is sent before all other packets."""
        self.displaced += len(self._urgent) == _URGENT
        self._urgent.append(packet)

    def live(self, packet: bytes) -> None:
        """Queue a packet of live telemetry."""
        self._queue.add(packet)

    def play(self, source: Iterator[bytes] | None) -> None:
        """Play back the packets of `source` at the unused data rate.

        An item b"" of `source` ends the present call of `frames`.
        """
        self._source = source

    def frames(self, now_ns: int, live_only: bool = False) -> list[bytes]:
        """Return the frames that are due at `now_ns`; if `live_only`, files and playback wait.

        Raises KnightCubeError if no frame can be protected. No further packets are then taken from the queues
        until the completed frames can be protected.
        """
        before = now_ns if self._credit_ns is None else self._credit_ns
        most = max(2.0 * self._frame_bytes, self._rate * _BURST_S)
        self._credit = min(most, self._credit + self._rate * (now_ns - before) * 1e-9)
        self._credit_ns = now_ns
        due: list[bytes] = []
        while self._credit >= self._frame_bytes:
            try:
                framers = (self._live,) if live_only else (self._live, self._replay, self._filed)
                late = next(filter(None, (one.take() for one in framers)), None)
                made = late or self._next_live(now_ns) or ([] if live_only else self._next_in_turn())
            except KnightCubeError:
                if not due:
                    raise
                break  # the frames that were protected are sent first
            if not made:
                break
            due += made
            self._credit -= self._frame_bytes * len(made)
        self.sent += len(due)
        return due + self._idle_frames(1e-9 * (now_ns - before), len(due))

    def _idle_frames(self, seconds: float, sent: int) -> list[bytes]:
        """Return the due frames of idle data; in the last `seconds` s, `sent` other frames were made."""
        most = self._frame_bytes + self._idle_rate * _BURST_S
        credit = self._idle_credit + self._idle_rate * seconds - sent * self._frame_bytes
        credit = min(max(credit, -most), most)
        made = [self._idle.frame() for _ in range(int(max(credit, 0.0) // self._frame_bytes))]
        self._idle_credit = credit - len(made) * self._frame_bytes
        return made

    def _next_live(self, now_ns: int) -> list[bytes]:
        while (packet := self._urgent.popleft() if self._urgent else self._queue.take()) is not None:
            if not self._live.waits:
                self._begun_ns = now_ns
            if made := self._live.add(packet):
                self._begun_ns = now_ns
                return made
        late = self._live.waits and now_ns - self._begun_ns >= _FLUSH_NS
        return self._live.flush() if late else []

    def _next_in_turn(self) -> list[bytes]:
        """Return frames of the file transfers or of the playback, alternating between the two."""
        self._files_first = not self._files_first
        if self._files_first:
            return self._next_filed() or self._next_played()
        return self._next_played() or self._next_filed()

    def _next_filed(self) -> list[bytes]:
        while (packet := self._files()) is not None:
            if made := self._filed.add(packet):
                return made
        return self._filed.flush() if self._filed.waits else []

    def _next_played(self) -> list[bytes]:
        if self._source is None:
            return []
        for packet in self._source:
            if not packet:
                return []
            self.played_ns = time_of(packet)
            if made := self._replay.add(packet):
                return made
        self._source = None
        return self._replay.flush() if self._replay.waits else []


class Playback:
    """Playback of one time interval of recorded packets at a time."""

    def __init__(self, downlink: Downlink, log: LogFollower, clock: Clock) -> None:
        self._downlink, self._log, self._clock = downlink, log, clock
        self._done: Report | None = None
        self._missing: list[str] = []

    def begin(self, play: Play, done: Report) -> list[Report]:
        """Begin a playback and return the reports due now; `done` is the report of completion."""
        folder = self._log.folder(play.run)
        if folder is None:
            return [replace(done, stage=Stage.FAILED, text=f"the archive has no run {play.run}")]
        reports = self.end("replaced by another playback")
        self._missing = []
        self._downlink.play(stretch(folder, play.begin, play.end, self._missing, self._clock.now_ns))
        self._done = done
        return [*reports, replace(done, stage=Stage.STARTED)]

    def end(self, reason: str) -> list[Report]:
        """End the playback and return the failure report of an interrupted playback."""
        reports = [] if self._done is None else [replace(self._done, stage=Stage.FAILED, text=reason)]
        self._done = None
        self._downlink.play(None)
        return reports

    def turn(self) -> list[Report]:
        """Return the final report of a playback once all readable packets were sent, else an empty list."""
        if self._done is None or self._downlink.playing:
            return []
        done, self._done = self._done, None
        if self._missing:
            text = f"unreadable parts: {len(self._missing)}, first {self._missing[0]}"
            done = replace(done, stage=Stage.FAILED, text=text)
        return [done]
