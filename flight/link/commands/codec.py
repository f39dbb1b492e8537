"""Commands as values, as words and as packets. Packets that are no command are refused with the reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from flight.link.commands.definitions import (
    CLEAR,
    DUMP_PARAMETERS,
    LAYOUTS,
    LOAD_PARAMETERS,
    MODE,
    PING,
    POINT,
    SAFE,
    SLEW,
)
from flight.link.modes import Mode
from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import HEADER_BYTES, Packer, TelemetryError, crc16, to_text
from flight.link.telemetry.parameters import FIELDS, KEYS, crc_of
from knightcube.errors import FlightError, UsageError
from knightcube.gnc.guidance.three_axes.pointing_target import NUMBERS, Goal, PointingTarget


class CommandError(FlightError):
    """Raised for bytes or values that are not a valid command; the text states the reason."""


class MalformedError(CommandError):
    """Raised for bytes that are not a command packet.

    Such bytes are never answered, so that two flights cannot answer each other without end.
    """


@dataclass(frozen=True, slots=True)
class Ping:
    """Answer."""

    number: int = 0
    packet = PING

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name."""
        return {"number": self.number}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return f"ping {self.number}"


@dataclass(frozen=True, slots=True)
class ChangeMode:
    """Go into a mode; `reason` is for the log."""

    mode: Mode
    reason: str = ""

    @property
    def packet(self) -> Packet:
        """The packet of the command: SAFE has its own packet."""
        return SAFE if self.mode is Mode.SAFE else MODE

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name."""
        return {"reason": self.reason} if self.mode is Mode.SAFE else {"mode": int(self.mode)}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return f"mode {self.mode.label}" + (f": {shown(self.reason)}" if self.reason else "")


@dataclass(frozen=True, slots=True)
class Slew:
    """Go to an attitude."""

    q2: float
    packet = SLEW

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name."""
        return {"q2": self.q2}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return f"slew to q2 {self.q2:+.4f}" if math.isfinite(self.q2) else "slew"


@dataclass(frozen=True, slots=True)
class Clear:
    """Clear a latched event, so that it can be raised again."""

    event: str
    packet = CLEAR

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name."""
        return {"event": self.event}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return f"clear {shown(self.event)}"


@dataclass(frozen=True, slots=True)
class Point:
    """Point to a goal."""

    target: PointingTarget
    packet = POINT

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name; spare numbers and a free roll are NaN."""
        target = self.target
        return {
            "goal": int(target.goal),
            "numbers": [*target.numbers, *[math.nan] * (4 - len(target.numbers))],
            "roll": math.nan if target.roll is None else target.roll,
        }

    @property
    def text(self) -> str:
        """The command as printable text."""
        return f"point {self.target.text}"


@dataclass(frozen=True, slots=True)
class LoadParameters:
    """Replace the table of parameters whose CRC is `replaced` by `values`, in the order of the table."""

    replaced: int
    values: tuple[float, ...]
    packet = LOAD_PARAMETERS

    @property
    def by_key(self) -> dict[str, float]:
        """The values by their keys in a configuration."""
        return dict(zip(KEYS, self.values, strict=True))

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name."""
        named = {field.name: value for field, value in zip(FIELDS, self.values, strict=True)}
        return {"replaced": self.replaced, "crc": crc_of(self.values), **named}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return f"load-parameters {crc_of(self.values):08x} in place of {self.replaced:08x}"


@dataclass(frozen=True, slots=True)
class DumpParameters:
    """Report the table of parameters."""

    packet = DUMP_PARAMETERS

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields: none."""
        return {}

    @property
    def text(self) -> str:
        """The command as printable text."""
        return "dump-parameters"


Command = Ping | ChangeMode | Slew | Clear | Point | LoadParameters | DumpParameters


def shown(text: str) -> str:
    """Return a text in which characters that do not print are replaced by escapes."""
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return "".join(escaped)


