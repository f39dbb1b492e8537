"""Replacement of the kernel's /dev/i2c-N, in which an emulated bus performs the ioctls of smbus2."""

from __future__ import annotations

import ctypes
import errno
from typing import Any

from smbus2 import smbus2

from sim_hal.emulators import i2c_bus
from sim_hal.emulators.i2c_bus import EmulatedI2cBus, Message

I2C_RETRIES = 0x0701
I2C_TIMEOUT = 0x0702


class IoctlWire:
    """A callable that replaces fcntl.ioctl.

    Attributes:
        wire: the emulated bus that performs the transfers.
        settings: (request, value) of each change of timeout or retries, in order.
        functions: the adapter's functionality mask.
        slave_error: errno with which the selection of an address fails, or 0.
    """

    def __init__(self, wire: EmulatedI2cBus) -> None:
        self.wire = wire
        self._address = -1
        self.settings: list[tuple[int, int]] = []
        self.functions = i2c_bus.FUNCTIONS
        self.slave_error = 0

    def __call__(self, descriptor: int, request: int, argument: Any = 0) -> int:
        """Perform one ioctl. Raises OSError as the kernel does."""
        if request == smbus2.I2C_FUNCS:
            argument.value = self.functions
        elif request == smbus2.I2C_SLAVE:
            if self.slave_error:
                raise OSError(self.slave_error, "choosing the address")
            self._address = argument
        elif request in {I2C_TIMEOUT, I2C_RETRIES}:
            self.settings.append((request, argument))
        elif request == smbus2.I2C_SMBUS:
            self._transfer(argument)
        elif request == smbus2.I2C_RDWR:
            self._messages(argument)
        else:
            raise OSError(errno.ENOTTY, f"request 0x{request:04x}")
        return 0

    def _transfer(self, message: Any) -> None:
        union = message.data.contents if message.data else None
        sent = b"" if union is None else bytes(union.block)
        reading, command, size = message.read_write == 1, message.command, message.size
        answer = i2c_bus.smbus(self.wire, self._address, reading, command, size, sent)
        if union is not None:
            union.block[: len(answer)] = answer

    def _messages(self, argument: Any) -> None:
        messages = [argument.msgs[index] for index in range(argument.nmsgs)]
        answers = iter(
            self.wire.transfer(
                [
                    Message(m.addr, count=m.len) if m.flags & 1 else Message(m.addr, m.buf[: m.len])
                    for m in messages
                ]
            )
        )
        for message in messages:
            if message.flags & 1:
                ctypes.memmove(message.buf, next(answers), message.len)
