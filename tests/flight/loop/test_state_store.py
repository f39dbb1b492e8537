"""Tests that after any failure of a write, either the old or the new state is read."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.link import events
from flight.loop.state import (
    COPIES,
    Learned,
    LinuxFiles,
    StateStore,
    StoredState,
    decode,
    encode,
)
from tests.flight.loop.disk import Disk, PowerLostError
from tests.flight.loop.stored_states import Reports, state_of

FOLDER = Path("/state")
ROOT = Path(__file__).resolve().parents[3]


def test_a_stored_state_is_read_by_another_process_of_the_application(tmp_path: Path) -> None:
    reports = Reports()
    store = StateStore(tmp_path, reports)
    assert store.load() == StoredState(), "a folder without a state is a first boot"
    for number in (1, 2, 3):
        assert store.store(state_of(number))
        assert StateStore(tmp_path, reports).load() == state_of(number)
    assert not reports.kinds
    assert {path.name for path in tmp_path.iterdir()} == set(COPIES)


def _stored(disk: Disk, reports: Reports) -> StateStore:
    """Return a store that a new process opens on a disk with the states 1 and 2."""
    first = StateStore(FOLDER, reports, disk)
    first.store(state_of(1))
    first.store(state_of(2))
    store = StateStore(FOLDER, reports, disk)
    assert store.load() == state_of(2)
    return store


def calls_of_one_write(bite: int) -> int:
    """Return the number of calls of one `store` that change the disk."""
    disk = Disk(bite=bite)
    store = _stored(disk, Reports())
    disk.start(None)
    store.store(state_of(3))
    return disk.calls


@pytest.mark.parametrize("bite", [1 << 30, 100])
def test_power_loss_before_every_call_leaves_the_old_state_or_the_new(bite: int) -> None:
    """If power is lost before any system call of a write, a later start reads the old or the new state."""
    calls, found = calls_of_one_write(bite), 0
    assert calls >= 10
    for stop in range(calls + 1):
        disk, reports = Disk(bite=bite), Reports()
        store = _stored(disk, reports)
        disk.start(stop)
        if stop < calls:
            with pytest.raises(PowerLostError):
                store.store(state_of(3))
        else:
            store.store(state_of(3))
        for after in disk.after_power_loss():
            reports = Reports()
            allowed = [state_of(3)] if stop == calls else [state_of(2), state_of(3)]
            assert StateStore(FOLDER, reports, after).load() in allowed
            assert not reports.kinds, "a crash must not be reported as damage"
            found += 1
    assert found > 30


@pytest.mark.parametrize("forgotten", ["sync", "sync_folder"])
def test_the_model_of_power_loss_finds_a_write_that_forgets_to_sync(forgotten: str) -> None:
    """Without one of the two syncs, the model of the disk can lose the new state.

    This result shows that the tests of power loss can fail.
    """
    disk = Disk(forget=forgotten)
    _stored(disk, Reports()).store(state_of(3))
    states = [StateStore(FOLDER, Reports(), after).load() for after in disk.after_power_loss()]
    assert any(state != state_of(3) for state in states)


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_disk_that_fails_at_any_call_keeps_an_intact_state_and_the_failure_is_reported(error: int) -> None:
    for stop in range(calls_of_one_write(1 << 30)):
        disk, reports = Disk(), Reports()
        store = _stored(disk, reports)
        disk.start(stop, error)
        durable = store.store(state_of(3))
        assert reports.kinds == [events.STATE_UNWRITTEN]
        assert "state-b.json" in reports.texts[0]
        assert durable == ("state-a.json" not in reports.texts[0])
        disk.start(None)
        assert StateStore(FOLDER, Reports(), disk).load() in [state_of(2), state_of(3)]
        assert store.store(state_of(4)), "a disk that works again is written again"
        assert StateStore(FOLDER, Reports(), disk).load() == state_of(4)


@pytest.mark.parametrize("copy", COPIES)
def test_damage_to_one_copy_at_any_byte_loses_nothing_and_is_reported(tmp_path: Path, copy: str) -> None:
    StateStore(tmp_path, Reports()).store(state_of(1))
    path = tmp_path / copy
    whole = path.read_bytes()
    torn = [whole[:end] for end in range(len(whole))]
    flipped = [bytes([*whole[:i], whole[i] ^ (1 << i % 8), *whole[i + 1 :]]) for i in range(len(whole))]
    for data in [*torn, *flipped, whole + b"x", bytes(len(whole))]:
        path.write_bytes(data)
        reports = Reports()
        assert StateStore(tmp_path, reports).load() == state_of(1)
        assert reports.kinds == [events.STATE_RECOVERED]
        assert copy in reports.texts[0]


def test_the_newer_copy_wins_and_its_loss_falls_back_to_the_older(tmp_path: Path) -> None:
    (tmp_path / COPIES[0]).write_bytes(encode(7, state_of(7)))
    (tmp_path / COPIES[1]).write_bytes(encode(8, state_of(8)))
    reports = Reports()
    assert StateStore(tmp_path, reports).load() == state_of(8)
    (tmp_path / COPIES[1]).write_bytes(encode(8, state_of(8))[:-1])
    assert StateStore(tmp_path, reports).load() == state_of(7)
    assert reports.kinds == [events.STATE_RECOVERED]
    store = StateStore(tmp_path, reports)
    store.load()
    store.store(state_of(9))
    assert StateStore(tmp_path, Reports()).load() == state_of(9)


def test_a_copy_that_is_not_there_is_damage_unless_the_first_write_was_interrupted(tmp_path: Path) -> None:
    for generation, reported in ((1, []), (3, [events.STATE_RECOVERED])):
        (tmp_path / COPIES[0]).write_bytes(encode(generation, state_of(3)))
        reports = Reports()
        assert StateStore(tmp_path, reports).load() == state_of(3)
        assert reports.kinds == reported
    assert "state-b.json: is missing" in reports.texts[0]
    (tmp_path / COPIES[0]).write_bytes(b"torn")
    assert StateStore(tmp_path, reports).load() == StoredState(running=True)
    assert reports.kinds[-1] == events.STATE_LOST


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(900 << 30)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(path))


@pytest.mark.parametrize("place", [os.mkfifo, _socket, _sparse])
def test_a_copy_that_is_too_large_or_not_a_file_is_damage_that_the_next_write_mends(
    tmp_path: Path, place: Callable[[Path], None]
) -> None:
    StateStore(tmp_path, Reports()).store(state_of(1))
    (tmp_path / COPIES[0]).unlink()
    for name in (COPIES[0], "state-b.tmp"):
        place(tmp_path / name)
    reports = Reports()
    store = StateStore(tmp_path, reports)
    assert store.load() == state_of(1)
    assert reports.kinds == [events.STATE_RECOVERED]
    assert store.store(state_of(2))
    assert StateStore(tmp_path, reports).load() == state_of(2)
    assert len(reports.kinds) == 1


def test_two_damaged_copies_give_defaults_that_count_as_an_unclean_shutdown(tmp_path: Path) -> None:
    for name in COPIES:
        (tmp_path / name).write_bytes(b"\0" * 300)
    reports = Reports()
    assert StateStore(tmp_path, reports).load() == StoredState(running=True)
    assert reports.kinds == [events.STATE_LOST]


def test_a_copy_that_cannot_be_read_is_reported_with_the_systems_words(tmp_path: Path) -> None:
    StateStore(tmp_path, Reports()).store(state_of(1))
    (tmp_path / COPIES[1]).unlink()
    (tmp_path / COPIES[1]).mkdir()
    reports = Reports()
    assert StateStore(tmp_path, reports).load() == state_of(1)
    assert "Is a directory" in reports.texts[0]


def _with_crc(text: str) -> bytes:
    line = text.encode() + b"\n"
    return line + b"%08x\n" % zlib.crc32(line)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("boot_count", -1),
        ("boot_count", 1.5),
        ("operated", "1"),
        ("operated", -1.0),
        ("mode", "m" * 33),
        ("learned", {"x": {"values": [], "covariance": []}}),
        ("learned", {"x": {"values": [1.0], "covariance": [[-1.0]]}}),
        ("learned", {"x": {"values": [1.0, 2.0], "covariance": [[1.0, 0.0]]}}),
        ("learned", {"x": {"values": [1.0, 2.0], "covariance": [[1.0, 0.5], [0.4, 1.0]]}}),
        ("learned", {"x": {"values": [None], "covariance": [[1.0]]}}),
    ],
)
def test_a_wrong_content_with_a_valid_checksum_is_refused(key: str, value: object) -> None:
    good = json.loads(encode(1, state_of(1)).partition(b"\n")[0])
    assert decode(_with_crc(json.dumps(good))).state == state_of(1)
    good["state"][key] = value
    with pytest.raises(ValueError, match=r"\w"):
        decode(_with_crc(json.dumps(good)))


def test_keys_that_a_later_release_has_added_are_ignored() -> None:
    """After a return to an earlier release, this release must not lose the state of the later one."""
    copy = json.loads(encode(1, state_of(1)).partition(b"\n")[0])
    for part in (copy, copy["state"], *copy["state"]["learned"].values(), *copy["state"]["unclean"]):
        part["added"] = {"later": [1]}
    assert decode(_with_crc(json.dumps(copy))).state == state_of(1)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_state_that_is_not_finite_is_refused_before_it_is_written(tmp_path: Path, bad: float) -> None:
    store = StateStore(tmp_path, Reports())
    with pytest.raises(ValueError, match="finite"):
        store.store(StoredState(learned={"b": Learned((bad,), ((1.0,),))}))
    with pytest.raises(ValueError, match="finite"):
        store.store(StoredState(operated=bad))
    assert not list(tmp_path.iterdir())


@given(st.binary(max_size=400))
@settings(max_examples=100, deadline=None)
def test_random_bytes_are_never_a_state(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        decode(data)


def test_real_files_are_replaced_by_name_and_the_temporary_one_is_gone(tmp_path: Path) -> None:
    store = StateStore(tmp_path, Reports(), LinuxFiles())
    store.store(state_of(1))
    inodes = [(tmp_path / name).stat().st_ino for name in COPIES]
    (tmp_path / "state-a.tmp").write_bytes(b"left by a crash, longer than what comes now" * 100)
    store.store(state_of(2))
    assert [(tmp_path / name).stat().st_ino for name in COPIES] != inodes
    assert {path.name for path in tmp_path.iterdir()} == set(COPIES)
    assert StateStore(tmp_path, Reports()).load() == state_of(2)


WRITER = """
import os, signal, sys
from pathlib import Path
from tests.flight.loop.stored_states import Reports, state_of
from flight.loop.state import StateStore

