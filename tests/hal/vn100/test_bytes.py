"""Tests of packets, sentences and checksums against VectorNav's examples."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.drivers.vn100_protocol import (
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


def test_the_unit_may_be_spoken_to_without_a_checksum() -> None:
    sentence = parse(b"$VNRRG,8*XX\r\n", allow_none=True)
    assert sentence is not None
    assert sentence.fields == ("8",)


def test_count_and_status_behind_a_vnqmr_line_are_passed_over() -> None:
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
