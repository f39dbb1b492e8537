"""Tests that a restored backup of the key folder is detected, and that repeated old commands are refused.

The satellite detects the backup by the reference folder (`witness`), which backups do not contain.
"""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from flight.link import security
from flight.link.files.store import read_regular
from flight.link.frames import TELEMETRY_MASK
from flight.link.process.commanding import Timetable
from flight.link.security import Association, Refusal, RefusedError, Sealer, Vault, new_key
from knightcube.errors import UsageError
from tests.flight.link.vaults import Ground, gate, vault

KEYS = {spi: bytes([spi]) * 32 for spi in (1, 2, 3, 4)}


@pytest.fixture
def ground(tmp_path: Path) -> Vault:
    return vault(tmp_path / "ground", KEYS)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Return the satellite's folder of keys."""
    return vault(tmp_path / "keys", KEYS).folder


def opened(keys: Path, rebuild: bool = False) -> Vault:
    """Return the satellite's security associations, as the link opens them."""
    return Vault(keys, keys.parent / "witness", rebuild)


def refusal(at: Vault, frame: bytes) -> Refusal | None:
    """Return the reason of the refusal of a frame."""
    try:
        gate(at).admit(frame)
    except RefusedError as error:
        return error.cause
    return None


def restore(keys: Path) -> None:
    shutil.rmtree(keys)
    shutil.copytree(keys.parent / "backup", keys)


def test_a_restored_folder_refuses_all_commands_until_the_reserve_sets_a_key(
    keys: Path, ground: Vault
) -> None:
    shutil.copytree(keys, keys.parent / "backup")
    old = [Ground(ground, spi).frame(b"old") for spi in (1, 1, 2, 2)]
    assert [refusal(opened(keys), frame) for frame in old] == [None] * 4
    restore(keys)
    for _ in range(2):  # the frame is also refused after a restart
        at = opened(keys)
        assert at.restored
        assert [refusal(at, frame) for frame in old] == [Refusal.LOST] * 2 + [Refusal.REPEATED] * 2
        assert refusal(at, Ground(ground, 1).frame(b"new")) is Refusal.LOST
    receiver = gate(at)
    receiver.admit(Ground(ground, 2).frame(b"new key"))
    changed = Association(1, 2, 0, new_key())
    assert receiver.replace_key(1, changed.generation, changed.key)
    ground.write(changed)
    assert not opened(keys).restored
    assert refusal(opened(keys), Ground(ground, 1).frame(b"new")) is None
    assert [refusal(opened(keys), frame) for frame in old] == [Refusal.MAC] * 2 + [Refusal.REPEATED] * 2


def test_a_replaced_key_stays_refused_and_a_new_one_is_accepted(keys: Path, ground: Vault) -> None:
    shutil.copytree(keys, keys.parent / "backup")
    at = opened(keys)
    for spi in (1, 2, 3):
        before = at.read(spi)
        assert at.write(Association(spi, 2, 0, bytes([spi + 10]) * 32)) == 2
        assert before is not None
        assert at.has_used(spi, before.key), "a replaced key must not be set again"
    restore(keys)
    at = opened(keys)
    assert at.has_used(1, bytes([11]) * 32)
    assert not at.has_used(1, new_key())
    assert (at.restored, at.read(1)) == (True, None)
    for spi in (2, 3):
        found = at.read(spi)
        assert found is not None
        assert found.key == bytes([spi + 10]) * 32
    # Keys that are made on the ground start at generation 1.
    shutil.rmtree(keys)
    vault(keys, {spi: bytes([spi + 20]) * 32 for spi in KEYS})
    for _ in range(2):
        at = opened(keys)
        found = at.read(1)
        assert found is not None
        assert (at.restored, found.generation, found.key[0]) == (False, 1, 21)


def test_telemetry_continues_above_all_used_counters(keys: Path) -> None:
    shutil.copytree(keys, keys.parent / "backup")
    sealer = Sealer(opened(keys), 3, TELEMETRY_MASK, 8)
    used = [sealer.seal(bytes(6), b"live")[1] for _ in range(20)]
    restore(keys)
    restored = Sealer(opened(keys), 3, TELEMETRY_MASK, 8)
    assert restored.seal(bytes(6), b"live")[1] > max(used)


@pytest.mark.parametrize("damage", ["missing", "a", "b", "replaced", "a file"])
def test_a_damaged_witness_prevents_no_command(keys: Path, ground: Vault, damage: str) -> None:
    witness = keys.parent / "witness"
    for _ in range(3):
        assert refusal(opened(keys), Ground(ground, 1).frame(b"command")) is None
    if damage == "missing":
        shutil.rmtree(witness)
    elif damage == "a file":
        shutil.rmtree(witness)
        witness.write_bytes(b"")
    else:
        for path in witness.glob("replaced-*" if damage == "replaced" else f"spi-*.{damage}"):
            path.write_bytes(b"damaged")
    for _ in range(3):
        at = opened(keys)
        assert not at.restored
        assert refusal(at, Ground(ground, 1).frame(b"command")) is None


