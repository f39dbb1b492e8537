"""Telecommands: packet definitions, conversion between commands, packets and text, and receiving sockets.

Telecommands are CCSDS space packets of type 1. The field `time_ns` of the secondary header must be unique per
command, for example the sender's UTC, so that a packet duplicated by the network is executed only once.
Ground and satellite check the arguments of a command against the states and ranges in its packet definition.
The words of the command `knightcube command` are derived from the same definitions.

The receive queue of a socket is short. An unknown sender could fill the queue between two polls, and commands
from known senders would then be lost. A classic BPF filter (linux/filter.h) therefore makes the kernel drop
datagrams that come from unknown senders or do not begin with the packet identifier of a command. The data
that the filter can inspect begin with the UDP header for UDP sockets, and with the payload for UNIX sockets.
"""

from __future__ import annotations

import difflib
import math
import os
import socket
import stat
import struct
import zlib
from array import array
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path
from typing import Any, ClassVar, Protocol

from flight.link.events import COMMANDABLE, EVENTS, Mode
from flight.link.telemetry.definitions import PARAMETER_FIELDS, PARAMETER_KEYS, Field, Packet
from flight.link.telemetry.packets import (
    HEADER_BYTES,
    Layout,
    Packer,
    TelemetryError,
    compile_layouts,
    crc16,
    to_text,
)
from knightcube.errors import KnightCubeError, UsageError, shown
from knightcube.gnc.guidance.plant import Q2_LIMIT
from knightcube.gnc.guidance.pointing_target import NUMBERS, Goal, PointingTarget

_MODES = tuple((int(mode), mode.label) for mode in COMMANDABLE if mode is not Mode.SLEW)
_NUMBERS = (
    "for inertial: quaternion, ICRS into body; for ground: latitude and longitude, rad; for object: right "
    "ascension and declination of the search, rad, or NaN to search along the camera's boresight"
)
_GOALS = tuple((int(goal), goal.label) for goal in Goal)


def crc_of(values: Sequence[float]) -> int:
    """Return the CRC-32 of parameter values, encoded as big-endian doubles in table order."""
    return zlib.crc32(struct.pack(f">{len(PARAMETER_FIELDS)}d", *values))


def problem_of(values: Mapping[str, float]) -> str:
    """Return why a parameter table is invalid (missing or unknown key, value out of range), or ""."""
    if lacking := [key for key in PARAMETER_KEYS if key not in values]:
        return f"{lacking[0]} is missing: give all parameters of the table"
    if unknown := sorted(set(values) - set(PARAMETER_KEYS)):
        return f"{unknown[0]} is not a parameter: use {', '.join(PARAMETER_KEYS)}"
    for key, parameter in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True):
        low, high = parameter.valid or (-math.inf, math.inf)
        if not low <= values[key] <= high:  # NaN compares false
            return f"{key} = {values[key]:g} must lie within {low:g} to {high:g} {parameter.unit}"
    warning, hottest = values["health.temperature"], values["health.hottest"]
    if warning > hottest:
        return f"health.temperature = {warning:g} must not exceed health.hottest = {hottest:g} degree C"
    return ""


def telecommand(name: str, apid: int, meaning: str, *fields: Field, hazard: str = "") -> Packet:
    """Return the definition of a telecommand packet."""
    return Packet(name, apid, "at will", meaning, fields, telecommand=True, hazard=hazard)


PING = telecommand(
    "ping",
    0x201,
    "Answer without any other effect",
    Field("number", "u4", "-", "number that the reply echoes"),
)
SAFE = telecommand(
    "safe",
    0x202,
    "Abort: change to safe mode: no coil current in a testbed, detumbling and Sun pointing in a satellite",
    Field("reason", "S64", "-", "reason for the log"),
    hazard="ends pointing and slews until the next command",
)
MODE = telecommand(
    "mode",
    0x203,
    "Change the mode",
    Field("mode", "u1", "-", "new mode", states=_MODES),
    hazard="moves the body or stops its motion",
)
SLEW = telecommand(
    "slew",
    0x204,
    "Slew to an attitude and hold it",
    Field("q2", "f8", "-", "commanded final q2", valid=(-Q2_LIMIT, Q2_LIMIT)),
    hazard="moves the body",
)
CLEAR = telecommand(
    "clear",
    0x205,
    "Clear a latched event",
    Field("event", "S32", "-", "name of the event, as in the log"),
    hazard="uses a device again that the event excluded, for example a broken coil",
)
POINT = telecommand(
    "point",
    0x206,
    "Point a satellite to a goal",
    Field("goal", "u1", "-", "goal to point to", states=_GOALS),
    Field("numbers", "f8", "-", _NUMBERS, 4),
    Field("roll", "f8", "rad", "roll about the pointing axis; NaN for a free roll"),
    hazard="moves the body",
)

