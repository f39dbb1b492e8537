"""CCSDS space packets: packing, parsing, and the search for valid packets in a stretch of bytes.

A packet is the primary header of CCSDS 133.0-B-2 (6 bytes: version 0, telemetry, secondary header present,
APID; unsegmented, 14-bit sequence count of that APID; data length minus one), a secondary header (version
of the definition, u1; mission time in ns, i8), the fields of the table `flight.link.telemetry.definitions`,
and a packet error control of 16 bits: the CRC of CCSDS 232.0-B (x^16 + x^12 + x^5 + 1, preset to ones) over
all preceding bytes. All numbers are big-endian.

The search accepts a packet if its version bits, APID, sequence flags, length and CRC are right. After other
bytes it continues at the next byte that could begin a packet, so that only damaged packets are lost.
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
from spacepackets.ccsds.spacepacket import (  # type: ignore[import-untyped]  # it ships no py.typed
    PacketId,
    PacketSeqCtrl,
    PacketType,
    SequenceFlags,
)

from flight.link.telemetry.definitions import PACKETS, Field, Packet
from knightcube.errors import FlightError

PacketArray = npt.NDArray[np.void]

HEADER_BYTES = 6
SECONDARY_BYTES = 9
CRC_BYTES = 2
LONGEST_PACKET = 4096  # bounds the search for packets of another version in a damaged log
SEQUENCE_MODULUS = 1 << 14
UNSEGMENTED = int(PacketSeqCtrl(SequenceFlags.UNSEGMENTED, 0).raw())

_STRUCT_CODES = {"f8": "d", "f4": "f", "u1": "B", "u2": "H", "u4": "I", "u8": "Q", "i8": "q"}


class TelemetryError(FlightError):
    """Raised for values that do not fit the definition of their packet and for bytes that are not packets."""


def crc16(data: bytes) -> int:
    """Return the CRC-16 of CCSDS 232.0-B ("CCITT-FALSE"); 0 over a packet that ends in its own CRC."""
    return binascii.crc_hqx(data, 0xFFFF)


def to_text(value: bytes) -> str:
    """Return the text of a string field, padding removed."""
    return bytes(value).rstrip(b"\0").decode("utf-8", "replace")


def _to_bytes(value: object, size: int) -> bytes:
    """Return a text as less than `size` bytes of UTF-8, cut between characters; others become '?'.

    At least one zero follows, by which clients of the XTCE definition find the end of the text.
    """
    if not isinstance(value, str):
        raise TypeError("a text is needed")
    raw = value.encode("utf-8", "replace")
    return raw if len(raw) < size else raw[: size - 1].decode("utf-8", "ignore").encode("utf-8")


def _text_size(field: Field) -> int:
    """Return the bytes of a string field, 0 for a number."""
    return int(field.kind[1:]) if field.kind.startswith("S") else 0


def wraps_at(field: Field) -> int:
    """Return the modulus of a counter, 0 for a field that does not wrap."""
    return 1 << 8 * np.dtype(field.kind).itemsize if field.wraps else 0


def _struct_code(field: Field) -> str:
    return f"{_text_size(field)}s" if _text_size(field) else f"{field.count}{_STRUCT_CODES[field.kind]}"


@dataclass(frozen=True)
class Layout:
    """Layout of the bytes of a packet, compiled from its definition."""

    packet: Packet

    @cached_property
    def identifier(self) -> int:
        """The first 16 bits of the primary header."""
        kind = PacketType.TC if self.packet.telecommand else PacketType.TM
        return int(PacketId(kind, sec_header_flag=True, apid=self.packet.apid).raw())

    @cached_property
    def body(self) -> struct.Struct:
        """Both headers and the fields, without the CRC."""
        return struct.Struct(">HHHBq" + "".join(_struct_code(field) for field in self.packet.fields))

    @cached_property
    def length(self) -> int:
        """Bytes of the whole packet."""
        return self.body.size + CRC_BYTES

    @cached_property
    def fields(self) -> tuple[tuple[str, int, int, int], ...]:
        """Name, length (bytes) of a text or 0, count, and modulus of a counter or 0, for each field."""
        return tuple(
            (field.name, _text_size(field), field.count, wraps_at(field)) for field in self.packet.fields
        )

    @cached_property
    def offsets(self) -> dict[str, int]:
        """The first byte of `time_ns` and of every field, by name."""
        offsets = {"time_ns": HEADER_BYTES + 1}
        offset = HEADER_BYTES + SECONDARY_BYTES
        for field in self.packet.fields:
            offsets[field.name] = offset
            offset += np.dtype(field.kind).itemsize * field.count
        return offsets

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The numpy type of one whole packet: `time_ns`, then the fields of the table."""
        formats = [">i8"]
        for field in self.packet.fields:
            number = np.dtype(field.kind).newbyteorder(">")
            formats.append(f"{field.count if field.count > 1 else ''}{number.str}")
        names, offsets = list(self.offsets), list(self.offsets.values())
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": self.length})

    def array(self, packets: bytes) -> PacketArray:
        """Return a structured array, read-only and without a copy, of whole packets back to back."""
        return np.frombuffer(packets, dtype=self.dtype)

    def sequence_counts(self, packets: bytes) -> npt.NDArray[np.int64]:
        """Return the 14-bit sequence counts of whole packets back to back."""
        view = np.dtype({"names": ["word"], "formats": [">u2"], "offsets": [2], "itemsize": self.length})
        return np.asarray(np.frombuffer(packets, dtype=view)["word"].astype(np.int64) % SEQUENCE_MODULUS)


