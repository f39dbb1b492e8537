"""The connections of a board to its devices: serial ports, I2C buses and SPI devices, opened by name."""

from __future__ import annotations

import fcntl
import os
from array import array
from collections.abc import Sequence
from contextlib import ExitStack
from struct import Struct, pack

from hal.buses.i2c_bus import LinuxI2cBus, device_file
from hal.buses.serial_port import PySerialPort
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import Clock

SPI_MODE, SPI_SPEED, SPI_MESSAGE = 0x40016B01, 0x40046B04, 0x40006B00
"""Requests SPI_IOC_WR_MODE, SPI_IOC_WR_MAX_SPEED_HZ and SPI_IOC_MESSAGE(0) of linux/spi/spidev.h."""
SPI_TRANSFER = Struct("=QQIIHBBBBBB")
"""Layout of struct spi_ioc_transfer: buffers, length, speed, delay (us), bits, chip select change."""
FRAME_GAP_US = 20
"""Pause (us) between two frames; an ADIS16470 needs 16 us."""


class LinuxSpiDevice:
    """An SPI device /dev/spidevB.C, through the kernel's spidev driver."""

    def __init__(self, device: str, speed_hz: int, mode: int) -> None:
        """Open the device at a clock rate (Hz) in an SPI mode, 0 to 3. Raises NotResponding."""
        self._speed_hz = speed_hz
        try:
            self._descriptor = os.open(device, os.O_RDWR | os.O_CLOEXEC)
            fcntl.ioctl(self._descriptor, SPI_MODE, pack("=B", mode))
            fcntl.ioctl(self._descriptor, SPI_SPEED, pack("=I", speed_hz))
        except OSError as error:
            cure = "is the SPI bus enabled, and may this user open it?"
            raise NotResponding(device, f"cannot be opened ({error.strerror}): {cure}") from error

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        """Send frames one after the other, and return the bytes received during each. Raises OSError."""
        buffers = [(array("B", frame), array("B", bytes(len(frame)))) for frame in frames]
        request = SPI_MESSAGE | len(frames) * SPI_TRANSFER.size << 16
        calls = b"".join(
            SPI_TRANSFER.pack(
                *(half.buffer_info()[0] for half in pair),
                len(pair[0]),
                self._speed_hz,
                FRAME_GAP_US,
                8,
                # A chip select change after the last frame would keep the device selected.
                index < len(frames) - 1,
                *(0,) * 4,
            )
            for index, pair in enumerate(buffers)
        )
        fcntl.ioctl(self._descriptor, request, calls)
        return [received.tobytes() for _, received in buffers]

    def close(self) -> None:
        """Close the device."""
        os.close(self._descriptor)


class LinuxWires:
    """Connections of this machine (`hal.interfaces.wires.Wires`), which `stack` closes."""

    def __init__(
        self,
        clock: Clock,
        stack: ExitStack,
        coil_bus: int | str,
        patient: bool = False,
        exclusive: bool = False,
    ) -> None:
        """Open no device yet. The bus `coil_bus` is locked for this process if `exclusive` is true.

        If `patient` is true, a missing port or bus is opened later instead of raising an error.
        """
        self._clock, self._stack, self._coil_bus = clock, stack, coil_bus
        self._patient, self._exclusive = patient, exclusive
        self._ports: dict[str, PySerialPort] = {}
        self._buses: dict[str, LinuxI2cBus] = {}

    def serial(self, device: str, baud_rate: int) -> PySerialPort:
        """Return the serial port of a device file. Raises NotResponding."""
        if device not in self._ports:
            self._ports[device] = PySerialPort(device, baud_rate, self._clock, self._patient)
            self._stack.callback(self._ports[device].close)
        return self._ports[device]

    def i2c(self, bus: int | str | None = None) -> LinuxI2cBus:
        """Return the I2C bus with a number or device file; None means the bus of the coils.

        Raises DeviceError.
        """
        name, coils = device_file(self._coil_bus if bus is None else bus), device_file(self._coil_bus)
        if name not in self._buses:
            exclusive = self._exclusive and name == coils
            self._buses[name] = LinuxI2cBus(name, patient=self._patient, exclusive=exclusive)
            self._stack.callback(self._buses[name].close)
        return self._buses[name]

    def spi(self, device: str, speed_hz: int, mode: int) -> LinuxSpiDevice:
        """Return a device on an SPI bus. Raises NotResponding."""
        opened = LinuxSpiDevice(device, speed_hz, mode)
        self._stack.callback(opened.close)
        return opened
