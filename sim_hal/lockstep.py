"""Simulated hardware in lock-step: the clock jumps, devices answer in memory, runs repeat exactly.

A posed camera is a simulated star camera alone, held at the released attitude or turning at a constant rate;
its true attitude and rate are known at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from flight.link.telemetry.log import FlightLog
from flight.schema.sections import Config
from hal.interfaces.wires import Wires
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from sim_hal.assembly import (
    Hardware,
    StarRenderer,
    assemble,
    fault_generator,
    inline_exposure,
    line_generator,
)
from sim_hal.clock import SimClock, TimedSimulation
from sim_hal.emulators.camera import EmulatedCamera
from sim_hal.emulators.serial_line import EmulatedSerialLine
from sim_hal.faults.bench import Bench
from sim_hal.faults.schedule import put, scheduled
from sim_hal.objects import Objects
from sim_hal.orbit_devices import GPS_LINE
from sim_hal.settings import Simulation
from sim_hal.worlds.world import BodyMotion, TruthRecorder, WorldInputs, make_world


def posed_camera(
    config: Config, section: Simulation, clock: SimClock, rate: FloatArray
) -> tuple[EmulatedCamera, Callable[[int], FloatArray]]:
    """Return the camera of a configuration on a clock, and its attitude (4,), ICRS into camera, at a time.

    It turns at `rate` (3,) rad/s, camera axes, from the attitude at which the body is released. Raises
    ConfigError for a world that cannot be.
    """
    camera = config.camera
    assert camera is not None, "the caller has seen to a camera section"
    begun_ns, mounting = clock.now_ns(), np.array(camera.mounting)
    world = make_world(WorldInputs(config, section, lambda: np.zeros(3), begun_ns))
    objects = Objects(section.objects, section.utc, begun_ns, world)
    held, body_rate = world.motion(begun_ns), attitude_matrix(mounting).T @ rate
    nothing = np.zeros(3)

    def motion(time_ns: int) -> BodyMotion:
        turned = from_rotation_vector(body_rate * ((time_ns - begun_ns) * 1e-9))
        return BodyMotion(time_ns, multiply(turned, held.quaternion), body_rate, nothing, nothing)

    device = EmulatedCamera(
        motion,
        inline_exposure(StarRenderer(camera, section.sky, section.seed)),
        clock.now_ns,
        round(section.sky.readout * 1e9),
        mounting,
        round(section.sky.line_time * camera.rows * 1e9),
        objects.tracks,
    )
    clock.attach(TimedSimulation(lambda _: None, [device]))
    return device, lambda time_ns: multiply(mounting, motion(time_ns).quaternion)


@dataclass(frozen=True, slots=True)
class LockStep:
    """Clock, wires and release for the flight; hardware and line for fault injection and tests."""

    clock: SimClock
    wires: Wires
    release: Callable[[int], None]
    hardware: Hardware
    line: EmulatedSerialLine
    gps_line: EmulatedSerialLine | None = None


def utc_ns(label: str) -> int:
    """Return nanoseconds since 1970 of an ISO 8601 time. Raises ValueError."""
    return round(datetime.fromisoformat(label).timestamp()) * 1_000_000_000


def build(config: Config, section: Simulation, truth: TruthRecorder | None, clock: SimClock) -> LockStep:
    """Put the simulated hardware on a clock."""
    line = EmulatedSerialLine(clock.now_ns, config.inertial_unit.baud_rate, line_generator(section.seed))
    gps_line = None
    if config.gps is not None:
        generator = line_generator(section.seed, GPS_LINE)
        gps_line = EmulatedSerialLine(clock.now_ns, config.gps.baud_rate, generator)
    gps_end = None if gps_line is None else gps_line.device
    hardware = assemble(config, section, clock.now_ns, line.device, truth, gps_line=gps_end)
    clock.attach(hardware.simulation)
    gps_port = None if gps_line is None else gps_line.host
    wires = Wires(line.host, hardware.bus, hardware.camera, gps_port, hardware.orbit.wide)
    faults = scheduled(section.faults, realtime=False)
    bench = Bench(hardware, line, clock.now_ns, fault_generator(section.seed), line.host, gps_line=gps_line)

    def release(epoch_ns: int) -> None:
        hardware.release(epoch_ns)
        put(faults, bench, epoch_ns)

    return LockStep(clock, wires, release, hardware, line, gps_line)


@contextmanager
def opened(config: Config, section: Simulation, folder: Path) -> Iterator[LockStep]:
    """Simulate in lock-step; the truth goes into a log in `folder`, which is closed at the end."""
    clock = SimClock(utc_ns(section.utc))
    log = FlightLog(folder, "truth", clock=clock, sync_period_ns=None)
    try:
        yield build(config, section, TruthRecorder(log), clock)
    finally:
        log.close()
