"""Channel coding and framing of transfer frames, for a radio that does neither itself (a bare radio).

Telemetry follows CCSDS 131.0-B-5: Reed-Solomon code (255,223) in the dual basis with interleaving and
virtual fill, then a pseudo-randomiser, then the attached sync marker. Telecommands follow CCSDS 231.0-B-4: a
pseudo-randomiser, the BCH code (63,56) and the communications link transmission unit (CLTU), which carries
one frame. A terminal node controller (TNC) is connected by KISS, with or without the header of AX.25 frames.

One datagram or KISS frame carries one coded frame (codeblock or CLTU). In a byte stream (serial line, TCP), a
marker precedes each coded frame. Satellite and ground need the same settings, which are in the section
`link.coding` of the configuration. The radio must deliver whole bytes, because coded frames are not searched
for at other bit offsets.

The library reedsolo computes in the Galois field and corrects erroneous codewords. Encoding and the error
check of received codewords are done for every frame, and therefore use a table of parity symbols.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from reedsolo import ReedSolomonError, RSCodec

from flight.link.frames import (
    LONGEST_FRAME,
    SYNC,
    TELECOMMAND_HEADER,
    FrameStream,
    stated_length,
    telecommand_stream,
)
from flight.link.telemetry.packets import crc16

_REGISTERS = {
    "short": (8, (7, 5, 3, 0), 0xFF),
    "long": (17, (14, 0), 0x18E38),
    "command": (8, (6, 4, 3, 2, 1, 0), 0xFF),
}
"""Register length, feedback taps and initial state of each pseudo-randomiser."""
_LONGEST_UNIT = 2048 + 5 * 32


@cache
def pseudo_random(kind: str) -> bytes:
    """Return the beginning of a pseudo-random sequence, at least as long as the longest codeblock.

    The sequence "short" (x^8 + x^7 + x^5 + x^3 + 1) or "long" (x^17 + x^14 + 1) is that of CCSDS 131.0-B-5,
    section 10.4. The sequence "command" (x^8 + x^6 + x^4 + x^3 + x^2 + x + 1) is that of CCSDS 231.0-B-4.
    """
    size, taps, state = _REGISTERS[kind]
    sequence = 0
    for _ in range(8 * _LONGEST_UNIT):
        sequence = sequence << 1 | (state & 1)
        fed_back = sum(state >> tap for tap in taps) & 1
        state = state >> 1 | fed_back << (size - 1)
    return sequence.to_bytes(_LONGEST_UNIT, "big")


def randomised(data: bytes, kind: str | None) -> bytes:
    """Return the exclusive or of bytes and a pseudo-random sequence, or the same bytes if `kind` is None."""
    if kind is None:
        return data
    sequence = pseudo_random(kind)[: len(data)]
    return (int.from_bytes(data, "big") ^ int.from_bytes(sequence, "big")).to_bytes(len(data), "big")


_CODEWORD, _PARITY = 255, 32
DATA_SYMBOLS = _CODEWORD - _PARITY
"""Number of data symbols in a codeword of the Reed-Solomon code."""
_FIELD_POLYNOMIAL = 0x187
_ROOT = 173  # alpha^11, whose powers 112 to 143 are the roots of the generator polynomial
_FIRST_ROOT = 112
_DUAL_BASE_ROOT = 117  # exponent k of beta = alpha^k; symbols use the basis dual to the powers of beta


class ReedSolomon:
    """Reed-Solomon code (255,223) in the dual basis (CCSDS 131.0-B-5, section 4), with error counts."""

    def __init__(self, depth: int) -> None:
        """Prepare a code that interleaves `depth` codewords."""
        self._depth = depth
        self._codec = RSCodec(_PARITY, _CODEWORD, _FIRST_ROOT, _FIELD_POLYNOMIAL, _ROOT)
        self._dual, self._conventional, self._parity_of = _tables()
        self.corrected = self.uncorrectable = 0

    def encode(self, frame: bytes) -> bytes:
        """Return the codeblock of a frame, whose length must be a multiple of the interleaving depth."""
        return frame + self._parity(np.frombuffer(frame, np.uint8)).tobytes()

    def decode(self, block: bytes) -> bytes:
        """Return the corrected frame of a codeblock, in which uncorrectable codewords remain as received."""
        symbols = np.frombuffer(block, np.uint8).reshape(-1, self._depth).copy()
        data, parity = symbols[:-_PARITY], symbols[-_PARITY:]
        wrong = (self._parity(data.ravel()) != parity).any(axis=0)
        for column in np.flatnonzero(wrong):
            try:
                word, _, places = self._codec.decode(self._conventional[symbols[:, column]].tobytes())
            except ReedSolomonError:
                self.uncorrectable += 1
                continue
            data[:, column] = self._dual[np.frombuffer(word, np.uint8)]
            self.corrected += len(places)
        return data.tobytes()

    def _parity(self, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the parity symbols (32, depth) of data that are preceded by a virtual fill of zeros."""
        columns = data.reshape(-1, self._depth)
        places = np.arange(DATA_SYMBOLS - len(columns), DATA_SYMBOLS)[:, None]
        parity: NDArray[np.uint8] = np.bitwise_xor.reduce(self._parity_of[places, columns], axis=0).T
        return parity


