"""Tests that each boot gets a new folder in the archive, which deletes the oldest runs to keep its budget."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from flight.link.telemetry import log
from flight.link.telemetry.log import LEAST_FREE_BYTES, MOST_RUNS, FlightLog, begin_run, find_runs
from knightcube.errors import UsageError
from tests.flight.link.telemetry.samples import timing_packets
from tests.flight.link.telemetry.small_disk import content
from tests.manual_clock import ManualClock


def fill(folder: Path, size: int) -> None:
    """Write `size` bytes into two files of a run."""
    (folder / "flight-0001.ccsds").write_bytes(bytes(size - size // 3))
    (folder / "figures").mkdir()
    (folder / "figures" / "a.png").write_bytes(bytes(size // 3))


def names(archive: Path) -> list[str]:
    return [path.name for path in find_runs(archive)]


def test_each_boot_gets_the_next_number_in_a_folder_of_its_own(tmp_path: Path) -> None:
    archive = tmp_path / "state" / "runs"
    for number in (1, 2, 3):
        run = begin_run(archive, 1000, 100)
        assert run.folder == archive / f"run-00000{number}"
        assert (list(run.folder.iterdir()), run.dropped) == ([], 0)


def test_the_oldest_runs_go_until_the_rest_leaves_room_for_the_coming_one(tmp_path: Path) -> None:
    for _ in range(5):
        fill(begin_run(tmp_path, 10_000, 100).folder, 300)
    assert begin_run(tmp_path, 2000, 500).dropped == 0, "5 x 300 + 500 bytes just fit"
    run = begin_run(tmp_path, 1300, 500)
    assert run.dropped == 3
    assert names(tmp_path) == ["run-000004", "run-000005", "run-000006", "run-000007"]


def test_runs_are_in_the_order_of_their_numbers_not_of_their_letters_or_times(tmp_path: Path) -> None:
    for number in (999_999, 1_000_001, 7, 1_000_000):
        (tmp_path / f"run-{number:06d}").mkdir()
    assert names(tmp_path) == ["run-000007", "run-999999", "run-1000000", "run-1000001"]
    assert begin_run(tmp_path, 10, 1).folder.name == "run-1000002"


def test_a_number_is_not_used_again_while_newer_runs_are_there(tmp_path: Path) -> None:
    for _ in range(3):
        fill(begin_run(tmp_path, 10_000, 100).folder, 300)
    assert begin_run(tmp_path, 1000, 1000).folder.name == "run-000004"
    assert names(tmp_path) == ["run-000004"]


def test_nothing_but_runs_is_ever_removed(tmp_path: Path) -> None:
    archive, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "precious").write_text("keep")
    archive.mkdir()
    (archive / "run-000001").symlink_to(elsewhere)
    (archive / "run-2").mkdir()
    (archive / "run-000002.txt").write_text("a note")
    (archive / "state-a.json").write_text("{}")
    fill(begin_run(archive, 10_000, 100).folder, 5000)
    assert begin_run(archive, 1000, 1000).dropped == 1
    assert names(archive) == ["run-000003"], "number 1 is taken by the link"
    assert (elsewhere / "precious").read_text() == "keep"
    assert {path.name for path in archive.iterdir()} >= {"run-2", "run-000002.txt", "state-a.json"}


def test_a_board_that_crashes_at_every_start_does_not_fill_the_disk_with_folders(tmp_path: Path) -> None:
    for number in range(1, MOST_RUNS + 3):
        (tmp_path / f"run-{number:06d}").mkdir()
    assert begin_run(tmp_path, 1000, 100).dropped == 3
    assert len(names(tmp_path)) == MOST_RUNS


def test_a_budget_below_the_coming_run_and_a_place_that_cannot_be_written_are_clear_errors(
    tmp_path: Path,
) -> None:
    with pytest.raises(UsageError, match="archive budget of 10 bytes is too small: one run needs 11"):
        begin_run(tmp_path, 10, 11)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="the folder of a new run cannot be made: Not a directory"):
        begin_run(tmp_path / "file" / "runs", 10, 1)


def test_a_full_disk_takes_the_oldest_runs_but_not_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk has room either after two runs were deleted, or only after all runs were deleted."""
    for _ in range(4):
        fill(begin_run(tmp_path, 10_000, 100).folder, 300)

    def statvfs(needed: int) -> None:
        def free(path: Path) -> SimpleNamespace:
            gone = 4 - len(find_runs(Path(path)))
            return SimpleNamespace(f_bavail=LEAST_FREE_BYTES if gone >= needed else 0, f_frsize=1)

        monkeypatch.setattr(os, "statvfs", free)

    statvfs(2)
    assert begin_run(tmp_path, 10_000, 100).dropped == 2
    assert names(tmp_path) == ["run-000003", "run-000004", "run-000005"]
    (tmp_path / "run-000005").rmdir()
    statvfs(9)
    assert begin_run(tmp_path, 10_000, 100).dropped == 1
    assert names(tmp_path) == ["run-000004", "run-000005"]


