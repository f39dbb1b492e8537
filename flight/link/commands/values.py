"""Commands as values: each knows the packet that carries it, its fields and words, and is made of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from flight.link.commands.definitions import (
    CLEAR,
    DUMP_PARAMETERS,
    LOAD_PARAMETERS,
    MODE,
    PING,
    POINT,
    SAFE,
    SLEW,
)
from flight.link.commands.errors import CommandError
from flight.link.modes import Mode
from flight.link.parameters import FIELDS, KEYS, crc_of
from flight.link.telemetry.form import Packet
from knightcube.errors import UsageError
from knightcube.gnc.guidance.three_axes.pointing_target import NUMBERS, Goal, PointingTarget


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
        """The command in words that print."""
        return f"ping {self.number}"


@dataclass(frozen=True, slots=True)
class ChangeMode:
    """Go into a mode; `reason` is for the log."""

    mode: Mode
    reason: str = ""

    @property
    def packet(self) -> Packet:
        """The packet that carries it: the abort has one of its own."""
        return SAFE if self.mode is Mode.SAFE else MODE

    @property
    def fields(self) -> dict[str, Any]:
        """The packet's fields, by name."""
        return {"reason": self.reason} if self.mode is Mode.SAFE else {"mode": int(self.mode)}

    @property
    def text(self) -> str:
        """The command in words that print."""
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
        """The command in words that print."""
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
        """The command in words that print."""
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
        """The command in words that print."""
        return f"point {self.target.text}"


@dataclass(frozen=True, slots=True)
class LoadParameters:
    """Fly another table of parameters, `values` in its order, in place of the one whose CRC is `replaced`."""

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
        """The command in words that print."""
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
        """The command in words that print."""
        return "dump-parameters"


Command = Ping | ChangeMode | Slew | Clear | Point | LoadParameters | DumpParameters


def shown(text: str) -> str:
    """Return a text with its control characters, and others that do not print, as escapes."""
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return "".join(escaped)


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


def _table(fields: Mapping[str, Any]) -> LoadParameters:
    """Return the table in a packet's fields. Raises CommandError unless its CRC is that of its values."""
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
"""Makes the command of a packet's fields, by the packet's name."""