@cache
def _tables() -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the tables of the Reed-Solomon code.

    The tables are the dual basis representation of each symbol (256), the inverse of this table (256), and
    the parity symbols (223, 256, 32) of each data symbol at each position, in the dual basis.
    """
    codec = RSCodec(_PARITY, _CODEWORD, _FIRST_ROOT, _FIELD_POLYNOMIAL, _ROOT)
    power = np.array(codec.gf_exp, dtype=np.uint8)
    logarithm = np.array(codec.gf_log, dtype=np.intp)

    def times(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.uint8]:
        product: NDArray[np.uint8] = power[(logarithm[a] + logarithm[b]) % _CODEWORD]
        product[(a == 0) | (b == 0)] = 0
        return product

    symbols = np.arange(256, dtype=np.uint8)
    alpha = np.array([2], dtype=np.uint8)
    beta = power[int(logarithm[alpha[0]]) * _DUAL_BASE_ROOT % _CODEWORD]
    dual, factor = np.zeros(256, dtype=np.uint8), np.array([1], dtype=np.uint8)
    for _ in range(8):  # bit i is the trace of the symbol times beta^i, and bit 0 is sent first
        conjugate = times(symbols, factor)
        trace = np.zeros(256, dtype=np.uint8)
        for _ in range(8):
            trace = trace ^ conjugate
            conjugate = times(conjugate, conjugate)
        dual = (dual * 2 + trace).astype(np.uint8)
        factor = times(factor, np.array([beta], dtype=np.uint8))
    conventional = np.argsort(dual).astype(np.uint8)
    impulses = [bytes([1]) + bytes(DATA_SYMBOLS - 1 - place) for place in range(DATA_SYMBOLS)]
    parity = np.array([list(codec.encode(impulse)[-_PARITY:]) for impulse in impulses], dtype=np.uint8)
    products = times(conventional[None, :, None], parity[:, None, :])
    return dual, conventional, dual[products]


class FrameDecoder(Protocol):
    """Decoder of the frames in a byte stream."""

    def add(self, data: bytes) -> list[bytes]:
        """Add received bytes and return the frames that are now complete, including damaged frames."""


class Code(Protocol):
    """Code of one direction of the link."""

    def encode(self, frame: bytes) -> bytes:
        """Return the coded frame (codeblock or CLTU)."""

    def decode(self, unit: bytes) -> bytes:
        """Decode a coded frame. The CRC of the result is wrong if too many bits were damaged."""

    def marked(self, frame: bytes) -> bytes:
        """Return the sync marker and the coded frame, for a byte stream."""

    def stream(self) -> FrameDecoder:
        """Return a decoder of the coded frames in a byte stream."""


_WRONG_MARKER_BITS = 3
"""Maximum number of wrong bits in a sync marker that is accepted directly after a valid codeblock. At a bit
error rate of 0.8 %, at which the Reed-Solomon code fails, one marker of 8,000 has more than three wrong
bits."""
_RECENT_BLOCKS = 256
"""Number of codeblocks that are kept for reuse, because all lines send the same frames, and because a frame
that no line accepted is sent again."""


class TelemetryCode:
    """Telemetry code: Reed-Solomon code and pseudo-randomiser, both optional."""

    def __init__(self, frame_bytes: int, randomiser: str | None, depth: int | None) -> None:
        """Encode frames of `frame_bytes` bytes, with `depth` interleaved Reed-Solomon codewords."""
        self._kind = randomiser
        self._code = None if depth is None else ReedSolomon(depth)
        self._block = lru_cache(_RECENT_BLOCKS)(self._encoded)
        self._unit_bytes = frame_bytes + _PARITY * (depth or 0)

    @property
    def corrected(self) -> int:
        """Number of symbols that were corrected."""
        return 0 if self._code is None else self._code.corrected

    @property
    def uncorrectable(self) -> int:
        """Number of codewords with too many errors."""
        return 0 if self._code is None else self._code.uncorrectable

    def encode(self, frame: bytes) -> bytes:
        """Return the codeblock of a frame, without sync marker."""
        return self._block(frame)

    def _encoded(self, frame: bytes) -> bytes:
        return randomised(frame if self._code is None else self._code.encode(frame), self._kind)

    def decode(self, unit: bytes) -> bytes:
        """Return the frame in a codeblock."""
        block = randomised(unit, self._kind)
        if self._code is None:
            return block
        return self._code.decode(block) if len(block) == self._unit_bytes else b""

    def marked(self, frame: bytes) -> bytes:
        """Return the codeblock of a frame after the attached sync marker."""
        return SYNC + self.encode(frame)

    def stream(self) -> FrameDecoder:
        """Return a decoder of the codeblocks after sync markers."""
        tolerance = 0 if self._code is None else _WRONG_MARKER_BITS
        return FrameStream(lambda _: self._unit_bytes, 0, self.decode, tolerance)


_CLTU_START, _CLTU_TAIL = bytes.fromhex("EB90"), bytes.fromhex("C5C5C5C5C5C5C579")
_BLOCK_DATA, _BLOCK = 7, 8
_FILL = b"\x55"
_GENERATOR = 0b1000101 << 1
"""Generator polynomial x^7 + x^6 + x^2 + 1 without its highest term, aligned to the left of a byte."""
_INVERTED = 0xFE
"""Mask of the seven parity bits in the last byte of a codeblock, which are sent inverted."""
LONGEST_CLTU = len(_CLTU_START) + _BLOCK * -(-LONGEST_FRAME // _BLOCK_DATA) + len(_CLTU_TAIL)


@cache
def _remainders() -> list[int]:
    """Return the remainder of each byte value after division by the generator polynomial."""
    table = []
    for value in range(256):
        rest = value
        for _ in range(8):
            rest = (rest << 1 ^ (_GENERATOR if rest & 0x80 else 0)) & 0xFF
        table.append(rest)
    return table


def _bch_parity(data: bytes) -> int:
    """Return the parity bits of 7 bytes by the BCH code (63,56), aligned to the left of a byte."""
    rest, table = 0, _remainders()
    for value in data:
        rest = table[rest ^ value]
    return rest


@cache
def _wrong_bits() -> dict[int, int]:
    """Return masks of single bit errors among the 64 bits of a codeblock, by the syndrome of each error."""
    valid = int.from_bytes(bytes(_BLOCK_DATA) + bytes([_INVERTED]), "big")
    masks = (1 << bit for bit in range(1, 8 * _BLOCK))  # without bit 0, the fill bit
    return {_syndrome((valid ^ mask).to_bytes(_BLOCK, "big")): mask for mask in masks}


def _syndrome(block: bytes) -> int:
    """Return the syndrome of a codeblock, which is 0 if there are no errors. The fill bit is ignored."""
    return _bch_parity(block[:_BLOCK_DATA]) ^ (~block[_BLOCK_DATA] & _INVERTED)


@cache
def _starts() -> re.Pattern[bytes]:
    """Return a regular expression for the start sequence with at most one wrong bit."""
    start = int.from_bytes(_CLTU_START, "big")
    forms = [start, *(start ^ 1 << bit for bit in range(16))]
    return re.compile(b"|".join(re.escape(form.to_bytes(2, "big")) for form in forms), re.DOTALL)


def cltu(frame: bytes) -> bytes:
    """Return the communications link transmission unit that carries a frame (CCSDS 231.0-B-4)."""
    filled = frame + _FILL * (-len(frame) % _BLOCK_DATA)
    blocks = (filled[begin : begin + _BLOCK_DATA] for begin in range(0, len(filled), _BLOCK_DATA))
    coded = b"".join(data + bytes([_bch_parity(data) ^ _INVERTED]) for data in blocks)
    return _CLTU_START + coded + _CLTU_TAIL


class CltuStream:
    """Decoder of the frames in a stream of CLTUs, which corrects one wrong bit in each codeblock.

    The start sequence may also have one wrong bit. The length of the frame is read from the frame's header,
    so that the frame is complete before the tail sequence arrives. The search for the next start sequence
    continues after the last valid codeblock, so that each byte is decoded only once.
    """

    def __init__(self, kind: str | None, count: Callable[[int], object]) -> None:
        """Decode frames randomised by the sequence `kind`; pass the number of corrected bits to `count`."""
        self._kind, self._count = kind, count
        self._data = b""

    def add(self, data: bytes) -> list[bytes]:
        """Add received bytes and return the frames that are now complete and have a valid CRC."""
        self._data += data
        found: list[bytes] = []
        while (start := _starts().search(self._data)) is not None:
            self._data = self._data[start.start() :]
            coded = self._data[len(_CLTU_START) : LONGEST_CLTU]
            decoded = self._frame(coded)
            if decoded is None:
                return found
            frame, size = decoded
            if frame:
                found.append(frame)
            self._data = self._data[len(_CLTU_START) + size if size else 1 :]
        self._data = self._data[-1:]
        return found

    def _frame(self, coded: bytes) -> tuple[bytes, int] | None:
        """Return frame (b"" if damaged) and length of the valid codeblocks, or None if data are missing."""
        data, corrected, length = b"", 0, _BLOCK_DATA
        for end in range(_BLOCK, len(coded) + 1, _BLOCK):
            block = coded[end - _BLOCK : end]
            if syndrome := _syndrome(block):
                mask = _wrong_bits().get(syndrome)
                if mask is None:
                    return b"", end - _BLOCK
                block = (int.from_bytes(block, "big") ^ mask).to_bytes(_BLOCK, "big")
                corrected += 1
            data += block[:_BLOCK_DATA]
            if end == _BLOCK:
                length = stated_length(randomised(data, self._kind))
            if len(data) >= length:
                frame = randomised(data, self._kind)[:length]
                if length < TELECOMMAND_HEADER.size or crc16(frame) != 0:
                    return b"", end
                self._count(corrected)
                return frame, end
        return None


class CommandCode:
    """Telecommand code: CLTUs, randomised or not, or uncoded frames; `corrected` counts corrected bits."""

    def __init__(self, cltu_kind: str | None) -> None:
        """Encode frames in CLTUs of the kind "plain" or "randomised"; with None, frames are not coded."""
        self._coded = cltu_kind is not None
        self._kind = "command" if cltu_kind == "randomised" else None
        self.corrected = 0

    def encode(self, frame: bytes) -> bytes:
        """Return the CLTU of a frame, or the frame itself if frames are not coded."""
        return cltu(randomised(frame, self._kind)) if self._coded else frame

    def decode(self, unit: bytes) -> bytes:
        """Return the frame in a CLTU, empty if the CLTU is damaged beyond repair."""
        return next(iter(self.stream().add(unit)), b"") if self._coded else unit

    def marked(self, frame: bytes) -> bytes:
        """Return the CLTU of a frame or, if frames are not coded, the sync marker and the frame."""
        return self.encode(frame) if self._coded else SYNC + frame

    def stream(self) -> FrameDecoder:
        """Return a decoder of CLTUs or, if frames are not coded, of frames that follow sync markers."""
        return CltuStream(self._kind, self._add) if self._coded else telecommand_stream()

    def _add(self, corrected: int) -> None:
        self.corrected += corrected


_FRAME_END, _ESCAPE = b"\xc0", b"\xdb"
_ESCAPED_END, _ESCAPED_ESCAPE = _ESCAPE + b"\xdc", _ESCAPE + b"\xdd"
_DATA_FRAME = b"\x00"
_UI_NO_LAYER_3 = b"\x03\xf0"  # control field and protocol identifier of a UI frame without layer 3
_ADDRESS_BYTES = 7
_MOST_KISS_BYTES = 1 << 14


def ax25_header(to: str, source: str) -> bytes:
    """Return the header of an AX.25 UI frame (AX.25 2.2, section 3) between two call signs."""
    addresses = b""
    for call_sign, flags in ((to, 0xE0), (source, 0x61)):
        name, _, ssid = call_sign.upper().partition("-")
        addresses += bytes(ord(letter) << 1 for letter in name.ljust(6))
        addresses += bytes([flags | int(ssid or 0) << 1])
    return addresses + _UI_NO_LAYER_3


class KissStream:
    """Decoder of coded frames in KISS frames (Chepponis and Karn, 1987), with or without AX.25 headers."""

    def __init__(self, decode: Callable[[bytes], bytes], ax25: bool) -> None:
        """Decode frames by the function `decode`, after removing AX.25 headers if `ax25` is true."""
        self._decode, self._ax25 = decode, ax25
        self._data = b""

    def add(self, data: bytes) -> list[bytes]:
        """Add received bytes and return the frames in complete KISS frames."""
        *complete, rest = (self._data + data).split(_FRAME_END)
        self._data = rest if len(rest) < _MOST_KISS_BYTES else b""
        units = [unit for one in complete if (unit := self._unit(one))]
        return [self._decode(unit) for unit in units]

    def _unit(self, kiss: bytes) -> bytes:
        """Return the coded frame in a KISS data frame, or empty bytes for a KISS command frame."""
        if not kiss or kiss[0] & 0x0F:
            return b""
        content = kiss[1:].replace(_ESCAPED_END, _FRAME_END).replace(_ESCAPED_ESCAPE, _ESCAPE)
        if not self._ax25:
            return content
        last = next((at for at, byte in enumerate(content) if byte & 1), 0) + 1
        is_ui = last % _ADDRESS_BYTES == 0 and content[last : last + 2] == _UI_NO_LAYER_3
        return content[last + 2 :] if is_ui else b""


def kiss_frame(content: bytes) -> bytes:
    """Return the KISS frame that a TNC transmits on its first port."""
    escaped = content.replace(_ESCAPE, _ESCAPED_ESCAPE).replace(_FRAME_END, _ESCAPED_END)
    return _FRAME_END + _DATA_FRAME + escaped + _FRAME_END


@dataclass(frozen=True, slots=True)
class Framing:
    """Framing in a byte stream: function that encodes a frame, and function that creates a decoder."""

    wrap: Callable[[bytes], bytes]
    stream: Callable[[], FrameDecoder]


class LinkCodes:
    """Codes of both directions of a link, for telemetry frames and for telecommand frames."""

    def __init__(
        self,
        frame_bytes: int = 0,
        randomiser: str | None = None,
        reed_solomon: int | None = None,
        cltu_kind: str | None = None,
        call_signs: tuple[str, str] | None = None,
    ) -> None:
        """Create the codes of the section `link` of a configuration; by default, frames are not coded."""
        self.telemetry = TelemetryCode(frame_bytes, randomiser, reed_solomon)
        self.commands = CommandCode(cltu_kind)
        self._call_signs = call_signs

    def on_board(self, kiss: bool = False) -> Framing:
        """Return the framing of the satellite's byte stream, with KISS frames for a TNC if `kiss` is true."""
        return _framing(self.telemetry, self.commands, self._call_signs, kiss)

    def on_ground(self, kiss: bool = False) -> Framing:
        """Return the framing of the ground's byte stream, with KISS frames for a TNC if `kiss` is true."""
        reverse = None if self._call_signs is None else (self._call_signs[1], self._call_signs[0])
        return _framing(self.commands, self.telemetry, reverse, kiss)


def _framing(sent: Code, received: Code, call_signs: tuple[str, str] | None, kiss: bool) -> Framing:
    if not kiss:
        return Framing(sent.marked, received.stream)
    header = b"" if call_signs is None else ax25_header(*call_signs)

    def wrap(frame: bytes) -> bytes:
        return kiss_frame(header + sent.encode(frame))

    return Framing(wrap, lambda: KissStream(received.decode, bool(header)))
