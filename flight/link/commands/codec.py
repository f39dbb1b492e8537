"""Commands as the bytes of one packet each; other packets are refused with the reason."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flight.link.commands.definitions import CLEAR, LAYOUTS
from flight.link.commands.errors import CommandError, MalformedError
from flight.link.commands.values import MAKERS, Command
from flight.link.telemetry.form import Packet
from flight.link.telemetry.packets import HEADER_BYTES, Packer, TelemetryError, crc16, to_text

LONGEST = max(layout.length for layout in LAYOUTS.values())
"""Bytes of the longest command; longer packets are refused."""

_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}
IDENTIFIERS = tuple(_BY_IDENTIFIER)
"""The first 16 bits of a command: one of these."""


def command_of(packet: Packet, fields: Mapping[str, Any]) -> Command:
    """Return the command of a packet's fields by name. Raises CommandError for values that are none."""
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
    """Makes the packets of commands, and counts them."""

    def __init__(self) -> None:
        self._packer = Packer(LAYOUTS)

    def pack(self, command: Command, utc_ns: int) -> bytes:
        """Return the bytes of a command sent at `utc_ns`. Raises CommandError for values that are none."""
        check(command.packet, command.fields)
        try:
            return self._packer.pack(command.packet, utc_ns, command.fields)
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
