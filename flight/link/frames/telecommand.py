"""Telecommand transfer frames, CCSDS 232.0-B-4: a header of 5 bytes, one space packet, a CRC of 2.

All frames are of type BD (bypass, data), which the frame layer neither acknowledges nor retransmits. The
security header and trailer of CCSDS 355.0-B are between header and CRC
(`flight.link.security.associations`). There is no segment header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from flight.link.telemetry.packets import CRC_BYTES, crc16
from knightcube.errors import FlightError

HEADER = struct.Struct(">HHB")
LONGEST_FRAME = 1024
AUTHENTICATED = bytes((0, 0, 0xFC, 0, 0))
"""Bits of the header that the MAC covers, those of the virtual channel (355.0-B-2, 2.3.2.3.3)."""

_BYPASS = 1 << 13
_CHANNEL_BITS = 10


class FrameError(FlightError):
    """Raised for bytes that are not a frame of this link; the text states the reason."""


@dataclass(frozen=True, slots=True)
class TelecommandHeader:
    """The fields of the header that differ from frame to frame."""

    spacecraft: int
    channel: int
    sequence: int

    def pack(self, length: int) -> bytes:
        """Return the header of a frame of `length` bytes."""
        second = self.channel << _CHANNEL_BITS | (length - 1)
        return HEADER.pack(_BYPASS | self.spacecraft, second, self.sequence % 256)


def stated_length(header: bytes) -> int:
    """Return the length (bytes) of a frame from its header of 5 bytes."""
    return (int.from_bytes(header[2:4], "big") & 0x3FF) + 1


def open_frame(frame: bytes, spacecraft: int) -> bytes:
    """Return a frame without its CRC. Raises FrameError for another spacecraft and for invalid frames."""
    if len(frame) < HEADER.size + CRC_BYTES or stated_length(frame) != len(frame):
        raise FrameError("its length is wrong")
    first = int.from_bytes(frame[:2], "big")
    if first != _BYPASS | spacecraft:
        raise FrameError("it is for another spacecraft, or of another type than BD")
    return frame[:-CRC_BYTES]


def close_frame(body: bytes) -> bytes:
    """Return a frame with its CRC."""
    return body + crc16(body).to_bytes(CRC_BYTES, "big")