@pytest.mark.parametrize("left", ["nothing", "an empty folder", "damaged files"])
def test_a_lost_folder_is_rebuilt_without_the_primary_command_key(
    keys: Path, ground: Vault, left: str
) -> None:
    old = [Ground(ground, spi).frame(b"old") for spi in (1, 2, 2)]
    assert [refusal(opened(keys), frame) for frame in old] == [None] * 3
    used = Sealer(opened(keys), 3, TELEMETRY_MASK, 8).seal(bytes(6), b"live")[1]
    if left == "damaged files":
        for path in keys.glob("spi-*"):
            path.write_bytes(b"damaged")
    else:
        shutil.rmtree(keys)
    if left == "an empty folder":
        keys.mkdir()
    if left == "nothing":
        with pytest.raises(UsageError, match="no such folder"):
            opened(keys)
    else:
        assert all(opened(keys).read(spi) is None for spi in KEYS), "the folder may be mounted later"
    # Each start reports the loss until there is a new key.
    for rebuild in (True, False):
        at = opened(keys, rebuild=rebuild)
        assert (at.rebuilt, at.restored) == (True, False)
        assert [refusal(at, frame) for frame in old] == [Refusal.LOST] + [Refusal.REPEATED] * 2
        assert refusal(at, Ground(ground, 2).frame(b"new")) is None
    assert Sealer(at, 3, TELEMETRY_MASK, 8).seal(bytes(6), b"live")[1] > used
    receiver = gate(at)
    assert at.has_used(1, KEYS[1])
    assert receiver.replace_key(1, 2, new_key())
    ground.write(at.read(1) or pytest.fail("it was written"))
    assert refusal(opened(keys), Ground(ground, 1).frame(b"new")) is None
    assert not opened(keys).rebuilt
    assert [refusal(opened(keys), frame) for frame in old] == [Refusal.MAC] + [Refusal.REPEATED] * 2


def test_without_a_second_record_a_lost_folder_is_not_rebuilt(keys: Path) -> None:
    opened(keys)
    for path in (keys, keys.parent / "witness"):
        shutil.rmtree(path)
    with pytest.raises(UsageError, match="no such folder"):
        opened(keys, rebuild=True)


def test_a_failed_access_to_the_disk_does_not_replace_keys_by_older_ones(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = opened(keys).read(2)
    assert before is not None
    newer = replace(before, unused=before.unused + 7)
    Vault(keys).write(newer)  # the second record could not be written
    failures = iter([True, True] * 2)

    def read(path: Path, most: int) -> bytes | None:
        if path.parent == keys and path.name.startswith("spi-2") and next(failures, False):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return read_regular(path, most)

    monkeypatch.setattr(security, "read_regular", read)
    assert opened(keys).read(2) == newer


@pytest.mark.parametrize("spi", [2, 3, 4])
def test_lost_copies_of_one_association_are_restored_at_once(keys: Path, spi: int) -> None:
    before = opened(keys).read(spi)
    for path in keys.glob(f"spi-{spi}.*"):
        path.unlink()
    at = opened(keys)
    assert (at.copies(spi), at.read(spi), at.rebuilt) == (2, before, False)


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("damaged", ["a", "b"])
def test_each_copy_of_the_second_record_is_at_most_one_command_old(
    keys: Path, ground: Vault, damaged: str, restarts: bool
) -> None:
    """The second record is at most one command behind, even if only one of its copies is undamaged."""
    at = opened(keys)
    commands, telemetry = Ground(ground, 1), Sealer(at, 3, TELEMETRY_MASK)
    for _ in range(5):
        at = opened(keys) if restarts else at
        assert refusal(at, commands.frame(b"command")) is None
        assert refusal(at, Ground(ground, 2).frame(b"command")) is None
        (telemetry if not restarts else Sealer(at, 3, TELEMETRY_MASK)).seal(bytes(6), b"live")
    for path in (keys.parent / "witness").glob(f"spi-*.{damaged}"):
        path.write_bytes(b"damaged")
    shutil.rmtree(keys)
    shutil.copytree(keys.parent / "witness", keys)
    left = Vault(keys)
    assert [left.read(spi).unused >= least for spi, least in ((1, 4), (2, 5), (3, 4))] == [True] * 3  # type: ignore[union-attr]  # they were written


def test_access_of_other_users_is_removed_on_the_satellite(keys: Path) -> None:
    path = keys / "spi-1.a"
    path.chmod(0o640)
    with pytest.raises(UsageError, match="other users may read this key"):
        Vault(keys)
    opened(keys)
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_restored_schedule_is_deleted_for_good(tmp_path: Path) -> None:
    Timetable(tmp_path).add(10, 1, 1, "ping 1")
    restored = Timetable(tmp_path, restored=True)
    assert (restored.entries, restored.lost) == ((), True)
    assert Timetable(tmp_path).entries == ()
    assert Timetable(tmp_path).add(20, 1, 2, "ping 2").number == 2
