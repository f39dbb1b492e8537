"""The simulator's only interface to the flight application: rigs of emulated devices, and the faults in them.

In lock-step the devices live beside the loop and advance as it sleeps; in real time they live in a process of
their own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from flight.schema import reader as configuration
from flight.schema.document import ConfigError
from flight.schema.sections import Config
from hal.interfaces.devices import FrameSource
from hal.interfaces.guardian import CoilReach
from hal.interfaces.wires import SECOND_NS, Clock, Rig
from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from sim_hal import lockstep
from sim_hal.clock import SimClock
from sim_hal.faults import schedule
from sim_hal.faults.catalogue import listing
from sim_hal.faults.host import corrupted_by, host_faults
from sim_hal.faults.schedule import check, scheduled
from sim_hal.lockstep import posed_camera
from sim_hal.serving import remote
from sim_hal.settings import Simulation


@dataclass(frozen=True, slots=True)
class SimulationRequest:
    """The requests of a run to the simulator, besides its configuration.

    Attributes:
        config_path: the configuration's file; `text` its content as it is flown.
        out: the run's folder, for the log of the truth.
        realtime: whether the devices live in a process of their own.
        seed: replaces the configuration's where given.
        devices: file of a server of devices that runs already; None starts one.
        faults: beside those of the configuration.
    """

    config_path: Path
    text: str
    out: Path
    realtime: bool = False
    seed: int | None = None
    devices: Path | None = None
    faults: tuple[str, ...] = ()

    def section(self) -> Simulation:
        """Return the `simulation` section. Raises ConfigError."""
        name = str(self.config_path)
        section = configuration.simulation_section(self.text, name, Simulation)
        if section is None:
            raise ConfigError(name, "has no `simulation` section")
        return section


def open_rig(request: SimulationRequest, config: Config, stack: ExitStack) -> Rig:
    """Open the emulated devices of a configuration with the faults asked for; `stack` closes them.

    Raises UsageError and ConfigError before anything is opened, DeviceError.
    """
    section = request.section()
    if request.seed is not None:
        section = configuration.replace(section, seed=request.seed)
    section = configuration.replace(section, faults=(*section.faults, *schedule.entries(request.faults)))
    check(section.faults, config, request.realtime)
    opener = _served if request.realtime else _in_lockstep
    return with_host_faults(opener(request, config, section, stack), section)


@dataclass(frozen=True, slots=True)
class PosedCamera:
    """A camera, its clock, and its attitude (4,), ICRS into camera, at a time of that clock."""

    clock: Clock
    frames: FrameSource
    attitude: Callable[[int], FloatArray]


def open_camera(request: SimulationRequest, config: Config, rate: FloatArray) -> PosedCamera:
    """Return the emulated camera of a configuration, turning at `rate` (3,) rad/s in camera axes."""
    section = request.section()
    clock = SimClock(lockstep.utc_ns(section.utc))
    return PosedCamera(clock, *posed_camera(config, section, clock, rate))


def fault_catalogue() -> tuple[str, str]:
    """Return how faults are written, and a list of all."""
    return schedule.GRAMMAR, listing()


def injected_faults(request: SimulationRequest) -> tuple[str, ...]:
    """Return the faults of a flight as they are written, the configuration's first."""
    faults = (*schedule.schedule(request.section().faults), *map(schedule.parse, request.faults))
    return tuple(map(str, faults))


def corrupted_text(faults: tuple[str, ...], text: str, seed: int | None) -> str:
    """Return a configuration's text as the requested faults corrupt it; unchanged where none does."""
    return corrupted_by(faults, text, seed)


def with_host_faults(rig: Rig, section: Simulation) -> Rig:
    """Return a rig with the faults inside the flight process, where there are any."""
    host = host_faults(section, rig.clock, rig.realtime)
    if host is None:
        return rig

    def release(epoch_ns: int) -> None:
        rig.release(epoch_ns)
        host.begin(epoch_ns)

    return replace(rig, clock=host.clock(), release=release, host=host)


def _served(request: SimulationRequest, config: Config, section: Simulation, stack: ExitStack) -> Rig:
    """Return devices in a process of their own, in real time."""
    if request.devices is not None:
        served = stack.enter_context(remote.running(request.devices))
    else:
        served = stack.enter_context(remote.served(request.config_path, section.seed, request.out))
    opener, where = served.bus
    reach = CoilReach(opener, where, config.coils.address)
    faults = [str(fault) for fault in scheduled(section.faults, True)]

    def release(epoch_ns: int) -> None:
        served.release(epoch_ns, faults)

    return Rig(served.clock, served.wires, release, True, section.seed, reach=reach)


def _in_lockstep(request: SimulationRequest, config: Config, section: Simulation, stack: ExitStack) -> Rig:
    """Return devices beside the loop."""
    if request.devices is not None:
        raise UsageError("--devices: a server's devices live in real time: give --realtime too")
    hardware = stack.enter_context(lockstep.opened(config, section, request.out))
    latency = round(section.latency.planner * SECOND_NS), round(section.latency.vision * SECOND_NS)
    return Rig(hardware.clock, hardware.wires, hardware.release, False, section.seed, latency)
