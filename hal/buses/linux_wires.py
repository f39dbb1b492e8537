"""Serial ports, I2C buses and SPI devices of a Linux machine.

The receiving thread of a serial port records the arrival times of the data, and reopens a lost port. A udev
rule keeps the device name when an adapter is unplugged and plugged in again.

A call on an I2C bus waits until the previous transaction has ended. A transaction takes at most the timeout
of the I2C adapter, which is configured by ioctl I2C_TIMEOUT. Retries by the adapter are disabled (I2C_RETRIES
0), so that the drivers count each failure. An advisory lock on the device file reserves the bus for one
flight process. The kernel releases the lock when the process ends. A failed transaction does not release the
lock, unless the adapter was unplugged. The guardian and `deploy/coils-off` ignore the lock, because they must
be able to switch the coils off at any time.
"""

from __future__ import annotations

import errno
import os
import select
import termios
import threading
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from fcntl import LOCK_EX, LOCK_NB, flock, ioctl
from pathlib import Path
from struct import Struct, pack
from typing import TypeVar

import serial
from smbus2 import I2cFunc, SMBus, i2c_msg

from hal.buses.smbus_byte import I2C_TIMEOUT
from hal.interfaces.errors import NotResponding, OutOfRange, OutputFull, Refused
from hal.interfaces.wires import SECOND_NS, Clock

_READ_TIMEOUT_S = 0.1  # longest time (s) until the thread notices that the port is to be closed
_WRITE_TIMEOUT_S = 0.005  # longest time (s) to wait while the kernel's buffer is full, a fifth of a cycle
_CLOSE_S = 2.0  # longest time (s) to wait for the thread at the end
_PENDING_LIMIT = 1 << 16
_REOPEN_S = 0.25

# Exceptions of pyserial's POSIX implementation; pyserial's own exceptions are subclasses of OSError.
_PORT_ERRORS = (OSError, termios.error, ValueError, TypeError)


