"""ASCII sentences of the VN-100: `$VNxxx,field,...*checksum` and a line end.

The checksum covers the bytes strictly between `$` and `*`: two hex digits are the XOR of the bytes, four are
CRC-16/XMODEM, and `XX`, to the unit only, means none (VectorNav UM001 v2.43 section 4.2; its remark on
polynomial 0x07 is an error).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Literal

from hal.drivers.vn100.codec import crc16

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
    """Return the sentence of a whole line, or None when it is no sentence or its checksum fails.

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
