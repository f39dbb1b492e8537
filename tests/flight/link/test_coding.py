"""Tests of channel codes against published values, independent programs and a second implementation."""

from __future__ import annotations

import subprocess
from itertools import islice

import numpy as np
import pytest
import reed_solomon_ccsds
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.link.coding import (
    DATA_SYMBOLS,
    CltuStream,
    CommandCode,
    KissStream,
    LinkCodes,
    ReedSolomon,
    TelemetryCode,
    ax25_header,
    cltu,
    kiss_frame,
    pseudo_random,
    randomised,
)
from flight.link.frames import SYNC, TelecommandHeader, close_frame
from ground.yamcs import class_path, missing

DEPTHS = (1, 2, 3, 4, 5)


def telecommand(length: int, seed: int) -> bytes:
    """Return a telecommand frame of `length` bytes with random data."""
    header = TelecommandHeader(0x1A5, 0, 7).pack(length)
    return close_frame(header + np.random.default_rng(seed).bytes(length - len(header) - 2))


def noisy(data: bytes, bits: list[int]) -> bytes:
    """Return a copy of the data with some inverted bits."""
    value = int.from_bytes(data, "big")
    for bit in bits:
        value ^= 1 << bit
    return value.to_bytes(len(data), "big")


@pytest.mark.parametrize(
    ("kind", "begin"),
    [
        (
            "short",
            "FF480EC09A0D70BC8E2C93ADA7B746CE5A977DCC",
        ),  # first 40 bits as in CCSDS 131.0-B-5
        (
            "command",
            "FF399E5A68E906F56C892FA1315E08C052A8BBAE",
        ),  # first 40 bits as in CCSDS 231.0-B-4
    ],
)
def test_a_sequence_begins_as_published_and_repeats_after_255_bits(kind: str, begin: str) -> None:
    sequence = pseudo_random(kind)
    assert sequence[:20].hex().upper() == begin
    assert sequence[255:510] == sequence[:255]


def test_the_long_sequence_follows_its_polynomial_from_the_published_state() -> None:
    """The state 11000111000111000 of x^17 + x^14 + 1 is sent from its right end (CCSDS 131.0-B-5, 10.4)."""
    bits = [int(bit) for byte in pseudo_random("long") for bit in f"{byte:08b}"]
    assert bits[:17] == [int(bit) for bit in reversed("11000111000111000")]
    assert all(bits[n + 17] == bits[n + 14] ^ bits[n] for n in range(len(bits) - 17))


def test_symbols_have_the_published_dual_basis() -> None:
    """The rows of the matrix T are the images of alpha^7 to alpha^0 (CCSDS 131.0-B-5, annex F)."""
    rows = bytes.fromhex("8DEFEC86FA99AF7B")
    code = ReedSolomon(1)
    assert bytes(code._dual[1 << (7 - i)] for i in range(8)) == rows


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("symbols", [DATA_SYMBOLS, 100, 26])
def test_codeblocks_are_those_of_another_author_with_virtual_fill(depth: int, symbols: int) -> None:
    data = np.random.default_rng(depth).bytes(symbols * depth)
    fill = bytes((DATA_SYMBOLS - symbols) * depth)
    theirs = reed_solomon_ccsds.encode(fill + data, dual_basis=True, interleaving=depth)
    assert ReedSolomon(depth).encode(data) == theirs[len(fill) :]


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("symbols", [DATA_SYMBOLS, 30])
def test_16_wrong_symbols_of_each_codeword_are_corrected_and_17_are_not(depth: int, symbols: int) -> None:
    draw = np.random.default_rng(symbols + depth)
    code, data = ReedSolomon(depth), draw.bytes(symbols * depth)
    block = np.frombuffer(code.encode(data), np.uint8).reshape(-1, depth).copy()
    assert code.decode(block.tobytes()) == data
    assert (code.corrected, code.uncorrectable) == (0, 0)
    for wrong, corrected, uncorrectable in ((16, 16 * depth, 0), (17, 16 * depth, depth)):
        damaged = block.copy()
        for column in range(depth):
            places = draw.choice(len(block), wrong, replace=False)
            damaged[places, column] ^= draw.integers(1, 256, wrong, dtype=np.uint8)
        decoded = code.decode(damaged.tobytes())
        assert (code.corrected, code.uncorrectable) == (corrected, uncorrectable)
        assert (decoded == data) is (wrong == 16)


