"""Interface by which the flight application opens emulated devices with their faults.

In lock-step the devices run in the flight process and advance while the flight loop sleeps. The clock jumps
from event to event, and repeated runs are identical. In real time the devices run in a server process
(`sim_hal.serving.server`), with bus and cameras on a socket and the serial lines on pseudo-terminals.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from flight.link.telemetry.log import FlightLog
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, TestbedConfig
from flight.schema.devices import coil_fields, driver_of
from flight.schema.document import ConfigError
from flight.schema.sections import Config
from hal.buses.linux_wires import PySerialPort, device_file, lock_bus
from hal.buses.system import SystemClock
from hal.interfaces.devices import Frame, FrameSource
from hal.interfaces.errors import NotResponding
from hal.interfaces.guardian import CoilReach
from hal.interfaces.wires import SECOND_NS, Clock, Rig
from knightcube import compiled
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitError
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.errors import UsageError
from sim_hal.assembly import (
    Hardware,
    StarRenderer,
    assemble,
    emulated_camera,
    fault_generator,
    sky_objects,
)
from sim_hal.clock import FaultTimeline, SimClock, TimedSimulation
from sim_hal.emulation import EmulatedWires
from sim_hal.emulators.serial_line import EmulatedSerialLine
from sim_hal.faults import schedule
from sim_hal.faults.catalogue import Bench, listing
from sim_hal.faults.host import corrupted_by, host_faults
from sim_hal.faults.schedule import check, put, scheduled
from sim_hal.serving.device_link import DeviceLink, RemoteI2cBus
from sim_hal.settings import YEARS, CageTruth, FreeBodySection, Simulation, utc_seconds
from sim_hal.worlds.world import BodyMotion, TruthRecorder, WorldInputs, make_world

PATIENCE_S = 5.0
"""Time (s) from the death of the flight process until the device server ends."""
BENCH_COIL_FIELD = 5.0e-4
"""Field (T/A) of a coil along its axis at the magnetometer, if neither field nor position is configured."""
_START_S = 20.0
"""Longest time (s) that the server process may take to start."""
_FACTS = ("socket", "camera", "lines", "coil_bus", "wide", "utc_offset_ns")
OPENER = "sim_hal.serving.device_link:open_bus"


@dataclass(frozen=True, slots=True)
class SimulationRequest:
    """Options of a simulated run in addition to its configuration.

    Attributes:
        config_path: path of the configuration file.
        text: text of the configuration that is used, including injected corruption.
        out: folder of the run, in which the log of the true state is written.
        realtime: whether the devices run in a server process.
        seed: random seed that replaces the seed of the configuration, or None.
        devices: file with the connection data of a running device server, which `python -m sim_hal serve
            --facts` wrote, or None to start a server.
        faults: faults that are injected in addition to the faults of the configuration.
    """

    config_path: Path
    text: str
    out: Path
    realtime: bool = False
    seed: int | None = None
    devices: Path | None = None
    faults: tuple[str, ...] = ()

    def section(self) -> Simulation:
        """Return the `simulation` section. Raises ConfigError if the section is missing or invalid."""
        name = str(self.config_path)
        section = configuration.simulation_section(self.text, name, Simulation)
        if section is None:
            raise ConfigError(name, "has no `simulation` section")
        first, last = YEARS
        if not utc_seconds(f"{first}-01-01") <= utc_seconds(section.utc) < utc_seconds(f"{last + 1}-01-01"):
            raise ConfigError("simulation.utc", f"is {section.utc!r}: give a year from {first} to {last}")
        return section


def open_rig(request: SimulationRequest, config: Config, stack: ExitStack) -> Rig:
    """Open the emulated devices of a configuration with the requested faults, until `stack` is closed.

    Raises UsageError or ConfigError before a device is opened, and DeviceError if a device fails.
    """
    section = request.section()
    if request.seed is not None:
        section = configuration.replace(section, seed=request.seed)
    section = configuration.replace(section, faults=(*section.faults, *schedule.entries(request.faults)))
    check(section.faults, config, request.realtime)
    if not request.realtime:
        if request.devices is not None:
            raise UsageError("--devices: the devices of a server run in real time: give --realtime too")
        hardware = stack.enter_context(opened_lockstep(config, section, request.out))
        latency = round(section.latency.planner * SECOND_NS), round(section.latency.vision * SECOND_NS)

        def begin(epoch_ns: int) -> None:
            # Otherwise, the first control cycles would load numba and the machine code of their functions.
            compiled.load("flight.", "knightcube.gnc.")
            hardware.release(epoch_ns)

        return with_host_faults(replace(hardware.rig(section.seed, latency), release=begin), section)
    if request.devices is not None:
        served = stack.enter_context(running_server(request.devices))
    else:
        served = stack.enter_context(started_server(request.config_path, section.seed, request.out))
    off = tuple(driver_of("coils", config.coils).off(config.coils))
    reach = CoilReach(OPENER, str(served.socket_path), off)
    faults = [str(fault) for fault in scheduled(section.faults, True)]

    def release(epoch_ns: int) -> None:
        served.release(epoch_ns, faults)

    given = served.clock, served.wires, release, True, section.seed
    rig = Rig(*given, reach=reach, cameras=served.cameras, lateness=served.lateness)
    return with_host_faults(rig, section)


def check_elements(request: SimulationRequest, config: Config) -> None:
    """Raise ConfigError if the elements of a satellite or of a cage do not fit the simulated orbit."""
    section = request.section()
    lines: tuple[str, str] | None
    described: FreeBodySection | CageTruth | None
    if isinstance(config, OrbitConfig):
        name, lines, world, described = "elements", config.elements, "free_body", section.free_body
        cure = "`knightcube elements --config FILE` makes elements of the simulated orbit"
    else:
        cage = cast(TestbedConfig, config).cage
        lines = None if cage is None else cage.elements
        name, world, described = "cage.elements", "cage", section.cage
        cure = "`knightcube elements --altitude KM` makes elements of this orbit"
    if lines is None or described is None:
        return
    from sim_hal.worlds.orbit import misfit  # noqa: PLC0415 - loads SciPy

    try:
        problem = misfit(lines, described.orbit, section.utc, f"simulation.{world}.orbit")
    except UsageError as error:
        raise ConfigError(name, f"are not valid two-line elements: {error}: {cure}") from error
    except OrbitError as error:
        raise ConfigError(name, f"give no position at `simulation.utc`: {error}: {cure}") from error
    if problem:
        orbit = f"the first revolution of `simulation.{world}.orbit`"
        raise ConfigError(name, f"do not fit {orbit}: {problem}: {cure}")


@dataclass(frozen=True, slots=True)
class PosedCamera:
    """A star camera, its clock, and a function from a time (ns) to its attitude (4,), ICRS into camera."""

    clock: Clock
    frames: FrameSource
    attitude: Callable[[int], FloatArray]


def open_camera(request: SimulationRequest, config: Config, rate: FloatArray) -> PosedCamera:
    """Return the emulated star camera of a configuration, without other devices and with a known motion.

    The camera starts at the attitude at which the body is released and rotates at `rate` (3,), rad/s, camera
    axes. The times of the camera faults in the section `simulation` are counted from this call. Raises
    ConfigError for an invalid world, and UsageError for a fault that would have no effect in a flight.
    """
    section = request.section()
    faults = [one for one in check(section.faults, config, False) if one.kind.device == "camera"]
    return posed_camera(config, section, SimClock(utc_ns(section.utc)), rate, faults)


def posed_camera(
    config: Config,
    section: Simulation,
    clock: SimClock,
    rate: FloatArray,
    faults: Sequence[schedule.ScheduledFault] = (),
) -> PosedCamera:
    """Return the star camera of `open_camera`, with the clock `clock` and the `faults`."""
    camera = config.camera
    assert camera is not None, "the caller checks that the configuration has a camera"
    begun_ns, mounting = clock.now_ns(), np.array(camera.mounting)
    world = make_world(WorldInputs(config, section, lambda: np.zeros(3), begun_ns))
    objects = sky_objects(section, begun_ns, world)
    held, body_rate = world.motion(begun_ns), attitude_matrix(mounting).T @ rate
    zero = np.zeros(3)

    def motion(time_ns: int) -> BodyMotion:
        turned = from_rotation_vector(body_rate * ((time_ns - begun_ns) * 1e-9))
        return BodyMotion(time_ns, multiply(turned, held.quaternion), body_rate, zero, zero)

    expose = StarRenderer(camera, section.sky, section.seed).expose
    device = emulated_camera(camera, section.sky, motion, expose, clock.now_ns, objects)
    timeline = FaultTimeline()
    clock.attach(TimedSimulation(lambda _: None, [timeline, device]))
    # The faults of a camera use only these parts of the hardware.
    parts: Any = SimpleNamespace(camera=device, faults=timeline)
    put(faults, Bench(parts, cast(Any, None), clock.now_ns, fault_generator(section.seed)), begun_ns)
    timeline.advance(begun_ns)
    return PosedCamera(clock, device, lambda time_ns: multiply(mounting, motion(time_ns).quaternion))


@dataclass(frozen=True, slots=True)
class EmulatedBench:
    """Emulated devices of a body on a bench, and the emulated manual rotation, lens caps and lamp."""

    rig: Rig
    hardware: Hardware

    def turn(self, axis: FloatArray, angle: float, seconds: float) -> None:
        """Rotate the upright body about `axis` (3,) by `angle` rad, beginning now.

        The angle 0 restores the upright attitude.
        """
        held: Any = self.hardware.world
        held.turn(axis, angle, self.rig.clock.now_ns(), seconds)

    def cover(self, on: bool, number: int = 0) -> None:
        """Put the cap on a lens or take it off. A camera that already has a fault keeps its fault.

        `number` is 0 for the star camera and 1 or more for a horizon camera.
        """
        camera = (self.hardware.camera, *self.hardware.orbit.wide)[number]
        cap = "covered" if number else "capped"
        if camera is not None and camera.fault in {"", cap}:
            camera.fault = cap if on else ""

    def light(self, normal: FloatArray) -> None:
        """Illuminate the panel with the outward `normal` (3,), body axes; zeros switch the lamp off."""
        cells = self.hardware.orbit.cells
        if cells is not None:
            cells.lamp = normal


def open_bench(request: SimulationRequest, config: Config) -> EmulatedBench:
    """Return the emulated devices of a configuration for a bench, in lock-step, with the configured faults.

    The noise of the inertial unit is that of its data sheet plus the errors that `simulation.imu` adds. Each
    coil produces a field at the magnetometer even if the section `simulation` does not describe this field.
    """
    section = request.section()
    check(section.faults, config, False)
    imu = configuration.replace(section.imu, profile="datasheet")
    fields = coil_fields(config)
    if fields is None:
        fields = BENCH_COIL_FIELD * np.array([coil.direction() for coil in config.coils.slots])
    rows = section.coil_field or tuple(map(tuple, fields.T.tolist()))
    section = configuration.replace(section, world="bench", imu=imu, coil_field=rows)
    clock = SimClock(utc_ns(section.utc))
    devices = build_lockstep(config, section, None, clock)
    devices.release(clock.now_ns())
    return EmulatedBench(devices.rig(section.seed), devices.hardware)


def fault_catalogue() -> tuple[str, str]:
    """Return a text about the syntax of faults and a list of all faults as text."""
    return schedule.GRAMMAR, listing()


def injected_faults(request: SimulationRequest) -> tuple[str, ...]:
    """Return the faults of a flight as texts, beginning with those of the configuration."""
    faults = (*schedule.schedule(request.section().faults), *map(schedule.parse, request.faults))
    return tuple(map(str, faults))


def corrupted_text(faults: tuple[str, ...], text: str, seed: int | None) -> str:
    """Return the text of a configuration after the requested faults have corrupted it."""
    return corrupted_by(faults, text, seed)


def with_host_faults(rig: Rig, section: Simulation) -> Rig:
    """Return `rig` with the faults that act inside the flight process, if the section has any."""
    host = host_faults(section, rig.clock, rig.realtime)
    if host is None:
        return rig

    def release(epoch_ns: int) -> None:
        rig.release(epoch_ns)
        host.begin(epoch_ns)

    return replace(rig, clock=host.clock(), release=release, host=host)


@dataclass(frozen=True, slots=True)
class LockStep:
    """Emulated devices in lock-step. The flight uses only `rig`; faults and tests also use other attributes.

    The attribute `line` is the serial line of the inertial unit, or None for a unit without a serial line.
    """

    clock: SimClock
    wires: EmulatedWires
    cameras: tuple[FrameSource | None, ...]
    release: Callable[[int], None]
    hardware: Hardware
    line: EmulatedSerialLine
    gps_line: EmulatedSerialLine | None = None

    def rig(self, seed: int = 1, latency: tuple[int, int] = (0, 0)) -> Rig:
        """Return the rig of a flight with these devices."""
        return Rig(self.clock, self.wires, self.release, False, seed, latency, cameras=self.cameras)


def utc_ns(label: str) -> int:
    """Return the time since 1970 (ns) of an ISO 8601 time. Raises ConfigError as `utc_seconds` does."""
    return round(utc_seconds(label)) * 1_000_000_000


def build_lockstep(
    config: Config, section: Simulation, truth: TruthRecorder | None, clock: SimClock
) -> LockStep:
    """Assemble the simulated hardware and attach it to a clock."""
    wires = EmulatedWires(clock.now_ns, section.seed, config.coils.bus)
    hardware = assemble(config, section, clock.now_ns, wires, truth)
    clock.attach(hardware.simulation)
    line, gps_line = (cast(EmulatedSerialLine, wires.line_of(kind)) for kind in ("inertial_unit", "gps"))
    faults, cameras = scheduled(section.faults, realtime=False), (hardware.camera, *hardware.orbit.wide)
    host = None if line is None else line.host
    bench = Bench(hardware, line, clock.now_ns, fault_generator(section.seed), host, gps_line=gps_line)

    def release(epoch_ns: int) -> None:
        hardware.release(epoch_ns)
        put(faults, bench, epoch_ns)

    return LockStep(clock, wires, cameras, release, hardware, line, gps_line)


@contextmanager
def opened_lockstep(config: Config, section: Simulation, folder: Path) -> Iterator[LockStep]:
    """Assemble the devices for lock-step, with a log of the true state in `folder`."""
    clock = SimClock(utc_ns(section.utc))
    log = FlightLog(folder, "truth", clock=clock, sync_period_ns=None)
    try:
        yield build_lockstep(config, section, TruthRecorder(log), clock)
    finally:
        log.close()


class SimulatedUtcClock(SystemClock):
    """Monotonic clock of the computer with the UTC of a simulated orbit."""

    def __init__(self, offset_ns: int) -> None:
        """`offset_ns` is the simulated UTC minus CLOCK_MONOTONIC, ns."""
        super().__init__()
        self._offset_ns = offset_ns

    def utc_ns(self) -> int:
        """Return the simulated UTC in ns since 1970."""
        return self.now_ns() + self._offset_ns


class RemoteFrameSource:
    """Client of a camera in the server process.

    The server announces each frame in a message, and the client reads the pixels from a file.
    """

    def __init__(self, path: Path, clock: SystemClock, number: int = 0) -> None:
        """Connect to the camera `number`: 0 for the star camera, 1 or more for a horizon camera."""
        self._number = number
        self._link = DeviceLink(path)
        self._folder = path.parent
        self._clock = clock

    def trigger(self, exposure_ns: int) -> None:
        """Start an exposure without waiting for the server's answer."""
        try:
            self._link.send("trigger", exposure_ns, self._number)
        except OSError as error:
            raise NotResponding("camera", f"the emulated devices have ended ({error})") from error

    def poll(self) -> Frame | None:
        """Return the newest frame announced since the last call, or None if none was announced.

        Raises NotResponding if the server has ended or reports an error.
        """
        newest: Frame | None = None
        try:
            while self._link.pending() or select.select([self._link], [], [], 0.0)[0]:
                _, kind, result, text = self._link.receive()
                if kind == "frame":
                    sequence, start_ns, exposure_ns, shape, dtype = result
                    pixels = np.fromfile(self._folder / text, dtype=dtype).reshape(shape)
                    newest = Frame(sequence, start_ns, exposure_ns, self._clock.now_ns(), pixels)
                elif kind != "done":
                    raise NotResponding("camera", text)
        except OSError as error:
            raise NotResponding("camera", f"the emulated devices have ended ({error})") from error
        return newest

    def close(self) -> None:
        """Close the connection."""
        self._link.close()


