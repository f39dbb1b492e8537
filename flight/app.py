"""The composing root: from a configuration to a flight that has ended, with everything closed behind it.

The one place of the flight application that knows which hardware there is: Linux's, simulated in lock-step,
or simulated in real time in a process of its own. Whatever happens, the coils are at zero when `fly` returns.
"""

from __future__ import annotations

import importlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from flight import config as configuration
from flight import events
from flight.commands.channel import Channel, open_udp, open_unix
from flight.errors import ConfigError, UsageError
from flight.executive.jobs import JobResult, JobRunner
from flight.executive.lockstep import LockStepRunner
from flight.executive.processes import ProcessRunner
from flight.frames import NED_TO_TESTBED, attitude_map
from flight.health.board import Board
from flight.loop import SECOND_NS, Devices, FlightLoop, Progress, RunLabel, workers
from flight.quaternion import attitude_matrix
from flight.settings import AravisDevice, Camera, Config, V4l2Device
from flight.startracker.build import ensure_default_index
from flight.state.opening import open_state, state_folder
from flight.supervision import Supervision
from flight.telemetry.archive import begin_run
from flight.telemetry.log import FlightLog
from flight.telemetry.recorder import Recorder
from flight.telemetry.segments import open_segment
from hal.buses import real_time
from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import LinuxI2cBus
from hal.buses.serial_port import PySerialPort
from hal.buses.service_manager import ServiceManager
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.drivers.camera import CameraDevice, ServedCamera
from hal.drivers.coil_settings import DEVICE as COILS
from hal.drivers.coil_settings import CoilSettings, CoilWiring
from hal.drivers.coils import PwmTorqueCoils
from hal.drivers.ina219 import Ina219
from hal.drivers.pca9685 import Pca9685, switch_off
from hal.drivers.v4l2_camera import Stamp, V4l2Camera, V4l2Settings
from hal.drivers.vn100.driver import Vn100, Vn100Settings
from hal.guardian.client import CoilReach, GuardianLine
from hal.interfaces.devices import FrameSource
from hal.interfaces.wires import Clock, Wires

CONTROL_PRIORITY = 50
"""Of SCHED_FIFO, for the control thread and the coils' own."""

_GRID_NS = 25_000_000


@dataclass(frozen=True, slots=True)
class Order:
    """What the user asked for. `duration` in s and `seed` replace the configuration's when given.

    `devices` is the file of a server of simulated devices that runs already; without it one is started.
    `archive` holds the runs of a board: the next of them is flown into, instead of into `out`.
    `faults` are injected in simulation, beside those of the configuration, see `sim_hal.faults.grammar`.
    """

    config_path: Path
    out: Path
    realtime: bool = False
    duration: float | None = None
    seed: int | None = None
    devices: Path | None = None
    archive: Path | None = None
    faults: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended; `interrupted` when a signal asked for it.

    `restart` says why the process should be started again, empty when it should not.
    """

    folder: Path
    reason: str
    interrupted: bool
    log_error: str
    restart: str = ""


@dataclass(frozen=True, slots=True)
class Rig:
    """A clock, the wires, and what else depends on the kind of hardware.

    `release` is told mission time zero; `latency` of planner and vision in ns holds in lock-step only, and
    `reach`, by which a guardian zeroes the coils, in real time only. `host` breaks what is in this process,
    where a simulation asks for that.
    """

    clock: Clock
    wires: Wires
    release: Callable[[int], None]
    realtime: bool
    seed: int
    latency: tuple[int, int] = (0, 0)
    reach: CoilReach | None = None
    host: Any = None


def fly(order: Order, progress: Callable[[Progress], None] | None = None) -> Outcome:
    """Fly a configuration to its end. Raises UsageError for the user to mend, DeviceError for a device."""
    text, config = _load(order)
    if order.archive is not None:
        logs_bytes = (2 if config.simulation is None else 3) * config.telemetry.budget_bytes
        run = begin_run(order.archive, config.telemetry.archive_bytes, logs_bytes)
        order = replace(order, out=run.folder)
    _prepare_folder(order.out, text)
    with ExitStack() as stack:
        rig = _open_rig(order, text, config, stack)
        loop, flight_log = prepare(config, rig, order.out, stack)
        if progress is not None:
            loop.watch(progress)
        label = RunLabel(text, rig.seed, config.simulation is not None, rig.realtime)
        with _signals_stop(loop) as received:
            epoch_ns = mission_zero(rig.clock) if rig.realtime else next_whole_second(rig.clock)
            rig.release(epoch_ns)
            reason = loop.run(epoch_ns, label)
    return Outcome(order.out, reason, bool(received), flight_log.error(), loop.restart)


def default_folder(config_path: Path) -> Path:
    """Return the folder of a run that was given none: its configuration's name and the time, as labels."""
    now = datetime.fromtimestamp(SystemClock().utc_ns() * 1e-9, UTC)
    return Path("runs") / f"{config_path.stem}-{now:%Y%m%d-%H%M%S}"


