"""Tests of the emulated VN-100's registers: factory settings and valid values of UM001 v2.43 ch. 5."""

from __future__ import annotations

import pytest

from sim_hal.emulators.vn100 import (
    ASYNC_RATES_HZ,
    ASYNC_TYPES,
    BAUD_RATES,
    FIELD_BITS,
    REGISTERS,
    SUPPORTED_FIELDS,
    RegisterFile,
    UnitError,
    binary_output,
)

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
"""Smallest and largest value of each field, up to the first gap in the valid range."""


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
        file.flip(7, 7)  # 40 ^ 128 is 168 Hz, which the unit does not have
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