@pytest.mark.parametrize("kind", [None, "short", "long"])
@pytest.mark.parametrize(("depth", "frame_bytes"), [(None, 512), (5, 1115), (3, 129), (1, 128), (4, 892)])
def test_telemetry_frames_pass_a_noisy_stream_in_pieces(
    kind: str | None, depth: int | None, frame_bytes: int
) -> None:
    draw = np.random.default_rng(3)
    frames = [close_frame(draw.bytes(frame_bytes - 2)) for _ in range(6)]
    code = TelemetryCode(frame_bytes, kind, depth)
    marked = [code.marked(frame) for frame in frames]
    assert all(one.startswith(SYNC) for one in marked)
    if depth is not None:
        marked = [noisy(one, [int(bit) for bit in draw.choice(8 * frame_bytes, 16)]) for one in marked]
    line = draw.bytes(300) + b"".join(marked[:3]) + draw.bytes(77) + b"".join(marked[3:])
    stream, found = code.stream(), []
    for begin in range(0, len(line), 97):
        found += stream.add(line[begin : begin + 97])
    assert found == frames
    assert (code.corrected > 50) is (depth is not None)
    assert [code.decode(code.encode(frame)) for frame in frames] == frames


def test_a_marker_with_wrong_bits_is_accepted_only_behind_a_codeblock() -> None:
    frames = [close_frame(np.random.default_rng(i).bytes(221)) for i in range(5)]
    code = TelemetryCode(223, "short", 1)
    marked = [code.marked(frame) for frame in frames]
    length = 8 * len(marked[0])
    wrong = [
        noisy(one, [length - 1 - bit for bit in bits])
        for one, bits in zip(marked, [(), (3, 9, 31), (), (0, 1, 2, 7), (5,)], strict=True)
    ]
    for step in (1, 50, 1000):
        stream, found = code.stream(), []
        line = b"".join(wrong)
        for begin in range(0, len(line), step):
            found += stream.add(line[begin : begin + step])
        assert found == frames[:3], "four wrong bits lose the frame, and one loses the next"
    assert code.stream().add(wrong[1]) == []


@given(data=st.binary(min_size=7, max_size=7))
def test_parity_is_the_remainder_by_the_generator_of_the_standard(data: bytes) -> None:
    """A fill bit of 0 follows the inverted parity of x^7 + x^6 + x^2 + 1 (CCSDS 231.0-B-4, 3.3)."""
    rest = int.from_bytes(data, "big") << 7
    for bit in reversed(range(7, 63)):
        if rest >> bit & 1:
            rest ^= 0b11000101 << (bit - 7)
    assert cltu(data)[2:-8] == data + bytes([(rest ^ 0x7F) << 1])


@pytest.mark.parametrize("kind", ["plain", "randomised"])
@pytest.mark.parametrize("length", [37, 70, 71, 77, 500, 1024])
def test_one_wrong_bit_of_each_codeblock_and_of_the_start_is_corrected(kind: str, length: int) -> None:
    frame, code, draw = telecommand(length, length), CommandCode(kind), np.random.default_rng(length)
    unit = code.encode(frame)
    blocks = (len(unit) - 10) // 8
    wrong = [64 * (i + 1) + int(draw.integers(1, 64)) for i in range(blocks)]
    damaged = noisy(unit, [*wrong, 8 * len(unit) - 5])
    assert code.decode(damaged) == frame
    assert code.corrected == blocks
    two = [64 * blocks + 1, 64 * blocks + 2 + length % 60]
    assert code.decode(noisy(unit, two)) == b"", "two wrong bits in the first codeblock are detected"


@given(seed=st.integers(0, 2**16), kind=st.sampled_from(["plain", "randomised"]), step=st.integers(1, 60))
@settings(max_examples=40)
def test_cltus_are_found_among_noise_and_cut_units(seed: int, kind: str, step: int) -> None:
    draw = np.random.default_rng(seed)
    frames = [telecommand(int(draw.integers(7, 200)), seed + i) for i in range(4)]
    code = CommandCode(kind)
    parts = [bytes(draw.integers(0, 32, 40).tolist()) + code.marked(frame) for frame in frames]
    line = b"".join([*parts[:2], parts[0][: len(parts[0]) - 20], b"\x55" * 30, *parts[2:], draw.bytes(2000)])
    stream, found = code.stream(), []
    for begin in range(0, len(line), step):
        found += stream.add(line[begin : begin + step])
    assert found == frames


def test_a_stream_of_start_sequences_takes_limited_time_and_memory() -> None:
    stream = CltuStream(None, lambda _: None)
    for _ in range(20):
        assert stream.add(bytes.fromhex("EB90") * 5000) == []
    assert len(stream._data) < 2000