def fault_catalogue() -> tuple[str, str]:
    """Return how faults of a simulation are written, and a list of all."""
    grammar = importlib.import_module("sim_hal.faults.grammar").GRAMMAR
    listing = importlib.import_module("sim_hal.faults.catalogue").listing()
    return grammar, listing


def prepare(config: Config, rig: Rig, folder: Path, stack: ExitStack) -> tuple[FlightLoop, FlightLog]:
    """Open logs, devices and workers; `stack` closes them in the opposite order, the coils at zero."""
    sync_ns = SECOND_NS if rig.realtime else None
    flight_log = _open_log(folder, "flight", rig, config, sync_ns, stack)
    performance_log = _open_log(folder, "performance", rig, config, sync_ns, stack)
    keeper = open_state(config, os.environ, rig.clock, stack)
    guardian = _start_guardian(rig, stack)
    devices = _open_devices(config, rig, stack)
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is None:
        ensure_default_index()
    jobs = _open_jobs(config, rig, stack)
    recorder = Recorder(flight_log, performance_log)
    feed, beat = _nothing, _nothing
    if guardian is not None:
        guardian.wait_ready()
        supervision = _supervise(guardian, rig.clock, recorder, stack)
        feed, beat = supervision.feed, supervision.beat
    loop = FlightLoop(
        config,
        rig.clock,
        devices,
        jobs,
        recorder,
        flight_log.error,
        feed=feed,
        beat=beat,
        keeper=keeper,
        board=Board(folder) if rig.realtime else None,
        channels=_open_channels(config, stack),
    )
    return loop, flight_log


def _nothing() -> None:
    """Tell nobody: in lock-step nobody watches."""


def _open_channels(config: Config, stack: ExitStack) -> list[Channel]:
    """Listen where the configuration says."""
    channels: list[Channel] = []
    if config.commands.socket is not None:
        channels.append(open_unix(Path(config.commands.socket)))
    if config.commands.udp is not None:
        channels.append(open_udp(config.commands.udp))
    for channel in channels:
        stack.callback(channel.close)
    return channels


def _start_guardian(rig: Rig, stack: ExitStack) -> GuardianLine | None:
    """Start the guardian before any coil can be energised; it is the last to go, the coils being off."""
    if rig.reach is None:
        return None
    guardian = GuardianLine(rig.reach)
    stack.callback(guardian.close)
    return guardian


def _supervise(guardian: GuardianLine, clock: Clock, recorder: Recorder, stack: ExitStack) -> Supervision:
    """Have the flight watched, and the control loop with its coils served first."""
    overseer = ServiceManager(os.environ, os.getpid())
    stack.callback(overseer.close)
    first = [thread for thread in threading.enumerate() if thread.name == COILS]
    obtained = real_time.obtain([0, *(thread.native_id or 0 for thread in first)], CONTROL_PRIORITY)
    stack.callback(real_time.relinquish)
    stack.callback(overseer.stopping)
    supervision = Supervision(guardian, overseer, clock, recorder, f"flying; {obtained}")
    supervision.note(events.REAL_TIME_REFUSED if obtained.refusals else events.REAL_TIME, str(obtained))
    return supervision


def _load(order: Order) -> tuple[str, Config]:
    """Return the configuration as text and as values, with the order's changes in the values."""
    config = configuration.load(order.config_path)
    text = order.config_path.read_text(encoding="utf-8")
    if order.faults and config.simulation is None:
        raise UsageError("--fault: this configuration flies real devices, which break by themselves")
    if order.faults:
        spoiled = importlib.import_module("sim_hal.faults.host").corrupted_by(order.faults, text, order.seed)
        if spoiled != text:
            text, config = spoiled, configuration.parse(spoiled, str(order.config_path))
    if order.duration is not None:
        if not (np.isfinite(order.duration) and order.duration > 0.0):
            raise UsageError(f"--duration {order.duration}: must be a positive number of seconds")
        steps = tuple(step for step in config.steps if step.at < order.duration)
        config = configuration.replace(config, duration=order.duration, steps=steps)
    return text, config


def _prepare_folder(out: Path, text: str) -> None:
    """Make the run's folder and keep the configuration in it; a folder that holds a run is not touched."""
    if any(out.glob("*.ccsds")):
        raise UsageError(f"{out} holds a run already: give another folder with --out, or remove it")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "config.yaml").write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out}: cannot be written: {error.strerror or error}") from error


