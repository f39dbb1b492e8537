"""SMBus transfers on the emulated bus, as a Linux adapter without SMBus hardware makes them of messages.

Numbers of the transfers and layout of their data: linux/i2c.h (the union i2c_smbus_data). Words are little
endian. Not offered: block reads whose length the part sends, packet error checking, ten-bit addresses.
"""

from __future__ import annotations

import errno

from sim_hal.emulators.i2c_bus import EmulatedI2cBus, Message

_BLOCK, _OLD_I2C_BLOCK = 5, 6
BLOCK_MAX = 32
DATA_LENGTH = BLOCK_MAX + 2
"""Bytes of the union i2c_smbus_data."""

FUNCTIONS = 0x00000001 | 0x00FF0000 | 0x02000000 | 0x0C000000
"""Plain I2C; SMBus quick, byte, byte data, word data, process call and block write; I2C blocks."""


def smbus(
    bus: EmulatedI2cBus, address: int, reading: bool, command: int, size: int, data: bytes = b""
) -> bytes:
    """Carry out one transfer of ioctl I2C_SMBUS; return the union's new content, unpadded, empty for a write.

    Raises OSError as a bus does, and with EOPNOTSUPP or EINVAL as an adapter does.
    """
    head = bytes((command,))
    match size:
        case 0:  # quick
            messages = [Message(address, count=0 if reading else None)]
        case 1:  # byte
            messages = [Message(address, count=1) if reading else Message(address, head)]
        case 2 | 3:  # byte data, word data
            length = size - 1
            asked = [Message(address, head), Message(address, count=length)]
            messages = asked if reading else [Message(address, head + data[:length])]
        case 4:  # process call
            messages = [Message(address, head + data[:2]), Message(address, count=2)]
        case 5 | 6 | 8 if not (size == _BLOCK and reading):
            return _block(bus, address, reading, head, size, data)
        case _:
            raise OSError(errno.EOPNOTSUPP, f"SMBus transfer {size} is not offered")
    return b"".join(bus.transfer(messages))


def _block(bus: EmulatedI2cBus, address: int, reading: bool, head: bytes, size: int, data: bytes) -> bytes:
    """Carry out a block transfer; on the wire an SMBus block carries its length, an I2C block does not."""
    # Programs that ask for a block by its old number read a whole one.
    length = BLOCK_MAX if size == _OLD_I2C_BLOCK and reading else data[0]
    if not 1 <= length <= BLOCK_MAX:
        raise OSError(errno.EINVAL, f"a block of {length} bytes")
    if reading:
        (given,) = bus.transfer([Message(address, head), Message(address, count=length)])
        return bytes((length,)) + given
    bus.transfer([Message(address, head + data[size != _BLOCK : 1 + length])])
    return b""
