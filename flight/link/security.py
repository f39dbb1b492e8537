"""Security of the link (CCSDS 355.0-B-2): keys and counters on disk, authentication, replay protection.

Frames use AES-256-GCM in both directions: security header (SPI 2 bytes, IV 12 bytes), ciphertext, MAC (16
bytes). The IV is the frame's counter, which is used only once under a key. The MAC covers the virtual
channel, the SPI and the data; the IV is the nonce. Yamcs covers the same bits.

Key and counter of each SPI are stored in two copies. A copy is a record of fixed size that ends in its
CRC-32. Both copies are overwritten in place, one after the other: this needs no space on a full disk, and a
crash damages one copy at most. The newer copy is valid; it has the later key or the higher counter. A
folder holds the associations of one end of the link, and only its owner may read the files.

A gate checks CRC, spacecraft, SPI, MAC and counter in this order. A frame that fails a check changes only the
count of refusals for that cause. The counter of a frame is durable before its data are used, so that a crash
cannot lead to a second acceptance of the frame.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import stat
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from flight.link.frames import FrameError
from flight.link.regular_files import locked, overwrite, read_regular
from flight.link.telemetry.packets import crc16
from knightcube.errors import FlightError, UsageError

SPI_BYTES = 2
IV_BYTES = 12
MAC_BYTES = 16
SECURITY_HEADER_BYTES = SPI_BYTES + IV_BYTES
OVERHEAD_BYTES = SECURITY_HEADER_BYTES + MAC_BYTES
KEY_BYTES = 32

_NO_IV = bytes(IV_BYTES)


def _authenticated(header: bytes, mask: bytes, spi: bytes) -> bytes:
    masked = int.from_bytes(header, "big") & int.from_bytes(mask, "big")
    return masked.to_bytes(len(header), "big") + spi + _NO_IV


def protect(cipher: AESGCM, spi: int, counter: int, header: bytes, mask: bytes, data: bytes) -> bytes:
    """Return header, security header, ciphertext and MAC; `mask` selects the header bits of the MAC."""
    index, iv = spi.to_bytes(SPI_BYTES, "big"), counter.to_bytes(IV_BYTES, "big")
    return header + index + iv + cipher.encrypt(iv, data, _authenticated(header, mask, index))


def spi_of(protected: bytes) -> int:
    """Return the SPI of a frame, -1 if the frame is too short."""
    return int.from_bytes(protected[:SPI_BYTES], "big") if len(protected) >= OVERHEAD_BYTES else -1


def counter_of(protected: bytes) -> int:
    """Return the counter of a frame, which is authentic only if `unprotect` succeeds."""
    return int.from_bytes(protected[SPI_BYTES:SECURITY_HEADER_BYTES], "big")


def unprotect(cipher: AESGCM, header: bytes, mask: bytes, protected: bytes) -> bytes | None:
    """Return the data of a frame that begins with its security header, None if the MAC is wrong."""
    index, iv = protected[:SPI_BYTES], protected[SPI_BYTES:SECURITY_HEADER_BYTES]
    try:
        return cipher.decrypt(iv, protected[SECURITY_HEADER_BYTES:], _authenticated(header, mask, index))
    except InvalidTag:
        return None


COMMAND_SPIS = (1, 2)
"""Primary and reserve SPI of commands."""

TELEMETRY_SPIS = (3, 4)
"""Primary and reserve SPI of telemetry."""

HIGHEST_COUNTER = 2**63
"""Largest accepted counter. A sender of a thousand frames per second reaches it in 292 million years."""

COPIES = ("a", "b")

_RECORD = struct.Struct(f">4sHIQ{KEY_BYTES}s")
_MAGIC = b"KCS1"
_CRC_BYTES = 4
_LOCK, _OWNER = "lock", "owner"


@dataclass(frozen=True, slots=True, order=True)
class Association:
    """Key and counter of an SPI: `unused` is the lowest unused counter of this key."""

    spi: int
    generation: int
    unused: int
    key: bytes = field(repr=False, compare=False)

    @property
    def cipher(self) -> AESGCM:
        """AES-256-GCM under this key."""
        return AESGCM(self.key)


def encode(association: Association) -> bytes:
    """Return the bytes of a stored copy."""
    a = association
    record = _RECORD.pack(_MAGIC, a.spi, a.generation, a.unused, a.key)
    return record + zlib.crc32(record).to_bytes(_CRC_BYTES, "big")


def decode(data: bytes) -> Association | None:
    """Return the association of a stored copy, None for bytes that `encode` does not produce.

    A copy with a counter beyond `HIGHEST_COUNTER` is invalid, because no gate or sealer produces one.
    """
    record, crc = data[: _RECORD.size], data[_RECORD.size :]
    if len(record) != _RECORD.size or zlib.crc32(record).to_bytes(_CRC_BYTES, "big") != crc:
        return None
    magic, spi, generation, unused, key = _RECORD.unpack(record)
    good = magic == _MAGIC and unused <= HIGHEST_COUNTER
    return Association(spi, generation, unused, key) if good else None


class Vault:
    """Stored associations of a folder, which several processes of one user may share."""

    def __init__(self, folder: Path) -> None:
        """Open a folder. Raises UsageError if it does not exist or if others may read its files."""
        self._folder = folder
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder; `python -m ground keys` makes keys")
        for path in folder.glob("spi-*"):
            if stat.S_IMODE(path.stat().st_mode) & 0o077:
                raise UsageError(f"{path}: others may read this key: chmod 600, or make new keys")

    @property
    def folder(self) -> Path:
        """Folder of the associations."""
        return self._folder

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against writes of other processes. Raises FlightError if it cannot be written."""
        with ExitStack() as stack:
            try:
                file = os.open(self._folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
                stack.callback(os.close, file)
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                raise FlightError(f"{self._folder}: cannot be written: {error.strerror or error}") from error
            yield

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Lock the folder against a second link process. Raises UsageError if another process owns it."""
        with locked(self._folder / _OWNER, f"{self._folder}: another link process has these counters"):
            yield

    def read(self, name: int | str) -> Association | None:
        """Return the newest valid copy of an association, None if both copies are lost."""
        return max(self._copies(name), default=None)

    def copies(self, name: int | str) -> int:
        """Return the number of valid copies that equal the newest copy."""
        found = self._copies(name)
        return found.count(max(found)) if found else 0

    def write(self, association: Association, name: int | str | None = None) -> int:
        """Write both copies and return the number of durable copies, 0 if the disk fails. Never raises."""
        data = encode(association)
        spi = association.spi if name is None else name
        return sum(overwrite(self._path(spi, copy), data) for copy in COPIES)

    def advance(self, association: Association) -> int:
        """Write both copies unless another process wrote a newer one; return the number of durable copies.

        The number is 0 if the disk fails or is read-only.
        """
        try:
            with self.locked():
                newest = self.read(association.spi)
                if newest is not None and newest >= association:
                    return self.copies(association.spi)
                return self.write(association)
        except FlightError:
            return 0

    def remove(self, name: int | str) -> None:
        """Remove an association."""
        for copy in COPIES:
            self._path(name, copy).unlink(missing_ok=True)

    def _path(self, name: int | str, copy: str) -> Path:
        return self._folder / f"spi-{name}.{copy}"

    def _copies(self, name: int | str) -> list[Association]:
        found = []
        for copy in COPIES:
            try:
                data = read_regular(self._path(name, copy), _RECORD.size + _CRC_BYTES)
            except OSError:
                continue
            association = None if data is None else decode(data)
            if association is not None and str(association.spi) == str(name).partition("-")[0]:
                found.append(association)
        return found


WINDOW = 65_536
"""Largest lead of a command's counter over the highest accepted counter, which telemetry shows."""

NEXT = "next"
"""Suffix of the name of an SPI's next key, which the other end may already use."""


class Refusal(Enum):
    """Cause of the refusal of a frame."""

    CRC = "its CRC is wrong"
    HEADER = "it is not a frame of this spacecraft"
    SPI = "its SPI has no association"
    LOST = "the counter of its SPI is lost"
    MAC = "its MAC is wrong"
    REPEATED = "its counter was used"
    BEYOND = "its counter is too far ahead"
    UNSTORED = "its counter could not be stored"


class RefusedError(FlightError):
    """Raised for a refused frame; `counter` is the counter of an authentic frame, else None."""

    def __init__(self, cause: Refusal, spi: int = 0, counter: int | None = None) -> None:
        super().__init__(cause.value)
        self.cause = cause
        self.spi = spi
        self.counter = counter


@dataclass(frozen=True, slots=True)
class Admitted:
    """Data of an accepted frame."""

    spi: int
    counter: int
    header: bytes
    data: bytes


Parse = Callable[[bytes], tuple[bytes, bytes]]
"""Function that splits a frame of valid CRC into its header and protected rest; raises FrameError."""


class Gate:
    """Authenticates frames of one direction and rejects replays.

    Attributes:
        refused: number of refused frames by cause.
        admitted: number of accepted frames.
    """

    def __init__(
        self,
        vault: Vault,
        spis: Sequence[int],
        parse: Parse,
        mask: bytes,
        window: int = WINDOW,
        store_every: int = 1,
    ) -> None:
        """Accept frames of `spis`; a lost copy of an association is restored from the other copy.

        With `store_every` above 1, for telemetry on the ground, only every such counter is made durable.
        """
        self._vault = vault
        self._parse = parse
        self._mask = mask
        self._window = window
        self._store_every = store_every
        self._ciphers: dict[tuple[int, int], AESGCM] = {}
        self._open: dict[int, Association | None] = {spi: vault.read(spi) for spi in spis}
        for entry in self._open.values():
            if entry is not None and vault.copies(entry.spi) < len(COPIES):
                vault.write(entry)
        self._stored = {spi: entry.unused for spi, entry in self._open.items() if entry is not None}
        self.refused: Counter[Refusal] = Counter()
        self.admitted = 0

    def association(self, spi: int) -> Association | None:
        """Return the current association of an SPI, None if both copies are lost."""
        return self._open[spi]

    def admit(self, frame: bytes) -> Admitted:
        """Return the data of a frame, whose repetition is refused from now on. Raises RefusedError."""
        try:
            admitted = self._admit(frame)
        except RefusedError as error:
            self.refused[error.cause] += 1
            raise
        self.admitted += 1
        return admitted

    def replace_key(self, spi: int, generation: int, key: bytes) -> bool:
        """Change the key of an SPI and reset its counter to 0; return whether the change is durable."""
        changed = Association(spi, generation, 0, key)
        if self._vault.write(changed) == 0:
            return False
        self._open[spi] = changed
        self._stored[spi] = 0
        return True

    def close(self) -> None:
        """Make all counters durable."""
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
        spi = spi_of(protected)
        if spi not in self._open:
            raise RefusedError(Refusal.SPI)
        entry = self._open[spi] or self._read_again(spi)
        data = unprotect(self._cipher(entry), header, self._mask, protected)
        if data is None:
            entry, data = self._by_next_key(spi, header, protected)
        counter = counter_of(protected)
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
        """Read an association that could not be read before. Raises RefusedError if it is lost."""
        entry = self._vault.read(spi)
        if entry is None:
            raise RefusedError(Refusal.LOST, spi)
        self._open[spi], self._stored[spi] = entry, entry.unused
        return entry

    def _cipher(self, entry: Association) -> AESGCM:
        known = self._ciphers.get((entry.spi, entry.generation))
        if known is None:
            known = self._ciphers[entry.spi, entry.generation] = entry.cipher
        return known

    def _by_next_key(self, spi: int, header: bytes, protected: bytes) -> tuple[Association, bytes]:
        """Return association and data of a frame under the next key, if the other end already uses it."""
        following = self._vault.read(f"{spi}-{NEXT}") if self._store_every > 1 else None
        if following is not None:
            data = unprotect(following.cipher, header, self._mask, protected)
            if data is not None:
                self.replace_key(spi, following.generation, following.key)
                self._vault.remove(f"{spi}-{NEXT}")
                return following, data
        raise RefusedError(Refusal.MAC, spi)


class Sealer:
    """Protects sent frames under one SPI; each counter is reserved on disk before its frame is made."""

    def __init__(self, vault: Vault, name: int | str, mask: bytes, block: int = 1) -> None:
        """Use the SPI, or the name of its next key, and reserve `block` counters at a time.

        Counters that are reserved but unused at a crash are never used.
        """
        self._vault = vault
        self._name = name
        self._spi = int(str(name).partition("-")[0])
        self._mask = mask
        self._block = block
        self._next = 0
        self._end = 0
        self._cipher: AESGCM | None = None

    def replace_key(self, generation: int, key: bytes) -> bool:
        """Change the key and reset the counter to 0; return whether the change is durable."""
        if self._vault.write(Association(self._spi, generation, 0, key)) == 0:
            return False
        self._next = self._end = 0
        return True

    def seal(self, header: bytes, data: bytes) -> tuple[bytes, int]:
        """Return a protected frame without CRC, and its counter. Raises FlightError if no counter is free."""
        if self._next == self._end:
            self._reserve()
        assert self._cipher is not None
        counter = self._next
        self._next += 1
        return protect(self._cipher, self._spi, counter, header, self._mask, data), counter

    def _reserve(self) -> None:
        with self._vault.locked():
            entry = self._vault.read(self._name)
            if entry is None:
                raise FlightError(f"both copies of the counter of SPI {self._spi} are lost: use its reserve")
            reserved = replace(entry, unused=entry.unused + self._block)
            if reserved.unused > HIGHEST_COUNTER:
                raise FlightError(f"the counters of SPI {self._spi} are used up: change its key")
            if self._vault.write(reserved, self._name) == 0:
                raise FlightError(f"the counter of SPI {self._spi} cannot be stored")
        self._next, self._end = entry.unused, reserved.unused
        self._cipher = entry.cipher


def new_key() -> bytes:
    """Return a new key from the system's random numbers."""
    return secrets.token_bytes(KEY_BYTES)
