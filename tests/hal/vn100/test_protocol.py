"""Tests of the VN-100 protocol with VectorNav's examples, noise, gaps and damaged packets."""

from __future__ import annotations

import binascii
import itertools
import json
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.vn100 import OUTPUT_SET, Vn100
from hal.drivers.vn100_protocol import (
    LONGEST_LINE,
    AsciiLine,
    BinaryPacket,
    StreamParser,
    build,
    crc16,
    error_meaning,
    layout_of,
    measurement,
    parse,
)
from knightcube.astro.quaternion import NED_TO_TESTBED, attitude_matrix
from tests.hal.vn100.bench_line import MISSION
from tests.manual_clock import ManualClock
from tests.pace import ordinary_seconds
from tests.support.damaged import chances, damage

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "vn100_packets.json"
needs_data = pytest.mark.skipif(not DATA.exists(), reason=f"published packets not here: {DATA.name}")

EXAMPLE_1 = bytes.fromhex("fa 01 08 00 93 50 2e 42 83 3e f1 3f 48 b5 04 bb 92 88")
VNQMR = (
    b"$VNQMR,+0.021375,-0.049923,+0.797361,-0.601055,-0.2354,+0.8029,+1.8875,"
    b"+00.795,-00.412,-09.709,-00.0201,-00.0055,-00.0149*76\r\n"
)
# The example of register 15 in the manual, and a VNQMR line with a counter from the tests of a public parser.
AT_REST = (
    b"$VNRRG,15,-0.017057,-0.000767,+0.056534,+0.998255,+1.0670,-0.2568,+3.0696,"
    b"-00.019,+00.320,-09.802,-0.002801,-0.001186,-0.001582*65\r\n",
    b"$VNQMR,+0.004183,+0.001149,+0.089285,+0.995997,+00.0113,-00.2384,+00.1800,"
    b"+00.020,-00.092,-09.683,-00.000272,+00.000824,+00.000073,T0000000543*3D\r\n",
)
GROUP_NAMES = {"g1": "common", "g2": "time", "g3": "imu", "g5": "attitude"}


def published(kind: str) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = json.loads(DATA.read_text())[kind] if DATA.exists() else []
    return entries


def our_name(name: str) -> str:
    group, field = name.split(".")
    snake = "".join("_" + c.lower() if c.isupper() else c for c in field).lstrip("_")
    special = {"ypr": "yaw_pitch_roll", "ypr_u": "ypr_uncertainty"}
    return f"{GROUP_NAMES[group]}.{special.get(snake, snake)}"


def test_crc_has_the_published_check_value() -> None:
    assert crc16(b"123456789") == 0x31C3


def test_crc_is_the_bitwise_division_by_0x1021() -> None:
    rng = np.random.default_rng(3)
    for length in (0, 1, 2, 17, 74):
        data = rng.bytes(length)
        remainder = 0
        for byte in data:
            remainder ^= byte << 8
            for _ in range(8):
                remainder = (remainder << 1) ^ (0x1021 if remainder & 0x8000 else 0)
            remainder &= 0xFFFF
        assert crc16(data) == remainder


def test_the_manuals_first_example_decodes() -> None:
    (packet,) = StreamParser().feed(5, EXAMPLE_1)
    assert isinstance(packet, BinaryPacket)
    assert packet["common.yaw_pitch_roll"] == pytest.approx((43.5787, 1.88472, -0.00202497), rel=5e-6)
    assert packet.arrival_ns == 5
    assert packet.layout.pack(packet.values) == EXAMPLE_1


@needs_data
@pytest.mark.parametrize("entry", published("binary"), ids=lambda e: e["source"][:40])
def test_published_binary_packets_decode_to_their_values(entry: dict[str, Any]) -> None:
    raw = bytes.fromhex(entry["hex"])
    parser = StreamParser()
    found = parser.feed(0, raw)
    if not entry["crc_ok"]:
        assert found == []
        assert parser.bad_checksum >= 1
        return
    (packet,) = found
    assert isinstance(packet, BinaryPacket)
    assert len(packet.layout.places) == len(entry["decoded"])
    for name, values in entry["decoded"].items():
        assert packet[our_name(name)] == tuple(values)
    assert packet.layout.pack(packet.values) == raw
    assert (parser.bad_checksum, parser.discarded_bytes) == (0, 0)


@needs_data
@pytest.mark.parametrize(
    "entry", published("ascii") + published("vendor_sdk_sent"), ids=lambda e: e["line"][:24]
)
def test_published_lines_pass_or_fail_as_marked(entry: dict[str, Any]) -> None:
    line = entry["line"].encode() + b"\r\n"
    sentence = parse(line)
    parser = StreamParser()
    assert bool(parser.feed(0, line)) == (sentence is not None) == entry["checksum_ok"]
    if sentence is not None:
        assert build(sentence.command, *sentence.fields, checksum=sentence.checksum) == line
        if sentence.command in {"QMR", "YMR"}:
            assert measurement(sentence) is not None


