"""Tests that damaged packets and impossible values in flight logs are reported and not used."""

from __future__ import annotations

import binascii
import json
import struct
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings

from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, UNSEGMENTED, crc16
from ground import report
from ground.report.comparison import compare, format_comparison
from ground.telemetry import Run, scan
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.damaged import chances, damage

STEMS = ("flight", "truth", "performance")
IMPOSSIBLE = (b"\x7f\xf8\0\0\0\0\0\0", b"\x7f\xf0\0\0\0\0\0\0", b"\xff" * 8, bytes(8), b"\x80" + bytes(7))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    """Return the packets in the three logs of a run."""
    run = make_run(tmp_path_factory.mktemp("run"), Recipe(duration=12.0, planned=12.0, hold=3.0, rate_hz=4.0))
    packets: dict[str, list[bytes]] = {stem: [] for stem in STEMS}
    for stem in STEMS:
        data = b"".join(path.read_bytes() for path in sorted(run.glob(f"{stem}-*")))
        while data:
            length = int.from_bytes(data[4:6], "big") + 7
            packets[stem].append(data[:length])
            data = data[length:]
    return packets


def with_impossible_values(chance: Random, packet: bytes) -> bytes:
    """Return a packet with impossible values and a correct CRC."""
    body = bytearray(packet[:-2])
    start = chance.randrange(6, len(body))
    body[start : start + 8] = chance.choice(IMPOSSIBLE)[: len(body) - start]
    return bytes(body) + binascii.crc_hqx(bytes(body), 0xFFFF).to_bytes(2, "big")


@settings(max_examples=40)
@given(chance=chances())
def test_a_damaged_log_invents_no_packet_and_is_reported(
    logs: dict[str, list[bytes]], chance: Random
) -> None:
    results = {}
    for stem in STEMS:
        first = chance.randrange(len(logs[stem])) if logs[stem] else 0
        written = logs[stem][first : first + chance.randint(0, 40)]
        written = [with_impossible_values(chance, one) if not chance.randrange(8) else one for one in written]
        sent = [damage(chance, one) if not chance.randrange(8) else one for one in written]
        data = b"".join(sent)
        result = results[stem] = scan(data)
        claimed = sum(len(array) * LAYOUTS[name].length for name, array in result.packets.items())
        others = result.total_bytes - claimed - result.skipped_bytes - result.truncated_bytes
        assert others >= 0
        assert (others == 0) == (result.other_versions == 0)
        for name, array in result.packets.items():
            raw, length = array.tobytes(), LAYOUTS[name].length
            for start in range(0, len(raw), length):
                packet = raw[start : start + length]
                assert packet in written or binascii.crc_hqx(packet, 0xFFFF) == 0
    run = Run(Path("damaged"), results["flight"], results["truth"], results["performance"])
    summary = report.summarise(run)
    json.dumps(summary, allow_nan=False)
    text = report.format_report(summary)
    assert text.endswith("\n")
    assert "Log integrity" in text


@pytest.mark.parametrize("byte", [b"\0", b"\x7f", b"\xff"])
def test_packets_in_which_each_byte_has_the_same_value_are_reported_and_compared(byte: bytes) -> None:
    """Bytes 0xff are NaN as floating-point numbers, and unknown states as integers."""
    packets = []
    for layout in LAYOUTS.values():
        length = layout.length - HEADER_BYTES - 1
        head = struct.pack(">HHH", layout.identifier, UNSEGMENTED, length) + bytes([layout.packet.version])
        for second in range(3):
            packet = (head + struct.pack(">q", second * 10**9)).ljust(layout.length - CRC_BYTES, byte)
            packets.append(packet + crc16(packet).to_bytes(CRC_BYTES, "big"))
    result = scan(b"".join(packets))
    assert result.skipped_bytes == 0
    summary = report.summarise(Run(Path("damaged"), result, scan(b""), scan(b"")))
    json.dumps(summary, allow_nan=False)
    assert "Log integrity" in report.format_report(summary)
    assert "Figures" in format_comparison(compare(summary, summary))
