"""Simulated hardware: emulated devices beside the loop in lock-step, or in a process of their own.

The one module of the flight application that names the simulator, and only as text: on board none of it is
imported.
"""

from __future__ import annotations

import importlib
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from flight.app.request import RunRequest
from flight.app.rig import Rig
from flight.gnc.errors import UsageError
from flight.schema import reader as configuration
from flight.schema.sections import Config
from hal.guardian.client import CoilReach
from hal.interfaces.devices import FrameSource
from hal.interfaces.wires import SECOND_NS, Clock


def fault_catalogue() -> tuple[str, str]:
    """Return how faults of a simulation are written, and a list of all."""
    grammar = importlib.import_module("sim_hal.faults.grammar").GRAMMAR
    listing = importlib.import_module("sim_hal.faults.catalogue").listing()
    return grammar, listing


def corrupted_text(request: RunRequest, text: str) -> str:
    """Return a configuration as the requested faults corrupt it; unchanged where none does."""
    corrupted_by = importlib.import_module("sim_hal.faults.host").corrupted_by
    spoiled: str = corrupted_by(request.faults, text, request.seed)
    return spoiled


def flown_faults(request: RunRequest, text: str) -> tuple[str, ...]:
    """Return what was to break in a flight, as it is written, the configuration's first."""
    grammar: Any = importlib.import_module("sim_hal.faults.grammar")
    section = _simulation_section(text, request.config_path)
    return tuple(map(str, (*grammar.schedule(section.faults), *map(grammar.parse, request.faults))))


def simulated_rig(request: RunRequest, text: str, config: Config, stack: ExitStack) -> Rig:
    """Return the emulated devices of a configuration, with the request's faults. Raises UsageError."""
    section = _simulation_section(text, request.config_path)
    if request.seed is not None:
        section = configuration.replace(section, seed=request.seed)
    grammar = importlib.import_module("sim_hal.faults.grammar")
    section = configuration.replace(section, faults=(*section.faults, *grammar.entries(request.faults)))
    # Before anything is opened, or a process started, for a fault that could do nothing.
    importlib.import_module("sim_hal.faults.schedule").check(section.faults, config, request.realtime)
    if request.realtime:
        rig = _served_rig(request, config, section, stack)
    else:
        rig = _lockstep_rig(request, config, section, stack)
    return with_host_faults(rig, section)


def simulated_camera(config_path: Path, text: str, config: Config) -> tuple[Clock, FrameSource]:
    """Return the emulated camera of a configuration in lock-step, with the clock that it lives by."""
    section = _simulation_section(text, config_path)
    lockstep: Any = importlib.import_module("sim_hal.lockstep")
    clock = importlib.import_module("sim_hal.clock").SimClock(lockstep.utc_ns(section.utc))
    return clock, lockstep.build(config, section, None, clock).wires.frames


def with_host_faults(rig: Rig, section: Any) -> Rig:
    """Return simulated hardware with what is to break in this very process, where anything is."""
    host = importlib.import_module("sim_hal.faults.host").host_faults(section, rig.clock, rig.realtime)
    if host is None:
        return rig

    def release(epoch_ns: int) -> None:
        rig.release(epoch_ns)
        host.begin(epoch_ns)

    return replace(rig, clock=host.clock(), release=release, host=host)


def _simulation_section(text: str, config_path: Path) -> Any:
    sim_settings: Any = importlib.import_module("sim_hal.settings")
    return configuration.simulation_section(text, str(config_path), sim_settings.Simulation)


def _served_rig(request: RunRequest, config: Config, section: Any, stack: ExitStack) -> Rig:
    """Return devices in a process of their own, in real time."""
    schedule = importlib.import_module("sim_hal.faults.schedule").scheduled
    remote = importlib.import_module("sim_hal.serving.remote")
    if request.devices is not None:
        served = stack.enter_context(remote.running(request.devices))
    else:
        served = stack.enter_context(remote.served(request.config_path, section.seed, request.out))
    opener, where = served.bus
    reach = CoilReach(opener, where, config.coils.address)
    faults = [str(fault) for fault in schedule(section.faults, True)]

    def release(epoch_ns: int) -> None:
        served.release(epoch_ns, faults)

    return Rig(served.clock, served.wires, release, True, section.seed, reach=reach)


def _lockstep_rig(request: RunRequest, config: Config, section: Any, stack: ExitStack) -> Rig:
    """Return devices beside the loop, which advance as it sleeps."""
    if request.devices is not None:
        raise UsageError("--devices: a server's devices live in real time: give --realtime too")
    lockstep = importlib.import_module("sim_hal.lockstep")
    hardware = stack.enter_context(lockstep.opened(config, section, request.out))
    latency = round(section.latency.planner * SECOND_NS), round(section.latency.vision * SECOND_NS)
    return Rig(hardware.clock, hardware.wires, hardware.release, False, section.seed, latency)
