"""Tests in real time. The bus job runs on its own thread.

A command never waits for the bus. A command of zero current always reaches the coils.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from hal.buses.system import SystemClock
from hal.drivers.coils import PwmTorqueCoils
from hal.drivers.current_monitors import Ina219
from hal.drivers.pca9685 import Pca9685
from tests.hal.coils.rig import INA, PCA, THESIS, Wire


def eventually(condition: Callable[[], bool], within: float = 5.0) -> bool:
    """Wait until a condition that another thread sets is true."""
    deadline = time.monotonic() + within
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def started() -> tuple[PwmTorqueCoils, Wire]:
    """Build and start the coils on the real clock."""
    clock = SystemClock()
    wire = Wire(clock, THESIS, uncertainty=0.0)
    coils = PwmTorqueCoils(Pca9685(wire.bus, PCA, clock), clock, THESIS)
    coils.start()
    return coils, wire


def test_a_command_reaches_the_coils_and_falls_to_zero_when_no_other_comes() -> None:
    coils, wire = started()

    def commanded() -> bool:
        coils.command(np.array([0.1, 0.0, 0.0]))
        return bool(wire.circuit.currents()[0] > 0.09)

    assert eventually(commanded)
    assert eventually(lambda: not wire.circuit.currents().any())
    assert eventually(lambda: coils.state().stale)
    coils.close()


def test_a_command_does_not_wait_for_a_hung_bus() -> None:
    """If each transaction hangs for 0.5 s, 20 commands together take less time than one transaction."""
    coils, wire = started()
    release = threading.Event()

    def wait(span_ns: int) -> None:
        release.wait(0.5)

    wire.bus._wait = wait
    wire.bus.hang()
    begin = time.monotonic()
    for _ in range(20):
        coils.command(np.array([0.1, 0.0, 0.0]))
    took = time.monotonic() - begin
    assert eventually(lambda: "time-out" in coils.state().error)
    wire.bus.clear_faults()
    release.set()
    coils.close()
    assert took < 0.5
    assert wire.circuit.currents().tolist() == [0.0, 0.0, 0.0]


def test_many_threads_commanding_and_switching_off_end_at_zero() -> None:
    coils, wire = started()
    monitor = Ina219(wire.bus, INA, SystemClock(), period_ns=2_000_000)
    failures: list[BaseException] = []

    def hammer(seed: int) -> None:
        generator = np.random.default_rng(seed)
        try:
            for step in range(150):
                coils.command(generator.uniform(-0.2, 0.2, 3))
                state = coils.state()
                assert np.all(np.abs(state.current) <= 0.148)
                if step % 10 == seed:
                    coils.off()
        except BaseException as error:  # noqa: BLE001 - handed over to the test's own thread
            failures.append(error)

    threads = [threading.Thread(target=hammer, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20.0)
        assert not thread.is_alive()
    assert failures == []
    assert coils.state().faults == 0
    coils.close()
    monitor.close()
    assert monitor.error() == ""
    assert wire.circuit.currents().tolist() == [0.0, 0.0, 0.0]
    assert wire.chip.violations == set()


@pytest.mark.parametrize("times", [1, 2])
def test_close_ends_the_thread(times: int) -> None:
    coils, _ = started()
    assert any(thread.name == "coils" for thread in threading.enumerate())
    for _ in range(times):
        coils.close()
    assert not any(thread.name == "coils" for thread in threading.enumerate())
