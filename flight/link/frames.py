"""Transfer frames of telecommands (CCSDS 232.0-B-4) and telemetry (132.0-B-3), and streams of frames.

A telecommand frame has a header of 5 bytes, one space packet and a CRC of 2 bytes. All telecommand frames are
of type BD (bypass, data), which the frame layer neither acknowledges nor retransmits; there is no segment
header. Telemetry frames have a fixed length and contain space packets end to end. Their header of 6 bytes
contains the first header pointer, the offset of the first packet that begins in the frame, by which a reader
finds the next packet after a lost frame. Gaps are filled with idle packets. Both kinds carry the security
header and trailer of CCSDS 355.0-B (`flight.link.security`).

In a stream of bytes (serial line, TCP) each frame follows an attached sync marker (CCSDS 131.0-B), 1ACFFC1D
in both directions. A radio that transmits CLTUs must create them itself.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, UNSEGMENTED, crc16
from knightcube.errors import FlightError

TELECOMMAND_HEADER = struct.Struct(">HHB")
LONGEST_FRAME = 1024
TELECOMMAND_MASK = bytes((0, 0, 0xFC, 0, 0))
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
        return TELECOMMAND_HEADER.pack(_BYPASS | self.spacecraft, second, self.sequence % 256)


def stated_length(header: bytes) -> int:
    """Return the length (bytes) of a frame from its header of 5 bytes."""
    return (int.from_bytes(header[2:4], "big") & 0x3FF) + 1


def open_telecommand(frame: bytes, spacecraft: int) -> bytes:
    """Return a frame without its CRC. Raises FrameError for another spacecraft and for invalid frames."""
    if len(frame) < TELECOMMAND_HEADER.size + CRC_BYTES or stated_length(frame) != len(frame):
        raise FrameError("its length is wrong")
    first = int.from_bytes(frame[:2], "big")
    if first != _BYPASS | spacecraft:
        raise FrameError("it is for another spacecraft, or of another type than BD")
    return frame[:-CRC_BYTES]


def close_frame(body: bytes) -> bytes:
    """Return a frame with its CRC."""
    return body + crc16(body).to_bytes(CRC_BYTES, "big")


TELEMETRY_HEADER = struct.Struct(">HBBH")
TELEMETRY_MASK = bytes((0, 0x0E, 0, 0, 0, 0))
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
        header = TELEMETRY_HEADER.pack(self._first, self._master.value, self._count, _STATUS | pointer)
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
        _, _, count, status = TELEMETRY_HEADER.unpack(header)
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


def open_telemetry(frame: bytes, spacecraft: int) -> tuple[bytes, bytes, int]:
    """Return header, protected rest and virtual channel of a frame. Raises FrameError."""
    if len(frame) < TELEMETRY_HEADER.size + CRC_BYTES:
        raise FrameError("its length is wrong")
    (first,) = struct.unpack_from(">H", frame)
    if first >> 4 != spacecraft:
        raise FrameError("it is another spacecraft's")
    return frame[: TELEMETRY_HEADER.size], frame[TELEMETRY_HEADER.size : -CRC_BYTES], first >> 1 & 7


SYNC = bytes.fromhex("1ACFFC1D")


class FrameStream:
    """Finds the frames in received bytes. Not thread-safe."""

    def __init__(self, length_of: Callable[[bytes], int], header_bytes: int) -> None:
        """Find frames whose length (bytes) `length_of` computes from their first `header_bytes` bytes."""
        self._length_of = length_of
        self._header_bytes = header_bytes
        self._data = b""

    def add(self, data: bytes) -> list[bytes]:
        """Return the frames that end in `data`, including frames with a wrong CRC.

        After a wrong CRC the search continues inside that frame.
        """
        self._data += data
        found: list[bytes] = []
        while (mark := self._data.find(SYNC)) >= 0:
            begin = mark + len(SYNC)
            header = self._data[begin : begin + self._header_bytes]
            whole = len(header) == self._header_bytes
            end = begin + self._length_of(header) if whole else 0
            if not whole or end > len(self._data):
                self._data = self._data[mark:]
                return found
            frame = self._data[begin:end]
            found.append(frame)
            self._data = self._data[end if crc16(frame) == 0 else begin :]
        self._data = self._data[1 - len(SYNC) :]
        return found


def telecommand_stream() -> FrameStream:
    """Return a stream of telecommand frames, whose header states their length."""
    return FrameStream(stated_length, TELECOMMAND_HEADER.size)


def telemetry_stream(frame_bytes: int) -> FrameStream:
    """Return a stream of telemetry frames of `frame_bytes` bytes."""
    return FrameStream(lambda _: frame_bytes, 0)
