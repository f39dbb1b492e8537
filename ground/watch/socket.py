"""A flight that listens, asked by pings how it stands."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from flight.link.telemetry.definitions import COMMAND, EVENT
from flight.link.telemetry.packets import PacketArray, TelemetryError
from ground.commands.command import exchange
from ground.telemetry import decode
from knightcube.errors import FlightError, UsageError

_TIMEOUT_S = 2.0


@dataclass(frozen=True, slots=True)
class Answer:
    """A flight's answer to a ping: packets by name, its commands since start, and how long it took, s.

    Of events, the packets are those that no earlier answer had.
    """

    packets: Mapping[str, PacketArray]
    count: int
    delay: float


def answers(to: str, patience: float, ended: threading.Event) -> Iterator[Answer]:
    """Yield the answers to pings; ends once none has come for `patience` s. Raises UsageError."""
    packer, heard, shown_ns = CommandPacker(), time.monotonic(), -1
    while not ended.is_set():
        asked = time.monotonic()
        try:
            raw = exchange(
                to, packer.pack(Ping(int(asked * 1e3) & 0xFFFFFFFF), utc_ns()), min(_TIMEOUT_S, patience)
            )
            packets = decode(raw)
            (row,) = packets[COMMAND.name]
        except UsageError:
            raise
        except (FlightError, TelemetryError, ValueError):
            if time.monotonic() - heard > patience or ended.wait(min(1.0, patience)):
                return
            continue
        heard = time.monotonic()
        came = packets[EVENT.name]
        packets[EVENT.name] = came[came["time_ns"] > shown_ns]
        shown_ns = max([shown_ns, *came["time_ns"].tolist()])
        yield Answer(packets, int(row["count"]), heard - asked)
