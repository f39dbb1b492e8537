"""Classes that define packets and their fields, for `flight.link.telemetry.definitions`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Range = tuple[float, float]
States = tuple[tuple[int, str], ...]
NO_YES: States = ((0, "no"), (1, "yes"))
Level = Literal["warning", "fault"]
Alarms = tuple[tuple[int, Level], ...]


@dataclass(frozen=True, slots=True)
class Limits:
    """Nominal ranges (low, high) of a value. A value outside its range causes a warning or a fault."""

    warning: Range | None = None
    fault: Range | None = None


@dataclass(frozen=True, slots=True)
class Field:
    """Definition of one field of a packet. Numbers are big-endian in the packet.

    Attributes:
        kind: numpy type code (f8, f4, u1, u2, u4, u8, i8), or S<n> for n bytes of UTF-8 text.
        count: number of values; a field with more than one value is an array.
        states: numbers and names of the states of an enumerated field.
        bits: numbers and names of the bits of a bit field, of which several can be set.
        alarms: states or set bits that are reported as a warning or a fault.
        limits: nominal ranges of a numeric field without states.
        valid: allowed range (low, high) of a command argument.
        wraps: whether the field is a counter that continues at 0 after its largest number.
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


def counter(name: str, meaning: str) -> Field:
    """Return the definition of a counter field, which wraps at the end of its range."""
    return Field(name, "u4", "-", meaning, wraps=True)


def flag(name: str, meaning: str) -> Field:
    """Return the definition of a Boolean field with the states no and yes."""
    return Field(name, "u1", "-", meaning, states=NO_YES)


@dataclass(frozen=True, slots=True)
class Packet:
    """Definition of a packet: name, application process identifier (APID), rate and fields.

    The text `hazard` states the harm that a telecommand can cause. The text is empty for a harmless packet.
    """

    name: str
    apid: int
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    version: int = field(default=1)
    telecommand: bool = False
    hazard: str = ""
