"""The flight application's pen: packets into the flight log, timing into a performance log of its own.

Measured execution times depend on the machine, so they stand apart: the flight log of a lock-step run is the
same bit for bit each time.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol

from flight.link.events import COMMANDED, EventKind
from flight.link.telemetry.definitions import ATTITUDE, CONTROL, EVENT, HEALTH, HOUSEKEEPING, RUN
from flight.link.telemetry.form import Packet
from flight.link.telemetry.packets import Packer, TelemetryError

_STATUS = (RUN, CONTROL, ATTITUDE, HOUSEKEEPING, HEALTH)
_STATUS_EVENTS = 2
"""With these and the answer to a command a datagram fits into one Ethernet frame."""


class Log(Protocol):
    """Where packets go."""

    def write(self, packet: bytes) -> None:
        """Keep a packet; never waits."""


class Recorder:
    """Packs values and hands them to the logs. Times given are of the clock; packets carry mission time.

    A record that cannot be packed is counted and lost; it never fails the task that wrote it.

    Attributes:
        epoch_ns: the clock's time at mission time zero.
        lost: records whose values did not fit their packet.
        lost_text: why the newest of them did not fit.
    """

    def __init__(self, flight: Log, performance: Log) -> None:
        self._flight = flight
        self._performance = performance
        self._flight_packer = Packer()
        self._performance_packer = Packer()
        self._newest: dict[str, bytes] = {}
        self._events: deque[bytes] = deque(maxlen=_STATUS_EVENTS)
        self.epoch_ns = 0
        self.lost = 0
        self.lost_text = ""

    def record(self, packet: Packet, time_ns: int, **values: Any) -> bytes | None:
        """Write a packet to the flight log and return its bytes; None when its values do not fit."""
        packed = self._pack(self._flight_packer, packet, time_ns, values)
        if packed is not None:
            self._newest[packet.name] = packed
            self._flight.write(packed)
        return packed

    def status(self) -> bytes:
        """Return the newest packets that show how a flight stands, then its newest events, oldest first.

        Obeyed commands are left out of the events: who asks for the status would see its own question.
        """
        newest = [self._newest[packet.name] for packet in _STATUS if packet.name in self._newest]
        return b"".join([*newest, *self._events])

    def newest(self, packet: Packet) -> bytes:
        """Return the newest packet of a kind, empty when none was written."""
        return self._newest.get(packet.name, b"")

    def time(self, packet: Packet, time_ns: int, **values: Any) -> None:
        """Write a packet to the performance log."""
        packed = self._pack(self._performance_packer, packet, time_ns, values)
        if packed is not None:
            self._performance.write(packed)

    def event(self, kind: EventKind, time_ns: int, suppressed: int, text: str) -> None:
        """Write an event: the sink of `flight.loop.fdir.facts.EventLog`."""
        packed = self.record(
            EVENT,
            time_ns,
            code=kind.code,
            severity=int(kind.severity),
            suppressed=suppressed,
            name=kind.name,
            text=text,
        )
        if packed is not None and kind is not COMMANDED:
            self._events.append(packed)

    def _pack(self, packer: Packer, packet: Packet, time_ns: int, values: dict[str, Any]) -> bytes | None:
        try:
            return packer.pack(packet, time_ns - self.epoch_ns, values)
        except TelemetryError as error:
            self.lost += 1
            self.lost_text = str(error)
            return None
