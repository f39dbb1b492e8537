"""Tests of a bridge with a leg stuck high: the current of its coil, and commands that end this current."""

from __future__ import annotations

import pytest

from hal.drivers.coils import BRAKED
from hal.drivers.pca9685 import FULL_ON
from hal.interfaces.devices import NO_AXES
from hal.interfaces.errors import Refused
from sim_hal.emulators.coil_circuit import CoilCondition
from tests.hal.coils.rig import PCA, Rig

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


def test_a_sound_bridge_that_is_braked_carries_nothing_whatever_is_commanded(rig: Rig) -> None:
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

    So the current is checked after a brake, and the brake is released if the current remains.
    """
    rig = stuck(CoilCondition.A_LOW)
    assert rig.currents() == [0.0, 0.0, 0.0]
    rig.coils.brake(Y)
    assert rig.currents()[1] == pytest.approx(-FULL)


def test_zero_keeps_what_is_braked_at_zero() -> None:
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


def test_a_brake_that_the_chip_did_not_take_is_made_up_for() -> None:
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
