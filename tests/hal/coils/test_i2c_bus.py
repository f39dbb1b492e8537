"""Tests that both I2C buses fulfil the contract of hal.interfaces.wires.I2cBus, and of all transfers."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from smbus2 import SMBus, i2c_msg

from hal.buses.linux_wires import LinuxI2cBus, adapters
from hal.interfaces.errors import NotResponding, OutOfRange, Refused
from sim_hal.emulators.i2c_bus import smbus
from tests.hal.coils.ioctl_wire import I2C_RETRIES, I2C_TIMEOUT, IoctlWire
from tests.hal.coils.rig import INA, PCA, Rig


def test_bytes_and_blocks_come_back_as_written(rig: Rig) -> None:
    rig.bus.write_byte_data(PCA, 0x00, 0x21)
    rig.bus.write_i2c_block_data(PCA, 0x06, list(range(1, 33)))
    assert rig.bus.read_byte_data(PCA, 0x06) == 1
    assert rig.bus.read_i2c_block_data(PCA, 0x06, 4) == [1, 2, 3, 4]
    assert rig.bus.read_i2c_block_data(INA, 0x00, 2) == [0x39, 0x9F]


def test_a_byte_without_a_register_reaches_all_parts_by_the_general_call(rig: Rig) -> None:
    rig.bus.write_byte_data(PCA, 0x06, 7)
    rig.bus.write_byte(0x00, 0x06)
    assert rig.bus.read_byte_data(PCA, 0x06) == 0, "0x06 is the PCA9685's software reset"
    assert rig.bus.read_i2c_block_data(INA, 0x00, 2) == [0x39, 0x9F]


@pytest.mark.parametrize("length", [0, 33])
def test_a_block_is_1_to_32_bytes(rig: Rig, length: int) -> None:
    with pytest.raises(ValueError, match="1 to 32"):
        rig.bus.write_i2c_block_data(PCA, 0x06, [0] * length)
    with pytest.raises(ValueError, match="1 to 32"):
        rig.bus.read_i2c_block_data(PCA, 0x06, length)


def test_faults_have_the_kernels_codes(rig: Rig) -> None:
    with pytest.raises(OSError, match="0x22") as caught:
        rig.bus.read_byte_data(0x22, 0x00)
    assert caught.value.errno == errno.EREMOTEIO
    rig.wire.bus.lose_arbitration()
    with pytest.raises(BlockingIOError, match="arbitration"):
        rig.bus.read_byte_data(PCA, 0x00)
    rig.wire.bus.hang(times=1)
    begin = rig.clock.now_ns()
    with pytest.raises(TimeoutError, match="time-out"):
        rig.bus.write_byte_data(PCA, 0x00, 0x10)
    assert rig.clock.now_ns() - begin == 20_000_000
    assert rig.bus.read_byte_data(PCA, 0x00) == 0x11, "in order again"


def test_flipped_bits_arrive_without_an_error(rig: Rig) -> None:
    rig.wire.bus.flip_bits(PCA, index=0, mask=0x80)
    assert rig.bus.read_byte_data(PCA, 0xFE) == 0x9E
    assert rig.bus.read_byte_data(PCA, 0xFE) == 0x1E


def test_a_write_cut_short_leaves_what_was_acknowledged(rig: Rig) -> None:
    rig.bus.write_byte_data(PCA, 0x00, 0x20)
    rig.wire.bus.nack(PCA, after=3)
    with pytest.raises(OSError, match="no acknowledge"):
        rig.bus.write_i2c_block_data(PCA, 0x06, [1, 2, 3, 4])
    assert rig.bus.read_i2c_block_data(PCA, 0x06, 4) == [1, 2, 0, 0x10]


def test_a_closed_bus_refuses_transfers_and_can_be_closed_twice(rig: Rig) -> None:
    rig.bus.close()
    rig.bus.close()
    with pytest.raises(OSError, match="closed"):
        rig.bus.read_byte_data(PCA, 0x00)


def test_the_adapter_gets_its_timeout_and_no_retries(kernel: IoctlWire) -> None:
    LinuxI2cBus("/dev/null", timeout_ns=25_000_000).close()
    assert kernel.settings == [(I2C_TIMEOUT, 3), (I2C_RETRIES, 0)]


def test_a_timeout_of_zero_is_refused(kernel: IoctlWire) -> None:
    with pytest.raises(OutOfRange, match="time-out"):
        LinuxI2cBus("/dev/null", timeout_ns=0)


@pytest.mark.parametrize("code", [errno.EIO, errno.ETIMEDOUT, errno.EREMOTEIO, errno.EBUSY])
def test_a_failed_transaction_does_not_release_the_lock_of_the_bus(
    kernel: IoctlWire, tmp_path: Path, code: int
) -> None:
    node = tmp_path / "i2c"
    node.touch()
    bus = LinuxI2cBus(str(node), exclusive=True)
    kernel.slave_error = code
    with pytest.raises(OSError, match="address 0x40") as caught:
        bus.read_byte_data(PCA, 0x00)
    assert caught.value.errno == code
    with pytest.raises(Refused, match="another flight drives the coils"):
        LinuxI2cBus(str(node), exclusive=True)
    kernel.slave_error = 0
    assert bus.read_byte_data(PCA, 0x00) == 0x11
    bus.close()


def test_an_adapter_that_is_plugged_in_again_is_opened_and_locked_again(
    kernel: IoctlWire, tmp_path: Path
) -> None:
    """The kernel gives an adapter that was unplugged and plugged in again a new device file."""
    node = tmp_path / "i2c"
    node.touch()
    before = len(os.listdir("/proc/self/fd"))
    bus = LinuxI2cBus(str(node), exclusive=True)
    node.rename(tmp_path / "unplugged")
    kernel.slave_error = errno.EIO
    with pytest.raises(OSError, match="Input/output error"):
        bus.read_byte_data(PCA, 0x00)
    assert len(os.listdir("/proc/self/fd")) == before, "the kernel waits until the file is closed"
    with pytest.raises(FileNotFoundError):
        bus.read_byte_data(PCA, 0x00)
    node.touch()
    kernel.slave_error = 0
    assert bus.read_byte_data(PCA, 0x00) == 0x11
    with pytest.raises(Refused, match="another flight drives the coils"):
        LinuxI2cBus(str(node), exclusive=True)
    bus.close()


def test_no_descriptor_leaks_when_opening_fails() -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        with pytest.raises(NotResponding, match="not a usable I2C bus"):
            LinuxI2cBus("/dev/null")  # the real kernel reports that this file is not an I2C adapter
    assert len(os.listdir("/proc/self/fd")) == before


def test_an_address_held_by_a_kernel_driver_is_reported(kernel: IoctlWire) -> None:
    bus = LinuxI2cBus("/dev/null")
    kernel.slave_error = errno.EBUSY
    with pytest.raises(OSError, match="held by a kernel driver, address 0x40 on /dev/null"):
        bus.read_byte_data(PCA, 0x00)
    bus.close()


def test_an_adapter_without_block_transfers_is_refused(kernel: IoctlWire) -> None:
    kernel.functions = 0x00010000
    with pytest.raises(Refused, match="block transfers"):
        LinuxI2cBus("/dev/null")


def test_a_bus_that_may_be_missing_is_opened_when_it_appears(kernel: IoctlWire, tmp_path: Path) -> None:
    name = tmp_path / "knightcube-i2c"
    bus = LinuxI2cBus(str(name), patient=True)
    with pytest.raises(FileNotFoundError):
        bus.read_byte_data(PCA, 0x00)
    name.symlink_to("/dev/null")
    assert bus.read_byte_data(PCA, 0x00) == 0x11
    bus.close()


def test_an_exclusive_bus_belongs_to_one_flight_and_is_locked_before_any_other_access(
    kernel: IoctlWire, tmp_path: Path
) -> None:
    """Only one flight can open a bus exclusively, and the bus is locked before any other access.

    Guardian and `check` open the bus without exclusive access, so they are never refused.
    """
    node = tmp_path / "i2c"
    node.touch()
    first = LinuxI2cBus(str(node), exclusive=True)
    settings = len(kernel.settings)
    with pytest.raises(Refused, match="another flight drives the coils"):
        LinuxI2cBus(str(node), exclusive=True)
    assert len(kernel.settings) == settings
    LinuxI2cBus(str(node)).close()
    first.close()
    LinuxI2cBus(str(node), exclusive=True).close()


def test_a_missing_bus_is_reported_with_the_available_buses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hal.buses.linux_wires.adapters", lambda: [(1, "Synopsys DesignWare I2C adapter")])
    with pytest.raises(NotResponding, match=r"/dev/i2c-97: .*i2c-1 \(Synopsys.*udev rule"):
        LinuxI2cBus(97)
    monkeypatch.setattr("hal.buses.linux_wires.adapters", list)
    with pytest.raises(NotResponding, match="modprobe i2c-dev"):
        LinuxI2cBus(97)


def test_adapters_are_read_from_sysfs(tmp_path: Path) -> None:
    for entry, name in (("i2c-10", "i915 gmbus"), ("i2c-2", "DesignWare"), ("i2c-PNP0C50:00", "touchpad")):
        (tmp_path / entry).mkdir()
        (tmp_path / entry / "name").write_text(name + "\n", encoding="utf-8")
    assert adapters(tmp_path) == [(2, "DesignWare"), (10, "i915 gmbus")]
    assert adapters(tmp_path / "nothing") == []


def test_a_transaction_that_never_ends_does_not_hold_the_others_for_ever(kernel: IoctlWire) -> None:
    """If a transaction never ends, the next caller gets an error.

    The adapter ignores its timeout in this case. The bus can still be closed.
    """
    entered, leave = threading.Event(), threading.Event()

    class Stuck(IoctlWire):
        def _transfer(self, message: object) -> None:
            entered.set()
            leave.wait(10.0)

    bus = LinuxI2cBus("/dev/null", timeout_ns=10_000_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("smbus2.smbus2.ioctl", Stuck(kernel.wire))
        stuck = threading.Thread(target=bus.read_byte_data, args=(PCA, 0x00))
        stuck.start()
        assert entered.wait(5.0)
        with pytest.raises(TimeoutError, match="does not end"):
            bus.read_byte_data(PCA, 0x00)
        bus.close()
        leave.set()
        stuck.join(5.0)
        assert not stuck.is_alive()


@pytest.fixture
def bus(kernel: IoctlWire) -> Iterator[SMBus]:
    """Open the emulated bus with smbus2."""
    assert kernel.wire.transactions == 0
    with SMBus("/dev/null") as opened:
        yield opened


def test_words_are_little_endian_on_the_wire(bus: SMBus) -> None:
    assert bus.read_word_data(INA, 0x00) == 0x9F39  # the register Config is 0x399F, high byte first
    bus.write_word_data(INA, 0x05, 0x3412)
    assert bus.read_i2c_block_data(INA, 0x05, 2) == [0x12, 0x34]
    assert bus.process_call(INA, 0x05, 0x7856) == 0x7856


def test_bytes_without_a_register_continue_at_the_pointer(bus: SMBus) -> None:
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


def test_faults_of_the_wire_affect_messages_too(bus: SMBus, kernel: IoctlWire) -> None:
    kernel.wire.flip_bits(PCA, index=1, mask=0x01)
    answer = i2c_msg.read(PCA, 2)
    bus.i2c_rdwr(i2c_msg.write(PCA, [0xFE]), answer)
    assert answer.buf[:2] == b"\x1e\x1f", "PRE_SCALE twice, the second byte disturbed"
    kernel.wire.nack(PCA)
    with pytest.raises(OSError, match="no acknowledge"):
        bus.i2c_rdwr(i2c_msg.write(PCA, [0xFE]), answer)


@pytest.mark.parametrize(("size", "code"), [(5, errno.EOPNOTSUPP), (7, errno.EOPNOTSUPP), (8, errno.EINVAL)])
def test_transfers_that_the_adapter_does_not_support_have_the_errors_of_the_kernel(
    kernel: IoctlWire, size: int, code: int
) -> None:
    """An adapter refuses transfers that it does not support, with the errors of the kernel.

    The refused transfers are a block with a length from the device, a block process call, and 33 bytes.
    """
    with pytest.raises(OSError, match=r"not supported|33 bytes") as caught:
        smbus(kernel.wire, PCA, True, 0x06, size, bytes((33,)))
    assert caught.value.errno == code
