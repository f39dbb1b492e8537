"""Tests of CFDP data units against the independent codec of `spacepackets`, in both directions."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spacepackets.cfdp import (
    ChecksumType,
    ConditionCode,
    CrcFlag,
    DirectiveType,
    EntityIdTlv,
    PduConfig,
    TransmissionMode,
)
from spacepackets.cfdp.pdu import (
    AckPdu,
    DeliveryCode,
    EofPdu,
    FileDataPdu,
    FileStatus,
    FinishedParams,
    FinishedPdu,
    MetadataParams,
    MetadataPdu,
    NakPdu,
    TransactionStatus,
)
from spacepackets.cfdp.pdu.file_data import FileDataParams
from spacepackets.util import ByteFieldU16, ByteFieldU32

from flight.link.files.transfer import CRC32, CRC32C, MODULAR, FileSum, add
from flight.link.files.units import (
    MOST_REQUESTS,
    SEGMENT_BYTES,
    Ack,
    Code,
    Condition,
    Content,
    Eof,
    FileData,
    Finished,
    Metadata,
    Nak,
    PduError,
    Transaction,
    pack,
    unpack,
)
from flight.link.files.units import (
    FileStatus as OurFileStatus,
)
from flight.link.files.units import (
    TransactionStatus as OurTransactionStatus,
)
from flight.link.frames import LONGEST_FRAME, TELECOMMAND_HEADER
from flight.link.security import OVERHEAD_BYTES
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, SECONDARY_BYTES

TRANSACTION = Transaction(1, 0x01020304, 2)
FAULT = EntityIdTlv(b"\0\1")
FAULT_OF_RECEIVER = EntityIdTlv(b"\0\2")


def config() -> PduConfig:
    return PduConfig(
        source_entity_id=ByteFieldU16(1),
        dest_entity_id=ByteFieldU16(2),
        transaction_seq_num=ByteFieldU32(0x01020304),
        trans_mode=TransmissionMode.ACKNOWLEDGED,
    )


def metadata() -> MetadataPdu:
    params = MetadataParams(False, ChecksumType.CRC_32, 10_000_000, "log/a", "log/b")
    return MetadataPdu(config(), params)


def finished(condition: ConditionCode, delivery: DeliveryCode, status: FileStatus) -> FinishedPdu:
    fault = None if condition == ConditionCode.NO_ERROR else FAULT_OF_RECEIVER
    return FinishedPdu(config(), FinishedParams(condition, delivery, status, fault_location=fault))


CASES: list[tuple[Content, bytes]] = [
    (Metadata(10_000_000, "log/a", "log/b", CRC32), bytes(metadata().pack())),
    (FileData(900, b"abc"), bytes(FileDataPdu(config(), FileDataParams(b"abc", 900)).pack())),
    (Eof(0, 0x01020304, 99), bytes(EofPdu(config(), b"\1\2\3\4", 99).pack())),
    (
        Eof(15, 7, 99),
        bytes(EofPdu(config(), b"\0\0\0\7", 99, FAULT, ConditionCode.CANCEL_REQUEST_RECEIVED).pack()),
    ),
    (Nak(0, 99, ((0, 0), (5, 9))), bytes(NakPdu(config(), 0, 99, [(0, 0), (5, 9)]).pack())),
    (
        Ack(Code.EOF, 0, OurTransactionStatus.ACTIVE),
        bytes(
            AckPdu(config(), DirectiveType.EOF_PDU, ConditionCode.NO_ERROR, TransactionStatus.ACTIVE).pack()
        ),
    ),
    (
        Ack(Code.FINISHED, 5, OurTransactionStatus.TERMINATED),
        bytes(
            AckPdu(
                config(),
                DirectiveType.FINISHED_PDU,
                ConditionCode.FILE_CHECKSUM_FAILURE,
                TransactionStatus.TERMINATED,
            ).pack()
        ),
    ),
    (
        Finished(0, True, OurFileStatus.RETAINED),
        bytes(finished(ConditionCode.NO_ERROR, DeliveryCode.DATA_COMPLETE, FileStatus.FILE_RETAINED).pack()),
    ),
    (
        Finished(Condition.FILESTORE_REJECTION, False, OurFileStatus.REJECTED),
        bytes(
            finished(
                ConditionCode.FILESTORE_REJECTION,
                DeliveryCode.DATA_INCOMPLETE,
                FileStatus.DISCARDED_FILESTORE_REJECTION,
            ).pack()
        ),
    ),
]


@pytest.mark.parametrize(("content", "theirs"), CASES, ids=lambda case: type(case).__name__)
def test_units_are_those_of_another_codec(content: Content, theirs: bytes) -> None:
    assert pack(TRANSACTION, content) == theirs
    assert unpack(theirs) == (TRANSACTION, content)


def test_identifiers_of_other_lengths_are_read() -> None:
    short = bytes((0x20, 0, 10, 0x00, 1, 4, 2)) + bytes((4, 0)) + bytes(8)
    assert unpack(short) == (Transaction(1, 4, 2), Eof(0, 0, 0))


@given(st.binary(max_size=60), st.integers(0, 8), st.integers(0, 255))
def test_damaged_units_are_refused_and_nothing_else_happens(noise: bytes, case: int, at: int) -> None:
    good = CASES[case][1]
    for data in (noise, good[: at % len(good)], good[: at % len(good)] + noise, b"\x20" + noise):
        try:
            transaction, content = unpack(data)
        except PduError:
            continue
        assert transaction.number < 1 << 32
        assert isinstance(content, Content)


@given(st.integers(0, 8), st.integers(0, 40), st.integers(0, 255))
def test_a_changed_byte_of_a_unit_is_refused_by_field_and_value_or_read(
    case: int, at: int, value: int
) -> None:
    good = bytearray(CASES[case][1])
    good[at % len(good)] = value
    refusal = ""
    try:
        unpack(bytes(good))
    except PduError as error:
        refusal = str(error)
    fields = ("version", "mode", "flag", "bytes", "byte ", "entities", "directive")
    assert not refusal or any(field in refusal for field in fields)
    assert not refusal or any(character.isdigit() for character in refusal)


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (b"\x20", "has 1 bytes"),
        (b"\xa0" + bytes(9), "CFDP version 5"),
        (b"\x24" + bytes(9), "transmission mode is 1"),
        (b"\x21" + bytes(9), "large file flag is 1"),
        (bytes((0x20, 0, 1, 0x00, 1, 4, 2, 99)), "directive 99 is not known"),
        (bytes((0x20, 0, 2, 0x00, 1, 4, 2, 4, 0)), "before its last field (directive 4, 2 bytes)"),
    ],
)
def test_a_refusal_names_the_field_and_its_value(data: bytes, named: str) -> None:
    with pytest.raises(PduError) as caught:
        unpack(data)
    assert named in str(caught.value)


def test_a_crc_is_checked_and_left_out_of_the_content() -> None:
    theirs = config()
    theirs.crc_flag = CrcFlag.WITH_CRC
    data = bytes(FileDataPdu(theirs, FileDataParams(b"abc", 900)).pack())
    assert unpack(data) == (TRANSACTION, FileData(900, b"abc"))
    for position in range(4, len(data)):
        with pytest.raises(PduError, match="CRC"):
            unpack(data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :])


@pytest.mark.parametrize("kind", [0x24, 0x22, 0x21, 0x00, 0x40])
def test_units_of_class_1_of_large_files_and_other_versions_are_refused(kind: int) -> None:
    with pytest.raises(PduError):
        unpack(bytes((kind,)) + pack(TRANSACTION, Eof(0, 0, 0))[1:])


def test_the_longest_units_fit_into_a_telecommand_frame() -> None:
    around = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + CRC_BYTES + HEADER_BYTES + SECONDARY_BYTES + CRC_BYTES
    for content in (FileData(0, bytes(SEGMENT_BYTES)), Nak(0, 1, ((0, 1),) * MOST_REQUESTS)):
        assert len(pack(TRANSACTION, content)) + around <= LONGEST_FRAME


@pytest.mark.parametrize("size", [0, 1, 7, (1 << 20) + 3])
def test_checksums_are_those_of_the_standard(tmp_path: Path, size: int) -> None:
    """The checksum is a sum of words (CCSDS 727.0-B-5, 4.2.5).

    The CRCs of "123456789" are published values.
    """
    data = bytes(i * 37 % 256 for i in range(size))
    path = tmp_path / "file"
    path.write_bytes(data)
    padded = data + bytes(-size % 4)
    words = (int.from_bytes(padded[i : i + 4], "big") for i in range(0, len(padded), 4))
    assert summed(path, MODULAR, size) == sum(words) % 2**32
    path.write_bytes(b"123456789")
    assert summed(path, CRC32, 9) == 0xCBF43926
    assert summed(path, CRC32C, 9) == 0xE3069283
    halves = add(CRC32C, add(CRC32C, 0, b"1234"), b"56789")
    assert halves == 0xE3069283


def summed(path: Path, kind: int, size: int) -> int:
    work = FileSum(path, kind, size)
    while (value := work.step()) is None:
        pass
    return value
