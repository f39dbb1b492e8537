"""Tests that forged and repeated frames are refused with a reason, and that lost counters disable one SPI."""

from __future__ import annotations

import errno
import fcntl
import os
import random
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from flight.link.frames import TELECOMMAND_MASK, close_frame
from flight.link.security import (
    COPIES,
    HIGHEST_COUNTER,
    NEXT,
    WINDOW,
    Association,
    Gate,
    Refusal,
    RefusedError,
    Sealer,
    Vault,
    decode,
    encode,
    new_key,
    unprotect,
)
from knightcube.errors import KnightCubeError, UsageError
from tests.flight.link.vaults import Ground, frame_with, gate, parse, vault

KEYS = {1: bytes(range(32)), 2: bytes(range(32, 64))}


@pytest.fixture
def sky(tmp_path: Path) -> Vault:
    return vault(tmp_path / "sky", KEYS)


@pytest.fixture
def ground(tmp_path: Path) -> Vault:
    return vault(tmp_path / "ground", KEYS)


def cause(entrance: Gate, frame: bytes) -> Refusal:
    with pytest.raises(RefusedError) as refused:
        entrance.admit(frame)
    return refused.value.cause


def test_the_frame_is_that_of_the_standard_byte_by_byte(ground: Vault) -> None:
    """A protected frame has 5 bytes of header, 2 of SPI, 12 of IV, ciphertext, 16 of MAC and 2 of CRC.

    The MAC covers VCID, SPI and data.
    """
    maker = Ground(ground)
    maker.frame(b"first")
    frame = maker.frame(b"second")
    assert len(frame) == 5 + 2 + 12 + len(b"second") + 16 + 2
    assert frame[5:7] == b"\0\1"
    assert frame[11:19] == (1).to_bytes(8, "big"), "the counter follows 4 random bytes"
    covered = bytes([0, 0, frame[2] & 0xFC, 0, 0]) + b"\0\1" + bytes(12)
    assert AESGCM(KEYS[1]).decrypt(frame[7:19], frame[19:-2], covered) == b"second"


def gmac(key: bytes, nonce: bytes, data: bytes) -> bytes:
    """Return the tag of AES-GMAC by its definition (NIST SP 800-38D, sections 6.3, 6.4 and 7.1)."""

    def encrypted(block: bytes) -> int:
        aes = Cipher(algorithms.AES(key), modes.ECB()).encryptor()
        return int.from_bytes(aes.update(block), "big")

    factor, state = encrypted(bytes(16)), 0
    padded = data + bytes(-len(data) % 16)
    lengths = (8 * len(data) << 64).to_bytes(16, "big")
    for begin in range(0, len(padded) + 16, 16):
        state ^= int.from_bytes((padded + lengths)[begin : begin + 16], "big")
        product, shifted = 0, factor
        for bit in reversed(range(128)):
            product ^= shifted if state >> bit & 1 else 0
            shifted = shifted >> 1 ^ (0xE1 << 120 if shifted & 1 else 0)
        state = product
    return (state ^ encrypted(nonce + b"\0\0\0\1")).to_bytes(16, "big")


def test_a_frame_that_is_only_authenticated_has_readable_data_and_the_mac_of_the_standard(
    ground: Vault,
) -> None:
    """A frame without encryption contains its data in clear, and the MAC of the standard.

    The first tag is a NIST test vector (gcmEncryptExtIV256, no plaintext, 128 bits of data).
    """
    key = bytes.fromhex("78dc4e0aaf52d935c3c01eea57428f00ca1fd475f5da86a49c8dd73d68c8e223")
    data = bytes.fromhex("b96baa8c1c75a671bfb2d08d06be5f36")
    assert (
        gmac(key, bytes.fromhex("d79cf22d504cc793c3fb6c8a"), data).hex() == "3e5d486aa2e30b22e040b85723a06e76"
    )
    header, mask = bytes.fromhex("1A5200011800"), bytes.fromhex("000E00000000")
    sealed, _ = Sealer(ground, 2, mask, encrypted=False).seal(header, b"telemetry")
    spi, iv, plain, mac = sealed[6:8], sealed[8:20], sealed[20:-16], sealed[-16:]
    assert (sealed[:6], spi, plain) == (header, b"\0\2", b"telemetry")
    covered = bytes([0, header[1] & 0x0E, 0, 0, 0, 0]) + spi + bytes(12) + plain
    assert mac == gmac(KEYS[2], iv, covered)


