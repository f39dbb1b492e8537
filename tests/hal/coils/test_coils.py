"""Tests of the torque coils from driver to current, with H-bridges on a PWM chip and with DRV8830 bridges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.coils import (
    BRAKED,
    CoilSettings,
    CoilWiring,
    Drv8830Bridges,
    Drv8830Coils,
    control_of,
    counts_for,
    current_step,
    inputs_for,
    largest_counts,
    volts_of,
    wirings,
)
from hal.drivers.pca9685 import FULL_OFF, FULL_ON
from hal.interfaces.devices import NO_AXES
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from knightcube.astro.arrays import FloatArray
from sim_hal.clock import SimClock
from sim_hal.emulators.coil_circuit import BridgeCircuit, CoilCondition
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from tests.hal.coils.rig import PCA, THESIS, UNEQUAL, Rig, limited_to

MS = 1_000_000
FINITE = st.floats(allow_nan=False, allow_infinity=False)
USUAL = st.floats(-0.25, 0.25)


@settings(max_examples=60, deadline=None)
@given(
    command=st.tuples(USUAL | FINITE, USUAL | FINITE, USUAL | FINITE),
    limit=st.sampled_from([0.148, 0.1, 0.0201, 1.0]),
)
def test_the_coils_carry_the_commanded_currents_within_half_a_count(
    command: tuple[float, float, float], limit: float
) -> None:
    """The coil currents equal the commanded currents within half a count of the PWM.

    The coils have unequal resistances, and one coil is connected with reversed polarity.
    """
    rig = Rig(limited_to(limit))
    rig.coils.start()
    rig.command(*command)
    state = rig.coils.state()
    assert rig.currents() == pytest.approx(state.current.tolist(), abs=1e-15)
    any_limited = False
    for coil, asked, flowing in zip(UNEQUAL.coils, command, rig.currents(), strict=True):
        step = current_step(coil.resistance, 3.4)
        bound = min(limit, 3.4 / coil.resistance)
        any_limited = any_limited or abs(asked) > bound
        assert abs(flowing) <= bound * (1 + 1e-12)
        assert flowing * asked >= 0.0
        if abs(asked) <= bound - step:
            assert abs(flowing - asked) <= 0.5 * step * (1 + 1e-9)
        else:
            assert abs(flowing) > bound - step
    assert state.saturated or not any_limited
    assert state.command.tolist() == list(command)
    assert rig.wire.chip.violations == set()


def test_six_coils_carry_their_own_currents_through_the_chip_and_brake_alone() -> None:
    """Six coils on one chip carry their commanded currents, and each coil can be braked alone.

    The fifth coil has reversed polarity, and the sixth coil has its own channels.
    """
    coils = [CoilWiring(2 * k, 2 * k + 1, 20.0 + k, sign=-1 if k == 4 else 1) for k in range(5)]
    rig = Rig(replace(THESIS, coils=(*coils, CoilWiring(15, 12, 30.0))))
    rig.coils.start()
    wanted = [0.1, -0.02, 0.03, -0.04, 0.05, -0.06]
    rig.command(*wanted)
    assert rig.currents() == pytest.approx(wanted, abs=3.4 / 20.0 / 4096)
    assert rig.coils.state().current.tolist() == pytest.approx(rig.currents(), abs=1e-15)
    rig.coils.brake(frozenset({3, 5}))
    rig.command(*wanted)
    assert rig.currents() == pytest.approx([0.1, -0.02, 0.03, 0.0, 0.05, 0.0], abs=5e-5)
    rig.wire.circuit.become(4, CoilCondition.OPEN)
    rig.command(*wanted)
    assert rig.currents()[4] == 0.0
    rig.coils.off()
    assert rig.currents() == [0.0] * 6
    with pytest.raises(OutOfRange, match="number of currents"):
        rig.command(*wanted[:5])
    with pytest.raises(OutOfRange, match="number of coils"):
        replace(THESIS, coils=tuple(CoilWiring(2 * k, 2 * k + 1, 20.0) for k in range(7)))


def test_saturation_is_reported_and_only_when_it_happens(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.148, 0.0, 0.0)  # the largest current, V/R, is 0.14783 A
    assert rig.coils.state().saturated
    assert rig.coils.state().current[0] == pytest.approx(3.4 / 23.0)
    rig.command(0.147, 0.0, 0.0)
    assert not rig.coils.state().saturated


def test_both_inputs_are_low_at_zero_and_the_idle_one_otherwise(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.05, -0.05, 0.0)
    a_x, b_x, a_y, b_y, a_z, b_z, *others = rig.duties
    assert a_x == b_y == pytest.approx(0.05 * 23.0 / 3.4, abs=1 / 4096)
    assert [b_x, a_y, a_z, b_z, *others] == [0.0] * 14
    rig.command(0.0, 0.0, 0.0)
    assert rig.duties == [0.0] * 16


def test_start_leaves_a_running_chip_at_zero(rig: Rig) -> None:
    """The start zeroes the coils that a previous process has left driven."""
    rig.pca.configure()
    rig.pca.write_channels(0, [(0, 3000), (0, 4096)])
    assert rig.currents()[0] != 0.0
    rig.coils.start()
    assert rig.duties == [0.0] * 16
    assert rig.coils.state().error == ""


def test_a_start_without_a_chip_is_reported(rig: Rig) -> None:
    rig.wire.bus.detach(rig.wire.chip)
    with pytest.raises(NotResponding, match="pca9685 at 0x40"):
        rig.coils.start()
    assert "no acknowledge" in rig.coils.state().error


def test_start_survives_one_lost_transaction(rig: Rig) -> None:
    rig.wire.bus.nack(PCA)
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)
    assert rig.coils.state().faults == 1


def test_a_command_before_start_or_after_close_is_refused(rig: Rig) -> None:
    with pytest.raises(Refused, match=r"before start\(\)"):
        rig.command(0.1, 0.0, 0.0)
    rig.coils.start()
    rig.coils.close()
    with pytest.raises(Refused, match=r"after close\(\)"):
        rig.command(0.1, 0.0, 0.0)
    assert rig.duties == [0.0] * 16


def test_a_stale_command_is_at_zero_within_half_a_second(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, -0.1, 0.05)
    rig.clock.advance(250 * MS)
    assert rig.currents()[0] != 0.0, "still fresh at 0.25 s"
    assert not rig.coils.state().stale
    rig.clock.advance(250 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    state = rig.coils.state()
    assert state.stale
    assert state.current.tolist() == [0.0, 0.0, 0.0]
    assert state.command.tolist() == [0.1, -0.1, 0.05]


def test_the_longest_allowed_staleness_still_ends_within_half_a_second() -> None:
    rig = Rig(replace(THESIS, stale_after=0.4))
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.clock.advance(499 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    with pytest.raises(OutOfRange, match="stale_after"):
        replace(THESIS, stale_after=0.45)


def test_commands_that_keep_coming_keep_the_coils_driven(rig: Rig) -> None:
    rig.coils.start()
    for _ in range(80):
        rig.command(0.1, 0.0, 0.0)
        rig.clock.advance(25 * MS)
        assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)
    state = rig.coils.state()
    assert (state.stale, state.faults, state.error) == (False, 0, "")


def test_a_new_command_ends_staleness(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.clock.advance(1000 * MS)
    rig.command(0.02, 0.0, 0.0)
    assert not rig.coils.state().stale
    assert rig.currents()[0] == pytest.approx(0.02, abs=1e-4)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_value_that_is_not_finite_brings_all_coils_to_zero(rig: Rig, bad: float, axis: int) -> None:
    rig.coils.start()
    rig.command(0.1, 0.1, 0.1)
    values = [0.05, 0.05, 0.05]
    values[axis] = bad
    with pytest.raises(OutOfRange, match=f"current of coil {'xyz'[axis]} = (nan|inf|-inf) is outside -0.147"):
        rig.command(*values)
    assert rig.currents() == [0.0, 0.0, 0.0]
    assert np.all(np.isfinite(rig.coils.state().command))


def test_a_wrong_number_of_currents_brings_all_coils_to_zero(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, 0.1, 0.1)
    with pytest.raises(OutOfRange, match="number of currents"):
        rig.command(0.1, 0.1)
    assert rig.currents() == [0.0, 0.0, 0.0]


def test_the_coils_can_be_started_again_after_close(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, -0.1, 0.1)
    rig.coils.close()
    rig.coils.start()
    assert rig.duties == [0.0] * 16
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)


def test_before_the_first_command_the_state_is_all_zero(rig: Rig) -> None:
    rig.coils.start()
    state = rig.coils.state()
    assert (state.command_ns, state.stale, state.saturated, state.faults) == (-1, False, False, 0)
    assert state.command.tolist() == state.current.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "make",
    [
        lambda: CoilWiring(0, 1, 0.0),
        lambda: CoilWiring(0, 1, math.nan),
        lambda: CoilWiring(0, 1, 23.0, sign=2),
        lambda: replace(
            THESIS, coils=(CoilWiring(0, 1, 23.0), CoilWiring(1, 2, 23.0), CoilWiring(4, 5, 23.0))
        ),
        lambda: replace(
            THESIS, coils=(CoilWiring(0, 16, 23.0), CoilWiring(1, 2, 23.0), CoilWiring(4, 5, 23.0))
        ),
        lambda: replace(THESIS, supply_voltage=math.nan),
        lambda: replace(THESIS, current_limit=0.0),
        lambda: replace(THESIS, tries=0),
    ],
)
def test_impossible_settings_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(DeviceError, match="is outside"):
        make()


STEP = current_step(23.0, 3.4)


@pytest.mark.parametrize(
    ("counts", "input_a", "input_b"),
    [
        (+1, (0, 1), FULL_OFF),
        (+1024, (0, 1024), FULL_OFF),
        (+4095, (0, 4095), FULL_OFF),
        (+4096, FULL_ON, FULL_OFF),
        (-1, FULL_OFF, (0, 1)),
        (-1024, FULL_OFF, (0, 1024)),
        (-4096, FULL_OFF, FULL_ON),
        (0, FULL_OFF, FULL_OFF),
    ],
)
def test_inputs_follow_table_5_2(counts: int, input_a: tuple[int, int], input_b: tuple[int, int]) -> None:
    assert inputs_for(counts) == (input_a, input_b)


def test_no_counts_are_ever_equal_and_both_inputs_are_never_driven_at_once() -> None:
    for counts in range(-4096, 4097):
        pins = inputs_for(counts)
        assert all(on != off for on, off in pins)
        assert FULL_OFF in pins


def test_full_drive_is_the_thesis_maximum_current() -> None:
    """The largest current is 3.4 V / 23 ohm = 0.1478 A. The thesis states 0.148 A (ch. 5)."""
    assert largest_counts(STEP, 0.148) == 4096
    assert pytest.approx(3.4 / 23.0, rel=1e-15) == 4096 * STEP


def test_a_lower_limit_is_never_exceeded_by_rounding() -> None:
    largest = largest_counts(STEP, 0.1)
    assert largest * STEP <= 0.1 < (largest + 1) * STEP


def test_a_limit_of_whole_counts_is_reached_exactly() -> None:
    assert all(largest_counts(STEP, counts * STEP) == counts for counts in range(1, 4097))


@pytest.mark.parametrize(
    ("current", "counts", "limited"),
    [
        (0.0, 0, False),
        (0.4 * STEP, 0, False),
        (0.6 * STEP, 1, False),
        (-0.6 * STEP, -1, False),
        (1e3, 4096, True),
        (-1e3, -4096, True),
        (math.inf, 4096, True),
        (-math.inf, -4096, True),
    ],
)
def test_counts_are_the_nearest_and_limits_are_reported(current: float, counts: int, limited: bool) -> None:
    assert counts_for(current, STEP, 4096) == (counts, limited)


def test_a_duty_of_a_half_is_half_of_the_supply() -> None:
    """By Sease 5.33, V_equivalent = duty x V_supply. A duty cycle of 0.5 gives 1.7 V across 23 ohm."""
    assert counts_for(1.7 / 23.0, STEP, 4096) == (2048, False)


def test_nan_is_refused_as_a_current() -> None:
    with pytest.raises(ValueError, match="NaN"):
        counts_for(math.nan, STEP, 4096)


MS = 1_000_000
FULL = 3.4 / 23.0
Y = frozenset({1})


def stuck(condition: CoilCondition = CoilCondition.A_HIGH) -> Rig:
    """Return a rig whose coils are started, with one leg of coil y's bridge stuck."""
    rig = Rig()
    rig.coils.start()
    rig.wire.circuit.become(1, condition)
    return rig