def _open_log(
    folder: Path, stem: str, rig: Rig, config: Config, sync_ns: int | None, stack: ExitStack
) -> FlightLog:
    log = FlightLog(
        folder,
        stem,
        clock=rig.clock,
        segment_bytes=config.telemetry.segment_bytes,
        budget_bytes=config.telemetry.budget_bytes,
        sync_period_ns=sync_ns,
        opener=open_segment if rig.host is None else rig.host.opener(open_segment),
    )
    stack.callback(log.close)
    return log


def _open_rig(order: Order, text: str, config: Config, stack: ExitStack) -> Rig:
    """Return the hardware that the configuration asks for."""
    if config.simulation is None:
        if order.seed is not None:
            raise UsageError("--seed: this configuration flies real devices, which draw their own noise")
        if order.devices is not None:
            raise UsageError("--devices: this configuration flies real devices, not simulated ones")
        return _linux_rig(config, stack)
    sim_settings: Any = importlib.import_module("sim_hal.settings")
    section: Any = configuration.simulation_section(text, str(order.config_path), sim_settings.Simulation)
    if order.seed is not None:
        section = configuration.replace(section, seed=order.seed)
    grammar = importlib.import_module("sim_hal.faults.grammar")
    section = configuration.replace(section, faults=(*section.faults, *grammar.entries(order.faults)))
    rig = _simulated_rig(order, config, section, stack)
    return with_host_faults(rig, section)


def with_host_faults(rig: Rig, section: Any) -> Rig:
    """Return simulated hardware with what is to break in this very process, where anything is."""
    host = importlib.import_module("sim_hal.faults.host").host_faults(section, rig.clock, rig.realtime)
    if host is None:
        return rig

    def release(epoch_ns: int) -> None:
        rig.release(epoch_ns)
        host.begin(epoch_ns)

    return replace(rig, clock=host.clock(), release=release, host=host)


def _linux_rig(config: Config, stack: ExitStack) -> Rig:
    clock = SystemClock()
    i2c = LinuxI2cBus(config.coils.bus)
    stack.callback(i2c.close)
    switch_off(i2c, config.coils.address)  # before anything else can fail
    serial = PySerialPort(config.inertial_unit.device, config.inertial_unit.baud_rate, clock)
    stack.callback(serial.close)
    reach = CoilReach("hal.buses.smbus_byte:open_bus", i2c.name, config.coils.address)
    if (folder := state_folder(config, os.environ)) is not None:
        reach.note(folder)
    frames = _linux_camera(config.camera, clock, stack) if config.camera is not None else None
    return Rig(clock, Wires(serial, i2c, frames), lambda _: None, True, 0, reach=reach)


def _linux_camera(camera: Camera, clock: Clock, stack: ExitStack) -> FrameSource:
    """Open the camera that the configuration names. Raises ConfigError when it names none, DeviceError."""
    device, shape = camera.device, (camera.columns, camera.rows)
    exposure_ns = round(camera.exposure * SECOND_NS)
    opened: CameraDevice
    if isinstance(device, V4l2Device):
        delay_ns = round(device.stamp_delay * SECOND_NS)
        opened = V4l2Camera(
            V4l2Settings(
                device.path,
                *shape,
                device.pixel_format,
                exposure_ns,
                device.gain,
                Stamp(device.stamp),
                delay_ns,
            ),
            clock,
        )
    elif isinstance(device, AravisDevice):
        opened = AravisCamera(
            AravisSettings(device.name, *shape, device.pixel_format, exposure_ns, device.gain), clock
        )
    else:
        raise ConfigError(
            "camera.device",
            "real devices are flown: say which camera, `{kind: v4l2, path: ...}` or `{kind: aravis, name: "
            "...}`, or say `camera: none`",
        )
    source = ServedCamera(opened, clock)
    stack.callback(source.close)
    return source


@contextmanager
def opened_camera(config_path: Path) -> Iterator[tuple[Clock, FrameSource, Camera]]:
    """Open nothing but the camera of a configuration, simulated where it has a simulation section.

    Raises ConfigError when there is no camera in it, DeviceError.
    """
    text, config = _load(Order(config_path, Path()))
    if config.camera is None:
        raise ConfigError(str(config_path), "`camera` is none: give a configuration with a camera")
    with ExitStack() as stack:
        if config.simulation is None:
            clock: Clock = SystemClock()
            yield clock, _linux_camera(config.camera, clock, stack), config.camera
            return
        sim_settings: Any = importlib.import_module("sim_hal.settings")
        section: Any = configuration.simulation_section(text, str(config_path), sim_settings.Simulation)
        lockstep: Any = importlib.import_module("sim_hal.lockstep")
        sim_clock = importlib.import_module("sim_hal.clock").SimClock(lockstep.utc_ns(section.utc))
        built = lockstep.build(config, section, None, sim_clock)
        yield sim_clock, built.wires.frames, config.camera


