"""Tests of parser and driver with damaged VN-100 packets and impossible values, in random portions."""

from __future__ import annotations

import binascii
from dataclasses import replace
from random import Random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.vn100 import OUTPUT_SET, Vn100
from hal.drivers.vn100_protocol import BinaryPacket, StreamParser, layout_of
from tests.hal.vn100.bench_line import MISSION
from tests.manual_clock import ManualClock
from tests.support.damaged import chances, damage

LONGEST = 512
"""Length (bytes) of the longest packet."""
IMPOSSIBLE = (b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0\0\x80\xff", b"\xff\xff\x7f\x7f", b"\1\0\x80\x7f")
GOOD = layout_of(OUTPUT_SET).pack(
    [1_000_000, 0.0, 0.0, 0.0, 1.0, 0.1, -0.2, 0.3, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
)


class ScriptedPort:
    """A serial line that delivers prepared portions of bytes."""

    baud_rate = 115_200

    def __init__(self, chunks: list[tuple[int, bytes]]) -> None:
        self.chunks = chunks

    def receive(self) -> list[tuple[int, bytes]]:
        chunks, self.chunks = self.chunks, []
        return chunks

    def send(self, data: bytes) -> None: ...

    def set_baud_rate(self, baud_rate: int) -> None: ...

    def close(self) -> None: ...


def impossible(chance: Random) -> bytes:
    """Return a packet with an impossible number and a correct checksum."""
    body = bytearray(GOOD[1:-2])
    start = chance.randrange(8, len(body) - 4)
    body[start : start + 4] = chance.choice(IMPOSSIBLE)
    return b"\xfa" + bytes(body) + binascii.crc_hqx(bytes(body), 0).to_bytes(2, "big")


@given(chances())
def test_readings_are_finite_and_in_range_and_whole_packets_come_out(chance: Random) -> None:
    pieces = []
    for _ in range(chance.randint(1, 8)):
        pieces.append(chance.choice((GOOD, impossible(chance), damage(chance, GOOD), chance.randbytes(30))))
    stream = b"".join(pieces) + bytes(LONGEST + 300)
    chunks, position = [], 0
    while position < len(stream):
        size = chance.randint(1, 200)
        chunks.append((1_000_000_000 + position * 86_806, stream[position : position + size]))
        position += size
    parser = StreamParser(86_806.0, LONGEST)
    items = [item for arrival_ns, chunk in chunks for item in parser.feed(arrival_ns, chunk)]
    lengths = [item.layout.length if isinstance(item, BinaryPacket) else item.length for item in items]
    assert parser.bytes_received == len(stream)
    assert 0 <= len(stream) - parser.discarded_bytes - sum(lengths) <= LONGEST
    if all(piece == GOOD for piece in pieces):
        assert len(items) == len(pieces)
    settings = replace(MISSION, configure=False)
    driver = Vn100(ScriptedPort(chunks), ManualClock(), settings)
    for reading in driver.poll():
        assert abs(np.linalg.norm(reading.quaternion) - 1.0) < 1e-12
        assert not reading.has_rate or np.max(np.abs(reading.rate)) <= settings.rate_range
        assert np.max(np.abs(reading.field)) <= settings.field_range * (1.0 + 1e-12)
        assert np.max(np.abs(reading.acceleration)) <= settings.acceleration_range


PAYLOAD = ("q0", "q1", "q2", "q3", *(f"rate {axis}" for axis in "xyz"), *(f"acceleration {a}" for a in "xyz"))
"""Names of the numbers after the time in group 1 of the packet. The magnetic field follows in group 3."""
NAMES = (*PAYLOAD, *(f"magnetic field {axis}" for axis in "xyz"))


@given(st.integers(0, len(NAMES) - 1), st.floats(width=32))
def test_a_changed_number_is_read_or_refused_by_quantity_and_value(which: int, value: float) -> None:
    numbers = [0.0, 0.0, 0.0, 1.0, 0.1, -0.2, 0.3, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    numbers[which] = value
    sent = layout_of(OUTPUT_SET).pack([1_000_000, *numbers])
    driver = Vn100(ScriptedPort([(1_000_000_000, sent)]), ManualClock(), replace(MISSION, configure=False))
    readings, link = driver.poll(), driver.link()
    whole = [reading for reading in readings if reading.has_rate]
    name = NAMES[which]
    assert len(whole) + link.out_of_range + link.not_finite == 1
    assert len(readings) == 1 or not name.startswith("rate")
    scale = 1e-4 if name.startswith("magnetic") else 1.0
    if whole:
        assert link.rejection == ""
    elif name.startswith("q"):
        assert link.rejection.startswith("norm of the quaternion = ")
    else:
        assert link.rejection.startswith(f"{name} = {scale * value:g} ")
        assert "limit" in link.rejection


def test_a_stuck_sensor_is_named() -> None:
    chunks = [(1_000_000_000 + k, GOOD) for k in range(12)]
    driver = Vn100(ScriptedPort(chunks), ManualClock(), replace(MISSION, configure=False))
    assert len(driver.poll()) == 10
    assert driver.link().rejection == "12 samples in a row are identical"
