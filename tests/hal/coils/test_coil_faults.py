"""Tests of the torque coils with bus and chip faults: retries, counters, and zero current when in doubt."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from tests.hal.coils.rig import PCA, Rig

MS = 1_000_000


@pytest.mark.parametrize("fault", ["nack", "arbitration"])
def test_a_transient_fault_is_retried_and_counted(rig: Rig, fault: str) -> None:
    rig.coils.start()
    if fault == "nack":
        rig.wire.bus.nack(PCA, times=2)
    else:
        rig.wire.bus.lose_arbitration(times=2)
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents()[0] == pytest.approx(0.1, abs=1e-4)
    state = rig.coils.state()
    assert (state.faults, state.error) == (2, "")


def test_a_write_that_fails_repeatedly_sets_the_coils_to_zero_and_reports_the_error(rig: Rig) -> None:
    """If three attempts of a write fail, the driver writes zero to all coils and reports the error.

    Each attempt fails after ten bytes, so that coil x has its new value and coil y still has its old value.
    """
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


def test_the_error_of_a_dead_chip_remains_until_the_chip_responds_again(rig: Rig) -> None:
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


def test_a_dead_chip_gets_one_write_of_zero_per_period(rig: Rig) -> None:
    """A chip that does not respond is accessed once per period of 50 ms, by one transaction that writes zero.

    On a hung bus, each transaction lasts until its timeout, so the number of transactions must be small.
    """
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
def test_a_request_of_zero_just_before_a_write_is_not_undone_by_the_write(action: str) -> None:
    """A call of `off` or `close` just before a write is not undone by this write.

    The call is made as by a signal handler that interrupts the writing thread.
    """

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
    """A write of zero with flipped bits is corrected after one period of 50 ms.

    I2C has no checksum. The full-OFF value of coil x's input A becomes a duty cycle of a half.
    """
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


def test_off_gives_up_after_its_tries_and_the_job_continues_to_write_zero(rig: Rig) -> None:
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
