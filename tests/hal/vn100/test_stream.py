"""Tests of the stream parser with noise, gaps and damaged bytes of a serial line."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.vn100 import OUTPUT_SET
from hal.drivers.vn100_protocol import (
    LONGEST_LINE,
    AsciiLine,
    BinaryPacket,
    StreamParser,
    build,
    crc16,
    layout_of,
    parse,
)
from tests.pace import ordinary_seconds

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


@given(st.lists(st.tuples(noise, good), max_size=6), noise, st.lists(st.integers(1, 60), min_size=1))
@settings(max_examples=60, deadline=None)
def test_every_chunking_gives_the_same(
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


@given(st.binary(max_size=400))
@settings(max_examples=80, deadline=None)
def test_whatever_comes_nothing_is_raised_and_nothing_corrupt_passes(data: bytes) -> None:
    for item in StreamParser().feed(0, data):
        raw = encoded(item)
        assert raw in data
        assert parse(raw) is not None if isinstance(item, AsciiLine) else crc16(raw[1:]) == 0


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
