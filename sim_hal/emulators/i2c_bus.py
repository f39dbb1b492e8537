"""Emulated I2C bus in memory, with emulated chips, bus faults and SMBus transfers.

A transaction is one message or several messages joined by repeated STARTs, as in Linux's ioctl I2C_RDWR. The
duration of a transaction (0.6 ms for 24 bytes at 400 kHz) is not modelled, except that a hanging bus delays
the transaction until the timeout.

SMBus transfers are emulated by I2C messages, as in a Linux adapter without SMBus hardware. The transfer codes
and the data layout are those of linux/i2c.h (union i2c_smbus_data), with little-endian words. Packet error
checking, ten-bit addresses, and block reads whose length is sent by the chip are not supported.
"""

from __future__ import annotations

import errno
import operator
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Protocol

from flight.schema.document import MISTAKES
from hal.buses.linux_wires import BLOCK_LIMIT, check_length
from sim_hal.clock import check_emulator

_TIMEOUT_NS = 20_000_000


class I2cPart(Protocol):
    """An emulated chip on the I2C bus."""

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges an address (0 is the general call)."""

    def write(self, address: int, data: bytes) -> None:
        """Process the bytes of a write between the address and the STOP or repeated START."""

    def read(self, count: int) -> bytes:
        """Return `count` bytes, beginning at the register pointer."""


class Registers(ABC):
    """A chip on the I2C bus with a register pointer that increments at each byte."""

    def __init__(self, address: int) -> None:
        self.address = address
        self._pointer = 0

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges an address."""
        return address == self.address

    def write(self, address: int, data: bytes) -> None:
        """Set the register pointer, and write registers."""
        self._pointer = data[0]
        for value in data[1:]:
            self.store(self._pointer, value)
            self._pointer += 1

    def read(self, count: int) -> bytes:
        """Return the contents of `count` registers, beginning at the register pointer."""
        self.latch()
        self._pointer += count
        return bytes(self.load(register) for register in range(self._pointer - count, self._pointer))

    def latch(self) -> None:  # noqa: B027 - a chip without measurements needs no method
        """Store a new sample in the registers if one is due; called before registers are read."""

    @abstractmethod
    def store(self, register: int, value: int) -> None:
        """Write a register."""

    @abstractmethod
    def load(self, register: int) -> int:
        """Return a register's value."""


@dataclass(frozen=True, slots=True)
class Message:
    """One I2C message, which writes `data`, or reads `count` bytes if `count` is given."""

    address: int
    data: bytes = b""
    count: int | None = None


@dataclass(slots=True)
class _Fault:
    """A bus fault that acts `left` times, or until it is removed if `left` is None.

    `code` 0 is a bit flip.
    """

    code: int
    text: str
    address: int | None
    left: int | None
    after: int = 0
    index: int = 0
    mask: int = 0
    chance: Callable[[], bool] | None = None


