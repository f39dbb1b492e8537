"""The flight process's end of `sim_hal.serving.server`: bus and camera over a socket, the unit over a pty.

`served` starts the server beside the flight process and waits until its devices answer.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import lock_bus
from hal.buses.serial_port import PySerialPort
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import Wires
from knightcube.errors import UsageError
from sim_hal.serving.device_link import DeviceLink, RemoteI2cBus

PATIENCE_S = 5.0
"""How long the devices outlive a flight process that died."""

_START_S = 20.0
_FACTS = ("serial", "baud_rate", "socket", "camera", "gps", "gps_baud_rate", "wide")
OPENER = "sim_hal.serving.device_link:open_bus"


class RemoteFrameSource:
    """A FrameSource whose camera is in the server's process; frames are announced, and read from a file."""

    def __init__(self, path: Path, clock: SystemClock, number: int = 0) -> None:
        """Connect to the star camera, number 0, or to a wide one."""
        self._number = number
        self._link = DeviceLink(path)
        self._folder = path.parent
        self._clock = clock

    def trigger(self, exposure_ns: int) -> None:
        """Start an exposure without waiting for the answer."""
        try:
            self._link.send("trigger", exposure_ns, self._number)
        except OSError as error:
            raise NotResponding("camera", f"the emulated devices are gone ({error})") from error

    def poll(self) -> Frame | None:
        """Return the newest frame announced since the last call. Raises NotResponding when refused."""
        newest: Frame | None = None
        try:
            while self._link.pending() or select.select([self._link], [], [], 0.0)[0]:
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
    """Clock, wires and release of devices in another process."""

    clock: SystemClock
    wires: Wires
    release: Callable[..., None]
    """Takes mission time zero, and the faults of the flight as they are written."""
    bus: tuple[str, str]
    """How another process opens the bus: `module:function` and that function's argument."""


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
        with _connected(_server_facts(process)) as plugged:
            yield plugged
    finally:
        process.terminate()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


@contextmanager
def running(facts_path: Path) -> Iterator[Served]:
    """Connect to a server that runs already, and leave it running. Raises UsageError, NotResponding.

    `facts_path` is the file that `python -m sim_hal serve CONFIG --facts FILE` wrote.
    """
    with ExitStack() as stack:
        try:
            file = stack.enter_context(facts_path.open(encoding="utf-8"))
            facts = json.load(file)
            facts = {name: facts[name] for name in _FACTS}
        except (OSError, ValueError, LookupError, TypeError) as error:
            problem = f"{facts_path} names no server: give what `sim_hal serve --facts` wrote"
            raise UsageError(problem) from error
        try:
            lock_bus(file.fileno())
        except OSError as error:
            raise NotResponding(str(facts_path), error.strerror or "is locked") from error
        yield stack.enter_context(_connected(facts))


@contextmanager
def _connected(facts: dict[str, Any]) -> Iterator[Served]:
    """Connect to the server with these facts."""
    clock = SystemClock()
    path = Path(facts["socket"])
    with ExitStack() as stack:
        serial = PySerialPort(facts["serial"], facts["baud_rate"], clock)
        stack.callback(serial.close)
        try:
            bus = RemoteI2cBus(path)
            stack.callback(bus.close)
            camera = RemoteFrameSource(path, clock) if facts["camera"] else None
            wide = tuple(RemoteFrameSource(path, clock, number + 1) for number in range(facts["wide"]))
        except OSError as error:
            raise NotResponding("emulated devices", f"no server answers on {path} ({error})") from error
        for source in wide if camera is None else (camera, *wide):
            stack.callback(source.close)
        gps = None
        if facts["gps"] is not None:
            gps = PySerialPort(facts["gps"], facts["gps_baud_rate"], clock)
            stack.callback(gps.close)
        wires = Wires(serial, bus, camera, gps, wide)

        def release(epoch_ns: int, faults: Sequence[str] = ()) -> None:
            bus.call("release", epoch_ns, list(faults), os.getpid())

        yield Served(clock, wires, release, (OPENER, str(path)))


def _server_facts(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Return the facts that the server prints once its devices answer."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], _START_S)
    line = process.stdout.readline() if ready else b""
    if not line:
        raise NotResponding("emulated devices", f"the server did not start within {_START_S:g} s")
    facts: dict[str, Any] = json.loads(line)
    return facts
