"""Writes one byte to one register over a Linux I2C adapter with the standard library alone; also a command.

The guardian switches the coils off through this module, and `deploy/coils-off` runs this file alone under any
Python where i2cset is missing:

    python3 smbus_byte.py /dev/i2c-1 0x40 0xfd 0x10

It uses the kernel's SMBus call (ioctl I2C_SMBUS, linux/i2c-dev.h) instead of write(2), so that adapters with
SMBus only work too, and avoids ctypes, which is slow to load.
"""

import fcntl
import os
import struct
import sys
from array import array

I2C_TIMEOUT = 0x0702
I2C_SLAVE = 0x0703
I2C_SMBUS = 0x0720
_SMBUS_WRITE = 0
_SMBUS_BYTE_DATA = 2
_DATA_BYTES = 34  # union i2c_smbus_data: a block, its length and a checksum
_TIMEOUT_UNITS = 2  # of 10 ms


class ByteBus:
    """An I2C adapter for writing; each failure is an OSError with the kernel's fault code."""

    def __init__(self, device: str) -> None:
        """Open an adapter's device file. Raises OSError."""
        self._descriptor = os.open(device, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.ioctl(self._descriptor, I2C_TIMEOUT, _TIMEOUT_UNITS)
        except OSError:
            self.close()
            raise

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte. Raises OSError."""
        data = array("B", bytes(_DATA_BYTES))
        data[0] = value
        # struct i2c_smbus_ioctl_data: read_write, command, size, data
        call = struct.pack("@BBIP", _SMBUS_WRITE, register, _SMBUS_BYTE_DATA, data.buffer_info()[0])
        fcntl.ioctl(self._descriptor, I2C_SLAVE, address)
        fcntl.ioctl(self._descriptor, I2C_SMBUS, call)

    def close(self) -> None:
        """Close the adapter. Safe to call twice."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def open_bus(where: str) -> ByteBus:
    """Return the open adapter `where`; the guardian's opener."""
    return ByteBus(where)


def main(arguments: list[str]) -> int:
    """Write the byte given by the arguments; return 0 done, 1 failed, 2 wrong use."""
    try:
        device, *numbers = arguments
        address, register, value = (int(number, 0) for number in numbers)
    except ValueError:
        sys.stderr.write("usage: smbus_byte.py DEVICE ADDRESS REGISTER VALUE\n")
        return 2
    try:
        bus = ByteBus(device)
        try:
            bus.write_byte_data(address, register, value)
        finally:
            bus.close()
    except OSError as error:
        sys.stderr.write(f"smbus_byte: {device}, address 0x{address:02x}: {error.strerror}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
