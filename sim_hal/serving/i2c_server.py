"""Serves an emulated I2C bus on a Unix socket to programs that believe in /dev/i2c-N (`i2c_preload.c`).

A request is its length and one of three kinds of content, an answer an errno, a length and data; all numbers
in the machine's own byte order, for both ends are on one machine.
"""

from __future__ import annotations

import errno
import selectors
import socket
import struct
from pathlib import Path

from sim_hal.emulators import i2c_adapter
from sim_hal.emulators.i2c_bus import EmulatedI2cBus, Message

_FUNCTIONS, _SMBUS, _MESSAGES = 1, 2, 3
_LENGTH = struct.Struct("=I")
_ANSWER = struct.Struct("=ii")
_SMBUS_HEAD = struct.Struct("=?BIH")
_MESSAGE_HEAD = struct.Struct("=HHH")
_READ = 0x0001
_UNSUPPORTED = 0x0410
"""Flags of a message: ten-bit address, length sent by the part."""


class I2cServer:
    """The far end of every /dev/i2c-N that the programs open."""

    def __init__(self, bus: EmulatedI2cBus, path: Path) -> None:
        """Listen on a new socket at `path`."""
        self._bus = bus
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(16)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._received: dict[socket.socket, bytearray] = {}

    def serve(self, wait: float) -> None:
        """Answer what is asked within the next `wait` s."""
        for key, _ in self._selector.select(wait):
            line = key.fileobj
            assert isinstance(line, socket.socket)
            if line is self._listener:
                client, _ = line.accept()
                self._received[client] = bytearray()
                self._selector.register(client, selectors.EVENT_READ)
            else:
                self._serve_client(line)

    def close(self) -> None:
        """Close every connection."""
        for line in (self._listener, *self._received):
            line.close()
        self._selector.close()

    def _serve_client(self, line: socket.socket) -> None:
        received = self._received[line]
        try:
            chunk = line.recv(1 << 16)
            received += chunk
            while len(received) >= 4 and len(received) >= 4 + (length := _LENGTH.unpack_from(received)[0]):
                request = bytes(received[4 : 4 + length])
                del received[: 4 + length]
                line.sendall(self._answer(request))
        except (ConnectionError, struct.error):
            chunk = b""
        if not chunk:
            self._selector.unregister(line)
            del self._received[line]
            line.close()

    def _answer(self, request: bytes) -> bytes:
        try:
            given = self._carried_out(request)
        except OSError as error:
            return _ANSWER.pack(error.errno or errno.EIO, 0)
        return _ANSWER.pack(0, len(given)) + given

    def _carried_out(self, request: bytes) -> bytes:
        match request[0]:
            case 1:
                return _LENGTH.pack(i2c_adapter.FUNCTIONS)
            case 2:
                reading, command, size, address = _SMBUS_HEAD.unpack_from(request, 1)
                data = request[1 + _SMBUS_HEAD.size :]
                return i2c_adapter.smbus(self._bus, address, reading, command, size, data)
            case 3:
                return b"".join(self._bus.transfer(_messages(request)))
            case _:
                raise OSError(errno.ENOTTY, f"request {request[0]}")


def _messages(request: bytes) -> list[Message]:
    """Return the messages of a request. Raises OSError for what the adapter cannot do."""
    messages, at = [], 2
    for _ in range(request[1]):
        address, flags, length = _MESSAGE_HEAD.unpack_from(request, at)
        at += _MESSAGE_HEAD.size
        if flags & _UNSUPPORTED:
            raise OSError(errno.EOPNOTSUPP, f"a message with flags 0x{flags:04x}")
        if flags & _READ:
            messages.append(Message(address, count=length))
        else:
            messages.append(Message(address, request[at : at + length]))
            at += length
    return messages