def _simulated_rig(order: Order, config: Config, section: Any, stack: ExitStack) -> Rig:
    """Return emulated devices: beside the loop in lock-step, or in a process of their own in real time."""
    schedule = importlib.import_module("sim_hal.faults.schedule").scheduled
    if order.realtime:
        schedule(section.faults, True)  # a bad one before a process is started for it
        remote = importlib.import_module("sim_hal.remote")
        if order.devices is not None:
            served = stack.enter_context(remote.running(order.devices))
        else:
            served = stack.enter_context(remote.served(order.config_path, section.seed, order.out))
        opener, where = served.bus
        reach = CoilReach(opener, where, config.coils.address)
        faults = [str(fault) for fault in schedule(section.faults, True)]

        def release(epoch_ns: int) -> None:
            served.release(epoch_ns, faults)

        return Rig(served.clock, served.wires, release, True, section.seed, reach=reach)
    if order.devices is not None:
        raise UsageError("--devices: a server's devices live in real time: give --realtime too")
    lockstep = importlib.import_module("sim_hal.lockstep")
    hardware = stack.enter_context(lockstep.opened(config, section, order.out))
    latency = round(section.latency.planner * SECOND_NS), round(section.latency.vision * SECOND_NS)
    return Rig(hardware.clock, hardware.wires, hardware.release, False, section.seed, latency)


def _open_jobs(config: Config, rig: Rig, stack: ExitStack) -> JobRunner:
    specs = workers(config, *rig.latency)
    made = specs if rig.host is None else rig.host.workers(specs)
    runner: JobRunner = ProcessRunner(rig.clock, made) if rig.realtime else LockStepRunner(rig.clock, made)
    stack.callback(runner.close)
    return runner if rig.host is None else rig.host.jobs(runner, specs, JobResult)


def _open_devices(config: Config, rig: Rig, stack: ExitStack) -> Devices:
    """Set the devices up, the coils first: they are at zero before anything else happens."""
    coils = PwmTorqueCoils(
        Pca9685(rig.wires.i2c, config.coils.address, rig.clock), rig.clock, coil_settings(config)
    )
    stack.callback(coils.close)
    coils.start()
    power = None
    if config.power_monitor is not None:
        monitor = config.power_monitor
        power = Ina219(rig.wires.i2c, monitor.address, rig.clock, monitor.shunt)
        stack.callback(power.close)
    unit = Vn100(rig.wires.serial, rig.clock, unit_settings(config))
    stack.callback(unit.close)
    unit.configure()
    camera = rig.wires.frames
    if camera is not None:
        stack.callback(camera.close)
    return Devices(unit, coils, power, camera)


def coil_settings(config: Config) -> CoilSettings:
    """Return the coils as the configuration believes them."""
    coils = config.coils
    enables = coils.enable_channels or (None, None, None)
    x, y, z = (
        CoilWiring(pair[0], pair[1], resistance, sign, enable)
        for pair, resistance, sign, enable in zip(
            coils.channels, coils.resistance, coils.signs, enables, strict=True
        )
    )
    return CoilSettings((x, y, z), coils.supply_voltage, coils.current_limit, coils.stale_after)


def unit_settings(config: Config) -> Vn100Settings:
    """Return what is asked of the inertial unit; its readings come out in the testbed frame."""
    unit = config.inertial_unit
    mounting = np.array(unit.mounting)
    return Vn100Settings(
        attitude_map=attitude_map(mounting, NED_TO_TESTBED),
        mounting=attitude_matrix(mounting),
        rate_hz=unit.rate_hz,
        output=unit.output,
        field_range=unit.field_range,
    )


def next_whole_second(clock: Clock) -> int:
    """Return mission time zero in lock-step: the next whole second that is half a second away."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


def mission_zero(clock: Clock) -> int:
    """Return mission time zero in real time: soon, on the grid of 40 Hz."""
    return (clock.now_ns() // _GRID_NS + 3) * _GRID_NS


@contextmanager
def _signals_stop(loop: FlightLoop) -> Iterator[list[int]]:
    """End the flight politely on Ctrl-C and on systemd's SIGTERM; the list holds the signals received."""
    received: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        received.append(number)
        loop.stop(f"stopped by {signal.Signals(number).name}")

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