@pytest.mark.parametrize(("condition", "sign"), [(CoilCondition.A_HIGH, 1.0), (CoilCondition.B_HIGH, -1.0)])
def test_a_leg_stuck_high_drives_its_coil_at_zero_and_a_brake_ends_it(
    condition: CoilCondition, sign: float
) -> None:
    """A leg stuck high drives its coil at zero command, until the brake sets both inputs high.

    The brake works for either leg, so the driver need not know which leg is stuck.
    """
    rig = stuck(condition)
    rig.command(0.0, 0.0, 0.0)
    assert rig.currents() == pytest.approx([0.0, sign * FULL, 0.0])
    rig.coils.brake(Y)
    assert BRAKED == (FULL_ON, FULL_ON)
    assert rig.currents() == [0.0, 0.0, 0.0]
    assert rig.coils.state().braked == Y


def test_a_healthy_bridge_that_is_braked_carries_no_current_for_any_command(rig: Rig) -> None:
    rig.coils.start()
    rig.coils.brake(Y)
    rig.command(0.1, 0.1, -0.05)
    assert rig.currents() == pytest.approx([0.1, 0.0, -0.05], abs=1e-4)
    assert rig.coils.state().current.tolist() == pytest.approx([0.1, 0.0, -0.05], abs=1e-4)
    rig.coils.brake(NO_AXES)
    rig.command(0.1, 0.1, -0.05)
    assert rig.currents() == pytest.approx([0.1, 0.1, -0.05], abs=1e-4)


