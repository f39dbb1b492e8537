"""Tests of transfers over a lossy channel, with killed ends and refused files."""

from __future__ import annotations

import errno
import io
import json
import os
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link.files import store
from flight.link.files.store import (
    Ending,
    FileError,
    Incoming,
    Outgoing,
    Ranges,
    Store,
    line_of,
    problem_of_name,
    to_record,
)
from flight.link.files.transfer import (
    CRC32,
    CRC32C,
    GROUND,
    MODULAR,
    MOST_OPEN,
    NO_CHECKSUM,
    SATELLITE,
    Entity,
    Origin,
    add,
)
from flight.link.files.units import (
    MOST_REQUESTS,
    Ack,
    Code,
    Condition,
    Eof,
    FileData,
    FileStatus,
    Finished,
    Metadata,
    Nak,
    Transaction,
    pack,
    unpack,
)
from tests.flight.link.files.lossy import MOST, Pair

SIZE = 200_001


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_bytes(np.random.default_rng(5).bytes(SIZE))
    return path


@pytest.mark.parametrize("kind", [MODULAR, CRC32C, CRC32, NO_CHECKSUM])
@pytest.mark.parametrize("source", [SATELLITE, GROUND])
@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
def test_a_file_arrives_complete_and_is_closed_at_both_ends(
    tmp_path: Path, file: Path, loss: float, source: int, kind: int
) -> None:
    pair = Pair(tmp_path, loss, seed=7)
    pair.send(source, file, "a/b.bin", kind)
    pair.until_closed()
    assert pair.received(SATELLITE + GROUND - source, "a/b.bin") == file.read_bytes()
    assert [[one.condition for one in pair.ended[end]] for end in (SATELLITE, GROUND)] == [[0], [0]]
    if not loss:
        assert pair.carried < SIZE / 900 + 10, "something was sent twice over a channel without loss"


@pytest.mark.parametrize("seed", range(4))
def test_ends_that_are_killed_go_on(tmp_path: Path, file: Path, seed: int) -> None:
    pair, draw = Pair(tmp_path, 0.2, seed), np.random.default_rng(seed)
    pair.send(SATELLITE, file, "down")
    pair.send(GROUND, file, "up")
    for _ in range(30):
        for _ in range(int(draw.integers(1, 8))):
            pair.turn(units=4)
        pair.kill(int(draw.integers(SATELLITE, GROUND + 1)))
    pair.until_closed()
    assert pair.received(GROUND, "down") == pair.received(SATELLITE, "up") == file.read_bytes()


def test_a_killed_end_asks_again_for_a_second_at_most(tmp_path: Path, file: Path) -> None:
    pair = Pair(tmp_path, 0.0)
    pair.send(SATELLITE, file, "down")
    for _ in range(60):  # cycles of 20 ms, 1.2 s in total
        pair.turn(units=3)
    pair.kill(GROUND)
    (progress,) = pair.ends[GROUND].transfers()
    assert progress.done >= 45 * 3 * 900
    before = pair.carried
    pair.until_closed()
    assert pair.carried - before < (SIZE - progress.done) / 900 + 20


