"""The telemetry of the parameters."""

from __future__ import annotations

from dataclasses import replace

from flight.link.parameters import FIELDS
from flight.link.telemetry.form import Field, Packet, counter
from flight.link.telemetry.states import NO_YES, TABLES

PARAMETERS = Packet(
    "parameters",
    0x184,
    "at the start of a flight that takes commands, at each load, at will",
    "The table of parameters that flies",
    (
        counter("loads", "tables loaded, earlier boots included"),
        Field("crc", "u4", "-", "CRC-32 of the values, as big-endian doubles in this order"),
        Field("table", "u1", "-", "where it comes from", states=TABLES),
        Field("kept", "u1", "-", "it outlives the process", states=NO_YES),
        *(replace(field, valid=None) for field in FIELDS),
    ),
)
