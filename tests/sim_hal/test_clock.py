"""Tests that simulated time jumps to the next event, and that each due event occurs in order."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from hal.buses.system import SystemClock
from sim_hal.clock import NEVER, EmulatorError, SimClock, TimedSimulation
from sim_hal.emulation import EmulatedWires
from sim_hal.emulators.i2c_bus import EmulatedI2cBus, Registers

MS = 1_000_000


class Beeper:
    """A world with an event every 10 ms."""

    def __init__(self, notes: list[tuple[str, int]]) -> None:
        self._notes = notes
        self._next = 10 * MS
        self.time = 0

    def next_event_ns(self) -> int:
        return self._next

    def advance_to(self, time_ns: int) -> None:
        assert time_ns >= self.time
        self.time = time_ns
        while self._next <= time_ns:
            self._notes.append(("beep", self._next))
            self._next += 10 * MS

    run_events = pass_to = advance_to


def test_sleeping_advances_the_world_and_the_tickers_in_order() -> None:
    clock, notes = SimClock(), list[tuple[str, int]]()
    clock.attach(Beeper(notes))
    clock.ticker("tick", 15 * MS, lambda: notes.append(("tick", clock.now_ns())))
    clock.sleep_until_ns(45 * MS)
    assert notes == [
        ("beep", 10 * MS),
        ("tick", 15 * MS),
        ("beep", 20 * MS),
        ("beep", 30 * MS),
        ("tick", 30 * MS),
        ("beep", 40 * MS),
        ("tick", 45 * MS),
    ]


def test_a_deadline_in_the_past_changes_nothing() -> None:
    clock = SimClock()
    clock.sleep_until_ns(5 * MS)
    clock.sleep_until_ns(3 * MS)
    assert clock.now_ns() == 5 * MS


def test_a_kick_runs_the_job_at_once_and_starts_its_period_again() -> None:
    clock, runs = SimClock(), list[int]()
    ticker = clock.ticker("job", 20 * MS, lambda: runs.append(clock.now_ns()))
    clock.sleep_until_ns(15 * MS)
    ticker.kick()
    clock.sleep_until_ns(34 * MS)
    assert runs == [15 * MS]
    clock.sleep_until_ns(35 * MS)
    assert runs == [15 * MS, 35 * MS]
    ticker.stop()
    clock.sleep_until_ns(100 * MS)
    assert len(runs) == 2


def test_a_job_that_sleeps_lets_the_world_go_on_but_no_other_job() -> None:
    clock, notes = SimClock(), list[tuple[str, int]]()
    clock.attach(Beeper(notes))
    clock.ticker("sleeper", 12 * MS, lambda: clock.sleep_until_ns(clock.now_ns() + 10 * MS))
    clock.ticker("other", 14 * MS, lambda: notes.append(("other", clock.now_ns())))
    clock.sleep_until_ns(15 * MS)
    assert notes[:2] == [("beep", 10 * MS), ("beep", 20 * MS)]
    assert notes[2] == ("other", 22 * MS)
    assert clock.now_ns() == 22 * MS


class Mistaken(Registers):
    """An emulator of another package, whose methods raise the given errors."""

    def __init__(self, advance: Exception | None = None, load: Exception | None = None) -> None:
        super().__init__(0x40)
        self._advance, self._load = advance, load

    def next_event_ns(self) -> int:
        return NEVER if self._advance is None else 10 * MS

    def advance(self, now_ns: int) -> None:
        assert self._advance is not None
        raise self._advance

    def store(self, register: int, value: int) -> None:
        pass

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        return [bytes([self.load(0)]) for _ in frames]

    def load(self, register: int) -> int:
        if self._load is not None:
            raise self._load
        return 0


NAMED = rf"the emulator {__name__}:Mistaken failed: .*test_clock.py:\d+: KeyError: 'x': correct this line"


def test_a_mistake_in_a_timed_emulator_of_another_package_is_named() -> None:
    clock = SimClock()
    clock.attach(TimedSimulation(lambda _: None, [Mistaken(KeyError("x"))]))
    with pytest.raises(EmulatorError, match=NAMED):
        clock.sleep_until_ns(20 * MS)


def test_a_mistake_in_a_chip_of_another_package_ends_the_job_that_reads_the_chip() -> None:
    clock, bus = SimClock(), EmulatedI2cBus([Mistaken(load=KeyError("x"))])

    def read() -> None:
        bus.read_byte_data(0x40, 1)

    clock.ticker("driver", 10 * MS, read)
    with pytest.raises(EmulatorError, match=NAMED):
        clock.sleep_until_ns(20 * MS)


def test_a_mistake_in_an_spi_device_of_another_package_is_named() -> None:
    wires = EmulatedWires(lambda: 0, 1, 1)
    wires.spi_devices |= {"good": Mistaken(), "bad": Mistaken(load=KeyError("x"))}
    assert wires.spi("good", 1_000_000, 3).transfer([b"a"]) == [b"\0"]
    with pytest.raises(EmulatorError, match=NAMED):
        wires.spi("bad", 1_000_000, 3).transfer([b"a"])


def test_errors_that_a_chip_may_raise_and_errors_of_built_in_code_are_not_renamed() -> None:
    bus = EmulatedI2cBus([Mistaken(load=OSError(121, "no acknowledge"))])
    with pytest.raises(OSError, match="no acknowledge"):
        bus.read_byte_data(0x40, 1)
    clock = SimClock()

    def job() -> None:
        raise KeyError("x")

    ticker = clock.ticker("job", MS, job)
    clock.sleep_until_ns(8 * MS)
    assert ticker.error == "KeyError: 'x'"


def test_utc_is_the_label_of_the_start_plus_the_time_since() -> None:
    clock = SimClock(utc_start_ns=5)
    clock.sleep_until_ns(7)
    assert clock.utc_ns() == 12


@pytest.mark.parametrize("clock", [SimClock(), SystemClock()])
def test_a_job_that_raises_is_kept_as_an_error_and_runs_again(clock: SimClock | SystemClock) -> None:
    """If a job raises, the error is stored and the job runs again.

    If the exception ended the thread of the job, a device such as the coils would keep its last state.
    """
    runs = list[int]()

    def job() -> None:
        runs.append(clock.now_ns())
        if len(runs) == 1:
            raise MemoryError("none left")

    ticker = clock.ticker("job", 5 * MS, job)
    made_ns = ticker.served_ns
    clock.sleep_until_ns(clock.now_ns() + 5 * MS)
    patience_ns = clock.now_ns() + 1_000 * MS
    while not ticker.error and clock.now_ns() < patience_ns and len(runs) < 2:
        clock.sleep_until_ns(clock.now_ns() + MS)
    while ticker.served_ns == made_ns and clock.now_ns() < patience_ns:
        clock.sleep_until_ns(clock.now_ns() + MS)
    assert len(runs) >= 2
    assert (ticker.error, list(clock.tickers)) == ("", [ticker])
    ticker.stop()
    assert list(clock.tickers) == []
