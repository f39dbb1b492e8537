"""Link process: communication lines to the ground, and the loop that receives frames and sends telemetry.

The communication lines use UDP, TCP or a serial port. The loop runs at 50 Hz in one thread, and no call on a
line blocks. A flood of received frames is processed in several steps, so that telemetry is not delayed. The
counter of an accepted frame is stored before the command in the frame is executed. A link process that is
killed at any moment therefore executes no command twice.
"""

from __future__ import annotations

import contextlib
import select
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from ipaddress import IPv4Address, IPv4Network
from itertools import accumulate
from pathlib import Path
from typing import Any, Protocol

from flight.link import commands
from flight.link.coding import LONGEST_CLTU, FrameDecoder, Framing, LinkCodes
from flight.link.commands import CommandError, CommandPacker, filter_datagrams
from flight.link.events import Mode
from flight.link.files.store import FileError, files_folder
from flight.link.files.units import UP, is_unit
from flight.link.frames import TELECOMMAND_HEADER, TELECOMMAND_MASK, TELEMETRY_MASK, open_telecommand
from flight.link.process import directives
from flight.link.process.commanding import (
    ControlLine,
    Report,
    Scheduling,
    Sent,
    Stage,
    Timetable,
    Verification,
    report,
    request_of,
)
from flight.link.process.directives import (
    Activate,
    Confirm,
    Deletion,
    Directive,
    Executable,
    Listing,
    NewKey,
    Play,
    Portion,
    Privileged,
    Restart,
    Scheduled,
    Stop,
    UseFile,
    Withdraw,
)
from flight.link.process.downlink import Downlink, LogFollower, Playback, time_of
from flight.link.process.filing import STATUS, Filing, Renewal, values_of
from flight.link.security import (
    COMMAND_SPIS,
    TELEMETRY_SPIS,
    USED_KEY,
    Admitted,
    Gate,
    Refusal,
    RefusedError,
    Sealer,
    Vault,
    may_change,
)
from flight.link.telemetry.definitions import LINK, RUN, TRANSFER, VERIFICATION, Packet
from flight.link.telemetry.packets import Packer, TelemetryError, row_of
from hal.interfaces.errors import DeviceError, OutputFull
from hal.interfaces.wires import SECOND_NS, Clock, SerialPort
from knightcube.errors import KnightCubeError, UsageError

AT_MOST = 512
"""Maximum number of datagrams read per call, so that a flood of frames does not delay the telemetry."""

_BUFFER = 1 << 20
_HEARD_NS = 60_000_000_000
_CONNECTIONS = 4
"""Maximum number of TCP connections that have sent an authentic frame."""
_STRANGERS = 256
"""Maximum number of TCP connections that have not sent an authentic frame. If 200 unauthenticated clients
connect per second, a new connection has 1.3 s for its first frame."""
_PIECE = 1 << 14
_RECONNECT_NS = 5 * SECOND_NS
_DEAD_NS = 300 * SECOND_NS
"""Time (ns) after which a TCP connection that accepts no frame is closed. Even if a peer reads steadily at
960 bytes/s, no frame fits into the socket buffers for up to 126 s, because the kernel frees the buffers in
large blocks."""


