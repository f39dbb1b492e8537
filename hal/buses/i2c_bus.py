"""Linux I2C bus through smbus2, with a lock for several threads and bounded waiting times.

A call waits until the previous transaction has ended. The transaction of the call then takes at most the
timeout of the I2C adapter, which is configured by ioctl I2C_TIMEOUT. Retries by the adapter are disabled
(I2C_RETRIES 0), so that the drivers count each failure.

An advisory lock on the device file reserves the bus for one flight process. The kernel releases the lock when
the process ends. The guardian and `deploy/coils-off` ignore the lock, because they may switch the coils off
at any time.
"""

from __future__ import annotations

import errno
import fcntl
import os
import threading
from collections.abc import Callable, Sequence
from fcntl import ioctl
from pathlib import Path
from typing import TypeVar

from smbus2 import I2cFunc, SMBus, i2c_msg

from hal.buses.smbus_byte import I2C_TIMEOUT
from hal.interfaces.errors import NotResponding, OutOfRange, Refused


def lock_bus(descriptor: int) -> None:
    """Lock an open file until it is closed. Raises OSError (EUSERS) if another process holds the lock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(errno.EUSERS, "another flight drives the coils on this bus") from error


_Answer = TypeVar("_Answer")

I2C_RETRIES = 0x0701
_TIMEOUT_UNIT_NS = 10_000_000
_BLOCK_LIMIT = 32

# Meanings of the kernel's fault codes (Documentation/i2c/fault-codes).
_MEANING = {
    errno.EREMOTEIO: "no acknowledge",
    errno.ENXIO: "no acknowledge of the address",
    errno.ETIMEDOUT: "time-out, the clock line may be held low",
    errno.EAGAIN: "arbitration lost",
    errno.EBUSY: "the address is held by a kernel driver",
    errno.EBADF: "the bus has been closed",
    errno.EUSERS: "another flight drives the coils on this bus",
}
# Errors that do not indicate a failure of the bus, so that the device file stays open.
_LINE_IN_ORDER = frozenset({errno.EREMOTEIO, errno.ENXIO, errno.EAGAIN, errno.EBUSY})


class LinuxI2cBus:
    """Thread-safe I2C bus /dev/i2c-N, whose device file is reopened after a bus failure."""

    def __init__(
        self,
        device: int | str,
        timeout_ns: int = 20_000_000,
        patient: bool = False,
        exclusive: bool = False,
    ) -> None:
        """Open a bus.

        Args:
            device: number N of the bus /dev/i2c-N, or a device file, for example with a udev name.
            timeout_ns: timeout of a transaction (ns), rounded up to the kernel's steps of 10 ms.
            patient: whether a bus that does not exist yet is opened by a later transaction instead of raising
                an error.
            exclusive: whether the bus is locked, so that two flight processes cannot drive the same coils.

        Raises NotResponding if there is no such bus. Raises Refused if the permission to open the bus is
        missing or the adapter does not support block transfers.
        """
        if timeout_ns <= 0:
            raise OutOfRange("i2c bus", "time-out", timeout_ns * 1e-9, 0.01, 1.0, "s")
        self.name = device_file(device)
        self._timeout_units = -(-timeout_ns // _TIMEOUT_UNIT_NS)
        # A transaction has at most two messages, and each message may time out.
        self._patience = 2.0 * self._timeout_units * _TIMEOUT_UNIT_NS * 1e-9
        self._exclusive = exclusive
        self._lock = threading.Lock()
        self._bus: SMBus | None = None
        self._closed = False
        try:
            self._bus = self._open()
        except FileNotFoundError as error:
            if patient:
                return
            raise NotResponding(self.name, _how_to_find_a_bus()) from error
        except PermissionError as error:
            raise Refused(self.name, "no permission: add the user to the group that owns it (i2c)") from error
        except OSError as error:
            reason = _MEANING.get(error.errno or 0, error.strerror)
            raise NotResponding(self.name, f"not a usable I2C bus: {reason}") from error
        if self._bus.funcs & I2cFunc.SMBUS_I2C_BLOCK != I2cFunc.SMBUS_I2C_BLOCK:
            self.close()
            raise Refused(self.name, "the adapter cannot do I2C block transfers; choose another bus")

    def write_byte(self, address: int, value: int) -> None:
        """Write one byte to a device without a register address."""
        self._transact(address, lambda bus: bus.write_byte(address, value))

    def read_byte_data(self, address: int, register: int) -> int:
        """Read one byte from a register of a device."""
        return self._transact(address, lambda bus: bus.read_byte_data(address, register))

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte to a register of a device."""
        self._transact(address, lambda bus: bus.write_byte_data(address, register, value))

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        """Read `length` bytes, at most 32, from consecutive registers of a device."""
        _check_length(length)
        answer = self._transact(address, lambda bus: bus.read_i2c_block_data(address, register, length))
        if len(answer) != length:
            raise OSError(errno.EIO, f"{len(answer)} bytes, not {length}, from 0x{address:02x}, {self.name}")
        return answer

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write at most 32 bytes to consecutive registers of a device."""
        _check_length(len(values))
        self._transact(address, lambda bus: bus.write_i2c_block_data(address, register, list(values)))

    def exchange(self, address: int, data: bytes, count: int) -> bytes:
        """Write `data` if there are any, then read `count` bytes after a repeated START, if any."""
        messages = [i2c_msg.write(address, data)] if data or not count else []
        if count:
            messages.append(i2c_msg.read(address, count))
        self._transact(address, lambda bus: bus.i2c_rdwr(*messages))
        return bytes(messages[-1]) if count else b""

    def close(self) -> None:
        """Close the bus. Calling `close` again has no effect."""
        self._closed = True
        # The bus is closed even without the lock, because a hung transaction must not delay the exit.
        locked = self._lock.acquire(timeout=self._patience)
        self._drop()
        if locked:
            self._lock.release()

    def _open(self) -> SMBus:
        bus = SMBus()
        try:
            bus.open(self.name)
            if bus.fd is not None:
                if self._exclusive:
                    lock_bus(bus.fd)
                ioctl(bus.fd, I2C_TIMEOUT, self._timeout_units)
                ioctl(bus.fd, I2C_RETRIES, 0)
        except OSError:
            bus.close()
            raise
        return bus

    def _drop(self) -> None:
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def _transact(self, address: int, action: Callable[[SMBus], _Answer]) -> _Answer:
        if not self._lock.acquire(timeout=self._patience):
            raise OSError(errno.ETIMEDOUT, f"a transaction on {self.name} does not end")
        try:
            if self._closed:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            if self._bus is None:
                self._bus = self._open()
            return action(self._bus)
        except OSError as error:
            code = error.errno or errno.EIO
            if code not in _LINE_IN_ORDER:
                self._drop()
            meaning = _MEANING.get(code, os.strerror(code))
            raise OSError(code, f"{meaning}, address 0x{address:02x} on {self.name}") from error
        finally:
            self._lock.release()


def device_file(bus: int | str) -> str:
    """Return the device file of a bus that is given by its number or its device file."""
    return f"/dev/i2c-{bus}" if isinstance(bus, int) else bus


def adapters(folder: Path = Path("/sys/bus/i2c/devices")) -> list[tuple[int, str]]:
    """Return the number and name of each I2C adapter that the kernel knows."""
    found = []
    for entry in folder.glob("i2c-*"):
        number = entry.name.removeprefix("i2c-")
        if number.isdigit() and (entry / "name").is_file():
            found.append((int(number), (entry / "name").read_text(encoding="utf-8").strip()))
    return sorted(found)


def _how_to_find_a_bus() -> str:
    known = adapters()
    if not known:
        return "no such bus, and the kernel knows no adapter: enable one in the firmware, modprobe i2c-dev"
    listing = ", ".join(f"i2c-{number} ({name})" for number, name in known)
    return (
        f"no such bus; the kernel knows {listing}. Is i2c-dev loaded? Numbers change between boots: use"
        ' the permanent name of a udev rule with SUBSYSTEM=="i2c-dev", ATTR{name} and SYMLINK+='
    )


def _check_length(length: int) -> None:
    if not 1 <= length <= _BLOCK_LIMIT:
        raise ValueError(f"a block of {length} bytes: SMBus carries 1 to {_BLOCK_LIMIT}")
