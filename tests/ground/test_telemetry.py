"""Tests of packets read from bytes and from the folder of a run, and of the damage report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.link.telemetry.definitions import CONTROL, EVENT, IMU, TARGET, TRUTH
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import LAYOUTS, Packer, TelemetryError, crc16
from ground.telemetry import ScanResult, decode, read_run, scan
from knightcube.errors import UsageError
from tests.flight.link.telemetry.samples import plain_contents, timing_packets
from tests.ground.report.synthetic import Recipe, make_run
from tests.manual_clock import ManualClock
from tests.pace import ordinary_seconds

SHORT = Recipe(duration=30.0, planned=30.0, hold=10.0, rate_hz=10.0)


def test_the_three_logs_of_a_run_are_read_by_packet_name(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run", SHORT))
    assert run["target"]["q2"].tolist() == [-0.3, -0.2, -0.1, 0.0]
    assert len(run["control"]) == len(run["truth"]) == len(run["cycle_timing"]) == 301
    assert len(run["imu"]) == 0
    assert all(log.intact for log in run.logs.values())


def test_a_run_on_hardware_has_no_truth(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=5.0, rate_hz=10.0, truth=False, performance=False)))
    assert run.truth.counts == run.performance.counts == {}
    assert len(run["truth"]) == 0


def test_a_run_killed_between_two_bytes_is_read_to_its_last_whole_packet(tmp_path: Path) -> None:
    path = make_run(tmp_path, SHORT) / "flight-0001.ccsds"
    path.write_bytes(path.read_bytes()[:-1])
    run = read_run(tmp_path)
    assert run.flight.truncated_bytes > 0
    assert len(run["control"]) == 300


def test_segments_are_read_in_order_and_dropped_ones_are_known(tmp_path: Path) -> None:
    packets = timing_packets(100)
    log = FlightLog(tmp_path, clock=ManualClock(), segment_bytes=220, budget_bytes=2200)
    for packet in packets:
        log.write(packet)
    log.close()
    run = read_run(tmp_path)
    assert run.dropped_segments("flight") == log.dropped_segments > 0
    kept = run["cycle_timing"]["cycle"].tolist()
    assert kept == list(range(kept[0], 100))
    assert run.dropped_segments("truth") == 0


def test_a_tenth_thousand_segment_comes_after_the_ninth(tmp_path: Path) -> None:
    first, second = timing_packets(2)
    (tmp_path / "flight-9999.ccsds").write_bytes(first)
    (tmp_path / "flight-10000.ccsds").write_bytes(second)
    assert read_run(tmp_path)["cycle_timing"]["cycle"].tolist() == [0, 1]


def test_a_folder_without_a_run_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="no flight log"):
        read_run(tmp_path)
    (tmp_path / "flight-0001.ccsds").write_bytes(b"not a log")
    with pytest.raises(UsageError, match="no valid packet in the 9 bytes"):
        read_run(tmp_path)


def cycles(result: ScanResult) -> list[int]:
    return [int(cycle) for cycle in result.packets["cycle_timing"]["cycle"]]


def claimed(result: ScanResult) -> int:
    return sum(LAYOUTS[name].length * count for name, count in result.counts.items())


def test_nothing_gives_nothing() -> None:
    result = scan(b"")
    assert result.counts == {}
    assert result.intact
    assert result.packets["control"]["q2"].shape == (0,)


def test_an_undamaged_log_is_intact() -> None:
    packets = timing_packets(100)
    result = scan(b"".join(packets))
    assert result.counts == {"cycle_timing": 100}
    assert cycles(result) == list(range(100))
    assert result.intact


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=200), st.binary(max_size=200), st.binary(max_size=200))
def test_garbage_around_packets_costs_none_of_them(before: bytes, between: bytes, after: bytes) -> None:
    first, second = timing_packets(2)
    result = scan(before + first + between + second + after)
    assert cycles(result) == [0, 1]
    assert result.skipped_bytes + result.truncated_bytes == len(before + between + after)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=40),
            st.sampled_from(timing_packets(3)),
            st.sampled_from([layout.identifier.to_bytes(2, "big") for layout in LAYOUTS.values()]),
        )
    )
)
def test_every_byte_of_any_stretch_is_accounted_for(pieces: list[bytes]) -> None:
    data = b"".join(pieces)
    result = scan(data)
    assert claimed(result) + result.skipped_bytes + result.truncated_bytes == result.total_bytes == len(data)
    assert result.skipped_bytes >= 0
    assert result.truncated_bytes >= 0


def test_one_damaged_byte_costs_one_packet_and_shows_in_the_sequence() -> None:
    packets = timing_packets(5)
    length = len(packets[0])
    for position in range(length):
        for flip in (0x01, 0x80, 0xFF):
            data = bytearray(b"".join(packets))
            data[2 * length + position] ^= flip
            result = scan(bytes(data))
            assert cycles(result) == [0, 1, 3, 4]
            assert result.skipped_bytes == length
            assert result.missing["cycle_timing"] == 1


def test_bytes_lost_in_the_middle_cost_the_packets_they_touch() -> None:
    packets = timing_packets(6)
    length = len(packets[0])
    data = b"".join(packets)
    result = scan(data[: length + 10] + data[2 * length + 20 :])
    assert cycles(result) == [0, 3, 4, 5]
    assert result.missing["cycle_timing"] == 2


def test_sequence_gaps_are_counted_across_the_wrap() -> None:
    packer = Packer()
    packets = timing_packets((1 << 14) + 10, packer)
    kept = packets[: (1 << 14) - 3] + packets[(1 << 14) + 5 :]
    assert scan(b"".join(kept)).missing["cycle_timing"] == 8


def test_a_packet_of_another_version_is_stepped_over_and_counted() -> None:
    first, second = timing_packets(2)
    other = bytearray(first[:-2] + b"one field more")
    other[4:6] = (len(other) + 2 - 7).to_bytes(2, "big")
    other[6] += 1
    newer = bytes(other) + crc16(bytes(other)).to_bytes(2, "big")
    result = scan(first + newer + second)
    assert cycles(result) == [0, 1]
    assert (result.other_versions, result.skipped_bytes) == (1, 0)
    assert not result.intact


@pytest.mark.parametrize("byte", [0, 1, 2], ids=["version bits", "apid", "sequence"])
def test_a_header_that_is_not_ours_is_not_believed_even_with_a_good_crc(byte: int) -> None:
    packet = bytearray(timing_packets(1)[0][:-2])
    if byte == 0:
        packet[0] |= 0x20
    elif byte == 1:
        packet[1] = 0xEE
    else:
        packet[4:6] = (len(packet) + 3 - 7).to_bytes(2, "big")
    assert scan(bytes(packet) + crc16(bytes(packet)).to_bytes(2, "big")).counts == {}


def test_decode_takes_whole_packets_only() -> None:
    packets = timing_packets(3)
    assert decode(b"".join(packets))["cycle_timing"]["cycle"].tolist() == [0, 1, 2]
    with pytest.raises(TelemetryError, match="1 bytes belong to no packet"):
        decode(b"".join(packets) + b"x")


def test_kinds_of_packets_are_distinguished_in_order() -> None:
    packer = Packer()
    kinds = [IMU, CONTROL, TARGET, IMU, EVENT, IMU]
    data = b"".join(packer.pack(kind, i, plain_contents(kind)) for i, kind in enumerate(kinds))
    result = scan(data)
    assert result.counts == {"imu": 3, "control": 1, "target": 1, "event": 1}
    assert result.packets["imu"]["time_ns"].tolist() == [0, 3, 5]
    assert result.intact


def log(cycles: int) -> bytes:
    """Return the IMU, control and truth packets of `cycles` control cycles."""
    packer = Packer()
    kinds = [(kind, plain_contents(kind)) for kind in (IMU, CONTROL, TRUTH)]
    return b"".join(packer.pack(kind, cycle, values) for cycle in range(cycles) for kind, values in kinds)


def test_a_log_four_times_as_long_takes_about_four_times_as_long() -> None:
    short, long = log(1_000), log(4_000)
    assert scan(long).counts == {"imu": 4_000, "control": 4_000, "truth": 4_000}
    assert ordinary_seconds(lambda: scan(long), 5) < 6.0 * ordinary_seconds(lambda: scan(short), 5)


def test_noise_holds_no_packets() -> None:
    noise = np.random.default_rng(7).bytes(1_000_000)
    assert scan(noise).counts == {}
