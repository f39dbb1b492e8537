"""Finds the packets in a stretch of bytes, whatever has happened to it, and makes arrays of them.

A packet is valid when its version bits, APID, sequence flags, length and CRC are right. After anything
else the search goes on at the next byte that could begin a packet, so that only damaged packets are lost.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from flight.link.telemetry.packets import (
    HEADER_BYTES,
    LAYOUTS,
    LONGEST_PACKET,
    SEQUENCE_MODULUS,
    UNSEGMENTED,
    Layout,
    PacketArray,
    TelemetryError,
    crc16,
)

_BY_IDENTIFIER = {layout.identifier.to_bytes(2, "big"): layout for layout in LAYOUTS.values()}
# A known identifier, or its first byte as the last byte of all.
_START = re.compile(
    b"|".join(re.escape(i) + b"|" + re.escape(i[:1]) + rb"\Z" for i in _BY_IDENTIFIER), re.DOTALL
)

_SEQUENCE_FLAGS = UNSEGMENTED >> 8  # as the first byte of the sequence control carries them


@dataclass(frozen=True)
class ScanResult:
    """What was found in a stretch of bytes.

    Attributes:
        packets: for every packet of the table a structured array in order of arrival, empty when none came.
        total_bytes: length of the stretch.
        skipped_bytes: bytes that belong to no valid packet, those of a truncated tail excepted.
        truncated_bytes: bytes at the end that look like a packet cut short.
        missing: for every packet of the table how many the sequence counts say are missing between those
            found (of a loss of 16,384 or more in a row only the remainder is seen).
        other_versions: valid packets of this table's APIDs in another version than the table's; not decoded.
    """

    packets: dict[str, PacketArray]
    total_bytes: int
    skipped_bytes: int
    truncated_bytes: int
    missing: dict[str, int]
    other_versions: int

    @property
    def counts(self) -> dict[str, int]:
        """Packets found, by name; those that came not at all are left out."""
        return {name: len(array) for name, array in self.packets.items() if len(array)}

    @property
    def intact(self) -> bool:
        """Whether every byte and every sequence count is accounted for."""
        damage = self.skipped_bytes + self.truncated_bytes + self.other_versions
        return damage + sum(self.missing.values()) == 0


def scan(data: bytes) -> ScanResult:
    """Return the packets in `data` and an account of all its bytes."""
    found: dict[str, list[bytes]] = {name: [] for name in LAYOUTS}
    position = claimed = other_versions = 0
    incomplete = -1  # where the first packet cut short may begin, since the last valid one
    end = len(data)
    while position < end:
        layout = _BY_IDENTIFIER.get(data[position : position + 2])
        length = 0 if layout is None else _valid_length(data, position, layout)
        if layout is not None and length > 0:
            packet = data[position : position + length]
            if packet[HEADER_BYTES] == layout.packet.version:
                found[layout.packet.name].append(packet)
            else:
                other_versions += 1
            position += length
            claimed += length
            incomplete = -1
            continue
        if incomplete < 0 and _cut_short(data, position):
            incomplete = position
        match = _START.search(data, position + 1)
        position = match.start() if match else end
    truncated = end - incomplete if incomplete >= 0 else 0
    joined = {name: b"".join(packets) for name, packets in found.items()}
    return ScanResult(
        packets={name: LAYOUTS[name].array(raw) for name, raw in joined.items()},
        total_bytes=end,
        skipped_bytes=end - claimed - truncated,
        truncated_bytes=truncated,
        missing={name: _missing(LAYOUTS[name], raw) for name, raw in joined.items()},
        other_versions=other_versions,
    )


def decode(data: bytes) -> dict[str, PacketArray]:
    """Return the arrays of `data`, which must be whole valid packets. Raises TelemetryError otherwise."""
    result = scan(data)
    bad = result.skipped_bytes + result.truncated_bytes
    if bad or result.other_versions:
        others = result.other_versions
        raise TelemetryError(f"{bad} bytes are no packets, {others} packets are of another version")
    return result.packets


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
        return any(identifier[:1] == data[position:] for identifier in _BY_IDENTIFIER)
    layout = _BY_IDENTIFIER.get(data[position : position + 2])
    if layout is None or left >= layout.length:
        return False
    return left < HEADER_BYTES or _stated_length(data, position) == layout.length


def _missing(layout: Layout, packets: bytes) -> int:
    """Return how many packets the sequence counts of those found say are missing between them."""
    if len(packets) <= layout.length:  # most kinds of packets are in no datagram
        return 0
    steps = np.diff(layout.sequence_counts(packets))
    return int(np.sum((steps - 1) % SEQUENCE_MODULUS))