def test_a_frame_is_accepted_once_and_forged_frames_are_refused_with_their_cause(
    sky: Vault, ground: Vault
) -> None:
    entrance, maker = gate(sky), Ground(ground)
    first, second = maker.frame(b"one"), maker.frame(b"two")
    assert entrance.admit(second).data == b"two"
    assert cause(entrance, second) is Refusal.REPEATED
    assert cause(entrance, first) is Refusal.REPEATED
    third = maker.frame(b"three")
    assert cause(entrance, third[:-1] + bytes([third[-1] ^ 1])) is Refusal.CRC
    assert cause(entrance, close_frame(third[:20] + bytes([third[20] ^ 1]) + third[21:-2])) is Refusal.MAC
    # The tested frames have a wrong SPI, header or spacecraft.
    assert cause(entrance, close_frame(third[:6] + b"\2" + third[7:-2])) is Refusal.MAC
    assert cause(entrance, close_frame(third[:6] + b"\7" + third[7:-2])) is Refusal.SPI
    assert cause(entrance, close_frame(third[:2] + bytes([third[2] ^ 4]) + third[3:-2])) is Refusal.MAC
    assert cause(entrance, close_frame(b"\x25" + third[1:-2])) is Refusal.HEADER
    assert entrance.admit(third).counter == 2  # none of the refused frames has advanced the counter
    assert sum(entrance.refused.values()) == 8
    assert entrance.admitted == 2


def test_a_satellite_that_received_nothing_for_years_accepts_the_next_command(
    sky: Vault, ground: Vault
) -> None:
    """The ground has used the counters of a month of fastest frames, or of decades of gateway pings."""
    skip(ground, 30 * 86_400 * 1000)
    assert gate(sky).admit(Ground(ground).frame(b"command")).spi == 1


def test_the_window_is_limited_and_the_reserve_sets_a_key_beyond_it(sky: Vault, ground: Vault) -> None:
    entrance = gate(sky)
    skip(ground, WINDOW - 1)
    assert entrance.admit(Ground(ground).frame(b"last of the window")).counter == WINDOW - 1
    skip(ground, WINDOW)
    assert cause(entrance, Ground(ground).frame(b"one too far")) is Refusal.BEYOND
    assert entrance.admit(Ground(ground, 2).frame(b"by the reserve")).spi == 2
    assert entrance.replace_key(1, 2, bytes(32))
    ground.write(sky.read(1) or pytest.fail("it was written"))
    assert entrance.admit(Ground(ground).frame(b"new")).counter == 0


def skip(at: Vault, count: int) -> None:
    """Consume counters without sending a frame."""
    entry = at.read(1)
    assert entry is not None
    at.write(replace(entry, unused=entry.unused + count))


def test_after_a_restart_no_frame_is_accepted_again_and_one_copy_is_sufficient(
    sky: Vault, ground: Vault, tmp_path: Path
) -> None:
    frame = Ground(ground).frame(b"one")
    gate(sky).admit(frame)
    assert cause(gate(sky), frame) is Refusal.REPEATED
    for copy in COPIES:
        torn = tmp_path / "sky" / f"spi-1.{copy}"
        torn.write_bytes(torn.read_bytes()[:30])
        assert sky.copies(1) == 1
        assert cause(gate(sky), frame) is Refusal.REPEATED
        assert sky.copies(1) == 2  # the missing copy was restored from the other copy


