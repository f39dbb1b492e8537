"""The bytes of one connection to the gateway: first a token, then command packets, and nothing else.

Every byte is checked as it arrives. The first byte that no token, or no command packet, can have at its place
ends the connection, so that text of another protocol (HTTP from a web page) is refused at its first byte.
The token itself is compared when all of it has arrived, in constant time: a connection that was closed at the
first wrong character of the token would let a stranger find the token one character after another.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Iterator
from dataclasses import dataclass

from flight.link.files.units import PACKET_VERSION, UP
from flight.link.frames import LONGEST_FRAME, TELECOMMAND_HEADER
from flight.link.security import OVERHEAD_BYTES
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, SECONDARY_BYTES
from ground.xtce import TELECOMMANDS
from knightcube.errors import FlightError

_TOKEN_CHARACTERS = b"0123456789abcdef"
_TOKEN_BYTES = 32
_CHECKED_BYTES = HEADER_BYTES + 1
"""Length of the primary header and the version of the packet's definition."""
_UNSEGMENTED = 0b11
_LONGEST_PACKET = LONGEST_FRAME - TELECOMMAND_HEADER.size - OVERHEAD_BYTES - CRC_BYTES
_SHORTEST_UNIT = HEADER_BYTES + SECONDARY_BYTES + 1 + CRC_BYTES


class StreamError(FlightError):
    """A byte that must end its connection; says which."""


@dataclass(frozen=True, slots=True)
class _Form:
    """The header of one kind of packet: first 16 bits, bounds of the packet's length, version."""

    identifier: bytes
    shortest: int
    longest: int
    version: int

    def begins(self, header: bytes) -> bool:
        """Return whether a packet of this kind can begin with these bytes."""
        if header[:2] != self.identifier[: len(header)]:
            return False
        if len(header) > 2 and header[2] >> 6 != _UNSEGMENTED:
            return False
        if len(header) > 4:
            low, high = (bound - HEADER_BYTES - 1 for bound in (self.shortest, self.longest))
            stated = header[4:HEADER_BYTES]
            if not low.to_bytes(2, "big")[: len(stated)] <= stated <= high.to_bytes(2, "big")[: len(stated)]:
                return False
        return len(header) <= HEADER_BYTES or header[HEADER_BYTES] == self.version


_FORMS = (
    *(
        _Form(layout.identifier.to_bytes(2, "big"), layout.length, layout.length, layout.packet.version)
        for layout in TELECOMMANDS.values()
    ),
    _Form(UP.to_bytes(2, "big"), _SHORTEST_UNIT, _LONGEST_PACKET, PACKET_VERSION),
)


def new_token() -> str:
    """Return a random token: 64 hexadecimal digits."""
    return secrets.token_hex(_TOKEN_BYTES)


class CommandStream:
    """Takes the bytes of a connection and returns its command packets.

    Attributes:
        authenticated: whether the token has arrived.
    """

    def __init__(self, token: str) -> None:
        """Expect a line with the token first."""
        self._line = token.encode("ascii") + b"\n"
        self._arrived = bytearray()
        self.authenticated = False

    def packets(self, data: bytes) -> Iterator[bytes]:
        """Yield the command packets that these bytes complete. Raises StreamError at a wrong byte."""
        self._arrived += data
        if not self.authenticated and not self._take_token():
            return
        while (length := self._checked_length()) is not None and len(self._arrived) >= length:
            packet = bytes(self._arrived[:length])
            del self._arrived[:length]
            yield packet

    def _take_token(self) -> bool:
        """Return whether the line with the token is complete, and remove the line."""
        size = len(self._line)
        line = bytes(self._arrived[:size])
        if any(byte not in _TOKEN_CHARACTERS for byte in line[: size - 1]):
            raise StreamError("its first bytes are not the token")
        if len(line) < size:
            return False
        if not hmac.compare_digest(line, self._line):
            raise StreamError("its first bytes are not the token")
        del self._arrived[:size]
        self.authenticated = True
        return True

    def _checked_length(self) -> int | None:
        """Return the length of the packet that has begun, None while its header is incomplete."""
        header = bytes(self._arrived[:_CHECKED_BYTES])
        for end in range(1, len(header) + 1):
            if not any(form.begins(header[:end]) for form in _FORMS):
                raise StreamError(f"no command packet has 0x{header[end - 1]:02x} as its byte {end}")
        if len(header) < _CHECKED_BYTES:
            return None
        return HEADER_BYTES + 1 + int.from_bytes(header[4:HEADER_BYTES], "big")