LOAD_PARAMETERS = telecommand(
    "load-parameters",
    0x210,
    "Replace the whole table of parameters",
    Field(
        "replaced",
        "u4",
        "-",
        "CRC-32 of the table to be replaced; the command is refused if another table is in use",
    ),
    Field("crc", "u4", "-", "CRC-32 of the values, as big-endian doubles in this order"),
    *PARAMETER_FIELDS,
    hazard="changes the limits at which the satellite detumbles, stops or warns",
)
DUMP_PARAMETERS = telecommand("dump-parameters", 0x211, "Report the table of parameters in use")

COMMANDS: tuple[Packet, ...] = (PING, SAFE, MODE, SLEW, CLEAR, POINT, LOAD_PARAMETERS, DUMP_PARAMETERS)

LAYOUTS: dict[str, Layout] = compile_layouts(COMMANDS)
"""Layouts of the command packets by name."""


class CommandError(KnightCubeError):
    """Raised for bytes or values that are not a valid command. The error text states the reason."""


class MalformedError(CommandError):
    """Raised for bytes that are not a command.

    Such bytes are not answered, so that two flights cannot answer each other endlessly.
    """


class _Command:
    """Base class of commands; attributes are named like packet fields unless `fields` is overridden."""

    __slots__ = ()
    packet: ClassVar[Packet]

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the packet's fields by field name."""
        return {field.name: getattr(self, field.name) for field in self.packet.fields}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return str(self)


@dataclass(frozen=True, slots=True)
class Ping(_Command):
    """Command that requests an answer with the same number."""

    number: int = 0
    packet = PING

    def __str__(self) -> str:
        return f"ping {self.number}"


@dataclass(frozen=True, slots=True)
class ChangeMode:
    """Command to change the mode. The text `reason` is written to the log."""

    mode: Mode
    reason: str = ""

    @property
    def packet(self) -> Packet:
        """Packet definition of the command. Safe mode is commanded by a packet of its own."""
        return SAFE if self.mode is Mode.SAFE else MODE

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the packet's fields by field name."""
        return {"reason": self.reason} if self.mode is Mode.SAFE else {"mode": int(self.mode)}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return str(self)

    def __str__(self) -> str:
        return f"mode {self.mode.label}" + (f": {shown(self.reason)}" if self.reason else "")


@dataclass(frozen=True, slots=True)
class Slew(_Command):
    """Command to slew to an attitude."""

    q2: float
    packet = SLEW

    def __str__(self) -> str:
        return f"slew to q2 {self.q2:+.4f}" if math.isfinite(self.q2) else "slew"


@dataclass(frozen=True, slots=True)
class Clear(_Command):
    """Command to clear a latched event, so that the event can be raised again."""

    event: str
    packet = CLEAR

    def __str__(self) -> str:
        return f"clear {shown(self.event)}"


@dataclass(frozen=True, slots=True)
class Point(_Command):
    """Command to point to a target."""

    target: PointingTarget
    packet = POINT

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the packet's fields by field name. Unused numbers and a free roll angle are NaN."""
        target = self.target
        return {
            "goal": int(target.goal),
            "numbers": [*target.numbers, *[math.nan] * (4 - len(target.numbers))],
            "roll": math.nan if target.roll is None else target.roll,
        }

    def __str__(self) -> str:
        return f"point {self.target.text}"


@dataclass(frozen=True, slots=True)
class LoadParameters(_Command):
    """Command to replace the table whose CRC-32 is `replaced`; new values are in the order of the table."""

    replaced: int
    values: tuple[float, ...]
    packet = LOAD_PARAMETERS

    @property
    def by_key(self) -> dict[str, float]:
        """New parameter values by configuration key."""
        return dict(zip(PARAMETER_KEYS, self.values, strict=True))

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the packet's fields by field name."""
        named = {field.name: value for field, value in zip(PARAMETER_FIELDS, self.values, strict=True)}
        return {"replaced": self.replaced, "crc": crc_of(self.values), **named}

    def __str__(self) -> str:
        return f"load-parameters {crc_of(self.values):08x} replacing {self.replaced:08x}"


