"""Ground end of a link, with keys, protected commands, telemetry, and reports on commands."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
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
from flight.link.process.downlink import LIVE
from flight.link.process.station import host_port
from flight.link.security import (
    COMMAND_SPIS,
    COPIES,
    OVERHEAD_BYTES,
    TELEMETRY_SPIS,
    Association,
    Gate,
    RefusedError,
    Sealer,
    Vault,
    new_key,
)
from flight.link.telemetry.definitions import LINK, VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, to_text
from flight.schema.sections import Link
from knightcube.errors import FlightError, UsageError

DEFAULTS = Link(keys="-")
"""Default spacecraft identifier and frame length."""

_STORE_EVERY = 256
"""Number of telemetry frames between two writes of the anti-replay counters."""
_ANY_AHEAD = 2**63
"""Width of the anti-replay window, which accepts any gap after lost telemetry."""
_READ_BYTES = 1 << 16
_LINK, _VERIFICATION = (LAYOUTS[packet.name].identifier.to_bytes(2, "big") for packet in (LINK, VERIFICATION))


def make_keys(folder: Path) -> list[Path]:
    """Make new keys in a new folder, and return the subfolders for the satellite and the ground.

    Raises UsageError if the folder exists or cannot be written.
    """
    keys = {spi: new_key() for spi in (*COMMAND_SPIS, *TELEMETRY_SPIS)}
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError as error:
        raise UsageError(f"{folder} exists: keys are never overwritten, give another folder") from error
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror or error}") from error
    ends = [folder / end for end in ("satellite", "ground")]
    for end in ends:
        end.mkdir(mode=0o700)
        vault = Vault(end)
        for spi, key in keys.items():
            if vault.write(Association(spi, 1, 0, key)) != len(COPIES):
                raise UsageError(f"{end}: keys cannot be written")
    return ends


@dataclass(frozen=True, slots=True)
class TerminalSettings:
    """Spacecraft identifier and length of telemetry frames, which must be equal at both ends of a link."""

    spacecraft: int = DEFAULTS.spacecraft
    frame_bytes: int = DEFAULTS.frame_bytes


class GroundLine(Protocol):
    """A line to the satellite."""

    def fileno(self) -> int:
        """Return the file descriptor for `select`."""

    def receive(self) -> list[bytes]:
        """Return the received frames. Raises FlightError if the line was closed."""

    def send(self, frame: bytes) -> None:
        """Send a frame. Raises FlightError."""

    def close(self) -> None:
        """Close."""


class Terminal:
    """The ground end of a link, for use by one thread.

    Attributes:
        gate: authentication of the telemetry frames, with the numbers of refused frames.
        lost_frames: number of telemetry frames that are missing according to their authenticated counters.
            Counters that the satellite's link process skips when it starts again are included.
    """

    def __init__(self, line: GroundLine, vault: Vault, settings: TerminalSettings) -> None:
        """Create a terminal with an open line and the ground's keys."""
        self._line = line
        self._vault = vault
        self._settings = settings
        self._sequence = 0
        self._sealers: dict[int, Sealer] = {}
        self._channels: dict[int, PacketAssembler] = {}
        self._expected: dict[int, int] = {}  # next counter of each SPI
        self.lost_frames = 0
        self.gate = Gate(vault, TELEMETRY_SPIS, self._parse, TELEMETRY_MASK, _ANY_AHEAD, _STORE_EVERY)

    def fileno(self) -> int:
        """Return the line's file descriptor for `select`."""
        return self._line.fileno()

    def send(self, packet: bytes, spi: int = 1) -> int:
        """Send a command packet and return the counter of its frame. Raises FlightError."""
        sealer = self._sealers.setdefault(spi, Sealer(self._vault, spi, TELECOMMAND_MASK))
        return self.send_by(sealer, packet)

    def sealer(self, spi: int, block: int) -> Sealer:
        """Return a frame sealer for `send_by`, which reserves `block` counters at once."""
        return Sealer(self._vault, spi, TELECOMMAND_MASK, block, shared=True)

    def send_by(self, sealer: Sealer, packet: bytes) -> int:
        """Send a command packet with a sealer's key and return the counter of its frame."""
        header = TelecommandHeader(self._settings.spacecraft, 0, self._sequence)
        length = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + len(packet) + CRC_BYTES
        body, counter = sealer.seal(header.pack(length), packet)
        self._sequence += 1
        self._line.send(close_frame(body))
        return counter

    def packets(self, seconds: float) -> Iterator[tuple[int, bytes]]:
        """Yield virtual channel and packet of all telemetry received within `seconds` s."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            if select.select([self._line], [], [], left)[0]:
                yield from self.take()

    def take(self) -> Iterator[tuple[int, bytes]]:
        """Yield virtual channel and packet of the telemetry received since the last call."""
        for frame in self._line.receive():
            try:
                admitted = self.gate.admit(frame)
            except RefusedError:  # counted by the gate
                continue
            # A new key begins at counter 0.
            expected = self._expected.get(admitted.spi, admitted.counter)
            self.lost_frames += max(admitted.counter - expected, 0)
            self._expected[admitted.spi] = admitted.counter + 1
            channel = admitted.header[1] >> 1 & 7
            assembler = self._channels.setdefault(channel, PacketAssembler())
            for packet in assembler.add(admitted.header, admitted.data, self.lost_frames):
                if channel == LIVE and packet[:2] == _LINK:
                    self._pass_by(packet)
                yield channel, packet

    def follow(self, counter: int, spi: int, seconds: float) -> Iterator[Report]:
        """Yield the reports on a command until the final report, for at most `seconds` s.

        A report of a repeated frame is final if no other report came before. Otherwise somebody has repeated
        the command's frame, and this report is skipped.
        """
        reported = False
        for _, packet in self.packets(seconds):
            if packet[:2] != _VERIFICATION:
                continue
            found = report_of(packet)
            repeated = found.stage is Stage.REPEATED
            if (found.counter, found.spi) == (counter, spi) and not (repeated and reported):
                yield found
                if found.stage.final or repeated:
                    return
                reported = True

    def close(self) -> None:
        """Store the frame counters and close the line."""
        self.gate.close()
        self._line.close()

    def _pass_by(self, packet: bytes) -> None:
        """Continue the counters of commands above those that the satellite has accepted.

        The stored counters are behind if the folder of keys is an older copy.
        """
        (row,) = LAYOUTS[LINK.name].array(packet)
        for spi, highest, generation in zip(COMMAND_SPIS, row["highest"], row["generation"], strict=False):
            own = self._vault.read(spi)
            if own is not None and own.generation == generation and own.unused <= highest:
                self._vault.advance(replace(own, unused=int(highest) + 1))

    def _parse(self, frame: bytes) -> tuple[bytes, bytes]:
        header, protected, _ = open_telemetry(frame, self._settings.spacecraft)
        return header, protected


def report_of(packet: bytes) -> Report:
    """Return the report in a verification packet."""
    (row,) = LAYOUTS[VERIFICATION.name].array(packet)
    stage = Stage(int(row["stage"]))
    name, text = to_text(row["name"]), to_text(row["text"])
    request = Request(int(row["packet"]), int(row["sequence"]))
    return Report(int(row["spi"]), int(row["counter"]), stage, name, text, request)


class UdpGround:
    """UDP line with one frame per datagram."""

    def __init__(self, address: str) -> None:
        """Open a socket that sends to HOST:PORT and receives at any free port. Raises FlightError."""
        self._address = host_port(address)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.setblocking(False)
        with _reaching(address):
            self._socket.bind(("", 0))

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the received datagrams."""
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
    """Stream of frames with sync markers, over TCP or a serial line."""

    def __init__(self, name: str, file: int, frame_bytes: int, close: Callable[[], object]) -> None:
        """Create a stream on an open file descriptor."""
        self._name = name
        self._file = file
        self._stream: FrameStream = telemetry_stream(frame_bytes)
        self._close = close

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._file

    def receive(self) -> list[bytes]:
        """Return the received frames. Raises FlightError at the end of the stream."""
        with _reaching(self._name):
            data = os.read(self._file, _READ_BYTES)
        if not data:
            raise FlightError(f"{self._name}: the line was closed")
        return self._stream.add(data)

    def send(self, frame: bytes) -> None:
        """Send a frame after its sync marker."""
        data = SYNC + frame
        with _reaching(self._name):
            while data:
                data = data[os.write(self._file, data) :]

    def close(self) -> None:
        """Close the line."""
        self._close()


def open_terminal(address: str, keys: Path, settings: TerminalSettings | None = None) -> Terminal:
    """Open the line to HOST:PORT (UDP), tcp:HOST:PORT, or /dev/FILE@BAUD.

    Raises UsageError for an invalid address or key folder, and FlightError if the line cannot be opened.
    """
    settings = settings or TerminalSettings()
    vault = Vault(keys)
    line: GroundLine
    try:
        with _reaching(address):
            if address.startswith("tcp:"):
                connection = socket.create_connection(host_port(address.removeprefix("tcp:")), timeout=5.0)
                connection.setblocking(True)
                close = connection.close
                line = StreamGround(address, connection.fileno(), settings.frame_bytes, close)
            elif address.startswith("/"):
                device, _, baud = address.partition("@")
                port = serial.Serial(device, int(baud), exclusive=True)
                line = StreamGround(address, port.fileno(), settings.frame_bytes, port.close)
            else:
                line = UdpGround(address)
    except ValueError as error:
        raise UsageError(f"{address}: give HOST:PORT, tcp:HOST:PORT or /dev/FILE@BAUD") from error
    return Terminal(line, vault, settings)


@contextlib.contextmanager
def _reaching(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FlightError(f"{name}: cannot be reached: {error.strerror or error}") from error
