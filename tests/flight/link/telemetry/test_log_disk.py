"""Tests that the log reports a full, slow, missing or hung disk, and never blocks the loop."""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from pathlib import Path

import pytest

from flight.link.telemetry.log import FlightLog, SegmentFile, open_segment
from ground.telemetry import scan
from knightcube.errors import UsageError
from tests.flight.link.telemetry.samples import timing_packets
from tests.flight.link.telemetry.small_disk import SmallDisk, SmallDiskFile, content
from tests.manual_clock import ManualClock

SECOND = 1_000_000_000


@pytest.mark.parametrize("room", [0, 1, 500, 777])
def test_a_full_disk_stops_the_log_in_order(tmp_path: Path, room: int) -> None:
    """Packets that fit on the disk are stored completely, and all other packets are counted and reported."""
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
    """The queue of the log keeps packets until the disk has room again.

    A packet that was written incompletely is written again.
    """
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


def test_packets_that_were_lost_on_a_full_disk_are_counted_until_the_end(tmp_path: Path) -> None:
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
    assert result.missing["cycle_timing"] == 10, "the sequence counts show the gap"


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
        broken.setattr("flight.link.telemetry.log.os.fsync", fail)
        with pytest.raises(OSError, match=os.strerror(errno.EIO)):
            open_segment(path)
    assert not path.exists()
    open_segment(path).close()


def test_an_incomplete_packet_that_cannot_be_truncated_loses_no_later_packet(tmp_path: Path) -> None:
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


def test_a_segment_that_cannot_be_opened_later_stops_the_log_in_order(tmp_path: Path) -> None:
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


def test_a_segment_that_a_failing_disk_leaves_behind_does_not_stop_the_log(tmp_path: Path) -> None:
    """The disk can fail between the creation of a segment and the removal of its file."""
    failures = iter([False, True])

    def opened(path: Path) -> SegmentFile:
        file = open_segment(path)
        if next(failures, False):
            file.close()
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return file

    clock, packets = ManualClock(0), timing_packets(25)
    log = FlightLog(tmp_path, clock=clock, segment_bytes=10 * len(packets[0]), opener=opened)
    for packet in packets:
        log.write(packet)
    clock.advance(SECOND)
    assert os.strerror(errno.EIO) in log.error()
    clock.advance(3 * SECOND)
    assert log.error() == ""
    log.close()
    assert content(tmp_path) == b"".join(packets)


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


def test_packets_since_the_last_sync_count_as_lost_when_a_sync_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock(0)
    log = FlightLog(tmp_path, clock=clock, sync_period_ns=SECOND)
    fsync = os.fsync
    for second, lost in enumerate((0, 10, 20, 20)):
        monkeypatch.setattr("flight.link.telemetry.log.os.fsync", fsync if second in (0, 3) else failing_sync)
        for i, packet in enumerate(timing_packets(10)):
            log.write(packet)
            clock.sleep_until_ns(second * SECOND + (i + 1) * SECOND // 10)
        assert log.lost == lost
    log.close()
    assert len(content(tmp_path)) == 40 * len(timing_packets(1)[0])


def failing_sync(file: int) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_hung_disk_blocks_neither_write_nor_close(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.link.telemetry.log._HUNG_DISK_S", 0.1)
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
    log._store.close()  # the process ends without closing the log


def test_a_patient_log_begins_without_its_disk_and_writes_all_when_it_comes(tmp_path: Path) -> None:
    clock, disk = ManualClock(0), SmallDisk(0)
    packets = timing_packets(20)

    def opener(path: Path) -> SegmentFile:
        if not disk.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return disk.open(path)

    with pytest.raises(UsageError, match=f"a log cannot be written there: {os.strerror(errno.ENOSPC)}"):
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


def test_a_folder_that_is_removed_in_flight_is_reported_at_once_and_made_again(tmp_path: Path) -> None:
    clock, folder = ManualClock(0), tmp_path / "run"
    packets = timing_packets(30)
    log = FlightLog(folder, clock=clock)
    for packet in packets[:10]:
        log.write(packet)
    clock.advance(SECOND)
    shutil.rmtree(folder)
    for packet in packets[10:20]:
        log.write(packet)
    clock.advance(SECOND // 4)
    reported = "log flight: writing stopped: the run's files were removed; 10 packets lost, 10 waiting"
    assert log.error() == reported
    clock.advance(2 * SECOND)
    assert log.error() == ""
    for packet in packets[20:]:
        log.write(packet)
    log.close()
    assert content(folder) == b"".join(packets[10:])
    assert log.lost == 10
