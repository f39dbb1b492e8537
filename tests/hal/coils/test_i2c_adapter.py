"""Tests that the unchanged smbus2 performs each kind of transfer on the emulated bus by ioctls."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import pytest
from smbus2 import SMBus, i2c_msg

from sim_hal.emulators.i2c_bus import smbus
from tests.hal.coils.ioctl_wire import IoctlWire
from tests.hal.coils.rig import INA, PCA


@pytest.fixture
def bus(kernel: IoctlWire) -> Iterator[SMBus]:
    """Open the emulated bus with smbus2."""
    assert kernel.wire.transactions == 0
    with SMBus("/dev/null") as opened:
        yield opened


def test_words_are_little_endian_on_the_wire(bus: SMBus) -> None:
    assert bus.read_word_data(INA, 0x00) == 0x9F39  # Config is 0x399F, and the chip sends the high byte first
    bus.write_word_data(INA, 0x05, 0x3412)
    assert bus.read_i2c_block_data(INA, 0x05, 2) == [0x12, 0x34]
    assert bus.process_call(INA, 0x05, 0x7856) == 0x7856


def test_bytes_without_a_register_go_on_where_the_pointer_stands(bus: SMBus) -> None:
    bus.write_byte_data(PCA, 0x00, 0x20)
    bus.write_byte(PCA, 0x02)
    assert [bus.read_byte(PCA) for _ in range(3)] == [0xE2, 0xE4, 0xE8]


def test_an_smbus_block_carries_its_length(bus: SMBus) -> None:
    bus.write_byte_data(PCA, 0x00, 0x20)
    bus.write_block_data(PCA, 0x06, [7, 8])
    assert bus.read_i2c_block_data(PCA, 0x06, 3) == [2, 7, 8]


def test_messages_joined_by_repeated_starts_are_one_transaction(bus: SMBus, kernel: IoctlWire) -> None:
    bus.write_byte_data(PCA, 0x00, 0x20)
    before = kernel.wire.transactions
    answers = i2c_msg.read(PCA, 3), i2c_msg.read(INA, 2)
    bus.i2c_rdwr(i2c_msg.write(PCA, [0x02]), answers[0], i2c_msg.write(INA, [0x00]), answers[1])
    assert [answer.buf[: answer.len] for answer in answers] == [b"\xe2\xe4\xe8", b"\x39\x9f"]
    assert kernel.wire.transactions == before + 2, "one for each part that was addressed"


def test_a_part_that_is_absent_acknowledges_nothing(bus: SMBus) -> None:
    bus.write_quick(PCA)
    for attempt in (bus.write_quick, bus.read_byte):
        with pytest.raises(OSError, match="0x22") as caught:
            attempt(0x22)
        assert caught.value.errno == errno.EREMOTEIO


def test_faults_of_the_wire_meet_messages_too(bus: SMBus, kernel: IoctlWire) -> None:
    kernel.wire.flip_bits(PCA, index=1, mask=0x01)
    answer = i2c_msg.read(PCA, 2)
    bus.i2c_rdwr(i2c_msg.write(PCA, [0xFE]), answer)
    assert answer.buf[:2] == b"\x1e\x1f", "PRE_SCALE twice, the second byte disturbed"
    kernel.wire.nack(PCA)
    with pytest.raises(OSError, match="no acknowledge"):
        bus.i2c_rdwr(i2c_msg.write(PCA, [0xFE]), answer)


@pytest.mark.parametrize(("size", "code"), [(5, errno.EOPNOTSUPP), (7, errno.EOPNOTSUPP), (8, errno.EINVAL)])
def test_what_the_adapter_cannot_do_is_refused_like_the_kernels(
    kernel: IoctlWire, size: int, code: int
) -> None:
    """An adapter refuses transfers that it does not support, with the errors of the kernel.

    The refused transfers are a block with a length from the device, a block process call, and 33 bytes.
    """
    with pytest.raises(OSError, match=r"not supported|33 bytes") as caught:
        smbus(kernel.wire, PCA, True, 0x06, size, bytes((33,)))
    assert caught.value.errno == code