class Line(Protocol):
    """Interface of a communication line to the ground."""

    name: str

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the received frames with their senders, oldest first. Never raises."""

    def trust(self, sender: Any, now_ns: int) -> None:
        """Note that a frame from `sender` was authentic. The default does nothing."""
        return

    def send(self, frames: Sequence[bytes], now_ns: int) -> int | None:
        """Send frames to all listeners. Never raises.

        Returns the number of leading frames that at least one listener accepted, or None if nobody listens.
        The caller sends the remaining frames again.
        """

    def close(self) -> None:
        """Close the line. Calling `close` again has no effect."""


class _Output:
    """Output of a stream, which completes a partly sent frame before it accepts new frames."""

    def __init__(self) -> None:
        self._rest = b""

    def send(self, frames: Sequence[bytes], write: Callable[[bytes], int]) -> int:
        """Send frames by `write`, which counts the written bytes. Return the number of begun frames."""
        data, bounds = self._rest + b"".join(frames), [*accumulate(map(len, frames), initial=len(self._rest))]
        written = write(data) if data else 0
        begun = sum(begin < written for begin in bounds[:-1])
        self._rest = data[written : bounds[begun]]
        return begun

    def clear(self) -> None:
        """Discard the rest of the last frame, because the stream was lost."""
        self._rest = b""


def _write_to(line: socket.socket, data: bytes) -> int:
    """Write to a socket without waiting. Return the number of written bytes. Raises OSError."""
    try:
        return line.send(data)
    except BlockingIOError:
        return 0


class UdpLine:
    """UDP line; sends to the fixed address, and to each sender for a minute after an authentic frame."""

    def __init__(
        self,
        address: str,
        to: str | None = None,
        peers: Sequence[IPv4Network] | None = None,
        codes: LinkCodes | None = None,
    ) -> None:
        """Bind a UDP socket to the address HOST:PORT. Raises UsageError if the socket cannot be bound.

        The fixed address `to` receives telemetry. Only senders in the networks `peers` are accepted, or all
        senders if `peers` is None. If `codes` is None, frames are not coded.
        """
        self.name = f"UDP {address}"
        self._peers = peers
        self._codes = codes or LinkCodes()
        self._fixed = None if to is None else host_port(to)
        self._heard: dict[Any, int] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.setblocking(False)
        try:
            self._socket.bind(host_port(address))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise UsageError(f"link.udp: cannot listen on {address}: {error}") from error
        if peers is not None:
            filter_datagrams(self._socket, peers)

    @property
    def port(self) -> int:
        """Number of the bound UDP port."""
        return int(self._socket.getsockname()[1])

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return frames and senders of datagrams; a datagram that is too long is cut to an invalid length."""
        found = []
        for _ in range(AT_MOST):
            try:
                data, sender = self._socket.recvfrom(LONGEST_CLTU + 1)
            except BlockingIOError:
                break
            except OSError:  # ICMP error from a listener that no longer exists
                continue
            if self._peers is None or any(IPv4Address(sender[0]) in peers for peers in self._peers):
                found.append((self._codes.commands.decode(data), sender))
        return found

    def trust(self, sender: Any, now_ns: int) -> None:
        """Send telemetry to the authenticated `sender` for one minute."""
        self._heard[sender] = now_ns

    def send(self, frames: Sequence[bytes], now_ns: int) -> int | None:
        """Send each frame as one datagram to each listener, until the network accepts no more datagrams."""
        self._heard = {who: at for who, at in self._heard.items() if now_ns - at < _HEARD_NS}
        fixed = () if self._fixed is None or self._fixed in self._heard else (self._fixed,)
        listeners = (*fixed, *self._heard)
        if not listeners:
            return None
        for count, frame in enumerate(frames):
            unit = self._codes.telemetry.encode(frame)
            if not any([self._send(unit, listener) for listener in listeners]):
                return count
        return len(frames)

    def _send(self, unit: bytes, listener: Any) -> bool:
        """Send a datagram. Return whether the network has accepted it."""
        with contextlib.suppress(OSError):
            return self._socket.sendto(unit, listener) == len(unit)
        return False

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@dataclass(slots=True)
class _Connection:
    """TCP connection: its decoder, its output, and whether it has sent an authentic frame."""

    stream: FrameDecoder
    output: _Output = field(default_factory=_Output)
    trusted: bool = False
    refused_ns: int | None = None  # time since which the connection has accepted no frame