@dataclass(frozen=True, slots=True)
class DumpParameters(_Command):
    """Command to report the parameter table in use."""

    packet = DUMP_PARAMETERS

    def __str__(self) -> str:
        return "dump-parameters"


Command = Ping | ChangeMode | Slew | Clear | Point | LoadParameters | DumpParameters


def _target(number: int, numbers: list[float], roll: float) -> PointingTarget:
    """Return the pointing target in the fields of a POINT packet. Raises CommandError for wrong values."""
    goal = Goal(number)
    try:
        counts = NUMBERS.get(goal, (0,))
        given = numbers[: counts[-1]]
        if 0 in counts and all(map(math.isnan, given)):
            given = []
        return PointingTarget(goal, tuple(given), None if math.isnan(roll) else roll)
    except UsageError as error:
        raise CommandError(str(error)) from error


def _table(fields: Mapping[str, Any]) -> LoadParameters:
    """Return the parameter table in the fields of a packet. Raises CommandError for a wrong CRC."""
    values = tuple(fields[field.name] for field in PARAMETER_FIELDS)
    if fields["crc"] != crc_of(values):
        raise CommandError(f"crc = {fields['crc']:08x}, but the CRC of the values is {crc_of(values):08x}")
    return LoadParameters(fields["replaced"], values)


MAKERS: Mapping[str, Callable[[Mapping[str, Any]], Command]] = {
    PING.name: lambda fields: Ping(fields["number"]),
    SAFE.name: lambda fields: ChangeMode(Mode.SAFE, fields["reason"]),
    MODE.name: lambda fields: ChangeMode(Mode(fields["mode"])),
    SLEW.name: lambda fields: Slew(fields["q2"]),
    CLEAR.name: lambda fields: Clear(fields["event"]),
    POINT.name: lambda fields: Point(_target(fields["goal"], fields["numbers"], fields["roll"])),
    LOAD_PARAMETERS.name: _table,
    DUMP_PARAMETERS.name: lambda _: DumpParameters(),
}
"""Functions by packet name; each creates a command from the fields of such a packet."""


_DEGREES = "deg"
"""Unit of the angles in a command that is written in words."""
LONGEST = max(layout.length for layout in LAYOUTS.values())
"""Length (bytes) of the longest command packet. Longer packets are refused."""

_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}
IDENTIFIERS = tuple(_BY_IDENTIFIER)
"""Packet identifiers of the commands. An identifier is the first 16 bits of a packet."""


def command_of(packet: Packet, fields: Mapping[str, Any]) -> Command:
    """Return the command in the fields of a packet. Raises CommandError for forbidden values."""
    check(packet, fields)
    return MAKERS[packet.name](fields)


def check(packet: Packet, fields: Mapping[str, Any]) -> None:
    """Raise CommandError if a field of a packet is outside the states or range of its definition."""
    for field in packet.fields:
        value = fields[field.name]
        if field.states and value not in dict(field.states):
            allowed = ", ".join(f"{number} {label}" for number, label in field.states)
            raise CommandError(f"{field.name} = {value} cannot be commanded: use one of {allowed}")
        if field.valid is not None and not field.valid[0] <= value <= field.valid[1]:  # NaN compares false
            low, high = field.valid
            raise CommandError(f"{field.name} = {value} must lie within {low:g} to {high:g}")
    if packet is CLEAR and (problem := event_problem(fields["event"])):
        raise CommandError(f"clear: {shown(fields['event'])!r} {problem}")


def event_problem(name: str) -> str:
    """Return why `name` is not the name of an event, with the most similar name, or "" for an event."""
    names = [kind.name for kind in EVENTS]
    if name in names:
        return ""
    close = difflib.get_close_matches(name, names, n=1)
    cure = f"did you mean {close[0]}?" if close else "use a name of the page Events"
    return f"is not the name of an event: {cure}"


class CommandPacker:
    """Encodes commands as packets, and counts the packets of each type."""

    def __init__(self) -> None:
        self._packer = Packer(LAYOUTS)

    def pack(self, command: Command, utc_ns: int) -> bytes:
        """Return a command encoded as a packet. Raises CommandError for forbidden values."""
        check(command.packet, command.fields)
        try:
            return self._packer.pack(command.packet, utc_ns, command.fields)
        except TelemetryError as error:
            raise CommandError(str(error)) from error


