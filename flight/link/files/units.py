"""Encoding and decoding of the protocol data units of CFDP file transfers (CCSDS 727.0-B-5, section 5).

A protocol data unit (PDU) consists of a header and either file data or a directive. The header has version 1,
entity numbers of 2 bytes and transaction numbers of 4 bytes; the decoder also accepts other lengths. The PDUs
are sent without CRC, because the frame that carries a PDU is authenticated; received PDUs may have a CRC. The
large-file option is not used. Each PDU is sent in a space packet of variable length, with the same headers as
the other packets and a 16-bit CRC. The tables of packet definitions do not list the packets that carry PDUs.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, SECONDARY_BYTES, UNSEGMENTED, crc16
from knightcube.errors import KnightCubeError

SEGMENT_BYTES = 900
"""Maximum file data (bytes) in one PDU, chosen so that the PDU fits into a telecommand frame."""
MOST_REQUESTS = 100
"""Maximum number of gaps in one NAK PDU, chosen so that the PDU fits into a telecommand frame."""
FILE_DATA_OVERHEAD, NAK_OVERHEAD, REQUEST_BYTES = 16, 21, 8
"""Overhead (bytes) of a file data PDU and of a NAK PDU, and length (bytes) of each gap in a NAK PDU."""
LONGEST_UNIT = FILE_DATA_OVERHEAD + SEGMENT_BYTES
HIGHEST_NUMBER = 2**32 - 1
_ENTITY_BYTES, _NUMBER_BYTES = 2, 4
_FIXED_BYTES = 4
_PDU_VERSION = 0b001 << 5
_FILE_DATA, _TO_SENDER, _UNACKNOWLEDGED, _CRC, _LARGE = 1 << 4, 1 << 3, 1 << 2, 1 << 1, 1
_METADATA_OF_SEGMENT = 1 << 3
_LENGTHS = (_ENTITY_BYTES - 1) << 4 | (_NUMBER_BYTES - 1)
_FAULT_LOCATION = 6  # TLV type of a fault location
_MOST_NAME_BYTES = 255


class PduError(KnightCubeError):
    """Raised for bytes that are not a CFDP PDU of class 2. The error text states the reason."""


class Condition(IntEnum):
    """CFDP condition codes (CCSDS 727.0-B-5, table 5-5)."""

    NO_ERROR = 0
    FILESTORE_REJECTION = 4
    CHECKSUM_FAILURE = 5
    SIZE_ERROR = 6
    UNSUPPORTED_CHECKSUM = 11
    CANCELLED = 15


class Code(IntEnum):
    """CFDP directive codes (CCSDS 727.0-B-5, table 5-4)."""

    EOF = 4
    FINISHED = 5
    ACK = 6
    METADATA = 7
    NAK = 8


class TransactionStatus(IntEnum):
    """Status of a transaction in an acknowledgement (CCSDS 727.0-B-5, table 5-8)."""

    ACTIVE = 1
    TERMINATED = 2
    UNRECOGNIZED = 3


class FileStatus(IntEnum):
    """Status of a received file (CCSDS 727.0-B-5, table 5-7)."""

    DISCARDED = 0
    REJECTED = 1
    RETAINED = 2


@dataclass(frozen=True, slots=True, order=True)
class Transaction:
    """Identification of a transfer: source entity, transaction number and destination entity."""

    source: int
    number: int
    destination: int


@dataclass(frozen=True, slots=True)
class Metadata:
    """Metadata PDU: file size (bytes), file names at the sender and receiver, and checksum type."""

    size: int
    source_name: str
    name: str
    checksum_type: int


@dataclass(frozen=True, slots=True)
class FileData:
    """File data PDU: one segment of the file."""

    offset: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Eof:
    """EOF PDU, sent after all data or if the sender cancels the transfer."""

    condition: int
    checksum: int
    size: int


@dataclass(frozen=True, slots=True)
class Nak:
    """NAK PDU: request for missing byte ranges (begin, end). The range (0, 0) requests the metadata."""

    begin: int
    end: int
    gaps: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Finished:
    """Finished PDU: report from the receiver that the transfer has ended."""

    condition: int
    complete: bool
    kept: int


@dataclass(frozen=True, slots=True)
class Ack:
    """ACK PDU: acknowledgement of an EOF or Finished PDU."""

    code: int
    condition: int
    status: int


Content = Metadata | FileData | Eof | Nak | Finished | Ack
_LONG = struct.Struct(">I")
_PAIR = struct.Struct(">II")
_EOF = struct.Struct(">BII")


def pack(transaction: Transaction, content: Content) -> bytes:
    """Return a PDU encoded as bytes."""
    body, kind = _body(transaction, content)
    if isinstance(content, Nak | Finished) or (isinstance(content, Ack) and content.code == Code.EOF):
        kind |= _TO_SENDER
    header = struct.pack(">BHB", _PDU_VERSION | kind, len(body), _LENGTHS)
    names = struct.pack(">HIH", transaction.source, transaction.number, transaction.destination)
    return header + names + body


def unpack(data: bytes) -> tuple[Transaction, Content]:
    """Return the transaction and content of the PDU at the beginning of `data`. Raises PduError."""
    if len(data) < _FIXED_BYTES:
        raise PduError(f"the unit has {len(data)} bytes, but a CFDP header has at least {_FIXED_BYTES}")
    if data[0] & 0b111 << 5 != _PDU_VERSION:
        raise PduError(f"the unit has CFDP version {data[0] >> 5}, but must have version 1")
    if data[0] & _UNACKNOWLEDGED:
        raise PduError("the transmission mode is 1 (class 1), but must be 0 (class 2)")
    if data[0] & _LARGE:
        raise PduError("the large file flag is 1, but must be 0")
    entity, number = (data[3] >> 4 & 7) + 1, (data[3] & 7) + 1
    begin = _FIXED_BYTES + 2 * entity + number
    end = begin + int.from_bytes(data[1:3], "big")
    if len(data) < end or end == begin:
        raise PduError(f"the unit has {end} bytes, but only {len(data)} were received")
    transaction = Transaction(
        int.from_bytes(data[4 : 4 + entity], "big"),
        int.from_bytes(data[4 + entity : 4 + entity + number], "big"),
        int.from_bytes(data[begin - entity : begin], "big"),
    )
    if max(transaction.source, transaction.destination) >= 1 << 16 or transaction.number > HIGHEST_NUMBER:
        raise PduError(
            f"entities {transaction.source} and {transaction.destination} must be below 65536, and the "
            f"transaction number {transaction.number} at most {HIGHEST_NUMBER}"
        )
    if data[0] & _CRC:
        if crc16(data[:end]) != 0:
            raise PduError(
                f"the CRC flag is 1, but the CRC {data[end - CRC_BYTES : end].hex()} of the unit is wrong"
            )
        end -= CRC_BYTES
    body = data[begin:end]
    try:
        if data[0] & _FILE_DATA:
            if data[3] & _METADATA_OF_SEGMENT:
                raise PduError("the segment metadata flag is 1, but must be 0")
            return transaction, FileData(_LONG.unpack_from(body)[0], body[_LONG.size :])
        return transaction, _directive(body)
    except (struct.error, IndexError) as error:
        kind = "file data" if data[0] & _FILE_DATA else f"directive {body[0] if body else 'missing'}"
        raise PduError(f"the unit ends before its last field ({kind}, {len(body)} bytes)") from error


def _body(transaction: Transaction, content: Content) -> tuple[bytes, int]:
    """Return the bytes after the header of a PDU, and the file data flag for the header."""
    match content:
        case FileData(offset, data):
            return _LONG.pack(offset) + data, _FILE_DATA
        case Metadata(size, source_name, name, checksum_type):
            names = b"".join(_name(text) for text in (source_name, name))
            return struct.pack(">BBI", Code.METADATA, checksum_type, size) + names, 0
        case Eof(condition, checksum, size):
            fault = _fault(condition, transaction.source)
            return bytes((Code.EOF,)) + _EOF.pack(condition << 4, checksum, size) + fault, 0
        case Nak(begin, end, gaps):
            return bytes((Code.NAK,)) + _PAIR.pack(begin, end) + b"".join(_PAIR.pack(*g) for g in gaps), 0
        case Finished(condition, complete, kept):
            flags = condition << 4 | (not complete) << 2 | kept
            return bytes((Code.FINISHED, flags)) + _fault(condition, transaction.destination), 0
        case Ack(code, condition, status):
            return bytes((Code.ACK, code << 4 | (code == Code.FINISHED), condition << 4 | status)), 0


def _directive(body: bytes) -> Content:
    code, rest = body[0], body[1:]
    match code:
        case Code.METADATA:
            size = _LONG.unpack_from(rest, 1)[0]
            first, second = 5, 6 + rest[5]
            end = second + 1 + rest[second]
            if len(rest) < end:
                raise PduError(f"the file names end at byte {end}, but the unit ends at byte {len(rest)}")
            names = (rest[first + 1 : second], rest[second + 1 : end])
            source_name, name = (raw.decode("utf-8", "replace") for raw in names)
            return Metadata(size, source_name, name, rest[0] & 15)
        case Code.EOF:
            flags, checksum, size = _EOF.unpack_from(rest)
            return Eof(flags >> 4, checksum, size)
        case Code.NAK:
            begin, end = _PAIR.unpack_from(rest)
            return Nak(begin, end, tuple(_PAIR.iter_unpack(rest[8 : len(rest) // 8 * 8])))
        case Code.FINISHED:
            return Finished(rest[0] >> 4, not rest[0] & 4, rest[0] & 3)
        case Code.ACK:
            return Ack(rest[0] >> 4, rest[1] >> 4, rest[1] & 3)
        case _:
            raise PduError(f"directive {code} is not known: the codes are {sorted(map(int, Code))}")


def _name(text: str) -> bytes:
    raw = text.encode()
    if len(raw) > _MOST_NAME_BYTES:
        raise PduError(f"{text}: longer than {_MOST_NAME_BYTES} bytes")
    return bytes((len(raw),)) + raw


def _fault(condition: int, entity: int) -> bytes:
    """Return the TLV that identifies the entity which detected a fault, empty if there is no fault."""
    if condition == Condition.NO_ERROR:
        return b""
    return bytes((_FAULT_LOCATION, _ENTITY_BYTES)) + entity.to_bytes(_ENTITY_BYTES, "big")


DOWN = 0x0973
"""First 16 bits of a packet that carries a PDU to the ground (type telemetry, APID 0x173)."""
UP = 0x1A28
"""First 16 bits of a packet that carries a PDU to the satellite (type telecommand, APID 0x228)."""
PACKET_VERSION = 1

UNIT_OVERHEAD_BYTES = HEADER_BYTES + SECONDARY_BYTES + CRC_BYTES
"""Overhead (bytes) of a packet that carries a PDU."""

_PACKET_HEADERS = struct.Struct(">HHHBq")
_MODULUS = 1 << 14


class UnitPacker:
    """Encoder that puts CFDP PDUs into space packets of one direction and counts the packets."""

    def __init__(self, identifier: int) -> None:
        """Make packets whose first 16 bits are `identifier`, which is `DOWN` or `UP`."""
        self._identifier = identifier
        self._count = 0

    def pack(self, unit: bytes, time_ns: int) -> bytes:
        """Return the packet that carries a PDU."""
        length = SECONDARY_BYTES + len(unit) + CRC_BYTES - 1
        body = (
            _PACKET_HEADERS.pack(self._identifier, UNSEGMENTED | self._count, length, PACKET_VERSION, time_ns)
            + unit
        )
        self._count = (self._count + 1) % _MODULUS
        return body + crc16(body).to_bytes(CRC_BYTES, "big")


def is_unit(packet: bytes, identifier: int) -> bool:
    """Return whether the first 16 bits of a packet are `identifier`, which is `DOWN` or `UP`."""
    return int.from_bytes(packet[:2], "big") == identifier


def unit_of(packet: bytes) -> bytes:
    """Return the PDU in a packet, or empty bytes if the packet is damaged."""
    stated = int.from_bytes(packet[4:HEADER_BYTES], "big") + HEADER_BYTES + 1
    known = len(packet) == stated and packet[HEADER_BYTES : HEADER_BYTES + 1] == bytes((PACKET_VERSION,))
    return packet[HEADER_BYTES + SECONDARY_BYTES : -CRC_BYTES] if known and crc16(packet) == 0 else b""
