"""The gate of the link: which frames are let in, each once, and the counters of those that go out.

Checks follow each other from cheap to dear: CRC, spacecraft, SPI, MAC, counter. A frame that fails changes
nothing but the count of its cause. A counter is durable before the frame's data is handed on, so that no
crash lets a frame in twice.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from flight.link.frames.telecommand import FrameError
from flight.link.security.associations import COPIES, HIGHEST_COUNTER, Association, Vault
from flight.link.security.sdls import KEY_BYTES, counter_of, protect, spi_of, unprotect
from flight.link.telemetry.packets import crc16
from knightcube.errors import FlightError

WINDOW = 65_536
"""How far ahead of the highest accepted counter a command's may be; telemetry shows that counter."""

NEXT = "next"
"""Behind an SPI in a name: its next key, which the other end may have taken already."""


class Refusal(Enum):
    """Why a frame is not let in."""

    CRC = "its CRC is wrong"
    HEADER = "it is no frame of this spacecraft"
    SPI = "there is no association of its SPI"
    LOST = "the counter of its SPI is lost"
    MAC = "its MAC is wrong"
    REPEATED = "its counter was used"
    BEYOND = "its counter is too far ahead"
    UNSTORED = "its counter could not be stored"


class RefusedError(FlightError):
    """A frame that is not let in; `counter` is that of an authentic frame, else None."""

    def __init__(self, cause: Refusal, spi: int = 0, counter: int | None = None) -> None:
        super().__init__(cause.value)
        self.cause = cause
        self.spi = spi
        self.counter = counter


@dataclass(frozen=True, slots=True)
class Admitted:
    """The data of a frame that was let in."""

    spi: int
    counter: int
    header: bytes
    data: bytes


Parse = Callable[[bytes], tuple[bytes, bytes]]
"""A frame with a right CRC to its header and protected rest; raises FrameError."""


class Gate:
    """Lets frames of one direction in.

    Attributes:
        refused: frames by cause.
        admitted: frames let in.
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
        """Let frames of `spis` in; a copy that is lost is made again from the other.

        `store_every` above 1, for telemetry on the ground, makes only each such counter durable.
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
        """Return the association of an SPI as it is now; None when both copies are lost."""
        return self._open[spi]

    def admit(self, frame: bytes) -> Admitted:
        """Return the data of a frame, which is then used up. Raises RefusedError."""
        try:
            admitted = self._admit(frame)
        except RefusedError as error:
            self.refused[error.cause] += 1
            raise
        self.admitted += 1
        return admitted

    def replace_key(self, spi: int, generation: int, key: bytes) -> bool:
        """Change the key of an SPI, its counter back to 0; return whether that is durable."""
        changed = Association(spi, generation, 0, key)
        if self._vault.write(changed) == 0:
            return False
        self._open[spi] = changed
        self._stored[spi] = 0
        return True

    def close(self) -> None:
        """Make the counters durable that are not."""
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
        """Return an association that the disk did not give before. Raises RefusedError if it is lost."""
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
        """Return association and data of a frame under the next key: the other end has taken that key."""
        following = self._vault.read(f"{spi}-{NEXT}") if self._store_every > 1 else None
        if following is not None:
            data = unprotect(following.cipher, header, self._mask, protected)
            if data is not None:
                self.replace_key(spi, following.generation, following.key)
                self._vault.remove(f"{spi}-{NEXT}")
                return following, data
        raise RefusedError(Refusal.MAC, spi)


class Sealer:
    """Protects what is sent under one SPI; each counter is reserved on disk before its frame is made."""

    def __init__(self, vault: Vault, name: int | str, mask: bytes, block: int = 1) -> None:
        """Take the SPI, or the name of its next key. `block` counters are reserved at once.

        Those that a crash leaves over are never used.
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
        """Change the key, the counter back to 0; return whether that is durable."""
        if self._vault.write(Association(self._spi, generation, 0, key)) == 0:
            return False
        self._next = self._end = 0
        return True

    def seal(self, header: bytes, data: bytes) -> tuple[bytes, int]:
        """Return a protected frame without CRC, and its counter. Raises FlightError without a counter."""
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
