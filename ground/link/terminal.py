"""Ground end of a link, with keys, protected commands, telemetry, and reports on commands."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import serial

from flight.app.run import utc_ns
from flight.link import frames, security
from flight.link.coding import Framing, LinkCodes
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.directives import portions
from flight.link.process.downlink import LIVE
from flight.link.process.station import host_port
from flight.link.telemetry.definitions import LINK, VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, row_of
from flight.schema.sections import Link, LinkCoding
from ground.telemetry import text_of
from knightcube.errors import KnightCubeError, UsageError, reason_of

DEFAULTS = Link(keys="-")
"""Link settings that are used without a configuration."""

ADDRESSES = "HOST:PORT (UDP), tcp:HOST:PORT, /dev/FILE@BAUD, kiss:HOST:PORT or kiss:/dev/FILE@BAUD"
"""Permitted notations of the address at which the ground sends frames to the satellite."""

_STORE_EVERY = 256  # number of telemetry frames between two writes of the anti-replay counters
_ANY_AHEAD = 2**63
"""Width of the anti-replay window, so large that a gap of any length after lost telemetry is accepted."""
_READ_BYTES = 1 << 16
_RECONNECT_S = 2.0  # minimum time (s) from the end of an attempt to open a stream until the next
_CONNECT_S = 1.5  # longest time (s) to wait for a TCP connection; the wait blocks the program
_LOST = -2  # value of `highest` in the packet `link` for an SPI whose counter is lost
PORTS = 1 << 16  # number of TCP and UDP ports
_TURN_S = 1.0  # longest time (s) to wait while another program sends a frame with the same keys
KEEP_ALIVE_S = 20.0
"""Longest time (s) between two frames to the satellite, whose link forgets a UDP sender after a minute."""
FRAME_OVERHEAD_BYTES = frames.TELECOMMAND_HEADER.size + security.OVERHEAD_BYTES + CRC_BYTES
"""Number of bytes that a telecommand frame adds to its packet."""
_LINK, _VERIFICATION = (LAYOUTS[packet.name].identifier.to_bytes(2, "big") for packet in (LINK, VERIFICATION))


def make_keys(folder: Path) -> list[Path]:
    """Make new keys in a new folder, and return the subfolders for the satellite and the ground.

    Raises UsageError if the folder exists or cannot be written.
    """
    keys = {spi: security.new_key() for spi in (*security.COMMAND_SPIS, *security.TELEMETRY_SPIS)}
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError as error:
        raise UsageError(
            f"{folder}: exists already; keys are never overwritten: give another folder"
        ) from error
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {reason_of(error)}") from error
    ends = [folder / end for end in ("satellite", "ground")]
    for end in ends:
        end.mkdir(mode=0o700)
        vault = security.Vault(end)
        for spi, key in keys.items():
            if vault.write(security.Association(spi, 1, 0, key)) != len(security.COPIES):
                raise UsageError(f"{end}: keys cannot be written")
    return ends


@dataclass(frozen=True, slots=True)
class TerminalSettings:
    """Settings from a configuration's section `link` that must be equal at both ends of the link."""

    spacecraft: int = DEFAULTS.spacecraft
    frame_bytes: int = DEFAULTS.frame_bytes
    command_frame_bytes: int = DEFAULTS.command_frame_bytes
    encrypted: bool = DEFAULTS.encrypt_telemetry
    coding: LinkCoding = DEFAULTS.coding
    call_signs: tuple[str, str] | None = None

    @classmethod
    def of(cls, link: Link) -> TerminalSettings:
        """Return the settings of the section `link`."""
        sizes = link.frame_bytes, link.command_frame_bytes
        return cls(link.spacecraft, *sizes, link.encrypt_telemetry, link.coding, link.call_signs)

    def codes(self) -> LinkCodes:
        """Return a coder and decoder of the link's frames, with error counters at zero."""
        codes = self.coding.randomiser, self.coding.reed_solomon, self.coding.cltu
        return LinkCodes(self.frame_bytes, *codes, self.call_signs)


class GroundLine(Protocol):
    """A line to the satellite."""

    def fileno(self) -> int:
        """Return the file descriptor for `select`."""

    def receive(self) -> list[bytes]:
        """Return the received frames. Raises KnightCubeError once if the line is lost."""

    def send(self, frame: bytes) -> None:
        """Send a frame. Raises KnightCubeError."""

    def close(self) -> None:
        """Close."""


