"""What goes down, and when: verification first, then live telemetry, then files and playback in turn.

All within the line's rate. Live telemetry that it does not hold is thinned: of a periodic kind only the
newest packet waits. The archive has them all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

from flight.link.frames.telemetry import HEADER, MasterCount, Seal, TelemetryFramer
from flight.link.process.archive_reader import time_of
from flight.link.security.sdls import OVERHEAD_BYTES
from flight.link.telemetry.definitions import COMMAND, EVENT, MODE, PLAN, RUN, STARS, STREAK, TARGET
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS

LIVE, PLAYBACK, FILES = 0, 1, 2
"""Virtual channels."""

LEAST_FRAME = HEADER.size + OVERHEAD_BYTES + CRC_BYTES + 64

_SINGLE = {
    LAYOUTS[packet.name].identifier.to_bytes(2, "big")
    for packet in (RUN, TARGET, MODE, PLAN, STREAK, STARS, EVENT, COMMAND)
}
"""Kinds of which each packet counts."""

_BURST_S = 0.1
_WAITING_S = 0.5
_URGENT = 256
"""Reports that wait; a newer one displaces the oldest."""
_FLUSH_NS = 200_000_000


class LiveQueue:
    """Packets that wait for the rate.

    Attributes:
        thinned: packets that newer ones have replaced.
    """

    def __init__(self, room: float) -> None:
        """Beyond `room` bytes only the newest packet of each periodic kind waits."""
        self._room = room
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._newest: dict[bytes, bytes] = {}
        self.thinned = 0

    def add(self, packet: bytes) -> None:
        """Have a packet wait."""
        kind, room = packet[:2], self._room * (4 if packet[:2] in _SINGLE else 1)
        if self._bytes + len(packet) <= room and (kind in _SINGLE or not self._newest):
            self._waiting.append(packet)
            self._bytes += len(packet)
        else:
            self.thinned += self._newest.pop(kind, None) is not None
            self._newest[kind] = packet

    def take(self) -> bytes | None:
        """Return the next packet, None when none waits."""
        if self._waiting:
            packet = self._waiting.popleft()
            self._bytes -= len(packet)
            return packet
        return self._newest.pop(next(iter(self._newest))) if self._newest else None


class Downlink:
    """Makes telemetry frames at a line's rate.

    Attributes:
        sent: frames made.
        displaced: reports that waited for the rate when newer ones took their room.
        played_ns: mission time that the playback has reached.
    """

    def __init__(
        self, spacecraft: int, frame_bytes: int, rate: float, seal: Seal, files: Callable[[], bytes | None]
    ) -> None:
        """`rate` is in bytes/s of frames; `frame_bytes` is the length of each.

        `files` returns the next packet of a file's transfer when there is rate for it, None for none.
        """
        room = frame_bytes - HEADER.size - OVERHEAD_BYTES - CRC_BYTES
        master = MasterCount()
        self._live = TelemetryFramer(spacecraft, LIVE, room, master, seal)
        self._replay = TelemetryFramer(spacecraft, PLAYBACK, room, master, seal)
        self._filed = TelemetryFramer(spacecraft, FILES, room, master, seal)
        self._files = files
        self._files_first = True
        self._frame_bytes = frame_bytes
        self._rate = rate
        self._credit = 0.0
        self._credit_ns: int | None = None
        self._begun_ns = 0
        self._urgent: deque[bytes] = deque(maxlen=_URGENT)
        self._queue = LiveQueue(rate * _WAITING_S)
        self._source: Iterator[bytes] | None = None
        self.sent = self.displaced = 0
        self.played_ns = 0

    @property
    def thinned(self) -> int:
        """Live packets left out."""
        return self._queue.thinned

    @property
    def playing(self) -> bool:
        """Whether the archive is played back."""
        return self._source is not None

    def report(self, packet: bytes) -> None:
        """Send a packet before all others."""
        self.displaced += len(self._urgent) == _URGENT
        self._urgent.append(packet)

    def live(self, packet: bytes) -> None:
        """Send a packet of the flight as it is now."""
        self._queue.add(packet)

    def play(self, source: Iterator[bytes] | None) -> None:
        """Send the packets of `source` with the rate that is left over; b"" of it is a break."""
        self._source = source

    def frames(self, now_ns: int) -> list[bytes]:
        """Return the frames that are due. Raises FlightError where none can be protected."""
        before = now_ns if self._credit_ns is None else self._credit_ns
        most = max(2.0 * self._frame_bytes, self._rate * _BURST_S)
        self._credit = min(most, self._credit + self._rate * (now_ns - before) * 1e-9)
        self._credit_ns = now_ns
        due: list[bytes] = []
        while self._credit >= self._frame_bytes:
            made = self._next_live(now_ns) or self._next_in_turn()
            if not made:
                break
            due += made
            self._credit -= self._frame_bytes * len(made)
        self.sent += len(due)
        return due

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
        """Return frames of a file, or of the playback: each has half of what live telemetry leaves."""
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
