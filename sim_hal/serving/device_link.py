"""Client of the device server `sim_hal.serving.server`, with messages as lines of JSON over a Unix socket.

This module uses only the standard library and imports quickly, because the guardian opens the emulated bus by
`open_bus` and must start at once and without numpy. `multiprocessing.connection` is not used because it would
delay the guardian by tens of milliseconds, blocks on a partial message and unpickles the data that it reads.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

_ANSWER_S, _FIRST_ANSWER_S, _FIRST_S = 0.1, 5.0, 2.0
"""Usual and initial timeout (s) of an answer, and time (s) for which the initial timeout is used."""


def pack(message: Any) -> bytes:
    """Return a message as one line of JSON."""
    return json.dumps(message, separators=(",", ":")).encode() + b"\n"


class Inbox:
    """Decoder that splits received bytes into messages."""

    def __init__(self) -> None:
        self._rest = b""

    def take(self, chunk: bytes) -> list[Any]:
        """Return the messages that are complete after `chunk`, oldest first."""
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        return [json.loads(line) for line in lines]


class DeviceLink:
    """One connection to the device server."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._line.settimeout(_FIRST_ANSWER_S)
        self._patient_until: float | None = time.monotonic() + _FIRST_S
        try:
            self._line.connect(os.fspath(path))
        except OSError:
            self._line.close()
            raise
        self._inbox = Inbox()
        self._messages: deque[Any] = deque()
        self._numbers = itertools.count(1)

    def fileno(self) -> int:
        """Return the file descriptor of the socket, for `select`."""
        return self._line.fileno()

    def send(self, name: str, *arguments: Any) -> int:
        """Send a request and return the request's number."""
        if self._patient_until is not None and time.monotonic() > self._patient_until:
            self._patient_until = None
            self._line.settimeout(_ANSWER_S)
        number = next(self._numbers)
        self._line.sendall(pack([number, name, *arguments]))
        return number

    def pending(self) -> bool:
        """Return whether `receive` would return a message at once."""
        return bool(self._messages)

    def receive(self) -> list[Any]:
        """Wait for one message. Raises TimeoutError, or ConnectionError if the server has ended."""
        while not self._messages:
            chunk = self._line.recv(65536)
            if not chunk:
                raise ConnectionResetError(errno.ECONNRESET, "the emulated devices have ended")
            self._messages += self._inbox.take(chunk)
        message: list[Any] = self._messages.popleft()
        return message

    def close(self) -> None:
        """Close the connection."""
        self._line.close()


class RemoteI2cBus:
    """An I2cBus whose chips are in the server process. The bus is thread-safe."""

    def __init__(self, path: str | os.PathLike[str], name: str = "") -> None:
        """Connect to the bus `name` of the server, or to the bus of the coils if `name` is empty."""
        self._link = DeviceLink(path)
        self._lock = threading.Lock()
        if name:
            self.call("select", name)

    def call(self, name: str, *arguments: Any) -> Any:
        """Send a request and wait for its answer. Raises OSError as a Linux bus does."""
        with self._lock:
            try:
                number = self._link.send(name, *arguments)
                # Answers to requests that have timed out are skipped.
                while (answer := self._link.receive())[0] != number:
                    pass
            except TimeoutError as error:
                raise TimeoutError(errno.ETIMEDOUT, "the emulated bus does not answer") from error
        _, kind, result, text = answer
        if kind != "done":
            raise OSError(result or errno.EIO, text)
        return result

    def write_byte(self, address: int, value: int) -> None:
        """Write one byte without a register address."""
        self.call("write_byte", address, value)

    def read_byte_data(self, address: int, register: int) -> int:
        """Read one byte."""
        return int(self.call("read_byte_data", address, register))

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte."""
        self.call("write_byte_data", address, register, value)

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        """Read a block."""
        return list(self.call("read_i2c_block_data", address, register, length))

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write a block."""
        self.call("write_i2c_block_data", address, register, list(values))

    def exchange(self, address: int, data: bytes, count: int) -> bytes:
        """Write and read bytes without a register address."""
        return bytes(self.call("exchange", address, list(data), count))

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        """Transfer frames to and from the selected device, which must be an SPI device."""
        return [bytes(frame) for frame in self.call("spi", [list(frame) for frame in frames])]

    def close(self) -> None:
        """Close the connection."""
        self._link.close()


def open_bus(where: str) -> RemoteI2cBus:
    """Return the emulated bus of the server at the socket `where`, for the guardian."""
    return RemoteI2cBus(where)