class EmulatedI2cBus:
    """A thread-safe I2C bus (`hal.interfaces.wires.I2cBus`) with emulated chips."""

    def __init__(self, parts: Sequence[I2cPart] = (), wait: Callable[[int], None] | None = None) -> None:
        """Connect the chips.

        The function `wait`, if given, advances time by the timeout (ns) when the bus hangs.
        """
        self._parts = list(parts)
        self._wait = wait
        self._faults: list[_Fault] = []
        self._closed = False
        # The lock is re-entrant: during a simulated hang, the waiting thread may run jobs that use the bus.
        self._lock = threading.RLock()
        self.transactions = 0

    def attach(self, part: I2cPart) -> None:
        """Add a chip to the bus."""
        with self._lock:
            self._parts.append(part)

    def detach(self, part: I2cPart) -> None:
        """Remove a chip from the bus, so that its address is not acknowledged."""
        with self._lock:
            self._parts.remove(part)

    def put_before(self, part: I2cPart, cover: I2cPart) -> Callable[[], None]:
        """Replace a chip on the bus by `cover`, and return the function that restores the chip."""
        with self._lock:
            self._parts[self._parts.index(part)] = cover

        def uncover() -> None:
            with self._lock:
                self._parts[self._parts.index(cover)] = part

        return uncover

    def write_byte(self, address: int, value: int) -> None:
        """Write one byte without a register address."""
        self.send(address, bytes((value,)))

    def read_byte_data(self, address: int, register: int) -> int:
        """Read one byte of a register."""
        return self._read(address, register, 1)[0]

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte to a register."""
        self.send(address, bytes((register, value)))

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        """Read `length` bytes, at most 32, beginning at a register."""
        check_length(length)
        return list(self._read(address, register, length))

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write up to 32 bytes, beginning at a register."""
        check_length(len(values))
        self.send(address, bytes((register, *values)))

    def exchange(self, address: int, data: bytes, count: int) -> bytes:
        """Write `data` (if not empty) and read `count` bytes (if not 0) in one transaction."""
        messages = [Message(address, data)] if data or not count else []
        return b"".join(self.transfer([*messages, Message(address, count=count)] if count else messages))

    def close(self) -> None:
        """Close the bus. Safe to call twice."""
        self._closed = True

    def send(self, address: int, data: bytes) -> None:
        """Write raw bytes to an address; the byte 0x06 to address 0 resets the chips (software reset)."""
        self.transfer((Message(address, data),))

    def transfer(self, messages: Sequence[Message]) -> list[bytes]:
        """Send messages joined by repeated STARTs, and return the data of each read.

        At most one fault acts on a chip in a transaction. A bit flip changes the data that are read. If the
        transaction only writes, a bit flip changes the data that are written after the register byte. Raises
        EmulatorError if the code of a chip of another package fails.
        """
        try:
            return self._transferred(messages)
        except MISTAKES as error:
            check_emulator(error)
            raise

    def _transferred(self, messages: Sequence[Message]) -> list[bytes]:
        given: list[bytes] = []
        parts: list[I2cPart] = []
        fault: _Fault | None = None
        address = -1
        with self._lock:
            reads = bool(self._faults) and any(message.count is not None for message in messages)
            for message in messages:
                if message.address != address:
                    address = message.address
                    parts, fault = self._begin(address)
                    if fault is not None and fault.code:
                        self._deliver(parts, address, b"" if reads else message.data[: fault.after])
                        self._fail(fault, address)
                if message.count is None:
                    written = message.data if reads or fault is None else _flipped(message.data, fault, 1)
                    self._deliver(parts, address, written)
                elif fault is None and len(parts) == 1:
                    given.append(parts[0].read(message.count))
                else:
                    # The bus is open drain, so zero bits dominate if several chips answer.
                    answers = zip(*(part.read(message.count) for part in parts), strict=True)
                    wired = bytes(reduce(operator.and_, column) for column in answers)
                    given.append(_flipped(wired, fault, 0))
        return given

    def nack(
        self,
        address: int | None,
        times: int | None = 1,
        after: int = 0,
        chance: Callable[[], bool] | None = None,
    ) -> Callable[[], None]:
        """Make a chip, or all chips if `address` is None, refuse transactions.

        The fault acts `times` times, or until it is removed if `times` is None. A write is refused after
        `after` bytes, including the register byte. If the function `chance` is given, the fault acts only
        when `chance` returns True. Returns the function that removes the fault.
        """
        return self._add(
            _Fault(errno.EREMOTEIO, "no acknowledge", address, times, after=after, chance=chance)
        )

    def hang(self, times: int | None = None) -> Callable[[], None]:
        """Hold the clock line low, so that each transaction fails after the timeout."""
        return self._add(_Fault(errno.ETIMEDOUT, "time-out, the clock line is held low", None, times))

    def time_out(self, address: int, chance: Callable[[], bool]) -> Callable[[], None]:
        """Make a chip stretch the clock beyond the timeout whenever `chance` returns True."""
        return self._add(
            _Fault(errno.ETIMEDOUT, "time-out, the clock is stretched", address, None, chance=chance)
        )

    def lose_arbitration(self, times: int | None = 1) -> Callable[[], None]:
        """Make transactions fail because another master wins the arbitration."""
        return self._add(_Fault(errno.EAGAIN, "arbitration lost", None, times))

    def flip_bits(self, address: int, index: int, mask: int, times: int | None = 1) -> Callable[[], None]:
        """Invert the bits `mask` in byte `index` of the written or read data, without reporting an error."""
        return self._add(_Fault(0, "bits flipped", address, times, index=index, mask=mask))

    def clear_faults(self) -> None:
        """Remove all faults."""
        with self._lock:
            self._faults.clear()

    def _add(self, fault: _Fault) -> Callable[[], None]:
        with self._lock:
            self._faults.append(fault)

        def remove() -> None:
            with self._lock:  # faults are compared by identity, because two faults may be equal
                self._faults = [other for other in self._faults if other is not fault]

        return remove

    def _read(self, address: int, register: int, count: int) -> bytes:
        return self.transfer((Message(address, bytes((register,))), Message(address, count=count)))[0]

    def _begin(self, address: int) -> tuple[list[I2cPart], _Fault | None]:
        if self._closed:
            raise OSError(errno.EBADF, "the emulated bus has been closed")
        self.transactions += 1
        fault = self._due_fault(address) if self._faults else None
        parts = [part for part in self._parts if part.answers(address)]
        if not parts and (fault is None or fault.code != errno.ETIMEDOUT):
            raise OSError(errno.EREMOTEIO, f"no acknowledge, address 0x{address:02x} on the emulated bus")
        return parts, fault

    def _due_fault(self, address: int) -> _Fault | None:
        for fault in self._faults:
            if fault.address in {None, address} and (fault.chance is None or fault.chance()):
                if fault.left is not None:
                    fault.left -= 1
                    if fault.left <= 0:
                        self._faults.remove(fault)
                return fault
        return None

    def _fail(self, fault: _Fault, address: int) -> None:
        if fault.code == errno.ETIMEDOUT and self._wait is not None:
            self._wait(_TIMEOUT_NS)
        raise OSError(fault.code, f"{fault.text}, address 0x{address:02x} on the emulated bus")

    @staticmethod
    def _deliver(parts: list[I2cPart], address: int, data: bytes) -> None:
        if data:  # A write without data only tests whether the address is acknowledged.
            for part in parts:
                part.write(address, data)


