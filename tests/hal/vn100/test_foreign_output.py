"""Tests that a VN-100 with unexpected output is detected, and then configured at its own baud rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.vn100_protocol import LONGEST_LINE, BinaryPacket, StreamParser, build, crc16, layout_of
from tests.hal.vn100.bench_line import MISSION, BenchLine, bench_line

INPUT = Path(__file__).resolve().parents[4] / "shared/data/inputs/vn-gnss.bin"


def packet(header: bytes, length: int) -> bytes:
    """Return a packet with a header (group byte and field words) and a payload of `length` bytes."""
    body = header + bytes(range(length % 200)) + bytes(length - length % 200)
    return b"\xfa" + body + crc16(body).to_bytes(2, "big")


FOREIGN = {
    "groups 1, 4 and 6": packet(bytes.fromhex("29310110020100"), 74),
    "group 4 alone": packet(bytes.fromhex("080100"), 8),
    "a field word with an extension": packet(bytes.fromhex("0131810100"), 52),
    "a group byte with an extension": packet(bytes.fromhex("8101010001"), 20),
    "groups 1 and 6 with long fields": packet(bytes.fromhex("21c0000018"), 132),
}


def save(bench: BenchLine, sent: bytes, divisor: int = 20) -> None:
    bench.unit.save_foreign_output(sent, divisor, bench.clock.now_ns())


def changed_rates(bench: BenchLine) -> list[int]:
    """Return a list to which each later change of the host's baud rate is appended."""
    rates: list[int] = []
    change = bench.line.host.set_baud_rate

    def listen(baud_rate: int) -> None:
        rates.append(baud_rate)
        change(baud_rate)

    bench.line.host.set_baud_rate = listen  # type: ignore[method-assign]  # records the calls
    return rates


def seconds_until_readings(bench: BenchLine) -> float:
    """Return the time (s), at most 8 s, until readings have arrived at 40 Hz for half a second."""
    seconds = 0.0
    while seconds < 8.0:
        seconds += 0.5
        if len(bench.run(0.5)) >= 19:
            break
    return seconds


def assert_set_right(bench: BenchLine) -> None:
    assert bench.unit.registers.read(75) == ("1", "20", "05", "0131", "0100")
    assert bench.unit.registers.read(6) == ("0",)
    assert bench.unit.registers.read(85)[:3] == ("20", "20", "20")
    assert len(bench.run(1.0)) >= 39


@pytest.mark.skipif(not INPUT.is_file(), reason="../shared/data/inputs/vn-gnss.bin is missing")
def test_the_output_of_the_report_is_recognised_and_set_right_in_flight() -> None:
    data = INPUT.read_bytes()
    parser = StreamParser()
    assert parser.feed(0, data) == []
    assert (parser.foreign, parser.bytes_received) == (7, 672)
    bench = bench_line()
    bench.driver.configure()
    bench.run(1.0)
    rates = changed_rates(bench)
    save(bench, data[:84])
    assert seconds_until_readings(bench) <= 2.5, "one second of it is the start of the unit"
    assert rates == []
    assert_set_right(bench)


@pytest.mark.parametrize("kind", FOREIGN)
@pytest.mark.parametrize("divisor", [20, 80, 400])
def test_an_unknown_output_after_a_reset_is_set_right_without_baud_hunting(kind: str, divisor: int) -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(1.0)
    rates = changed_rates(bench)
    save(bench, FOREIGN[kind], divisor)
    assert seconds_until_readings(bench) <= 3.0
    assert rates == []
    assert_set_right(bench)


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_unit_with_an_unknown_output_is_set_up_at_the_start(kind: str) -> None:
    bench = bench_line()
    save(bench, FOREIGN[kind], 20)
    bench.run(1.5)
    bench.driver.configure()
    assert_set_right(bench)


def test_an_unknown_output_at_another_baud_rate_is_found() -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(1.0)
    bench.unit.set_baud_rate(57600)
    save(bench, FOREIGN["groups 1, 4 and 6"])
    assert seconds_until_readings(bench) <= 6.0
    assert_set_right(bench)
    assert bench.line.host.baud_rate == bench.line.device.baud_rate == 115200


@pytest.mark.parametrize("kind", ["6 14", "6 1", "76 1 40 01 0008", "77 1 80 14 0400 0002"])
def test_an_additional_output_is_switched_off_in_flight(kind: str) -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(1.0)
    rates = changed_rates(bench)
    register, *fields = kind.split()
    bench.line.host.send(build("WRG", register, *fields))
    bench.run(0.05)
    assert bench.unit.registers.read(int(register))[0] != "0"
    readings = bench.run(2.0)
    assert bench.unit.registers.read(int(register))[0] == "0"
    assert len(readings) >= 75
    assert rates == []
    assert_set_right(bench)


def test_other_lines_than_the_configured_ones_are_switched_off() -> None:
    bench = bench_line(settings=replace(MISSION, output="ascii", rate_hz=20))
    bench.driver.configure()
    bench.run(1.0)
    bench.line.host.send(build("WRG", 76, 1, 40, "01", "0008"))
    bench.run(2.0)
    assert bench.unit.registers.read(76)[0] == "0"
    assert len(bench.run(1.0)) >= 19


def test_one_unexpected_packet_now_and_then_changes_nothing() -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(1.0)
    for _ in range(6):
        bench.line.host.send(build("BOM", 1))
        bench.run(3.0)
    bench.line.host.send(build("RRG", 8))
    bench.run(1.0)
    assert bench.driver.recoveries == 0


@given(st.binary(max_size=400), st.integers(1, 200), st.integers(8, 300))
def test_unknown_packets_in_noise_are_counted_and_the_next_reading_is_found(
    noise: bytes, piece: int, length: int
) -> None:
    parser, foreign = StreamParser(longest=128), packet(bytes.fromhex("29310110020100"), length)
    wanted = layout_of({0: 0x0131, 2: 0x0100})
    sound = wanted.pack((1, *(0.0,) * 13))
    data = noise + foreign * 3 + sound + bytes(LONGEST_LINE)
    items = [item for at in range(0, len(data), piece) for item in parser.feed(at, data[at : at + piece])]
    assert [item.layout for item in items if isinstance(item, BinaryPacket)] == [wanted]
    assert parser.foreign >= 2