def _target(number: int, numbers: list[float], roll: float) -> PointingTarget:
    """Return the target of a packet's fields; a roll of NaN means a free roll. Raises CommandError."""
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
    """Return the table in a packet's fields. Raises CommandError if its CRC is wrong."""
    values = tuple(fields[field.name] for field in FIELDS)
    if fields["crc"] != crc_of(values):
        raise CommandError(f"crc = {fields['crc']:08x}, but that of the values is {crc_of(values):08x}")
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
"""Functions that make a command from the fields of a packet, by packet name."""


LONGEST = max(layout.length for layout in LAYOUTS.values())
"""Length (bytes) of the longest command; longer packets are refused."""

_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}
IDENTIFIERS = tuple(_BY_IDENTIFIER)
"""First 16 bits of all command packets."""


def command_of(packet: Packet, fields: Mapping[str, Any]) -> Command:
    """Return the command of a packet's fields. Raises CommandError for values outside the table."""
    check(packet, fields)
    return MAKERS[packet.name](fields)


def check(packet: Packet, fields: Mapping[str, Any]) -> None:
    """Refuse fields outside the states and ranges of the table. Raises CommandError."""
    for field in packet.fields:
        value = fields[field.name]
        if field.states and value not in dict(field.states):
            allowed = ", ".join(f"{number} {label}" for number, label in field.states)
            raise CommandError(f"{field.name} = {value} is not to be commanded so: one of {allowed}")
        if field.valid is not None and not field.valid[0] <= value <= field.valid[1]:  # NaN compares false
            low, high = field.valid
            raise CommandError(f"{field.name} = {value} must lie within {low:g} to {high:g}")
    if packet is CLEAR and not fields["event"]:
        raise CommandError("clear needs the name of an event")


class CommandPacker:
    """Makes the packets of commands with their sequence counts."""

    def __init__(self) -> None:
        self._packer = Packer(LAYOUTS)

    def pack(self, command: Command, utc_ns: int) -> bytes:
        """Return the packet of a command. Raises CommandError for values outside the table."""
        check(command.packet, command.fields)
        try:
            return self._packer.pack(command.packet, utc_ns, command.fields)
        except TelemetryError as error:
            raise CommandError(str(error)) from error


def unpack(data: bytes) -> Command:
    """Return the command in a packet.

    Raises MalformedError for bytes that are not a command packet and CommandError for invalid values.
    """
    if len(data) < HEADER_BYTES:
        raise MalformedError(f"{len(data)} bytes are no packet")
    layout = _BY_IDENTIFIER.get(int.from_bytes(data[:2], "big"))
    if layout is None:
        raise MalformedError(f"no command begins with 0x{int.from_bytes(data[:2], 'big'):04x}")
    stated = int.from_bytes(data[4:HEADER_BYTES], "big") + HEADER_BYTES + 1
    if not len(data) == stated == layout.length:
        raise MalformedError(f"{len(data)} bytes, {stated} stated, {layout.packet.name} has {layout.length}")
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


def command_of_words(text: str) -> Command:
    """Return the command of a line such as `slew 0.2`, `mode hold`, `safe end of pass` or `point sun`.

    A line is the name of the command, then each field in order, in the units of the table; labels stand for
    states. Missing numbers at the end are NaN, and a text field takes the rest of the line. Raises
    CommandError, also for a number outside the range of its field.
    """
    name, *words = text.split() or [""]
    if name not in LAYOUTS:
        raise CommandError(f"{name!r} is no command: {', '.join(LAYOUTS)}")
    packet = LAYOUTS[name].packet
    fields: dict[str, Any] = {}
    for field in packet.fields:
        if field.kind.startswith("S"):
            fields[field.name], words = " ".join(words), []
            continue
        taken, words = words[: field.count], words[field.count :]
        numbers = [_number(field, word) for word in [*taken, *[""] * (field.count - len(taken))]]
        fields[field.name] = numbers if field.count > 1 else numbers[0]
    if words:
        raise CommandError(f"{text}: nothing is to stand behind {packet.fields[-1].name}")
    command = command_of(packet, fields)
    CommandPacker().pack(command, 0)
    return command


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