def test_a_brake_on_a_leg_stuck_low_would_drive_the_coil() -> None:
    """With a leg stuck low, the brake would drive the coil.

    Therefore the current is checked after the bridge was braked, and the brake is released if the current
    remains.
    """
    rig = stuck(CoilCondition.A_LOW)
    assert rig.currents() == [0.0, 0.0, 0.0]
    rig.coils.brake(Y)
    assert rig.currents()[1] == pytest.approx(-FULL)


def test_coils_stay_at_zero_while_a_stuck_leg_is_braked() -> None:
    rig = stuck()
    rig.coils.brake(Y)
    rig.command(0.1, 0.0, 0.0)
    rig.coils.off()
    assert rig.currents() == [0.0, 0.0, 0.0]
    rig.clock.advance(1000 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0], "the job says it again at every period"


def test_a_command_that_becomes_stale_does_not_lift_a_brake() -> None:
    rig = stuck()
    rig.coils.brake(Y)
    rig.command(0.1, 0.0, 0.0)
    rig.clock.advance(500 * MS)
    assert rig.coils.state().stale
    assert rig.currents() == [0.0, 0.0, 0.0]


def test_close_leaves_a_stuck_leg_braked() -> None:
    rig = stuck()
    rig.coils.brake(Y)
    rig.coils.close()
    assert rig.currents() == [0.0, 0.0, 0.0]
    with pytest.raises(Refused, match=r"after close\(\)"):
        rig.coils.brake(Y)


