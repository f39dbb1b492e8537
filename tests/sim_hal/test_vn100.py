"""Tests of the emulated VN-100: registers, settings, errors, clock, messages and filter commands."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.vn100_protocol import FIELDS, AsciiLine, BinaryPacket, build
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.clock import NEVER
from sim_hal.emulators.vn100 import (
    ASYNC_RATES_HZ,
    ASYNC_TYPES,
    BAUD_RATES,
    FIELD_BITS,
    REGISTERS,
    SUPPORTED_FIELDS,
    RegisterFile,
    UnitError,
    Vn100EmulatorSettings,
    binary_output,
)
from sim_hal.emulators.vn100_sensors import PROFILES, REPORTS
from tests.hal.vn100.bench_line import Bench

WATCHED = (1, 5, 6, 7, 21, 36, 38, 43, 44, 50, 51, 74, 75)


def test_by_default_the_unit_sends_vnymr_at_40_hz() -> None:
    items = Bench().run(1.0)
    assert 39 <= len(items) <= 41
    for item in items:
        assert isinstance(item, AsciiLine)
        assert (item.sentence.command, item.length) == ("YMR", 122)
        assert item.sentence.checksum == "xor8"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"$VNRRG,1*00\r\n", "03"),
        (b"$VNRRG,1*0000\r\n", "03"),
        (build("FOO"), "04"),
        (build("TAR", 1), "06"),
        (build("SFB", 0), "06"),
        (build("SIH"), "05"),
        (build("SIH", 10, 0), "05"),
        (build("SIH", 0, 0, 0, 1, 0), "06"),
        (build("SIH", "north"), "07"),
        (build("SIH", "inf"), "07"),
        (build("SIH", 0, 0, 0, 0), "07"),
        (build("WRG", 36, *(5,) * 8), "05"),
        (build("WRG", 36, *(5,) * 10), "06"),
        (build("WRG", 36, *(5,) * 8, 10.5), "07"),
        (build("WRG", 38, -1, *(5,) * 8), "07"),
        (build("WRG", 50, 1, 2), "05"),
        (build("WRG", 50, 1, 2, 3, 4), "06"),
        (build("WRG", 50, 1, 2, "nan"), "07"),
        (build("WRG", 51, 2, 0.1, 0.01), "07"),
        (build("WRG", 51, 1, 0.1), "05"),
        (build("WRG", 239, *(0,) * 9), "09"),
        (build("WRG", 240, *(0,) * 9), "09"),
        (build("RRG"), "05"),
        (build("WRG", 44, 1, 3), "05"),
        (build("WRG", 44, 1, 3, 5, 1), "06"),
        (build("WRG", 6, 7), "07"),
        (build("WRG", 7, 41), "07"),
        (build("WRG", 75, 1, 20, "08", "0001"), "07"),
        (build("WRG", 75, 1, 20, "01", "0040"), "07"),
        (build("WRG", 75, 1, 0, "01", "0001"), "07"),
        (build("WRG", 75, 1, 20, "05", "0001"), "05"),
        (build("WRG", 21, 1, 0, "nan", 0, 0, -9.8), "07"),
        (build("RRG", 99), "08"),
        (build("RRG", "x"), "08"),
        (build("WRG", 99, 1), "08"),
        (build("WRG", 1, "VN-1000"), "09"),
        (build("WRG", 8, 0, 0, 0), "09"),
        (build("WRG", 75, 1, 1, "01", "0531"), "0C"),
        (build("WRG", 5, 9600), "0C"),
        (build("BOM", 1), "07"),
    ],
)
def test_mistakes_get_their_error_codes_and_change_nothing(line: bytes, code: str) -> None:
    bench = Bench()
    bench.exchange(build("WRG", 7, 20), 0.1)
    bench.quiet()
    before = [bench.unit.registers.read(n) for n in WATCHED]
    (answer,) = bench.exchange(line)
    assert (answer.command, answer.fields) == ("ERR", (code,))
    assert [bench.unit.registers.read(n) for n in WATCHED] == before


def test_an_answer_has_the_type_of_checksum_of_its_command() -> None:
    bench = Bench().quiet()
    for question in ("xor8", "crc16"):
        (answer,) = bench.exchange(build("RRG", 1, checksum=question))
        assert (answer.checksum, answer.fields) == (question, ("1", "VN-100T-CR"))
    assert bench.exchange(b"$VNRRG,1*XX\r\n")[0].checksum == "xor8"


def test_register_30_sets_checksum_and_trailing_fields_of_its_lines() -> None:
    bench = Bench()
    bench.exchange(build("WRG", 30, 1, 1, 0, 0, 3, 0, 1))
    line = bench.run(0.1)[-1]
    assert isinstance(line, AsciiLine)
    assert line.sentence.checksum == "crc16"
    assert line.sentence.fields[-2:] == ("T0000000000", "S0000")
    assert len(line.sentence.fields) == 12 + 2


def test_the_error_mode_may_silence_errors() -> None:
    bench = Bench().quiet()
    bench.exchange(build("WRG", 30, 0, 0, 0, 0, 1, 0, 0))
    assert bench.exchange(build("FOO")) == []


def test_the_baud_rate_changes_after_the_answer() -> None:
    bench = Bench().quiet()
    (answer,) = bench.exchange(build("WRG", 5, 230400))
    assert answer.fields == ("5", "230400")
    assert bench.exchange(build("RRG", 1)) == []
    bench.line.host.set_baud_rate(230400)
    assert bench.exchange(b"\r\n" + build("RRG", 1))[-1].fields == ("1", "VN-100T-CR")


def test_settings_outlive_a_reset_only_when_saved() -> None:
    bench = Bench()
    bench.exchange(build("WRG", 6, 2))
    bench.exchange(build("RST"), 2.0)
    assert bench.unit.registers.read(6) == ("14",)
    bench.exchange(build("WRG", 6, 2))
    saved = bench.exchange(build("WNV"), 0.6)
    assert "WNV" in {sentence.command for sentence in saved}
    bench.exchange(build("RST"), 2.0)
    assert {i.sentence.command for i in bench.run(0.5) if isinstance(i, AsciiLine)} == {"QTN"}
    bench.exchange(build("RFS"), 2.0)
    assert {i.sentence.command for i in bench.run(0.5) if isinstance(i, AsciiLine)} == {"YMR"}


def test_after_a_reset_the_unit_is_silent_while_it_starts_and_its_clock_begins_at_zero() -> None:
    bench = Bench()
    bench.exchange(build("WRG", 75, 1, 20, "01", "0001"))
    bench.exchange(build("WNV"), 0.6)
    assert [s.command for s in bench.exchange(build("RST"), 0.02)][-1] == "RST"
    assert bench.run(0.9) == []
    packets = [item for item in bench.run(1.0) if isinstance(item, BinaryPacket)]
    assert packets[0].values == (25_000_000,)


def test_the_clock_of_the_unit_may_run_fast_and_out_of_phase() -> None:
    fast = Vn100EmulatorSettings(noise=PROFILES["none"], clock_ppm=20.0, uptime_ns=7_310_000_000)
    bench = Bench(fast).quiet()
    bench.exchange(build("WRG", 75, 1, 20, "01", "0001"))
    bench.exchange(build("ASY", 1))
    packets = [item for item in bench.run(100.0) if isinstance(item, BinaryPacket)]
    bench.run(1.0)
    last, first = packets[-1], packets[0]
    elapsed_ns = last.arrival_ns - first.arrival_ns
    counted_ns = float(last.values[0]) - float(first.values[0])
    assert counted_ns / elapsed_ns - 1.0 == pytest.approx(20e-6, rel=1e-3)
    assert float(first.values[0]) % 25_000_000 == 0.0


def test_every_ascii_output_has_the_values_of_its_register() -> None:
    bench = Bench()
    for report in REPORTS:
        bench.exchange(build("WRG", 6, report.async_type), 0.05)
        line = bench.run(0.1)[-1]
        assert isinstance(line, AsciiLine)
        assert line.sentence.command == report.header
        if report.register is not None and report.header != "DTV":
            answers = bench.exchange(build("RRG", report.register))
            (answer,) = [s for s in answers if s.command == "RRG"]
            assert answer.fields[1:] == line.sentence.fields


def test_every_binary_field_of_a_vn100_is_available_and_agrees_with_the_others() -> None:
    bench = Bench().quiet()
    values: dict[str, tuple[float, ...]] = {}
    for group, word in SUPPORTED_FIELDS.items():
        for bit, (_name, _) in enumerate(FIELDS[group]):
            if word >> bit & 1:
                echo = bench.exchange(build("WRG", 75, 0, 20, f"{1 << group:02X}", f"{1 << bit:04X}"))
                assert echo[-1].command == "WRG"
                bench.line.host.send(build("BOM", 1))
                (packet,) = bench.run(0.05)
                assert isinstance(packet, BinaryPacket)
                ((field, place),) = packet.layout.places.items()
                values[field] = tuple(float(v) for v in packet.values[place])
    a = attitude_matrix(np.array(values["attitude.quaternion"]))
    assert np.array(values["attitude.dcm"]).reshape(3, 3, order="F") == pytest.approx(a, abs=1e-6)
    accel = np.array(values["common.accel"])
    assert values["attitude.accel_ned"] == pytest.approx(a.T @ accel, abs=1e-5)
    assert values["attitude.accel_ned"] == pytest.approx([0.0, 0.0, -9.80665], abs=1e-5)
    assert values["attitude.linear_accel_ned"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    assert values["attitude.mag_ned"] == pytest.approx([4.5, 0.0, 0.0], abs=1e-5)
    yaw, pitch, roll = np.radians(values["common.yaw_pitch_roll"])
    # The Euler angles (3-2-1) rotate the axes about z, then about y, then about x.
    (cz, cy, cx), (sz, sy, sx) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    turn_z = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
    turn_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    turn_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    assert turn_x @ turn_y @ turn_z == pytest.approx(a, abs=1e-6)


def test_known_disturbances_show_in_the_status() -> None:
    bench = Bench().quiet()
    bench.exchange(build("WRG", 75, 0, 20, "10", "0001"))
    for command, bit in (("KMD", 11), ("KAD", 12)):
        for flag in (1, 0):
            bench.exchange(build(command, flag))
            bench.line.host.send(build("BOM", 1))
            (packet,) = bench.run(0.02)
            assert isinstance(packet, BinaryPacket)
            assert packet.values == (flag << bit,)


def test_a_flood_without_a_line_end_overflows_its_buffer() -> None:
    bench = Bench().quiet()
    answers = bench.exchange(b"A" * 300, 0.1)
    assert [s.fields for s in answers] == [("02",)]
    assert bench.exchange(b"A" * 10) == []
    assert bench.exchange(b"\r\n" + build("RRG", 1))[0].command == "RRG"


def test_the_receive_buffer_holds_256_bytes() -> None:
    bench = Bench().quiet()
    question = build("RRG", 1)
    assert bench.exchange(b"A" * (256 - len(question) + 1) + question[:-1], 0.1) == []
    assert bench.exchange(question[-1:])[0].command == "RRG"
    assert [s.fields for s in bench.exchange(b"A" * 257, 0.1)] == [("02",)]


numbers = map(str, range(0, 101, 5))
field = st.sampled_from([*numbers, "8", "44", "75", "01", "FFFF", "-1", "1e9", "nan", "", "é"])
commands = st.sampled_from(
    ["RRG", "WRG", "ASY", "KMD", "BOM", "WNV", "RST", "RFS", "SGB", "SIH", "TAR", "ERR", ""]
)


@given(
    st.lists(
        st.binary(max_size=40)
        | st.builds(
            lambda head, fields: b"$VN%b*XX\r\n" % ",".join((head, *fields)).encode(),
            commands,
            st.lists(field, max_size=12),
        ),
        max_size=12,
    )
)
@settings(max_examples=60, deadline=None)
def test_after_any_received_bytes_the_unit_continues_and_can_be_restored(lines: list[bytes]) -> None:
    bench = Bench()
    for line in lines:
        bench.exchange(line, 0.03)
    bench.run(1.6)
    bench.line.host.set_baud_rate(bench.line.device.baud_rate)
    bench.exchange(b"\r\n" + build("RFS"), 1.6)
    bench.line.host.set_baud_rate(115200)
    bench.run(0.1)
    assert {i.sentence.command for i in bench.run(0.2) if isinstance(i, AsciiLine)} == {"YMR"}


def test_a_unit_without_outputs_has_no_next_event() -> None:
    bench = Bench().quiet()
    assert bench.unit.next_event_ns() == NEVER
    bench.line.host.send(build("RRG", 1))
    assert bench.now_ns < bench.unit.next_event_ns() < NEVER


def test_bytes_take_their_time_on_the_line() -> None:
    bench = Bench().quiet()
    bench.line.device.write(bytes(range(100)), bench.now_ns)
    start_ns = bench.now_ns
    bench.now_ns = start_ns + round(10.5 * 10e9 / 115200)
    ((arrival_ns, data),) = bench.line.host.receive()
    assert data == bytes(range(10))
    assert arrival_ns == pytest.approx(start_ns + 10 * 10e9 / 115200, abs=1)
    bench.now_ns = start_ns + round(100 * 10e9 / 115200) + 1
    assert bench.line.host.receive()[0][1] == bytes(range(10, 100))


FACTORY = {
    0: "",
    1: "VN-100T-CR",
    2: "5",
    3: "0100012345",
    4: "2.1.0.0",
    5: "115200",
    6: "14",
    7: "40",
    21: "1,0,1.8,0,0,-9.79375",
    23: "1,0,0,0,1,0,0,0,1,0,0,0",
    25: "1,0,0,0,1,0,0,0,1,0,0,0",
    26: "1,0,0,0,1,0,0,0,1",
    30: "0,0,0,0,1,0,1",
    32: "3,0,0,0,6,1,0,100000000,0",
    33: "0,0,0",
    35: "1,1,1,1",
    36: "4,4,4,5,5,5,5.5,5.5,5.5",
    38: "5,5,5,3,3,3,4,4,4",
    43: "+00.000000,+00.000000,+00.000000",
    44: "1,3,5",
    47: "1,0,0,0,1,0,0,0,1,0,0,0",
    50: "0,0,0",
    51: "1,0.1,0.01",
    74: ",".join(["+00.000000"] * 7),
    75: "0,0,00",
    76: "0,0,00",
    77: "0,0,00",
    82: "0,0,0,0,0",
    83: "0,0,0,0,1000,0.000,+00.00000000,+000.00000000,+00000.000",
    84: "1,0,0,0,1,0,0,0,1,0,0,0",
    85: "0,4,4,4,0,0,3,3,3,0",
}
READ_ONLY = {1, 2, 3, 4, 47}
WITH_PORT = {5, 6, 7}


def test_the_factory_settings_are_those_of_the_manual() -> None:
    file = RegisterFile()
    assert {number: ",".join(fields) for number, fields in file.values.items()} == FACTORY


def test_identity_and_calibration_are_read_only_and_three_registers_take_a_port() -> None:
    assert {number for number, register in REGISTERS.items() if not register.writable} == READ_ONLY
    assert {number for number, register in REGISTERS.items() if register.port_option} == WITH_PORT


@pytest.mark.parametrize("number", sorted(set(REGISTERS) - READ_ONLY))
def test_the_factory_setting_of_a_writable_register_can_be_written(number: int) -> None:
    file = RegisterFile()
    default = file.values[number]
    assert file.write(number, default) == default
    with pytest.raises(UnitError, match="05"):
        file.write(number, default[:-1])
    too_many = default + ("0",) * (2 if number in WITH_PORT else 1)
    with pytest.raises(UnitError, match="06"):
        file.write(number, too_many)


LARGEST: dict[int, tuple[tuple[int, ...], ...]] = {
    30: ((0, 4), (0, 2), (0, 4), (0, 2), (1, 1), (0, 1), (0, 2)),
    32: ((0, 6), (0, 1), (0, 1), (0, 65535), (0, 6), (0, 1), (0, 65535), (0, 2**32 - 1), (0, 2**32 - 1)),
    33: ((0, 2**32 - 1),) * 3,
    35: ((0, 1), (0, 2), (0, 1), (0, 1)),
    36: ((0, 10),) * 9,
    38: ((0, 10),) * 9,
    44: ((0, 2), (3, 3), (1, 5)),
    82: ((0, 1), (0, 2), (0, 1), (0, 1), (0, 1)),
    85: ((0, 25),) * 5 + ((0, 3),) * 5,
}
"""Smallest and largest value of each field, up to the first gap in its valid values."""


@pytest.mark.parametrize(
    ("number", "place"),
    [(number, place) for number, fields in LARGEST.items() for place in range(len(fields))],
)
def test_a_field_takes_its_whole_range_and_nothing_beyond(number: int, place: int) -> None:
    low, high = LARGEST[number][place]
    for value in (low, high):
        file = RegisterFile()
        fields = list(file.values[number])
        fields[place] = str(value)
        file.write(number, tuple(fields))
        assert file.values[number] == tuple(fields)
    for value in (low - 1, high + 1):
        file = RegisterFile()
        fields = list(file.values[number])
        fields[place] = str(value)
        with pytest.raises(UnitError, match="07"):
            file.write(number, tuple(fields))


@pytest.mark.parametrize(
    ("place", "valid"), [(4, {1, 3}), (5, {0, 1, 3})], ids=["serial checksum", "SPI checksum"]
)
def test_register_30_takes_the_checksums_of_the_manual(place: int, valid: set[int]) -> None:
    for value in range(6):
        fields = list(REGISTERS[30].default)
        fields[place] = str(value)
        if value in valid:
            assert REGISTERS[30].checked(tuple(fields)) == tuple(fields)
        else:
            with pytest.raises(UnitError, match="07"):
                REGISTERS[30].checked(tuple(fields))


@pytest.mark.parametrize(
    ("number", "allowed", "values"),
    [
        (5, BAUD_RATES, "9600 19200 38400 57600 115200 128000 230400 460800 921600"),
        (6, ASYNC_TYPES, "0 1 2 8 9 10 11 12 13 14 16 17 19 30"),
        (7, ASYNC_RATES_HZ, "1 2 4 5 10 20 25 40 50 100 200"),
    ],
)
def test_speeds_types_and_rates_are_those_of_the_manual(
    number: int, allowed: tuple[int, ...], values: str
) -> None:
    assert [str(value) for value in allowed] == values.split()
    for value in values.split():
        assert RegisterFile().write(number, (value,)) == (value,)
        assert RegisterFile().write(number, (value, "1")) == (value, "1")
    for wrong in (("3",), (values.split(maxsplit=1)[0], "0"), (values.split(maxsplit=1)[0], "3")):
        with pytest.raises(UnitError, match="07"):
            RegisterFile().write(number, wrong)


def test_a_write_for_the_other_port_leaves_the_own_port_alone() -> None:
    file = RegisterFile()
    assert file.write(7, ("20", "2")) == ("20", "2")
    assert file.values[7] == ("40",)
    file.write(7, ("20", "1"))
    assert file.values[7] == ("20",)


def test_the_user_tag_has_up_to_20_characters() -> None:
    file = RegisterFile()
    file.write(0, ("x" * 20,))
    assert file.read(0) == ("x" * 20,)
    with pytest.raises(UnitError, match="07"):
        file.write(0, ("x" * 21,))


def test_the_fields_of_a_vn100_without_satellite_navigation_are_supported() -> None:
    assert SUPPORTED_FIELDS == {0: 0b0011_1111_0011_1101, 1: 0b1_1001_0001, 2: 0xFFF, 4: 0x1FF}


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        (("1", "20"), "05"),
        (("1", "20", "01"), "05"),
        (("1", "20", "01", "0001", "0001"), "06"),
        (("-1", "20", "01", "0001"), "07"),
        (("4", "20", "01", "0001"), "07"),
        (("1", "0", "01", "0001"), "07"),
        (("1", "65536", "01", "0001"), "07"),
        (("1", "20", "100", "0001"), "07"),
        (("1", "20", "00"), "07"),
        (("1", "20", "01", "0000"), "07"),
        (("1", "20", "01", "0002"), "07"),
        (("1", "20", "08", "0001"), "07"),
        (("1", "20", "01", "xyz"), "07"),
    ],
)
def test_a_binary_output_outside_the_manual_is_refused(fields: tuple[str, ...], code: str) -> None:
    with pytest.raises(UnitError, match=code):
        binary_output(fields)


def test_a_binary_output_has_the_ports_divisor_and_fields_of_its_register() -> None:
    output = binary_output(("3", "65535", "05", "0131", "0100"))
    assert output is not None
    assert (output.ports, output.divisor) == (3, 65535)
    assert output.layout.fields == ((0, 0), (0, 4), (0, 5), (0, 8), (2, 8))
    assert binary_output(("0", "0", "00")) is None
    assert binary_output(("0", "20", "01", "0001")) is not None


def test_a_binary_output_is_echoed_in_upper_case_with_all_digits() -> None:
    file = RegisterFile()
    assert file.write(75, ("01", "020", "5", "131", "1aF")) == ("1", "20", "05", "0131", "01AF")
    assert file.read(75) == ("1", "20", "05", "0131", "01AF")


def test_flash_keeps_what_was_saved_and_a_restore_brings_the_factory_settings() -> None:
    file = RegisterFile()
    file.write(7, ("20",))
    file.load()
    assert file.read(7) == ("40",)
    file.write(7, ("20",))
    file.save()
    file.write(7, ("10",))
    file.load()
    assert file.read(7) == ("20",)
    file.restore()
    assert file.integer(7) == 20
    file.load()
    assert file.integer(7) == 40
    assert (file.integer(44, 1), file.integer(44, 2)) == (3, 5)


def test_an_unknown_register_is_an_error() -> None:
    file = RegisterFile()
    with pytest.raises(UnitError, match="08"):
        file.read(99)
    with pytest.raises(UnitError, match="08"):
        file.write(99, ("1",))


def test_a_flipped_bit_changes_one_field_and_is_checked() -> None:
    assert FIELD_BITS == 16
    file = RegisterFile()
    with pytest.raises(UnitError, match="07"):
        file.flip(7, 7)  # 40 ^ 128 is 168 Hz, an invalid rate
    assert file.read(7) == ("168",)
    file.flip(7, FIELD_BITS)
    assert file.read(7) == ("168",), "a register with one field has no second field"
    file.write(75, ("1", "20", "01", "0131"))
    for bit in (1, FIELD_BITS, 3 * FIELD_BITS + 9):  # port 2, divisor 21, field bit 9
        file.flip(75, bit)
    assert file.read(75) == ("3", "21", "01", "0331")
    with pytest.raises(UnitError, match="05"):
        file.flip(75, 2 * FIELD_BITS + 4)
    assert file.read(75) == ("3", "21", "11", "0331")


NOISELESS = Vn100EmulatorSettings(noise=PROFILES["none"])


def angles(bench: Bench, register: int = 8) -> list[float]:
    """Return yaw, pitch and roll (deg)."""
    (answer,) = bench.exchange(build("RRG", register))
    return [float(text) for text in answer.fields[1:4]]


def command(bench: Bench, *words: object) -> tuple[str, ...]:
    """Send a command; return the fields of the response, with the command first."""
    (answer,) = bench.exchange(build(*map(str, words)))
    return answer.command, *answer.fields


@pytest.mark.parametrize(
    ("register", "default"),
    [
        (36, "4,4,4,5,5,5,5.5,5.5,5.5"),
        (38, "5,5,5,3,3,3,4,4,4"),
        (50, "0,0,0"),
        (51, "1,0.1,0.01"),
        (74, ",".join(["+00.000000"] * 7)),
    ],
)
def test_factory_settings_of_the_filters_registers(register: int, default: str) -> None:
    """Filter registers have the names, lengths and factory settings of VectorNav UM001 and the SDK."""
    bench = Bench().quiet()
    assert command(bench, "RRG", register) == ("RRG", str(register), *default.split(","))


@pytest.mark.parametrize("register", [36, 38, 50, 51])
def test_written_values_are_echoed_kept_and_saved(register: int) -> None:
    """Written values are echoed, kept and saved.

    The commands have the format of the SDK: numbers with six decimals, and register numbers with two digits.
    """
    bench = Bench().quiet()
    length = {36: 9, 38: 9, 50: 3, 51: 3}[register]
    values = [f"{0.5 * k + 0.25:f}" for k in range(length)]
    if register == 51:
        values[0] = "0"
    assert command(bench, "WRG", register, *values) == ("WRG", str(register), *values)
    assert command(bench, "RRG", f"{register:02d}") == ("RRG", str(register), *values)
    assert bench.exchange(build("WNV"), 0.6)[0].command == "WNV"
    bench.exchange(build("RST"), 1.5)
    bench.quiet()
    assert command(bench, "RRG", register)[2:] == tuple(values)


@pytest.mark.parametrize("register", [239, 240])
def test_linear_acceleration_has_its_registers_in_body_and_ned_axes(register: int) -> None:
    """Registers give the linear acceleration in body and NED axes, which is zero at rest.

    As in UM001's example, values in degrees, m/s^2 and rad/s have 3, 3 and 6 decimals.
    """
    bench = Bench().quiet()
    (answer,) = bench.exchange(build("RRG", register))
    assert len(answer.fields) == 1 + 9
    assert [len(text) for text in answer.fields[1:]] == [8, 8, 8, 7, 7, 7, 10, 10, 10]
    values = [float(text) for text in answer.fields[1:]]
    assert values[:3] == angles(bench)
    assert values[3:6] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    assert np.linalg.norm(values[6:]) == pytest.approx(0.02, abs=1e-5)


def test_tare_and_initial_heading_turn_the_attitude_about_the_vertical() -> None:
    bench = Bench(NOISELESS).quiet()
    turning = angles(bench)
    assert command(bench, "TAR") == ("TAR",)
    # During two exchanges of 20 ms each, the body rotates at 0.02 rad/s.
    assert angles(bench) == pytest.approx([0.0, *turning[1:]], abs=0.1)
    assert command(bench, "SIH", "+045.000") == ("SIH", "+045.000")
    assert angles(bench) == pytest.approx([45.0, *turning[1:]], abs=0.1)
    command(bench, "SIH", "-120", "30", "20")
    assert angles(bench, 239) == pytest.approx([-120.0, *turning[1:]], abs=0.1)
    # Quaternion (scalar last) of a rotation by 60 deg about the vertical. VectorNav's quaternion rotates body
    # into NED.
    command(bench, "SIH", 0, 0, 0.5, 0.866025)
    assert angles(bench, 240) == pytest.approx([60.0, *turning[1:]], abs=0.1)
    bench.exchange(build("RST"), 1.5)
    assert angles(bench.quiet())[0] == pytest.approx(turning[0], abs=3.0), "a reset finds north again"


def test_in_the_absolute_heading_mode_the_magnetometer_determines_the_heading() -> None:
    bench = Bench(NOISELESS).quiet()
    bench.exchange(build("WRG", 35, 1, 0, 1, 1))
    before = angles(bench)
    assert command(bench, "TAR") == ("TAR",)
    assert command(bench, "SIH", 90) == ("SIH", "90")
    assert angles(bench) == pytest.approx(before, abs=0.1)


def test_biases_are_stored_to_start_from() -> None:
    bias = np.array([1e-3, -2e-3, 3e-3])
    bench = Bench(dataclasses.replace(NOISELESS, gyro_bias=bias)).quiet()
    gyro = ("+00.001000", "-00.002000", "+00.003000")
    bench.exchange(build("WRG", 74, *(0.0,) * 3, *(0.1,) * 4))
    assert command(bench, "SGB") == ("SGB",)
    assert bench.unit.registers.read(43) == gyro
    assert bench.unit.registers.read(74) == (*gyro, *("0.1",) * 4)
    bench.exchange(build("WRG", 43, 0, 0, 0))
    assert command(bench, "SFB") == ("SFB",)
    assert bench.unit.registers.read(43) == gyro
    assert bench.unit.registers.read(74) == (*gyro, *("+00.000000",) * 4)
