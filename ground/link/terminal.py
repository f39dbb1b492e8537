"""The ground's end of a link: sends protected commands, receives telemetry and what became of a command."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import serial

from flight.link.frames import (
    SYNC,
    TELECOMMAND_HEADER,
    TELECOMMAND_MASK,
    TELEMETRY_MASK,
    FrameStream,
    PacketAssembler,
    TelecommandHeader,
    close_frame,
    open_telemetry,
    telemetry_stream,
)
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.station import host_port
from flight.link.security import OVERHEAD_BYTES, TELEMETRY_SPIS, Gate, RefusedError, Sealer, Vault
from flight.link.telemetry.definitions import VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, to_text
from flight.schema.sections import Link
from knightcube.errors import FlightError, UsageError

DEFAULTS = Link(keys="-")
"""Spacecraft and length of frames where nobody says otherwise."""

_STORE_EVERY = 256
_ANY_AHEAD = 2**63
_PIECE = 1 << 16


@dataclass(frozen=True, slots=True)
class TerminalSettings:
    """What both ends must agree on: spacecraft identifier, bytes of each telemetry frame."""

    spacecraft: int = DEFAULTS.spacecraft
    frame_bytes: int = DEFAULTS.frame_bytes


class GroundLine(Protocol):
    """A way to the satellite."""

    def fileno(self) -> int:
        """Return the descriptor to wait for."""

    def receive(self) -> list[bytes]:
        """Return the frames that came. Raises FlightError where the line is gone."""

    def send(self, frame: bytes) -> None:
        """Send a frame. Raises FlightError."""

    def close(self) -> None:
        """Close."""


class Terminal:
    """The ground's end. For one thread.

    Attributes:
        lost_frames: telemetry frames that the counts say are missing.
        gate: which telemetry frames were let in, and why others were not.
    """

    def __init__(self, line: GroundLine, vault: Vault, settings: TerminalSettings) -> None:
        """Take an open line and the ground's keys."""
        self._line = line
        self._vault = vault
        self._settings = settings
        self._sequence = 0
        self._sealers: dict[int, Sealer] = {}
        self._channels: dict[int, PacketAssembler] = {}
        self.gate = Gate(vault, TELEMETRY_SPIS, self._parse, TELEMETRY_MASK, _ANY_AHEAD, _STORE_EVERY)

    @property
    def lost_frames(self) -> int:
        """Frames that are missing between those that came."""
        return sum(channel.lost_frames for channel in self._channels.values())

    def fileno(self) -> int:
        """Return the line's descriptor, to wait for."""
        return self._line.fileno()

    def send(self, packet: bytes, spi: int = 1) -> int:
        """Send a command packet; return the counter of its frame. Raises FlightError."""
        sealer = self._sealers.setdefault(spi, Sealer(self._vault, spi, TELECOMMAND_MASK))
        return self.send_by(sealer, packet)

    def sealer(self, spi: int, block: int) -> Sealer:
        """Return what protects frames to be sent by `send_by`, with `block` counters reserved at once."""
        return Sealer(self._vault, spi, TELECOMMAND_MASK, block)

    def send_by(self, sealer: Sealer, packet: bytes) -> int:
        """Send a command packet under the key of a sealer."""
        header = TelecommandHeader(self._settings.spacecraft, 0, self._sequence)
        length = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + len(packet) + CRC_BYTES
        body, counter = sealer.seal(header.pack(length), packet)
        self._sequence += 1
        self._line.send(close_frame(body))
        return counter

    def packets(self, seconds: float) -> Iterator[tuple[int, bytes]]:
        """Yield virtual channel and packet of all telemetry that comes within a time, as it comes."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            if select.select([self._line], [], [], left)[0]:
                yield from self.take()

    def take(self) -> Iterator[tuple[int, bytes]]:
        """Yield virtual channel and packet of the telemetry that has come."""
        for frame in self._line.receive():
            yield from self._open(frame)

    def follow(self, counter: int, spi: int, seconds: float) -> Iterator[Report]:
        """Yield the reports on a command until its last, or until the time is over."""
        identifier = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")
        for _, packet in self.packets(seconds):
            if packet[:2] != identifier:
                continue
            found = report_of(packet)
            if (found.counter, found.spi) == (counter, spi):
                yield found
                if found.stage.final:
                    return

    def close(self) -> None:
        """Store the counters and close the line."""
        self.gate.close()
        self._line.close()

    def _parse(self, frame: bytes) -> tuple[bytes, bytes]:
        header, protected, _ = open_telemetry(frame, self._settings.spacecraft)
        return header, protected

    def _open(self, frame: bytes) -> Iterator[tuple[int, bytes]]:
        try:
            admitted = self.gate.admit(frame)
        except RefusedError:  # counted by the gate
            return
        channel = admitted.header[1] >> 1 & 7
        assembler = self._channels.setdefault(channel, PacketAssembler())
        for packet in assembler.add(admitted.header, admitted.data):
            yield channel, packet


def report_of(packet: bytes) -> Report:
    """Return what a verification packet reports."""
    (row,) = LAYOUTS[VERIFICATION.name].array(packet)
    stage = Stage(int(row["stage"]))
    name, text = to_text(row["name"]), to_text(row["text"])
    request = Request(int(row["packet"]), int(row["sequence"]))
    return Report(int(row["spi"]), int(row["counter"]), stage, name, text, request)


class UdpGround:
    """A frame in each datagram, to and from one address."""

    def __init__(self, address: str, listen: str | None = None) -> None:
        """Send to HOST:PORT; `listen` is the own address where telemetry is sent to. Raises FlightError."""
        self._address = host_port(address)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.setblocking(False)
        with _reaching(address):
            self._socket.bind(("", 0) if listen is None else host_port(listen))

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the datagrams that came."""
        found: list[bytes] = []
        with contextlib.suppress(OSError):
            while len(found) < 1024:
                found.append(self._socket.recv(4096))
        return found

    def send(self, frame: bytes) -> None:
        """Send a datagram."""
        with _reaching(str(self._address)):
            self._socket.sendto(frame, self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class StreamGround:
    """Marked frames in a stream: TCP, or a serial line."""

    def __init__(self, name: str, file: int, frame_bytes: int, close: Callable[[], object]) -> None:
        """Take an open descriptor."""
        self._name = name
        self._file = file
        self._stream: FrameStream = telemetry_stream(frame_bytes)
        self._close = close

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._file

    def receive(self) -> list[bytes]:
        """Return the frames that came. Raises FlightError at the stream's end."""
        with _reaching(self._name):
            data = os.read(self._file, _PIECE)
        if not data:
            raise FlightError(f"{self._name}: the line was closed")
        return self._stream.add(data)

    def send(self, frame: bytes) -> None:
        """Send a marked frame."""
        data = SYNC + frame
        with _reaching(self._name):
            while data:
                data = data[os.write(self._file, data) :]

    def close(self) -> None:
        """Close the line."""
        self._close()


def open_terminal(
    address: str, keys: Path, settings: TerminalSettings | None = None, listen: str | None = None
) -> Terminal:
    """Open HOST:PORT (UDP), tcp:HOST:PORT, or /dev/FILE@BAUD. Raises UsageError, FlightError."""
    settings = settings or TerminalSettings()
    vault = Vault(keys)
    try:
        line = _open_line(address, settings.frame_bytes, listen)
    except ValueError as error:
        raise UsageError(f"{address}: give HOST:PORT, tcp:HOST:PORT or /dev/FILE@BAUD") from error
    return Terminal(line, vault, settings)


def _open_line(address: str, frame_bytes: int, listen: str | None) -> GroundLine:
    with _reaching(address):
        if address.startswith("tcp:"):
            connection = socket.create_connection(host_port(address.removeprefix("tcp:")), timeout=5.0)
            connection.setblocking(True)
            return StreamGround(address, connection.fileno(), frame_bytes, connection.close)
        if address.startswith("/"):
            device, _, baud = address.partition("@")
            port = serial.Serial(device, int(baud), exclusive=True)
            return StreamGround(address, port.fileno(), frame_bytes, port.close)
    return UdpGround(address, listen)


@contextlib.contextmanager
def _reaching(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FlightError(f"{name}: cannot be reached: {error.strerror or error}") from error
