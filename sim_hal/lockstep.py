"""Simulated hardware in lock-step: the clock jumps, the devices answer in memory, runs repeat bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from flight.link.telemetry.log import FlightLog
from flight.schema.sections import Config
from hal.interfaces.wires import Wires
from sim_hal.assembly import Hardware, assemble, fault_generator, line_generator
from sim_hal.clock import SimClock
from sim_hal.emulators.serial_line import SerialLine
from sim_hal.faults.bench import Bench
from sim_hal.faults.schedule import put, scheduled
from sim_hal.orbit_devices import GPS_LINE
from sim_hal.settings import Simulation
from sim_hal.worlds.truth import TruthRecorder


@dataclass(frozen=True, slots=True)
class LockStep:
    """Clock, wires and release for the flight; hardware and line for fault injection and tests."""

    clock: SimClock
    wires: Wires
    release: Callable[[int], None]
    hardware: Hardware
    line: SerialLine
    gps_line: SerialLine | None = None


def utc_ns(label: str) -> int:
    """Return nanoseconds since 1970 of an ISO 8601 time. Raises ValueError."""
    return round(datetime.fromisoformat(label).timestamp()) * 1_000_000_000


def build(config: Config, section: Simulation, truth: TruthRecorder | None, clock: SimClock) -> LockStep:
    """Put the simulated hardware on a clock."""
    line = SerialLine(clock.now_ns, config.inertial_unit.baud_rate, line_generator(section.seed))
    gps_line = None
    if config.gps is not None:
        generator = line_generator(section.seed, GPS_LINE)
        gps_line = SerialLine(clock.now_ns, config.gps.baud_rate, generator)
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
