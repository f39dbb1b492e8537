"""CCSDS space packets: encoding, decoding, and the search for valid packets in a byte string.

A packet consists of a primary header, a secondary header, the fields of the packet definition
(`flight.link.telemetry.definitions`) and a CRC. The primary header (CCSDS 133.0-B-2, 6 bytes) contains the
APID, a 14-bit sequence count per APID and the data length; all packets are unsegmented. The secondary header
contains the version of the packet definition (u1) and the mission time in ns (i8). The CRC has 16 bits and
covers all preceding bytes (CCSDS 232.0-B: polynomial x^16 + x^12 + x^5 + 1, initial value all ones). All
numbers are big-endian.

The search accepts a packet if its version bits, APID, sequence flags, length and CRC are correct. After
invalid bytes the search continues at the next byte that could begin a packet, so that only damaged packets
are lost.
"""

from __future__ import annotations

import binascii
import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.definitions import PACKETS, Field, Packet
from knightcube.errors import KnightCubeError

PacketArray = Any
"""Structured array (n,) with a column for each field of a packet. The type is `Any`, because numpy's types do
not describe the columns, and because mypy then needs a third less time for the repository."""

HEADER_BYTES = 6
SECONDARY_BYTES = 9
_SECONDARY_HEADER = 1 << 11  # flag of the secondary header in the first word of the primary header
CRC_BYTES = 2
LONGEST_PACKET = 4096  # maximum packet length (bytes), which limits the search in a damaged log
SEQUENCE_MODULUS = 1 << 14
UNSEGMENTED = 0b11 << 14  # sequence flags in the second word of the primary header

_STRUCT_CODES = {"f8": "d", "f4": "f", "u1": "B", "u2": "H", "u4": "I", "u8": "Q", "i8": "q"}


class TelemetryError(KnightCubeError):
    """Raised for values that do not fit the packet definition and for bytes that are not a packet."""


def crc16(data: bytes) -> int:
    """Return the CRC-16 of CCSDS 232.0-B (CCITT-FALSE), which is 0 for data that end with their CRC."""
    return binascii.crc_hqx(data, 0xFFFF)


def to_text(value: bytes) -> str:
    """Return the text of a string field without its zero padding."""
    return bytes(value).rstrip(b"\0").decode("utf-8", "replace")


def _to_bytes(value: object, size: int) -> bytes:
    """Return a text as UTF-8 of less than `size` bytes, for clients that need a terminating zero.

    The text is truncated between characters. Characters that cannot be encoded become '?'.
    """
    if not isinstance(value, str):
        raise TypeError("a text is needed")
    raw = value.encode("utf-8", "replace")
    return raw if len(raw) < size else raw[: size - 1].decode("utf-8", "ignore").encode("utf-8")


def _text_size(field: Field) -> int:
    """Return the length (bytes) of a string field, 0 for a numeric field."""
    return int(field.kind[1:]) if field.kind.startswith("S") else 0


def wraps_at(field: Field) -> int:
    """Return the modulus of a counter field, 0 for a field that does not wrap."""
    return 1 << 8 * np.dtype(field.kind).itemsize if field.wraps else 0


def _struct_code(field: Field) -> str:
    return f"{_text_size(field)}s" if _text_size(field) else f"{field.count}{_STRUCT_CODES[field.kind]}"


