"""The kernel's side of /dev/i2c-N, replaced: the ioctls that smbus2 makes, answered by an emulated bus."""

from __future__ import annotations

import errno
from typing import Any

from smbus2 import smbus2

from sim_hal.emulators.i2c_bus import EmulatedI2cBus

I2C_RETRIES = 0x0701
I2C_TIMEOUT = 0x0702


class IoctlWire:
    """Callable in place of fcntl.ioctl.

    Attributes:
        wire: the emulated bus that answers.
        settings: (request, value) of every time-out and retry setting made, in order.
        functions: the adapter's functionality mask.
        slave_error: errno that choosing an address raises, 0 for none.
    """

    def __init__(self, wire: EmulatedI2cBus) -> None:
        self.wire = wire
        self._address = -1
        self.settings: list[tuple[int, int]] = []
        self.functions = int(smbus2.I2cFunc.I2C | smbus2.I2cFunc.SMBUS_EMUL)
        self.slave_error = 0

    def __call__(self, descriptor: int, request: int, argument: Any = 0) -> int:
        """Answer one ioctl as the kernel would; raises OSError as it would."""
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
        else:
            raise OSError(errno.ENOTTY, f"request 0x{request:04x}")
        return 0

    def _transfer(self, message: Any) -> None:
        data = message.data.contents
        reading = message.read_write == smbus2.I2C_SMBUS_READ
        if message.size == smbus2.I2C_SMBUS_BYTE_DATA:
            if reading:
                data.byte = self.wire.read_byte_data(self._address, message.command)
            else:
                self.wire.write_byte_data(self._address, message.command, data.byte)
        elif message.size == smbus2.I2C_SMBUS_I2C_BLOCK_DATA:
            length = data.block[0]
            if reading:
                answer = self.wire.read_i2c_block_data(self._address, message.command, length)
                data.block[1 : length + 1] = answer
            else:
                self.wire.write_i2c_block_data(self._address, message.command, data.block[1 : length + 1])
        else:
            raise OSError(errno.EOPNOTSUPP, f"SMBus size {message.size}")