def unpack(data: bytes) -> Command:
    """Return the command in a packet. Raises MalformedError or, for wrong values, CommandError."""
    if len(data) < HEADER_BYTES:
        raise MalformedError(f"{len(data)} bytes are too short for a packet")
    layout = _BY_IDENTIFIER.get(int.from_bytes(data[:2], "big"))
    if layout is None:
        raise MalformedError(f"no command begins with 0x{int.from_bytes(data[:2], 'big'):04x}")
    stated = int.from_bytes(data[4:HEADER_BYTES], "big") + HEADER_BYTES + 1
    if not len(data) == stated == layout.length:
        raise MalformedError(
            f"{layout.packet.name} has {layout.length} bytes, but {len(data)} were received"
            f" and the header states {stated}"
        )
    if crc16(data) != 0:
        raise MalformedError("its CRC is wrong")
    if data[HEADER_BYTES] != layout.packet.version:
        raise CommandError(f"version {data[HEADER_BYTES]} of {layout.packet.name} is not known")
    (row,) = layout.array(data)
    fields = {
        field.name: to_text(row[field.name]) if field.kind.startswith("S") else row[field.name].tolist()
        for field in layout.packet.fields
    }
    return command_of(layout.packet, fields)


def command_of_words(text: str, stored: bool = False) -> Command:
    """Return the command of a line such as `slew 0.2` or `point ground 52.5deg 13.4deg roll 90deg`.

    The line consists of the command's name and the values of its fields, in the order of the packet
    definition. A state is written as its label, and an angle of `point` with its unit. Omitted real numbers
    at the end of the line become NaN, and a text field takes the rest of the line. If `stored` is true, the
    line may come from an earlier release and have angles in rad without a unit. Raises CommandError for an
    unknown command, for superfluous words and for values out of range.
    """
    name, *words = text.split() or [""]
    if name not in LAYOUTS:
        raise CommandError(f"{name!r} is not a command: use {', '.join(LAYOUTS)}")
    packet = LAYOUTS[name].packet
    if packet is POINT:
        words = _by_fields(words, stored)
    fields: dict[str, Any] = {}
    for field in packet.fields:
        if field.kind.startswith("S"):
            fields[field.name], words = " ".join(words), []
            continue
        taken, words = words[: field.count], words[field.count :]
        numbers = [_number(field, word) for word in [*taken, *[""] * (field.count - len(taken))]]
        fields[field.name] = numbers if field.count > 1 else numbers[0]
    if words:
        last = packet.fields[-1].name if packet.fields else name
        raise CommandError(f"{text}: unexpected words after {last}")
    command = command_of(packet, fields)
    CommandPacker().pack(command, 0)
    return command


def _by_fields(words: list[str], stored: bool) -> list[str]:
    """Return the arguments of `point` in the order and units of the packet's fields."""
    goal, numbers = words[:1], words[1:]
    is_attitude = goal == [Goal.INERTIAL.label]
    keyword = next((at for at, word in enumerate(numbers) if word in {"roll", "--roll"}), None)
    if keyword is not None:
        if len(numbers) != keyword + 2:
            raise CommandError(f"roll needs one angle such as 90{_DEGREES}")
        numbers = [*numbers[:keyword], *["nan"] * (4 - keyword), *numbers[keyword + 1 :]]
    most = next((NUMBERS.get(one, (0,))[-1] for one in Goal if goal == [one.label]), 4)
    if not stored and any(word != "nan" for word in numbers[most:4]):
        raise CommandError(f"{goal[0]} takes at most {most} numbers: give a roll as roll 90{_DEGREES}")
    return goal + [
        word if is_attitude and at < 4 else _in_radians(word, stored) for at, word in enumerate(numbers)
    ]


def _in_radians(word: str, stored: bool) -> str:
    try:
        if word.endswith(_DEGREES):
            return repr(math.radians(float(word.removesuffix(_DEGREES))))
    except ValueError:
        raise CommandError(f"{word!r} is not an angle such as 52.5{_DEGREES}") from None
    if stored or word == "nan":
        return word
    raise CommandError(f"{word!r} has no unit: give an angle such as 52.5{_DEGREES}")


