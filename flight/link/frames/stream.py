"""Frames in a stream of bytes (serial line, TCP), each after an attached sync marker (CCSDS 131.0-B).

Both directions use the telemetry marker 1ACFFC1D. A radio that transmits CLTUs must create them itself.
"""

from __future__ import annotations

from collections.abc import Callable

from flight.link.frames import telecommand
from flight.link.telemetry.packets import crc16

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
    return FrameStream(telecommand.stated_length, telecommand.HEADER.size)


def telemetry_stream(frame_bytes: int) -> FrameStream:
    """Return a stream of telemetry frames of `frame_bytes` bytes."""
    return FrameStream(lambda _: frame_bytes, 0)
