"""The torque coils, from the driver to the current in the wire: right when all is well, zero on any doubt."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.coil_settings import CoilSettings, CoilWiring
from hal.drivers.h_bridge import current_step
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from tests.coils.rig import PCA, THESIS_COILS, UNEQUAL, Rig, limited_to

MS = 1_000_000
FINITE = st.floats(allow_nan=False, allow_infinity=False)
USUAL = st.floats(-0.25, 0.25)


@settings(max_examples=200, deadline=None)
@given(
    command=st.tuples(USUAL | FINITE, USUAL | FINITE, USUAL | FINITE),
    limit=st.sampled_from([0.148, 0.1, 0.0201, 1.0]),
)
def test_the_world_feels_what_was_commanded_within_half_a_count(
    command: tuple[float, float, float], limit: float
) -> None:
    """Coils of unequal resistance, one of them wired backwards, one with an enable input."""
    rig = Rig(limited_to(limit))
    rig.coils.start()
    rig.command(*command)
    state = rig.coils.state()
    assert rig.currents() == pytest.approx(state.current.tolist(), abs=1e-15)
    any_limited = False
    for coil, asked, felt in zip(UNEQUAL.coils, command, rig.currents(), strict=True):
        step = current_step(coil.resistance, 3.4)
        bound = min(limit, 3.4 / coil.resistance)
        any_limited = any_limited or abs(asked) > bound
        assert abs(felt) <= bound * (1 + 1e-12)
        assert felt * asked >= 0.0
        if abs(asked) <= bound - step:
            assert abs(felt - asked) <= 0.5 * step * (1 + 1e-9)
        else:
            assert abs(felt) > bound - step
    assert state.saturated or not any_limited
    assert state.command.tolist() == list(command)
    assert rig.wire.chip.violations == set()


def test_saturation_is_told_and_only_when_it_happens(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.148, 0.0, 0.0)  # V/R is 0.14783 A
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


def test_a_wired_enable_coasts_at_zero_and_drives_otherwise() -> None:
    rig = Rig(UNEQUAL)
    rig.coils.start()
    rig.command(0.0, 0.0, -0.02)
    assert rig.wire.chip.duty(10) == 1.0
    rig.command(0.0, 0.0, 0.0)
    assert rig.wire.chip.duty(10) == 0.0


def test_three_coils_with_enable_take_nine_channels_in_two_blocks() -> None:
    wiring = tuple(CoilWiring(3 * axis, 3 * axis + 1, 23.0, enable_channel=3 * axis + 2) for axis in range(3))
    rig = Rig(CoilSettings(coils=(wiring[0], wiring[1], wiring[2])))
    assert [(first, len(pins)) for first, pins in rig.settings.blocks()] == [(0, 8), (8, 1)]
    rig.coils.start()
    rig.command(0.1, -0.1, 0.03)
    half = 0.5 * current_step(23.0, 3.4)
    assert rig.currents() == pytest.approx([0.1, -0.1, 0.03], abs=half)


def test_start_leaves_a_running_chip_at_zero(rig: Rig) -> None:
    """A process that died left its coils driven."""
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
    rig = Rig(CoilSettings(coils=THESIS_COILS, stale_after=0.4))
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.clock.advance(499 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    with pytest.raises(OutOfRange, match="stale_after"):
        CoilSettings(coils=THESIS_COILS, stale_after=0.45)


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


@pytest.mark.parametrize("fault", ["nack", "arbitration"])
def test_a_passing_fault_is_retried_and_counted(rig: Rig, fault: str) -> None:
    rig.coils.start()
    if fault == "nack":
        rig.wire.bus.nack(PCA, times=2)
    else:
        rig.wire.bus.lose_arbitration(times=2)
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)
    state = rig.coils.state()
    assert (state.faults, state.error) == (2, "")


def test_a_write_that_fails_for_good_ends_at_zero_and_says_why(rig: Rig) -> None:
    """Three tries cut off after ten bytes: coil x has its new value, coil y none; then zero gets through."""
    rig.coils.start()
    rig.command(0.1, 0.1, 0.1)
    rig.wire.bus.nack(PCA, times=3, after=10)
    rig.command(-0.1, -0.1, -0.1)
    assert rig.currents() == [0.0, 0.0, 0.0]
    state = rig.coils.state()
    assert state.current.tolist() == [0.0, 0.0, 0.0]
    assert state.faults == 3
    assert "no acknowledge" in state.error
    rig.clock.advance(50 * MS)
    assert rig.currents() == pytest.approx([-0.1] * 3, abs=1e-4), "the command is still fresh"
    assert rig.coils.state().error == ""


def test_a_dead_chip_keeps_its_error_until_it_is_back_and_then_obeys(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.wire.bus.nack(PCA, times=None)
    for _ in range(8):
        rig.command(0.1, 0.0, 0.0)
        rig.clock.advance(25 * MS)
        assert "no acknowledge" in rig.coils.state().error
    assert rig.currents()[0] != 0.0, "nobody can reach the chip: this is what the output-enable line is for"
    before = rig.coils.state().faults
    assert before >= 8
    rig.wire.bus.clear_faults()
    rig.command(0.03, 0.0, 0.0)
    state = rig.coils.state()
    assert (state.error, state.faults) == ("", before)
    assert rig.currents()[0] == pytest.approx(0.03, abs=1e-4)


def test_a_dead_chip_is_asked_once_a_period_and_with_zero(rig: Rig) -> None:
    """On a hung bus each question costs a time-out: the job must not spend its time on many."""
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.wire.bus.nack(PCA, times=None)
    rig.command(0.1, 0.0, 0.0)
    before = rig.wire.bus.transactions
    rig.clock.advance(500 * MS)
    assert rig.wire.bus.transactions - before == 10


def test_a_job_that_is_late_for_close_writes_nothing(rig: Rig) -> None:
    rig.coils.start()
    (job,) = rig.clock.tickers
    rig.coils.close()
    before = rig.wire.bus.transactions
    job.kick()
    assert rig.wire.bus.transactions == before


@pytest.mark.parametrize("action", ["off", "close"])
def test_zero_asked_for_just_before_a_write_is_not_undone_by_it(action: str) -> None:
    """As a signal handler does it, in the middle of the thread that writes."""

    class Interrupted(EmulatedI2cBus):
        signal: Callable[[], None] | None = None

        def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
            if self.signal is not None:
                handler, self.signal = self.signal, None
                handler()
            super().write_i2c_block_data(address, register, values)

    plain = Rig()
    bus = Interrupted([plain.wire.chip])
    rig = Rig(wire=plain.wire, clock=plain.clock, bus=bus)
    rig.coils.start()
    bus.signal = getattr(rig.coils, action)
    rig.command(0.1, 0.1, 0.1)
    assert bus.signal is None
    assert rig.duties == [0.0] * 16
    assert not rig.coils.state().current.any()


def test_a_chip_that_comes_back_without_commands_is_zeroed(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.wire.bus.nack(PCA, times=None)
    rig.clock.advance(2000 * MS)
    assert rig.currents()[0] != 0.0
    rig.wire.bus.clear_faults()
    rig.clock.advance(50 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    assert rig.coils.state().stale
    assert rig.coils.state().error == ""


def test_a_hung_bus_costs_a_bounded_time_and_ends_at_zero(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.wire.bus.hang()
    begin = rig.clock.now_ns()
    rig.command(0.1, 0.0, 0.0)
    assert rig.clock.now_ns() - begin <= 100 * MS
    assert "time-out" in rig.coils.state().error
    rig.clock.advance(1000 * MS)
    rig.wire.bus.clear_faults()
    rig.clock.advance(100 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)


def test_a_brown_out_is_mended_within_a_second_and_counted(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.wire.chip.brown_out()
    assert rig.currents() == [0.0, 0.0, 0.0]
    for _ in range(41):
        rig.clock.advance(25 * MS)
        rig.command(0.1, 0.0, 0.0)
    assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)
    assert rig.coils.state().faults == 1
    assert rig.wire.chip.violations == set()


def test_bits_flipped_in_a_zero_do_not_outlast_one_period(rig: Rig) -> None:
    """I2C has no checksum: full OFF of coil x's input A arrives as a duty of a half."""
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    rig.wire.bus.flip_bits(PCA, index=3, mask=0x18)
    rig.command(0.0, 0.0, 0.0)
    assert rig.currents()[0] > 0.05
    rig.clock.advance(50 * MS)
    assert rig.currents() == [0.0, 0.0, 0.0]


