"""The flight application's pen: packets into the flight log, timing into a performance log of its own.

Measured execution times depend on the machine, so they stand apart: the flight log of a lock-step run is the
same bit for bit each time.
"""

from __future__ import annotations

from typing import Any, Protocol

from flight.link.events import EventKind
from flight.link.telemetry.definitions import EVENT
from flight.link.telemetry.form import Packet
from flight.link.telemetry.packets import Packer


class Log(Protocol):
    """Where packets go."""

    def write(self, packet: bytes) -> None:
        """Keep a packet; never waits."""


class Recorder:
    """Packs values and hands them to the logs. Times given are of the clock; packets carry mission time."""

    def __init__(self, flight: Log, performance: Log) -> None:
        self._flight = flight
        self._performance = performance
        self._flight_packer = Packer()
        self._performance_packer = Packer()
        self.epoch_ns = 0

    def record(self, packet: Packet, time_ns: int, **values: Any) -> None:
        """Write a packet to the flight log."""
        self._flight.write(self._flight_packer.pack(packet, time_ns - self.epoch_ns, values))

    def time(self, packet: Packet, time_ns: int, **values: Any) -> None:
        """Write a packet to the performance log."""
        self._performance.write(self._performance_packer.pack(packet, time_ns - self.epoch_ns, values))

    def event(self, kind: EventKind, time_ns: int, suppressed: int, text: str) -> None:
        """Write an event: the sink of `flight.loop.fdir.event_log.EventLog`."""
        self.record(
            EVENT,
            time_ns,
            code=kind.code,
            severity=int(kind.severity),
            suppressed=suppressed,
            name=kind.name,
            text=text,
        )
