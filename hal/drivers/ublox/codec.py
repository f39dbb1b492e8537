"""UBX, the binary protocol of u-blox receivers (u-blox M8 interface description, UBX-13003221, chapter 32).

A frame is B5 62, class, identifier, length (little endian), payload, and an 8-bit Fletcher checksum over all
but the first two bytes. UBX and not NMEA: one NAV-PVT frame carries time, position, all three components of
the velocity and their accuracies of one epoch. NMEA spreads these over sentences, rounds the place to 2 m in
the usual format, and has no vertical velocity.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

SYNC = b"\xb5\x62"
NAV_PVT = 0x01, 0x07
ACK_NAK, ACK_ACK = (0x05, 0x00), (0x05, 0x01)
CFG_PRT, CFG_MSG, CFG_RATE = (0x06, 0x00), (0x06, 0x01), (0x06, 0x08)
OVERHEAD = 8
PVT_LENGTH = 92
_PVT = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH")
THREE_DIMENSIONS = 3
"""NAV-PVT's fixType of a full fix."""
DATE_AND_TIME = 0b011
"""Of NAV-PVT's `valid`."""
FIX_OK = 0b1
"""Of NAV-PVT's `flags`."""

Kind = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Pvt:
    """NAV-PVT in the receiver's own units.

    Attributes:
        date: year, month, day, hour, minute, second UTC; `nano` ns to add, of either sign.
        valid: bits of date and time. fix: its type. flags: bits of the fix.
        satellites: in use.
        longitude, latitude: 1e-7 deg. height: mm above WGS 84.
        horizontal, vertical: mm, accuracies.
        velocity: mm/s, north, east, down. speed_accuracy: mm/s.
    """

    date: tuple[int, int, int, int, int, int]
    nano: int
    valid: int
    fix: int
    flags: int
    satellites: int
    longitude: int
    latitude: int
    height: int
    horizontal: int
    vertical: int
    velocity: tuple[int, int, int]
    speed_accuracy: int

    def packed(self, time_of_week_ms: int = 0) -> bytes:
        """Return the payload."""
        north, east, _ = self.velocity
        ground = round((north * north + east * east) ** 0.5)
        return _PVT.pack(
            time_of_week_ms,
            *self.date,
            self.valid,
            30,  # ns, accuracy of the time
            self.nano,
            self.fix,
            self.flags,
            0,
            self.satellites,
            self.longitude,
            self.latitude,
            self.height,
            self.height,
            self.horizontal,
            self.vertical,
            *self.velocity,
            ground,
            0,
            self.speed_accuracy,
            0,
            150,  # position's dilution of precision, 0.01
            0,
            0,
            0,
            0,
            0,
        )


def unpack_pvt(payload: bytes) -> Pvt:
    """Return the content of NAV-PVT; `payload` has its length."""
    values = _PVT.unpack(payload)
    (_, year, month, day, hour, minute, second, valid, _, nano, fix, flags, _, satellites) = values[:14]
    longitude, latitude, height, _, horizontal, vertical, north, east, down, _, _, accuracy = values[14:26]
    return Pvt(
        date=(year, month, day, hour, minute, second),
        nano=nano,
        valid=valid,
        fix=fix,
        flags=flags,
        satellites=satellites,
        longitude=longitude,
        latitude=latitude,
        height=height,
        horizontal=horizontal,
        vertical=vertical,
        velocity=(north, east, down),
        speed_accuracy=accuracy,
    )


def checksum(body: bytes) -> bytes:
    """Return the two check bytes over class, identifier, length and payload."""
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def frame(kind: Kind, payload: bytes = b"") -> bytes:
    """Return a whole frame."""
    body = bytes(kind) + len(payload).to_bytes(2, "little") + payload
    return SYNC + body + checksum(body)


class StreamParser:
    """Splits the line's bytes into frames; a false start costs two bytes, so good frames behind it are found.

    Attributes:
        bytes_received: all bytes fed. frames: with a valid checksum. bad_checksum: those without.
        discarded_bytes: bytes outside valid frames.
    """

    def __init__(self, longest: int = 256) -> None:
        """Take frames of at most `longest` bytes of payload."""
        self.bytes_received = 0
        self.frames = 0
        self.bad_checksum = 0
        self.discarded_bytes = 0
        self._longest = longest
        self._buffer = b""

    def feed(self, data: bytes) -> list[tuple[Kind, bytes, int]]:
        """Return the frames that `data` completes: kind, payload, and how many bytes stand behind it."""
        self.bytes_received += len(data)
        buffer, found, position = self._buffer + data, [], 0
        while True:
            start = buffer.find(SYNC, position)
            if start < 0:
                start = len(buffer) - buffer.endswith(SYNC[:1])
            self.discarded_bytes += start - position
            position = start
            if len(buffer) - start < OVERHEAD:
                break
            length = int.from_bytes(buffer[start + 4 : start + 6], "little")
            end = start + OVERHEAD + length
            if length <= self._longest and end > len(buffer):
                break
            body = buffer[start + 2 : end - 2]
            if length > self._longest or checksum(body) != buffer[end - 2 : end]:
                self.bad_checksum += 1
                self.discarded_bytes += len(SYNC)
                position = start + len(SYNC)
                continue
            self.frames += 1
            found.append(((body[0], body[1]), body[4:], len(buffer) - end))
            position = end
        self._buffer = buffer[position:]
        return found