def _nothing(rig: Rig) -> None:
    pass


def _commanded(rig: Rig) -> None:
    rig.coils.start()
    rig.command(0.1, -0.1, 0.1)


def _stale(rig: Rig) -> None:
    _commanded(rig)
    rig.clock.advance(500 * MS)


def _browned_out(rig: Rig) -> None:
    _commanded(rig)
    rig.wire.chip.brown_out()


def _lost_and_back(rig: Rig) -> None:
    _commanded(rig)
    rig.wire.bus.nack(PCA, times=None)
    rig.command(0.1, 0.1, 0.1)
    rig.wire.bus.clear_faults()


def _flaky(rig: Rig) -> None:
    _commanded(rig)
    rig.wire.bus.nack(PCA, times=2)


def _closed(rig: Rig) -> None:
    _commanded(rig)
    rig.coils.close()


STATES = [_nothing, _commanded, _stale, _browned_out, _lost_and_back, _flaky, _closed]


@pytest.mark.parametrize("bring_there", STATES)
def test_off_gives_zero_from_every_state_and_twice(rig: Rig, bring_there: Callable[[Rig], None]) -> None:
    bring_there(rig)
    for _ in range(2):
        rig.coils.off()
        assert rig.duties == [0.0] * 16
        assert rig.coils.state().current.tolist() == [0.0, 0.0, 0.0]
    rig.clock.advance(1500 * MS)
    assert rig.duties == [0.0] * 16, "nothing energises them again"


