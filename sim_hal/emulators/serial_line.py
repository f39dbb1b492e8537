"""Emulated serial lines with transmission times and wire faults, in memory or on a pseudo-terminal.

Each direction of a line is a `Wire`. In memory, the host's end is a `hal.interfaces.wires.SerialPort` and the
device's end is a `DeviceEnd`. A line in memory is deterministic for a given random generator. A
`PtyLine` serves any client on a pseudo-terminal in real time at the line's baud rate. The client's baud rate
is read from the terminal, so a wrong baud rate corrupts the bytes as on a real line.
"""

from __future__ import annotations

import errno
import os
import select
import termios
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.interfaces.errors import NotResponding
from sim_hal.clock import NEVER

_BITS = 10  # start bit, eight data bits, stop bit
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LineFaults:
    """Faults of one direction of a serial line, which affect bytes sent after the beginning of a fault.

    Attributes:
        silent: whether all bytes are lost.
        garbage: whether every byte is replaced by a random byte.
        cut_probability: probability that a message loses a random run of its bytes.
        flip_probability: probability that a bit arrives inverted.
        delay_ns: additional delay of each byte.
        thinned: number n; only every n-th message arrives, and the other messages are lost.
    """

    silent: bool = False
    garbage: bool = False
    cut_probability: float = 0.0
    flip_probability: float = 0.0
    delay_ns: int = 0
    thinned: int = 1


SOUND = LineFaults()


