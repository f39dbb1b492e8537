"""Commands as values, and as the bytes of one packet each; other packets are refused with the reason."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flight.gnc.errors import FlightError, UsageError
from flight.gnc.guidance.one_axis.limits import Q2_LIMIT
from flight.gnc.guidance.three_axes.pointing_target import NUMBERS, Goal, PointingTarget
from flight.link.commands.definitions import CLEAR, LAYOUTS, MODE, PING, POINT, SAFE, SLEW
from flight.link.modes import COMMANDABLE, Mode
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


def check(command: Command) -> None:
    """Refuse values that no flight can obey; raises CommandError."""
    match command:
        case ChangeMode(mode) if mode not in COMMANDABLE or mode is Mode.SLEW:
            allowed = ", ".join(m.label for m in COMMANDABLE if m is not Mode.SLEW)
            raise CommandError(f"mode {mode.label} is not to be commanded so: one of {allowed}")
        case Slew(q2) if not abs(q2) <= Q2_LIMIT:  # NaN compares false
            raise CommandError(f"q2 = {q2} must lie within +-{Q2_LIMIT}")
        case Clear(event) if not event:
            raise CommandError("clear needs the name of an event")


class CommandPacker:
    """Makes the packets of commands, and counts them."""

    def __init__(self) -> None:
        self._packer = Packer(LAYOUTS)

    def pack(self, command: Command, utc_ns: int) -> bytes:
        """Return the bytes of a command sent at `utc_ns`. Raises CommandError for values that are none."""
        check(command)
        try:
            match command:
                case Ping(number):
                    return self._packer.pack(PING, utc_ns, number=number)
                case ChangeMode(mode, reason) if mode is Mode.SAFE:
                    return self._packer.pack(SAFE, utc_ns, reason=reason)
                case ChangeMode(mode):
                    return self._packer.pack(MODE, utc_ns, mode=int(mode))
                case Slew(q2):
                    return self._packer.pack(SLEW, utc_ns, q2=q2)
                case Clear(event):
                    return self._packer.pack(CLEAR, utc_ns, event=event)
                case Point(target):
                    return self._packer.pack(POINT, utc_ns, **_fields(target))
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
    command: Command
    match layout.packet.name:
        case PING.name:
            command = Ping(int(row["number"]))
        case SAFE.name:
            command = ChangeMode(Mode.SAFE, to_text(row["reason"]))
        case MODE.name:
            command = ChangeMode(_mode(int(row["mode"])))
        case SLEW.name:
            command = Slew(float(row["q2"]))
        case POINT.name:
            command = Point(_target(int(row["goal"]), row["numbers"].tolist(), float(row["roll"])))
        case _:
            command = Clear(to_text(row["event"]))
    check(command)
    return command


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


def _mode(number: int) -> Mode:
    try:
        return Mode(number)
    except ValueError:
        raise CommandError(f"{number} is no mode") from None


def _fields(target: PointingTarget) -> dict[str, object]:
    spare = 4 - len(target.numbers)
    return {
        "goal": int(target.goal),
        "numbers": [*target.numbers, *[math.nan] * spare],
        "roll": math.nan if target.roll is None else target.roll,
    }


def _target(number: int, numbers: list[float], roll: float) -> PointingTarget:
    """Return the target of a packet's fields. Raises CommandError; a roll of NaN is free."""
    try:
        goal = Goal(number)
    except ValueError:
        raise CommandError(f"{number} is no goal") from None
    try:
        count = NUMBERS.get(goal, 0)
        return PointingTarget(goal, tuple(numbers[:count]), None if math.isnan(roll) else roll)
    except UsageError as error:
        raise CommandError(str(error)) from error