def words_of(command: Command) -> str:
    """Return a command as a line that `command_of_words` converts back. Numbers have 10 digits."""
    words = [command.packet.name]
    if isinstance(command, Point):
        target = command.target
        angles = [f"{math.degrees(angle):.10g}{_DEGREES}" for angle in (*target.numbers, target.roll or 0.0)]
        numbers = [f"{one:.10g}" for one in target.numbers] if target.goal is Goal.INERTIAL else angles[:-1]
        roll = [] if target.roll is None else ["roll", angles[-1]]
        return " ".join([*words, target.goal.label, *numbers, *roll])
    for field in command.packet.fields:
        value = command.fields[field.name]
        labels = dict(field.states)
        words += [
            f"{one:.10g}" if isinstance(one, float) else str(labels.get(one, one))
            for one in (value if field.count > 1 else [value])
        ]
    while words[-1] in {"", "nan"}:
        words.pop()
    return " ".join(words)


def _number(field: Field, word: str) -> float | int:
    for number, label in field.states:
        if word == label:
            return number
    real = field.kind.startswith("f")
    if not word and real:
        return math.nan
    try:
        return float(word) if real else int(word)
    except ValueError:
        labels = ", ".join(label for _, label in field.states)
        raise CommandError(
            f"{field.name} = {word!r}: {f'one of {labels}' if labels else field.meaning}"
        ) from None


_SO_ATTACH_FILTER = 26
_SOURCE = 0xFFF00000 + 12  # SKF_NET_OFF plus the offset of the IPv4 source address
_UDP_HEADER_BYTES = 8
_LOAD_WORD, _LOAD_HALF, _AND, _EQUAL, _RETURN = 0x20, 0x28, 0x54, 0x15, 0x06
_DROP, _WHOLE = (_RETURN, 0, 0, 0), (_RETURN, 0, 0, 0xFFFF)

_Instruction = tuple[int, int, int, int]
"""BPF instruction: operation code, jump offset if true, jump offset if false, and operand."""


def filter_datagrams(
    bound: socket.socket, peers: Sequence[IPv4Network] | None, identifiers: Sequence[int] = ()
) -> None:
    """Attach a kernel filter that drops datagrams from addresses outside `peers`, unless `peers` is None.

    If `identifiers` are given, the filter also drops datagrams which do not begin with one of them. If the
    kernel refuses the filter, the socket receives all datagrams, and its reader must check them.
    """
    start = _UDP_HEADER_BYTES if bound.family == socket.AF_INET else 0
    left = len(identifiers)
    program: list[_Instruction] = []
    if identifiers:
        program = [(_LOAD_HALF, 0, 0, start)]
        program += [(_EQUAL, left - number, 0, identifier) for number, identifier in enumerate(identifiers)]
        program.append(_DROP)
    for peer in peers or ():
        network = (_EQUAL, 0, 1, int(peer.network_address))
        program += [(_LOAD_WORD, 0, 0, _SOURCE), (_AND, 0, 0, int(peer.netmask)), network, _WHOLE]
    program.append(_WHOLE if peers is None else _DROP)
    code = array("B", b"".join(struct.pack("@HBBI", *instruction) for instruction in program))
    # The kernel expects struct sock_fprog: the number of instructions and a pointer to the first instruction.
    with suppress(OSError):
        packed = struct.pack("@HP", len(program), code.buffer_info()[0])
        bound.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, packed)


AT_MOST = 16
"""Maximum number of datagrams read per poll, so that a flood of datagrams does not delay the control loop."""

_LOOK_EVERY = 10
"""Number of polls between two checks that the socket file exists. In flight, ten polls take one second."""


class Channel(Protocol):
    """Receiver of datagrams that also returns each sender's address, to which an answer can be sent."""

    name: str

    def poll(self) -> list[tuple[bytes, Any]]:
        """Return received datagrams with their senders, oldest first, without blocking or raising errors."""

    def news(self) -> str:
        """Return a description of events since the last call, or an empty text."""

    def answer(self, data: bytes, sender: Any) -> None:
        """Send an answer to a sender that has an address, without blocking or raising errors."""

    def close(self) -> None:
        """Close the channel. Calling `close` again has no effect."""