def test_both_copies_lost_refuse_that_spi_and_its_reserve_changes_the_key(
    sky: Vault, ground: Vault, tmp_path: Path
) -> None:
    old = Ground(ground).frame(b"old")
    (tmp_path / "sky" / "spi-1.a").unlink()
    (tmp_path / "sky" / "spi-1.b").write_bytes(b"")
    entrance = gate(sky)
    assert cause(entrance, old) is Refusal.LOST
    assert entrance.admit(Ground(ground, 2).frame(b"by the reserve")).spi == 2
    assert entrance.replace_key(1, 2, bytes(32))
    assert cause(entrance, old) is Refusal.MAC
    assert cause(gate(sky), old) is Refusal.MAC
    ground.write(sky.read(1) or pytest.fail("it was written"))
    assert gate(sky).admit(Ground(ground).frame(b"new")).counter == 0


@pytest.mark.parametrize("store_every", [1, 3])
def test_after_a_change_of_key_no_frame_is_accepted_twice(
    sky: Vault, ground: Vault, store_every: int
) -> None:
    def entrance() -> Gate:
        return Gate(sky, (1,), parse, TELECOMMAND_MASK, store_every=store_every)

    first = entrance()
    first.admit(Ground(ground).frame(b"by the old key"))
    assert first.replace_key(1, 2, bytes(32))
    ground.write(sky.read(1) or pytest.fail("it was written"))
    frames = [Ground(ground).frame(b"by the new key") for _ in range(store_every)]
    for frame in frames[:-1]:
        first.admit(frame)
    if store_every > 1:
        assert entrance().admit(frames[0]).counter == 0, "not stored yet"
    first.admit(frames[-1])
    assert [cause(entrance(), frame) for frame in frames] == [Refusal.REPEATED] * store_every, "stored"
    first.admit(Ground(ground).frame(b"one more"))
    kept = sky.read(1) or pytest.fail("both copies are there")
    assert kept.unused == store_every + (store_every == 1), "stored once per `store_every` counts"
    last = Ground(ground).frame(b"last")
    second = entrance()
    second.admit(last)
    second.close()
    assert cause(entrance(), last) is Refusal.REPEATED, "stored at the end"


def test_every_process_of_the_ground_follows_a_new_key_of_telemetry(sky: Vault, ground: Vault) -> None:
    """The process that receives the first frame with the new key replaces the key in the shared folder."""
    gates = [Gate(ground, [1], parse, TELECOMMAND_MASK, store_every=256) for _ in range(3)]
    sender = Ground(sky)
    before = sender.frame(b"before")
    assert [one.admit(before).data for one in gates] == [b"before"] * 3
    following = Association(1, 2, 0, new_key())
    ground.write(following, f"1-{NEXT}")
    sky.write(following)
    sender = Ground(sky)
    for data in (b"first", b"second"):
        frame = sender.frame(data)
        assert [one.admit(frame).data for one in gates] == [data] * 3
        assert [cause(one, frame) for one in gates] == [Refusal.REPEATED] * 3
    assert ground.read(f"1-{NEXT}") is None
    assert cause(gates[1], before) is Refusal.MAC


def test_a_next_key_that_cannot_be_stored_is_not_lost(
    sky: Vault, ground: Vault, monkeypatch: pytest.MonkeyPatch
) -> None:
    following = Association(1, 2, 0, new_key())
    ground.write(following, f"1-{NEXT}")
    sky.write(following)
    sender = Ground(sky)

    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as broken:
        entrance, frame = Gate(ground, [1], parse, TELECOMMAND_MASK, store_every=256), sender.frame(b"first")
        broken.setattr(os, "pwrite", fail)
        assert entrance.admit(frame).data == b"first"
    restarted = Gate(ground, [1], parse, TELECOMMAND_MASK, store_every=256)
    assert restarted.admit(sender.frame(b"second")).data == b"second"
    assert ground.read(1) == following