class Terminal:
    """The ground end of a link, for use by one thread.

    Attributes:
        gate: authentication of the telemetry frames, with the numbers of refused frames.
        lost_frames: number of telemetry frames that are missing according to their authenticated counters.
            The number `lost_frames` includes the counters that the satellite's link process skips at a
            restart.
        idle_frames: number of received frames of idle data.
        packet_bytes: longest packet that a telecommand frame can carry, bytes.
        lost_spis: SPIs of commands whose counter the satellite has lost, according to the newest telemetry.
        problem: reason why the newest packet could not be sent, or an empty text.
    """

    def __init__(
        self,
        line: GroundLine,
        vault: security.Vault,
        settings: TerminalSettings,
        codes: LinkCodes | None = None,
    ) -> None:
        """Create a terminal from an open line, the keys of the ground, and the coding of the frames."""
        self._line = line
        self._vault = vault
        self._settings = settings
        self._sequence = 0
        self._sealers: dict[int, security.Sealer] = {}
        self._channels: dict[int, frames.PacketAssembler] = {}
        self._expected: dict[int, int] = {}  # next counter of each SPI
        self._codes = codes or settings.codes()
        self._learned = False
        self.problem = ""
        self._failing: float | None = None  # time of the first failure to send since the last success
        self.lost_spis: tuple[int, ...] = ()
        self.lost_frames = self.idle_frames = 0
        self.packet_bytes = settings.command_frame_bytes - FRAME_OVERHEAD_BYTES
        spis, mask, encrypted = security.TELEMETRY_SPIS, frames.TELEMETRY_MASK, settings.encrypted
        self.gate = security.Gate(
            vault, spis, self._parse, mask, _ANY_AHEAD, _STORE_EVERY, encrypted=encrypted
        )

    def fileno(self) -> int:
        """Return the line's file descriptor for `select`."""
        return self._line.fileno()

    def send(self, packet: bytes, spi: int = 1) -> int:
        """Send a command packet and return the counter of its frame. Raises KnightCubeError."""
        sealer = self._sealers.setdefault(spi, security.Sealer(self._vault, spi, frames.TELECOMMAND_MASK))
        return self.send_by(sealer, packet)

    def sealer(self, spi: int, block: int) -> security.Sealer:
        """Return a new sealer, the argument of `send_by`, that reserves `block` counter values at a time."""
        return security.Sealer(self._vault, spi, frames.TELECOMMAND_MASK, block, shared=True)

    def send_by(self, sealer: security.Sealer, packet: bytes) -> int:
        """Send a packet in a frame authenticated by `sealer`, and return the counter of the frame.

        A packet that is too long for a frame is sent in portions; the counter is that of the last portion. No
        other program sends between the portions, because the satellite joins only consecutive portions.
        Raises KnightCubeError if the packet is longer than any command, or if a frame cannot be sent.
        """
        try:
            counter = self._send_parts(sealer, packet)
        except KnightCubeError as error:
            self.problem = str(error)
            self._failing = time.monotonic() if self._failing is None else self._failing
            raise
        self.problem, self._failing = "", None
        return counter

    @property
    def failing(self) -> float:
        """Time (s) since the first failure to send after the last success, or 0."""
        return 0.0 if self._failing is None else time.monotonic() - self._failing

    def _send_parts(self, sealer: security.Sealer, packet: bytes) -> int:
        is_long = len(packet) > self.packet_bytes
        with _turn_to_send(self._vault.folder):
            for part in portions(packet, utc_ns()) if is_long else (packet,):
                length = FRAME_OVERHEAD_BYTES + len(part)
                header = frames.TelecommandHeader(self._settings.spacecraft, 0, self._sequence)
                body, counter = sealer.seal(header.pack(length), part)
                self._sequence += 1
                self._line.send(frames.close_frame(body))
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
            if frames.is_idle(frame):
                self.idle_frames += 1
                continue
            try:
                admitted = self.gate.admit(frame)
            except security.RefusedError:  # counted by the gate
                continue
            # The counters of a new key begin at 0.
            expected = self._expected.get(admitted.spi, admitted.counter)
            self.lost_frames += max(admitted.counter - expected, 0)
            self._expected[admitted.spi] = admitted.counter + 1
            channel = admitted.header[1] >> 1 & 7
            assembler = self._channels.setdefault(channel, frames.PacketAssembler())
            for packet in assembler.add(admitted.header, admitted.data, self.lost_frames):
                if channel == LIVE and packet[:2] == _LINK:
                    self._pass_by(packet)
                yield channel, packet

    def follow(self, counter: int, spi: int, seconds: float, *, reported: bool = False) -> Iterator[Report]:
        """Yield the reports on a command until the final report, for at most `seconds` s.

        If the first report states that the frame's counter was used before, it is also the final report. If a
        later report states this, it is skipped, because a third party has replayed the frame. If `reported`
        is true, the first report was received in an earlier call.
        """
        for _, packet in self.packets(seconds):
            if packet[:2] != _VERIFICATION:
                continue
            found = report_of(packet)
            if found is None:
                continue
            repeated = found.stage is Stage.REPEATED
            if (found.counter, found.spi) == (counter, spi) and not (repeated and reported):
                yield found
                if found.stage.final or repeated:
                    return
                reported = True

    def learn_counters(self, seconds: float) -> None:
        """Receive telemetry until a packet `link` raises counters that are too low, at most `seconds` s."""
        self._learned = False
        for _ in self.packets(seconds):
            if self._learned:
                return

    def reception(self) -> str:
        """Return, as a text, the numbers of received frames, lost frames and corrected errors."""
        code = self._codes.telemetry
        return (
            f"{self.gate.admitted} frames accepted, {sum(self.gate.refused.values())} refused, "
            f"{self.lost_frames} lost, {self.idle_frames} idle; {code.corrected} symbols corrected, "
            f"{code.uncorrectable} codewords uncorrectable"
        )

    def close(self) -> None:
        """Store the frame counters and close the line."""
        self.gate.close()
        self._line.close()

    def _pass_by(self, packet: bytes) -> None:
        """Raise the counters for commands above those that the satellite has accepted.

        The stored counters are behind if the folder of keys is an older copy.
        """
        row = row_of(LINK, packet)
        if row is None:  # the counters in a packet of another version are not known
            return
        self._learned = True
        self.lost_spis = tuple(
            spi
            for spi, highest in zip(security.COMMAND_SPIS, row["highest"], strict=False)
            if highest == _LOST
        )
        for spi, highest, generation in zip(
            security.COMMAND_SPIS, row["highest"], row["generation"], strict=False
        ):
            own = self._vault.read(spi)
            if own is not None and own.generation == generation and own.unused <= highest:
                self._vault.advance(replace(own, unused=int(highest) + 1))

    def _parse(self, frame: bytes) -> tuple[bytes, bytes]:
        header, protected, _ = frames.open_telemetry(frame, self._settings.spacecraft)
        return header, protected