@pytest.mark.parametrize(
    ("command", "fields", "line"),
    [
        ("RRG", ("01",), b"$VNRRG,01*E15F\r\n"),
        ("WRG", ("06", 8, 1), b"$VNWRG,06,8,1*5484\r\n"),
        ("WRG", ("75", 1, 20, 16, "0001", "001E", "0004"), b"$VNWRG,75,1,20,16,0001,001E,0004*E384\r\n"),
        ("WNV", (), b"$VNWNV*DBDF\r\n"),
    ],
)
def test_commands_are_those_that_the_vendors_kit_sends(
    command: str, fields: tuple[object, ...], line: bytes
) -> None:
    assert build(command, *fields) == line


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"$",
        b"$VN*00",
        b"$VNRRG,8*",
        b"$VNRRG,8*4",
        b"$VNRRG,8*4C\r\n",
        b"$VNRRG,8*XX\r\n",
        b"$VNRRG,8*+4B\r\n",
        b"$VNRRG,8\xff*4B",
    ],
)
def test_a_line_that_is_not_a_sentence_gives_none(line: bytes) -> None:
    assert parse(line) is None


def test_a_command_without_a_checksum_is_read() -> None:
    sentence = parse(b"$VNRRG,8*XX\r\n", allow_none=True)
    assert sentence is not None
    assert sentence.fields == ("8",)


def test_count_and_status_behind_a_vnqmr_line_are_ignored() -> None:
    body = VNQMR[1 : VNQMR.index(b"*")] + b",T0000000543,S0000"
    sentence = parse(b"$" + body + f"*{crc16(body):04X}\r\n".encode())
    assert sentence is not None
    values = measurement(sentence)
    assert values is not None
    assert values.gyro == (-0.0201, -0.0055, -0.0149)


def test_error_answers_are_read_as_hexadecimal() -> None:
    for line, code in ((b"$VNERR,03*72", 0x03), (b"$VNERR,12*72", 0x12)):
        sentence = parse(line)
        assert sentence is not None
        error = error_meaning(sentence)
        assert error is not None
        assert error[0] == code
    too_slow = parse(build("ERR", "0C"))
    assert too_slow is not None
    assert error_meaning(too_slow) == (0x0C, "insufficient baud rate")


@pytest.mark.parametrize("line", AT_REST)
def test_the_units_quaternion_is_ours_from_ned_to_body(line: bytes) -> None:
    """The unit's quaternion is the attitude from NED to body.

    For two real VN-100s at rest, tilted by 2 and 1 deg, the specific force in NED is 1 g upwards.
    """
    (item,) = StreamParser().feed(0, line)
    assert isinstance(item, AsciiLine)
    fields = [float(text) for text in item.sentence.fields if text[0] in "+-"]
    matrix, accel = attitude_matrix(np.array(fields[:4])), np.array(fields[7:10])
    force = matrix.T @ accel
    assert force == pytest.approx([0.0, 0.0, -9.8], abs=0.13)
    # The horizontal force is below 0.03 m/s^2. With the inverse rotation, the tilt would be doubled.
    assert np.hypot(*force[:2]) < 0.03
    assert np.hypot(*(matrix @ accel)[:2]) > 0.15


def test_the_testbeds_constant_rotation_is_that_of_its_definition() -> None:
    """The axis y of the sensor points down, and the field, which defines north, is along -z of the sensor."""
    matrix = attitude_matrix(NED_TO_TESTBED)
    assert matrix == pytest.approx(np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]]), abs=1e-15)
    north, east, down = np.eye(3)
    assert matrix @ down == pytest.approx([0, 1, 0])
    assert matrix @ north == pytest.approx([0, 0, -1])
    assert matrix @ east == pytest.approx(np.cross([0, 1, 0], [0, 0, -1]))


def test_an_unknown_output_set_is_refused() -> None:
    with pytest.raises(ValueError, match="no VN-100 output set"):
        layout_of({3: 0x0001})
    with pytest.raises(ValueError, match="no VN-100 output set"):
        layout_of({0: 0x8000})


LAYOUT = layout_of(OUTPUT_SET)
Item = BinaryPacket | AsciiLine


def packet(seed: int) -> bytes:
    rng = np.random.default_rng(seed)
    return LAYOUT.pack([seed * 25_000_000, *rng.standard_normal(13).tolist()])


def encoded(item: Item) -> bytes:
    if isinstance(item, BinaryPacket):
        return item.layout.pack(item.values)
    return build(item.sentence.command, *item.sentence.fields, checksum=item.sentence.checksum)


def contents(items: list[Item]) -> list[bytes]:
    return [encoded(item) for item in items]


good = st.one_of(
    st.integers(0, 1000).map(packet),
    st.integers(0, 1000).map(lambda n: build("YPR", f"{n:+08.3f}", "+000.278", "-002.026", checksum="crc16")),
)
# Strategy for noise that contains many false starts of packets and lines.
noise = st.lists(
    st.sampled_from([b"\xfa", b"\xfa\x01", b"\xfa\x05\x31", b"$", b"$VN", b"\r\n", b"*", b"\0", b"A"])
    | st.binary(max_size=8),
    max_size=12,
).map(b"".join)
damaged = st.tuples(good, st.integers(0, 1000), st.integers(1, 255)).map(
    lambda drawn: bytes(
        byte ^ (drawn[2] if place == drawn[1] % len(drawn[0]) else 0) for place, byte in enumerate(drawn[0])
    )
)