_LENGTHS = (63, 300)
_PROBE = """
import java.util.HexFormat;
import org.yamcs.tctm.ccsds.Randomizer;
import org.yamcs.tctm.ccsds.error.BchCltuGenerator;

public class Probe {
    public static void main(String[] texts) throws Exception {
        HexFormat hex = HexFormat.of();
        for (String text : texts) {
            byte[] frame = hex.parseHex(text);
            System.out.println(hex.formatHex(new BchCltuGenerator().makeCltu(frame.clone(), false)));
            System.out.println(hex.formatHex(new BchCltuGenerator().makeCltu(frame.clone(), true)));
            Randomizer.randomizeTm(frame);
            System.out.println(hex.formatHex(frame));
        }
    }
}
"""


@pytest.fixture(scope="module")
def of_yamcs(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return two CLTUs and the randomised frame from Yamcs, for a frame of each length."""
    source = tmp_path_factory.mktemp("probe") / "Probe.java"
    source.write_text(_PROBE, encoding="utf-8")
    frames = [telecommand(length, 5).hex() for length in _LENGTHS]
    java = ["java", "-XX:TieredStopAtLevel=1", "-XX:+UseSerialGC", "-cp", class_path()]
    return subprocess.run(
        [*java, str(source), *frames], capture_output=True, text=True, check=True
    ).stdout.split()


@pytest.mark.skipif(bool(missing()), reason=missing() or "-")
@pytest.mark.parametrize("length", _LENGTHS)
def test_yamcs_makes_the_same_cltus_and_random_sequence(length: int, of_yamcs: list[str]) -> None:
    frame, first = telecommand(length, 5), 3 * _LENGTHS.index(length)
    cltus = [CommandCode(kind).encode(frame) for kind in ("plain", "randomised")]
    assert of_yamcs[first : first + 3] == [one.hex() for one in (*cltus, randomised(frame, "short"))]
    assert len(of_yamcs) == 3 * len(_LENGTHS)


def test_kiss_escapes_as_its_specification_and_skips_other_frames() -> None:
    """As in the example of the specification, C0 and DB are sent as DB DC and DB DD.

    Frames of other types are skipped.
    """
    assert kiss_frame(b"\xc0a\xdb") == b"\xc0\x00\xdb\xdca\xdb\xdd\xc0"
    stream = KissStream(bytes, ax25=False)
    line = b"\xc0\x01\x32\xc0" + kiss_frame(b"one") + b"\xc0\xc0" + kiss_frame(b"\xdb\xdc\xc0")
    found = [frame for byte in line for frame in stream.add(bytes([byte]))]
    assert found == [b"one", b"\xdb\xdc\xc0"]
    assert KissStream(bytes, ax25=False).add(b"x" * 100_000) == []


def test_an_ax25_header_is_that_of_the_specification() -> None:
    """A UI frame from N7LEM to NJ7P has the header of AX.25 2.2, figure 3.5, without a layer-3 protocol."""
    header = ax25_header("NJ7P", "N7LEM")
    assert header.hex(" ") == "9c 94 6e a0 40 40 e0 9c 6e 98 8a 9a 40 61 03 f0"
    assert ax25_header("A-15", "B-3")[6:14] == bytes.fromhex("fe 84 40 40 40 40 40 67")
    digipeated = header[:13] + b"\x60" + ax25_header("RELAY", "X")[:6] + b"\xe1" + header[14:]
    stream = KissStream(bytes, ax25=True)
    line = [kiss_frame(form + b"unit") for form in (header, digipeated, b"", header[:-1] + b"\xcf")]
    assert stream.add(b"".join(line)) == [b"unit", b"unit"]


@pytest.mark.parametrize("call_signs", [None, ("OK0GND", "OK0SAT-11")])
@pytest.mark.parametrize("kiss", [False, True])
def test_both_ends_understand_each_other(kiss: bool, call_signs: tuple[str, str] | None) -> None:
    codes = LinkCodes(223, "long", 1, "randomised", call_signs)
    down, up = close_frame(bytes(range(221))), telecommand(90, 1)
    board, ground = codes.on_board(kiss), codes.on_ground(kiss)
    assert ground.stream().add(board.wrap(down)) == [down]
    assert board.stream().add(ground.wrap(up)) == [up]
    assert list(islice(ground.stream().add(board.wrap(down) * 2), 3)) == [down, down]
