"""Telemetry transfer frames of fixed length, CCSDS 132.0-B-3: space packets laid end to end.

The header of 6 bytes contains the first header pointer, the offset of the first packet that begins in the
frame. A reader that lost a frame finds the next packet by it. Gaps are filled with idle packets. Frames are
protected as in `flight.link.security.associations`; there is no operational control field.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from flight.link.frames.telecommand import FrameError, close_frame
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, UNSEGMENTED

HEADER = struct.Struct(">HBBH")
AUTHENTICATED = bytes((0, 0x0E, 0, 0, 0, 0))
"""Bits of the header that the MAC covers, those of the virtual channel (355.0-B-2, 2.3.2.3.3)."""

NO_HEADER = 0x7FF
"""First header pointer of a frame in which no packet begins."""

IDLE = 0x7FF
"""APID of idle packets."""

_STATUS = 0b11 << 11  # segment length identifier of packets, all flags zero
_LEAST_IDLE = HEADER_BYTES + 1

Seal = Callable[[bytes, bytes], bytes]
"""Function from header and data to the protected frame without CRC."""


@dataclass(slots=True)
class MasterCount:
    """Master channel frame count: the count of frames of all virtual channels."""

    value: int = 0


class TelemetryFramer:
    """Packs the packets of one virtual channel into frames. Not thread-safe."""

    def __init__(
        self, spacecraft: int, channel: int, data_bytes: int, master: MasterCount, seal: Seal
    ) -> None:
        """Make frames with `data_bytes` bytes of packets each."""
        self._first = spacecraft << 4 | channel << 1
        self._room = data_bytes
        self._master = master
        self._seal = seal
        self._count = 0
        self._data = bytearray()
        self._starts: list[int] = []  # of packets, in _data

    @property
    def waits(self) -> bool:
        """Whether packets wait for a frame to fill up."""
        return bool(self._data)

    def add(self, packet: bytes) -> list[bytes]:
        """Add a packet and return the frames that are full."""
        self._starts.append(len(self._data))
        self._data += packet
        return [self._take() for _ in range(len(self._data) // self._room)]

    def flush(self) -> list[bytes]:
        """Fill up the frame with an idle packet and return the full frames."""
        gap = self._room - len(self._data) % self._room
        length = gap if gap >= _LEAST_IDLE else gap + self._room
        return self.add(idle_packet(length))

    def _take(self) -> bytes:
        pointer = self._starts[0] if self._starts and self._starts[0] < self._room else NO_HEADER
        header = HEADER.pack(self._first, self._master.value, self._count, _STATUS | pointer)
        frame = close_frame(self._seal(header, bytes(self._data[: self._room])))
        del self._data[: self._room]
        self._starts = [start - self._room for start in self._starts if start >= self._room]
        self._master.value = (self._master.value + 1) % 256
        self._count = (self._count + 1) % 256
        return frame


def idle_packet(length: int) -> bytes:
    """Return an idle packet of `length` bytes, at least 7."""
    size = length - HEADER_BYTES
    return struct.pack(">HHH", IDLE, UNSEGMENTED, size - 1) + bytes(size)


class PacketAssembler:
    """Finds the packets of one virtual channel in the data of its frames."""

    def __init__(self) -> None:
        self._count: int | None = None
        self._rest: bytes | None = None  # begin of an incomplete packet; None until a packet begins
        self.lost_frames = 0

    def add(self, header: bytes, data: bytes) -> list[bytes]:
        """Return the packets that end in a frame, without idle packets.

        A gap in the frame count loses the packets that continue across the gap.
        """
        _, _, count, status = HEADER.unpack(header)
        if self._count is not None and (gap := (count - self._count - 1) % 256):
            self.lost_frames += gap
            self._rest = None
        self._count = count
        pointer = status & NO_HEADER
        if self._rest is None:
            if pointer >= len(data):
                return []
            data = data[pointer:]
            self._rest = b""
        return self._split(self._rest + data)

    def _split(self, data: bytes) -> list[bytes]:
        found, begin = [], 0
        while begin + HEADER_BYTES <= len(data):
            end = begin + HEADER_BYTES + 1 + int.from_bytes(data[begin + 4 : begin + 6], "big")
            if end > len(data):
                break
            if int.from_bytes(data[begin : begin + 2], "big") & NO_HEADER != IDLE:
                found.append(data[begin:end])
            begin = end
        self._rest = data[begin:]
        return found


def open_frame(frame: bytes, spacecraft: int) -> tuple[bytes, bytes, int]:
    """Return header, protected rest and virtual channel of a frame. Raises FrameError."""
    if len(frame) < HEADER.size + CRC_BYTES:
        raise FrameError("its length is wrong")
    (first,) = struct.unpack_from(">H", frame)
    if first >> 4 != spacecraft:
        raise FrameError("it is another spacecraft's")
    return frame[: HEADER.size], frame[HEADER.size : -CRC_BYTES], first >> 1 & 7
