"""Folders of associations for both ends of a link."""

from __future__ import annotations

from pathlib import Path

from flight.link.frames import telecommand
from flight.link.security.associations import COMMAND_SPIS, OVERHEAD_BYTES, Association, Vault, protect
from flight.link.security.gate import Gate, Sealer
from flight.link.telemetry.packets import CRC_BYTES

SPACECRAFT = 0x1A5


def vault(folder: Path, keys: dict[int, bytes]) -> Vault:
    """Return a new vault with these keys."""
    folder.mkdir()
    made = Vault(folder)
    for spi, key in keys.items():
        made.write(Association(spi, 1, 0, key))
    return made


def parse(frame: bytes) -> tuple[bytes, bytes]:
    """Split a telecommand frame as the satellite does."""
    body = telecommand.open_frame(frame, SPACECRAFT)
    size = telecommand.HEADER.size
    return body[:size], body[size:]


def gate(at: Vault) -> Gate:
    """Return the satellite's gate of commands."""
    return Gate(at, COMMAND_SPIS, parse, telecommand.AUTHENTICATED)


def frame_with(at: Vault, counter: int, data: bytes, spi: int = 1) -> bytes:
    """Return an authentic telecommand frame with any counter of 96 bits, which no sealer would reserve."""
    entry = at.read(spi)
    assert entry is not None
    header = telecommand.TelecommandHeader(SPACECRAFT, 0, 0)
    length = telecommand.HEADER.size + OVERHEAD_BYTES + len(data) + CRC_BYTES
    mask = telecommand.AUTHENTICATED
    return telecommand.close_frame(protect(entry.cipher, spi, counter, header.pack(length), mask, data))


class Ground:
    """Makes protected telecommand frames."""

    def __init__(self, at: Vault, spi: int = 1) -> None:
        self._sealer = Sealer(at, spi, telecommand.AUTHENTICATED)

    def frame(self, data: bytes) -> bytes:
        """Return the next frame."""
        header = telecommand.TelecommandHeader(SPACECRAFT, 0, 0)
        length = telecommand.HEADER.size + 30 + len(data) + 2
        return telecommand.close_frame(self._sealer.seal(header.pack(length), data)[0])