def test_a_new_key_of_the_same_generation_replaces_the_old_key(sky: Vault, ground: Vault) -> None:
    entrance, old = gate(sky), Ground(ground)
    entrance.admit(old.frame(b"old"))
    late, changed = old.frame(b"late"), Association(1, 1, 0, new_key())
    assert entrance.replace_key(1, 1, changed.key)
    ground.write(changed)
    assert cause(entrance, late) is Refusal.MAC
    assert entrance.admit(Ground(ground).frame(b"new")).data == b"new"


def test_no_frame_is_accepted_if_its_counter_cannot_be_stored(
    sky: Vault, ground: Vault, monkeypatch: pytest.MonkeyPatch
) -> None:
    entrance, frame = gate(sky), Ground(ground).frame(b"one")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(os, "fsync", fail)
        assert cause(entrance, frame) is Refusal.UNSTORED
        with pytest.raises(KnightCubeError, match="cannot be stored"):
            Ground(ground).frame(b"two")
    assert entrance.admit(frame).data == b"one"


def test_a_counter_that_could_not_be_read_at_the_start_is_read_when_a_frame_needs_it(
    sky: Vault, ground: Vault, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = Ground(ground).frame(b"one"), Ground(ground).frame(b"two")
    gate(sky).admit(first)

    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(os, "open", fail)
        entrance = gate(sky)
        assert cause(entrance, second) is Refusal.LOST
    assert cause(entrance, first) is Refusal.REPEATED
    assert entrance.admit(second).data == b"two"


def test_no_frame_is_accepted_if_the_folder_cannot_be_written(
    sky: Vault, ground: Vault, monkeypatch: pytest.MonkeyPatch
) -> None:
    entrance, frame = gate(sky), Ground(ground).frame(b"one")

    def fail(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    for call in ("open", "flock"):
        with monkeypatch.context() as broken:
            broken.setattr(os if call == "open" else fcntl, call, fail)
            assert cause(entrance, frame) is Refusal.UNSTORED
    assert entrance.admit(frame).data == b"one"


def test_the_last_counter_is_2_to_the_63_less_one_both_ways(sky: Vault, ground: Vault) -> None:
    maker = Ground(ground)
    for vault_ in (sky, ground):
        entry = vault_.read(1)
        assert entry is not None
        vault_.write(replace(entry, unused=HIGHEST_COUNTER - 1))
    entrance = gate(sky)
    assert entrance.admit(maker.frame(b"last")).counter == 2**63 - 1
    with pytest.raises(KnightCubeError, match="used up: change its key"):
        maker.frame(b"one more")
    assert cause(entrance, frame_with(ground, HIGHEST_COUNTER, b"")) is Refusal.BEYOND
    assert (sky.read(1) or pytest.fail("it was written")).unused == HIGHEST_COUNTER
    assert decode(encode(Association(1, 1, HIGHEST_COUNTER + 1, bytes(32)))) is None


@pytest.mark.timeout(30)
def test_a_fifo_or_an_endless_file_instead_of_a_copy_is_a_lost_copy(sky: Vault, tmp_path: Path) -> None:
    first, second = (tmp_path / "sky" / f"spi-1.{copy}" for copy in COPIES)
    first.unlink()
    os.mkfifo(first)
    assert sky.copies(1) == 1
    gate(sky)  # this call tries to restore the missing copy
    with second.open("r+b") as file:
        file.truncate(1 << 40)
    assert sky.read(1) is None


def test_no_counter_is_used_twice_by_senders_that_share_a_folder(ground: Vault) -> None:
    makers = [Ground(ground), Ground(ground)]
    counters = [maker.frame(b"")[7:19] for _ in range(3) for maker in makers]
    assert len(set(counters)) == len(counters)


def test_a_block_of_counters_ends_when_another_sender_has_reserved_counters(ground: Vault) -> None:
    blocks = Sealer(ground, 1, bytes(5), 64, shared=True)
    single = Sealer(ground, 1, bytes(5))
    order = [blocks, blocks, single, blocks, single, single, blocks, blocks]
    counters = [sealer.seal(bytes(5), b"x")[1] for sealer in order]
    assert counters == sorted(set(counters)), "the receiver refuses a counter below the highest"


def test_a_block_of_counters_ends_when_the_key_was_changed(ground: Vault) -> None:
    """A sender does not use the remaining counters of a reserved block after a change of the key."""
    sealer = Sealer(ground, 1, bytes(5), 64, shared=True)
    sealer.seal(bytes(5), b"x")
    old = ground.read(1)
    assert old is not None
    ground.write(replace(old, generation=old.generation + 1, key=new_key()))
    body, counter = sealer.seal(bytes(5), b"x")
    changed = ground.read(1)
    assert changed is not None
    assert counter == old.unused
    assert unprotect(changed.cipher, bytes(5), bytes(5), body[5:]) == b"x"


def test_a_block_of_counters_is_used_up_without_another_reservation(ground: Vault) -> None:
    sealer = Sealer(ground, 1, bytes(5), 3, shared=True)
    counters, reserved = [], []
    for _ in range(7):
        counters.append(sealer.seal(bytes(5), b"x")[1])
        entry = ground.read(1)
        assert entry is not None
        reserved.append(entry.unused)
    assert counters == [0, 1, 2, 3, 4, 5, 6]
    assert reserved == [3, 3, 3, 6, 6, 6, 9]


def test_a_sender_uses_its_reserved_counters_although_both_copies_are_lost(ground: Vault) -> None:
    sealer = Sealer(ground, 1, bytes(5), 3, shared=True)
    assert sealer.seal(bytes(5), b"x")[1] == 0
    for path in ground.folder.glob("spi-1.*"):
        path.unlink()
    assert [sealer.seal(bytes(5), b"x")[1] for _ in range(2)] == [1, 2]
    with pytest.raises(KnightCubeError, match="both copies of the counter of SPI 1 are lost"):
        sealer.seal(bytes(5), b"x")


def test_no_nonce_is_used_twice_if_the_folder_is_restored_from_a_backup(ground: Vault) -> None:
    draw = random.Random(7)
    backup = {path: path.read_bytes() for path in ground.folder.glob("spi-*")}
    nonces, counters = [], []
    for _ in range(20):
        sealer = Sealer(ground, 1, bytes(5), draw.choice((1, 64)))
        for _ in range(5):
            frame, counter = sealer.seal(bytes(5), b"x")
            nonces.append(frame[7:19])
            counters.append(counter)
        if draw.random() < 0.5:
            for path, data in backup.items():
                path.write_bytes(data)
    assert len(set(counters)) < len(counters), "no counter was used twice: the test restores nothing"
    assert len(set(nonces)) == len(nonces)


def test_keys_in_a_folder_that_cannot_be_listed_are_used(
    sky: Vault, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(path: Path) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    monkeypatch.setattr(os, "scandir", damaged)
    assert Vault(tmp_path / "sky").read(1) == sky.read(1)


def test_keys_are_for_their_owner_only_and_not_in_what_is_printed(sky: Vault, tmp_path: Path) -> None:
    path = tmp_path / "sky" / "spi-1.a"
    assert path.stat().st_mode & 0o777 == 0o600
    assert KEYS[1].hex() not in repr(sky.read(1))
    assert repr(KEYS[1]) not in repr(sky.read(1))
    path.chmod(0o640)
    with pytest.raises(UsageError, match="other users may read"):
        Vault(tmp_path / "sky")


def test_a_damaged_record_is_none(tmp_path: Path, sky: Vault) -> None:
    record = (tmp_path / "sky" / "spi-1.a").read_bytes()
    assert decode(record) == sky.read(1)
    for place in range(len(record)):
        assert decode(record[:place] + bytes([record[place] ^ 0x40]) + record[place + 1 :]) is None
        assert decode(record[:place]) is None