class ServedWires:
    """Connections to emulated devices in a server process (`hal.interfaces.wires.Wires`)."""

    def __init__(
        self, clock: SystemClock, path: Path, lines: dict[str, str], coil_bus: str, stack: ExitStack
    ) -> None:
        """Use the server's socket `path`; `lines` maps device files to the names of pseudo-terminals."""
        self._clock, self._path, self._lines, self._stack = clock, path, lines, stack
        self._coil_bus = coil_bus
        self._open: dict[str, Any] = {}

    def serial(self, device: str, baud_rate: int) -> PySerialPort:
        """Return the serial port of an emulated device. Raises NotResponding."""
        if device not in self._lines:
            raise NotResponding(device, "no emulated device is connected to this line")
        if device in self._open and self._open[device].closed:
            del self._open[device]
        port: PySerialPort = self._kept(
            device, lambda: PySerialPort(self._lines[device], baud_rate, self._clock)
        )
        return port

    def i2c(self, bus: int | str | None = None) -> RemoteI2cBus:
        """Return the emulated I2C bus with the number or device file `bus`; None means the coil driver's bus.

        Raises NotResponding.
        """
        name = self._coil_bus if bus is None else device_file(bus)
        opened: RemoteI2cBus = self._kept(name, lambda: RemoteI2cBus(self._path, name))
        return opened

    def spi(self, device: str, speed_hz: int, mode: int) -> RemoteI2cBus:
        """Return an emulated device on an SPI bus. Raises NotResponding."""
        return self.i2c(device)

    def _kept(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._open:
            try:
                self._open[name] = make()
            except OSError as error:
                raise NotResponding(name, f"the emulated devices do not answer ({error})") from error
            self._stack.callback(self._open[name].close)
        return self._open[name]


@dataclass(frozen=True, slots=True)
class Served:
    """Connections to the devices in a server process."""

    clock: SystemClock
    wires: ServedWires
    cameras: tuple[FrameSource | None, ...]
    bus: RemoteI2cBus
    socket_path: Path

    def release(self, epoch_ns: int, faults: Sequence[str] = ()) -> None:
        """Release the body at `epoch_ns` and schedule the faults of the flight."""
        self.bus.call("release", epoch_ns, list(faults), os.getpid())

    def lateness(self) -> tuple[int, float]:
        """Return the number of delayed events since the release, and the largest delay, s. Raises OSError."""
        late, latest_ns = self.bus.call("lateness")
        return int(late), 1e-9 * latest_ns


@contextmanager
def started_server(config_path: Path, seed: int, folder: Path) -> Iterator[Served]:
    """Start a device server for a configuration, and end it afterwards.

    Raises NotResponding if the server does not start, or ends while the flight still uses it.
    """
    command = [sys.executable, "-m", "sim_hal", "serve", str(config_path), "--folder", str(folder)]
    process = subprocess.Popen(
        [*command, "--seed", str(seed), "--patience", str(PATIENCE_S)],
        stdout=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C must reach only the flight process, which then ends the server
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    try:
        ready, _, _ = select.select([process.stdout], [], [], _START_S)
        line = process.stdout.readline() if ready else b""
        if not line:
            raise NotResponding("emulated devices", f"the server did not start within {_START_S:g} s")
        with _connected(json.loads(line)) as served:
            try:
                yield served
            except OSError:
                # A server that is ending has closed its connections.
                with suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=5.0)
                if process.returncode is None:
                    raise
        if process.poll() is not None:
            raise NotResponding("emulated devices", "the server ended during the flight (see above)")
    finally:
        process.terminate()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


@contextmanager
def running_server(facts_path: Path) -> Iterator[Served]:
    """Connect to a running device server, which continues to run afterwards.

    `facts_path` is the file that `python -m sim_hal serve CONFIG --facts FILE` wrote. Raises UsageError for
    an invalid file and NotResponding if no server answers.
    """
    with ExitStack() as stack:
        try:
            file = stack.enter_context(facts_path.open(encoding="utf-8"))
            facts = json.load(file)
            facts = {name: facts[name] for name in _FACTS}
        except (OSError, ValueError, LookupError, TypeError) as error:
            problem = "describes no server"
            if isinstance(error, OSError):
                problem = f"cannot be read ({error.strerror})"
            cure = "give a file that `python -m sim_hal serve --facts` wrote"
            raise UsageError(f"--devices {facts_path}: {problem}: {cure}") from error
        try:
            lock_bus(file.fileno())
        except OSError as error:
            raise NotResponding(str(facts_path), error.strerror or "is locked") from error
        yield stack.enter_context(_connected(facts))


@contextmanager
def _connected(facts: dict[str, Any]) -> Iterator[Served]:
    """Connect to a device server with the connection data `facts`."""
    offset_ns = facts["utc_offset_ns"]
    clock = SystemClock() if offset_ns is None else SimulatedUtcClock(offset_ns)
    path = Path(facts["socket"])
    with ExitStack() as stack:
        wires = ServedWires(clock, path, facts["lines"], facts["coil_bus"], stack)
        try:
            bus = RemoteI2cBus(path)
            stack.callback(bus.close)
            camera = RemoteFrameSource(path, clock) if facts["camera"] else None
            wide = tuple(RemoteFrameSource(path, clock, number + 1) for number in range(facts["wide"]))
        except OSError as error:
            raise NotResponding("emulated devices", f"no server answers on {path} ({error})") from error
        for source in wide if camera is None else (camera, *wide):
            stack.callback(source.close)
        yield Served(clock, wires, (camera, *wide), bus, path)
