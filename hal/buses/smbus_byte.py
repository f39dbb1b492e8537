"""Module and command that writes one byte to an I2C register on Linux, without other packages.

The guardian switches the coils off through this module. If the program i2cset is not installed, the script
`deploy/coils-off` runs this file as a command:

    python3 smbus_byte.py /dev/i2c-1 0x40 0xfd 0x10

The module uses the kernel's SMBus call (ioctl I2C_SMBUS, linux/i2c-dev.h) instead of write(2), so that
SMBus-only adapters are supported. The module does not use ctypes, which is slow to load.
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
_DATA_BYTES = 34  # size of union i2c_smbus_data: block, length and checksum
_TIMEOUT_UNITS = 2  # timeout in units of 10 ms


class ByteBus:
    """I2C adapter for writing single bytes. Each failure raises OSError with the kernel's fault code."""

    def __init__(self, device: str) -> None:
        """Open the device file of an I2C adapter. Raises OSError."""
        self._descriptor = os.open(device, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.ioctl(self._descriptor, I2C_TIMEOUT, _TIMEOUT_UNITS)
        except OSError:
            self.close()
            raise

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte to a register of a device. Raises OSError."""
        data = array("B", bytes(_DATA_BYTES))
        data[0] = value
        # struct i2c_smbus_ioctl_data has the fields read_write, command, size and data.
        call = struct.pack("@BBIP", _SMBUS_WRITE, register, _SMBUS_BYTE_DATA, data.buffer_info()[0])
        fcntl.ioctl(self._descriptor, I2C_SLAVE, address)
        fcntl.ioctl(self._descriptor, I2C_SMBUS, call)

    def close(self) -> None:
        """Close the adapter. Calling `close` again has no effect."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def open_bus(where: str) -> ByteBus:
    """Open the I2C adapter with the device file `where`. The guardian opens the bus by this function."""
    return ByteBus(where)


def main(arguments: list[str]) -> int:
    """Write the byte given by the arguments.

    Return exit status 0 (done), 1 (failed) or 2 (wrong arguments).
    """
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
