"""Command `sim_hal emulate i2c`, which serves the coils' I2C bus to programs that open /dev/i2c-N.

Programs access the bus through a preload library (`i2c_preload.c`) instead of a CUSE device, because a CUSE
device needs a kernel module, a device node and privileges, which containers and shared machines lack. Each
version of the library is compiled once by a C compiler. Programs that are linked statically or run
set-user-id do not load the library. The library sends requests over a Unix socket. A request consists of its
length and its content, which starts with the kind of the request. An answer consists of an errno, a length
and data. All numbers are in native byte order, because client and server are on the same computer.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import json
import os
import selectors
import shlex
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np

from flight.schema import reader as configuration
from hal.buses.system import SystemClock
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import UsageError
from sim_hal.assembly import assemble_coils
from sim_hal.emulation import EmulatedWires
from sim_hal.emulators import i2c_bus
from sim_hal.emulators.i2c_bus import EmulatedI2cBus, Message
from sim_hal.settings import Release, Simulation

SOURCE = Path(__file__).with_name("i2c_preload.c")
_FLAGS = ("-shared", "-fPIC", "-O2", "-w")
_COMPILERS = ("cc", "gcc", "clang")


def library() -> Path:
    """Return the path of the compiled library in the user's cache folder.

    Raises UsageError if the library cannot be compiled or written.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "knightcube"
    text = SOURCE.read_bytes()
    path = folder / f"i2c-preload-{os.uname().machine}-{hashlib.sha256(text).hexdigest()[:16]}.so"
    if path.is_file():
        return path
    named = os.environ.get("CC")
    names = (named,) if named else _COMPILERS
    compiler = next(filter(None, map(shutil.which, names)), None)
    if compiler is None:
        raise UsageError(
            f"no C compiler ({', '.join(names)}) to build the preload library with: install one"
            " (Debian: apt-get install gcc libc6-dev) or set CC to its name"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(f".{os.getpid()}")
        command = [compiler, *_FLAGS, "-o", str(beside), str(SOURCE), "-ldl", "-lpthread"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise UsageError(f"{folder}: the preload library cannot be written: {error.strerror}") from error
    if done.returncode != 0:
        first = next(iter(done.stderr.splitlines()), f"status {done.returncode}")
        raise UsageError(f"the preload library does not compile: {first} (Debian: apt-get install libc6-dev)")
    beside.replace(path)
    return path


_LENGTH = struct.Struct("=I")
_ANSWER = struct.Struct("=ii")
_SMBUS_HEAD = struct.Struct("=?BIH")
_MESSAGE_HEAD = struct.Struct("=HHH")
_READ = 0x0001
_UNSUPPORTED = 0x0410
"""Flags of I2C messages that are not supported: ten-bit address, and block length sent by the chip."""


class I2cServer:
    """Server for the requests of programs that open /dev/i2c-N."""

    def __init__(self, bus: EmulatedI2cBus, path: Path) -> None:
        """Listen on a new socket at `path`."""
        self._bus = bus
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(16)
        self._selector = selectors.EpollSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._received: dict[socket.socket, bytearray] = {}

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when a request arrives, for `select`."""
        return self._selector.fileno()

    def serve(self, wait: float) -> None:
        """Answer the requests that arrive during the next `wait` s."""
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
                try:
                    given = self._execute(request)
                    answer = _ANSWER.pack(0, len(given)) + given
                except OSError as error:
                    answer = _ANSWER.pack(error.errno or errno.EIO, 0)
                line.sendall(answer)
        except (ConnectionError, struct.error):
            chunk = b""
        if not chunk:
            self._selector.unregister(line)
            del self._received[line]
            line.close()

    def _execute(self, request: bytes) -> bytes:
        match request[0]:
            case 1:
                return _LENGTH.pack(i2c_bus.FUNCTIONS)
            case 2:
                reading, command, size, address = _SMBUS_HEAD.unpack_from(request, 1)
                data = request[1 + _SMBUS_HEAD.size :]
                return i2c_bus.smbus(self._bus, address, reading, command, size, data)
            case 3:
                return b"".join(self._bus.transfer(_messages(request)))
            case _:
                raise OSError(errno.ENOTTY, f"request {request[0]}")


def _messages(request: bytes) -> list[Message]:
    """Return the I2C messages of a request. Raises OSError for unsupported flags."""
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


_LONGEST_WAIT_S = 0.05


def emulate(options: argparse.Namespace) -> int:
    """Serve the bus until the given program ends.

    If no program is given, serve the bus until a signal arrives or the time limit is reached.
    """
    config = configuration.load(options.config)
    text = options.config.read_text(encoding="utf-8")
    section = configuration.simulation_section(text, str(options.config), Simulation)
    if section is None:  # without this section, the true coils equal the configured coils
        section = Simulation(release=Release(q2=0.0))
    now_ns = SystemClock().now_ns
    wires = EmulatedWires(now_ns, options.seed, config.coils.bus)
    assemble_coils(config, section, np.random.default_rng(options.seed), now_ns, wires)
    with tempfile.TemporaryDirectory(prefix="knightcube-i2c-") as folder:
        path = Path(folder) / "bus.sock"
        environment = {
            "LD_PRELOAD": str(library()),
            "KNIGHTCUBE_I2C_SOCKET": str(path),
            "KNIGHTCUBE_I2C_BUS": str(options.bus),
        }
        server = I2cServer(wires.i2c(), path)
        try:
            if options.program:
                return _run_program(server, options.program, environment, options.duration)
            parts = {config.coils.driver: config.coils.address}
            if config.power_monitor is not None:
                parts[config.power_monitor.driver] = config.power_monitor.address
            facts = {"device": f"/dev/i2c-{options.bus}", "parts": parts, "environment": environment}
            assigned = " ".join(f"{name}={shlex.quote(value)}" for name, value in environment.items())
            sys.stdout.write((json.dumps(facts) if options.json else assigned) + "\n")
            sys.stdout.flush()
            _serve(server, None, options.duration)
        finally:
            server.close()
    return 0


def _run_program(
    server: I2cServer, program: list[str], environment: Mapping[str, str], duration: float | None
) -> int:
    """Run a program with the server, and return the exit status of the program as a shell does."""
    try:
        process = subprocess.Popen(program, env={**os.environ, **environment})
    except OSError as error:
        raise UsageError(f"{program[0]} cannot be run: {error.strerror}") from error
    _serve(server, process, duration)
    if process.poll() is None:
        process.terminate()
    status = process.wait()
    return status if status >= 0 else 128 - status


def _serve(server: I2cServer, process: subprocess.Popen[bytes] | None, duration: float | None) -> None:
    """Answer requests until the process ends, the duration is over or a signal arrives."""
    clock = SystemClock()
    end_ns = None if duration is None else clock.now_ns() + round(duration * SECOND_NS)
    with stop_signals() as stopped:
        while not stopped.is_set() and (process is None or process.poll() is None):
            if end_ns is not None and clock.now_ns() >= end_ns:
                return
            server.serve(_LONGEST_WAIT_S)


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set, and restore the previous handlers afterwards."""
    stopped = threading.Event()

    def stop(_signal: int, _frame: FrameType | None) -> None:
        stopped.set()

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopped
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
