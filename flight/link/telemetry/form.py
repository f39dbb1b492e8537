"""Types of a packet definition; `flight.link.telemetry.definitions` is the table of all packets."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Range = tuple[float, float]
States = tuple[tuple[int, str], ...]
Level = Literal["warning", "fault"]
Alarms = tuple[tuple[int, Level], ...]


@dataclass(frozen=True, slots=True)
class Limits:
    """Nominal ranges (low, high) of a value; a value outside is a warning or a fault."""

    warning: Range | None = None
    fault: Range | None = None


@dataclass(frozen=True, slots=True)
class Field:
    """One field: `kind` is a numpy type code (f8, f4, u1, u2, u4, u8, i8) or S<n> for n bytes of UTF-8.

    `count` > 1 makes an array. All numbers are big-endian on the wire.

    Attributes:
        states: the values of an enumerated field, each with its name.
        bits: the bits of a bit field, each with its name; several bits can be set.
        alarms: the states or set bits that are a warning or a fault.
        limits: the nominal ranges of a value without states.
        valid: the allowed range (low, high) of a command's argument.
        wraps: whether the field continues at 0 after its largest number.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    count: int = 1
    states: States = ()
    alarms: Alarms = ()
    limits: Limits | None = None
    valid: Range | None = None
    wraps: bool = False
    bits: States = ()


def counter(name: str, meaning: str, kind: str = "u4") -> Field:
    """Return the field of a counter, which wraps at the end of its range."""
    return Field(name, kind, "-", meaning, wraps=True)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet: its application process identifier (APID), rate and fields.

    `hazard` states the harm that a telecommand can cause, empty if there is none.
    """

    name: str
    apid: int
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    version: int = field(default=1)
    telecommand: bool = False
    hazard: str = ""
