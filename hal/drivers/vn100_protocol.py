"""VN-100 protocol: binary packets, ASCII sentences, and a decoder of the byte stream.

A binary packet consists of the sync byte FA, a group byte, a 16-bit word of field bits per group, the payload
and a CRC (VectorNav UM001 v2.43, section 4.3). Words and payload are little-endian, the CRC is big-endian.
The CRC is CRC-16/XMODEM over the bytes between the sync byte and the CRC. The quantities have the units of
the device: gauss, degrees, m/s^2, rad/s and ns.

An ASCII sentence consists of `$VNxxx,field,...*checksum` and a line end (VectorNav UM001 v2.43, section 4.2).
The checksum covers the bytes between `$` and `*`, excluding both. A checksum of two hexadecimal digits is the
XOR of the bytes, and a checksum of four digits is a CRC-16/XMODEM. The unit also accepts `XX` instead of a
checksum. The remark on polynomial 0x07 in section 4.2 of the manual is wrong.

`StreamParser` finds valid packets after or inside corrupted data, because the search continues one byte after
an invalid candidate. The computing time and memory of `StreamParser` are limited by the length of the longest
possible packet.

Packets with unknown fields, such as those of satellite navigation or of firmware 3, have an unknown length.
`StreamParser` counts a packet with unknown fields if the bytes up to the next packet with the same header
have a valid CRC. A packet with unknown fields shows that the baud rate is correct.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache, reduce
from operator import xor
from typing import Literal

SYNC = 0xFA

# Each table lists the names and struct codes of a group's fields. The GNSS groups 4 and 7 are omitted.
_COMMON = (
    ("time_startup", "Q"), ("time_gps", "Q"), ("time_sync_in", "Q"), ("yaw_pitch_roll", "3f"),
    ("quaternion", "4f"), ("angular_rate", "3f"), ("position", "3d"), ("velocity", "3f"),
    ("accel", "3f"), ("imu", "6f"), ("mag_pres", "5f"), ("delta_theta_vel", "7f"),
    ("status", "H"), ("sync_in_count", "I"), ("time_gps_pps", "Q"),
)  # fmt: skip
_TIME = (
    ("time_startup", "Q"), ("time_gps", "Q"), ("gps_tow", "Q"), ("gps_week", "H"), ("time_sync_in", "Q"),
    ("time_gps_pps", "Q"), ("time_utc", "8s"), ("sync_in_count", "I"), ("sync_out_count", "I"),
    ("time_status", "B"),
)  # fmt: skip
_IMU = (
    ("imu_status", "H"), ("uncomp_mag", "3f"), ("uncomp_accel", "3f"), ("uncomp_gyro", "3f"), ("temp", "f"),
    ("pres", "f"), ("delta_theta", "4f"), ("delta_vel", "3f"), ("mag", "3f"), ("accel", "3f"),
    ("angular_rate", "3f"), ("sens_sat", "H"),
)  # fmt: skip
_ATTITUDE = (
    ("vpe_status", "H"), ("yaw_pitch_roll", "3f"), ("quaternion", "4f"), ("dcm", "9f"), ("mag_ned", "3f"),
    ("accel_ned", "3f"), ("linear_accel_body", "3f"), ("linear_accel_ned", "3f"), ("ypr_uncertainty", "3f"),
    ("reserved_9", "12s"), ("reserved_10", "28s"), ("reserved_11", "24s"), ("heave", "3f"),
    ("attitude_uncertainty", "f"),
)  # fmt: skip
_INS = (
    ("ins_status", "H"), ("position_lla", "3d"), ("position_ecef", "3d"), ("velocity_body", "3f"),
    ("velocity_ned", "3f"), ("velocity_ecef", "3f"), ("mag_ecef", "3f"), ("accel_ecef", "3f"),
    ("linear_accel_ecef", "3f"), ("position_uncertainty", "f"), ("velocity_uncertainty", "f"),
    ("reserved_11", "68s"), ("reserved_12", "64s"),
)  # fmt: skip

# Tables of the fields of each group, by the bit of the group in the group byte.
FIELDS: Mapping[int, tuple[tuple[str, str], ...]] = {0: _COMMON, 1: _TIME, 2: _IMU, 4: _ATTITUDE, 5: _INS}
GROUP_NAMES: Mapping[int, str] = {0: "common", 1: "time", 2: "imu", 4: "attitude", 5: "ins"}

Value = float | bytes


@dataclass(frozen=True, slots=True)
class OutputLayout:
    """Layout of binary packets with a given set of output fields.

    Attributes:
        header: bytes after the sync byte, which are group byte and field words.
        fields: group bit and field bit of each field, in the order of the payload.
        places: slice of the field's values in the unpacked payload, by field name "group.name".
        payload: struct format of the payload.
        length: length of the whole packet, from sync byte to CRC, bytes.
    """

    header: bytes
    fields: tuple[tuple[int, int], ...]
    places: Mapping[str, slice]
    payload: struct.Struct
    length: int

    def pack(self, values: Iterable[Value]) -> bytes:
        """Return the packet with the given payload values, listed in the order of the fields."""
        body = self.header + self.payload.pack(*values)
        return b"".join((b"\xfa", body, crc16(body).to_bytes(2, "big")))


@dataclass(frozen=True, slots=True)
class BinaryPacket:
    """Received binary packet with a valid checksum, and the host time of its last byte."""

    arrival_ns: int
    layout: OutputLayout
    values: tuple[Value, ...]

    def __getitem__(self, field: str) -> tuple[Value, ...]:
        """Return the values of the field "group.name". Raises KeyError if the packet lacks the field."""
        return self.values[self.layout.places[field]]


def crc16(data: bytes | bytearray) -> int:
    """Return the CRC-16/XMODEM of `data` (polynomial 0x1021, initial value 0)."""
    return crc_hqx(data, 0)


def layout_of(words: Mapping[int, int]) -> OutputLayout:
    """Return the packet layout for a mapping from group bits to field masks, such as {0: 0x0131, 2: 0x0100}.

    Raises ValueError for an unknown group or field.
    """
    groups = sum(1 << bit for bit in words)
    header = struct.pack(f"<B{len(words)}H", groups, *(words[bit] for bit in sorted(words)))
    layout = layout_of_header(header)
    if layout is None:
        raise ValueError(f"no VN-100 output set has the field words {dict(words)}")
    return layout


def header_length(group_byte: int) -> int:
    """Return the length (bytes) of group byte and field words, or 0 for an unsupported group byte."""
    if group_byte == 0 or any(group_byte >> bit & 1 and bit not in FIELDS for bit in range(8)):
        return 0
    return 1 + 2 * group_byte.bit_count()


@lru_cache(maxsize=256)
def layout_of_header(header: bytes) -> OutputLayout | None:
    """Return the packet layout for a header (group byte, field words), or None for an invalid header."""
    if not header:
        return None
    bits = [bit for bit in range(8) if header[0] >> bit & 1]
    words = struct.unpack(f"<{len(bits)}H", header[1:])
    fields: list[tuple[int, int]] = []
    places: dict[str, slice] = {}
    codes = "<"
    start = 0
    for group, word in zip(bits, words, strict=True):
        table = FIELDS.get(group)
        if table is None or word == 0 or word >> len(table):
            return None
        for bit, (name, code) in enumerate(table):
            if word >> bit & 1:
                count = len(struct.unpack(f"<{code}", bytes(struct.calcsize(f"<{code}"))))
                fields.append((group, bit))
                places[f"{GROUP_NAMES[group]}.{name}"] = slice(start, start + count)
                start += count
                codes += code
    payload = struct.Struct(codes)
    return OutputLayout(header, tuple(fields), places, payload, 1 + len(header) + payload.size + 2)


HEADER_LENGTHS: tuple[int, ...] = tuple(header_length(byte) for byte in range(256))


Checksum = Literal["xor8", "crc16", "none"]

ERRORS = {
    0x01: "hard fault", 0x02: "serial buffer overflow", 0x03: "invalid checksum", 0x04: "invalid command",
    0x05: "not enough parameters", 0x06: "too many parameters", 0x07: "invalid parameter",
    0x08: "invalid register", 0x09: "unauthorized access", 0x0A: "watchdog reset",
    0x0B: "output buffer overflow", 0x0C: "insufficient baud rate", 0xFF: "error buffer overflow",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Sentence:
    """ASCII sentence: command name after `$VN`, such as "QMR", text fields, and type of the checksum."""

    command: str
    fields: tuple[str, ...]
    checksum: Checksum


@dataclass(frozen=True, slots=True)
class AsciiLine:
    """Received ASCII sentence with a valid checksum, the host time of its last byte, and its length."""

    arrival_ns: int
    length: int
    sentence: Sentence


@dataclass(frozen=True, slots=True)
class Measurement:
    """Measured values in an asynchronous VNQMR or VNYMR line.

    Attributes:
        attitude: quaternion (q0, q1, q2, q3), scalar last, or yaw, pitch and roll, deg.
        mag: magnetic field, gauss.
        accel: acceleration, m/s^2.
        gyro: angular rate, rad/s.
    """

    attitude: tuple[float, ...]
    mag: tuple[float, float, float]
    accel: tuple[float, float, float]
    gyro: tuple[float, float, float]


def xor8(data: bytes) -> int:
    """Return the XOR of all bytes."""
    return reduce(xor, data, 0)


def build(command: str, *fields: object, checksum: Checksum = "crc16") -> bytes:
    """Return the line `$VN<command>,<fields>*<checksum>` with a line end."""
    body = ",".join(("VN" + command, *map(str, fields))).encode("ascii")
    digits = "XX"
    if checksum != "none":
        digits = f"{xor8(body):02X}" if checksum == "xor8" else f"{crc16(body):04X}"
    return b"$%b*%b\r\n" % (body, digits.encode("ascii"))


def parse(line: bytes, *, allow_none: bool = False) -> Sentence | None:
    """Return the sentence in a line, or None if the line is not a sentence or has a wrong checksum.

    The placeholder `XX` instead of a checksum is accepted only if `allow_none` is true. A unit never sends
    `XX`.
    """
    text = line.rstrip(b"\r\n")
    body, star, digits = text[1:].partition(b"*")  # a valid sentence contains exactly one `*`
    if not (text.startswith(b"$VN") and star and body.isascii() and len(body) >= 5):
        return None
    checksum = _verify(body, digits, allow_none)
    if checksum is None:
        return None
    command, *fields = body.decode("ascii").split(",")
    return Sentence(command[2:], tuple(fields), checksum)


def _verify(body: bytes, digits: bytes, allow_none: bool) -> Checksum | None:
    if allow_none and digits == b"XX":
        return "none"
    # The function int() also accepts signs, underscores and blanks, which isalnum() excludes.
    if len(digits) not in {2, 4} or not digits.isalnum():
        return None
    try:
        value = int(digits, 16)
    except ValueError:
        return None
    if len(digits) == 2:
        return "xor8" if value == xor8(body) else None
    return "crc16" if value == crc16(body) else None


def measurement(sentence: Sentence) -> Measurement | None:
    """Return the values of a VNQMR or VNYMR sentence, or None for other sentences or invalid numbers.

    Trailing fields that begin with T or S (count and status, see register 30) are ignored. NaN and infinite
    values are returned, because the driver rejects them.
    """
    heads = {"QMR": 4, "YMR": 3}.get(sentence.command)
    if heads is None or len(sentence.fields) < heads + 9:
        return None
    if any(not extra.startswith(("T", "S")) for extra in sentence.fields[heads + 9 :]):
        return None
    try:
        values = tuple(map(float, sentence.fields[: heads + 9]))
    except ValueError:
        return None
    m, a, g = values[heads : heads + 3], values[heads + 3 : heads + 6], values[heads + 6 :]
    return Measurement(values[:heads], (m[0], m[1], m[2]), (a[0], a[1], a[2]), (g[0], g[1], g[2]))


def error_meaning(sentence: Sentence) -> tuple[int, str] | None:
    """Return the code and meaning of a `$VNERR` sentence, or None for other sentences.

    The code is -1 if the sentence does not contain a valid hexadecimal code.
    """
    if sentence.command != "ERR":
        return None
    try:
        code = int(sentence.fields[0], 16)
    except (IndexError, ValueError):
        return -1, "an unreadable error"
    return code, ERRORS.get(code, "an undocumented error")


LONGEST_LINE = 256  # size of the unit's receive buffer (bytes); its longest answer has about 100 bytes

_START = re.compile(rb"[\xfa$]")
# The patterns exclude `$` within a line, so that the line after a truncated line is found.
_LINE = re.compile(rb"\$VN[\x20-\x23\x25-\x7e]{0,%d}\r?\n" % (LONGEST_LINE - 5))
_LINE_BEGUN = re.compile(rb"\$(?:V(?:N[\x20-\x23\x25-\x7e]{0,%d}\r?)?)?" % (LONGEST_LINE - 5))

_FOREIGN_HEADER, _FOREIGN_LONGEST = 4, 600
"""Number of header bytes that are compared, and maximum length (bytes), for packets with unknown fields."""

_LONG_AGO_NS = -(1 << 62)
_FALSE = 0
_INCOMPLETE = -1


class StreamParser:
    """Decoder that extracts binary packets and ASCII lines from received bytes.

    Attributes:
        bytes_received: number of received bytes.
        packets: number of packets and lines with a valid checksum.
        bad_checksum: number of complete packets and lines with a wrong checksum.
        discarded_bytes: number of bytes outside valid packets and lines.
        foreign: number of packets with unknown fields and a valid checksum among the discarded bytes.
    """

    def __init__(self, byte_ns: float = 0.0, longest: int = 512) -> None:
        """Prepare the decoder for packets of at most `longest` bytes; the line sends a byte in `byte_ns`.

        A small value of `longest` limits the delay of a valid packet that follows noise which resembles the
        start of a packet.
        """
        self.byte_ns = byte_ns
        self.bytes_received = 0
        self.packets = 0
        self.bad_checksum = 0
        self.discarded_bytes = 0
        self.foreign = 0
        self._unknown = bytearray()
        self._longest = longest
        self._buffer = bytearray()
        self._previous_ns = _LONG_AGO_NS

    def feed(self, arrival_ns: int, data: bytes) -> list[BinaryPacket | AsciiLine]:
        """Return the packets and lines that are completed by `data`, whose last byte arrived at `arrival_ns`.

        The arrival time of a packet or line is corrected for the transmission time of the bytes that follow
        it in `data`, but is never earlier than the arrival of the previous data.
        """
        self.bytes_received += len(data)
        buffer = self._buffer
        buffer += data
        found: list[BinaryPacket | AsciiLine] = []
        position, end = 0, len(buffer)
        while position < end:
            start = _START.search(buffer, position)
            begin = end if start is None else start.start()
            if begin > position:
                self._discard(position, begin)
                position = begin
            if start is None:
                break
            span = self._span(position)
            if span == _INCOMPLETE:
                break
            item = None
            if span != _FALSE:
                early_ns = round((end - position - span) * self.byte_ns)
                item = self._decode(position, span, max(self._previous_ns, arrival_ns - early_ns))
            if item is None:
                self._discard(position, position + 1)
                position += 1
            else:
                self.packets += 1
                found.append(item)
                position += span
        del buffer[:position]
        self._previous_ns = arrival_ns
        if self._unknown:
            self._count_foreign()
        return found

    def _discard(self, begin: int, end: int) -> None:
        """Count the bytes from offset `begin` to `end`, and keep them for the search for unknown packets."""
        self.discarded_bytes += end - begin
        self._unknown += self._buffer[begin:end]

    def _count_foreign(self) -> None:
        """Count the packets with unknown fields, whose length is unknown.

        Such a packet is assumed to end where its header occurs again.
        """
        unknown, start, pending = self._unknown, self._unknown.find(SYNC), -1
        while 0 <= start < len(unknown) - _FOREIGN_HEADER:
            header = unknown[start : start + _FOREIGN_HEADER]
            after = unknown.find(header, start + _FOREIGN_HEADER, start + _FOREIGN_LONGEST)
            if after >= 0 and crc16(unknown[start + 1 : after]) == 0:
                self.foreign += 1
                start, pending = after, -1
                continue
            if pending < 0 and after < 0 and len(unknown) - start < _FOREIGN_LONGEST:
                pending = start
            start = unknown.find(SYNC, start + 1)
        if pending >= 0:
            start = pending
        del unknown[: start if start >= 0 else len(unknown)]

    def _span(self, position: int) -> int:
        """Return the length (bytes) of a packet or line at `position`, or _FALSE (invalid) or _INCOMPLETE."""
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
        # The CRC over a valid packet including its own CRC is zero.
        elif crc16(raw[1:]) == 0:
            header = raw[1 : 1 + HEADER_LENGTHS[raw[1]]]
            layout = layout_of_header(header)
            if layout is not None:
                return BinaryPacket(arrival_ns, layout, layout.payload.unpack_from(raw, 1 + len(header)))
        self.bad_checksum += 1
        return None
