"""Gateway between ground station software, which has no keys, and a protected link.

A connection must begin with the token of the gateway, because web pages can also connect to loopback but do
not know the token. After the token the connection receives every telemetry packet, live and played back, as a
stream. The gateway adds time and CRC to each command packet or file transfer packet from the connection and
sends it in a protected frame. The gateway keeps the sequence count of a command packet, because
`verification` packets identify a command by this count.
"""

from __future__ import annotations

import hmac
import math
import os
import secrets
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from pathlib import Path

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from flight.link.files.units import PACKET_VERSION, UP
from flight.link.frames import LONGEST_FRAME
from flight.link.process.commanding import request_of
from flight.link.process.directives import LONGEST_IN_PORTIONS
from flight.link.process.station import host_port
from flight.link.telemetry.definitions import VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, SECONDARY_BYTES, crc16
from ground.link.terminal import FRAME_OVERHEAD_BYTES, PORTS, Terminal, report_of
from ground.xtce import TELECOMMANDS
from knightcube.errors import KnightCubeError, UsageError, reason_of

ADDRESS = "127.0.0.1:5013"

_VERIFIED = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")
_UNIT = UP.to_bytes(2, "big")  # first two bytes of a packet of a file transfer
_TIME = struct.Struct(">q")
_TIME_AT = HEADER_BYTES + 1
_MAX_UNSENT = 1 << 22  # number of unsent bytes above which a connection is closed
_SPI, _BLOCK = 1, 64
"""Security parameter index of the gateway's key, and number of frame counters that are reserved at once."""
_READ_BYTES = 1 << 16
_PING_PERIOD_S = 20.0
"""Time (s) between the gateway's own pings, because the link forgets a UDP sender after a minute."""
_KEPT_PINGS = 64  # number of the gateway's newest pings whose reports are not relayed
_FAILURE_S = 60.0  # time (s) without a failure after which the same failure of the line is reported again
_RETRY_S = 2.0  # time (s) from a failure of the line to the next ping, which opens a lost stream again
_ACCEPT_PAUSE_S = 1.0  # time (s) without accepting connections after a failure, such as too many open files
_TOKEN_S = 5.0  # time (s) after which a connection without the token is closed
_MOST_WITHOUT_TOKEN = 256
"""Maximum number of connections that have not sent the token; a further connection closes the oldest."""
_REPORT_S = 1.0  # minimum time (s) between two reports about connections without the token
_TOKEN_CHARACTERS = b"0123456789abcdef"
_TOKEN_BYTES = 32
_CHECKED_BYTES = HEADER_BYTES + 1
"""Number of header bytes that are checked: primary header, and version of the packet definition."""
_UNSEGMENTED = 0b11
_LONGEST_PACKET = LONGEST_FRAME - FRAME_OVERHEAD_BYTES
_SHORTEST_UNIT = HEADER_BYTES + SECONDARY_BYTES + 1 + CRC_BYTES


class StreamError(KnightCubeError):
    """Error for a byte that belongs neither to the token nor to a command packet."""


@dataclass(frozen=True, slots=True)
class _HeaderForm:
    """Header of a packet type: first 16 bits, minimum and maximum length of the packet, and version."""

    identifier: bytes
    shortest: int
    longest: int
    version: int

    def begins(self, header: bytes) -> bool:
        """Return whether a packet of this type can begin with the bytes `header`."""
        if header[:2] != self.identifier[: len(header)]:
            return False
        if len(header) > 2 and header[2] >> 6 != _UNSEGMENTED:
            return False
        if len(header) > 4:
            low, high = (bound - HEADER_BYTES - 1 for bound in (self.shortest, self.longest))
            stated = header[4:HEADER_BYTES]
            if not low.to_bytes(2, "big")[: len(stated)] <= stated <= high.to_bytes(2, "big")[: len(stated)]:
                return False
        return len(header) <= HEADER_BYTES or header[HEADER_BYTES] == self.version


_HEADER_FORMS = (
    *(
        _HeaderForm(layout.identifier.to_bytes(2, "big"), layout.length, layout.length, layout.packet.version)
        for layout in TELECOMMANDS.values()
    ),
    _HeaderForm(_UNIT, _SHORTEST_UNIT, _LONGEST_PACKET, PACKET_VERSION),
)


def new_token() -> str:
    """Return a random token: 64 hexadecimal digits."""
    return secrets.token_hex(_TOKEN_BYTES)


