"""Transfer frames for telecommands (CCSDS 232.0-B-4) and telemetry (CCSDS 132.0-B-3), and frame streams.

A telecommand frame has a header of 5 bytes, one space packet and a CRC of 2 bytes. All telecommand frames are
of type BD (bypass, data), which the frame layer neither acknowledges nor retransmits, and have no segment
header. Telemetry frames have a fixed length and contain consecutive space packets. The telemetry frame header
of 6 bytes contains the first header pointer: the offset of the first packet that begins in the frame. After a
lost frame, the receiver finds the next packet by the first header pointer. An incomplete telemetry frame is
filled up with an idle packet. Telecommand and telemetry frames carry the security header and trailer of CCSDS
355.0-B (`flight.link.security`).

In a byte stream (serial line, TCP) each frame follows the attached sync marker 1ACFFC1D (CCSDS 131.0-B), in
both directions, unless another form of the stream is configured (`flight.link.coding`).
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from dataclasses import dataclass

from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, UNSEGMENTED, crc16
from knightcube.errors import KnightCubeError

TELECOMMAND_HEADER = struct.Struct(">HHB")
LONGEST_FRAME = 1024
TELECOMMAND_MASK = bytes((0, 0, 0xFC, 0, 0))
"""Telecommand header bits covered by the MAC: the virtual channel (CCSDS 355.0-B-2, 2.3.2.3.3)."""

_BYPASS = 1 << 13
_CHANNEL_BITS = 10


class FrameError(KnightCubeError):
    """Raised for bytes that are not a frame of this link. The error text states the reason."""


@dataclass(frozen=True, slots=True)
class TelecommandHeader:
    """Fields of a telecommand frame header that differ between frames."""

    spacecraft: int
    channel: int
    sequence: int

    def pack(self, length: int) -> bytes:
        """Return the header of a telecommand frame of `length` bytes."""
        second = self.channel << _CHANNEL_BITS | (length - 1)
        return TELECOMMAND_HEADER.pack(_BYPASS | self.spacecraft, second, self.sequence % 256)


def stated_length(header: bytes) -> int:
    """Return the frame length (bytes) that a telecommand frame header of 5 bytes states."""
    return (int.from_bytes(header[2:4], "big") & 0x3FF) + 1


def open_telecommand(frame: bytes, spacecraft: int) -> bytes:
    """Return a BD frame for this spacecraft without its CRC. Raises FrameError for any other frame."""
    if len(frame) < TELECOMMAND_HEADER.size + CRC_BYTES or stated_length(frame) != len(frame):
        raise FrameError("its length is wrong")
    first = int.from_bytes(frame[:2], "big")
    if first != _BYPASS | spacecraft:
        raise FrameError("the frame is for another spacecraft, or not of type BD")
    return frame[:-CRC_BYTES]


def close_frame(body: bytes) -> bytes:
    """Return a frame with its CRC appended."""
    return body + crc16(body).to_bytes(CRC_BYTES, "big")


TELEMETRY_HEADER = struct.Struct(">HBBH")
TELEMETRY_MASK = bytes((0, 0x0E, 0, 0, 0, 0))
"""Telemetry header bits covered by the MAC: the virtual channel (CCSDS 355.0-B-2, 2.3.2.3.3)."""

NO_HEADER = 0x7FF
"""First header pointer of a frame in which no packet begins."""

IDLE = 0x7FF
"""APID of idle packets."""

IDLE_CHANNEL = 7
"""Virtual channel of frames that contain only idle data."""
_ONLY_IDLE_DATA = 0x7FE  # first header pointer of a frame with only idle data

_COUNTS = 256  # modulus of a frame count

_STATUS = 0b11 << 11  # frame status field: segment length identifier 11, all flags zero
_LEAST_IDLE = HEADER_BYTES + 1

Seal = Callable[[bytes, bytes], bytes]
"""Function that returns the protected frame, without CRC, from a frame header and data."""


@dataclass(slots=True)
class MasterCount:
    """Master channel frame count, which counts the frames of all virtual channels."""

    value: int = 0


class TelemetryFramer:
    """Framer that packs the packets of one virtual channel into telemetry frames. Not thread-safe."""

    def __init__(
        self, spacecraft: int, channel: int, data_bytes: int, master: MasterCount, seal: Seal
    ) -> None:
        """Make frames that each contain `data_bytes` bytes of packets."""
        self._first = spacecraft << 4 | channel << 1
        self._room = data_bytes
        self._master, self._seal = master, seal
        self._count = 0
        self._data = bytearray()
        self._starts: list[int] = []  # offsets of the waiting packets in `_data`

    @property
    def waits(self) -> bool:
        """Whether an incomplete frame contains data."""
        return bool(self._data)

    def add(self, packet: bytes) -> list[bytes]:
        """Add a packet and return the frames that it completes. If `seal` fails, the packet is kept."""
        self._starts.append(len(self._data))
        self._data += packet
        return self.take()

    def take(self) -> list[bytes]:
        """Return the completed frames that can be protected; there are none unless `seal` failed before.

        Raises the error of `seal` if there are completed frames and none can be protected.
        """
        made: list[bytes] = []
        while len(self._data) >= self._room:
            try:
                made.append(self._take())
            except KnightCubeError:
                if not made:
                    raise
                break
        return made

    def flush(self) -> list[bytes]:
        """Fill the current frame with an idle packet and return the completed frames."""
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


class IdleFramer:
    """Framer of idle frames, which keep the carrier of a radio modulated and need no protection."""

    def __init__(self, spacecraft: int, frame_bytes: int, master: MasterCount, fill: bytes) -> None:
        """Make frames of `frame_bytes` bytes, whose data are the first bytes of `fill`."""
        self._first = spacecraft << 4 | IDLE_CHANNEL << 1
        self._fill = fill[: frame_bytes - TELEMETRY_HEADER.size - CRC_BYTES]
        self._master = master
        self._count = 0

    def frame(self) -> bytes:
        """Return the next frame."""
        status = _STATUS | _ONLY_IDLE_DATA
        header = TELEMETRY_HEADER.pack(self._first, self._master.value, self._count, status)
        self._master.value = (self._master.value + 1) % _COUNTS
        self._count = (self._count + 1) % _COUNTS
        return close_frame(header + self._fill)


def is_idle(frame: bytes) -> bool:
    """Return whether a telemetry frame has a correct CRC and contains only idle data."""
    if len(frame) < TELEMETRY_HEADER.size or crc16(frame) != 0:
        return False
    first, status = int.from_bytes(frame[:2], "big"), int.from_bytes(frame[4:6], "big")
    return first >> 1 & 7 == IDLE_CHANNEL and status & NO_HEADER == _ONLY_IDLE_DATA


def idle_packet(length: int) -> bytes:
    """Return an idle packet of `length` bytes. The minimum length is 7 bytes."""
    size = length - HEADER_BYTES
    return struct.pack(">HHH", IDLE, UNSEGMENTED, size - 1) + bytes(size)


class PacketAssembler:
    """Decoder that extracts the packets of one virtual channel from telemetry frames.

    The frame count in a frame header has only 8 bits, and neither it nor the first header pointer is
    authenticated. A packet is therefore continued in the next frame only if three conditions hold: the frame
    counts are consecutive, the authenticated counters exclude a loss of 256 frames, and the first header
    pointer agrees with the length of the packet.
    """

    def __init__(self) -> None:
        self._count: int | None = None
        self._missing = 0
        self._rest: bytes | None = None  # received bytes of an incomplete packet

    def add(self, header: bytes, data: bytes, missing: int = 0) -> list[bytes]:
        """Return the packets that end in a frame, except idle packets.

        After lost frames, a packet that began before or in the lost frames is discarded, and decoding
        continues at the first header pointer. According to the authenticated counters, `missing` frames of
        all virtual channels were lost since the link was opened.
        """
        _, _, count, status = TELEMETRY_HEADER.unpack(header)
        if self._count != (count - 1) % _COUNTS or missing - self._missing >= _COUNTS:
            self._rest = None
        self._count, self._missing = count, missing
        pointer = status & NO_HEADER
        if self._rest is not None:
            joined, begun = self._rest + data, len(self._rest)
            starts = _packet_starts(joined)
            first = next((start - begun for start in starts if begun <= start < len(joined)), NO_HEADER)
            if first == pointer:
                return self._split(joined, starts)
        if pointer >= len(data):
            self._rest = None
            return []
        return self._split(data[pointer:], _packet_starts(data[pointer:]))

    def _split(self, data: bytes, starts: list[int]) -> list[bytes]:
        """Return the complete packets in `data`, which begin at the offsets `starts`, and keep the rest."""
        self._rest = data[starts[-1] :]
        packets = [data[begin:end] for begin, end in itertools.pairwise(starts)]
        return [packet for packet in packets if int.from_bytes(packet[:2], "big") & IDLE != IDLE]


def _packet_starts(data: bytes) -> list[int]:
    """Return the offset of each packet in `data`. The last offset is the start of the incomplete packet."""
    starts = [0]
    while (begin := starts[-1]) + HEADER_BYTES <= len(data):
        end = begin + HEADER_BYTES + 1 + int.from_bytes(data[begin + 4 : begin + 6], "big")
        if end > len(data):
            break
        starts.append(end)
    return starts


def open_telemetry(frame: bytes, spacecraft: int) -> tuple[bytes, bytes, int]:
    """Return header, protected data and virtual channel of a telemetry frame.

    Raises FrameError for a frame that is too short, or that belongs to another spacecraft.
    """
    if len(frame) < TELEMETRY_HEADER.size + CRC_BYTES:
        raise FrameError("its length is wrong")
    (first,) = struct.unpack_from(">H", frame)
    if first >> 4 != spacecraft:
        raise FrameError("it is for another spacecraft")
    return frame[: TELEMETRY_HEADER.size], frame[TELEMETRY_HEADER.size : -CRC_BYTES], first >> 1 & 7


SYNC = bytes.fromhex("1ACFFC1D")


class FrameStream:
    """Decoder that extracts frames from a byte stream by their sync markers. Not thread-safe."""

    def __init__(
        self,
        length_of: Callable[[bytes], int],
        header_bytes: int,
        decode: Callable[[bytes], bytes] = bytes,
        wrong_bits: int = 0,
    ) -> None:
        """Find frames in a byte stream.

        The function `length_of` returns the length (bytes) of a frame from its header of `header_bytes`
        bytes, and `decode` returns the frame in the bytes after a sync marker. A sync marker directly after a
        valid frame may have up to `wrong_bits` wrong bits.
        """
        self._length_of, self._header_bytes, self._decode = length_of, header_bytes, decode
        self._wrong_bits = wrong_bits
        self._follows = False  # whether the data follow directly after a frame with a correct CRC
        self._data = b""

    def add(self, data: bytes) -> list[bytes]:
        """Add received bytes and return the frames that are now complete, including frames with a wrong CRC.

        If the CRC of a frame is wrong, the search for the next sync marker continues inside that frame.
        """
        self._data += data
        found: list[bytes] = []
        while (mark := self._mark()) >= 0:
            begin = mark + len(SYNC)
            header = self._data[begin : begin + self._header_bytes]
            whole = len(header) == self._header_bytes
            end = begin + self._length_of(header) if whole else 0
            if not whole or end > len(self._data):
                self._data = self._data[mark:]
                return found
            frame = self._decode(self._data[begin:end])
            found.append(frame)
            self._follows = crc16(frame) == 0
            self._data = self._data[end if self._follows else begin :]
        if not self._follows:
            self._data = self._data[1 - len(SYNC) :]
        return found

    def _mark(self) -> int:
        """Return the offset of the next sync marker, -1 if there is none in the received data."""
        if self._follows and self._wrong_bits:
            if len(self._data) < len(SYNC):
                return -1
            wrong = int.from_bytes(self._data[: len(SYNC)], "big") ^ int.from_bytes(SYNC, "big")
            if wrong.bit_count() <= self._wrong_bits:
                return 0
        self._follows = False
        return self._data.find(SYNC)


def telecommand_stream() -> FrameStream:
    """Return a decoder of telecommand frames, whose headers state the frame length."""
    return FrameStream(stated_length, TELECOMMAND_HEADER.size)
