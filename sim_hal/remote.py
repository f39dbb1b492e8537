"""The flight process's end of `sim_hal.server`: bus and camera over a socket, the unit over a pty.

`served` starts the server beside the flight process and waits until its devices answer.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hal.buses.clock import SystemClock
from hal.buses.serial_port import PySerialPort
from hal.interfaces.errors import NotResponding
from hal.interfaces.readings import Frame
from hal.interfaces.wires import Wires
from sim_hal.server import LENGTH

PATIENCE_S = 5.0
"""How long the devices outlive a flight process that died."""

_ANSWER_S = 0.1
_START_S = 20.0


class _Link:
    """One connection to the server."""

    def __init__(self, path: Path) -> None:
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._line.settimeout(_ANSWER_S)
        self._line.connect(str(path))
        self._received = bytearray()
        self._numbers = itertools.count(1)

    def fileno(self) -> int:
        return self._line.fileno()

    def send(self, name: str, *arguments: Any) -> int:
        """Send a request; return its number."""
        number = next(self._numbers)
        body = msgspec.msgpack.encode([number, name, *arguments])
        self._line.sendall(LENGTH.pack(len(body)) + body)
        return number

    def receive(self) -> list[Any]:
        """Wait for one message. Raises TimeoutError, or ConnectionError when the server is gone."""
        while (message := self._message()) is None:
            chunk = self._line.recv(65536)
            if not chunk:
                raise ConnectionResetError(errno.ECONNRESET, "the emulated devices are gone")
            self._received += chunk
        return message

    def close(self) -> None:
        self._line.close()

    def _message(self) -> list[Any] | None:
        if len(self._received) < LENGTH.size:
            return None
        (length,) = LENGTH.unpack_from(self._received)
        end = LENGTH.size + length
        if len(self._received) < end:
            return None
        message: list[Any] = msgspec.msgpack.decode(bytes(self._received[LENGTH.size : end]))
        del self._received[:end]
        return message


class RemoteI2cBus:
    """An I2cBus whose parts are in the server's process. Safe for several threads."""

    def __init__(self, path: Path) -> None:
        self._link = _Link(path)
        self._lock = threading.Lock()

    def call(self, name: str, *arguments: Any) -> Any:
        """Ask and wait for the answer. Raises OSError as a bus does."""
        with self._lock:
            try:
                number = self._link.send(name, *arguments)
                # An answer that came too late for its own question is passed over.
                while (answer := self._link.receive())[0] != number:
                    pass
            except TimeoutError as error:
                raise TimeoutError(errno.ETIMEDOUT, "the emulated bus does not answer") from error
        _, kind, result, text = answer
        if kind == "error":
            raise OSError(result, text)
        return result

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

    def close(self) -> None:
        """Close the connection."""
        self._link.close()


class RemoteFrameSource:
    """A FrameSource whose camera is in the server's process; frames are announced, and read from a file."""

    def __init__(self, path: Path, clock: SystemClock) -> None:
        self._link = _Link(path)
        self._folder = path.parent
        self._clock = clock

    def trigger(self, exposure_ns: int) -> None:
        """Start an exposure; the answer is not waited for."""
        try:
            self._link.send("trigger", exposure_ns)
        except OSError as error:
            raise NotResponding("camera", f"the emulated devices are gone ({error})") from error

    def poll(self) -> Frame | None:
        """Return the newest frame announced since the last call. Raises NotResponding when refused."""
        newest: Frame | None = None
        try:
            while select.select([self._link], [], [], 0.0)[0]:
                _, kind, result, text = self._link.receive()
                if kind == "frame":
                    newest = self._read(result, text)
                elif kind != "done":
                    raise NotResponding("camera", text)
        except OSError as error:
            raise NotResponding("camera", f"the emulated devices are gone ({error})") from error
        return newest

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def _read(self, description: list[Any], name: str) -> Frame:
        sequence, start_ns, exposure_ns, shape, dtype = description
        pixels = np.fromfile(self._folder / name, dtype=dtype).reshape(shape)
        return Frame(sequence, start_ns, exposure_ns, self._clock.now_ns(), pixels)


@dataclass(frozen=True, slots=True)
class Served:
    """What the flight application needs of devices in another process."""

    clock: SystemClock
    wires: Wires
    release: Callable[[int], None]
    process_id: int


@contextmanager
def served(config_path: Path, seed: int, folder: Path) -> Iterator[Served]:
    """Start the server for a configuration and connect to it; end it at the end. Raises NotResponding."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "sim_hal",
            "serve",
            str(config_path),
            "--folder",
            str(folder),
            "--seed",
            str(seed),
            "--patience",
            str(PATIENCE_S),
        ],
        stdout=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the flight process, which then ends this one
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    try:
        facts = _first_words(process)
        clock = SystemClock()
        serial = PySerialPort(facts["serial"], facts["baud_rate"], clock)
        path = Path(facts["socket"])
        bus = RemoteI2cBus(path)
        camera = RemoteFrameSource(path, clock) if facts["camera"] else None
        try:
            wires = Wires(serial, bus, camera)
            yield Served(clock, wires, lambda epoch_ns: bus.call("release", epoch_ns), process.pid)
        finally:
            serial.close()
            bus.close()
            if camera is not None:
                camera.close()
    finally:
        process.terminate()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _first_words(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Return what the server says of itself once its devices answer."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], _START_S)
    line = process.stdout.readline() if ready else b""
    if not line:
        raise NotResponding("emulated devices", f"the server did not start within {_START_S:g} s")
    facts: dict[str, Any] = json.loads(line)
    return facts