# A child for each round: it stores 1, 2, 3 ... until it is killed. The parent, which pays the imports once,
# kills it at a random moment, and knows which states may then be found.
import random, time
folder, rounds, draw = Path(sys.argv[1]), int(sys.argv[2]), random.Random(int(sys.argv[3]))
number = midway = 0
for round in range(rounds):
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        store = StateStore(folder, Reports())
        store.load()
        while True:
            number += 1
            os.write(write, b"<%d" % number)
            store.store(state_of(number))
            os.write(write, b">")
    os.close(write)
    trace = os.read(read, 1)  # it has begun to write
    time.sleep(draw.uniform(0.0, 0.01))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    while piece := os.read(read, 65536):
        trace += piece
    os.close(read)
    reports = Reports()
    found = StateStore(folder, reports).load().boot_count
    begun, ended = int(trace.rstrip(b">").rpartition(b"<")[2]), trace.endswith(b">")
    assert begun - (not ended) <= found <= begun, (round, trace, found)
    midway += not ended
    assert not reports.kinds, reports.texts
    number = found
print(midway)
"""


def test_two_hundred_kills_at_random_moments_leave_the_old_state_or_the_new(tmp_path: Path) -> None:
    """After each of 200 SIGKILLs during a write, the stored state is the last state or the new state."""
    seed = 20260115
    done = subprocess.run(
        [sys.executable, "-c", WRITER, str(tmp_path), "200", str(seed)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100, "most are killed while they write, not between"
