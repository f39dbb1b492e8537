"""Link security (CCSDS 355.0-B-2): stored keys and counters, encryption, authentication, replay protection.

Frames in both directions are protected by AES-256-GCM. A protected frame contains the SPI (security parameter
index, 2 bytes), the IV (12 bytes), the ciphertext and the MAC (16 bytes). Telemetry may also be authenticated
without encryption. The IV is the nonce, which must never repeat under the same key. The IV consists of a salt
of 32 random bits, which each sender draws at its start, and of a counter of 64 bits. The counter increases
from frame to frame, and the receiver ignores the salt. If a folder of keys is restored from a backup,
counters are used again, but with another salt. The MAC covers the virtual channel, the SPI and the data, as
in Yamcs.

The key and counter of each SPI are stored in two files, which are copies of each other. Each file is a record
of fixed size that ends with a CRC-32. Both files are overwritten in place, one after the other, so that a
full disk does not prevent the update and a crash damages at most one copy. If the two copies differ, the copy
with the newer key or the higher counter is used. One folder contains the security associations of one end of
the link, and only the folder's owner may read them.

A folder of keys that was restored from a backup contains old counters, with which old commands would be
executed again. The satellite therefore keeps a reference folder (argument `witness`), which no backup may
contain. The reference folder contains the newest association of each SPI and the digests of all replaced
keys. An association is outdated if the reference folder has the same key with a higher counter, or if its key
was replaced. A new key that is not in the reference folder is accepted from any folder. If the association of
the primary command SPI is outdated, its commands are refused until a command of the reserve SPI sets a new
key. The other SPIs continue with the key and counter in the reference folder, also if the folder of keys is
lost.

A gate checks the CRC, spacecraft, SPI, MAC and counter of a frame in this order. A refused frame has no
effect except on the count of refusals by cause. The counter of an accepted frame is stored durably before the
frame's data are used, so that the same frame cannot be accepted again after a crash.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import secrets
import stat
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from flight.link.files.store import locked, overwrite, read_regular
from flight.link.frames import FrameError
from flight.link.telemetry.packets import crc16
from knightcube.errors import KnightCubeError, UsageError

SPI_BYTES = 2
IV_BYTES = 12
MAC_BYTES = 16
SECURITY_HEADER_BYTES = SPI_BYTES + IV_BYTES
OVERHEAD_BYTES = SECURITY_HEADER_BYTES + MAC_BYTES
KEY_BYTES = 32

_NO_IV = bytes(IV_BYTES)
_SALT_BITS, _COUNTER_BITS = 32, 64


def _authenticated(header: bytes, mask: bytes, spi: bytes) -> bytes:
    masked = int.from_bytes(header, "big") & int.from_bytes(mask, "big")
    return masked.to_bytes(len(header), "big") + spi + _NO_IV


def protect(
    cipher: AESGCM, spi: int, iv: int, header: bytes, mask: bytes, data: bytes, encrypted: bool = True
) -> bytes:
    """Return header, security header, data and MAC. The MAC covers the header bits in `mask`.

    If `encrypted` is false, the data are authenticated by AES-GMAC and can be read without a key.
    """
    index, nonce = spi.to_bytes(SPI_BYTES, "big"), iv.to_bytes(IV_BYTES, "big")
    authenticated = _authenticated(header, mask, index)
    if encrypted:
        return header + index + nonce + cipher.encrypt(nonce, data, authenticated)
    return header + index + nonce + data + cipher.encrypt(nonce, b"", authenticated + data)


def unprotect(
    cipher: AESGCM, header: bytes, mask: bytes, protected: bytes, encrypted: bool = True
) -> bytes | None:
    """Return the data of a protected frame, or None if the MAC is wrong."""
    index, iv = protected[:SPI_BYTES], protected[SPI_BYTES:SECURITY_HEADER_BYTES]
    authenticated = _authenticated(header, mask, index)
    try:
        if encrypted:
            return cipher.decrypt(iv, protected[SECURITY_HEADER_BYTES:], authenticated)
        data, mac = protected[SECURITY_HEADER_BYTES:-MAC_BYTES], protected[-MAC_BYTES:]
        cipher.decrypt(iv, mac, authenticated + data)
        return data
    except InvalidTag:
        return None


COMMAND_SPIS = (1, 2)
"""Primary and reserve SPI (security parameter index) of command frames."""

TELEMETRY_SPIS = (3, 4)
"""Primary and reserve SPI (security parameter index) of telemetry frames."""


def may_change(spi: int, changed: int) -> bool:
    """Return whether a command with an SPI may change the key of the SPI `changed`.

    The reserve SPI may change all keys, and the primary SPI only the keys of primary SPIs.
    """
    return spi == COMMAND_SPIS[1] or changed not in (COMMAND_SPIS[1], TELEMETRY_SPIS[1])


HIGHEST_COUNTER = 2**63
"""Largest accepted frame counter, which is reached after 292 million years at 1000 frames per second."""

COPIES = ("a", "b")

_RECORD = struct.Struct(f">4sHIQ{KEY_BYTES}s")
_MAGIC = b"KCS1"
_CRC_BYTES = 4
_LOCK, OWNER = "lock", "owner"


@dataclass(frozen=True, slots=True, order=True)
class Association:
    """Security association: the key of an SPI and the lowest counter that is unused with this key."""

    spi: int
    generation: int
    unused: int
    key: bytes = field(repr=False, compare=False)

    @property
    def cipher(self) -> AESGCM:
        """AES-256-GCM cipher with the key of this association."""
        return AESGCM(self.key)


def encode(association: Association) -> bytes:
    """Return the record that stores an association."""
    a = association
    record = _RECORD.pack(_MAGIC, a.spi, a.generation, a.unused, a.key)
    return record + zlib.crc32(record).to_bytes(_CRC_BYTES, "big")


def decode(data: bytes) -> Association | None:
    """Return the association in a stored record, or None if the record is damaged or invalid.

    A record with a counter above `HIGHEST_COUNTER` is invalid, because no such counter is ever used.
    """
    record, crc = data[: _RECORD.size], data[_RECORD.size :]
    if len(record) != _RECORD.size or zlib.crc32(record).to_bytes(_CRC_BYTES, "big") != crc:
        return None
    magic, spi, generation, unused, key = _RECORD.unpack(record)
    good = magic == _MAGIC and unused <= HIGHEST_COUNTER
    return Association(spi, generation, unused, key) if good else None


class Vault:
    """Folder of stored security associations, which several processes of the same user may share."""

    def __init__(self, folder: Path, witness: Path | None = None, rebuild: bool = False) -> None:
        """Open a folder. Raises UsageError for a missing folder, or if other users may read its files.

        On a satellite, `witness` is the path of the reference folder, which is created if it does not exist.
        With a reference folder, other users' access to the keys is removed. If `rebuild` is true, a lost
        folder is made again from the reference folder, without the primary command SPI. Raises OSError if
        this is not possible.
        """
        self._folder = folder
        self._witness = None if witness is None else _Witness(witness)
        known = {} if self._witness is None else self._witness.known
        if rebuild and known:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder; `knightcube keys` makes keys")
        with suppress(OSError):  # the keys may be readable although the damaged folder cannot be listed
            for path in folder.glob("spi-*"):
                if not stat.S_IMODE(path.stat().st_mode) & 0o077:
                    continue
                if self._witness is None:
                    raise UsageError(
                        f"{path}: other users may read this key: run chmod 600, or make new keys"
                    )
                path.chmod(0o600)
        self.restored = self.rebuilt = False
        """Whether the primary command SPI is refused because its association is outdated (`restored`), or
        because its association was lost (`rebuilt`)."""
        if self._witness is not None:
            spis = (*COMMAND_SPIS, *TELEMETRY_SPIS)
            stored = {spi: max(self._copies(spi), default=None) for spi in spis}
            is_lost = all(one is None for one in stored.values())
            for spi, one in stored.items():
                if one is not None and not self._witness.outdates(one):
                    self._witness.write(one)
                elif spi != COMMAND_SPIS[0] and spi in known and (rebuild or not is_lost):
                    self.write(known[spi])
            self.rebuilt = COMMAND_SPIS[0] in known and self.copies(COMMAND_SPIS[0]) == 0
            self.restored = self.copies(COMMAND_SPIS[0]) > 0 and self.read(COMMAND_SPIS[0]) is None

    @property
    def folder(self) -> Path:
        """Path of the folder of associations."""
        return self._folder

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against writes by other processes. Raises KnightCubeError if locking fails."""
        with ExitStack() as stack:
            try:
                file = os.open(self._folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
                stack.callback(os.close, file)
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                raise KnightCubeError(
                    f"{self._folder}: cannot be written: {error.strerror or error}"
                ) from error
            yield

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Lock the folder against a second link process. Raises UsageError if it is already locked."""
        with locked(self._folder / OWNER, f"{self._folder}: another link process uses these counters"):
            yield

    def read(self, name: int | str) -> Association | None:
        """Return the newest valid copy of a security association, or None if no copy is valid.

        An association in the reference folder that is newer than both copies is returned instead. For an
        outdated primary command SPI, the result is None, because old frames could be accepted again.
        """
        newest = max(self._copies(name), default=None)
        if newest is None or self._witness is None or not self._witness.outdates(newest):
            return newest
        return None if newest.spi == COMMAND_SPIS[0] else self._witness.known[newest.spi]

    def has_used(self, spi: int, key: bytes) -> bool:
        """Return whether an SPI uses this key, or has used it according to the reference folder."""
        present = self.read(spi)
        recorded = self._witness is not None and self._witness.has_recorded(spi, key)
        return recorded or (present is not None and present.key == key)

    def copies(self, name: int | str) -> int:
        """Return the number of valid copies that equal the newest copy."""
        found = self._copies(name)
        return found.count(max(found)) if found else 0

    def write(self, association: Association, name: int | str | None = None) -> int:
        """Write both copies of an association and return how many writes succeeded. Never raises."""
        data = encode(association)
        spi = association.spi if name is None else name
        written = sum(overwrite(self._path(spi, copy), data) for copy in COPIES)
        if written and self._witness is not None:
            self._witness.write(association)
        return written

    def advance(self, association: Association) -> int:
        """Write both copies unless a newer association is stored; return the number of valid copies."""
        try:
            with self.locked():
                newest = self.read(association.spi)
                if newest is not None and newest >= association:
                    return self.copies(association.spi)
                return self.write(association)
        except KnightCubeError:
            return 0

    def remove(self, name: int | str) -> None:
        """Delete both copies of a security association."""
        for copy in COPIES:
            self._path(name, copy).unlink(missing_ok=True)

    def _path(self, name: int | str, copy: str) -> Path:
        return self._folder / f"spi-{name}.{copy}"

    def _copies(self, name: int | str) -> list[Association]:
        found = []
        for copy in COPIES:
            data = None
            # Reading is retried, because a copy that could not be read would be replaced by an older
            # association.
            for _ in range(_READ_TRIES):
                with suppress(OSError):
                    data = read_regular(self._path(name, copy), _RECORD.size + _CRC_BYTES)
                    break
            association = None if data is None else decode(data)
            if association is not None and str(association.spi) == str(name).partition("-")[0]:
                found.append(association)
        return found


_READ_TRIES = 3
"""Number of attempts to read a stored association."""
_ID_BYTES = 8
_MOST_IDS_BYTES = 1 << 16


class _Witness:
    """Reference folder with the newest (`known`) association of each SPI and the digests of replaced keys.

    Disk errors are ignored, because a link without a reference folder is better than no link.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.known: dict[int, Association] = {}
        self._replaced: dict[int, set[bytes]] = {}
        self._older: dict[int, str] = {}  # the copy that is not the newest one
        for spi in (*COMMAND_SPIS, *TELEMETRY_SPIS):
            found = [decode(self._read(f"spi-{spi}.{copy}", _RECORD.size + _CRC_BYTES)) for copy in COPIES]
            good = [one for one in found if one is not None and one.spi == spi]
            if good:
                self.known[spi] = max(good)
                self._older[spi] = COPIES[found[0] == max(good)]
            ids = self._read(f"replaced-{spi}", _MOST_IDS_BYTES)
            self._replaced[spi] = {ids[at : at + _ID_BYTES] for at in range(0, len(ids), _ID_BYTES)}

    def outdates(self, stored: Association) -> bool:
        """Return whether a stored association has been replaced, or has an old counter."""
        known = self.known.get(stored.spi)
        if known is None:
            return False
        if known.key == stored.key:
            return stored.unused < known.unused
        return _id_of(stored.key) in self._replaced[stored.spi]

    def has_recorded(self, spi: int, key: bytes) -> bool:
        """Return whether a key is the newest key of an SPI or was replaced."""
        known = self.known.get(spi)
        return _id_of(key) in self._replaced[spi] or (known is not None and known.key == key)

    def write(self, association: Association) -> None:
        """Record a new association, and the digest of the key that it replaces."""
        spi, known = association.spi, self.known.get(association.spi)
        if association == known and association.key == known.key:
            return
        new = known is None or known.key != association.key
        if known is not None and new:
            self._replaced[spi].add(_id_of(known.key))
            overwrite(self._folder / f"replaced-{spi}", b"".join(sorted(self._replaced[spi])))
        self.known[spi] = association
        # If only the counter is new, only the older copy is overwritten, so that a crash damages at most one
        # copy. If the folder of keys is lost, the reserve SPI continues with one of the copies, so both are
        # written.
        older = self._older.get(spi, COPIES[0])
        for copy in COPIES if new or spi == COMMAND_SPIS[1] else (older,):
            overwrite(self._folder / f"spi-{spi}.{copy}", encode(association))
        self._older[spi] = COPIES[older == COPIES[0]]

    def _read(self, name: str, most: int) -> bytes:
        with suppress(OSError):
            return read_regular(self._folder / name, most) or b""
        return b""


def _id_of(key: bytes) -> bytes:
    return hashlib.sha256(b"knightcube " + key).digest()[:_ID_BYTES]


WINDOW = 2**40
"""Largest accepted gap between the counter of a command frame and the lowest unused counter. A ground that
sends 1000 frames per second to a satellite that receives none exceeds this gap after 34 years."""

NEXT = "next"
"""Suffix of the name under which the next key of an SPI is stored during a key change."""


class Refusal(Enum):
    """Reason why a frame was refused."""

    CRC = "its CRC is wrong"
    HEADER = "it is not a frame of this spacecraft"
    SPI = "its SPI has no association"
    LOST = "the counter of its SPI is lost"
    MAC = "its MAC is wrong"
    REPEATED = "its counter was used"
    BEYOND = "its counter is too far ahead"
    UNSTORED = "its counter could not be stored"


class RefusedError(KnightCubeError):
    """Raised for a refused frame. The attribute `counter` is None unless the frame is authentic."""

    def __init__(self, cause: Refusal, spi: int = 0, counter: int | None = None) -> None:
        super().__init__(cause.value)
        self.cause, self.spi, self.counter = cause, spi, counter


@dataclass(frozen=True, slots=True)
class Admitted:
    """Content of an accepted frame: SPI, counter, header and decrypted data."""

    spi: int
    counter: int
    header: bytes
    data: bytes


Parse = Callable[[bytes], tuple[bytes, bytes]]
"""Function that splits a frame with valid CRC into header and protected data, or raises FrameError."""


class Gate:
    """Authenticates frames of one direction and rejects replays; counts `admitted` and `refused` frames."""

    def __init__(
        self,
        vault: Vault,
        spis: Sequence[int],
        parse: Parse,
        mask: bytes,
        window: int = WINDOW,
        store_every: int = 1,
        encrypted: bool = True,
    ) -> None:
        """Accept frames of the given SPIs and restore lost copies of their associations.

        If `store_every` is above 1, the counter is stored only once per `store_every` counts. The ground
        station uses a value above 1 for telemetry. Telemetry can be authenticated without being `encrypted`.
        """
        self._vault, self._parse, self._mask, self._window = vault, parse, mask, window
        self._store_every, self._encrypted = store_every, encrypted
        self._ciphers: dict[bytes, AESGCM] = {}
        self._open: dict[int, Association | None] = {spi: vault.read(spi) for spi in spis}
        for entry in self._open.values():
            if entry is not None and vault.copies(entry.spi) < len(COPIES):
                vault.write(entry)
        self._stored = {spi: entry.unused for spi, entry in self._open.items() if entry is not None}
        self.refused: Counter[Refusal] = Counter()
        self.admitted = 0

    def association(self, spi: int) -> Association | None:
        """Return the current association of an SPI, or None if both stored copies are lost."""
        return self._open[spi]

    def admit(self, frame: bytes) -> Admitted:
        """Return the content of a frame. Raises RefusedError for an invalid or repeated frame."""
        try:
            admitted = self._admit(frame)
        except RefusedError as error:
            self.refused[error.cause] += 1
            raise
        self.admitted += 1
        return admitted

    def replace_key(self, spi: int, generation: int, key: bytes) -> bool:
        """Change the key of an SPI and reset the SPI's counter to 0. Return whether the change was stored."""
        changed = Association(spi, generation, 0, key)
        if self._vault.write(changed) == 0:
            return False
        self._open[spi] = changed
        self._stored[spi] = 0
        return True

    def close(self) -> None:
        """Store all counters durably."""
        for entry in self._open.values():
            if entry is not None and entry.unused > self._stored[entry.spi]:
                self._vault.advance(entry)

    def _admit(self, frame: bytes) -> Admitted:
        if crc16(frame) != 0:
            raise RefusedError(Refusal.CRC)
        try:
            header, protected = self._parse(frame)
        except FrameError as error:
            raise RefusedError(Refusal.HEADER) from error
        spi = int.from_bytes(protected[:SPI_BYTES], "big") if len(protected) >= OVERHEAD_BYTES else -1
        if spi not in self._open:
            raise RefusedError(Refusal.SPI)
        entry = self._open[spi] or self._read_again(spi)
        data = unprotect(self._cipher(entry), header, self._mask, protected, self._encrypted)
        if data is None:
            entry, data = self._by_newer_key(entry, header, protected)
        counter = int.from_bytes(protected[SPI_BYTES:SECURITY_HEADER_BYTES], "big") % (1 << _COUNTER_BITS)
        if counter < entry.unused:
            raise RefusedError(Refusal.REPEATED, spi, counter)
        if counter >= min(entry.unused + self._window, HIGHEST_COUNTER):
            raise RefusedError(Refusal.BEYOND, spi, counter)
        used = replace(entry, unused=counter + 1)
        if used.unused >= self._stored[spi] + self._store_every:
            if self._vault.advance(used) == 0:
                raise RefusedError(Refusal.UNSTORED, spi, counter)
            self._stored[spi] = used.unused
        self._open[spi] = used
        return Admitted(spi, counter, header, data)

    def _read_again(self, spi: int) -> Association:
        """Try again to read a missing association. Raises RefusedError if both stored copies are lost."""
        entry = self._vault.read(spi)
        if entry is None:
            raise RefusedError(Refusal.LOST, spi)
        self._open[spi], self._stored[spi] = entry, entry.unused
        return entry

    def _cipher(self, entry: Association) -> AESGCM:
        known = self._ciphers.get(entry.key)
        if known is None:
            known = self._ciphers[entry.key] = entry.cipher
        return known

    def _by_newer_key(self, entry: Association, header: bytes, protected: bytes) -> tuple[Association, bytes]:
        """Return association and data of a frame whose key is newer than `entry`. Raises RefusedError.

        On the ground, another process that shares the folder of keys may already have replaced the key.
        """
        spi = entry.spi
        for name in (spi, f"{spi}-{NEXT}") if self._store_every > 1 else ():
            newer = self._vault.read(name)
            if newer is None or newer.generation <= entry.generation:
                continue
            data = unprotect(newer.cipher, header, self._mask, protected, self._encrypted)
            if data is None:
                continue
            # If the next key cannot be stored as the present key, its file is kept for the next start.
            if name != spi and self.replace_key(spi, newer.generation, newer.key):
                self._vault.remove(name)
            self._open[spi], self._stored[spi] = newer, newer.unused
            return newer, data
        raise RefusedError(Refusal.MAC, spi)


class Sealer:
    """Protects frames with the key of one SPI. A counter is reserved on disk before it is used."""

    def __init__(
        self,
        vault: Vault,
        name: int | str,
        mask: bytes,
        block: int = 1,
        shared: bool = False,
        encrypted: bool = True,
    ) -> None:
        """Protect frames with the association `name`, and reserve `block` counters at a time.

        Counters that were reserved but not used before a crash are skipped. If several processes share the
        association, `shared` must be true. The rest of a block is then skipped as soon as another process has
        reserved counters, because the receiver refuses counters below the highest one it has received.
        """
        self._vault, self._name = vault, name
        self._spi = int(str(name).partition("-")[0])
        self._mask, self._block, self._shared, self._encrypted = mask, block, shared, encrypted
        self._salt = secrets.randbits(_SALT_BITS) << _COUNTER_BITS
        self._next = self._end = self._generation = 0
        self._cipher: AESGCM | None = None

    def replace_key(self, generation: int, key: bytes) -> bool:
        """Change the key and reset the counter to 0. Return whether the change was stored."""
        if self._vault.write(Association(self._spi, generation, 0, key)) == 0:
            return False
        self._next = self._end = 0
        return True

    def seal(self, header: bytes, data: bytes) -> tuple[bytes, int]:
        """Return a protected frame, without CRC, and its counter.

        Raises KnightCubeError if no counter can be reserved.
        """
        if self._next == self._end or (self._shared and self._is_overtaken()):
            self._reserve()
        assert self._cipher is not None
        counter = self._next
        self._next += 1
        iv = self._salt | counter
        return protect(self._cipher, self._spi, iv, header, self._mask, data, self._encrypted), counter

    def _is_overtaken(self) -> bool:
        """Return whether another process has changed the key or reserved counters after this block."""
        entry = self._vault.read(self._name)
        return entry is not None and (entry.generation, entry.unused) != (self._generation, self._end)

    def _reserve(self) -> None:
        with self._vault.locked():
            entry = self._vault.read(self._name)
            if entry is None:
                raise KnightCubeError(
                    f"both copies of the counter of SPI {self._spi} are lost: use the reserve SPI"
                )
            reserved = replace(entry, unused=entry.unused + self._block)
            if reserved.unused > HIGHEST_COUNTER:
                raise KnightCubeError(f"the counters of SPI {self._spi} are used up: change its key")
            if self._vault.write(reserved, self._name) == 0:
                raise KnightCubeError(f"the counter of SPI {self._spi} cannot be stored")
        self._next, self._end, self._generation = entry.unused, reserved.unused, entry.generation
        self._cipher = entry.cipher


USED_KEY = "has or had this key"
"""Text with which the satellite refuses a new key that the SPI has already used (`Vault.has_used`)."""


def new_key() -> bytes:
    """Return a new key from the random number generator of the operating system."""
    return secrets.token_bytes(KEY_BYTES)
