"""Tests of the torque coils from driver to current: correct currents, and zero current in doubt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.coils import CoilWiring, current_step
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from sim_hal.emulators.coil_circuit import CoilCondition
from tests.hal.coils.rig import PCA, THESIS, UNEQUAL, Rig, limited_to

MS = 1_000_000
FINITE = st.floats(allow_nan=False, allow_infinity=False)
USUAL = st.floats(-0.25, 0.25)


@settings(max_examples=60, deadline=None)
@given(
    command=st.tuples(USUAL | FINITE, USUAL | FINITE, USUAL | FINITE),
    limit=st.sampled_from([0.148, 0.1, 0.0201, 1.0]),
)
def test_the_world_feels_what_was_commanded_within_half_a_count(
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


def test_start_without_a_chip_says_so(rig: Rig) -> None:
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
    with pytest.raises(
        OutOfRange, match=f"current of coil {'xyz'[axis]} = (nan|inf|-inf) A is outside -0.147"
    ):
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
def test_settings_that_cannot_be_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(DeviceError, match="is outside"):
        make()