def test_a_brown_out_lifts_a_brake_for_half_a_second_at_most() -> None:
    """After a brown-out of the chip, a stuck leg drives its coil for at most 0.6 s.

    The chip loses its registers. The next check of its configuration restores the brake.
    """
    rig = stuck()
    rig.coils.brake(Y)
    rig.wire.chip.brown_out()
    assert rig.currents()[1] == pytest.approx(FULL)
    rig.clock.advance(600 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    assert rig.wire.chip.violations == set()


def test_a_brake_that_could_not_be_written_is_written_later() -> None:
    rig = stuck()
    rig.wire.bus.nack(PCA, times=None)
    rig.coils.brake(Y)
    assert rig.coils.state().braked == NO_AXES
    assert rig.coils.state().error
    rig.wire.bus.clear_faults()
    rig.clock.advance(100 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    assert rig.coils.state().braked == Y


def test_a_start_begins_without_brakes() -> None:
    rig = stuck()
    rig.coils.brake(Y)
    rig.coils.close()
    rig.coils.start()
    assert rig.coils.state().braked == NO_AXES
    assert rig.duties == [0.0] * 16


@pytest.mark.parametrize("axis", range(3))
def test_a_braked_bridge_is_reported_without_current_on_each_axis(axis: int) -> None:
    rig = Rig()
    rig.coils.start()
    rig.command(0.1, 0.1, 0.1)
    rig.coils.brake(frozenset({axis}))
    expected = [0.0 if number == axis else 0.1 for number in range(3)]
    state = rig.coils.state()
    assert state.current[axis] == 0.0
    assert state.current.tolist() == pytest.approx(expected, abs=1e-4)
    assert rig.currents() == pytest.approx(expected, abs=1e-4)


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


def test_a_bridge_at_its_highest_voltage_follows_the_next_command_at_once() -> None:
    clock, given = SimClock(), replace(SETTINGS, supply_voltage=5.06)
    circuit = BridgeCircuit(0x60, given, np.random.default_rng(1), 0.0, 5.0)
    bridges = Drv8830Bridges(EmulatedI2cBus(circuit.parts), 0x60, clock, given)
    bridges.configure()
    bridges.write_channels(0, [FULL_ON, FULL_OFF])
    clock.sleep_until_ns(300_000_000_000)
    bridges.write_channels(0, [(0, 2048), FULL_OFF])
    assert volts_of(circuit.parts[0].registers[0]) < 3.0


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