def compile_layouts(packets: Iterable[Packet]) -> dict[str, Layout]:
    """Return the layouts of a table by packet name. Raises TelemetryError for an inconsistent table."""
    layouts = {packet.name: Layout(packet) for packet in packets}
    apids = [layout.packet.apid for layout in layouts.values()]
    if len(set(apids)) != len(apids):
        raise TelemetryError("two packets of the definition table share an APID")
    for name, layout in layouts.items():
        names = [field.name for field in layout.packet.fields]
        if len({*names, "time_ns"}) != len(names) + 1:
            raise TelemetryError(f"packet {name}: a field's name is used twice, or is 'time_ns'")
        if layout.length > LONGEST_PACKET:
            raise TelemetryError(f"packet {name}: {layout.length} bytes, more than {LONGEST_PACKET}")
    return layouts


LAYOUTS: dict[str, Layout] = compile_layouts(PACKETS)


class Packer:
    """Makes packets with a sequence count per APID. Not thread-safe."""

    def __init__(self, layouts: Mapping[str, Layout] | None = None) -> None:
        """Pack the packets of a compiled table, by default of the telemetry table."""
        self._layouts = LAYOUTS if layouts is None else layouts
        self._counts = dict.fromkeys(self._layouts, 0)

    def pack(
        self, packet: Packet, time_ns: int, values: Mapping[str, object] | None = None, /, **fields: object
    ) -> bytes:
        """Return the bytes of one packet at mission time `time_ns`, all fields given by name.

        Texts too long for their field are cut between two characters, counters past their end wrap. NaN
        passes: the table says where it means "none". Raises TelemetryError for a missing or unknown field, a
        wrong length, or a value out of range; such a packet is not counted.
        """
        given = fields if values is None else {**values, **fields} if fields else values
        layout = self._layouts[packet.name]
        count = self._counts[packet.name]
        data_length = layout.length - HEADER_BYTES - 1
        flat: list[Any] = [layout.identifier, UNSEGMENTED | count, data_length, packet.version, time_ns]
        try:
            for name, text_size, items, end in layout.fields:
                value: Any = given[name]
                if text_size:
                    flat.append(_to_bytes(value, text_size))
                elif end and value >= end:
                    flat.append(value % end)
                elif items == 1:
                    flat.append(value)
                else:
                    flat += _to_items(value, items)
            body = layout.body.pack(*flat)
        except (KeyError, TypeError, ValueError, OverflowError, struct.error) as error:
            raise _explain(layout, time_ns, given) from error
        if len(given) != len(layout.fields):
            raise _explain(layout, time_ns, given)
        self._counts[packet.name] = (count + 1) % SEQUENCE_MODULUS
        return body + crc16(body).to_bytes(CRC_BYTES, "big")


def _to_items(value: Any, count: int) -> list[Any]:
    """Return the numbers of an array field. Raises ValueError if their number is not `count`."""
    items: list[Any] = value.tolist() if isinstance(value, np.ndarray) else value
    if type(items) is not list:
        items = list(items)
    if len(items) != count:
        raise ValueError(f"{len(items)} values where {count} are needed")
    return items


def _explain(layout: Layout, time_ns: int, given: Mapping[str, object]) -> TelemetryError:
    """Return the error that names the wrong value of a packet that cannot be packed."""
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
# A known identifier, or its first byte as the last byte of all.
_START = re.compile(
    b"|".join(re.escape(i) + b"|" + re.escape(i[:1]) + rb"\Z" for i in BY_IDENTIFIER), re.DOTALL
)
_SEQUENCE_FLAGS = UNSEGMENTED >> 8  # as the first byte of the sequence control carries them


def walk(data: bytes) -> Iterator[tuple[Layout, int, int]]:
    """Yield layout, first byte and end of each valid packet of any version."""
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
    """Return the length of an incomplete packet at the end of `data`, 0 if there is none.

    `begin` is the end of the last valid packet.
    """
    position, end = begin, len(data)
    while position < end:
        if _cut_short(data, position):
            return end - position
        match = _START.search(data, position + 1)
        position = match.start() if match else end
    return 0


def _valid_length(data: bytes, position: int, layout: Layout) -> int:
    """Return the length of the valid packet at `position`, 0 if there is none."""
    length = _stated_length(data, position)
    stop = position + length
    if length < HEADER_BYTES + 1 or stop > len(data):
        return 0
    if data[position + 2] & _SEQUENCE_FLAGS != _SEQUENCE_FLAGS:
        return 0
    own_version = data[position + HEADER_BYTES] == layout.packet.version
    plausible = length == layout.length if own_version else length <= LONGEST_PACKET
    return length if plausible and crc16(data[position:stop]) == 0 else 0


def _stated_length(data: bytes, position: int) -> int:
    """Return the packet length in the header at `position`, 0 if the header is incomplete."""
    header = data[position : position + HEADER_BYTES]
    return int.from_bytes(header[4:], "big") + HEADER_BYTES + 1 if len(header) == HEADER_BYTES else 0


def _cut_short(data: bytes, position: int) -> bool:
    """Return whether an incomplete packet may begin at `position`."""
    left = len(data) - position
    if left == 1:
        return any(identifier[:1] == data[position:] for identifier in BY_IDENTIFIER)
    layout = BY_IDENTIFIER.get(data[position : position + 2])
    if layout is None or left >= layout.length:
        return False
    return left < HEADER_BYTES or _stated_length(data, position) == layout.length
