"""Authentication of received frames with replay protection, and protection of sent frames.

The checks run from cheap to expensive: CRC, spacecraft, SPI, MAC, counter. A frame that fails a check
changes only the count of refusals for that cause. The counter of a frame is durable before its data are
used, so that a crash cannot lead to a second acceptance of the frame.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from flight.link.frames.telecommand import FrameError
from flight.link.security.associations import (
    COPIES,
    HIGHEST_COUNTER,
    KEY_BYTES,
    Association,
    Vault,
    counter_of,
    protect,
    spi_of,
    unprotect,
)
from flight.link.telemetry.packets import crc16
from knightcube.errors import FlightError

WINDOW = 65_536
"""Largest lead of a command's counter over the highest accepted counter, which telemetry shows."""

NEXT = "next"
"""Suffix of the name of an SPI's next key, which the other end may already use."""


class Refusal(Enum):
    """Cause of the refusal of a frame."""

    CRC = "its CRC is wrong"
    HEADER = "it is no frame of this spacecraft"
    SPI = "there is no association of its SPI"
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
