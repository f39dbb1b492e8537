"""Makes arrays of the packets in a stretch of bytes, and accounts for all of its bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.link.telemetry.packets import (
    HEADER_BYTES,
    LAYOUTS,
    SEQUENCE_MODULUS,
    Layout,
    PacketArray,
    TelemetryError,
    truncated_bytes,
    walk,
)


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
    claimed = other_versions = last = 0
    for layout, begin, end in walk(data):
        if data[begin + HEADER_BYTES] == layout.packet.version:
            found[layout.packet.name].append(data[begin:end])
        else:
            other_versions += 1
        claimed += end - begin
        last = end
    truncated = truncated_bytes(data, last)
    joined = {name: b"".join(packets) for name, packets in found.items()}
    return ScanResult(
        packets={name: LAYOUTS[name].array(raw) for name, raw in joined.items()},
        total_bytes=len(data),
        skipped_bytes=len(data) - claimed - truncated,
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


def _missing(layout: Layout, packets: bytes) -> int:
    """Return how many packets the sequence counts of those found say are missing between them."""
    if len(packets) <= layout.length:  # most kinds of packets are in no datagram
        return 0
    steps = np.diff(layout.sequence_counts(packets))
    return int(np.sum((steps - 1) % SEQUENCE_MODULUS))