@pytest.mark.parametrize("point", range(2))
def test_a_received_file_is_stored_after_a_kill_during_its_storage(
    tmp_path: Path, file: Path, point: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = Pair(tmp_path, 0.0)
    pair.send(SATELLITE, file, "down")
    calls = iter(range(point))

    def replace(one: Path, other: Path) -> None:
        if pair.ends[GROUND].transfers() and "in-" in one.name and next(calls, None) is None:
            raise KeyboardInterrupt
        os.rename(one, other)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(KeyboardInterrupt):
        pair.until_closed()
    monkeypatch.undo()
    pair.kill(GROUND)
    pair.until_closed()
    assert pair.received(GROUND, "down") == file.read_bytes()


def test_a_received_file_that_cannot_be_read_does_not_prevent_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, stat = Store(tmp_path), os.stat
    folder.save(store.Incoming(GROUND, 1, "release/a", 1, finished=(0, True, 2)))

    def fail(path: object, **options: bool) -> os.stat_result:
        if str(path).endswith(".part"):
            raise OSError(errno.EIO, "Input/output error")
        return stat(path, **options)  # type: ignore[arg-type]  # as called

    monkeypatch.setattr(os, "stat", fail)
    assert len(Entity(SATELLITE, folder, lambda _: "", SIZE, 0).transfers()) == 1


def test_an_eof_that_comes_again_is_acknowledged_again_also_after_the_end(tmp_path: Path, file: Path) -> None:
    pair = Pair(tmp_path, 0.0)
    number = pair.send(SATELLITE, file, "down").number
    pair.until_closed()
    transaction = Transaction(SATELLITE, number, GROUND)
    pair.kill(GROUND)
    pair.ends[GROUND].take(pack(transaction, Eof(0, 1, 2)), 0)
    answers = [unpack(unit)[1] for unit in iter(lambda: pair.ends[GROUND].unit(0), None)]
    assert answers[1] == Finished(0, True, 2)
    assert pair.ends[SATELLITE].unit(0) is None
    pair.ends[SATELLITE].take(pack(transaction, Finished(0, True, 2)), 0)
    assert pair.ends[SATELLITE].unit(0) is not None, "a late Finished is not acknowledged"


def test_numbers_outlive_a_restart_and_the_loss_of_their_record(tmp_path: Path, file: Path) -> None:
    one = Store(tmp_path / "s")
    given = [one.new_number(5 * 10**9), one.new_number(5 * 10**9)]
    given.append(Store(tmp_path / "s").new_number(0))
    assert given == [5, 6, 7]
    (tmp_path / "s" / "transfers" / "numbers.json").write_bytes(b"{")
    assert Store(tmp_path / "s").new_number(60 * 10**9) == 60


def test_numbers_do_not_repeat_under_a_clock_beyond_their_range(tmp_path: Path) -> None:
    """The numbers have 32 bits, and the UTC of a wrong clock reaches the year 2262."""
    folder = Store(tmp_path)
    given = [folder.new_number(utc_ns) for utc_ns in (2**63 - 1, 2**63 - 1, 5 * 10**9)]
    assert len({*given}) == 3
    assert folder.new_number((2**32 - 1) * 10**9) == 2**32 - 1
    assert [folder.new_number(utc_ns) for utc_ns in (0, -(10**9))] == [1, 2]


@pytest.mark.parametrize(
    "name",
    [
        "",
        "..",
        "../a",
        "a/../b",
        "/etc/passwd",
        "a//b",
        "a\0b",
        ".bashrc",
        "a/.b",
        "a b",
        "a\n",
        "x" * 96,
        "a/b/c/d/e",
    ],
)
def test_names_that_could_leave_the_folder_are_refused(tmp_path: Path, file: Path, name: str) -> None:
    assert problem_of_name(name)
    pair = Pair(tmp_path, 0.0)
    with pytest.raises(FileError):
        pair.send(GROUND, file, name)
    transaction = Transaction(GROUND, 9, SATELLITE)
    pair.ends[SATELLITE].take(pack(transaction, Metadata(3, name, name, CRC32)), 0)
    pair.ends[SATELLITE].take(pack(transaction, FileData(0, b"abc")), 0)
    answer = pair.ends[SATELLITE].unit(0)
    assert answer is not None
    assert unpack(answer)[1] == Finished(4, False, 1)
    assert not [path for path in (tmp_path / str(SATELLITE) / "received").rglob("*")]


@pytest.mark.parametrize(
    ("unit", "condition"),
    [
        (Metadata(MOST + 1, "a", "a", CRC32), 4),
        (Metadata(10, "a", "a", 9), 11),
        (FileData(8, b"abc"), 6),
        (Eof(0, 0, 11), 6),
        (Eof(15, 0, 0), 15),
    ],
)
def test_a_faulty_unit_of_a_file_ends_its_transfer(
    tmp_path: Path, unit: Metadata | FileData | Eof, condition: int
) -> None:
    pair, transaction = Pair(tmp_path, 0.0), Transaction(GROUND, 9, SATELLITE)
    end = pair.ends[SATELLITE]
    if not isinstance(unit, Metadata):
        end.take(pack(transaction, Metadata(10, "a", "a", CRC32)), 0)
    end.take(pack(transaction, unit), 0)
    answers = [unpack(answer)[1] for answer in iter(lambda: end.unit(0), None)]
    assert [one.condition for one in answers if isinstance(one, Finished)] == [condition]


def test_bytes_beyond_the_end_that_came_before_the_metadata_are_left_out_of_the_file(tmp_path: Path) -> None:
    """File data beyond the stated file size is an error, even if the data arrive before the size.

    CCSDS 727.0-B-5, 4.6.1.2, states this rule.
    """
    pair, transaction = Pair(tmp_path, 0.0), Transaction(GROUND, 9, SATELLITE)
    end = pair.ends[SATELLITE]
    checksum = zlib.crc32(b"abc")
    for unit in (FileData(0, b"abcdef"), Eof(0, checksum, 3), Metadata(3, "a", "a", CRC32)):
        end.take(pack(transaction, unit), 0)
    end.work(0)
    answers = [unpack(answer)[1] for answer in iter(lambda: end.unit(0), None)]
    assert [one.condition for one in answers if isinstance(one, Finished)] == [6]
    assert not (tmp_path / str(SATELLITE) / "received" / "a").exists()


def test_a_wrong_checksum_and_a_full_disk_are_reported_and_nothing_is_kept(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = Pair(tmp_path, 0.0)
    pair.send(SATELLITE, file, "down")
    pair.turn(units=50)
    file.write_bytes(bytes(SIZE))
    pair.until_closed()
    assert [one.condition for one in pair.ended[SATELLITE]] == [5]
    monkeypatch.setattr(Store, "room", lambda _: SIZE - 1)
    pair.send(SATELLITE, file, "again")
    pair.until_closed()
    assert [one.condition for one in pair.ended[GROUND]] == [5, 4]
    folder = pair.store(GROUND)
    assert not folder.incoming()
    assert not [path for path in folder.received.rglob("*") if path.is_file()]


def test_metadata_that_could_not_be_checked_on_a_failing_disk_are_checked_when_repeated(
    tmp_path: Path,
) -> None:
    reasons: list[str | OSError] = [OSError(errno.EIO, "failed"), "not allowed"]

    def accept(_: Metadata) -> str:
        reason = reasons.pop(0)
        if isinstance(reason, OSError):
            raise reason
        return reason

    end = Entity(SATELLITE, Store(tmp_path), accept, SIZE, 0)
    metadata = pack(Transaction(GROUND, 1, SATELLITE), Metadata(SIZE, "a", "a", CRC32))
    with pytest.raises(OSError, match="failed"):
        end.take(metadata, 0)
    end.take(metadata, 0)
    answer = end.unit(0)
    assert answer is not None
    assert unpack(answer)[1] == Finished(Condition.FILESTORE_REJECTION, False, FileStatus.REJECTED)


def test_a_full_disk_does_not_stop_a_file_that_was_begun_before(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = Pair(tmp_path, 0.0)
    small = tmp_path / "small"
    small.write_bytes(b"abc")
    pair.send(SATELLITE, file, "down")
    up = pair.send(GROUND, small, "up")
    whole = store.write_whole

    def full(path: Path, data: bytes) -> None:
        if path.is_relative_to(tmp_path / str(SATELLITE)):
            raise FileError("no space left")
        whole(path, data)

    def keep(now_ns: int) -> None:
        with suppress(FileError):  # `flight.link.process.filing` reports this error
            Entity.keep(end, now_ns)

    end = pair.ends[SATELLITE]
    monkeypatch.setattr(store, "write_whole", full)
    monkeypatch.setattr(end, "keep", keep)
    pair.until_closed()
    assert pair.received(GROUND, "down") == file.read_bytes()
    assert [(one.name, one.condition) for one in pair.ended[GROUND]] == [("up", 4), ("down", 0)]
    end.take(pack(Transaction(GROUND, up.number, SATELLITE), Eof(0, 1, 3)), pair.now_ns)
    assert not end.transfers(), "an ended transfer began again"


def test_a_damaged_folder_of_transfers_does_not_keep_an_end_from_starting(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = Pair(tmp_path, 0.0)
    pair.send(SATELLITE, file, "down")

    scandir = os.scandir

    for failures, transfers in ((100, 0), (1, 1), (0, 1)):

        def damaged(path: Path, left: list[int] = [failures]) -> object:  # noqa: B006 - the count of one disk
            left[0] -= 1
            if left[0] >= 0:
                raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
            return scandir(path)

        with monkeypatch.context() as disk:
            disk.setattr(os, "scandir", damaged)
            pair.kill(SATELLITE)
        assert len(pair.ends[SATELLITE].transfers()) == transfers


def test_a_file_that_shrinks_or_is_cancelled_ends_at_both_ends(tmp_path: Path, file: Path) -> None:
    pair = Pair(tmp_path, 0.3, seed=1)
    pair.send(SATELLITE, file, "shrinks")
    cancelled = pair.send(GROUND, file, "cancelled")
    pair.turn()
    os.truncate(file, 10_000)
    pair.ends[SATELLITE].cancel(GROUND, cancelled.number)
    pair.until_closed()
    assert {one.name: one.condition for one in pair.ended[SATELLITE]} == {"shrinks": 4, "cancelled": 15}
    assert {one.name: one.condition for one in pair.ended[GROUND]} == {"shrinks": 4, "cancelled": 15}
    with pytest.raises(FileError, match="no transfer"):
        pair.ends[SATELLITE].cancel(1, 1)


@pytest.mark.parametrize("source", [SATELLITE, GROUND])
def test_the_eof_of_a_cancelled_transfer_states_what_was_transmitted(
    tmp_path: Path, file: Path, source: int
) -> None:
    pair = Pair(tmp_path, 0.0)
    one = pair.send(source, file, "a")
    end = pair.ends[source]
    sent = [unpack(unit)[1] for unit in (end.unit(0) for _ in range(40)) if unit is not None]
    data = b"".join(content.data for content in sent if isinstance(content, FileData))
    end.cancel(source, one.number)
    unit = end.unit(0)
    assert unit is not None
    assert unpack(unit)[1] == Eof(15, add(CRC32, 0, data), len(data))


@pytest.mark.parametrize("suspended", [SATELLITE, GROUND])
def test_a_suspended_transfer_rests_over_a_restart_and_goes_on_when_it_is_resumed(
    tmp_path: Path, file: Path, suspended: int
) -> None:
    pair = Pair(tmp_path, 0.2, seed=3)
    number = pair.send(SATELLITE, file, "down").number
    pair.turn(units=20)
    pair.ends[suspended].suspend(SATELLITE, number, suspended=True)
    pair.kill(suspended)
    for _ in range(100):
        pair.turn(units=20)
    before = pair.carried
    for _ in range(100):
        pair.turn(units=20)
    assert pair.ended[SATELLITE] == []
    (shown,) = pair.ends[suspended].transfers()
    assert (shown.condition, shown.said) == (None, "suspended")
    assert pair.carried - before <= 1, "only the other end may ask, ever more seldom"
    pair.ends[suspended].suspend(SATELLITE, number, suspended=False)
    pair.until_closed()
    assert pair.received(GROUND, "down") == file.read_bytes()
    with pytest.raises(FileError, match="no transfer"):
        pair.ends[SATELLITE].suspend(SATELLITE, number, suspended=True)


def test_a_damaged_record_is_ignored(tmp_path: Path, file: Path) -> None:
    pair = Pair(tmp_path, 0.0)
    pair.send(SATELLITE, file, "down")
    (path,) = (tmp_path / str(SATELLITE) / "transfers").glob("out-*.json")
    data = path.read_bytes()
    assert len(pair.store(SATELLITE).outgoing()) == 1
    for position in range(len(data)):
        path.write_bytes(data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :])
        assert pair.store(SATELLITE).outgoing() == []


def test_fields_that_a_later_release_has_added_to_records_are_ignored(tmp_path: Path) -> None:
    """After a return to an earlier release, the transfers of the later release continue."""
    folder, ending = Store(tmp_path), Ending(GROUND, 6, 0, complete=True, kept=2)
    outgoing = Outgoing(7, GROUND, "/log", "log/a", 9, 1, CRC32)
    incoming = Incoming(GROUND, 8, "elements/a", 4, ranges=((0, 2),))
    for record in (outgoing, incoming):
        folder.save(record)
    folder.add_ending(ending)
    folder.new_number(9 * 10**9)
    for path in (tmp_path / "transfers").glob("*.json"):
        values = json.loads(line_of(path.read_bytes()) or b"")
        for part in (values, *values.get("endings", ())):
            part["added"] = {"later": [1]}
        path.write_bytes(to_record(json.dumps(values).encode()))
    again = Store(tmp_path)
    assert (again.outgoing(), again.incoming(), again.endings, again.last) == (
        [outgoing],
        [incoming],
        (ending,),
        9,
    )


def test_many_gaps_are_requested_in_order_and_a_bounded_number_at_a_time(tmp_path: Path) -> None:
    pair, transaction = Pair(tmp_path, 0.0), Transaction(GROUND, 9, SATELLITE)
    end, size, pieces = pair.ends[SATELLITE], 1 << 20, 3000
    end.take(pack(transaction, Metadata(size, "a", "a", CRC32)), 0)
    for piece in range(pieces):
        end.take(pack(transaction, FileData(2 * piece, b"x")), 0)
    end.take(pack(transaction, Eof(0, 1, size)), 0)
    naks = [unpack(unit)[1] for unit in iter(lambda: end.unit(0), None)]
    gaps = [gap for nak in naks if isinstance(nak, Nak) for gap in nak.gaps]
    assert gaps[:-1] == [(2 * piece + 1, 2 * piece + 2) for piece in range(pieces - 1)]
    assert max(len(nak.gaps) for nak in naks if isinstance(nak, Nak)) < MOST_REQUESTS


def _asked_at(end: Entity, seconds: Sequence[float]) -> list[float]:
    """Return the times (s) at which an end requests missing data."""
    return [
        time
        for time in seconds
        for unit in iter(lambda: end.unit(round(time * 1e9)), None)  # noqa: B023 - used up at once
        if isinstance(unpack(unit)[1], Nak)
    ]


def test_missing_data_are_requested_at_the_end_and_again_two_seconds_after_the_last_data(
    tmp_path: Path,
) -> None:
    pair, transaction = Pair(tmp_path, 0.0), Transaction(GROUND, 9, SATELLITE)
    end = pair.ends[SATELLITE]
    end.take(pack(transaction, Metadata(40, "a", "a", CRC32)), 0)
    end.take(pack(transaction, FileData(0, bytes(10))), 0)
    end.take(pack(transaction, Eof(0, 1, 40)), 1_000_000_000)
    assert _asked_at(end, [1.0, 1.5, 2.5]) == [1.0]
    end.take(pack(transaction, FileData(10, bytes(10))), 2_500_000_000)
    assert _asked_at(end, [3.0, 4.0, 4.4]) == [], "data arrived less than 2 s ago"
    assert _asked_at(end, [4.5, 5.0, 6.4, 6.5]) == [4.5, 6.5]


def test_without_an_end_missing_data_are_requested_ten_seconds_after_the_last_data(tmp_path: Path) -> None:
    pair, transaction = Pair(tmp_path, 0.0), Transaction(GROUND, 9, SATELLITE)
    end = pair.ends[SATELLITE]
    end.take(pack(transaction, Metadata(40, "a", "a", CRC32)), 0)
    end.take(pack(transaction, FileData(0, bytes(10))), 6_000_000_000)
    assert _asked_at(end, [6.0, 10.0, 15.9]) == []
    assert _asked_at(end, [16.0, 20.0, 25.9, 26.0]) == [16.0, 26.0]


def _sliced(missing: set[int]) -> list[tuple[int, int]]:
    """Return the first gap in the bytes 0 to 25, and the last gap in the bytes 7 to 25.

    A gap is a range of `missing` bytes, given as a pair (begin, end). The second gap starts at byte 7 or
    later.
    """
    edges = [n for n in range(26) if (n in missing) != (n - 1 in missing)]
    gaps = list(zip(edges[::2], edges[1::2], strict=True))
    return gaps[:1] + [(max(begin, 7), end) for begin, end in gaps if end > 7][-1:]


def test_a_repeated_request_of_a_file_continues_its_transfer_and_a_ninth_transfer_is_refused(
    tmp_path: Path, file: Path
) -> None:
    pair = Pair(tmp_path, 0.0)
    first = pair.send(SATELLITE, file, "a")
    assert pair.send(SATELLITE, file, "a").number == first.number
    for i in range(MOST_OPEN - 1):
        pair.send(SATELLITE, file, f"a{i}")
    with pytest.raises(FileError, match="cancel one"):
        pair.send(SATELLITE, file, "b")


@pytest.mark.parametrize("displaced", [False, True])
def test_a_file_that_was_received_whole_is_not_reported_as_cancelled(tmp_path: Path, displaced: bool) -> None:
    """The transfer is cancelled or displaced by new ones before the sender has acknowledged its end."""
    pair, transaction, data = Pair(tmp_path, 0.0), Transaction(GROUND, 9, SATELLITE), b"data"
    end = pair.ends[SATELLITE]
    end.take(pack(transaction, Metadata(4, "a", "a", CRC32)), 0)
    end.take(pack(transaction, FileData(0, data)), 0)
    end.take(pack(transaction, Eof(0, zlib.crc32(data), 4)), 0)
    while end.transfers()[0].condition is None:
        end.work(0)
    assert pair.received(SATELLITE, "a") == data
    if displaced:
        for number in range(10, 10 + MOST_OPEN):
            end.take(pack(Transaction(GROUND, number, SATELLITE), FileData(0, data)), number)
    else:
        end.cancel(GROUND, 9)
    (progress,) = end.ended if displaced else end.transfers()
    assert (progress.number, progress.condition, progress.said) == (9, 0, "whole")


def test_ranges_against_a_set_of_bytes() -> None:
    draw = np.random.default_rng(1)
    for _ in range(50):
        ranges, known = Ranges(), set[int]()
        for begin, length in draw.integers(0, 20, (12, 2)).tolist():
            ranges.add(begin, begin + length)
            known |= set(range(begin, begin + length))
            assert ranges.total == len(known)
            missing = {n for pair in ranges.gaps(0, 25, 99) for n in range(*pair)}
            assert missing == set(range(25)) - known
            assert ranges.gaps(0, 25, 1) + ranges.gaps(7, 25, 99)[-1:] == _sliced(missing)
            assert ranges.cover(length) == (set(range(length)) <= known)
        taken = set[int]()
        while ranges:
            taken |= set(range(*ranges.take(3)))
        assert taken == known


def test_a_record_that_does_not_fit_on_the_disk_leaves_no_incomplete_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "listing.json"
    store.write_whole(path, b"before")

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(FileError, match="No space left"):
        store.write_whole(path, b"after")
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == {"listing.json": b"before"}


def test_received_data_is_removed_before_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the process is killed in between, the next start finds the record and removes the transfer."""
    folder, record = Store(tmp_path), Incoming(GROUND, 7)
    folder.save(record)
    folder.part(record).write_bytes(b"data")
    unlink = Path.unlink

    def killed(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok)
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            folder.remove(record)
    assert not folder.part(record).exists()
    assert folder.incoming() == [record]


class FailingDisk:
    """A disk on which each kind of access to a transfer's file fails a number of times, then succeeds."""

    def __init__(self, failures: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = dict.fromkeys(("read", "write", "move", "sync"), failures)
        self.unsynced: list[tuple[int, int]] = []  # offset and length of each write since the last sync
        opened, pwrite, replace = Path.open, os.pwrite, os.replace

        def open_(path: Path, mode: str = "r") -> Any:
            self.access("read", mode == "rb")
            return opened(path, mode)

        def write(file: int, data: bytes, offset: int) -> int:
            self.access("write", offset > SIZE // 2)
            self.unsynced.append((offset, len(data)))
            return pwrite(file, data, offset)

        def move(one: Path, other: Path) -> None:
            self.access("move", one.suffix == ".part")
            replace(one, other)

        def sync(file: int) -> None:
            writes, self.unsynced = self.unsynced, []
            try:  # the kernel reports a failed write only once
                self.access("sync", any(offset > SIZE // 2 for offset, _ in writes))
            except OSError:
                for offset, length in writes:  # the kernel discards data that it could not write
                    pwrite(file, bytes(length), offset)
                raise

        monkeypatch.setattr(os, "fdatasync", sync)
        monkeypatch.setattr(Path, "open", open_)
        monkeypatch.setattr(os, "pwrite", write)
        monkeypatch.setattr(os, "replace", move)

    def access(self, kind: str, fails: bool) -> None:
        if fails and self.left[kind]:
            self.left[kind] -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))


@pytest.mark.parametrize("source", [SATELLITE, GROUND])
@pytest.mark.parametrize("access", ["read", "write", "move", "sync"])
def test_a_failed_access_to_the_disk_is_repeated_for_half_a_minute_before_the_transfer_is_given_up(
    tmp_path: Path, file: Path, source: int, access: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = Pair(tmp_path, 0.0)
    other = GROUND if source == SATELLITE else SATELLITE
    disk = FailingDisk(0, monkeypatch)
    disk.left[access] = 3
    pair.send(source, file, "a")
    pair.until_closed()
    assert disk.left[access] == 0
    assert pair.received(other, "a") == file.read_bytes()
    disk.left[access] = 10**9
    begun_ns, failures = pair.now_ns, disk.left[access]
    pair.send(source, file, "b")
    pair.until_closed()
    assert [one.condition for one in pair.ended[source]] == [0, Condition.FILESTORE_REJECTION]
    assert 25e9 < pair.now_ns - begun_ns < 120e9
    attempts = failures - disk.left[access]
    assert attempts < 30 or access in {"write", "sync"}, "each attempt is followed by a pause"
    assert not pair.store(other).incoming()


@pytest.mark.parametrize("lasting", [True, False])
def test_failed_syncs_are_counted_until_new_data_are_kept(
    tmp_path: Path, lasting: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel reports a failed write once, so that the next sync without new data succeeds."""
    end, transaction = Entity(SATELLITE, Store(tmp_path), lambda _: "", SIZE, 0), Transaction(2, 1, SATELLITE)
    disk = FailingDisk(0, monkeypatch)
    end.take(pack(transaction, Metadata(SIZE, "a", "a", CRC32)), 0)
    for attempt in range(60):
        disk.left["sync"] = int(lasting or attempt % 2 == 0)
        offset = SIZE - 1 - (0 if lasting else attempt // 2)
        end.take(pack(transaction, FileData(offset, b"x")), 3 * attempt * 10**9)
        for second in (1, 2):
            with suppress(FileError):
                end.keep((3 * attempt + second) * 10**9)
    (progress,) = end.transfers()
    expected = (Condition.FILESTORE_REJECTION, 0) if lasting else (None, 30)
    assert (progress.condition, progress.done) == expected


class _WithoutSegments(io.BufferedReader):
    """A file in which reads of segments (below 1,000 bytes) fail, but reads for the checksum succeed."""

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size < 1000:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read(size)


def test_data_that_cannot_be_read_end_the_transfer_although_its_checksum_can_be_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "long"
    with path.open("wb") as file:
        file.truncate(64 << 20)
    end = Entity(SATELLITE, Store(tmp_path / "files"), lambda _: "", SIZE, 0)
    end.send(path, "long", GROUND, CRC32, 0, 0, Origin())
    monkeypatch.setattr(Path, "open", lambda path, _: _WithoutSegments(io.FileIO(path)))
    seconds, sent = 0, list[Any]()
    while not any(isinstance(content, Eof) for content in sent):
        seconds += 1
        unit = end.unit(seconds * 10**9)
        sent += [] if unit is None else [unpack(unit)[1]]
    assert sent[-1] == Eof(Condition.FILESTORE_REJECTION, 0, 0)
    assert 25 < seconds < 60


def _give(end: Entity, number: int, name: str, now_ns: int = 0) -> None:
    """Give an end all PDUs of a short file."""
    for content in (Metadata(4, name, name, CRC32), FileData(0, b"data"), Eof(0, zlib.crc32(b"data"), 4)):
        end.take(pack(Transaction(GROUND, number, SATELLITE), content), now_ns)


def _contents(end: Entity, now_ns: int) -> list[Any]:
    """Return the contents of all PDUs that an end sends."""
    return [unpack(unit)[1] for unit in iter(lambda: end.unit(now_ns), None)]


def test_a_record_that_can_never_be_stored_ends_its_transfer_after_half_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Store(tmp_path)
    end = Entity(SATELLITE, folder, lambda _: "", SIZE, 0)

    def fail(record: Outgoing | Incoming) -> None:
        raise FileError("input/output error") from OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(folder, "save", fail)
    _give(end, 1, "a")
    seconds = 0
    while end.transfers()[0].condition is None:
        seconds += 1
        end.work(seconds * 10**9)
    assert end.transfers()[0].condition == Condition.FILESTORE_REJECTION
    assert 25 < seconds < 60


def test_a_failed_sync_of_a_complete_file_is_counted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end = Entity(SATELLITE, Store(tmp_path), lambda _: "", SIZE, 0)
    disk = FailingDisk(0, monkeypatch)
    attempts = 0

    def sync(_: int) -> None:
        nonlocal attempts
        attempts += 1
        disk.left["sync"] = 1
        disk.access("sync", True)

    monkeypatch.setattr(os, "fdatasync", sync)
    for minute in range(10):
        _give(end, 1, "a", minute * 60 * 10**9)
        end.work((minute * 60 + 50) * 10**9)
    assert end.transfers()[0].condition == Condition.FILESTORE_REJECTION
    assert attempts == 7


@pytest.mark.parametrize("waiting", [MOST_OPEN - 1, MOST_OPEN])
def test_a_complete_file_that_waits_for_its_storage_is_not_deleted_as_received(
    tmp_path: Path, waiting: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    end = Entity(SATELLITE, Store(tmp_path), lambda _: "", SIZE, 0)
    with monkeypatch.context() as failing:
        disk = FailingDisk(0, failing)
        disk.left["move"] = 100
        for number in range(1, MOST_OPEN + 1):
            name, transaction = f"f{number}", Transaction(GROUND, number, SATELLITE)
            end.take(pack(transaction, Metadata(4, name, name, CRC32)), number)
            if number <= waiting:
                _give(end, number, name, number)
        for _ in range(4 * MOST_OPEN):
            end.work(MOST_OPEN)
        assert [one.condition for one in end.transfers()].count(0) == waiting
        _give(end, 9, "f9", MOST_OPEN)
    (ended,) = end.ended
    if waiting == MOST_OPEN:
        assert (ended.number, ended.condition) == (1, Condition.FILESTORE_REJECTION)
    else:
        assert (ended.number, ended.condition) == (MOST_OPEN, Condition.CANCELLED)
    for second in range(60):
        end.work(second * 10**9)
    names = {path.name for path in (tmp_path / "received").iterdir()}
    assert names == {f"f{number}" for number in range(1, 10) if number != ended.number}


def test_a_file_that_cannot_be_examined_at_the_start_is_stored_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, stat = Store(tmp_path), os.stat
    folder.save(Incoming(GROUND, 1, "a", 4, finished=(0, True, 2)))
    folder.part(Incoming(GROUND, 1)).write_bytes(b"data")

    def fail(path: Any, **options: bool) -> os.stat_result:
        if str(path).endswith(".part"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return stat(path, **options)

    with monkeypatch.context() as failing:
        failing.setattr(os, "stat", fail)
        FailingDisk(1, failing)
        end = Entity(SATELLITE, folder, lambda _: "", SIZE, 0)
    assert _contents(end, 0) == []
    end.take(pack(Transaction(GROUND, 1, SATELLITE), Ack(Code.FINISHED, 0, 2)), 0)
    end.work(3 * 10**9)
    assert (folder.received / "a").read_bytes() == b"data"
    assert _contents(end, 3 * 10**9) == [Finished(0, True, 2)]


@pytest.mark.parametrize("deleted", [False, True])
def test_the_move_of_a_complete_file_is_synced_after_a_restart_unless_the_file_was_deleted(
    tmp_path: Path, deleted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Store(tmp_path)
    folder.save(Incoming(GROUND, 1, "a", 4, finished=(0, True, 2)))
    if not deleted:
        (folder.received / "a").write_bytes(b"data")
    synced, sync = list[Path](), store.make_lasting

    def noted(path: Path) -> None:
        synced.append(path)
        sync(path)

    monkeypatch.setattr(store, "make_lasting", noted)
    end = Entity(SATELLITE, folder, lambda _: "", SIZE, 0)
    assert (folder.received in synced) != deleted
    assert _contents(end, 0) == [Finished(0, True, 2)]


def test_data_that_are_received_again_do_not_change_a_complete_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end = Entity(SATELLITE, Store(tmp_path), lambda _: "", SIZE, 0)
    _give(end, 1, "a")
    monkeypatch.setattr(os, "pwrite", lambda *_: pytest.fail("the file was written again"))
    end.take(pack(Transaction(GROUND, 1, SATELLITE), FileData(0, b"data")), 0)
    end.work(0)
    end.work(0)
    assert (tmp_path / "received" / "a").read_bytes() == b"data"


def test_records_are_not_written_into_a_folder_that_is_mounted_later(tmp_path: Path) -> None:
    first, late = tmp_path / "files", tmp_path / "late"
    record = Incoming(GROUND, 1, "elements/late", 5)
    Store(late).save(record)
    end = Entity(SATELLITE, Store(first), lambda _: "", SIZE, 0)
    metadata = pack(Transaction(GROUND, 1, SATELLITE), Metadata(9, "elements/early", "a", CRC32))
    end.take(metadata, 0)
    end.keep(0, at_once=True)
    first.rename(tmp_path / "hidden")
    late.rename(first)
    end.take(pack(Transaction(GROUND, 1, SATELLITE), FileData(0, b"abc")), 0)
    with pytest.raises(FileError, match="another folder is mounted there"):
        end.close(0)
    assert Store(first).incoming() == [record]


def test_a_new_name_is_synced_to_disk_in_each_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, record = Store(tmp_path), Incoming(GROUND, 7, "elements/a", 4)
    folder.part(record).write_bytes(b"data")
    synced: list[Path] = []
    monkeypatch.setattr(store, "make_lasting", synced.append)
    folder.place(record)
    assert synced == [folder.received, folder.received / "elements"]


@pytest.mark.parametrize(
    ("failing", "problem"),
    [("received", "cannot be placed"), ("received/elements", "is stored, but a power loss may remove it")],
)
def test_a_file_is_placed_only_if_each_new_name_was_synced_to_disk(
    tmp_path: Path, failing: str, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, record = Store(tmp_path), Incoming(GROUND, 7, "elements/a", 4)
    folder.part(record).write_bytes(b"data")
    synced: list[Path] = []

    def sync(path: Path) -> None:
        synced.append(path)
        if path == tmp_path / failing and synced.count(path) == 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(store, "make_lasting", sync)
    with pytest.raises(FileError, match=f"elements/a: {problem}: Input/output error"):
        folder.place(record)
    folder.place(record)
    assert synced.count(tmp_path / failing) == 2
    assert (folder.received / "elements" / "a").read_bytes() == b"data"
    (folder.received / "elements" / "a").unlink()
    with pytest.raises(FileError, match="No such file"):
        folder.place(record)


def test_only_the_folder_itself_is_closed_to_other_users(tmp_path: Path) -> None:
    (tmp_path / "usual").mkdir()
    store.make_folder(tmp_path / "a" / "b")
    modes = [path.stat().st_mode & 0o777 for path in (tmp_path / "a", tmp_path / "a" / "b")]
    assert modes == [(tmp_path / "usual").stat().st_mode & 0o777, 0o700]


def test_records_are_written_on_a_file_system_without_constant_inode_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some file systems give a folder that is not open a new inode number at each access."""
    place, stat, numbers = tmp_path / "transfers", os.stat, iter(range(1, 1000))

    def renumbered(path: object, **options: bool) -> os.stat_result:
        found = stat(path, **options)  # type: ignore[arg-type]  # as called
        if str(path) != str(place) or _opened(place):
            return found
        return os.stat_result((found.st_mode, next(numbers), *found[2:]))

    monkeypatch.setattr(os, "stat", renumbered)
    folder = Store(tmp_path)
    for number in (1, 2):
        folder.save(Incoming(GROUND, number))
    assert len(folder.incoming()) == 2
    assert _opened(place) == 1
    del folder
    assert _opened(place) == 0


def _opened(folder: Path) -> int:
    """Return how many descriptors of this process are open for a folder."""
    found = 0
    for number in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):
            found += os.readlink(f"/proc/self/fd/{number}") == os.path.realpath(folder)
    return found


def test_the_name_of_a_file_is_synced_again_after_the_start_of_a_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An earlier process may have been killed between the creation of the file and the sync of its name."""
    synced: list[Path] = []
    monkeypatch.setattr(store, "make_lasting", synced.append)
    path = tmp_path / "a"
    path.write_bytes(b"zero")
    assert store.overwrite(path, b"one")
    assert store.overwrite(path, b"two")
    assert synced == [tmp_path]
    path.unlink()
    assert store.overwrite(path, b"three")
    assert synced == [tmp_path, tmp_path]


def test_a_new_file_is_stored_only_if_its_folder_was_synced_to_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []

    def sync(folder: Path) -> None:
        synced.append(folder)
        if len(synced) == 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(store, "make_lasting", sync)
    assert [store.overwrite(tmp_path / "a", data) for data in (b"one", b"two", b"three")] == [
        False,
        True,
        True,
    ]
    assert synced == [tmp_path, tmp_path]
    assert (tmp_path / "a").read_bytes() == b"three"


def test_a_record_that_cannot_be_read_once_continues_its_transfer(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = Pair(tmp_path, 0.0)
    pair.send(SATELLITE, file, "down")
    opened, failed = os.open, set[str]()

    def fail_once(path: Any, *given: Any, **options: Any) -> int:
        if str(path).endswith(".json") and str(path) not in failed:
            failed.add(str(path))
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return opened(path, *given, **options)

    with monkeypatch.context() as disk:
        disk.setattr(os, "open", fail_once)
        pair.kill(SATELLITE)
    assert len(failed) == 2
    pair.until_closed()
    assert pair.received(GROUND, "down") == file.read_bytes()


@pytest.mark.parametrize("damaged", [1, 2])
def test_a_transfer_that_cannot_be_stored_does_not_prevent_the_storage_of_the_others(
    tmp_path: Path, damaged: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Store(tmp_path)
    end, save = Entity(SATELLITE, folder, lambda _: "", SIZE, 0), folder.save

    def fail(record: Outgoing | Incoming) -> None:
        if record.number == damaged:
            raise FileError("no space left")
        save(record)

    monkeypatch.setattr(folder, "save", fail)
    for number in (1, 2):
        end.take(pack(Transaction(GROUND, number, SATELLITE), Metadata(SIZE, "a", "a", CRC32)), 0)
    with pytest.raises(FileError, match="no space left"):
        end.keep(0, at_once=True)
    assert [record.number for record in folder.incoming()] == [3 - damaged]
