"""Commands as values, and as the bytes of one packet each; other packets are refused with the reason."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flight.gnc.errors import FlightError, UsageError
from flight.gnc.guidance.three_axes.pointing_target import NUMBERS, Goal, PointingTarget
from flight.link.commands.definitions import CLEAR, LAYOUTS, MODE, PING, POINT, SAFE, SLEW
from flight.link.modes import Mode
from flight.link.telemetry.form import Packet
from flight.link.telemetry.packets import HEADER_BYTES, Packer, TelemetryError, crc16, to_text

LONGEST = max(layout.length for layout in LAYOUTS.values())
"""Bytes of the longest command; longer packets are refused."""

_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}
IDENTIFIERS = tuple(_BY_IDENTIFIER)
"""The first 16 bits of a command: one of these."""


class CommandError(FlightError):
    """Bytes or values that are no command; says why."""


class MalformedError(CommandError):
    """Bytes that are no packet of a command: never answered, so that two flights cannot answer each other."""


@dataclass(frozen=True, slots=True)
class Ping:
    """Answer."""

    number: int = 0


@dataclass(frozen=True, slots=True)
class ChangeMode:
    """Go into a mode; `reason` is for the log."""

    mode: Mode
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Slew:
    """Go to an attitude."""

    q2: float


@dataclass(frozen=True, slots=True)
class Clear:
    """Clear a latched event, so that it can be raised again."""

    event: str


@dataclass(frozen=True, slots=True)
class Point:
    """Point to a goal."""

    target: PointingTarget


Command = Ping | ChangeMode | Slew | Clear | Point


def name_of(command: Command) -> str:
    """Return the name of the packet that carries a command."""
    match command:
        case Ping():
            return PING.name
        case ChangeMode(mode):
            return SAFE.name if mode is Mode.SAFE else MODE.name
        case Slew():
            return SLEW.name
        case Clear():
            return CLEAR.name
        case Point():
            return POINT.name


def fields_of(command: Command) -> dict[str, Any]:
    """Return the fields of the packet that carries a command, by name."""
    match command:
        case Ping(number):
            return {"number": number}
        case ChangeMode(mode, reason):
            return {"reason": reason} if mode is Mode.SAFE else {"mode": int(mode)}
        case Slew(q2):
            return {"q2": q2}
        case Clear(event):
            return {"event": event}
        case Point(target):
            return _fields(target)


def command_of(packet: Packet, fields: Mapping[str, Any]) -> Command:
    """Return the command of a packet's fields by name. Raises CommandError for values that are none."""
    check(packet, fields)
    match packet.name:
        case PING.name:
            return Ping(fields["number"])
        case SAFE.name:
            return ChangeMode(Mode.SAFE, fields["reason"])
        case MODE.name:
            return ChangeMode(Mode(fields["mode"]))
        case SLEW.name:
            return Slew(fields["q2"])
        case POINT.name:
            return Point(_target(fields["goal"], fields["numbers"], fields["roll"]))
        case _:
            return Clear(fields["event"])


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
    """Makes the packets of commands, and counts them."""

    def __init__(self) -> None:
        self._packer = Packer(LAYOUTS)

    def pack(self, command: Command, utc_ns: int) -> bytes:
        """Return the bytes of a command sent at `utc_ns`. Raises CommandError for values that are none."""
        packet, fields = LAYOUTS[name_of(command)].packet, fields_of(command)
        check(packet, fields)
        try:
            return self._packer.pack(packet, utc_ns, fields)
        except TelemetryError as error:
            raise CommandError(str(error)) from error


def unpack(data: bytes) -> Command:
    """Return the command that `data` is, all of it.

    Raises MalformedError for bytes that are no packet of a command, CommandError for values that are none.
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


def shown(text: str) -> str:
    """Return a text with its control characters, and others that do not print, as escapes."""
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return "".join(escaped)


def describe(command: Command) -> str:
    """Return a command in words that print."""
    match command:
        case Ping(number):
            return f"ping {number}"
        case ChangeMode(mode, reason):
            return f"mode {mode.label}" + (f": {shown(reason)}" if reason else "")
        case Slew(q2):
            return f"slew to q2 {q2:+.4f}" if math.isfinite(q2) else "slew"
        case Clear(event):
            return f"clear {shown(event)}"
        case Point(target):
            return f"point {target.text}"


def _fields(target: PointingTarget) -> dict[str, Any]:
    spare = 4 - len(target.numbers)
    return {
        "goal": int(target.goal),
        "numbers": [*target.numbers, *[math.nan] * spare],
        "roll": math.nan if target.roll is None else target.roll,
    }


def _target(number: int, numbers: list[float], roll: float) -> PointingTarget:
    """Return the target of a packet's fields. Raises CommandError; a roll of NaN is free."""
    goal = Goal(number)
    try:
        counts = NUMBERS.get(goal, (0,))
        given = numbers[: counts[-1]]
        if 0 in counts and all(map(math.isnan, given)):
            given = []
        return PointingTarget(goal, tuple(given), None if math.isnan(roll) else roll)
    except UsageError as error:
        raise CommandError(str(error)) from error
