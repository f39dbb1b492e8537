"""`sim_hal emulate i2c`: serves the coils' I2C bus to programs that open /dev/i2c-N themselves.

Programs reach the bus through a preload library (`i2c_preload.c`) rather than a CUSE device. A CUSE device
needs a kernel module, its device node and the right to use both, which containers and shared machines lack.
The library needs a C compiler once for each version. Programs that are linked statically, or set-user-id, do
not load it.

The library sends requests over a Unix socket. A request is its length and one of three kinds of content; an
answer is an errno, a length and data. All numbers are in the machine's own byte order, because both ends are
on one machine.
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
from collections.abc import Mapping
from pathlib import Path
from types import FrameType

import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import config_path, names
from hal.buses.clock import SystemClock
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import UsageError
from sim_hal.assembly import CoilHardware, assemble_coils
from sim_hal.emulators import i2c_bus
from sim_hal.emulators.i2c_bus import EmulatedI2cBus, Message
from sim_hal.serving.options import positive, seed
from sim_hal.settings import Release, Simulation

SOURCE = Path(__file__).with_name("i2c_preload.c")
_FLAGS = ("-shared", "-fPIC", "-O2", "-w")
_COMPILERS = ("cc", "gcc", "clang")


def library() -> Path:
    """Return the compiled library, from the user's cache if it is there. Raises UsageError."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "knightcube"
    text = SOURCE.read_bytes()
    path = folder / f"i2c-preload-{os.uname().machine}-{hashlib.sha256(text).hexdigest()[:16]}.so"
    if path.is_file():
        return path
    compiler = _compiler()
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


def _compiler() -> str:
    named = os.environ.get("CC")
    for name in (named,) if named else _COMPILERS:
        if found := shutil.which(name):
            return found
    raise UsageError(
        f"no C compiler ({named or ', '.join(_COMPILERS)}) to build the preload library with: install one"
        " (Debian: apt-get install gcc libc6-dev) or name it by CC"
    )


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


_LONGEST_WAIT_S = 0.05

_EXAMPLES = """\
examples:
  python -m sim_hal emulate i2c -- i2cdetect -y 1
      run a program on the emulated bus; ends with it, and with its status
  python -m sim_hal emulate i2c --bus 7 --config testbed -- python3 my_driver.py
      another bus number, and the coils of another configuration
  python -m sim_hal emulate i2c
      serve until interrupted; prints the environment that lets any program open the bus
"""


def add_to(devices: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the device to `sim_hal emulate`."""
    parser = devices.add_parser(
        "i2c",
        help="the coils' I2C bus, for unchanged programs",
        description="Serve the PWM chip and the current monitor of a configuration's coils, in real time, to "
        "programs that open /dev/i2c-N themselves.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    carried = ", ".join(names())
    add = parser.add_argument
    add(
        "--config",
        type=config_path,
        default=config_path("step_demo"),
        metavar="CONFIG",
        help=f"YAML file, or one of {carried} (default step_demo)",
    )
    add("program", nargs="*", metavar="PROGRAM", help="after --: a program to run, with its arguments")
    add("--bus", type=int, choices=range(256), default=1, metavar="N", help="serve /dev/i2c-N (default 1)")
    add("--seed", type=seed, default=1, help="of the currents' noise (default 1)")
    add("--duration", type=positive, metavar="S", help="end after S seconds")
    add("--json", action="store_true", help="print one JSON object instead of the environment")
    parser.set_defaults(command=emulate)


def emulate(options: argparse.Namespace) -> int:
    """Serve until the program ends, or without one until SIGINT, SIGTERM or the duration's end."""
    try:
        coils = _coils(options.config, options.seed)
        with tempfile.TemporaryDirectory(prefix="knightcube-i2c-") as folder:
            path = Path(folder) / "bus.sock"
            environment = {
                "LD_PRELOAD": str(library()),
                "KNIGHTCUBE_I2C": str(path),
                "KNIGHTCUBE_I2C_BUS": str(options.bus),
            }
            server = I2cServer(coils.bus, path)
            try:
                if options.program:
                    return _with_program(server, options.program, environment, options.duration)
                _announce(options, environment, coils)
                _serve(server, None, options.duration)
            finally:
                server.close()
    except UsageError as error:
        sys.stderr.write(f"sim_hal: {error}\n")
        return 2
    return 0


def _coils(config_file: Path, number: int) -> CoilHardware:
    config = configuration.load(config_file)
    text = config_file.read_text(encoding="utf-8")
    section = configuration.simulation_section(text, str(config_file), Simulation)
    if section is None:  # a board's configuration: its coils have the configured values
        section = Simulation(release=Release(q2=0.0))
    return assemble_coils(config, section, np.random.default_rng(number), SystemClock().now_ns)


def _announce(options: argparse.Namespace, environment: Mapping[str, str], coils: CoilHardware) -> None:
    parts = {"pca9685": coils.pwm.address}
    if coils.monitor is not None:
        parts["ina219"] = coils.monitor.address
    facts = {"device": f"/dev/i2c-{options.bus}", "parts": parts, "environment": environment}
    text = " ".join(f"{name}={shlex.quote(value)}" for name, value in environment.items())
    sys.stdout.write((json.dumps(facts) if options.json else text) + "\n")
    sys.stdout.flush()


def _with_program(
    server: I2cServer, program: list[str], environment: Mapping[str, str], duration: float | None
) -> int:
    """Run a program beside the server; return its exit status as a shell does."""
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
    """Answer requests until the process, the duration or a signal ends it."""
    stopped = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    clock = SystemClock()
    end_ns = None if duration is None else clock.now_ns() + round(duration * SECOND_NS)
    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        while not stopped and (process is None or process.poll() is None):
            if end_ns is not None and clock.now_ns() >= end_ns:
                return
            server.serve(_LONGEST_WAIT_S)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
