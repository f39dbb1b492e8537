"""Key folders of security associations for both ends of a link."""

from __future__ import annotations

from pathlib import Path

from flight.link.frames import (
    TELECOMMAND_HEADER,
    TELECOMMAND_MASK,
    TelecommandHeader,
    close_frame,
    open_telecommand,
)
from flight.link.security import COMMAND_SPIS, OVERHEAD_BYTES, Association, Gate, Sealer, Vault, protect
from flight.link.telemetry.packets import CRC_BYTES

SPACECRAFT = 0x1A5


def vault(folder: Path, keys: dict[int, bytes]) -> Vault:
    """Return a new vault with the given keys."""
    folder.mkdir()
    made = Vault(folder)
    for spi, key in keys.items():
        made.write(Association(spi, 1, 0, key))
    return made


def parse(frame: bytes) -> tuple[bytes, bytes]:
    """Split a telecommand frame as the satellite does."""
    body = open_telecommand(frame, SPACECRAFT)
    size = TELECOMMAND_HEADER.size
    return body[:size], body[size:]


def gate(at: Vault) -> Gate:
    """Return the satellite's gate, which authenticates command frames."""
    return Gate(at, COMMAND_SPIS, parse, TELECOMMAND_MASK)


def frame_with(at: Vault, iv: int, data: bytes, spi: int = 1) -> bytes:
    """Return an authentic telecommand frame with any IV of 96 bits, even a value that no sender would use."""
    entry = at.read(spi)
    assert entry is not None
    header = TelecommandHeader(SPACECRAFT, 0, 0)
    length = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + len(data) + CRC_BYTES
    mask = TELECOMMAND_MASK
    return close_frame(protect(entry.cipher, spi, iv, header.pack(length), mask, data))


class Ground:
    """Ground end that makes protected telecommand frames."""

    def __init__(self, at: Vault, spi: int = 1) -> None:
        self._sealer = Sealer(at, spi, TELECOMMAND_MASK)

    def frame(self, data: bytes) -> bytes:
        """Return the next frame."""
        header = TelecommandHeader(SPACECRAFT, 0, 0)
        length = TELECOMMAND_HEADER.size + 30 + len(data) + 2
        return close_frame(self._sealer.seal(header.pack(length), data)[0])
