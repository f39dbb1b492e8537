"""The flight log keeps what it is given, in order, or says what it could not keep."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from flight.errors import UsageError
from flight.telemetry.log import FlightLog
from flight.telemetry.scanner import scan
from flight.telemetry.segments import SegmentFile, find_segments, open_segment
from hal.buses.clock import SystemClock
from tests.manual_clock import ManualClock
from tests.telemetry.samples import timing_packets

SECOND = 1_000_000_000


def content(folder: Path, stem: str = "flight") -> bytes:
    return b"".join(path.read_bytes() for path in find_segments(folder, stem))


class SmallDisk:
    """Opens segments on a disk of `room` bytes; a write beyond it takes what fits, the next fails."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.syncs = 0
        self.refusals = 0

    def open(self, path: Path) -> SegmentFile:
        """Open a segment on this disk."""
        return SmallDiskFile(self, open_segment(path))


class SmallDiskFile:
    """One file on a small disk."""

    def __init__(self, disk: SmallDisk, file: SegmentFile) -> None:
        self._disk = disk
        self._file = file

    def write(self, data: bytes, /) -> int | None:
        """Take what fits."""
        if self._disk.room == 0 and data:
            self._disk.refusals += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fits = data[: self._disk.room]
        self._disk.room -= len(fits)
        return self._file.write(fits)

    def truncate(self, size: int, /) -> int:
        """Cut the file."""
        return self._file.truncate(size)

    def fileno(self) -> int:
        """Count a sync."""
        self._disk.syncs += 1
        return self._file.fileno()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


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


@pytest.mark.parametrize("room", [0, 1, 500, 777])
def test_a_full_disk_stops_the_log_politely(tmp_path: Path, room: int) -> None:
    """What fits is kept as whole packets; the rest is counted and told."""
    clock, disk = ManualClock(0), SmallDisk(room)
    packets = timing_packets(50)
    log = FlightLog(tmp_path, clock=clock, segment_bytes=10 * len(packets[0]), opener=disk.open)
    for packet in packets[:40]:
        log.write(packet)
    clock.sleep_until_ns(SECOND)
    for packet in packets[40:]:
        log.write(packet)
    log.close()
    result = scan(content(tmp_path))
    whole = room // len(packets[0])
    assert result.counts.get("cycle_timing", 0) == whole
    assert result.intact
    assert log.lost == 50 - whole
    assert (
        log.error() == f"log flight: writing stopped: {os.strerror(errno.ENOSPC)}; {50 - whole} packets lost"
    )


@pytest.mark.parametrize("room", [0, 500, 777])
def test_a_disk_that_was_full_and_has_room_again_gets_what_waited(tmp_path: Path, room: int) -> None:
    """Within the queue's reach nothing is lost, and what was cut off half-way is written again whole."""
    clock, disk = ManualClock(0), SmallDisk(room)
    packets = timing_packets(60)
    log = FlightLog(tmp_path, clock=clock, segment_bytes=25 * len(packets[0]), opener=disk.open)
    for packet in packets[:40]:
        log.write(packet)
    clock.advance(SECOND)
    whole = room // len(packets[0])
    waiting = f"; 0 packets lost, {40 - whole} waiting"
    assert log.error() == f"log flight: writing stopped: {os.strerror(errno.ENOSPC)}{waiting}"
    disk.room = 1 << 20
    clock.advance(2 * SECOND)
    assert log.error() == ""
    for packet in packets[40:]:
        log.write(packet)
    log.close()
    assert content(tmp_path) == b"".join(packets)
    assert (log.error(), log.lost) == ("", 0)


