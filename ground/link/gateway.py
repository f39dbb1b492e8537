"""Plain packets for a ground station that holds no keys: protected frames end here, in both directions.

A connection must begin with the gateway's token (`ground.link.command_stream`); a web page, which can open
connections to loopback too, does not know it. After the token the connection gets every telemetry packet,
live and played back, as a stream. A command packet that it sends, or a packet with a unit of a file's
transfer, gets its time and CRC and goes up in a protected frame. Its sequence count stays: by it the packets
`verification` name the command.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from ipaddress import IPv4Address

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from flight.link.process.station import host_port
from flight.link.telemetry.definitions import VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, crc16
from ground.link.command_stream import CommandStream, StreamError
from ground.link.terminal import Terminal, report_of
from knightcube.errors import UsageError

ADDRESS = "127.0.0.1:5013"

_VERIFIED = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")
_TIME = struct.Struct(">q")
_TIME_AT = HEADER_BYTES + 1
_UNSENT = 1 << 22
_SPI, _BLOCK = 1, 64
"""Counters are reserved by so many: a file is thousands of frames, a reservation two writes to the disk."""
_PIECE = 1 << 16
_AGAIN_S = 20.0
"""Between the gateway's own pings: by UDP the link forgets a sender after a minute."""
_TOKEN_S = 5.0
"""Time (s) after which a connection without the token is closed."""
_MOST_WITHOUT_TOKEN = 16
"""Maximum number of connections without the token; one more closes the oldest of them."""
_REPORT_S = 1.0
"""Minimum time (s) between two reports about connections without the token."""


@dataclass(slots=True)
class _Connection:
    """What has arrived on a connection, and what is to be sent; `opened` by the monotonic clock, s."""

    stream: CommandStream
    opened: float
    unsent: bytearray = field(default_factory=bytearray)


class Gateway:
    """Carries packets between a terminal and the connections of a listener. For one thread.

    Attributes:
        down: telemetry packets handed over.
        up: commands sent.
        refused: connections that were closed because they did not send the token, or sent a byte that no
            command packet has.
    """

    def __init__(
        self, terminal: Terminal, address: str, token: str, complain: Callable[[str], object]
    ) -> None:
        """Listen on HOST:PORT of loopback; `complain` gets each refusal in words. Raises UsageError."""
        self._terminal = terminal
        self._token = token
        self._reported = -_REPORT_S
        self._sealer = terminal.sealer(_SPI, _BLOCK)
        self._complain = complain
        self._packer = CommandPacker()
        self._asked_at: float | None = None
        self._own: set[int] = set()
        self._connections: dict[socket.socket, _Connection] = {}
        self.down = self.up = self.refused = 0
        try:
            host, port = host_port(address)
            if not IPv4Address(host).is_loopback:
                raise UsageError(f"{address}: plain packets are served on loopback only: give 127.0.0.1:PORT")
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError, ValueError) as error:
            raise UsageError(f"{address}: cannot be listened to: {error}") from error
        self._listener.setblocking(False)

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self._listener.getsockname()[1])

    def run(self, ended: Callable[[], bool]) -> None:
        """Carry until `ended` returns true. Raises FlightError where the line to the satellite is gone."""
        while not ended():
            self.turn(0.2)

    def turn(self, seconds: float) -> None:
        """Carry what there is, or comes within a time."""
        if self._asked_at is None or time.monotonic() - self._asked_at > _AGAIN_S:
            self._asked_at = time.monotonic()
            self._own.add(self._terminal.send_by(self._sealer, self._packer.pack(Ping(), utc_ns())))
        waiting = [line for line, connection in self._connections.items() if connection.unsent]
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
        for line, connection in self._without_token():
            if time.monotonic() - connection.opened > _TOKEN_S:
                self._refuse(line, f"it did not send the token within {_TOKEN_S:g} s")

    def close(self) -> None:
        """Close the listener and its connections; the terminal stays open."""
        for line in list(self._connections):
            self._drop(line)
        self._listener.close()

    def _hand_over(self, packet: bytes) -> None:
        if packet[:2] == _VERIFIED and report_of(packet).counter in self._own:
            return  # of our own ping, which no ground station has sent
        self.down += 1
        for line, connection in list(self._connections.items()):
            if connection.stream.authenticated:
                connection.unsent.extend(packet)
                self._flush(line)

    def _flush(self, line: socket.socket) -> None:
        unsent = self._connections[line].unsent
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
        try:
            for packet in self._connections[line].stream.packets(data):
                self._terminal.send_by(self._sealer, finished(packet, utc_ns()))
                self.up += 1
        except StreamError as error:
            self._refuse(line, str(error))

    def _accept(self) -> None:
        try:
            line, _ = self._listener.accept()
        except OSError:
            return
        line.setblocking(False)
        strangers = self._without_token()
        if len(strangers) >= _MOST_WITHOUT_TOKEN:
            self._refuse(strangers[0][0], f"{len(strangers)} others have not sent the token either")
        self._connections[line] = _Connection(CommandStream(self._token), time.monotonic())

    def _without_token(self) -> list[tuple[socket.socket, _Connection]]:
        """Return the connections that have not sent the token, the oldest first."""
        return [(line, one) for line, one in self._connections.items() if not one.stream.authenticated]

    def _refuse(self, line: socket.socket, reason: str) -> None:
        """Close a connection, count it and report why; a flood of strangers is reported once a second."""
        self.refused += 1
        now = time.monotonic()
        if self._connections[line].stream.authenticated or now - self._reported > _REPORT_S:
            self._reported = now
            self._complain(f"connection closed: {reason} (closed so far: {self.refused})")
        self._drop(line)

    def _drop(self, line: socket.socket) -> None:
        self._connections.pop(line, None)
        line.close()


def finished(packet: bytes, now_ns: int) -> bytes:
    """Return a command packet with its time and its CRC, which a ground station leaves at 0."""
    body = packet[:_TIME_AT] + _TIME.pack(now_ns) + packet[_TIME_AT + _TIME.size : -CRC_BYTES]
    return body + crc16(body).to_bytes(CRC_BYTES, "big")