class PySerialPort:
    """Serial port in raw 8N1 mode without flow control, opened exclusively.

    The class implements `hal.interfaces.wires.SerialPort`. Opening a port sets the modem lines DTR and RTS,
    which are not used otherwise. A pseudo-terminal has no modem lines, and works as well.

    Attributes:
        baud_rate: baud rate of the port, bits per second.
        lost_bytes: number of received bytes that were dropped because `receive` was called too rarely.
    """

    def __init__(
        self,
        device: str,
        baud_rate: int,
        clock: Clock,
        patient: bool = False,
        write_timeout: float = _WRITE_TIMEOUT_S,
    ) -> None:
        """Open the port.

        Raises NotResponding if the port cannot be opened. If `patient` is true, a missing port counts as
        lost instead, and is opened later. A call of `send` waits at most `write_timeout`, s, for the port and
        as long for its output queue; the default is short enough for the thread that drives the coils.
        """
        self.baud_rate = baud_rate
        self.lost_bytes = 0
        self._device, self._write_timeout, self._clock = device, write_timeout, clock
        self._pending: deque[tuple[int, bytes]] = deque()
        self._pending_bytes = 0
        self._lock = threading.Lock()
        # The lock is held while the port is used or replaced, because a closed descriptor may be reused.
        self._port_lock = threading.Lock()
        self._failure = ""
        self._closing = threading.Event()
        try:
            self._serial = self._open()
        except _PORT_ERRORS as error:
            # The text of pyserial's exceptions repeats the device and the error number.
            number = error.errno if isinstance(error, OSError) else None
            reason = os.strerror(number) if number else str(error)
            self._failure = (
                f"cannot be opened at {baud_rate} baud ({reason}): is the device plugged in, the name right, "
                "the port free, and may this user open it (group dialout)?"
            )
            if not patient:
                raise NotResponding(device, self._failure) from error
            self._serial = serial.Serial()  # not open
        self._thread = threading.Thread(target=self._read, name=f"serial {device}", daemon=True)
        self._thread.start()

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the data received since the last call as tuples (arrival_ns, bytes), oldest first.

        Raises NotResponding if the port is lost and all data received before the loss have been returned.
        """
        with self._lock:
            chunks = list(self._pending)
            self._pending.clear()
            self._pending_bytes = 0
        if not chunks and self._failure:
            raise NotResponding(self._device, self._failure)
        return chunks

    def send(self, data: bytes) -> None:
        """Write bytes. Raises NotResponding if the port is lost, or OutputFull."""
        if self._failure:
            raise NotResponding(self._device, self._failure)
        try:
            with self._held():
                written = self._write(data)
        except _PORT_ERRORS as error:
            message = f"writing failed ({error}): is the device still there?"
            raise NotResponding(self._device, message) from error
        if written < len(data):
            raise OutputFull(self._device, written)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change the baud rate. Raises NotResponding if the port rejects the baud rate."""
        # The baud rate is stored even if the port is lost, because the port is reopened at this rate.
        self.baud_rate = baud_rate
        try:
            with self._held():
                self._serial.baudrate = baud_rate
        except _PORT_ERRORS as error:
            raise NotResponding(self._device, f"does not support {baud_rate} baud ({error})") from error

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closing.is_set()

    def close(self) -> None:
        """Stop the thread and close the port. Calling `close` again has no effect."""
        if self._closing.is_set():
            return
        self._closing.set()
        is_held = self._port_lock.acquire(timeout=_CLOSE_S)  # otherwise the thread is closing the port
        if is_held:
            self._serial.cancel_read()  # has no effect on a port that is not open
            self._port_lock.release()
        self._thread.join(timeout=_CLOSE_S)
        if is_held:
            self._serial.close()
        self._failure = self._failure or "the port was closed"

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Hold the lock of the port. Raises NotResponding if another thread holds it for too long.

        The receiving thread holds it while it closes a lost port. This can take 30 s, because the kernel
        waits for the output queue.
        """
        if not self._port_lock.acquire(timeout=self._write_timeout):
            raise NotResponding(self._device, "the port is busy, or is being closed")
        try:
            yield
        finally:
            self._port_lock.release()

    def _write(self, data: bytes) -> int:
        """Write bytes, and wait while the output queue is full. Return the number of written bytes.

        The method `write` of pyserial also raises an error if all bytes were written but the thread was
        suspended in between.
        """
        file, until_ns = self._serial.fileno(), self._clock.now_ns() + round(self._write_timeout * SECOND_NS)
        written = 0
        while written < len(data):
            with suppress(BlockingIOError):
                written += os.write(file, data[written:])
            left = max(until_ns - self._clock.now_ns(), 0) / SECOND_NS
            if written < len(data) and not select.select([], [file], [], left)[1]:
                break
        return written

    def _open(self) -> serial.Serial:
        return serial.Serial(self._device, self.baud_rate, timeout=_READ_TIMEOUT_S, exclusive=True)

    def _read(self) -> None:
        if self._failure:
            self._open_again()
        while not self._closing.is_set():
            try:
                # The thread waits for the first byte, and then reads all bytes that have arrived.
                data = self._serial.read(1)
                if data:
                    data += self._serial.read(self._serial.in_waiting)
            except _PORT_ERRORS as error:
                if not self._closing.is_set():
                    self._failure = f"reading failed ({error}): is the device still there?"
                    self._open_again()
                continue
            if data:
                self._keep(self._clock.now_ns(), data)

    def _keep(self, arrival_ns: int, data: bytes) -> None:
        with self._lock:
            self._pending.append((arrival_ns, data))
            self._pending_bytes += len(data)
            while self._pending_bytes > _PENDING_LIMIT:
                _, oldest = self._pending.popleft()
                self._pending_bytes -= len(oldest)
                self.lost_bytes += len(oldest)

    def _open_again(self) -> None:
        """Try to reopen the port until this succeeds or `close` is called.

        The receiving thread calls this method.
        """
        with self._port_lock:
            self._serial.close()
        while not self._closing.wait(_REOPEN_S):
            try:
                port = self._open()
            except _PORT_ERRORS:
                continue
            with self._port_lock:
                self._serial = port
                # The baud rate may have changed while the port was opened.
                with suppress(*_PORT_ERRORS):
                    port.baudrate = self.baud_rate
            self._failure = ""
            return


def lock_bus(descriptor: int) -> None:
    """Lock an open file until it is closed. Raises OSError (EUSERS) if another process holds the lock."""
    try:
        flock(descriptor, LOCK_EX | LOCK_NB)
    except BlockingIOError as error:
        raise OSError(errno.EUSERS, "another flight drives the coils on this bus") from error


_Answer = TypeVar("_Answer")

I2C_RETRIES = 0x0701
_TIMEOUT_UNIT_NS = 10_000_000
BLOCK_LIMIT = 32
"""Maximum number of bytes in an SMBus block."""

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


class LinuxI2cBus:
    """Thread-safe I2C bus /dev/i2c-N.

    After a failure, the device file is reopened only if it was removed or replaced, because closing the file
    releases the lock of the bus.
    """

    def __init__(
        self, device: int | str, timeout_ns: int = 20_000_000, patient: bool = False, exclusive: bool = False
    ) -> None:
        """Open a bus.

        Args:
            device: number N of the bus /dev/i2c-N, or a device file, for example with a udev name.
            timeout_ns: timeout of a transaction (ns), rounded up to the kernel's steps of 10 ms.
            patient: whether a missing bus is accepted, and opened by a later transaction.
            exclusive: whether the bus is locked, so that two flight processes cannot drive the same coils.

        Raises NotResponding if the bus does not exist. Raises Refused if the permission to open the bus is
        missing, the adapter does not support block transfers, or another flight has locked the bus.
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
            kind = Refused if error.errno == errno.EUSERS else NotResponding
            raise kind(self.name, f"not a usable I2C bus: {reason}") from error
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
        check_length(length)
        answer = self._transact(address, lambda bus: bus.read_i2c_block_data(address, register, length))
        if len(answer) != length:
            raise OSError(errno.EIO, f"0x{address:02x} on {self.name} sent {len(answer)} bytes, not {length}")
        return answer

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write at most 32 bytes to consecutive registers of a device."""
        check_length(len(values))
        self._transact(address, lambda bus: bus.write_i2c_block_data(address, register, list(values)))

    def exchange(self, address: int, data: bytes, count: int) -> bytes:
        """Write `data` (if not empty) and read `count` bytes (if not 0) in one transaction."""
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

    def _is_current(self) -> bool:
        """Return whether the open file is still the device file of the bus.

        The kernel removes the device file when the adapter is unplugged. The adapter can be used again only
        after all open files of the bus have been closed.
        """
        if self._bus is None or self._bus.fd is None:
            return False
        try:
            return os.path.samestat(os.fstat(self._bus.fd), os.stat(self.name))
        except OSError:
            return False

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
            if not self._is_current():
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


def check_length(length: int) -> None:
    """Raise ValueError for a number of bytes that does not fit into an SMBus block."""
    if not 1 <= length <= BLOCK_LIMIT:
        raise ValueError(f"a block of {length} bytes: SMBus carries 1 to {BLOCK_LIMIT}")


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
        self._speed_hz, self._descriptor = speed_hz, -1
        try:
            self._descriptor = os.open(device, os.O_RDWR | os.O_CLOEXEC)
            ioctl(self._descriptor, SPI_MODE, pack("=B", mode))
            ioctl(self._descriptor, SPI_SPEED, pack("=I", speed_hz))
        except OSError as error:
            if self._descriptor >= 0:
                os.close(self._descriptor)
            cure = "is the SPI bus enabled, and may this user open it?"
            raise NotResponding(device, f"cannot be opened ({error.strerror}): {cure}") from error

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        """Send frames one after the other, and return the bytes received during each frame.

        Raises OSError.
        """
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
        ioctl(self._descriptor, request, calls)
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

        If `patient` is true, a missing port or bus raises no error and is opened later.
        """
        self._clock, self._stack, self._coil_bus = clock, stack, coil_bus
        self._patient, self._exclusive = patient, exclusive
        self._ports: dict[str, PySerialPort] = {}
        self._buses: dict[str, LinuxI2cBus] = {}
        self._spi: dict[tuple[str, int, int], LinuxSpiDevice] = {}

    def serial(self, device: str, baud_rate: int) -> PySerialPort:
        """Return the serial port of a device file. Raises NotResponding if the port cannot be opened."""
        if device not in self._ports or self._ports[device].closed:
            self._ports[device] = PySerialPort(device, baud_rate, self._clock, self._patient)
            self._stack.callback(self._ports[device].close)
        return self._ports[device]

    def i2c(self, bus: int | str | None = None) -> LinuxI2cBus:
        """Return the I2C bus with the number or device file `bus`, or the coils' bus if `bus` is None.

        Raises DeviceError if the bus cannot be opened.
        """
        name, coils = device_file(self._coil_bus if bus is None else bus), device_file(self._coil_bus)
        if name not in self._buses:
            exclusive = self._exclusive and name == coils
            self._buses[name] = LinuxI2cBus(name, patient=self._patient, exclusive=exclusive)
            self._stack.callback(self._buses[name].close)
        return self._buses[name]

    def spi(self, device: str, speed_hz: int, mode: int) -> LinuxSpiDevice:
        """Return a device on an SPI bus. Raises NotResponding if the device cannot be opened."""
        # A sensor that does not answer is started repeatedly, and must not open a file each time.
        if (device, speed_hz, mode) not in self._spi:
            opened = self._spi[device, speed_hz, mode] = LinuxSpiDevice(device, speed_hz, mode)
            self._stack.callback(opened.close)
        return self._spi[device, speed_hz, mode]