class DatagramChannel:
    """Channel of a bound datagram socket. A UNIX socket whose file was removed is bound again."""

    def __init__(
        self,
        name: str,
        bound: socket.socket,
        path: Path | None = None,
        peers: Sequence[IPv4Network] | None = None,
    ) -> None:
        """Use a bound socket; `close` closes the socket and removes the file `path` of a UNIX socket.

        Only datagrams from the networks `peers` are accepted, or all datagrams if `peers` is None.
        """
        self.name = name
        self._socket = bound
        self._path, self._peers = path, peers
        self._polls = 0
        self._news = ""
        self._closed = False
        bound.setblocking(False)
        self._file = _identity(path)

    def poll(self) -> list[tuple[bytes, Any]]:
        """Return the received datagrams, oldest first, each cut to one byte more than the longest command."""
        self._polls += 1
        if self._path is not None and not self._closed and self._polls % _LOOK_EVERY == 0:
            self._look(self._path)
        found = []
        for _ in range(AT_MOST):
            try:
                data, sender = self._socket.recvfrom(LONGEST + 1)
            except OSError:  # no datagram is waiting, or an earlier answer caused an ICMP error
                break
            if self._peers is None or any(IPv4Address(sender[0]) in peers for peers in self._peers):
                found.append((data, sender))
        return found

    def news(self) -> str:
        """Return a description of events since the last call, or an empty text."""
        news, self._news = self._news, ""
        return news

    def answer(self, data: bytes, sender: Any) -> None:
        """Send an answer to a sender, if the sender has an address."""
        if sender:
            with suppress(OSError):
                self._socket.sendto(data, sender)

    def close(self) -> None:
        """Close the socket and remove its file, unless another socket has replaced the file."""
        self._socket.close()
        self._closed = True
        if self._path is not None and self._file is not None and _identity(self._path) == self._file:
            with suppress(OSError):
                self._path.unlink()

    def _look(self, path: Path) -> None:
        """Bind the socket again if its file was removed or replaced; retry at the next check."""
        if self._file is not None and _identity(path) == self._file:
            return
        try:
            bound = _bound_unix(path)
        except OSError as error:
            if self._file is not None:
                self._news = f"{path} was removed and cannot be bound again: {error.strerror or error}"
            self._file = None
            return
        bound.setblocking(False)
        old, self._socket, self._file = self._socket, bound, _identity(path)
        old.close()
        self._news = f"{path} had been removed and is bound again"


def open_unix(path: Path) -> DatagramChannel:
    """Bind a UNIX datagram socket that owner and group may write to. A stale socket file is replaced.

    Raises UsageError if `path` is a file of another kind, if a process listens at `path`, or if binding
    fails.
    """
    try:
        bound = _bound_unix(path)
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"commands.socket: cannot listen on {path}: {reason}") from error
    return DatagramChannel("socket", bound, path)


def _bound_unix(path: Path) -> socket.socket:
    """Return a UNIX datagram socket bound to `path`. Raises OSError if the socket cannot be bound."""
    bound = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        with suppress(FileNotFoundError):
            if not stat.S_ISSOCK(path.lstat().st_mode):
                raise OSError("a file that is not a socket has this path")
            if _is_served(path):
                raise OSError("another flight listens there")
            path.unlink()
        before = os.umask(0o117)
        try:
            bound.bind(str(path))
        finally:
            os.umask(before)
    except OSError:
        bound.close()
        raise
    filter_datagrams(bound, None, IDENTIFIERS)
    return bound


def open_udp(address: str, peers: Sequence[IPv4Network] | None = None) -> DatagramChannel:
    """Bind a UDP socket to HOST:PORT for senders in `peers`, or for all senders.

    Raises UsageError if the socket cannot be bound.
    """
    host, _, port = address.rpartition(":")
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind((host, int(port)))
    except (OSError, OverflowError) as error:
        bound.close()
        raise UsageError(f"commands.udp: cannot listen on {address}: {error}") from error
    filter_datagrams(bound, peers, IDENTIFIERS)
    return DatagramChannel("udp", bound, peers=peers)


def _identity(path: Path | None) -> tuple[int, int] | None:
    """Return the device and inode of a file, or None if it does not exist."""
    try:
        found = os.lstat(path) if path is not None else None
    except OSError:
        return None
    return None if found is None else (found.st_dev, found.st_ino)


def _is_served(path: Path) -> bool:
    """Return whether a process is bound to a socket file."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True