class TcpLine:
    """TCP server for frames that follow sync markers, or are coded as configured.

    Connections that have sent an authentic frame are limited to four, other connections to 256. A further
    connection replaces the oldest connection of the same kind, so that unauthenticated clients displace only
    each other. Telemetry is sent to connections that have sent an authentic frame.
    """

    def __init__(
        self, address: str, peers: Sequence[IPv4Network] | None = None, framing: Framing | None = None
    ) -> None:
        """Listen for connections at the address HOST:PORT. Raises UsageError if it cannot be bound.

        Connections are accepted from the networks `peers`, or from everywhere if `peers` is None. If
        `framing` is None, frames are not coded, and each frame follows a sync marker.
        """
        self.name = f"TCP {address}"
        self._peers = peers
        self._framing = framing or LinkCodes().on_board()
        self._connections: dict[socket.socket, _Connection] = {}
        self._readable = select.poll()
        try:
            self._listener = socket.create_server(host_port(address), backlog=_STRANGERS)
        except (OSError, OverflowError) as error:
            raise UsageError(f"link.tcp: cannot listen on {address}: {error}") from error
        self._listener.setblocking(False)

    @property
    def port(self) -> int:
        """Number of the TCP port on which the server listens."""
        return int(self._listener.getsockname()[1])

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the frames received from all connections."""
        self._accept()
        found: list[tuple[bytes, Any]] = []
        ready = {file for file, _ in self._readable.poll(0)}
        for connection, state in list(self._connections.items()):
            if connection.fileno() not in ready:
                continue
            try:
                data = connection.recv(_PIECE)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if not data:
                self._drop(connection)
                continue
            found += [(frame, connection) for frame in state.stream.add(data)]
        return found

    def trust(self, sender: Any, now_ns: int) -> None:
        """Mark the connection `sender` as authenticated: keep it when others connect, and send telemetry."""
        state = self._connections.get(sender)
        if state is not None and not state.trusted:
            self._make_room(trusted=True, most=_CONNECTIONS)
            state.trusted = True

    def send(self, frames: Sequence[bytes], now_ns: int) -> int | None:
        """Send frames to authenticated connections; close connections that accept none for five minutes."""
        marked, begun = list(map(self._framing.wrap, frames)), list[int]()
        for connection, state in list(self._connections.items()):
            if not state.trusted:
                continue
            try:
                begun.append(state.output.send(marked, partial(_write_to, connection)))
            except OSError:
                self._drop(connection)
                begun.append(0)
            if begun[-1] or state.refused_ns is None:
                state.refused_ns = None if begun[-1] or not frames else now_ns
            elif now_ns - state.refused_ns >= _DEAD_NS:
                self._drop(connection)
        return max(begun, default=None)

    def close(self) -> None:
        """Close all connections and the listening socket."""
        for connection in list(self._connections):
            self._drop(connection)
        self._listener.close()

    def _accept(self) -> None:
        for _ in range(_STRANGERS):
            try:
                connection, (host, _) = self._listener.accept()
            except OSError:
                return
            if self._peers is not None and not any(IPv4Address(host) in peers for peers in self._peers):
                connection.close()
                continue
            connection.setblocking(False)
            self._make_room(trusted=False, most=_STRANGERS)
            self._connections[connection] = _Connection(self._framing.stream())
            self._readable.register(connection, select.POLLIN)

    def _make_room(self, trusted: bool, most: int) -> None:
        """Drop the oldest connection of a kind (`trusted` or not) if there are `most` of this kind."""
        same = [one for one, state in self._connections.items() if state.trusted == trusted]
        if len(same) >= most:
            self._drop(same[0])

    def _drop(self, connection: socket.socket) -> None:
        if self._connections.pop(connection, None) is not None:
            self._readable.unregister(connection)
        connection.close()


class TncLine(Line):
    """Client of a TNC, such as Direwolf, by KISS over TCP; reconnects after five seconds."""

    def __init__(self, address: str, framing: Framing) -> None:
        """Connect to the address HOST:PORT when frames are first sent."""
        self.name = f"KISS {address}"
        self._address = host_port(address)
        self._framing = framing
        self._stream = framing.stream()
        self._socket: socket.socket | None = None
        self._output = _Output()
        self._next_ns = 0

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the received frames, or an empty list while there is no connection."""
        if self._socket is None:
            return []
        try:
            data = self._socket.recv(_PIECE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self.close()
        return [(frame, None) for frame in self._stream.add(data)]

    def send(self, frames: Sequence[bytes], now_ns: int) -> int:
        """Send each frame as the data of one KISS frame. Without a connection, no frame is accepted."""
        if self._socket is None and now_ns >= self._next_ns:
            self._next_ns = now_ns + _RECONNECT_NS
            self._stream = self._framing.stream()
            with contextlib.suppress(OSError):
                self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
                self._socket.setblocking(False)
                self._socket.connect(self._address)
        if self._socket is None:
            return 0
        try:
            return self._output.send(list(map(self._framing.wrap, frames)), partial(_write_to, self._socket))
        except OSError:
            self.close()
            return 0

    def close(self) -> None:
        """Close the connection."""
        self._output.clear()
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class SerialLine(Line):
    """Serial line to a radio for frames that follow sync markers, or are coded as configured."""

    def __init__(self, name: str, port: SerialPort, framing: Framing | None = None) -> None:
        """Use an open port, which reopens itself; if `framing` is None, frames follow sync markers."""
        self.name, self._port = name, port
        self._framing = framing or LinkCodes().on_board()
        self._stream, self._output = self._framing.stream(), _Output()

    def receive(self) -> list[tuple[bytes, Any]]:
        """Return the received frames, or an empty list if the port is lost."""
        try:
            pieces = self._port.receive()
        except DeviceError:
            return []
        return [(frame, None) for _, data in pieces for frame in self._stream.add(data)]

    def send(self, frames: Sequence[bytes], now_ns: int) -> int:
        """Send frames. No frame is accepted if the port is lost."""
        try:
            return self._output.send(list(map(self._framing.wrap, frames)), self._write)
        except DeviceError:
            self._output.clear()
            return 0

    def _write(self, data: bytes) -> int:
        """Write to the port. Return the number of written bytes. Raises DeviceError if the port is lost."""
        try:
            self._port.send(data)
        except OutputFull as error:
            return error.written
        return len(data)

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def host_port(address: str) -> tuple[str, int]:
    """Return the host and port of a valid address HOST:PORT."""
    host, _, port = address.rpartition(":")
    return host, int(port)


def _change_key(change: NewKey, spi: int, vault: Vault, gate: Gate, sealers: Mapping[int, Sealer]) -> str:
    """Change a key as requested by a command with the SPI `spi`. Return the problem, or "" on success."""
    if change.spi not in (*COMMAND_SPIS, *TELEMETRY_SPIS):
        return f"there is no SPI {change.spi}"
    if not may_change(spi, change.spi):
        return f"SPI {spi} must not change the key of the reserve SPI {change.spi}: send it under SPI 2"
    before = vault.read(change.spi)
    if before is not None and change.generation != before.generation + 1:
        return f"SPI {change.spi} has a key of generation {before.generation}: the new key must be the next"
    if vault.has_used(change.spi, change.key):  # recorded frames with this key would be accepted again
        return f"SPI {change.spi} {USED_KEY}: make a new key"
    if change.spi in COMMAND_SPIS:
        done = gate.replace_key(change.spi, change.generation, change.key)
    else:
        done = sealers[change.spi].replace_key(change.generation, change.key)
    if done and change.spi == COMMAND_SPIS[0]:
        vault.rebuilt = False
    return "" if done else "the key could not be stored"


_CURE = "set a new key for SPI 1 by a command under SPI 2"
RESTORED = f"the keys were restored from a backup: {_CURE}"
REBUILT = f"the folder of keys was lost: {_CURE}"
TURN_NS = SECOND_NS // 50
_BUSY_NS = SECOND_NS // 250
"""Period (ns) of the loop while frames arrive. A Linux socket buffers about 50 ms of traffic at 10,000
frames/s."""
_LABEL_NS = 10 * SECOND_NS
_UTC_WAIT_NS = 120 * SECOND_NS
"""Longest time (ns) for which scheduled commands wait for the UTC of the flight."""
_RESERVED_BLOCK = 4096
_REFUSALS_A_SECOND = 4
_STALL_NS = 10 * SECOND_NS
"""Shortest time (ns) after which a line that accepts no frame is reported, because a slow line needs seconds
for a frame."""
_STATUS_WAITING = 16
"""Largest number of waiting reports at which a status report of the link is still queued."""
_HIGHEST_REPORTED = 2**63 - 1
"""Largest frame counter and mission time (ns) that fit into a report. Received counters have 96 bits."""


@dataclass(frozen=True, slots=True)
class StationSettings:
    """Settings of the link.

    Attributes:
        spacecraft: spacecraft identifier in all frames.
        frame_bytes: length of a telemetry frame, bytes.
        rate: data rate of the telemetry, bytes/s.
        command_loss: time without an authentic frame after which the flight computer returns to an earlier
            version, s; 0 for never.
        renewal: status file that `deploy/renewal.py` writes.
        idle_rate: data rate (bytes/s) up to which frames of idle data are sent.
        encrypted: whether telemetry is encrypted in addition to its authentication.
        codes: encoders and decoders of the lines; the decoders count corrected errors.
        foreign_modes: modes that the body does not have, for which no command can be scheduled.
    """

    spacecraft: int
    frame_bytes: int
    rate: float
    command_loss: float = 0.0
    renewal: Path = STATUS
    idle_rate: float = 0.0
    encrypted: bool = True
    codes: LinkCodes = field(default_factory=LinkCodes)
    foreign_modes: frozenset[Mode] = frozenset()


class Transmitter:
    """Sender of the due frames on all lines; frames that no line accepts are sent again before others.

    While nobody listens, live telemetry is discarded, and files and playback wait. The attribute `untaken`
    counts how often a line did not accept a frame.
    """

    def __init__(self, lines: Sequence[Line], downlink: Downlink) -> None:
        self._lines, self._downlink = lines, downlink
        self._stall_ns = max(_STALL_NS, round(2 * downlink.frame_s * SECOND_NS))
        self._refused_ns: dict[str, int] = {}  # time since which a line has accepted no frame, by line
        self._unsent: list[bytes] = []
        self._listened = False  # whether anybody listened to the last frames
        self.untaken = 0

    def turn(self, now_ns: int) -> str:
        """Send the due frames. Return why telemetry cannot be sent, or an empty text."""
        problem, due = "", list[bytes]()
        if not self._unsent or not self._listened:
            try:
                due = self._downlink.frames(now_ns, live_only=not self._listened)
            except KnightCubeError as error:  # commands are accepted, such as a command that sets a new key
                problem = str(error)
        frames = self._unsent + due
        counts = {line.name: line.send(frames, now_ns) for line in self._lines}
        taken = [count for count in counts.values() if count is not None]
        self.untaken += sum(len(frames) - count for count in taken)
        if taken or self._listened:  # otherwise the frames in `due` contain live telemetry only
            self._unsent = frames[max(taken, default=0) :]
        self._listened = bool(taken)
        if frames:
            refusing = [name for name, count in counts.items() if count == 0]
            self._refused_ns = {name: self._refused_ns.get(name, now_ns) for name in refusing}
        stalled = [name for name, at_ns in self._refused_ns.items() if now_ns - at_ns >= self._stall_ns]
        return problem or (f"no telemetry can be sent on {', '.join(stalled)}" if stalled else "")


class Station:
    """Satellite end of the link: processes received frames and sends telemetry."""

    def __init__(
        self,
        settings: StationSettings,
        vault: Vault,
        lines: Sequence[Line],
        control: ControlLine[Sent],
        log: LogFollower,
        clock: Clock,
    ) -> None:
        """Use open communication lines, which the caller closes."""
        self._vault, self._lines, self._control, self._log = vault, lines, control, log
        self._clock = clock
        self._gate = Gate(vault, COMMAND_SPIS, parser_of(settings.spacecraft), TELECOMMAND_MASK)
        self._codes = settings.codes
        self._sealers = {
            spi: Sealer(vault, spi, TELEMETRY_MASK, _RESERVED_BLOCK, encrypted=settings.encrypted)
            for spi in TELEMETRY_SPIS
        }
        self._downlink = Downlink(
            settings.spacecraft,
            settings.frame_bytes,
            settings.rate,
            self._seal,
            lambda: self._filing.packet(clock.now_ns(), self._time_ns()),
            settings.idle_rate,
        )
        self._filing = Filing(files_folder(vault.folder), log.place, clock.now_ns())
        folder = vault.folder.absolute().parent / "renewal"
        self._renewal = Renewal(folder, settings.renewal, settings.command_loss)
        self._verification = Verification()
        self._packer, self._commands = Packer(), CommandPacker()
        # Segments (class `Portion`) that were sent with different SPIs are not joined.
        self._joiners = {spi: directives.Joiner() for spi in COMMAND_SPIS}
        self._mission_ns, self._mission_at_ns = 0, clock.now_ns()
        self._label, self._zero_utc_ns = b"", 0
        self._utc_offset_ns: int | None = None  # best known UTC minus the time of the host's clock
        self._begun_ns = self._status_ns = self._label_ns = clock.now_ns()
        self._refusals_ns = deque([-2 * SECOND_NS] * _REFUSALS_A_SECOND, _REFUSALS_A_SECOND)
        self._received = self._refused_commands = 0
        self._problem, self._keys_returned = "", False
        self._transmitter = Transmitter(lines, self._downlink)
        self._unpacked, self._unpacked_text = 0, ""
        self._alive: Callable[[], object] | None = None
        self._alive_ns = clock.now_ns()
        self._playback = Playback(self._downlink, log, clock)
        self._scheduling = Scheduling(Timetable(vault.folder, vault.restored), settings.foreign_modes)
        self._report(*self._scheduling.beginning())
        if vault.restored or vault.rebuilt:
            self.report_problem("keys", RESTORED if vault.restored else REBUILT)
        self._status()

    @property
    def transfers(self) -> int:
        """Number of open file transfers."""
        return len(self._filing.status())

    @property
    def obeyed(self) -> int:
        """Number of accepted frames, excluding those whose command was refused or failed."""
        return self._gate.admitted - self._refused_commands

    def report_problem(self, name: str, text: str) -> None:
        """Report a problem during the start to the ground, with the name of the affected software part."""
        self._report(Report(0, 0, Stage.FAILED, name, text))

    @property
    def unreported(self) -> int:
        """Number of reports that were never sent because packing failed or the queue was full."""
        return self._unpacked + self._downlink.displaced

    def run(
        self, ended: Callable[[], bool], complain: Callable[[str], object], alive: Callable[[], object]
    ) -> None:
        """Run until `ended` returns true, or until the lost key of the primary command SPI can be read again.

        In the second case the folder of keys was mounted late, and a new station must read the keys, the
        schedule and the file transfers of this folder.

        The function `complain` is called for each new problem with sending, and at most once a second for
        lost reports. The function `alive` is called once a second while the loop makes progress, also during
        an iteration that processes many frames.
        """
        self._alive = alive
        due_ns, complained, lost, lost_ns = self._clock.now_ns(), "", 0, 0
        while not ended() and not self._keys_returned:
            pause_ns = _BUSY_NS if self.turn() else TURN_NS
            if self._problem and self._problem != complained:
                complain(self._problem)
            complained = self._problem
            is_late = not self._problem and self.unreported != lost
            if is_late and self._clock.now_ns() - lost_ns >= SECOND_NS:
                lost, lost_ns = self.unreported, self._clock.now_ns()
                complain(f"{lost} reports could not be sent: {self._unpacked_text or 'too many at once'}")
            due_ns = max(due_ns + pause_ns, self._clock.now_ns())
            self._clock.sleep_until_ns(due_ns)
        if self._keys_returned:
            complain("the lost keys can be read again: the link is started again")
        self._control.close()
        try:
            self._filing.close(self._clock.now_ns())
        except FileError:
            if not self._keys_returned:  # the folder mounted late has its own transfers, which continue
                raise

    def turn(self) -> bool:
        """Process received frames and send due frames. Return whether any frame was received."""
        now_ns, before = self._clock.now_ns(), self._received
        for line in self._lines:
            for frame, sender in line.receive():
                self._take(frame, line, sender, now_ns)
                self._beat()
        for sent, answer in self._control.answers(now_ns):
            reports = self._verification.answered(sent, answer)
            self._refused_commands += reports[0].stage is Stage.FAILED
            self._report_stages(*reports)
        self._follow(now_ns)
        self._execute_due(now_ns)
        self._report(*self._playback.turn())
        self._report(*self._filing.turn(now_ns))
        for progress, ending in self._filing.ended():
            self._send(TRANSFER, values_of(progress))
            self._report(*[ending] if ending else [])
        if now_ns >= self._status_ns:
            self._status_ns = now_ns + SECOND_NS
            self._report(*self._renewal.turn(self._gate.admitted, now_ns))
            self._status()
        self._problem = self._transmitter.turn(now_ns)
        self._beat()
        return self._received > before

    def _beat(self) -> None:
        """Call the function `alive` once a second to report that the loop makes progress."""
        now_ns = self._clock.now_ns()
        if self._alive is not None and now_ns >= self._alive_ns:
            self._alive_ns = now_ns + SECOND_NS
            self._alive()

    def _take(self, frame: bytes, line: Line, sender: Any, now_ns: int) -> None:
        self._received += 1
        try:
            admitted = self._gate.admit(frame)
        except RefusedError as error:
            # Reports are rate-limited, because an attacker could repeat recorded frames at a high rate.
            if error.counter is not None and now_ns - self._refusals_ns[0] > SECOND_NS:
                self._refusals_ns.append(now_ns)
                counter = min(error.counter, _HIGHEST_REPORTED)
                stage = Stage.REPEATED if error.cause is Refusal.REPEATED else Stage.REFUSED
                self._report(Report(error.spi, counter, stage, "", str(error)))
            return
        line.trust(sender, now_ns)
        request = request_of(admitted.data)
        try:
            admitted = self._joined(admitted)
            request = request_of(admitted.data)
            if is_unit(admitted.data, UP):
                self._filing.take(admitted.data, now_ns)
                return
            directive = directives.unpack(admitted.data)
            if directive is not None:
                self._obey(admitted, directive)
                return
            sent = Sent(admitted.spi, admitted.counter, commands.unpack(admitted.data), request)
        except CommandError as error:
            self._refused_commands += 1
            self._report(Report(admitted.spi, admitted.counter, Stage.REFUSED, "", str(error), request))
            return
        self._report(report(sent, Stage.ACCEPTED, sent.command.text))
        self._hand_over(sent, admitted.data, now_ns)

    def _joined(self, admitted: Admitted) -> Admitted:
        """Return the content of a frame. For the last segment of a packet, this is the whole packet.

        Raises CommandError for a damaged directive, or if a segment is missing.
        """
        if is_unit(admitted.data, UP) or not isinstance(portion := directives.unpack(admitted.data), Portion):
            return admitted
        whole = self._joiners[admitted.spi].add(portion)
        return replace(admitted, data=whole) if whole else admitted

    def _hand_over(self, sent: Sent, packet: bytes, now_ns: int) -> None:
        if problem := self._control.send(sent, packet, now_ns):
            self._refused_commands += 1
            self._report_stages(report(sent, Stage.FAILED, problem))

    def _execute_due(self, now_ns: int) -> None:
        """Send due scheduled commands to the control process, and report commands that are not executed.

        If too many commands are due at once, the later commands wait for the answers to the first ones.
        """
        waits = self._log.label and now_ns - self._begun_ns < _UTC_WAIT_NS
        if self._utc_offset_ns is None and waits:
            return
        utc_ns = self._utc_ns()
        entries = self._scheduling.due(utc_ns)
        while not self._control.is_full and (due := next(entries, None)) is not None:
            if isinstance(due, Sent):
                self._hand_over(due, self._commands.pack(due.command, utc_ns), now_ns)
            else:
                self._report(due)

    def _obey(self, admitted: Admitted, directive: Directive) -> None:
        """Execute a directive and report the stages of its execution."""
        name, text = directive.packet.name, str(directive)
        request = request_of(admitted.data)
        done = Report(admitted.spi, admitted.counter, Stage.COMPLETED, name, text, request)
        self._report(replace(done, stage=Stage.ACCEPTED))
        # A packet in segments is executed only after its last segment has arrived.
        reports = [done] if isinstance(directive, Portion) else self._executed(directive, done)
        own = [one.stage for one in reports if (one.spi, one.counter) == (done.spi, done.counter)]
        self._refused_commands += Stage.FAILED in own
        self._report(*reports)

    def _executed(self, directive: Executable, done: Report) -> list[Report]:
        """Execute a directive and return the reports due now; `done` is the report of completion."""
        match directive:
            case Play():
                return self._playback.begin(directive, done)
            case Stop():
                return [*self._playback.end("stopped"), done]
            case NewKey():
                problem = _change_key(directive, done.spi, self._vault, self._gate, self._sealers)
                return [replace(done, stage=Stage.FAILED, text=problem) if problem else done]
            case Activate() | Confirm() | Withdraw() | Restart():
                return self._renew(directive, done)
            case Scheduled() | Deletion() | Listing():
                return self._schedule(directive, done)
            case _:
                return self._filing.obey(directive, done, self._utc_ns(), self._clock.now_ns())

    def _schedule(self, directive: Scheduled | Deletion | Listing, done: Report) -> list[Report]:
        """Change or list the schedule. No command is added if the folder of keys was rebuilt."""
        if isinstance(directive, Scheduled) and self._vault.rebuilt:  # the lost folder has another schedule
            return [replace(done, stage=Stage.FAILED, text=REBUILT)]
        return self._scheduling.obey(directive, done, self._utc_ns())

    def _renew(self, directive: Privileged, done: Report) -> list[Report]:
        """Hand a directive over to the privileged `deploy/renewal.py`, which reports its completion."""
        request = partial(self._renewal.request, directive, done, self._clock.now_ns())
        handed_over = replace(done, stage=Stage.STARTED, text=f"{directive}: handed over")
        if isinstance(directive, Activate):
            return self._filing.select(UseFile(directive.name, directive.sum), handed_over, request)
        problem = request()
        return [replace(done, stage=Stage.FAILED, text=problem) if problem else handed_over]

    def _follow(self, now_ns: int) -> None:
        for packet in self._log.new():
            self._mission_ns, self._mission_at_ns = time_of(packet), now_ns
            self._downlink.live(packet)
            self._scheduling.followed(packet)
            self._renewal.followed(packet, now_ns, live=self._log.is_live)
            self._report_stages(*self._verification.followed(packet))
            if self._log.is_live and self._log.label:
                self._follow_utc(self._log.label, time_of(packet) - now_ns)
        if self._log.label and now_ns >= self._label_ns:
            self._label_ns = now_ns + _LABEL_NS
            self._downlink.live(self._log.label)

    def _follow_utc(self, label: bytes, mission_offset_ns: int) -> None:
        """Update the newest run packet, and the offset (ns) of the flight's UTC from the host's clock.

        The largest offset is the most accurate one, because packets are delayed in the log.
        """
        if (row := row_of(RUN, label)) is None:  # the flight has another version of the packet
            self._utc_offset_ns = None
            return
        if label != self._label:
            self._label, self._utc_offset_ns = label, None
            self._zero_utc_ns = int(row["utc_ns"])
        offset_ns = self._zero_utc_ns + mission_offset_ns
        self._utc_offset_ns = max(
            offset_ns, offset_ns if self._utc_offset_ns is None else self._utc_offset_ns
        )

    def _utc_ns(self) -> int:
        """Return the UTC of the flight, ns since 1970, or the host's UTC if there is no flight."""
        if self._utc_offset_ns is None:
            return self._clock.utc_ns()
        return self._clock.now_ns() + self._utc_offset_ns

    def _seal(self, header: bytes, data: bytes) -> bytes:
        """Protect a frame with the primary SPI, or else the reserve SPI.

        Raises KnightCubeError if neither SPI can protect it.
        """
        problem: KnightCubeError | None = None
        for sealer in self._sealers.values():
            try:
                return sealer.seal(header, data)[0]
            except KnightCubeError as error:
                problem = problem or error
        raise problem or KnightCubeError("no SPI is configured for telemetry")

    def _report_stages(self, *reports: Report) -> None:
        """Report stages of commands that the flight executes, and note results of scheduled commands."""
        for one in reports:
            self._scheduling.reported(one)
        self._report(*reports)

    def _report(self, *reports: Report) -> None:
        for one in reports:
            values = {name: getattr(one, name) for name in ("spi", "counter", "name", "text")}
            self._send(VERIFICATION, {**values, "stage": int(one.stage), **one.request._asdict()})

    def _status(self) -> None:
        gate, vault = self._gate, self._vault
        known = {spi: vault.read(spi) for spi in (*COMMAND_SPIS, *TELEMETRY_SPIS)}
        self._keys_returned = vault.rebuilt and known[COMMAND_SPIS[0]] is not None
        gates = [gate.association(spi) for spi in COMMAND_SPIS]
        values = {
            "received": self._received,
            "admitted": gate.admitted,
            **{f"refused_{cause.name.lower()}": gate.refused[cause] for cause in Refusal},
            "highest": [-2 if entry is None else entry.unused - 1 for entry in gates],
            "generation": [0 if entry is None else entry.generation for entry in known.values()],
            "copies": [vault.copies(spi) for spi in known],
            "refused_command": self._refused_commands,
            "sent": self._downlink.sent,
            "thinned": self._downlink.thinned,
            "playing": int(self._downlink.playing),
            "played_ns": self._downlink.played_ns,
            "unreported": self.unreported,
            "corrected": self._codes.commands.corrected,
            "untaken": self._transmitter.untaken,
        }
        if self._downlink.waiting > _STATUS_WAITING:  # a status that waits would displace reports of commands
            return
        self._send(LINK, values)
        for progress in self._filing.status():
            self._send(TRANSFER, values_of(progress))

    def _send(self, packet: Packet, values: dict[str, Any]) -> None:
        """Queue a report packet for sending. A packet whose values do not fit is counted and dropped."""
        try:
            self._downlink.report(self._packer.pack(packet, self._time_ns(), values))
        except TelemetryError as error:
            self._unpacked += 1
            self._unpacked_text = str(error)

    def _time_ns(self) -> int:
        """Return the mission time (ns), limited to the range of the time field in a packet."""
        return min(self._mission_ns + self._clock.now_ns() - self._mission_at_ns, _HIGHEST_REPORTED)


def parser_of(spacecraft: int) -> Callable[[bytes], tuple[bytes, bytes]]:
    """Return a function that splits a telecommand frame of this spacecraft into header and protected data."""
    size = TELECOMMAND_HEADER.size

    def parse(frame: bytes) -> tuple[bytes, bytes]:
        body = open_telecommand(frame, spacecraft)
        return body[:size], body[size:]

    return parse
