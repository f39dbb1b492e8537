"""A flight seen and commanded by its link: telemetry out of protected frames, commands with their stages."""

from __future__ import annotations

import threading
import time

import numpy as np

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from flight.link.process.commanding import Report, Stage
from flight.link.process.directives import LIST
from flight.link.process.downlink import LIVE
from flight.link.telemetry.definitions import VERIFICATION
from flight.link.telemetry.packets import PacketArray
from ground.console.commanding import Object
from ground.link.commanding import obeyed
from ground.link.terminal import Terminal, report_of
from ground.telemetry import scan
from knightcube.errors import FlightError

_LISTEN_S = 0.02
_ASK_AFTER_S = 2.0
"""After so long without telemetry a ping asks for it: by UDP the link forgets a sender after a minute."""
_ANSWER_S = 5.0
_KEPT_REPORTS = 64
_SPI = 1


class LinkFeed:
    """Owns the terminal. `new` is called by one thread, `send` by others; between them stands a lock.

    Playback is not shown: its packets are of another time than the live ones.
    """

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal
        self._lock = threading.Lock()
        self._packer = CommandPacker()
        self._reports: dict[int, list[Report]] = {}
        self._heard = time.monotonic()
        self._asked = -np.inf

    @property
    def silence(self) -> float:
        """How long no telemetry has come, s."""
        return time.monotonic() - self._heard

    def new(self) -> dict[str, PacketArray]:
        """Return the packets by name that came since the last call. Raises FlightError."""
        with self._lock:
            now = time.monotonic()
            if now - max(self._heard, self._asked) > _ASK_AFTER_S or self._asked < 0.0:
                self._asked = now
                self._terminal.send(self._packer.pack(Ping(), utc_ns()), _SPI)
            came = [packet for channel, packet in self._terminal.packets(_LISTEN_S) if channel == LIVE]
        if came:
            self._heard = time.monotonic()
        found = scan(b"".join(came)).packets
        for row in found[VERIFICATION.name]:
            self._keep(report_of(row.tobytes()))
        return found

    def send(self, packet: bytes) -> Object:
        """Send a command; return what became of it so far. Raises FlightError without an answer."""
        with self._lock:
            counter = self._terminal.send(packet, _SPI)
        until = time.monotonic() + _ANSWER_S
        while time.monotonic() < until:
            reports = list(self._reports.get(counter, ()))
            if reports and reports[-1].stage is not Stage.ACCEPTED:
                return {"obeyed": int(obeyed(reports)), "text": _text(reports), "counter": counter}
            time.sleep(0.02)
        raise FlightError(f"no answer by the link within {_ANSWER_S:g} s")

    def close(self) -> None:
        """Store the counters and close the line."""
        self._terminal.close()

    def _keep(self, report: Report) -> None:
        if report.spi == _SPI:
            self._reports.setdefault(report.counter, []).append(report)
            while len(self._reports) > _KEPT_REPORTS:
                del self._reports[next(iter(self._reports))]


def _text(reports: list[Report]) -> str:
    """Return the newest text, of a list all lines."""
    listed = reports[1:] if reports[-1].name == LIST.name else reports[-1:]
    return "; ".join(report.text for report in listed)
