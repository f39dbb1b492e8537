"""The complete coil chain on one emulated bus: driver, PWM chip, bridges, coils and current monitor."""

from __future__ import annotations

import dataclasses

import numpy as np

from hal.drivers.coils import CoilSettings, CoilWiring, PwmTorqueCoils
from hal.drivers.pca9685 import Pca9685
from hal.interfaces.devices import TorqueCoils
from hal.interfaces.wires import Clock, I2cBus
from sim_hal.emulators.coil_circuit import CoilCircuit, EmulatedIna219
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.pca9685 import EmulatedPca9685
from tests.manual_clock import ManualClock

PCA, INA = 0x40, 0x45
THESIS_COILS = (CoilWiring(0, 1, 23.0), CoilWiring(2, 3, 23.0), CoilWiring(4, 5, 23.0))
THESIS = CoilSettings(THESIS_COILS, supply_voltage=3.4, current_limit=0.148, stale_after=0.25)
"""Coil settings of the thesis (Sease 2013, ch. 5)."""
UNEQUAL = dataclasses.replace(
    THESIS, coils=(CoilWiring(0, 1, 23.0), CoilWiring(3, 2, 17.0, sign=-1), CoilWiring(8, 9, 25.0))
)


class Wire:
    """The emulated bus, and the devices on the bus."""

    def __init__(self, clock: Clock, settings: CoilSettings, uncertainty: float, seed: int = 1) -> None:
        self.chip = EmulatedPca9685(PCA, clock.now_ns)
        self.circuit = CoilCircuit(
            self.chip, settings, np.random.default_rng(seed), clock.now_ns, uncertainty=uncertainty
        )
        self.monitor = EmulatedIna219(INA, clock.now_ns, self.circuit.mean_supply)
        self.bus = EmulatedI2cBus(
            [self.chip, self.monitor], wait=lambda span_ns: clock.sleep_until_ns(clock.now_ns() + span_ns)
        )


class Rig:
    """Coil driver and bus on a manual clock.

    If `bus` is given, it replaces the emulated bus.
    """

    def __init__(
        self,
        settings: CoilSettings = THESIS,
        uncertainty: float = 0.0,
        wire: Wire | None = None,
        clock: ManualClock | None = None,
        bus: I2cBus | None = None,
    ) -> None:
        self.settings = settings
        self.clock = ManualClock() if clock is None else clock
        self.wire = Wire(self.clock, self.settings, uncertainty) if wire is None else wire
        self.bus: I2cBus = self.wire.bus if bus is None else bus
        self.pca = Pca9685(self.bus, PCA, self.clock)
        self.coils: TorqueCoils = PwmTorqueCoils(self.pca, self.clock, self.settings)

    @property
    def duties(self) -> list[float]:
        """Duty cycle of each channel of the chip."""
        return [self.wire.chip.duty(channel) for channel in range(16)]

    def currents(self) -> list[float]:
        """Return the coil currents, A."""
        return [float(current) for current in self.wire.circuit.currents()]

    def command(self, *currents: float) -> None:
        """Command currents, A."""
        self.coils.command(np.array(currents))


def limited_to(current_limit: float, settings: CoilSettings = UNEQUAL) -> CoilSettings:
    """Return coil settings with the given current limit."""
    return dataclasses.replace(settings, current_limit=current_limit)
