"""Tests of DRV8830 bridges: mean current, brakes, brown-outs, and the writes that stop the bridges."""

from __future__ import annotations

import numpy as np
import pytest

from hal.drivers.coils import CoilSettings, Drv8830Bridges, Drv8830Coils, control_of, volts_of, wirings
from knightcube.astro.arrays import FloatArray
from sim_hal.clock import SimClock
from sim_hal.emulators.coil_circuit import BridgeCircuit
from sim_hal.emulators.i2c_bus import EmulatedI2cBus

SETTINGS = CoilSettings(
    wirings([(0, 1), (2, 3), (4, 5)], [23.0] * 3, [1, -1, 1], [0.148] * 3), 3.4, 0.148, 0.25
)


class Bench:
    """A coil driver with emulated bridges."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.circuit = BridgeCircuit(0x60, SETTINGS, np.random.default_rng(1), 0.0, 5.0)
        self.bus = EmulatedI2cBus(self.circuit.parts)
        bridges = Drv8830Bridges(self.bus, 0x60, self.clock, SETTINGS)
        self.coils = Drv8830Coils(bridges, self.clock, SETTINGS)
        self.coils.start()

    def mean(self, currents: list[float], seconds: float = 1.0) -> FloatArray:
        """Return the mean coil currents (A) while a command is repeated at 40 Hz."""
        seen = []
        for step in range(round(seconds * 1000)):
            if step % 25 == 0:
                self.coils.command(np.array(currents))
            self.clock.sleep_until_ns(self.clock.now_ns() + 1_000_000)
            seen.append(self.circuit.currents().copy())
        return np.asarray(np.mean(seen, axis=0))


@pytest.mark.parametrize("currents", [[0.148, -0.148, 0.0], [0.004, -0.0115, 0.02], [0.1, 0.05, -0.0333]])
def test_the_mean_current_is_the_command_although_the_steps_are_coarse(currents: list[float]) -> None:
    """The mean current equals the command within 0.6 mA, although one step of the bridge is 3.5 mA.

    The smallest driven current of the bridge is 21 mA.
    """
    np.testing.assert_allclose(Bench().mean(currents), currents, atol=6e-4)


def test_a_brake_holds_both_outputs_high_and_zero_leaves_them_open() -> None:
    bench = Bench()
    bench.mean([0.1, 0.1, 0.1], 0.1)
    bench.coils.brake(frozenset({1}))
    bench.mean([0.1, 0.1, 0.1], 0.1)
    assert [part.registers[0] & 3 for part in bench.circuit.parts] == [1, 3, 1]
    bench.coils.off()
    assert [part.registers[0] for part in bench.circuit.parts if part is not bench.circuit.parts[1]] == [0, 0]


def test_a_brown_out_is_repaired_and_a_dead_chip_is_reported() -> None:
    bench = Bench()
    bench.mean([0.1, 0.0, 0.0], 0.1)
    bench.circuit.parts[0].brown_out()
    bench.mean([0.1, 0.0, 0.0], 1.0)
    np.testing.assert_allclose(bench.mean([0.1, 0.0, 0.0], 0.5)[0], 0.1, atol=2e-3)
    bench.bus.nack(0x62, None)
    bench.mean([0.1, 0.0, 0.1], 0.5)
    assert "0x62" in bench.coils.state().error
    assert bench.circuit.parts[0].registers[0] == 0, "the other bridges are off"


def test_a_stale_command_and_the_end_leave_all_bridges_off() -> None:
    bench = Bench()
    bench.mean([0.1, 0.1, 0.1], 0.1)
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 400_000_000)
    assert not bench.circuit.currents().any()
    bench.mean([0.1, 0.1, 0.1], 0.1)
    bench.coils.close()
    assert not bench.circuit.currents().any()


@pytest.mark.parametrize("volts", [0.5, -1.0, 3.4, -5.06])
def test_a_voltage_is_within_half_a_step(volts: float) -> None:
    assert volts_of(control_of(volts)) == pytest.approx(volts, abs=0.0402)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("volts", [5.2, 6.0, 12.0])
def test_a_voltage_beyond_the_range_becomes_the_largest_voltage_of_the_same_sign(
    volts: float, sign: float
) -> None:
    """A voltage beyond the range of the register becomes the largest voltage of the same sign, 5.06 V.

    Six of the eight bits of the register contain the voltage.
    """
    control = control_of(sign * volts)
    assert 0 <= control <= 0xFF
    assert volts_of(control) == pytest.approx(sign * 5.06, abs=0.01)
