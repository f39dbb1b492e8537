"""Tests of the commands that configure a VN-100, by VectorNav UM001 v2.43, chapter 5."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from hal.drivers.vn100 import BAUD_RATES, PASSING_ERRORS, Question, Vn100Settings, check, set_up
from hal.drivers.vn100_protocol import Sentence
from hal.interfaces.errors import OutOfRange, Refused
from tests.hal.vn100.bench_line import MISSION

MODEL = ("VN-100T-CR",)
BINARY = ["RRG 1", "WRG 6 0", "WRG 44 0 1 5", "WRG 85 20 20 20 4 0 3 3 3 3 0", "WRG 76 0 20 01 0001",
          "WRG 77 0 20 01 0001", "WRG 75 1 20 05 0131 0100", "ASY 1"]  # fmt: skip
ASCII = ["RRG 1", "WRG 6 0", "WRG 44 0 1 5", "WRG 85 20 20 20 4 0 3 3 3 3 0", "WRG 76 0 20 01 0001",
         "WRG 77 0 20 01 0001", "WRG 75 0 20 01 0001", "WRG 30 0 0 0 0 3 0 1", "WRG 7 40", "WRG 6 8",
         "ASY 1"]  # fmt: skip


def converse(settings: Vn100Settings, answers: Mapping[str, tuple[str, ...]] | None = None) -> list[str]:
    """Return the commands of the set-up. The unit echoes each command for which no response is given."""
    dialogue = set_up(settings)
    asked: list[str] = []
    question = next(dialogue)
    while True:
        text = " ".join([question.command, *map(str, question.fields)])
        asked.append(text)
        echo = MODEL if question.command == "RRG" else tuple(map(str, question.fields[1:]))
        try:
            question = dialogue.send((answers or {}).get(text, echo))
        except StopIteration:
            return asked


@pytest.mark.parametrize(("output", "questions"), [("binary", BINARY), ("ascii", ASCII)])
def test_the_questions_are_those_of_the_manual(output: str, questions: list[str]) -> None:
    settings = replace(MISSION, output="binary" if output == "binary" else "ascii", rate_hz=40)
    assert converse(settings) == questions


def test_the_divisor_is_that_of_800_hz_and_the_port_that_of_the_cable() -> None:
    assert "WRG 75 2 40 05 0131 0100" in converse(replace(MISSION, unit_port=2, rate_hz=20))


@pytest.mark.parametrize(
    ("question", "echo"),
    [
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "5", "131", "100")),
        ("WRG 75 1 20 05 0131 0100", ("01", "0020", "05", "0131", "0100")),
        ("WRG 85 20 20 20 4 0 3 3 3 3 0", ("20", "20", "20", "04", "0", "3", "3.0", "3", "3", "0")),
        ("WRG 76 0 20 01 0001", ("0", "0", "00")),
    ],
)
def test_an_echo_with_other_zeros_is_the_same_number(question: str, echo: tuple[str, ...]) -> None:
    assert converse(MISSION, {question: echo}) == BINARY


@pytest.mark.parametrize(
    ("question", "echo"),
    [
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "05", "0131", "0101")),
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "05", "0131")),
        ("WRG 75 1 20 05 0131 0100", ("1", "20", "05", "013x", "0100")),
        ("WRG 44 0 1 5", ("1", "1", "5")),
        ("WRG 6 0", ("14",)),
        ("WRG 76 0 20 01 0001", ("1", "20", "01", "0001")),
        ("WRG 76 0 20 01 0001", ()),
        ("RRG 1", ("VN-200",)),
        ("RRG 1", ()),
    ],
)
def test_an_echo_of_another_value_is_refused(question: str, echo: tuple[str, ...]) -> None:
    with pytest.raises(Refused):
        converse(MISSION, {question: echo})


def test_an_answer_belongs_to_its_command_and_register() -> None:
    question = Question("WRG", (75, 1))
    assert question.answer(Sentence("WRG", ("75", "1"), "crc16")) == ("1",)
    assert question.answer(Sentence("WRG", ("075", "1"), "crc16")) == ("1",)
    assert question.answer(Sentence("WRG", ("76", "1"), "crc16")) is None
    assert question.answer(Sentence("RRG", ("75", "1"), "crc16")) is None
    assert question.answer(Sentence("WRG", (), "crc16")) is None
    assert question.complaint(Sentence("ERR", ("0C",), "crc16")) == (12, "error 0C, insufficient baud rate")
    assert question.complaint(Sentence("WRG", ("75",), "crc16")) is None
    assert question.text() == "$VNWRG,75,1"


def test_only_errors_of_the_line_are_worth_another_try() -> None:
    """Only errors of the line are retried.

    The codes are those of UM001 Table 18; -1 is an unreadable code.
    """
    assert {-1, 0x01, 0x02, 0x03, 0x0A, 0x0B, 0xFF} == PASSING_ERRORS
    assert BAUD_RATES == (115200, 230400, 921600, 460800, 57600, 38400, 19200, 9600)


@pytest.mark.parametrize(
    ("output", "rate_hz", "baud_rate", "possible"),
    [
        ("binary", 200, 460800, True),
        ("binary", 1, 9600, True),
        ("binary", 30, 921600, False),
        ("ascii", 16, 921600, False),
        ("ascii", 25, 115200, True),
        ("binary", 40, 38400, True),  # 67 bytes x 40 Hz x 10 bits = 26800 bit/s, 70 % of the line
        ("binary", 50, 38400, False),  # 87 % of the line
        ("ascii", 50, 115200, True),  # 137 bytes, 59 % of the line
        ("ascii", 100, 115200, False),  # 119 % of the line
    ],
)
def test_a_rate_must_be_one_of_the_unit_and_fit_into_80_percent_of_the_line(
    output: str, rate_hz: int, baud_rate: int, possible: bool
) -> None:
    settings = replace(MISSION, output="binary" if output == "binary" else "ascii", rate_hz=rate_hz)
    if possible:
        check(settings, baud_rate)
        return
    with pytest.raises((Refused, OutOfRange)):
        check(settings, baud_rate)


@pytest.mark.parametrize(("port", "possible"), [(0, False), (1, True), (2, True), (3, False)])
def test_the_unit_has_two_serial_ports(port: int, possible: bool) -> None:
    settings = replace(MISSION, unit_port=port)
    if possible:
        check(settings, 115200)
        return
    with pytest.raises(Refused, match="serial ports 1 and 2"):
        check(settings, 115200)
