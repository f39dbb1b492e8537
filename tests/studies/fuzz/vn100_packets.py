"""Good, random and hostile packets and sentences of a VN-100, sealed by checksums of this module's own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from hal.drivers.vn100.driver import OUTPUT_SET
from hal.drivers.vn100.protocol import (
    FIELDS,
    HEADER_LENGTHS,
    OutputLayout,
    build,
    layout_of,
    layout_of_header,
)
from tests.studies.fuzz.mutation import Draw, chance, integer

REAL_PACKETS = Path(__file__).resolve().parents[4] / "shared" / "data" / "vn100_packets.json"
LONGEST = 512
"""Bytes of a packet, at most."""


def _crc_table() -> list[int]:
    """Return the table of the polynomial 0x1021, bit by bit."""
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
        table.append(value)
    return table


_TABLE = _crc_table()


def checksum(data: bytes, value: int = 0) -> int:
    """Return CRC-16/XMODEM, or of another preset `value`, by a way of its own."""
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _TABLE[value >> 8 ^ byte]
    return value


def real_packets() -> list[bytes]:
    """Return the packets of the manual and of real units, where they are at hand."""
    if not REAL_PACKETS.is_file():
        return []
    rows = json.loads(REAL_PACKETS.read_text(encoding="utf-8"))["binary"]
    return [bytes.fromhex(row["hex"]) for row in rows if row["crc_ok"] and _known(bytes.fromhex(row["hex"]))]


def _known(packet: bytes) -> bool:
    layout = layout_of_header(packet[1 : 1 + HEADER_LENGTHS[packet[1]]])
    return layout is not None and layout.length == len(packet)


def good_packet(draw: Draw) -> bytes:
    """Return a good packet: mostly of the output set that flies, with values of a body at rest."""
    if chance(draw, 0.7):
        q = draw.standard_normal(4)
        values = [integer(draw, 0, 2**40), *(q / np.linalg.norm(q)), *draw.normal(0.0, 0.1, 3)]
        return layout_of(OUTPUT_SET).pack([*values, *draw.normal(0.0, 5.0, 3), *draw.normal(0.0, 0.3, 3)])
    return _random_packet(draw)


def _random_packet(draw: Draw) -> bytes:
    """Return a packet of a random output set with random bytes in it, of a length that can be meant."""
    while True:
        groups = [group for group in FIELDS if chance(draw, 0.4)] or [0]
        words = {group: integer(draw, 1, 2 ** len(FIELDS[group]) - 1) for group in groups}
        layout = layout_of({group: word & integer(draw, 0, 2**16 - 1) or 1 for group, word in words.items()})
        if layout.length <= LONGEST:
            return _sealed(layout, draw.bytes(layout.payload.size))


def hostile(draw: Draw, packet: bytes) -> bytes:
    """Return a packet with wrong values and a right checksum: NaN, infinity, huge, random bits."""
    layout = layout_of_header(packet[1 : 1 + HEADER_LENGTHS[packet[1]]])
    if layout is None:
        raise ValueError("a packet of the pool has no layout")
    body = bytearray(packet[1 + len(layout.header) : -2])
    place = integer(draw, 0, max(len(body) - 4, 0))
    worst = (
        b"\0\0\xc0\x7f",
        b"\0\0\x80\x7f",
        b"\0\0\x80\xff",
        b"\xff\xff\x7f\x7f",
        b"\1\0\x80\x7f",
        draw.bytes(4),
    )
    body[place : place + 4] = worst[integer(draw, 0, len(worst) - 1)]
    return _sealed(layout, bytes(body[: layout.payload.size]).ljust(layout.payload.size, b"\0"))


def _sealed(layout: OutputLayout, payload: bytes) -> bytes:
    body = layout.header + payload
    return b"\xfa" + body + checksum(body).to_bytes(2, "big")


def sentence(draw: Draw) -> bytes:
    """Return a good sentence."""
    numbers = [f"{value:+.6f}" for value in draw.normal(0.0, 1.0, 13)]
    kind = ("QMR", "YMR", "RRG", "ERR", "WRG")[integer(draw, 0, 4)]
    fields = {"ERR": [f"{integer(draw, 0, 255):02X}"], "RRG": ["01", "VN-100"], "WRG": ["06", "0"]}
    return build(kind, *fields.get(kind, numbers), checksum="xor8" if chance(draw, 0.5) else "crc16")
