"""Plain packets for a ground station that holds no keys: protected frames end here, in both directions.

Whoever connects on loopback gets every telemetry packet, live and played back, as a stream; a command packet
that comes in, or one with a unit of a file's transfer, gets its time and CRC and goes up in a protected
frame. Its sequence count stays: by it the packets `verification` name the command.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Callable
from ipaddress import IPv4Address

from flight.app.utc_label import utc_ns
from flight.link.commands.codec import CommandPacker
from flight.link.commands.values import Ping
from flight.link.files.packets import UP, is_unit
from flight.link.process.lines import host_port
from flight.link.telemetry.link_definitions import VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, crc16
from ground.link.terminal import Terminal, report_of
from ground.xtce import TELECOMMANDS
from knightcube.errors import UsageError

ADDRESS = "127.0.0.1:5013"

_VERIFIED = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")
_COMMANDS = {layout.identifier: layout for layout in TELECOMMANDS.values()}
_TIME = struct.Struct(">q")
_TIME_AT = HEADER_BYTES + 1
_UNSENT = 1 << 22
_SPI, _BLOCK = 1, 64
"""Counters are reserved by so many: a file is thousands of frames, a reservation two writes to the disk."""
_PIECE = 1 << 16
_AGAIN_S = 20.0
"""Between the gateway's own pings: by UDP the link forgets a sender after a minute."""


class Gateway:
    """Carries packets between a terminal and the connections of a listener. For one thread.

    Attributes:
        down: telemetry packets handed over.
        up: commands sent.
    """

    def __init__(self, terminal: Terminal, address: str, complain: Callable[[str], object]) -> None:
        """Listen on HOST:PORT of loopback; `complain` gets each refusal in words. Raises UsageError."""
        self._terminal = terminal
        self._sealer = terminal.sealer(_SPI, _BLOCK)
        self._complain = complain
        self._packer = CommandPacker()
        self._asked_at: float | None = None
        self._own: set[int] = set()
        self._connections: dict[socket.socket, tuple[bytearray, bytearray]] = {}  # came, unsent
        self.down = self.up = 0
        try:
            host, port = host_port(address)
            if not IPv4Address(host).is_loopback:
                raise UsageError(f"{address}: whoever connects commands the satellite: loopback only")
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError, ValueError) as error:
            raise UsageError(f"{address}: cannot be listened to: {error}") from error
        self._listener.setblocking(False)

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self._listener.getsockname()[1])

    @property
    def connected(self) -> int:
        """How many ground stations there are."""
        return len(self._connections)

    def run(self, ended: Callable[[], bool]) -> None:
        """Carry until `ended` returns true. Raises FlightError where the line to the satellite is gone."""
        while not ended():
            self.turn(0.2)

    def turn(self, seconds: float) -> None:
        """Carry what there is, or comes within a time."""
        if self._asked_at is None or time.monotonic() - self._asked_at > _AGAIN_S:
            self._asked_at = time.monotonic()
            self._own.add(self._terminal.send_by(self._sealer, self._packer.pack(Ping(), utc_ns())))
        waiting = [line for line, (_, unsent) in self._connections.items() if unsent]
        reading: list[Terminal | socket.socket] = [self._terminal, self._listener, *self._connections]
        ready, writable, _ = select.select(reading, waiting, [], seconds)
        if self._terminal in ready:
            for _, packet in self._terminal.take():
                self._hand_over(packet)
        if self._listener in ready:
            self._accept()
        for line in [line for line in ready if line in self._connections]:
            self._receive(line)
        for line in [line for line in writable if line in self._connections]:
            self._flush(line)

    def close(self) -> None:
        """Close the listener and its connections; the terminal stays open."""
        for line in list(self._connections):
            self._drop(line)
        self._listener.close()

    def _hand_over(self, packet: bytes) -> None:
        if packet[:2] == _VERIFIED and report_of(packet).counter in self._own:
            return  # of our own ping, which no ground station has sent
        self.down += 1
        for line, (_, unsent) in list(self._connections.items()):
            unsent.extend(packet)
            self._flush(line)

    def _flush(self, line: socket.socket) -> None:
        unsent = self._connections[line][1]
        try:
            del unsent[: line.send(unsent) if unsent else 0]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(line)
        if len(unsent) > _UNSENT:
            self._complain("a ground station does not read: disconnected")
            self._drop(line)

    def _receive(self, line: socket.socket) -> None:
        try:
            data = line.recv(_PIECE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(line)
            return
        came = self._connections[line][0]
        came += data
        while len(came) >= HEADER_BYTES:
            length = HEADER_BYTES + 1 + int.from_bytes(came[4:HEADER_BYTES], "big")
            if len(came) < length:
                return
            packet = bytes(came[:length])
            del came[:length]
            self._send(packet)

    def _send(self, packet: bytes) -> None:
        layout = _COMMANDS.get(int.from_bytes(packet[:2], "big"))
        if not is_unit(packet, UP) and (layout is None or len(packet) != layout.length):
            self._complain(f"{len(packet)} bytes that begin with {packet[:2].hex()} are no command: not sent")
            return
        self._terminal.send_by(self._sealer, finished(packet, utc_ns()))
        self.up += 1

    def _accept(self) -> None:
        try:
            line, _ = self._listener.accept()
        except OSError:
            return
        line.setblocking(False)
        self._connections[line] = (bytearray(), bytearray())

    def _drop(self, line: socket.socket) -> None:
        self._connections.pop(line, None)
        line.close()


def finished(packet: bytes, now_ns: int) -> bytes:
    """Return a command packet with its time and its CRC, which a ground station leaves at 0."""
    body = packet[:_TIME_AT] + _TIME.pack(now_ns) + packet[_TIME_AT + _TIME.size : -CRC_BYTES]
    return body + crc16(body).to_bytes(CRC_BYTES, "big")