@given(st.lists(st.tuples(noise, good), max_size=6), noise, st.lists(st.integers(1, 60), min_size=1))
@settings(max_examples=60, deadline=None)
def test_the_result_does_not_depend_on_the_chunks(
    parts: list[tuple[bytes, bytes]], tail: bytes, sizes: list[int]
) -> None:
    data = b"".join(itertools.chain.from_iterable(parts)) + tail
    whole, cut = StreamParser(), StreamParser()
    at_once = contents(whole.feed(0, data))
    piecewise: list[bytes] = []
    position = 0
    for size in itertools.cycle(sizes):
        if position >= len(data):
            break
        piecewise += contents(cut.feed(0, data[position : position + size]))
        position += size
    assert piecewise == at_once
    assert (cut.bad_checksum, cut.discarded_bytes) == (whole.bad_checksum, whole.discarded_bytes)


@given(st.lists(st.tuples(noise, good), min_size=1, max_size=6))
@settings(max_examples=60, deadline=None)
def test_good_packets_are_found_behind_any_garbage(parts: list[tuple[bytes, bytes]]) -> None:
    parser = StreamParser()
    data = b"".join(itertools.chain.from_iterable(parts))
    # A false start of a packet waits for the announced number of bytes. The zeros complete each false packet.
    found = contents(parser.feed(0, data)) + contents(parser.feed(0, bytes(1024)))
    remaining = iter(found)
    assert all(any(item == sound for item in remaining) for _, sound in parts)
    assert parser.bytes_received == len(data) + 1024
    assert parser.discarded_bytes == parser.bytes_received - sum(map(len, found))


@given(st.lists(noise | good | damaged, max_size=8).map(b"".join))
@settings(max_examples=80, deadline=None)
def test_any_bytes_raise_no_exception_and_no_corrupt_packet_passes(data: bytes) -> None:
    for item in StreamParser().feed(0, data):
        assert encoded(item) in data, "the checksum is that of the content"


def test_no_single_flipped_bit_passes_and_the_next_packet_is_found() -> None:
    sound, follower = packet(1), packet(2)
    for bit in range(8 * len(sound)):
        broken = bytearray(sound)
        broken[bit // 8] ^= 1 << bit % 8
        parser = StreamParser(longest=128)
        found = contents(parser.feed(0, bytes(broken) + follower + bytes(128)))
        assert found == [follower]


def test_no_burst_within_the_payload_passes() -> None:
    """A burst of errors of up to 16 bits within the payload never passes the CRC-16."""
    rng = np.random.default_rng(5)
    sound = packet(1)
    for _ in range(500):
        start = int(rng.integers(8 * (1 + len(LAYOUT.header)), 8 * len(sound) - 16))
        pattern = (int(rng.integers(1, 1 << 15)) << 1 | 1) << (8 * len(sound) - 16 - start)
        broken = (int.from_bytes(sound, "big") ^ pattern).to_bytes(len(sound), "big")
        assert StreamParser().feed(0, broken) == []


def test_a_cut_at_any_byte_costs_no_packet_but_its_own() -> None:
    sound, follower = packet(1), packet(2)
    for kept in range(1, len(sound)):
        parser = StreamParser(longest=128)
        assert contents(parser.feed(0, sound[:kept] + follower + follower)) == [follower, follower]
        assert parser.discarded_bytes == kept


def test_a_cut_line_does_not_swallow_the_next() -> None:
    line = build("YPR", "+010.071", "+000.278", "-002.026")
    for kept in range(1, len(line)):
        assert contents(StreamParser().feed(0, line[:kept] + line)) == [line]


def test_packets_within_a_chunk_carry_the_time_of_their_own_last_byte() -> None:
    parser = StreamParser(byte_ns=100.0)
    sound = packet(1)
    first, second = parser.feed(1_000_000, sound + sound)
    assert second.arrival_ns == 1_000_000
    assert first.arrival_ns == 1_000_000 - 100 * len(sound)
    # Delayed bytes cannot have arrived before the previous portion.
    third, _ = parser.feed(1_000_500, sound + sound)
    assert third.arrival_ns == 1_000_000


def test_the_buffer_stays_bounded_and_the_work_linear() -> None:
    parser = StreamParser()
    attacks = [b"\xfa\x01\xff\x7f" * 16_000, b"$VN" + b"A" * 64_000, b"$VN" * 21_000, b"\xfa" * 64_000]

    def feed_all() -> None:
        for attack in attacks:
            for position in range(0, len(attack), 64):
                parser.feed(0, attack[position : position + 64])
                assert len(parser._buffer) <= max(512, LONGEST_LINE) + 64

    assert ordinary_seconds(feed_all, 1) < 5.0
    assert parser.packets == 0


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
