"""A run's folder is read back as arrays, with an account of its damage."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.link.telemetry.log import FlightLog
from ground.telemetry.reader import read_run
from knightcube.errors import UsageError
from tests.flight.link.telemetry.samples import timing_packets
from tests.ground.report.synthetic import Recipe, make_run
from tests.manual_clock import ManualClock

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
    with pytest.raises(UsageError, match="not one valid packet in 9 bytes"):
        read_run(tmp_path)
