"""Lines that carry frames: UDP, TCP and serial. No call waits, and a flood of frames is read in portions."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from ipaddress import IPv4Address, IPv4Network
from typing import Any, Protocol

from flight.link.frames.stream import SYNC, FrameStream, telecommand_stream
from flight.link.frames.telecommand import LONGEST_FRAME
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import SerialPort
from knightcube.errors import UsageError

AT_MOST = 512
"""Maximum number of frames read from a line per call, so that a flood does not delay the telemetry."""

_BUFFER = 1 << 20
_HEARD_NS = 60_000_000_000
_CONNECTIONS = 4
_UNSENT = 1 << 18
_PIECE = 1 << 14


class Line(Protocol):
    """Interface of a line to the ground."""

    name: str

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the received frames, each with its sender, oldest first. Never raises."""

    def trust(self, sender: Any, now_ns: int) -> None:
        """Record that an authentic frame came from a sender."""

    def send(self, frames: Sequence[bytes], now_ns: int) -> None:
        """Send frames to all listeners. Never raises."""

    def close(self) -> None:
        """Close. Safe to call twice."""


class UdpLine:
    """UDP line with one frame per datagram.

    Telemetry is sent to the fixed address and, for a minute, to each sender of an authentic frame.
    """

    def __init__(
        self, address: str, to: str | None = None, peers: Sequence[IPv4Network] | None = None
    ) -> None:
        """Bind HOST:PORT; if `peers` is given, frames of other senders are ignored. Raises UsageError."""
        self.name = f"UDP {address}"
        self._peers = peers
        self._fixed = None if to is None else host_port(to)
        self._heard: dict[Any, int] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.setblocking(False)
        try:
            self._socket.bind(host_port(address))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise UsageError(f"link.udp: {address} cannot be listened to: {error}") from error

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self._socket.getsockname()[1])

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the received datagrams, cut to one byte more than the longest frame."""
        found = []
        for _ in range(AT_MOST):
            try:
                data, sender = self._socket.recvfrom(LONGEST_FRAME + 1)
            except BlockingIOError:
                break
            except OSError:  # a listener that is gone answered by ICMP
                continue
            if self._peers is None or any(IPv4Address(sender[0]) in peers for peers in self._peers):
                found.append((data, sender))
        return found

    def trust(self, sender: Any, now_ns: int) -> None:
        """Send telemetry to this sender for a minute."""
        self._heard[sender] = now_ns

    def send(self, frames: Sequence[bytes], now_ns: int) -> None:
        """Send a datagram for each frame to each listener."""
        self._heard = {who: at for who, at in self._heard.items() if now_ns - at < _HEARD_NS}
        fixed = () if self._fixed is None or self._fixed in self._heard else (self._fixed,)
        for listener in (*fixed, *self._heard):
            for frame in frames:
                with contextlib.suppress(OSError):
                    self._socket.sendto(frame, listener)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpLine:
    """TCP server with a stream of marked frames per connection; a fifth connection replaces the oldest."""

    def __init__(self, address: str, peers: Sequence[IPv4Network] | None = None) -> None:
        """Listen at HOST:PORT; if `peers` is given, only they may connect. Raises UsageError."""
        self.name = f"TCP {address}"
        self._peers = peers
        self._connections: dict[socket.socket, tuple[FrameStream, bytearray]] = {}
        try:
            self._listener = socket.create_server(host_port(address))
        except (OSError, OverflowError) as error:
            raise UsageError(f"link.tcp: {address} cannot be listened to: {error}") from error
        self._listener.setblocking(False)

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self._listener.getsockname()[1])

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the frames received from all connections."""
        self._accept()
        found: list[tuple[bytes, Any]] = []
        for connection, (stream, _) in list(self._connections.items()):
            try:
                data = connection.recv(_PIECE)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if not data:
                self._drop(connection)
                continue
            found += [(frame, connection) for frame in stream.add(data)]
        return found

    def trust(self, sender: Any, now_ns: int) -> None:
        """Do nothing, because each connection receives the telemetry."""

    def send(self, frames: Sequence[bytes], now_ns: int) -> None:
        """Send frames to all connections, and close a connection that does not read them."""
        marked = b"".join(SYNC + frame for frame in frames)
        for connection, (_, unsent) in list(self._connections.items()):
            unsent.extend(marked)
            try:
                del unsent[: connection.send(unsent) if unsent else 0]
            except BlockingIOError:
                pass
            except OSError:
                self._drop(connection)
                continue
            if len(unsent) > _UNSENT:
                self._drop(connection)

    def close(self) -> None:
        """Close all connections and the listening socket."""
        for connection in list(self._connections):
            self._drop(connection)
        self._listener.close()

    def _accept(self) -> None:
        for _ in range(_CONNECTIONS):
            try:
                connection, (host, _) = self._listener.accept()
            except OSError:
                return
            if self._peers is not None and not any(IPv4Address(host) in peers for peers in self._peers):
                connection.close()
                continue
            connection.setblocking(False)
            if len(self._connections) == _CONNECTIONS:
                self._drop(next(iter(self._connections)))
            self._connections[connection] = (telecommand_stream(), bytearray())

    def _drop(self, connection: socket.socket) -> None:
        self._connections.pop(connection, None)
        connection.close()


class SerialLine:
    """Stream of marked frames on a serial port, to a radio or a modem."""

    def __init__(self, name: str, port: SerialPort) -> None:
        """Take an open port, which reopens by itself."""
        self.name = name
        self._port = port
        self._stream = telecommand_stream()

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the received frames, or an empty list if the port is lost."""
        try:
            pieces = self._port.receive()
        except DeviceError:
            return []
        return [(frame, None) for _, data in pieces for frame in self._stream.add(data)]

    def trust(self, sender: Any, now_ns: int) -> None:
        """Do nothing, because a serial line has only one other end."""

    def send(self, frames: Sequence[bytes], now_ns: int) -> None:
        """Send marked frames; frames are lost while the port is lost."""
        with contextlib.suppress(DeviceError):
            if frames:
                self._port.send(b"".join(SYNC + frame for frame in frames))

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def host_port(address: str) -> tuple[str, int]:
    """Return host and port of HOST:PORT. The caller has checked the form."""
    host, _, port = address.rpartition(":")
    return host, int(port)
