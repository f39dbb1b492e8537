"""Space packets that carry units of CFDP: header and time as in every packet, the unit, a CRC of 16 bits.

Their length varies, so they stand beside the tables of packets and not in them.
"""

from __future__ import annotations

import struct

from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, SECONDARY_BYTES, UNSEGMENTED, crc16

DOWN = 0x0973
"""First 16 bits of a packet with a unit for the ground: telemetry, APID 0x173."""
UP = 0x1A28
"""First 16 bits of one for the satellite: telecommand, APID 0x228."""
VERSION = 1

_HEADERS = struct.Struct(">HHHBq")
_MODULUS = 1 << 14


class UnitPacker:
    """Makes the packets of one direction, and counts them."""

    def __init__(self, identifier: int) -> None:
        """Make packets that begin with `identifier`, `DOWN` or `UP`."""
        self._identifier = identifier
        self._count = 0

    def pack(self, unit: bytes, time_ns: int) -> bytes:
        """Return the packet of a unit."""
        length = SECONDARY_BYTES + len(unit) + CRC_BYTES - 1
        body = _HEADERS.pack(self._identifier, UNSEGMENTED | self._count, length, VERSION, time_ns) + unit
        self._count = (self._count + 1) % _MODULUS
        return body + crc16(body).to_bytes(CRC_BYTES, "big")


def is_unit(packet: bytes, identifier: int) -> bool:
    """Return whether a packet is one of `DOWN`, or of `UP`."""
    return int.from_bytes(packet[:2], "big") == identifier


def unit_of(packet: bytes) -> bytes:
    """Return the unit that a packet carries; empty where the packet is damaged."""
    stated = int.from_bytes(packet[4:HEADER_BYTES], "big") + HEADER_BYTES + 1
    known = len(packet) == stated and packet[HEADER_BYTES : HEADER_BYTES + 1] == bytes((VERSION,))
    return packet[HEADER_BYTES + SECONDARY_BYTES : -CRC_BYTES] if known and crc16(packet) == 0 else b""
