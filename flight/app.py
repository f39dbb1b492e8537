"""The composing root: from a configuration to a flight that has ended, with everything closed behind it.

The one place of the flight application that knows which hardware there is: Linux's, simulated in lock-step,
or simulated in real time in a process of its own. Whatever happens, the coils are at zero when `fly` returns.
"""

from __future__ import annotations

import importlib
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from flight import config as configuration
from flight.errors import ConfigError, UsageError
from flight.executive.jobs import JobRunner
from flight.executive.lockstep import LockStepRunner
from flight.executive.processes import ProcessRunner
from flight.frames import NED_TO_TESTBED, attitude_map
from flight.loop import SECOND_NS, Devices, FlightLoop, Progress, RunLabel, workers
from flight.quaternion import attitude_matrix
from flight.settings import Config
from flight.startracker.build import ensure_default_index
from flight.telemetry.log import FlightLog
from flight.telemetry.recorder import Recorder
from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import LinuxI2cBus
from hal.buses.serial_port import PySerialPort
from hal.drivers.coil_settings import CoilSettings, CoilWiring
from hal.drivers.coils import PwmTorqueCoils
from hal.drivers.ina219 import Ina219
from hal.drivers.pca9685 import Pca9685, switch_off
from hal.drivers.vn100.driver import Vn100, Vn100Settings
from hal.interfaces.wires import Clock, Wires


@dataclass(frozen=True, slots=True)
class Order:
    """What the user asked for. `duration` in s and `seed` replace the configuration's when given."""

    config_path: Path
    out: Path
    realtime: bool = False
    duration: float | None = None
    seed: int | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended; `interrupted` when a signal asked for it."""

    folder: Path
    reason: str
    interrupted: bool
    log_error: str


@dataclass(frozen=True, slots=True)
class Rig:
    """A clock, the wires, and what else depends on the kind of hardware.

    `release` is told mission time zero; `latency` of planner and vision in ns holds in lock-step only.
    """

    clock: Clock
    wires: Wires
    release: Callable[[int], None]
    realtime: bool
    seed: int
    latency: tuple[int, int] = (0, 0)


def fly(order: Order, progress: Callable[[Progress], None] | None = None) -> Outcome:
    """Fly a configuration to its end. Raises UsageError for the user to mend, DeviceError for a device."""
    text, config = _load(order)
    _prepare_folder(order.out, text)
    with ExitStack() as stack:
        rig = _open_rig(order, text, config, stack)
        loop, flight_log = prepare(config, rig, order.out, stack)
        if progress is not None:
            loop.watch(progress)
        label = RunLabel(text, rig.seed, config.simulation is not None, rig.realtime)
        with _signals_stop(loop) as received:
            epoch_ns = next_whole_second(rig.clock)
            rig.release(epoch_ns)
            reason = loop.run(epoch_ns, label)
    return Outcome(order.out, reason, bool(received), flight_log.error())


def default_folder(config_path: Path) -> Path:
    """Return the folder of a run that was given none: its configuration's name and the time, as labels."""
    now = datetime.fromtimestamp(SystemClock().utc_ns() * 1e-9, UTC)
    return Path("runs") / f"{config_path.stem}-{now:%Y%m%d-%H%M%S}"


def prepare(config: Config, rig: Rig, folder: Path, stack: ExitStack) -> tuple[FlightLoop, FlightLog]:
    """Open logs, devices and workers; `stack` closes them in the opposite order, the coils at zero."""
    sync_ns = SECOND_NS if rig.realtime else None
    flight_log = _open_log(folder, "flight", rig.clock, config, sync_ns, stack)
    performance_log = _open_log(folder, "performance", rig.clock, config, sync_ns, stack)
    devices = _open_devices(config, rig, stack)
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is None:
        ensure_default_index()
    jobs = _open_jobs(config, rig, stack)
    recorder = Recorder(flight_log, performance_log)
    return FlightLoop(config, rig.clock, devices, jobs, recorder, flight_log.error), flight_log


def _load(order: Order) -> tuple[str, Config]:
    """Return the configuration as text and as values, with the order's changes in the values."""
    config = configuration.load(order.config_path)
    text = order.config_path.read_text(encoding="utf-8")
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
    folder: Path, stem: str, clock: Clock, config: Config, sync_ns: int | None, stack: ExitStack
) -> FlightLog:
    log = FlightLog(
        folder,
        stem,
        clock=clock,
        segment_bytes=config.telemetry.segment_bytes,
        budget_bytes=config.telemetry.budget_bytes,
        sync_period_ns=sync_ns,
    )
    stack.callback(log.close)
    return log


def _open_rig(order: Order, text: str, config: Config, stack: ExitStack) -> Rig:
    """Return the hardware that the configuration asks for."""
    if config.simulation is None:
        if order.seed is not None:
            raise UsageError("--seed: this configuration flies real devices, which draw their own noise")
        return _linux_rig(config, stack)
    sim_settings: Any = importlib.import_module("sim_hal.settings")
    section: Any = configuration.simulation_section(text, str(order.config_path), sim_settings.Simulation)
    if order.seed is not None:
        section = configuration.replace(section, seed=order.seed)
    return _simulated_rig(order, config, section, stack)


def _linux_rig(config: Config, stack: ExitStack) -> Rig:
    if config.camera is not None:
        raise ConfigError("camera", "no driver for a real camera yet: say `camera: none`")
    clock = SystemClock()
    i2c = LinuxI2cBus(config.coils.bus)
    stack.callback(i2c.close)
    switch_off(i2c, config.coils.address)  # before anything else can fail
    serial = PySerialPort(config.inertial_unit.device, config.inertial_unit.baud_rate, clock)
    stack.callback(serial.close)
    return Rig(clock, Wires(serial, i2c, None), lambda _: None, True, 0)


def _simulated_rig(order: Order, config: Config, section: Any, stack: ExitStack) -> Rig:
    """Return emulated devices: beside the loop in lock-step, or in a process of their own in real time."""
    if order.realtime:
        remote = importlib.import_module("sim_hal.remote")
        served = stack.enter_context(remote.served(order.config_path, section.seed, order.out))
        return Rig(served.clock, served.wires, served.release, True, section.seed)
    lockstep = importlib.import_module("sim_hal.lockstep")
    hardware = stack.enter_context(lockstep.opened(config, section, order.out))
    latency = round(section.latency.planner * SECOND_NS), round(section.latency.vision * SECOND_NS)
    return Rig(hardware.clock, hardware.wires, hardware.release, False, section.seed, latency)


def _open_jobs(config: Config, rig: Rig, stack: ExitStack) -> JobRunner:
    specs = workers(config, *rig.latency)
    runner: JobRunner = ProcessRunner(rig.clock, specs) if rig.realtime else LockStepRunner(rig.clock, specs)
    stack.callback(runner.close)
    return runner


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
    """Return the mission time zero: the next whole second of the clock that is half a second away."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


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