class CommandStream:
    """Decoder that splits the bytes of a connection into command packets and checks each byte as it arrives.

    A byte that cannot belong to the token or a command packet at its position ends the connection. Another
    protocol, such as HTTP from a web page, is therefore refused at its first byte. The token is compared in
    constant time after the whole token has arrived. Closing a connection at the first wrong character would
    reveal the token character by character.

    Attributes:
        authenticated: whether the correct token has arrived.
    """

    def __init__(self, token: str) -> None:
        """Create a decoder that expects a line with the token before the packets."""
        self._line = token.encode("ascii") + b"\n"
        self._arrived = bytearray()
        self.authenticated = False

    def packets(self, data: bytes) -> Iterator[bytes]:
        """Yield the command packets that are complete after `data`. Raises StreamError at an invalid byte."""
        self._arrived += data
        if not self.authenticated and not self._take_token():
            return
        while (length := self._checked_length()) is not None and len(self._arrived) >= length:
            packet = bytes(self._arrived[:length])
            del self._arrived[:length]
            yield packet

    def _take_token(self) -> bool:
        """Return whether the line with the token has arrived completely; the line is then removed."""
        size = len(self._line)
        line = bytes(self._arrived[:size])
        if any(byte not in _TOKEN_CHARACTERS for byte in line[: size - 1]):
            raise StreamError("the first bytes of the connection are not the token")
        if len(line) < size:
            return False
        if not hmac.compare_digest(line, self._line):
            raise StreamError("the first bytes of the connection are not the token")
        del self._arrived[:size]
        self.authenticated = True
        return True

    def _checked_length(self) -> int | None:
        """Return the length of the next packet, or None while its header is incomplete."""
        header = bytes(self._arrived[:_CHECKED_BYTES])
        for end in range(1, len(header) + 1):
            if not any(form.begins(header[:end]) for form in _HEADER_FORMS):
                raise StreamError(f"no command packet has 0x{header[end - 1]:02x} as its byte {end}")
        if len(header) < _CHECKED_BYTES:
            return None
        return HEADER_BYTES + 1 + int.from_bytes(header[4:HEADER_BYTES], "big")


def token_path(keys: Path, port: int) -> Path:
    """Return the path of the file in which local programs find the token of a gateway."""
    return keys / f"gateway-{port}.token"


@contextmanager
def token_file(path: Path, token: str) -> Iterator[None]:
    """Write a token to a file that only its user can read, and remove the file at the end.

    An old file of a gateway that was killed is replaced. Raises KnightCubeError if the file cannot be
    written.
    """
    new = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        new.unlink(missing_ok=True)
        file = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(file, "w", encoding="ascii") as out:
            out.write(f"{token}\n")
        new.replace(path)
    except OSError as error:
        raise KnightCubeError(f"{path}: the token cannot be written: {reason_of(error)}") from error
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()


@dataclass(slots=True)
class _StationConnection:
    """State of a connection, with its unsent bytes and its opening time on the monotonic clock, s."""

    stream: CommandStream
    opened: float
    unsent: bytearray = field(default_factory=bytearray)


