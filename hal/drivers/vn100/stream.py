"""Parses the bytes of the line into packets and sentences; resynchronises after any garbage.

A false candidate costs one byte only, so a good packet behind or inside a broken one is still found. Work and
memory are bounded: a candidate is at most `longest` bytes.
"""

from __future__ import annotations

import re

from hal.drivers.vn100.ascii import AsciiLine, parse
from hal.drivers.vn100.codec import HEADER_LENGTHS, SYNC, BinaryPacket, crc16, layout_of_header

LONGEST_LINE = 256  # the unit's own receive buffer; its longest answer (register 83) has about 100

_START = re.compile(rb"[\xfa$]")
# A `$` inside ends the candidate, so that a cut line cannot swallow the next one.
_LINE = re.compile(rb"\$VN[\x20-\x23\x25-\x7e]{0,%d}\r?\n" % (LONGEST_LINE - 5))
_LINE_BEGUN = re.compile(rb"\$(?:V(?:N[\x20-\x23\x25-\x7e]{0,%d}\r?)?)?" % (LONGEST_LINE - 5))

_LONG_AGO_NS = -(1 << 62)
_FALSE = 0
_INCOMPLETE = -1


class StreamParser:
    """Splits the line's bytes into binary packets and ASCII lines, and counts the rest.

    Attributes:
        bytes_received: all bytes fed.
        packets: packets and lines with a valid checksum.
        bad_checksum: complete packets and lines whose checksum failed.
        discarded_bytes: bytes outside valid packets and lines.
    """

    def __init__(self, byte_ns: float = 0.0, longest: int = 512) -> None:
        """Parse with `byte_ns`, the time of a byte on the wire, and packets of at most `longest` bytes.

        A small `longest` prevents a false start in noise from delaying the next good packet.
        """
        self.byte_ns = byte_ns
        self.bytes_received = 0
        self.packets = 0
        self.bad_checksum = 0
        self.discarded_bytes = 0
        self._longest = longest
        self._buffer = bytearray()
        self._previous_ns = _LONG_AGO_NS

    def feed(self, arrival_ns: int, data: bytes) -> list[BinaryPacket | AsciiLine]:
        """Accept a chunk whose last byte arrived at `arrival_ns`; return what it completed, oldest first.

        An item that ends inside the chunk arrived earlier by the bytes behind it, but not before the
        previous chunk.
        """
        self.bytes_received += len(data)
        buffer = self._buffer
        buffer += data
        found: list[BinaryPacket | AsciiLine] = []
        position, end = 0, len(buffer)
        while position < end:
            start = _START.search(buffer, position)
            if start is None:
                self.discarded_bytes += end - position
                position = end
                break
            self.discarded_bytes += start.start() - position
            position = start.start()
            span = self._span(position)
            if span == _INCOMPLETE:
                break
            item = None
            if span != _FALSE:
                early_ns = round((end - position - span) * self.byte_ns)
                item = self._decode(position, span, max(self._previous_ns, arrival_ns - early_ns))
            if item is None:
                self.discarded_bytes += 1
                position += 1
            else:
                self.packets += 1
                found.append(item)
                position += span
        del buffer[:position]
        self._previous_ns = arrival_ns
        return found

    def _span(self, position: int) -> int:
        """Return the length of the candidate at `position`, or _FALSE, or _INCOMPLETE."""
        if self._buffer[position] == SYNC:
            return self._packet_span(position)
        line = _LINE.match(self._buffer, position)
        if line is not None:
            return line.end() - position
        return _INCOMPLETE if _LINE_BEGUN.fullmatch(self._buffer, position) else _FALSE

    def _packet_span(self, position: int) -> int:
        buffer = self._buffer
        left = len(buffer) - position
        if left < 2:
            return _INCOMPLETE
        header_length = HEADER_LENGTHS[buffer[position + 1]]
        if header_length and left < 1 + header_length:
            return _INCOMPLETE
        layout = layout_of_header(bytes(buffer[position + 1 : position + 1 + header_length]))
        if layout is None or layout.length > self._longest:
            return _FALSE
        return layout.length if left >= layout.length else _INCOMPLETE

    def _decode(self, position: int, span: int, arrival_ns: int) -> BinaryPacket | AsciiLine | None:
        raw = bytes(self._buffer[position : position + span])
        if raw[0] != SYNC:
            sentence = parse(raw)
            if sentence is not None:
                return AsciiLine(arrival_ns, span, sentence)
        # The CRC over a valid packet including its checksum is zero.
        elif crc16(raw[1:]) == 0:
            header = raw[1 : 1 + HEADER_LENGTHS[raw[1]]]
            layout = layout_of_header(header)
            if layout is not None:
                return BinaryPacket(arrival_ns, layout, layout.payload.unpack_from(raw, 1 + len(header)))
        self.bad_checksum += 1
        return None
