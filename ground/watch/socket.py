"""A flight that listens, asked for its mode by pings."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from flight.app.utc_label import utc_ns
from flight.gnc.errors import FlightError, UsageError
from flight.link.commands.codec import CommandPacker, Ping
from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import TelemetryError
from ground.commands.command import exchange
from ground.telemetry.scanner import decode
from ground.watch.view import mode_label

_TIMEOUT_S = 2.0


@dataclass(frozen=True, slots=True)
class Answer:
    """A flight's answer to a ping: its mode, its commands since start, and after how long it came, s."""

    mode: str
    count: int
    delay: float


def answers(to: str, patience: float, ended: threading.Event) -> Iterator[Answer]:
    """Yield the answers to pings; ends once none has come for `patience` s. Raises UsageError."""
    packer, heard = CommandPacker(), time.monotonic()
    while not ended.is_set():
        asked = time.monotonic()
        try:
            raw = exchange(
                to, packer.pack(Ping(int(asked * 1e3) & 0xFFFFFFFF), utc_ns()), min(_TIMEOUT_S, patience)
            )
            (row,) = decode(raw)[COMMAND.name]
        except UsageError:
            raise
        except (FlightError, TelemetryError, ValueError):
            if time.monotonic() - heard > patience or ended.wait(min(1.0, patience)):
                return
            continue
        heard = time.monotonic()
        yield Answer(mode_label(int(row["mode"])), int(row["count"]), heard - asked)
