"""Tests that a byte is transferred by the kernel's SMBus ioctl with the memory layout of smbus2."""

from __future__ import annotations

import ctypes
import errno
import struct
from pathlib import Path

import pytest
from smbus2.smbus2 import I2C_SMBUS_BYTE_DATA, I2C_SMBUS_WRITE, i2c_smbus_ioctl_data

from hal.buses import smbus_byte


class Kernel:
    """Test double of ioctl(2) that records each call and the data to which its pointer refers."""

    def __init__(self, failing: int = 0) -> None:
        self.calls: list[tuple[int, object]] = []
        self.data = b""
        self._failing = failing

    def __call__(self, _: int, request: int, argument: int | bytes) -> int:
        if self._failing and request == smbus_byte.I2C_SMBUS:
            raise OSError(self._failing, "no acknowledge")
        if isinstance(argument, bytes):
            address = struct.unpack("@BBIP", argument)[3]
            self.data = ctypes.string_at(address, 34)
        self.calls.append((request, argument))
        return 0


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    kernel = Kernel()
    monkeypatch.setattr("fcntl.ioctl", kernel)
    return kernel


@pytest.fixture
def device(tmp_path: Path) -> str:
    (tmp_path / "i2c-7").touch()
    return str(tmp_path / "i2c-7")


def test_the_call_is_laid_out_as_smbus2_lays_it_out(kernel: Kernel, device: str) -> None:
    assert smbus_byte.main([device, "0x40", "0xfd", "0x10"]) == 0
    (_, (slave, address), (smbus, call)) = kernel.calls
    assert (slave, address, smbus) == (0x0703, 0x40, 0x0720)
    theirs = i2c_smbus_ioctl_data.create(read_write=I2C_SMBUS_WRITE, command=0xFD, size=I2C_SMBUS_BYTE_DATA)
    assert isinstance(call, bytes)
    assert len(call) == ctypes.sizeof(theirs)
    assert call[:8] == bytes(theirs)[:8]
    assert kernel.data[0] == 0x10


def test_a_chip_that_does_not_answer_is_one_line_and_status_1(
    monkeypatch: pytest.MonkeyPatch, device: str, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fcntl.ioctl", Kernel(errno.EREMOTEIO))
    assert smbus_byte.main([device, "0x40", "0xfd", "0x10"]) == 1
    assert capsys.readouterr().err == f"smbus_byte: {device}, address 0x40: no acknowledge\n"


def test_a_file_that_is_not_an_adapter_gives_status_1(
    device: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert smbus_byte.main([device, "0x40", "0xfd", "0x10"]) == 1
    assert "ioctl" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["/dev/i2c-1"], ["/dev/i2c-1", "x", "1", "2"], ["/d", "1", "2"]])
def test_wrong_use_is_status_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert smbus_byte.main(arguments) == 2
    assert "usage" in capsys.readouterr().err