def test_what_did_not_fit_while_the_disk_was_full_is_counted_to_the_end(tmp_path: Path) -> None:
    clock, disk = ManualClock(0), SmallDisk(0)
    packets = timing_packets(30)
    log = FlightLog(tmp_path, clock=clock, queue_packets=10, opener=disk.open)
    for packet in packets[:20]:
        log.write(packet)
        clock.advance(SECOND // 2)
    assert "10 packets lost, 10 waiting" in log.error()
    disk.room = 1 << 20
    clock.advance(5 * SECOND)
    assert log.error() == "", "nothing is wrong any more"
    for packet in packets[20:]:
        log.write(packet)
    log.close()
    assert log.error() == f"log flight: writing stopped: {os.strerror(errno.ENOSPC)}; 10 packets lost"
    result = scan(content(tmp_path))
    assert result.packets["cycle_timing"]["cycle"].tolist() == [*range(10), *range(20, 30)]
    assert result.missing["cycle_timing"] == 10, "the sequence counts tell the gap"


def test_a_full_disk_is_asked_once_a_second_not_at_every_drain(tmp_path: Path) -> None:
    clock, disk = ManualClock(0), SmallDisk(0)
    log = FlightLog(tmp_path, clock=clock, opener=disk.open)
    for packet in timing_packets(400):
        log.write(packet)
        clock.advance(SECOND // 40)
    assert 8 <= disk.refusals <= 11
    log.close()


def test_a_segment_whose_name_cannot_be_synced_is_not_left_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    path = tmp_path / "flight-0001.ccsds"
    with monkeypatch.context() as broken:
        broken.setattr("flight.telemetry.segments.os.fsync", fail)
        with pytest.raises(OSError, match=os.strerror(errno.EIO)):
            open_segment(path)
    assert not path.exists()
    open_segment(path).close()


def test_a_stump_that_cannot_be_cut_off_costs_no_later_packet(tmp_path: Path) -> None:
    class Uncut(SmallDiskFile):
        def truncate(self, size: int, /) -> int:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    clock, disk = ManualClock(0), SmallDisk(100)
    packets = timing_packets(20)
    log = FlightLog(tmp_path, clock=clock, opener=lambda path: Uncut(disk, open_segment(path)))
    for packet in packets:
        log.write(packet)
    clock.advance(SECOND)
    disk.room = 1 << 20
    clock.advance(2 * SECOND)
    log.close()
    result = scan(content(tmp_path))
    assert result.packets["cycle_timing"]["cycle"].tolist() == list(range(20))
    assert result.skipped_bytes == 100 % len(packets[0])


def test_a_disk_that_takes_little_at_a_time_loses_nothing(tmp_path: Path) -> None:
    class Sip:
        def __init__(self, path: Path) -> None:
            self._file = open_segment(path)
            self.truncate, self.fileno, self.close = self._file.truncate, self._file.fileno, self._file.close

        def write(self, data: bytes, /) -> int | None:
            return self._file.write(data[:7])

    packets = timing_packets(20)
    log = FlightLog(tmp_path, clock=ManualClock(), opener=Sip)
    for packet in packets:
        log.write(packet)
    log.close()
    assert content(tmp_path) == b"".join(packets)


def test_a_segment_that_cannot_be_opened_later_stops_the_log_politely(tmp_path: Path) -> None:
    def once(path: Path) -> SegmentFile:
        if path.name != "flight-0001.ccsds":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return open_segment(path)

    packets = timing_packets(15)
    log = FlightLog(tmp_path, clock=ManualClock(), segment_bytes=10 * len(packets[0]), opener=once)
    for packet in packets:
        log.write(packet)
    log.close()
    assert content(tmp_path) == b"".join(packets[:10])
    assert log.lost == 5
    assert os.strerror(errno.EROFS) in log.error()


def test_a_full_queue_loses_the_newest_and_says_so(tmp_path: Path) -> None:
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
    FlightLog(tmp_path, "truth", clock=ManualClock()).close()  # another stem is another log
    second = FlightLog(tmp_path, clock=ManualClock(), overwrite=True)
    second.write(packets[0])
    second.close()
    assert content(tmp_path) == packets[0]


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="file/run: no log can be written there: Not a directory"):
        FlightLog(tmp_path / "file" / "run", clock=ManualClock())


def test_the_disk_is_synced_about_once_a_second_or_only_at_the_end(tmp_path: Path) -> None:
    for name, period, expected in (("flying", SECOND, 10), ("lock-step", None, 0)):
        clock, disk = ManualClock(0), SmallDisk(1 << 20)
        log = FlightLog(tmp_path / name, clock=clock, sync_period_ns=period, opener=disk.open)
        for i, packet in enumerate(timing_packets(100)):
            log.write(packet)
            clock.sleep_until_ns((i + 1) * SECOND // 10)
        assert disk.syncs == expected
        log.close()
        assert disk.syncs == expected + 1


def test_a_hung_disk_blocks_neither_write_nor_close(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.telemetry.log._HUNG_DISK_S", 0.1)
    release = threading.Event()

    class Hung:
        def __init__(self, path: Path) -> None:
            self._file = open_segment(path)
            self.truncate, self.fileno, self.close = self._file.truncate, self._file.fileno, self._file.close

        def write(self, data: bytes, /) -> int | None:
            release.wait()
            return self._file.write(data)

    clock = ManualClock()
    log = FlightLog(tmp_path, clock=clock, drain_period_ns=100 * SECOND, opener=Hung)
    first, second = timing_packets(2)
    log.write(first)
    drain = threading.Thread(target=log._drain)
    drain.start()
    while log._queue:
        time.sleep(0.001)
    start = time.monotonic()
    log.write(second)
    assert time.monotonic() - start < 0.05
    clock.advance(10 * SECOND)
    assert log.error() == "log flight: the disk does not answer; 0 packets lost, 1 waiting"
    log.close()
    assert time.monotonic() - start < 1.0
    assert log.error() == "log flight: the disk does not answer; 1 packets lost"
    release.set()
    drain.join()
    assert log._store is not None
    log._store.close()  # what the process's end does


def test_the_log_works_on_the_machines_clock(tmp_path: Path) -> None:
    log = FlightLog(tmp_path, clock=SystemClock(), drain_period_ns=1_000_000)
    packets = timing_packets(200)
    for packet in packets:
        log.write(packet)
    deadline = time.monotonic() + 5.0
    while len(content(tmp_path)) < sum(map(len, packets)) and time.monotonic() < deadline:
        time.sleep(0.002)
    assert content(tmp_path) == b"".join(packets), "drained by the ticker, not by close"
    log.close()


WRITER = """
import sys
from pathlib import Path
from flight.telemetry.definitions import CYCLE_TIMING
from flight.telemetry.log import FlightLog
from flight.telemetry.packets import Packer
from hal.buses.clock import SystemClock

clock, packer, cycle = SystemClock(), Packer(), 0
log = FlightLog(Path(sys.argv[1]), clock=clock, segment_bytes=50_000, drain_period_ns=1_000_000)
while True:
    for _ in range(20):
        log.write(packer.pack(CYCLE_TIMING, cycle, cycle=cycle, lateness=0.0, execution=0.0))
        cycle += 1
    clock.sleep_until_ns(clock.now_ns() + 500_000)
"""


def test_a_killed_process_leaves_a_readable_log(tmp_path: Path) -> None:
    """SIGKILL in the middle of writing: no gap, no bad byte but perhaps one packet cut short at the end."""
    root = Path(__file__).resolve().parents[2]
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], cwd=root)
    try:
        deadline = time.monotonic() + 20.0
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
    """The file as a crash would leave it: any prefix of it."""
    log = FlightLog(tmp_path, clock=ManualClock())
    packets = timing_packets(100)
    for packet in packets:
        log.write(packet)
    log.close()
    path = tmp_path / "flight-0001.ccsds"
    for end in range(path.stat().st_size, 0, -13):
        os.truncate(path, end)
        assert scan(content(tmp_path)).counts.get("cycle_timing", 0) == end // len(packets[0])


def test_a_patient_log_begins_without_its_disk_and_writes_all_when_it_comes(tmp_path: Path) -> None:
    clock, disk = ManualClock(0), SmallDisk(0)
    packets = timing_packets(20)

    def opener(path: Path) -> SegmentFile:
        if not disk.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return disk.open(path)

    with pytest.raises(UsageError, match=f"no log can be written there: {os.strerror(errno.ENOSPC)}"):
        FlightLog(tmp_path, clock=clock, opener=opener)
    log = FlightLog(tmp_path, clock=clock, patient=True, opener=opener)
    for packet in packets:
        log.write(packet)
    clock.advance(2 * SECOND)
    assert log.error().endswith("0 packets lost, 20 waiting")
    disk.room = 1 << 20
    clock.advance(2 * SECOND)
    assert (log.error(), log.lost) == ("", 0)
    log.close()
    assert content(tmp_path) == b"".join(packets)
