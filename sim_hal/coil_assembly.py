"""The simulated coils of a configuration: PWM chip, bridges, current monitor, and the I2C bus they are on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flight.schema.sections import Config
from hal.drivers.h_bridge import CoilSettings, wirings
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.ina219 import EmulatedIna219
from sim_hal.emulators.pca9685 import EmulatedPca9685
from sim_hal.settings import Simulation
from sim_hal.worlds.coil_circuit import CoilCircuit

BUS_VOLTAGE = 5.0
"""V in the coils' supply, before the losses of the bridge [ch. 5: a 5 V power bus]."""


@dataclass(frozen=True, slots=True)
class CoilHardware:
    """The parts on the I2C bus and the circuit behind them; a configuration may have no monitor."""

    bus: EmulatedI2cBus
    pwm: EmulatedPca9685
    monitor: EmulatedIna219 | None
    circuit: CoilCircuit


def assemble_coils(
    config: Config,
    section: Simulation,
    generator: np.random.Generator,
    now_ns: Callable[[], int],
    wait: Callable[[int], None] | None = None,
) -> CoilHardware:
    """Build the coils; `now_ns` returns the simulation's time, `wait` advances time while the bus hangs."""
    pwm = EmulatedPca9685(config.coils.address, now_ns)
    circuit = CoilCircuit(
        pwm,
        _coil_settings(config, section),
        generator,
        now_ns,
        uncertainty=section.current_noise,
        bus_voltage=BUS_VOLTAGE,
    )
    settings = config.power_monitor
    monitor = None
    if settings is not None:
        monitor = EmulatedIna219(settings.address, now_ns, circuit.mean_supply, settings.shunt)
    bus = EmulatedI2cBus([pwm] if monitor is None else [pwm, monitor], wait=wait)
    return CoilHardware(bus, pwm, monitor, circuit)


def _coil_settings(config: Config, section: Simulation) -> CoilSettings:
    """Return the true coil settings."""
    coils = config.coils
    resistance = section.truth.resistance or coils.resistance
    supply = section.truth.supply_voltage or coils.supply_voltage
    wired = wirings(coils.channels, resistance, coils.signs, coils.enable_channels)
    return CoilSettings(wired, supply, coils.current_limit, coils.stale_after)
