"""Walks over the packets in a stretch of bytes, whatever has happened to it.

A packet is valid when its version bits, APID, sequence flags, length and CRC are right. After anything
else the search goes on at the next byte that could begin a packet, so that only damaged packets are lost.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from flight.link.telemetry.packets import HEADER_BYTES, LAYOUTS, LONGEST_PACKET, UNSEGMENTED, Layout, crc16

BY_IDENTIFIER = {layout.identifier.to_bytes(2, "big"): layout for layout in LAYOUTS.values()}
# A known identifier, or its first byte as the last byte of all.
_START = re.compile(
    b"|".join(re.escape(i) + b"|" + re.escape(i[:1]) + rb"\Z" for i in BY_IDENTIFIER), re.DOTALL
)
_SEQUENCE_FLAGS = UNSEGMENTED >> 8  # as the first byte of the sequence control carries them


def walk(data: bytes) -> Iterator[tuple[Layout, int, int]]:
    """Yield layout, first byte and end of each valid packet, also of other versions than the table's."""
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
    """Return how many bytes at the end of `data`, behind its last packet, look like a packet cut short."""
    position, end = begin, len(data)
    while position < end:
        if _cut_short(data, position):
            return end - position
        match = _START.search(data, position + 1)
        position = match.start() if match else end
    return 0


def _valid_length(data: bytes, position: int, layout: Layout) -> int:
    """Return the length of the valid packet at `position`, 0 when there is none."""
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
    """Return the length that the header at `position` states, 0 when the header itself is incomplete."""
    header = data[position : position + HEADER_BYTES]
    return int.from_bytes(header[4:], "big") + HEADER_BYTES + 1 if len(header) == HEADER_BYTES else 0


def _cut_short(data: bytes, position: int) -> bool:
    """Return whether `position` may begin a packet of which the end is missing."""
    left = len(data) - position
    if left == 1:
        return any(identifier[:1] == data[position:] for identifier in BY_IDENTIFIER)
    layout = BY_IDENTIFIER.get(data[position : position + 2])
    if layout is None or left >= layout.length:
        return False
    return left < HEADER_BYTES or _stated_length(data, position) == layout.length
