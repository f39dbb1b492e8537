"""The form of a packet's definition; `flight.link.telemetry.definitions` is the table of all."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Range = tuple[float, float]
States = tuple[tuple[int, str], ...]
Level = Literal["warning", "fault"]
Alarms = tuple[tuple[int, Level], ...]


@dataclass(frozen=True, slots=True)
class Limits:
    """The ranges (low, high) that a value lies in while all is well; outside, it is a warning or a fault."""

    warning: Range | None = None
    fault: Range | None = None


@dataclass(frozen=True, slots=True)
class Field:
    """One field: `kind` is a numpy type code (f8, f4, u1, u2, u4, u8, i8) or S<n> for n bytes of UTF-8.

    `count` > 1 makes an array. All numbers are big-endian on the wire.

    Attributes:
        states: the numbers that may stand in the field, each with its name.
        bits: the bits that may be set in the field, each with its name; several may be.
        alarms: the states, or the bits when set, that are a warning or a fault.
        limits: when a value without states is a warning or a fault.
        valid: the range (low, high) of a command's argument.
        wraps: past its largest number the field goes on at 0, as a counter may.
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
    """Return a field that counts, and wraps."""
    return Field(name, kind, "-", meaning, wraps=True)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet: its application process identifier (APID), rate and fields.

    `hazard` states the harm that a telecommand can do; empty where there is none.
    """

    name: str
    apid: int
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    version: int = field(default=1)
    telecommand: bool = False
    hazard: str = ""