def _flipped(data: bytes, fault: _Fault | None, first: int) -> bytes:
    """Return the data with the bits flipped by a fault.

    The fault flips bits of the byte at `first + fault.index`.
    """
    if fault is None or first + fault.index >= len(data):
        return data
    index = first + fault.index
    return data[:index] + bytes((data[index] ^ fault.mask,)) + data[index + 1 :]


_BLOCK, _OLD_I2C_BLOCK = 5, 6

FUNCTIONS = 0x00000001 | 0x00FF0000 | 0x02000000 | 0x0C000000
"""Supported functions (I2C_FUNC_*): plain I2C, SMBus transfers except block reads, and I2C blocks."""


def smbus(
    bus: EmulatedI2cBus, address: int, reading: bool, command: int, size: int, data: bytes = b""
) -> bytes:
    """Execute a transfer of ioctl I2C_SMBUS, and return the new content of the union (empty for a write).

    Raises OSError for bus errors, and with EOPNOTSUPP or EINVAL as a Linux adapter does.
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
            raise OSError(errno.EOPNOTSUPP, f"SMBus transfer {size} is not supported")
    return b"".join(bus.transfer(messages))


def _block(bus: EmulatedI2cBus, address: int, reading: bool, head: bytes, size: int, data: bytes) -> bytes:
    """Execute a block transfer; an SMBus block on the bus begins with its length, an I2C block does not."""
    # The obsolete transfer code for I2C block reads always reads a block of the maximum length.
    length = BLOCK_LIMIT if size == _OLD_I2C_BLOCK and reading else data[0]
    if not 1 <= length <= BLOCK_LIMIT:
        raise OSError(errno.EINVAL, f"a block of {length} bytes")
    if reading:
        (given,) = bus.transfer([Message(address, head), Message(address, count=length)])
        return bytes((length,)) + given
    bus.transfer([Message(address, head + data[size != _BLOCK : 1 + length])])
    return b""