def report_of(packet: bytes) -> Report | None:
    """Return the report in a verification packet, or None if its version or its stage is unknown."""
    row = row_of(VERIFICATION, packet)
    if row is None:
        return None
    try:
        stage = Stage(int(row["stage"]))
    except ValueError:
        return None
    name, text = text_of(row["name"]), text_of(row["text"])
    request = Request(int(row["packet"]), int(row["sequence"]))
    return Report(int(row["spi"]), int(row["counter"]), stage, name, text, request)


class UdpGround:
    """UDP line with one frame per datagram."""

    def __init__(self, address: str, codes: LinkCodes | None = None) -> None:
        """Open a socket that sends to HOST:PORT and receives at any free port. Raises KnightCubeError."""
        self._codes = codes or LinkCodes()
        self._name, self._address = address, checked_address(address)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.setblocking(False)
        with _reaching(address):
            self._socket.bind(("", 0))

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the frames in the received datagrams."""
        found: list[bytes] = []
        with contextlib.suppress(OSError):
            while len(found) < 1024:
                found.append(self._codes.telemetry.decode(self._socket.recv(4096)))
        return found

    def send(self, frame: bytes) -> None:
        """Send a datagram."""
        with _reaching(self._name):
            self._socket.sendto(self._codes.commands.encode(frame), self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


Opened = tuple[int, Callable[[], object]]
"""File descriptor of an open stream, and the function that closes the stream."""


class StreamGround:
    """Stream of frames over TCP or a serial line. A lost stream is opened again when a frame is sent."""

    def __init__(self, name: str, framing: Framing, connect: Callable[[], Opened]) -> None:
        """Open a stream by the function `connect`. Raises KnightCubeError if `connect` raises OSError."""
        self._name, self._framing, self._connect = name, framing, connect
        # The descriptor of the poll object stays the same when the stream is opened again.
        self._readable = select.epoll()
        self._file = -1
        self._close: Callable[[], object] = _nothing
        self._tried, self._problem = -math.inf, ""
        self._stream = framing.stream()
        try:
            self._open()
        except KnightCubeError:
            self._readable.close()
            raise

    def fileno(self) -> int:
        """Return a file descriptor that is readable while the stream is readable."""
        return self._readable.fileno()

    def receive(self) -> list[bytes]:
        """Return the received frames. Raises KnightCubeError once when the stream is lost."""
        if self._file < 0:
            return []
        try:
            with _reaching(self._name):
                data = os.read(self._file, _READ_BYTES)
            if not data:
                raise KnightCubeError(f"{self._name}: the line was closed")
        except KnightCubeError as error:
            self._drop(str(error))
            raise
        return self._stream.add(data)

    def send(self, frame: bytes) -> None:
        """Send a frame. Raises KnightCubeError if the stream is lost and cannot be opened again."""
        if self._file < 0:
            self._open()
        data = self._framing.wrap(frame)
        try:
            with _reaching(self._name):
                while data:
                    data = data[os.write(self._file, data) :]
        except KnightCubeError as error:
            self._drop(str(error))
            raise

    def close(self) -> None:
        """Close the line."""
        self._drop(f"{self._name}: the line was closed")
        self._readable.close()

    def _open(self) -> None:
        if time.monotonic() - self._tried < _RECONNECT_S:
            raise KnightCubeError(self._problem)
        try:
            with _reaching(self._name):
                self._file, self._close = self._connect()
        except KnightCubeError as error:
            self._problem = str(error)
            raise
        finally:
            self._tried = time.monotonic()
        self._readable.register(self._file, select.EPOLLIN)
        self._stream = self._framing.stream()

    def _drop(self, problem: str) -> None:
        self._problem = problem
        if self._file >= 0:
            with contextlib.suppress(OSError):
                self._readable.unregister(self._file)
            with contextlib.suppress(OSError):
                self._close()
        self._file, self._close = -1, _nothing


def _nothing() -> None:
    """Close nothing, because no stream is open."""


def _serial_port(place: str) -> Opened:
    """Open the serial port /dev/FILE@BAUD. Raises OSError, and ValueError for another form."""
    device, _, baud = place.partition("@")
    port = serial.Serial(device, int(baud), exclusive=True)
    os.set_blocking(port.fileno(), True)  # a nonblocking port fails when its output buffer is full
    return port.fileno(), port.close


def _connection(address: tuple[str, int]) -> Opened:
    """Connect to a TCP address. Raises OSError."""
    connection = socket.create_connection(address, timeout=_CONNECT_S)
    connection.setblocking(True)
    return connection.fileno(), connection.close


def open_terminal(address: str, keys: Path, settings: TerminalSettings | None = None) -> Terminal:
    """Open the line to HOST:PORT (UDP), tcp:HOST:PORT, /dev/FILE@BAUD or kiss:TNC.

    TNC is the address, HOST:PORT (TCP) or /dev/FILE@BAUD, of a terminal node controller that uses KISS.

    Raises UsageError for an invalid address or key folder, and KnightCubeError if the line cannot be opened.
    """
    settings = settings or TerminalSettings()
    vault, codes = security.Vault(keys), settings.codes()
    if not any(map(vault.copies, (*security.COMMAND_SPIS, *security.TELEMETRY_SPIS))):
        raise UsageError(
            f"{keys}: contains no keys: give the folder `ground` that `knightcube keys` has made"
        )
    if (keys / security.OWNER).exists():
        raise UsageError(f"{keys}: a link process uses these keys of the satellite: give the ground's folder")
    kiss = address.startswith("kiss:")
    framing, place = codes.on_ground(kiss), address.removeprefix("kiss:")
    line: GroundLine
    try:
        if place.startswith("/"):
            line = StreamGround(address, framing, partial(_serial_port, place))
        elif kiss or place.startswith("tcp:"):
            where = checked_address(place.removeprefix("tcp:"))
            line = StreamGround(address, framing, partial(_connection, where))
        else:
            line = UdpGround(address, codes)
    except ValueError as error:
        raise UsageError(f"{address}: give {ADDRESSES}") from error
    return Terminal(line, vault, settings, codes)


def checked_address(address: str) -> tuple[str, int]:
    """Return host and port of an address HOST:PORT. Raises ValueError for an impossible port."""
    host, port = host_port(address)
    if not host or not 0 < port < PORTS:
        raise ValueError(f"{address}: the port must be 1 to {PORTS - 1}")
    return host, port


@contextlib.contextmanager
def _turn_to_send(keys: Path) -> Iterator[None]:
    """Make the programs that share a folder of keys send one after the other.

    The satellite refuses a frame that arrives after a frame with a higher counter. A program waits for at
    most `_TURN_S` s, because another program may block while it sends.
    """
    with _reaching(str(keys)):
        file = os.open(keys / "uplink", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        until = time.monotonic() + _TURN_S
        while time.monotonic() < until:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.001)
        yield
    finally:
        os.close(file)


@contextlib.contextmanager
def _reaching(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or error
        raise KnightCubeError(f"{name}: cannot be reached: {reason}") from error