@pytest.mark.parametrize("bring_there", STATES)
def test_close_gives_zero_from_every_state_and_twice(rig: Rig, bring_there: Callable[[Rig], None]) -> None:
    bring_there(rig)
    for _ in range(2):
        rig.coils.close()
        assert rig.duties == [0.0] * 16
    assert not rig.clock.tickers


def test_off_gives_up_after_its_tries_and_the_job_goes_on_trying(rig: Rig) -> None:
    _commanded(rig)
    rig.wire.bus.nack(PCA, times=None)
    before = rig.wire.bus.transactions
    rig.coils.off()
    assert rig.wire.bus.transactions - before == rig.settings.tries
    assert "no acknowledge" in rig.coils.state().error
    rig.wire.bus.clear_faults()
    rig.clock.advance(50 * MS)
    assert rig.duties == [0.0] * 16
    assert rig.coils.state().error == ""


def test_the_coils_can_be_started_again_after_close(rig: Rig) -> None:
    _closed(rig)
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
        lambda: CoilSettings(coils=(CoilWiring(0, 1, 23.0), CoilWiring(1, 2, 23.0), CoilWiring(4, 5, 23.0))),
        lambda: CoilSettings(coils=(CoilWiring(0, 16, 23.0), CoilWiring(1, 2, 23.0), CoilWiring(4, 5, 23.0))),
        lambda: CoilSettings(coils=THESIS_COILS, supply_voltage=math.nan),
        lambda: CoilSettings(coils=THESIS_COILS, current_limit=0.0),
        lambda: CoilSettings(coils=THESIS_COILS, tries=0),
    ],
)
def test_settings_that_cannot_be_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(DeviceError, match="is outside"):
        make()
