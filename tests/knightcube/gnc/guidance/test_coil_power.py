"""Tests of the power of chopped coils against values computed by hand and against the simulated supply."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.gnc.guidance.plant import PathCost, SingleAxisPlant, steady_heat, supply_power
from tests.hal.coils.rig import Rig

VOLTAGE, BUS_VOLTAGE, RESISTANCE = 3.4, 5.0, 23.0
FULL = VOLTAGE / RESISTANCE


def test_the_supply_delivers_power_only_while_a_coil_is_driven_and_either_way() -> None:
    """At the duty cycles 0, 0.25, 0.5, -0.5 and 1, a coil takes |duty| times 3.4^2/23 W = 0.50261 W."""
    duty = np.array([0.0, 0.25, 0.5, -0.5, 1.0])
    expected = [0.0, 0.12565, 0.25130, 0.25130, 0.50261]
    np.testing.assert_allclose(supply_power(duty * FULL, VOLTAGE), expected, atol=1e-5)


def test_the_bus_delivers_the_same_current_at_its_higher_voltage() -> None:
    """A current of 0.02 A takes 68 mW at 3.4 V across the coil and 100 mW from a bus of 5 V."""
    current = np.array([0.02])
    assert supply_power(current, VOLTAGE)[0] == pytest.approx(0.068)
    assert supply_power(current, BUS_VOLTAGE)[0] == pytest.approx(0.100)


def test_the_heat_of_a_steady_current_is_the_supply_power_times_the_duty_cycle() -> None:
    """At a duty cycle of 0.5, the current is 0.07391 A and the heat 0.12565 W, half of the supply power."""
    duty = np.array([0.0, 0.25, 0.5, -0.5, 1.0])
    expected = [0.0, 0.03141, 0.12565, 0.12565, 0.50261]
    np.testing.assert_allclose(steady_heat(duty * FULL, RESISTANCE), expected, atol=1e-5)


def test_each_coil_has_its_own_resistance() -> None:
    """Each coil has its own resistance. Coils of 20 and 10 ohm carry given currents at two times."""
    current = np.array([[0.1, 0.2], [-0.1, 0.0]])
    np.testing.assert_allclose(steady_heat(current, np.array([20.0, 10.0])), [[0.2, 0.4], [0.2, 0.0]])


@pytest.mark.parametrize("current", [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (-0.05, 0.1, -0.02)])
def test_the_power_is_that_which_the_simulated_bridges_take_from_their_supply(
    current: tuple[float, float, float],
) -> None:
    """The power agrees with the power of the simulated circuit.

    The circuit integrates the chopped current over three whole periods.
    """
    rig = Rig()
    rig.coils.start()
    rig.command(*current)
    rig.clock.advance(1)
    begin, period = rig.clock.now_ns(), round(1e9 / rig.wire.chip.frequency)
    rig.clock.advance(3 * period)
    volts, amperes = rig.wire.circuit.mean_supply(begin, begin + 3 * period)
    assert supply_power(np.array(current), volts).sum() == pytest.approx(volts * amperes, abs=5e-4)


@pytest.mark.parametrize("cost", list(PathCost))
def test_the_smoothed_power_has_its_slope_and_is_within_a_tenth_of_full_power(cost: PathCost) -> None:
    plant = SingleAxisPlant(1.05e-3, 2.916e-4, RESISTANCE, FULL)
    current = np.linspace(-FULL, FULL, 41)
    value, slope = cost.smooth(plant, current)
    step = 1e-7
    ahead, behind = (cost.smooth(plant, current + shift)[0] for shift in (step, -step))
    np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), atol=1e-5)
    assert value[20] == pytest.approx(0.0, abs=1e-12)
    # The smoothed power is below the exact power by at most a tenth of the full power.
    lower = cost.power(plant, current) - value
    assert lower.min() > -1e-12
    assert lower.max() < 0.1 * VOLTAGE * FULL
    assert lower[0] == pytest.approx(0.0 if cost is PathCost.HEAT else 0.095 * VOLTAGE * FULL, abs=2e-4)
