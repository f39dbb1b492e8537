"""The VN-100's protocol: binary packets, ASCII sentences, and a parser of the byte stream.

A binary packet is `FA | group byte | one u16 LE word of field bits per group | payload LE | CRC16
big-endian` (VectorNav UM001 v2.43 section 4.3). The CRC is CRC-16/XMODEM over the bytes between the FA and
the CRC. Units are the unit's own: gauss, degrees, m/s^2, rad/s, ns.

An ASCII sentence is `$VNxxx,field,...*checksum` and a line end. The checksum covers the bytes strictly
between `$` and `*`: two hexadecimal digits are the XOR of the bytes, four are CRC-16/XMODEM, and `XX`,
accepted by the unit only, means no checksum (section 4.2; its remark on polynomial 0x07 is an error).

`StreamParser` resynchronises after any garbage. A false start costs one byte only, so a valid packet behind
or inside a broken packet is still found. Work and memory are bounded by the length of the longest candidate.
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

# (name, struct code) by bit. No VN-100 has groups 4 and 7 (GNSS); their sizes are not listed.
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

# By the group's bit in the group byte.
FIELDS: Mapping[int, tuple[tuple[str, str], ...]] = {0: _COMMON, 1: _TIME, 2: _IMU, 4: _ATTITUDE, 5: _INS}
GROUP_NAMES: Mapping[int, str] = {0: "common", 1: "time", 2: "imu", 4: "attitude", 5: "ins"}

Value = float | bytes


@dataclass(frozen=True, slots=True)
class OutputLayout:
    """OutputLayout of the packets of one output set.

    Attributes:
        header: the bytes after the sync byte: group byte and field words.
        fields: ((group bit, field bit), ...) in the order of the payload.
        places: field as "group.name" -> slice of the unpacked values.
        payload: the payload's struct.
        length: bytes of the whole packet, from sync to checksum.
    """

    header: bytes
    fields: tuple[tuple[int, int], ...]
    places: Mapping[str, slice]
    payload: struct.Struct
    length: int

    def pack(self, values: Iterable[Value]) -> bytes:
        """Return the packet with the payload `values`, flat, in the order of the fields."""
        body = self.header + self.payload.pack(*values)
        return b"".join((b"\xfa", body, crc16(body).to_bytes(2, "big")))


@dataclass(frozen=True, slots=True)
class BinaryPacket:
    """A packet with a valid checksum.

    `arrival_ns` is the host's time of its last byte; `values` is the payload, flat.
    """

    arrival_ns: int
    layout: OutputLayout
    values: tuple[Value, ...]

    def __getitem__(self, field: str) -> tuple[Value, ...]:
        """Return the values of a field named "group.name"; raises KeyError without one."""
        return self.values[self.layout.places[field]]


def crc16(data: bytes) -> int:
    """Return CRC-16/XMODEM of `data`: polynomial 0x1021, start 0, check value 0x31C3 of "123456789"."""
    return crc_hqx(data, 0)


def layout_of(words: Mapping[int, int]) -> OutputLayout:
    """Return the layout of field words by group bit, {0: 0x0131, 2: 0x0100}.

    Raises ValueError for a group or a field that is not in the tables.
    """
    groups = sum(1 << bit for bit in words)
    header = struct.pack(f"<B{len(words)}H", groups, *(words[bit] for bit in sorted(words)))
    layout = layout_of_header(header)
    if layout is None:
        raise ValueError(f"no VN-100 output set has the field words {dict(words)}")
    return layout


def header_length(group_byte: int) -> int:
    """Return the length of group byte and field words; 0 when no known unit sends this group byte."""
    if group_byte == 0 or any(group_byte >> bit & 1 and bit not in FIELDS for bit in range(8)):
        return 0
    return 1 + 2 * group_byte.bit_count()


@lru_cache(maxsize=256)
def layout_of_header(header: bytes) -> OutputLayout | None:
    """Return the layout of `header` (group byte and its field words); None when there is none."""
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
    0x01: "hard fault",
    0x02: "serial buffer overflow",
    0x03: "invalid checksum",
    0x04: "invalid command",
    0x05: "not enough parameters",
    0x06: "too many parameters",
    0x07: "invalid parameter",
    0x08: "invalid register",
    0x09: "unauthorized access",
    0x0A: "watchdog reset",
    0x0B: "output buffer overflow",
    0x0C: "insufficient baud rate",
    0xFF: "error buffer overflow",
}


@dataclass(frozen=True, slots=True)
class Sentence:
    """One sentence: `command` is the part after `$VN` ("QMR"), `fields` the rest, as text."""

    command: str
    fields: tuple[str, ...]
    checksum: Checksum


@dataclass(frozen=True, slots=True)
class AsciiLine:
    """A sentence with a valid checksum; `arrival_ns` is the host's time of its last byte."""

    arrival_ns: int
    length: int
    sentence: Sentence


@dataclass(frozen=True, slots=True)
class Measurement:
    """The values of an asynchronous VNQMR or VNYMR line, in the unit's own units.

    `attitude` is (q0, q1, q2, q3), scalar last, or (yaw, pitch, roll) in degrees; `mag` gauss, `accel` m/s^2,
    `gyro` rad/s.
    """

    attitude: tuple[float, ...]
    mag: tuple[float, float, float]
    accel: tuple[float, float, float]
    gyro: tuple[float, float, float]


def xor8(data: bytes) -> int:
    """Return the XOR of all bytes."""
    return reduce(xor, data, 0)


def build(command: str, *fields: object, checksum: Checksum = "crc16") -> bytes:
    """Return the sentence `$VN<command>,<fields>*<checksum>` with its line end."""
    body = ",".join(("VN" + command, *map(str, fields))).encode("ascii")
    digits = "XX"
    if checksum != "none":
        digits = f"{xor8(body):02X}" if checksum == "xor8" else f"{crc16(body):04X}"
    return b"$%b*%b\r\n" % (body, digits.encode("ascii"))


def parse(line: bytes, *, allow_none: bool = False) -> Sentence | None:
    """Return the sentence of a whole line, or None if the line is not a sentence or its checksum fails.

    `XX` instead of a checksum is accepted only with `allow_none`: a unit never sends it.
    """
    text = line.rstrip(b"\r\n")
    body, star, digits = text[1:].partition(b"*")  # a sentence has one star
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
    # bytes.isalnum excludes what int() accepts besides digits: a sign, an underscore, blanks.
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
    """Return the values of a VNQMR or VNYMR sentence; None for other sentences and for unreadable numbers.

    Trailing `T...` and `S...` fields (register 30: count and status) are ignored. A value may be NaN or
    infinite as the unit sent it; the driver rejects those.
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
    """Return (code, meaning) of a `$VNERR` sentence, None for any other.

    The code is hexadecimal; an unreadable one counts as -1.
    """
    if sentence.command != "ERR":
        return None
    try:
        code = int(sentence.fields[0], 16)
    except (IndexError, ValueError):
        return -1, "an unreadable error"
    return code, ERRORS.get(code, "an error without a published meaning")


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
