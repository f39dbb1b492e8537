"""Tests that the flight log stores all packets in order, and reports packets that it could not store."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flight.link.telemetry.log import FlightLog, find_segments
from ground.telemetry import scan
from hal.buses.system import SystemClock
from knightcube.errors import UsageError
from tests.flight.link.telemetry.samples import timing_packets
from tests.flight.link.telemetry.small_disk import content
from tests.manual_clock import ManualClock

SECOND = 1_000_000_000


def test_packets_reach_the_disk_as_time_passes_and_the_rest_on_close(tmp_path: Path) -> None:
    clock = ManualClock(0)
    log = FlightLog(tmp_path, clock=clock)
    packets = timing_packets(10)
    for packet in packets[:6]:
        log.write(packet)
    assert content(tmp_path) == b"", "write itself touches no disk"
    clock.sleep_until_ns(SECOND)
    assert content(tmp_path) == b"".join(packets[:6])
    for packet in packets[6:]:
        log.write(packet)
    log.close()
    log.close()
    assert content(tmp_path) == b"".join(packets)
    assert (log.lost, log.error(), log.dropped_segments) == (0, "", 0)


def test_segments_turn_between_packets_and_follow_one_another(tmp_path: Path) -> None:
    clock = ManualClock(0)
    packets = timing_packets(100)
    size = len(packets[0])
    log = FlightLog(tmp_path, clock=clock, segment_bytes=10 * size + 5)
    for packet in packets:
        log.write(packet)
    log.close()
    paths = find_segments(tmp_path, "flight")
    assert [path.name for path in paths] == [f"flight-{i:04d}.ccsds" for i in range(1, 11)]
    assert {path.stat().st_size for path in paths} == {10 * size}
    assert content(tmp_path) == b"".join(packets)


def test_the_files_do_not_depend_on_when_they_were_drained(tmp_path: Path) -> None:
    packets = timing_packets(400)
    for name, every in (("often", 1), ("seldom", 97)):
        clock = ManualClock(0)
        log = FlightLog(
            tmp_path / name, clock=clock, segment_bytes=1000, budget_bytes=8000, drain_period_ns=SECOND
        )
        for i, packet in enumerate(packets):
            log.write(packet)
            if i % every == 0:
                clock.sleep_until_ns(clock.now_ns() + SECOND)
        log.close()
    often, seldom = (find_segments(tmp_path / name, "flight") for name in ("often", "seldom"))
    assert [path.name for path in often] == [path.name for path in seldom]
    assert [path.read_bytes() for path in often] == [path.read_bytes() for path in seldom]


def test_over_budget_the_oldest_segments_go_and_are_counted(tmp_path: Path) -> None:
    packets = timing_packets(100)
    size = len(packets[0])
    log = FlightLog(tmp_path, clock=ManualClock(), segment_bytes=10 * size, budget_bytes=40 * size)
    for packet in packets[:40]:
        log.write(packet)
    log._drain()
    assert log.dropped_segments == 0, "a budget just filled is not exceeded"
    for packet in packets[40:]:
        log.write(packet)
    log.close()
    assert len(content(tmp_path)) <= 40 * size
    assert log.dropped_segments == 6
    assert content(tmp_path) == b"".join(packets[60:])


def test_a_budget_below_two_segments_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="two segments"):
        FlightLog(tmp_path, clock=ManualClock(), segment_bytes=1000, budget_bytes=1999)


def test_a_full_queue_loses_the_newest_packets_and_reports_it(tmp_path: Path) -> None:
    log = FlightLog(tmp_path, clock=ManualClock(), queue_packets=5)
    packets = timing_packets(8)
    for packet in packets:
        log.write(packet)
    assert log.lost == 3
    assert "3 packets lost" in log.error()
    log.close()
    assert content(tmp_path) == b"".join(packets[:5])


def test_packets_after_the_end_are_counted_as_lost(tmp_path: Path) -> None:
    log = FlightLog(tmp_path, clock=ManualClock())
    log.close()
    log.write(timing_packets(1)[0])
    assert log.lost == 1


def test_an_old_log_is_not_overwritten_unless_asked(tmp_path: Path) -> None:
    packets = timing_packets(30)
    first = FlightLog(tmp_path, clock=ManualClock(), segment_bytes=10 * len(packets[0]))
    for packet in packets:
        first.write(packet)
    first.close()
    with pytest.raises(UsageError, match=r"flight-0001\.ccsds exists"):
        FlightLog(tmp_path, clock=ManualClock())
    assert content(tmp_path) == b"".join(packets)
    FlightLog(tmp_path, "truth", clock=ManualClock()).close()  # a log with another name
    second = FlightLog(tmp_path, clock=ManualClock(), overwrite=True)
    second.write(packets[0])
    second.close()
    assert content(tmp_path) == packets[0]


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="file/run: a log cannot be written there: Not a directory"):
        FlightLog(tmp_path / "file" / "run", clock=ManualClock())


def test_the_log_works_on_the_machines_clock(tmp_path: Path) -> None:
    log = FlightLog(tmp_path, clock=SystemClock(), drain_period_ns=1_000_000)
    packets = timing_packets(200)
    for packet in packets:
        log.write(packet)
    deadline = time.monotonic() + 300.0
    while len(content(tmp_path)) < sum(map(len, packets)) and time.monotonic() < deadline:
        time.sleep(0.002)
    assert content(tmp_path) == b"".join(packets), "drained by the ticker, not by close"
    log.close()


WRITER = """
import sys
from pathlib import Path
from flight.link.telemetry.definitions import CYCLE_TIMING
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import Packer
from hal.buses.system import SystemClock

clock, packer, cycle = SystemClock(), Packer(), 0
log = FlightLog(Path(sys.argv[1]), clock=clock, segment_bytes=50_000, drain_period_ns=1_000_000)
while True:
    for _ in range(20):
        log.write(packer.pack(CYCLE_TIMING, cycle, cycle=cycle, lateness=0.0, execution=0.0))
        cycle += 1
    clock.sleep_until_ns(clock.now_ns() + 500_000)
"""


def test_a_killed_process_leaves_a_readable_log(tmp_path: Path) -> None:
    """After a SIGKILL during a write, the log has no gap, and only its last packet may be incomplete."""
    root = Path(__file__).resolve().parents[4]
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], cwd=root)
    try:
        deadline = time.monotonic() + 300.0
        while len(content(tmp_path)) < 150_000 and time.monotonic() < deadline:
            assert writer.poll() is None
            time.sleep(0.005)
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    result = scan(content(tmp_path))
    count = result.counts["cycle_timing"]
    assert count > 3000
    assert result.packets["cycle_timing"]["cycle"].tolist() == list(range(count))
    assert result.skipped_bytes == 0
    assert sum(result.missing.values()) == 0


def test_a_kill_at_every_byte_of_a_write_leaves_every_whole_packet(tmp_path: Path) -> None:
    """A crash can leave any prefix of the written bytes. All complete packets of the prefix are returned."""
    log = FlightLog(tmp_path, clock=ManualClock())
    packets = timing_packets(100)
    for packet in packets:
        log.write(packet)
    log.close()
    path = tmp_path / "flight-0001.ccsds"
    for end in range(path.stat().st_size, 0, -13):
        os.truncate(path, end)
        assert scan(content(tmp_path)).counts.get("cycle_timing", 0) == end // len(packets[0])
