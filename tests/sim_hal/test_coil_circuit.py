"""Tests of coil currents from PWM outputs: truth table of the bridge, current errors, and the supply."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.coils import CoilWiring
from hal.drivers.pca9685 import FULL_OFF, FULL_ON, PwmCounts
from sim_hal.emulators.coil_circuit import Bridge, Chopping, CoilCircuit
from tests.hal.coils.rig import THESIS, THESIS_COILS, Rig

FULL = 3.4 / 23.0
PULSE = st.tuples(st.integers(0, 4095), st.integers(0, 4096))


@pytest.mark.parametrize(
    ("input_a", "input_b", "current"),
    [
        (FULL_ON, FULL_ON, 0.0),  # H H: 0 V
        (FULL_ON, FULL_OFF, FULL),  # H L: V_supply, CW
        (FULL_OFF, FULL_ON, -FULL),  # L H: V_supply, CCW
        (FULL_OFF, FULL_OFF, 0.0),  # L L: 0 V
        ((0, 1024), FULL_OFF, FULL / 4),
        ((0, 2048), (1024, 3072), 0.0),  # phases of the bridge: positive, brake, negative
        ((0, 2048), (0, 1024), FULL / 4),  # both inputs high: brake
        ((3000, 1000), FULL_OFF, FULL * 2096 / 4096),  # the pulse continues across the end of the period
    ],
)
def test_the_coil_sees_table_5_2(input_a: PwmCounts, input_b: PwmCounts, current: float) -> None:
    rig = Rig()
    rig.pca.configure()
    rig.pca.write_channels(0, [input_a, input_b])
    assert rig.currents() == pytest.approx([current, 0.0, 0.0], abs=1e-15)


def test_the_uncertainty_is_uniform_within_its_bound_and_drawn_at_each_command() -> None:
    """The current error is uniform within 3.5 mA, and is drawn at each command.

    The standard deviation of the error is 3.5e-3/sqrt(3) A, which 2,000 random draws determine to within 8 %
    (5 sigma).
    """
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    errors = []
    for _ in range(2000):
        rig.command(0.1, -0.05, 0.0)
        x, y, z = rig.currents()
        errors.append((x - rig.coils.state().current[0], y - rig.coils.state().current[1]))
        assert z == 0.0, "none at zero command"
    spread = np.array(errors)
    assert np.all(np.abs(spread) <= 3.5e-3)
    assert np.max(np.abs(spread)) > 3.4e-3
    assert np.std(spread, axis=0) == pytest.approx([3.5e-3 / 3**0.5] * 2, rel=0.08)
    assert np.abs(np.mean(spread, axis=0)).max() < 5 * 3.5e-3 / 3**0.5 / 2000**0.5
    assert abs(np.corrcoef(spread.T)[0, 1]) < 5 / 2000**0.5


def test_the_current_keeps_its_error_until_the_coil_is_written_again() -> None:
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    before = rig.currents()
    assert rig.pca.is_configured()
    rig.pca.write_channels(2, [FULL_OFF, FULL_OFF])
    assert rig.currents() == before
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents() != before


def test_the_true_current_never_passes_the_limit() -> None:
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    for sign in (1.0, -1.0):
        for _ in range(50):
            rig.command(sign, sign, sign)
            assert max(map(abs, rig.currents())) <= FULL
    limited = Rig(replace(rig.settings, current_limit=0.1), uncertainty=3.5e-3)
    limited.coils.start()
    for _ in range(50):
        limited.command(1.0, 1.0, 1.0)
        assert max(limited.currents()) <= 0.1


def test_the_same_seed_gives_the_same_currents() -> None:
    def fly() -> list[list[float]]:
        rig = Rig(uncertainty=3.5e-3)
        rig.coils.start()
        flowing = []
        for step in range(20):
            rig.command(0.01 * step, 0.0, -0.05)
            rig.clock.advance(25_000_000)
            flowing.append(rig.currents())
        return flowing

    assert fly() == fly()


def test_a_coil_whose_resistance_is_not_what_the_driver_believes() -> None:
    """A coil of 20 ohm that the driver assumes to have 23 ohm carries 0.115 A instead of 0.1 A."""
    rig = Rig()
    truth = replace(THESIS, coils=(CoilWiring(0, 1, 20.0), *THESIS_COILS[1:]))
    circuit = CoilCircuit(rig.wire.chip, truth, np.random.default_rng(1), rig.clock.now_ns, uncertainty=0.0)
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    assert circuit.currents()[0] == pytest.approx(0.115, abs=1e-4)


def test_a_sleeping_or_browned_out_chip_carries_no_current() -> None:
    rig = Rig()
    rig.coils.start()
    rig.command(0.1, 0.1, 0.1)
    rig.bus.write_byte_data(0x40, 0x00, 0x30)
    assert rig.currents() == [0.0, 0.0, 0.0]


@given(a=PULSE, b=PULSE, begin=st.integers(0, 100_000_000), span=st.integers(100_000, 68_100_000))
def test_the_chopped_charge_agrees_with_sampling_the_bridge(
    a: tuple[int, int], b: tuple[int, int], begin: int, span: int
) -> None:
    """The charge of chopped currents agrees with samples of the bridge.

    The reference samples the middle of 20,000 slices. Each edge may be wrong by one slice.
    """
    period = 20_000_000.0
    chopping = Chopping(0, 0, period, ((Bridge(a, b), 0.148),))
    count = 20_000
    times = begin + span * (np.arange(count) + 0.5) / count
    at = times / period % 1.0 * 4096
    on_a, on_b = ((at - first) % 4096 < length for first, length in (a, b))
    sampled = 0.148 * np.mean(on_a != on_b)
    edges = 4 * (span / period + 2)
    assert chopping.charge(begin, begin + span) / span == pytest.approx(sampled, abs=0.148 * edges / count)


def test_the_supply_is_chopped_and_its_mean_over_whole_periods_is_the_sum_of_magnitudes() -> None:
    rig = Rig()
    rig.coils.start()
    rig.command(0.1, -0.05, 0.0)
    rig.clock.advance(1)
    begin = rig.clock.now_ns()
    period = round(1e9 / rig.wire.chip.frequency)
    rig.clock.advance(3 * period)
    supply = rig.wire.circuit.mean_supply
    volts, amps = supply(begin, begin + 3 * period)
    assert volts == 3.4
    assert amps == pytest.approx(0.15, abs=1e-4)
    slices = [supply(begin + k * period // 500, begin + (k + 1) * period // 500)[1] for k in range(500)]
    assert max(slices) == pytest.approx(2 * FULL, rel=1e-3), "both coils driven at once"
    assert min(slices) == 0.0


def test_a_single_conversion_of_the_chopped_current_is_off_by_up_to_18_percent() -> None:
    """A single ADC sample of the chopped current is off by up to 18 %.

    A sample of 68.1 ms contains up to 4 pulses, and 3.4 pulses on average (`hal.drivers.current_monitors`).
    """
    rig = Rig()
    rig.coils.start()
    rig.command(0.05, 0.0, 0.0)
    begin = rig.clock.now_ns()
    rig.clock.advance(100_000_000)
    window = 68_100_000
    starts = begin + np.linspace(0, 20_000_000, 400).astype(int)
    ratios = [rig.wire.circuit.mean_supply(int(at), int(at) + window)[1] / 0.05 for at in starts]
    assert 1.15 < max(ratios) < 1.19
    assert 0.81 < min(ratios) < 0.89