def test_a_flight_starts_although_the_disk_stores_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mkdir(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", mkdir)
    run = begin_run(tmp_path / "runs", 10, 1)
    assert (run.folder, run.folder.exists()) == (tmp_path / "runs" / "run-000001", False)


@pytest.mark.parametrize("number", [errno.EIO, errno.EUCLEAN])
def test_a_flight_starts_in_a_new_folder_although_the_archive_cannot_be_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    for _ in range(3):
        fill(begin_run(tmp_path, 10_000, 100).folder, 300)
    real = os.scandir

    def scandir(path: Path) -> object:
        if Path(path) == tmp_path:
            raise OSError(number, os.strerror(number), str(path))
        return real(path)

    with monkeypatch.context() as disk:
        disk.setattr(os, "scandir", scandir)
        assert begin_run(tmp_path, 10_000, 100).folder.name == "run-000004"
        assert names(tmp_path) == []
    assert names(tmp_path)[-1] == "run-000004"


def test_a_damaged_run_folder_stops_no_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(3):
        fill(begin_run(tmp_path, 10_000, 100).folder, 300)
    real = os.scandir

    def scandir(path: Path) -> object:
        if "run-000002" in str(path):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert begin_run(tmp_path, 10_000, 100).folder.name == "run-000004"


def test_an_attempt_that_fails_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folders of many failed attempts would make the archive delete earlier runs."""

    def fail(_: Path) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(log, "make_lasting", fail)
    with pytest.raises(UsageError, match="Too many open files"):
        begin_run(tmp_path, 1000, 100)
    assert find_runs(tmp_path) == []


def test_a_run_that_fills_the_disk_deletes_earlier_runs_and_then_its_oldest_segments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link could store no request and no file of the ground if the log used the whole disk."""
    for _ in range(4):
        fill(begin_run(tmp_path, 10**6, 100).folder, 2000)
    packets = timing_packets(400)
    size = len(packets[0])
    run = begin_run(tmp_path, 10**6, 100).folder
    capacity, frees = LEAST_FREE_BYTES + 8000 + 50 * size, []

    def statvfs(_: object) -> SimpleNamespace:
        frees.append(capacity - sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()))
        return SimpleNamespace(f_bavail=frees[-1], f_frsize=1)

    monkeypatch.setattr(os, "statvfs", statvfs)
    clock = ManualClock(0)
    flight = FlightLog(run, clock=clock, segment_bytes=10 * size, patient=True)
    for packet in packets:
        flight.write(packet)
        clock.advance(250_000_000)
    flight.close()
    statvfs(tmp_path)
    assert names(tmp_path) == ["run-000004", "run-000005"], "the newest earlier run is kept"
    assert frees[-1] >= LEAST_FREE_BYTES
    assert (flight.lost, flight.error()) == (0, "")
    stored = content(run)
    assert 0 < flight.dropped_segments < 40
    assert stored == b"".join(packets[-(len(stored) // size) :]), "the newest packets are kept"
