"""Tests that a log with an incomplete end or damaged bytes still gives every undamaged packet."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import LAYOUTS, crc16
from ground.report import format_report, summarise
from ground.telemetry import ScanResult, read_run, scan
from tests.ground.report.synthetic import Recipe, make_run

TAIL = 4096


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run whose only segment contains packets of many types."""
    return make_run(tmp_path_factory.mktemp("tail"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


def packets_of(data: bytes) -> list[tuple[int, bytes]]:
    """Return the offset and the bytes of each packet, found by the lengths in the packet headers."""
    found, position = [], 0
    while position < len(data):
        length = int.from_bytes(data[position + 4 : position + 6], "big") + 7
        found.append((position, data[position : position + length]))
        position += length
    assert position == len(data)
    return found


def returned(result: ScanResult) -> list[bytes]:
    """Return the found packets by type, in order."""
    return sorted(row.tobytes() for array in result.packets.values() for row in array)


def test_power_lost_at_every_byte_of_the_last_four_kibibytes_costs_the_packet_it_cut(run: Path) -> None:
    (path,) = find_segments(run, "flight")
    data = path.read_bytes()
    start = len(data) - TAIL - 512
    packets = [(place, packet) for place, packet in packets_of(data) if place >= start]
    first = packets[0][0]
    assert len({packet[:2] for _, packet in packets}) >= 4, "several kinds of packet"
    for end in range(len(data) - TAIL, len(data) + 1):
        result = scan(data[first:end])
        whole = [packet for place, packet in packets if place + len(packet) <= end]
        assert returned(result) == sorted(whole)
        assert result.truncated_bytes == end - first - sum(map(len, whole))
        assert result.skipped_bytes == 0


def test_blocks_that_power_loss_left_as_zeros_cost_only_what_they_cover(run: Path) -> None:
    """Blocks that a power loss left as zeros destroy only the packets that they cover.

    Blocks read as zeros if the file system has stored the length of the file but not these blocks.
    """
    data = find_segments(run, "flight")[0].read_bytes()[:8192]
    packets = packets_of(data[: packets_of_prefix(data)])
    for start in range(0, 8192, 512):
        torn = data[:start] + bytes(512) + data[start + 512 :]
        touched = [p for place, p in packets if place < start + 512 and place + len(p) > start]
        found = returned(scan(torn))
        assert all(packet in found for _, packet in packets if packet not in touched)
        assert all(packet in {p for _, p in packets} for packet in found)


def packets_of_prefix(data: bytes) -> int:
    """Return the offset at which the last complete packet of `data` ends."""
    position = 0
    while True:
        length = int.from_bytes(data[position + 4 : position + 6], "big") + 7
        if position + length > len(data):
            return position
        position += length


@pytest.mark.parametrize("seed", range(40))
def test_random_damage_costs_the_packets_it_touches_and_invents_none(run: Path, seed: int) -> None:
    """Packets with one to three flipped bits are dropped, and all other packets are returned unchanged.

    The CRC detects up to three flipped bits in a packet (distance 4 below 32,751 bits).
    """
    draw = random.Random(seed)
    data = bytearray(find_segments(run, "flight")[0].read_bytes())
    packets = packets_of(bytes(data))
    hit = set(draw.sample(range(len(packets)), 20))
    for index in hit:
        place, packet = packets[index]
        for bit in draw.sample(range(8 * len(packet)), draw.randint(1, 3)):
            data[place + bit // 8] ^= 1 << bit % 8
    kept = [packet for index, (_, packet) in enumerate(packets) if index not in hit]
    assert returned(scan(bytes(data))) == sorted(kept)


def test_a_packet_that_is_a_segment_of_a_sequence_is_refused() -> None:
    """A packet is accepted only if both sequence flags, which mark it as complete, are set.

    Packets with other flags are refused even if their CRC is correct.
    """
    body = bytearray(LAYOUTS["cycle_timing"].length - 2)
    body[:2] = LAYOUTS["cycle_timing"].identifier.to_bytes(2, "big")
    body[4:6] = (len(body) + 2 - 7).to_bytes(2, "big")
    body[6] = LAYOUTS["cycle_timing"].packet.version
    for flags in range(4):
        body[2] = flags << 6
        raw = bytes(body) + crc16(bytes(body)).to_bytes(2, "big")
        assert bool(scan(raw).counts) == (flags == 3)


@pytest.mark.parametrize("cut", [1, 5, 77, 300])
def test_a_run_with_an_incomplete_end_is_reported_with_the_number_of_lost_bytes(
    run: Path, tmp_path: Path, cut: int
) -> None:
    whole = read_run(run)
    for path in run.glob("*.ccsds"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (path,) = find_segments(tmp_path, "flight")
    path.write_bytes(path.read_bytes()[:-cut])
    torn = read_run(tmp_path)
    lost = sum(whole.flight.counts.values()) - sum(torn.flight.counts.values())
    assert 1 <= lost <= 10
    summary = summarise(torn)
    (row,) = [row for row in summary["logs"] if row["log"] == "flight"]
    assert row["truncated_bytes"] == torn.flight.truncated_bytes > 0
    assert torn.flight.skipped_bytes == 0
    assert "Log integrity" in format_report(summary)
