"""The form of a packet's definition; `flight.link.telemetry.definitions` is the table of all."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Field:
    """One field: `kind` is a numpy type code (f8, f4, u1, u2, u4, u8, i8) or S<n> for n bytes of UTF-8.

    `count` > 1 makes an array. All numbers are big-endian on the wire.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    count: int = 1


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet: its application process identifier (APID), rate and fields."""

    name: str
    apid: int
    rate: str
    meaning: str
    fields: tuple[Field, ...]
    version: int = field(default=1)
    telecommand: bool = False
