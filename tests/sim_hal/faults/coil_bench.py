"""Coils, current monitor, IMU and body in lock-step with a coil monitor, without a flight loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from flight.app.devices import coil_settings, unit_settings
from flight.app.flight import next_whole_second
from flight.loop.coil_monitor import CoilMonitor, CoilMonitorSettings
from flight.loop.coil_response import ResponseSettings
from flight.schema import reader as configuration
from flight.schema.bodies import TestbedConfig
from hal.drivers.coils import PwmTorqueCoils
from hal.drivers.current_monitors import Ina219
from hal.drivers.pca9685 import Pca9685
from hal.drivers.vn100 import Vn100
from hal.interfaces.devices import ImuReading
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_about_axis_y
from sim_hal.clock import SimClock
from sim_hal.rig import build_lockstep
from sim_hal.settings import FaultEntry
from sim_hal.worlds.testbed import Testbed
from tests.support.flights import demo_config, demo_world

CYCLE_NS = 25_000_000

Command = Callable[[float, ImuReading], FloatArray]
"""Controller that returns the currents (3,), A, from the time (s) and the newest reading."""


def hold(target: float, noise: float = 0.0, others: float = 0.0, seed: int = 0) -> Command:
    """Return a controller that holds the angle `target` (rad) about y.

    The command has the noise `noise` (A). The other coils have alternating currents of the amplitude `others`
    (A).
    """
    rng = np.random.default_rng(seed)

    def command(time: float, reading: ImuReading) -> FloatArray:
        angle = angle_about_axis_y(reading.quaternion)
        wanted = 0.25 * (target - angle) - 0.45 * reading.rate[1] + 0.03 * target
        y = others * math.sin(0.9 * time)
        z = others * math.cos(0.5 * time)
        return np.clip(np.array([wanted, y, z]) + noise * rng.normal(size=3), -0.14, 0.14)

    return command


def watch_settings(config: TestbedConfig, monitor_only: bool = False) -> CoilMonitorSettings:
    """Return the settings of a coil monitor for the demonstration's hardware."""
    coils, plant = config.coils, config.plant
    full = [coils.supply_voltage / ohm for ohm in coils.resistance]
    response = ResponseSettings(
        inertia=np.eye(3) * plant.inertia,
        dipole_per_ampere=plant.coil_turns * plant.coil_area,
        rate_noise=config.inertial_unit.rate_noise,
        free=(False, True, False),
    )
    return CoilMonitorSettings((full[0], full[1], full[2]), response=None if monitor_only else response)


@dataclass
class Watched:
    """Faults and corrections that a coil monitor reports, with times (s), and the coil currents (k, 3), A."""

    watch: CoilMonitor
    found: list[tuple[float, str, str]]
    readings: int
    suspicious: int
    angle: float
    times: FloatArray
    carried: FloatArray
    news: list[tuple[float, str]] = field(default_factory=list)


def observe(
    command: Command,
    duration: float,
    faults: Sequence[str] = (),
    seed: int = 1,
    monitor_only: bool = False,
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Watched:
    """Drive the coils for some time, and return the results of a coil monitor.

    The resistance of each simulated coil is the configured resistance divided by `gain`.
    """
    config = demo_config(duration, camera=False)
    entries = tuple(FaultEntry(fault=fault) for fault in faults)
    ohms = config.coils.resistance
    truth = configuration.replace(
        demo_world().truth, resistance=(ohms[0] / gain[0], ohms[1] / gain[1], ohms[2] / gain[2])
    )
    section = configuration.replace(demo_world(), seed=seed, faults=entries, truth=truth)
    clock = SimClock()
    lock = build_lockstep(config, section, None, clock)
    pca = Pca9685(lock.hardware.bus, config.coils.address, clock)
    coils = PwmTorqueCoils(pca, clock, coil_settings(config.coils))
    coils.start()
    monitor = Ina219(lock.hardware.bus, 0x45, clock)
    unit = Vn100(lock.line.host, clock, unit_settings(config.inertial_unit))
    unit.configure()
    watch = CoilMonitor(watch_settings(config, monitor_only))
    epoch_ns = next_whole_second(clock)
    lock.release(epoch_ns)
    seen = Watched(watch, [], 0, 0, 0.0, np.empty(0), np.empty((0, 3)))
    carried: list[tuple[float, FloatArray]] = []
    newest: ImuReading | None = None
    for cycle in range(round(duration * 1e9) // CYCLE_NS):
        clock.sleep_until_ns(epoch_ns + cycle * CYCLE_NS)
        now_ns = clock.now_ns()
        time = (now_ns - epoch_ns) * 1e-9
        state = coils.state()
        carried.append((time, lock.hardware.circuit.currents().copy()))
        watch.commanded(now_ns, state.current, state.braked, state.written_ns)
        for reading in unit.poll():
            newest = reading
            watch.observe_motion(reading.time_ns, reading.rate, reading.field)
        answer = monitor.latest()
        if answer is not None and not monitor.error():
            watch.measured(answer)
            seen.readings += 1
        seen.suspicious += bool(watch.suspicion)
        for verdict in watch.verdicts[len(seen.found) :]:
            assert verdict.fault is not None
            seen.found.append((time, "xyz"[verdict.axis], verdict.fault.name))
        seen.news += [(time, text) for text in watch.news()]
        if newest is not None:
            wanted = command(time, newest)
            usable = watch.available & (not watch.at_rest)
            own = np.where(usable, watch.correction.wire(wanted), 0.0)
            coils.command(own if watch.probe is None else watch.probe)
        coils.brake(watch.braked)
    seen.times, seen.carried = (np.array(column) for column in zip(*carried, strict=True))
    assert isinstance(lock.hardware.world, Testbed)
    seen.angle = lock.hardware.world.angle
    coils.close()
    monitor.close()
    return seen