class Gateway:
    """Relay of packets between a terminal and the connections of a listener, for use by one thread.

    Attributes:
        down: number of telemetry packets relayed.
        up: number of commands sent.
        refused: number of connections closed for a missing token or an invalid byte.
    """

    def __init__(
        self, terminal: Terminal, address: str, token: str, complain: Callable[[str], object]
    ) -> None:
        """Listen on the loopback address HOST:PORT, and report refusals by `complain`. Raises UsageError."""
        self._terminal = terminal
        self._token = token
        self._reported = -_REPORT_S
        self._sealer = terminal.sealer(_SPI, _BLOCK)
        self._complain = complain
        self._packer = CommandPacker()
        self._asked_at: float | None = None
        self._own: deque[int] = deque(maxlen=_KEPT_PINGS)  # counters of the gateway's own pings
        self._failure, self._failed_at = "", -math.inf  # reason and time of the line's last failure
        self._accept_at = -math.inf  # time from which connections are accepted
        self._connections: dict[socket.socket, _StationConnection] = {}
        self.down = self.up = self.refused = 0
        try:
            host, port = host_port(address)
            if not 0 <= port < PORTS:
                raise UsageError(f"{address}: the port must be 0 to {PORTS - 1}")
            if not IPv4Address(host).is_loopback:
                raise UsageError(f"{address}: plain packets are served on loopback only: give 127.0.0.1:PORT")
            self._listener = socket.create_server((host, port))
        except ValueError as error:
            raise UsageError(f"{address}: give 127.0.0.1:PORT") from error
        except OSError as error:
            problem = f"cannot listen there: {error.strerror or error}"
            raise UsageError(f"{address}: {problem}: give another port by --serve") from error
        self._listener.setblocking(False)

    @property
    def port(self) -> int:
        """Port of the listener."""
        return int(self._listener.getsockname()[1])

    def run(self, ended: Callable[[], bool]) -> None:
        """Relay packets until `ended` returns true."""
        while not ended():
            self.turn(0.2)

    def turn(self, seconds: float) -> None:
        """Relay the packets that are received within `seconds` s."""
        if self._asked_at is None or time.monotonic() - self._asked_at > _PING_PERIOD_S:
            self._asked_at = time.monotonic()
            with suppress(KnightCubeError):
                self._own.append(self._send(self._packer.pack(Ping(), utc_ns())))
        waiting = [line for line, connection in self._connections.items() if connection.unsent]
        reading: list[Terminal | socket.socket] = [self._terminal, *self._connections]
        if time.monotonic() >= self._accept_at:  # otherwise `select` would return at once
            reading.append(self._listener)
        ready, writable, _ = select.select(reading, waiting, [], seconds)
        if self._terminal in ready:
            try:
                for _, packet in self._terminal.take():
                    self._hand_over(packet)
            except KnightCubeError as error:
                self._note_failure(str(error))
        if self._listener in ready:
            self._accept()
        for line in [line for line in ready if line in self._connections]:
            self._receive(line)
        for line in [line for line in writable if line in self._connections]:
            self._flush(line)
        for line, connection in self._without_token():
            if time.monotonic() - connection.opened > _TOKEN_S:
                self._refuse(line, f"the client did not send the token within {_TOKEN_S:g} s")

    def close(self) -> None:
        """Close the listener and its connections; the terminal stays open."""
        for line in list(self._connections):
            self._drop(line)
        self._listener.close()

    def _send(self, packet: bytes) -> int:
        """Send a packet and return its frame counter.

        Raises KnightCubeError if the network, the line or the disk of the counters fails for a while.
        """
        try:
            return self._terminal.send_by(self._sealer, packet)
        except KnightCubeError as error:
            self._note_failure(f"commands and pings are not sent: {error}")
            raise

    def _note_failure(self, reason: str) -> None:
        """Try the line again soon. Each reason is reported once, and again if it returns after a minute."""
        now = time.monotonic()
        self._asked_at = now - _PING_PERIOD_S + _RETRY_S
        if reason != self._failure or now - self._failed_at > _FAILURE_S:
            self._complain(reason)
        self._failure, self._failed_at = reason, now

    def _hand_over(self, packet: bytes) -> None:
        if packet[:2] == _VERIFIED:
            report = report_of(packet)
            if report is not None and report.spi == _SPI and report.counter in self._own:
                return  # reports on the gateway's own pings are not relayed
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
        if len(unsent) > _MAX_UNSENT:
            self._complain("a ground station does not read its packets: disconnected")
            self._drop(line)

    def _receive(self, line: socket.socket) -> None:
        try:
            data = line.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(line)
            return
        try:
            for packet in self._connections[line].stream.packets(data):
                most = max(self._terminal.packet_bytes, LONGEST_IN_PORTIONS)
                if len(packet) > most:
                    raise StreamError(f"a packet has {len(packet)} bytes; the link carries {most}")
                try:
                    counter = self._send(finished(packet, utc_ns()))
                except KnightCubeError as error:
                    if packet[:2] != _UNIT:  # a file transfer repeats lost packets
                        self._complain(f"{_title(packet)} was not sent: {error}; send it again")
                    continue
                if counter in self._own:  # possible after a key change, when counters restart at 0
                    self._own.remove(counter)
                self.up += 1
        except StreamError as error:
            self._refuse(line, str(error))

    def _accept(self) -> None:
        try:
            line, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):  # the client has closed the connection
            return
        except OSError as error:
            now = time.monotonic()
            if now - self._accept_at > _FAILURE_S:
                self._complain(f"connections cannot be accepted: {reason_of(error)}")
            self._accept_at = now + _ACCEPT_PAUSE_S
            return
        line.setblocking(False)
        strangers = self._without_token()
        if len(strangers) >= _MOST_WITHOUT_TOKEN:
            self._refuse(strangers[0][0], f"{len(strangers)} connections have not sent the token")
        self._connections[line] = _StationConnection(CommandStream(self._token), time.monotonic())

    def _without_token(self) -> list[tuple[socket.socket, _StationConnection]]:
        """Return the connections that have not sent the token, oldest first."""
        return [(line, one) for line, one in self._connections.items() if not one.stream.authenticated]

    def _refuse(self, line: socket.socket, reason: str) -> None:
        """Close and count a connection. Those that sent no token are reported at most once a second."""
        self.refused += 1
        now = time.monotonic()
        if self._connections[line].stream.authenticated or now - self._reported > _REPORT_S:
            self._reported = now
            self._complain(f"connection closed: {reason} (closed so far: {self.refused})")
        self._drop(line)

    def _drop(self, line: socket.socket) -> None:
        self._connections.pop(line, None)
        line.close()


def _title(packet: bytes) -> str:
    """Return the name and the sequence count of a command packet."""
    request = request_of(packet)
    name = next(name for name, layout in TELECOMMANDS.items() if layout.identifier == request.packet)
    return f"command {name} with sequence count {request.sequence}"


def finished(packet: bytes, now_ns: int) -> bytes:
    """Return a command packet with the time and CRC set, which a ground station leaves at 0."""
    body = packet[:_TIME_AT] + _TIME.pack(now_ns) + packet[_TIME_AT + _TIME.size : -CRC_BYTES]
    return body + crc16(body).to_bytes(CRC_BYTES, "big")