@dataclass(slots=True)
class _Message:
    """Bytes in transmission; byte i arrives 10 (i + 1) / `baud_rate` s after `start_ns`."""

    start_ns: int
    data: bytes
    baud_rate: int
    taken: int = 0

    def crossed_ns(self, count: int) -> int:
        """Return the time (ns, rounded up) at which the first `count` bytes of this message have arrived."""
        return self.start_ns - (-count * _BITS * _SECOND_NS // self.baud_rate)

    def crossed(self, now_ns: int) -> int:
        """Return the number of bytes of this message that have arrived by `now_ns`."""
        if now_ns <= self.start_ns:
            return 0
        return min(len(self.data), (now_ns - self.start_ns) * self.baud_rate // (_BITS * _SECOND_NS))


class Wire:
    """One direction of a serial line, with its present faults. If the buffers are full, bytes are lost."""

    def __init__(self, rng: np.random.Generator, capacity: int = 6144) -> None:
        """Create the wire with a random generator for faults.

        `capacity` is the total size (bytes) of the buffers at both ends.
        """
        self.faults = SOUND
        self.lost_bytes = 0
        self._rng, self._capacity = rng, capacity
        self._messages: deque[_Message] = deque()
        self._waiting = 0
        self._free_ns = -NEVER
        self._last_ns = -NEVER
        self._messages_sent = 0

    def push(self, data: bytes, now_ns: int, sender_baud: int, receiver_baud: int) -> None:
        """Send bytes as soon as the wire is free; with unequal baud rates, random bytes arrive."""
        faults = self.faults
        start_ns = max(now_ns, self._free_ns)
        self._free_ns = start_ns + len(data) * _BITS * _SECOND_NS // sender_baud
        if faults is not SOUND:
            data = self._disturb(data, faults)
            start_ns += faults.delay_ns
        # Bytes sent after the end of a delay fault arrive after the delayed bytes, as on a real line.
        start_ns = max(start_ns, self._last_ns)
        if data and sender_baud != receiver_baud:
            # A receiver with a lower baud rate than the sender receives fewer characters, all random.
            data = self._rng.bytes(max(1, len(data) * min(receiver_baud, sender_baud) // sender_baud))
        room = self._capacity - self._waiting
        self.lost_bytes += max(0, len(data) - room)
        data = data[:room]
        if data:
            message = _Message(start_ns, data, sender_baud)
            self._messages.append(message)
            self._waiting += len(data)
            self._last_ns = message.crossed_ns(len(data))

    def noise(self, count: int, now_ns: int, baud_rate: int) -> None:
        """Send `count` random bytes over the wire."""
        self.push(self._rng.bytes(count), now_ns, baud_rate, baud_rate)

    def pull(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Return the data received by `now_ns` as tuples (time of the last byte, bytes), oldest first."""
        chunks: list[tuple[int, bytes]] = []
        while self._messages:
            message = self._messages[0]
            crossed = message.crossed(now_ns)
            if crossed > message.taken:
                chunks.append((message.crossed_ns(crossed), message.data[message.taken : crossed]))
                self._waiting -= crossed - message.taken
                message.taken = crossed
            if crossed < len(message.data):
                break
            self._messages.popleft()
        return chunks

    def next_arrival_ns(self) -> int:
        """Return the time (ns) at which the present message will have arrived completely, or NEVER."""
        if not self._messages:
            return NEVER
        message = self._messages[0]
        return message.crossed_ns(len(message.data))

    def _disturb(self, data: bytes, faults: LineFaults) -> bytes:
        rng = self._rng
        self._messages_sent += 1
        if faults.silent or self._messages_sent % faults.thinned:
            return b""
        if faults.garbage:
            data = rng.bytes(len(data))
        if faults.cut_probability and rng.random() < faults.cut_probability:
            first, last = sorted(rng.integers(0, len(data) + 1, 2).tolist())
            data = data[:first] + data[last + 1 :]
        if faults.flip_probability:
            flips = np.packbits(rng.random(8 * len(data)) < faults.flip_probability)
            data = (np.frombuffer(data, dtype=np.uint8) ^ flips).tobytes()
        return data


class DeviceEnd:
    """The device's end of a line, with the wires of both directions, each with its own faults."""

    def __init__(self, baud_rate: int, rng: np.random.Generator, host_rate: Callable[[], int]) -> None:
        """Create the wires; the function `host_rate` returns the baud rate of the host's end."""
        self.baud_rate = baud_rate
        self.to_host, self.to_device = (Wire(generator) for generator in rng.spawn(2))
        self._host_rate = host_rate

    def write(self, data: bytes, now_ns: int) -> None:
        """Queue bytes at `now_ns`; they are sent after all bytes that are already queued."""
        self.to_host.push(data, now_ns, self.baud_rate, self._host_rate())

    def read(self, now_ns: int) -> bytes:
        """Return the bytes from the host that have arrived by `now_ns`."""
        return b"".join(data for _, data in self.to_device.pull(now_ns))

    def next_arrival_ns(self) -> int:
        """Return the time at which the next bytes from the host arrive, or NEVER."""
        return self.to_device.next_arrival_ns()


class EmulatedSerialLine:
    """A serial line in memory with its wires and its two ends: `host`, a SerialPort, and `device`."""

    def __init__(self, now_ns: Callable[[], int], baud_rate: int, rng: np.random.Generator) -> None:
        """Store the host's clock, the baud rate of both ends, and the random generator of the faults."""
        self.device = DeviceEnd(baud_rate, rng, lambda: self.host.baud_rate)
        self.to_host, self.to_device = self.device.to_host, self.device.to_device
        self.host = HostEnd(self, now_ns, baud_rate)


class HostEnd:
    """The host's end of a line, which implements `hal.interfaces.wires.SerialPort`.

    Attributes:
        baud_rate: baud rate of this end, bits per second.
        unplugged: whether the cable is unplugged.
        closed: whether the host has closed the port.
        rejected_rate: baud rate that the port does not support, or 0.
    """

    def __init__(self, line: EmulatedSerialLine, now_ns: Callable[[], int], baud_rate: int) -> None:
        self.baud_rate = baud_rate
        self.unplugged = self.closed = False
        self.rejected_rate = 0
        self._line, self._now_ns = line, now_ns

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the bytes that have arrived since the last call. Raises NotResponding if unplugged."""
        self._check()
        return self._line.to_host.pull(self._now_ns())

    def send(self, data: bytes) -> None:
        """Send bytes now. Raises NotResponding if the port is unplugged."""
        self._check()
        self._line.to_device.push(data, self._now_ns(), self.baud_rate, self._line.device.baud_rate)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change the baud rate of this end. Raises NotResponding if the port rejects the baud rate."""
        self.baud_rate = baud_rate
        if baud_rate == self.rejected_rate:
            raise NotResponding("serial line", f"does not support {baud_rate} baud")

    def open(self) -> None:
        """Open a closed port; bytes that arrived while it was closed are lost."""
        if self.closed:
            self.closed = False
            self._line.to_host.pull(self._now_ns())

    def close(self) -> None:
        """Close the port."""
        self.closed = True

    def _check(self) -> None:
        if self.unplugged or self.closed:
            raise NotResponding("serial line", "the port is closed or unplugged")


_SPEEDS = {
    getattr(termios, f"B{rate}"): rate
    for rate in (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
    if hasattr(termios, f"B{rate}")
}
_CODES = {rate: code for code, rate in _SPEEDS.items()}


class PtyLine(DeviceEnd):
    """The device's end of a line whose host end is a pseudo-terminal with the device file `name`."""

    def __init__(self, baud_rate: int, rng: np.random.Generator, link: Path | None = None) -> None:
        """Open the pseudo-terminal, and make `link` a symbolic link to its device. Raises OSError."""
        super().__init__(baud_rate, rng, self._host_speed)
        # The client's side stays open, because reading from a pseudo-terminal without a client raises errors.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        if (code := _CODES.get(baud_rate)) is not None:
            attributes = termios.tcgetattr(self._far)
            attributes[4] = attributes[5] = code
            termios.tcsetattr(self._far, termios.TCSANOW, attributes)
        os.set_blocking(self._near, False)
        self.name = os.ttyname(self._far)
        self._link = link
        if link is not None:
            try:
                if link.is_symlink():
                    link.unlink()
                link.symlink_to(self.name)
            except OSError:
                self._link = None
                self.close()
                raise

    def exchange(self, now_ns: int) -> None:
        """Read the host's bytes, and deliver the device's bytes that have arrived by `now_ns`."""
        try:
            data = os.read(self._near, 4096)
        except BlockingIOError:
            data = b""
        if data:
            self.to_device.push(data, now_ns, self._host_speed(), self.baud_rate)
        for _, crossed in self.to_host.pull(now_ns):
            try:
                os.write(self._near, crossed)
            except OSError as error:
                # If no client reads, the bytes are lost as on an unconnected cable.
                if error.errno != errno.EAGAIN:
                    raise

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when the host writes, for `select`."""
        return self._near

    def wait(self, now_ns: int, until_ns: int) -> None:
        """Wait until the host writes, a message for the host is complete, or the time is `until_ns`."""
        due_ns = min(until_ns, self.to_host.next_arrival_ns())
        select.select([self._near], [], [], max(0, due_ns - now_ns) * 1e-9)

    def close(self) -> None:
        """Close the pseudo-terminal and remove the symbolic link. Calling it twice is safe.

        A link that another emulator has set to its own device is kept.
        """
        if self._near < 0:
            return
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self.name:
            self._link.unlink(missing_ok=True)
        os.close(self._near)
        os.close(self._far)
        self._near = self._far = -1

    def _host_speed(self) -> int:
        # A baud rate without a termios constant (128000) cannot be read back and is assumed to be correct.
        return _SPEEDS.get(termios.tcgetattr(self._far)[5], self.baud_rate)