@dataclass(frozen=True)
class Layout:
    """Byte layout of a packet, computed from the packet definition."""

    packet: Packet

    @cached_property
    def identifier(self) -> int:
        """First 16 bits of the primary header, which identify the packet type."""
        return self.packet.telecommand << 12 | _SECONDARY_HEADER | self.packet.apid

    @cached_property
    def body(self) -> struct.Struct:
        """Struct format of both headers and all fields, without the CRC."""
        return struct.Struct(">HHHBq" + "".join(_struct_code(field) for field in self.packet.fields))

    @cached_property
    def length(self) -> int:
        """Length (bytes) of the whole packet, including the CRC."""
        return self.body.size + CRC_BYTES

    @cached_property
    def fields(self) -> tuple[tuple[str, int, int, int], ...]:
        """Tuple of name, text length (bytes), number of items and counter modulus for each field.

        The text length is 0 for a numeric field, and the modulus is 0 for a field that does not wrap.
        """
        return tuple(
            (field.name, _text_size(field), field.count, wraps_at(field)) for field in self.packet.fields
        )

    @cached_property
    def offsets(self) -> dict[str, int]:
        """Offset (bytes) of the mission time `time_ns` and of each field in the packet, by name."""
        offsets = {"time_ns": HEADER_BYTES + 1}
        offset = HEADER_BYTES + SECONDARY_BYTES
        for field in self.packet.fields:
            offsets[field.name] = offset
            offset += np.dtype(field.kind).itemsize * field.count
        return offsets

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Structured numpy type of a whole packet, with the mission time `time_ns` and all fields."""
        formats = [">i8"]
        for field in self.packet.fields:
            number = np.dtype(field.kind).newbyteorder(">")
            formats.append(f"{field.count if field.count > 1 else ''}{number.str}")
        names, offsets = list(self.offsets), list(self.offsets.values())
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": self.length})

    def array(self, packets: bytes) -> PacketArray:
        """Return consecutive packets of this type as a read-only structured array without copying."""
        return np.frombuffer(packets, dtype=self.dtype)

    def sequence_counts(self, packets: bytes) -> npt.NDArray[np.int64]:
        """Return the 14-bit sequence counts of consecutive packets of this type."""
        view = np.dtype({"names": ["word"], "formats": [">u2"], "offsets": [2], "itemsize": self.length})
        return np.asarray(np.frombuffer(packets, dtype=view)["word"].astype(np.int64) % SEQUENCE_MODULUS)


def compile_layouts(packets: Iterable[Packet]) -> dict[str, Layout]:
    """Return the layouts of packets by name. Raises TelemetryError, for example for an APID used twice."""
    layouts = {packet.name: Layout(packet) for packet in packets}
    named: dict[int, str] = {}
    for name, layout in layouts.items():
        apid = layout.packet.apid
        if (first := named.setdefault(apid, name)) != name:
            raise TelemetryError(f"packets {first} and {name} share the APID 0x{apid:x}: change one APID")
        names = [field.name for field in layout.packet.fields]
        if len({*names, "time_ns"}) != len(names) + 1:
            raise TelemetryError(f"packet {name}: a field's name is used twice, or is 'time_ns'")
        if layout.length > LONGEST_PACKET:
            raise TelemetryError(f"packet {name}: {layout.length} bytes, more than {LONGEST_PACKET}")
    return layouts


LAYOUTS: dict[str, Layout] = compile_layouts(PACKETS)


def row_of(kind: Packet, packet: bytes) -> Any:
    """Return the values of a valid packet, or None if its type or version is not that of `kind`."""
    layout = LAYOUTS[kind.name]
    known = len(packet) == layout.length and packet[HEADER_BYTES] == kind.version
    return layout.array(packet)[0] if known and packet[:2] == layout.identifier.to_bytes(2, "big") else None


class Packer:
    """Encoder of packets with a sequence count per APID. Not thread-safe."""

    def __init__(self, layouts: Mapping[str, Layout] | None = None) -> None:
        """Use the given packet layouts, by default the layouts of all telemetry packets."""
        self._layouts = LAYOUTS if layouts is None else layouts
        self._counts = dict.fromkeys(self._layouts, 0)

    def pack(
        self, packet: Packet, time_ns: int, values: Mapping[str, object] | None = None, /, **fields: object
    ) -> bytes:
        """Return an encoded packet with mission time `time_ns` and the given field values.

        A text that is too long for its field is truncated between two characters, and a counter that exceeds
        its range wraps. NaN is accepted in all floating-point fields. Raises TelemetryError for a missing or
        unknown field, a wrong array length or a value out of range. An error does not change the sequence
        count.
        """
        given = fields if values is None else {**values, **fields} if fields else values
        layout = self._layouts[packet.name]
        count = self._counts[packet.name]
        data_length = layout.length - HEADER_BYTES - 1
        flat: list[Any] = [layout.identifier, UNSEGMENTED | count, data_length, packet.version, time_ns]
        try:
            for name, text_size, items, end in layout.fields:
                value: Any = given[name]
                if items > 1:
                    flat += value if type(value) is list and len(value) == items else _to_items(value, items)
                elif text_size:
                    flat.append(_to_bytes(value, text_size))
                else:
                    flat.append(value % end if end and value >= end else value)
            body = layout.body.pack(*flat)
        except (KeyError, TypeError, ValueError, OverflowError, struct.error) as error:
            raise _explain(layout, time_ns, given) from error
        if len(given) != len(layout.fields):
            raise _explain(layout, time_ns, given)
        self._counts[packet.name] = (count + 1) % SEQUENCE_MODULUS
        return body + crc16(body).to_bytes(CRC_BYTES, "big")


def _to_items(value: Any, count: int) -> list[Any]:
    """Return the values of an array field as a list. Raises ValueError unless there are `count` values."""
    items: list[Any] = value.tolist() if isinstance(value, np.ndarray) else value
    if type(items) is not list:
        items = list(items)
    if len(items) != count:
        raise ValueError(f"{len(items)} values where {count} are needed")
    return items


def _explain(layout: Layout, time_ns: int, given: Mapping[str, object]) -> TelemetryError:
    """Return an error that names the invalid value of a packet that cannot be packed."""
    name, names = layout.packet.name, [field.name for field in layout.packet.fields]
    if missing := [each for each in names if each not in given]:
        return TelemetryError(f"packet {name}: missing: {', '.join(missing)}")
    if unknown := sorted(set(given) - set(names)):
        return TelemetryError(f"packet {name}: no such field: {', '.join(unknown)}")
    for field in layout.packet.fields:
        value: Any = given[field.name]
        try:
            if _text_size(field):
                _to_bytes(value, _text_size(field))
            elif wraps_at(field):
                struct.pack(">" + _struct_code(field), value % wraps_at(field) if value >= 0 else value)
            else:
                items = _to_items(value, field.count) if field.count > 1 else [value]
                struct.pack(">" + _struct_code(field), *items)
        except (TypeError, ValueError, OverflowError, struct.error) as error:
            kind = f"{field.kind} x {field.count}" if field.count > 1 else field.kind
            return TelemetryError(
                f"packet {name}: {field.name} = {value!r} cannot be stored as {kind}: {error}"
            )
    return TelemetryError(f"packet {name}: mission time {time_ns!r} cannot be stored as i8")


BY_IDENTIFIER = {layout.identifier.to_bytes(2, "big"): layout for layout in LAYOUTS.values()}
# Pattern of a known packet identifier, or of the first byte of an identifier at the end of the data.
_START = re.compile(
    b"|".join(re.escape(i) + b"|" + re.escape(i[:1]) + rb"\Z" for i in BY_IDENTIFIER), re.DOTALL
)
_SEQUENCE_FLAGS = UNSEGMENTED >> 8  # sequence flags in the third byte of the header


def walk(data: bytes) -> Iterator[tuple[Layout, int, int]]:
    """Yield the layout, start offset and end offset of each valid packet in `data`, of any version."""
    position, end = 0, len(data)
    while position < end:
        layout = BY_IDENTIFIER.get(data[position : position + 2])
        length = 0 if layout is None else _valid_length(data, position, layout)
        if layout is not None and length > 0:
            yield layout, position, position + length
            position += length
            continue
        match = _START.search(data, position + 1)
        position = match.start() if match else end


def truncated_bytes(data: bytes, begin: int) -> int:
    """Return the length of an incomplete packet after the last valid packet, which ends at `begin`, or 0."""
    position, end = begin, len(data)
    while position < end:
        if _cut_short(data, position):
            return end - position
        match = _START.search(data, position + 1)
        position = match.start() if match else end
    return 0


def _valid_length(data: bytes, position: int, layout: Layout) -> int:
    """Return the length (bytes) of the valid packet at offset `position`, 0 if there is no valid packet."""
    length = _stated_length(data, position)
    stop = position + length
    if length < HEADER_BYTES + SECONDARY_BYTES + CRC_BYTES or stop > len(data):
        return 0
    if data[position + 2] & _SEQUENCE_FLAGS != _SEQUENCE_FLAGS:
        return 0
    own_version = data[position + HEADER_BYTES] == layout.packet.version
    plausible = length == layout.length if own_version else length <= LONGEST_PACKET
    return length if plausible and crc16(data[position:stop]) == 0 else 0


def _stated_length(data: bytes, position: int) -> int:
    """Return the packet length (bytes) stated in the header at offset `position`, 0 for a partial header."""
    header = data[position : position + HEADER_BYTES]
    return int.from_bytes(header[4:], "big") + HEADER_BYTES + 1 if len(header) == HEADER_BYTES else 0


def _cut_short(data: bytes, position: int) -> bool:
    """Return whether an incomplete packet could begin at offset `position`."""
    left = len(data) - position
    if left == 1:
        return any(identifier[:1] == data[position:] for identifier in BY_IDENTIFIER)
    layout = BY_IDENTIFIER.get(data[position : position + 2])
    if layout is None or left >= layout.length:
        return False
    return left < HEADER_BYTES or _stated_length(data, position) == layout.length
