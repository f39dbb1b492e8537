"""A serial line in memory, with transmission times and wire faults.

Each direction is a `Wire`. The host's end is a `hal.interfaces.wires.SerialPort`, the device's end a
`sim_hal.emulators.device.SerialEnd`. Deterministic for a given generator.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.interfaces.errors import NotResponding
from sim_hal.emulators.device import NEVER

_BITS = 10  # start, eight, stop
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LineFaults:
    """The faults of a wire, from the next byte on.

    Attributes:
        silent: nothing crosses.
        garbage: every byte is replaced by a random one.
        cut_probability: of a message to lose a random run of its bytes.
        flip_probability: of each bit to arrive inverted.
        delay_ns: added to the time of each byte.
        thinned: one message of this many crosses.
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
    """Bytes on their way: byte i has crossed at start + (i + 1) * 10 / baud."""

    start_ns: int
    data: bytes
    baud_rate: int
    taken: int = 0

    def crossed_ns(self, count: int) -> int:
        """Return when the first `count` bytes have crossed, rounded up."""
        return self.start_ns - (-count * _BITS * _SECOND_NS // self.baud_rate)

    def crossed(self, now_ns: int) -> int:
        """Return how many bytes have crossed by `now_ns`."""
        if now_ns <= self.start_ns:
            return 0
        return min(len(self.data), (now_ns - self.start_ns) * self.baud_rate // (_BITS * _SECOND_NS))


class Wire:
    """One direction of a line.

    Attributes:
        faults: its faults; may be replaced at any time.
        lost_bytes: bytes that found the buffers full.
    """

    def __init__(self, rng: np.random.Generator, capacity: int = 6144) -> None:
        """Take the generator of the faults and the bytes that fit in the buffers of both ends together."""
        self.faults = SOUND
        self.lost_bytes = 0
        self._rng = rng
        self._capacity = capacity
        self._messages: deque[_Message] = deque()
        self._waiting = 0
        self._free_ns = -NEVER
        self._last_ns = -NEVER
        self._messages_sent = 0

    def push(self, data: bytes, now_ns: int, sender_baud: int, receiver_baud: int) -> None:
        """Send bytes, from `now_ns` on or when the wire is free; with unequal speeds they arrive as noise."""
        faults = self.faults
        start_ns = max(now_ns, self._free_ns)
        self._free_ns = start_ns + len(data) * _BITS * _SECOND_NS // sender_baud
        if faults is not SOUND:
            data = self._disturb(data, faults)
            start_ns += faults.delay_ns
        # Bytes keep their order when a delay is removed.
        start_ns = max(start_ns, self._last_ns)
        if data and sender_baud != receiver_baud:
            # A slower receiver sees fewer characters; none of them is what was sent.
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
        """Insert `count` random bytes that neither end sent."""
        self.push(self._rng.bytes(count), now_ns, baud_rate, baud_rate)

    def pull(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Return crossed messages by `now_ns`, oldest first: (time of its last byte, bytes)."""
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
        """Return when the message under way will have crossed whole; NEVER when there is none."""
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


class SerialLine:
    """The line with both its ends.

    Attributes:
        to_host, to_device: the two wires, each with its faults.
        host: a SerialPort.
        device: a SerialEnd.
    """

    def __init__(self, now_ns: Callable[[], int], baud_rate: int, rng: np.random.Generator) -> None:
        """Take the time of the host's end, the speed of both ends, and the generator of the faults."""
        to_host_rng, to_device_rng = rng.spawn(2)
        self.to_host = Wire(to_host_rng)
        self.to_device = Wire(to_device_rng)
        self.host = HostEnd(self, now_ns, baud_rate)
        self.device = DeviceEnd(self, baud_rate)


class HostEnd:
    """The host's end; implements `hal.interfaces.wires.SerialPort`."""

    def __init__(self, line: SerialLine, now_ns: Callable[[], int], baud_rate: int) -> None:
        self.baud_rate = baud_rate
        self.unplugged = False
        self._line = line
        self._now_ns = now_ns

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the bytes crossed since the last call. Raises NotResponding when the port is gone."""
        self._check()
        return self._line.to_host.pull(self._now_ns())

    def send(self, data: bytes) -> None:
        """Send bytes now. Raises NotResponding when the port is gone."""
        self._check()
        self._line.to_device.push(data, self._now_ns(), self.baud_rate, self._line.device.baud_rate)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change this end's speed."""
        self.baud_rate = baud_rate

    def close(self) -> None:
        """Close the port, as unplugging does."""
        self.unplugged = True

    def _check(self) -> None:
        if self.unplugged:
            raise NotResponding("serial line", "the port is closed or unplugged")


class DeviceEnd:
    """The device's end; implements `sim_hal.emulators.device.SerialEnd`."""

    def __init__(self, line: SerialLine, baud_rate: int) -> None:
        self.baud_rate = baud_rate
        self._line = line

    def write(self, data: bytes, now_ns: int) -> None:
        """Start to send bytes at `now_ns`."""
        self._line.to_host.push(data, now_ns, self.baud_rate, self._line.host.baud_rate)

    def read(self, now_ns: int) -> bytes:
        """Return the host's bytes that have crossed by `now_ns`."""
        return b"".join(data for _, data in self._line.to_device.pull(now_ns))

    def next_arrival_ns(self) -> int:
        """Return when the host's bytes will next have crossed."""
        return self._line.to_device.next_arrival_ns()
