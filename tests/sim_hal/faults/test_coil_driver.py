"""Tests of the coil driver with a faulty PWM chip: faults are detected, reported and corrected."""

from __future__ import annotations

import numpy as np
import pytest

from flight.app.devices import coil_settings
from hal.drivers.coils import PwmTorqueCoils
from hal.drivers.pca9685 import Pca9685
from sim_hal.clock import SimClock
from sim_hal.faults.catalogue import Bench
from sim_hal.faults.schedule import parse, put
from sim_hal.rig import build_lockstep
from tests.support.flights import demo_config, demo_world

CYCLE_NS = 25_000_000
WANTED = np.array([0.06, 0.0, -0.03])


def errors_under(fault: str) -> tuple[list[tuple[float, str]], float]:
    """Drive the coils for six seconds during a fault.

    Returns (time, error) of each cycle, and the last current error (A).
    """
    config = demo_config(10.0, camera=False)
    lock = build_lockstep(config, demo_world(), None, SimClock())
    coils = PwmTorqueCoils(
        Pca9685(lock.hardware.bus, 0x40, lock.clock), lock.clock, coil_settings(config.coils)
    )
    coils.start()
    epoch_ns = lock.clock.now_ns()
    bench = Bench(lock.hardware, lock.line, lock.clock.now_ns, np.random.default_rng(4), lock.line.host)
    put([parse(fault)], bench, epoch_ns)
    seen = []
    for cycle in range(240):
        lock.clock.sleep_until_ns(epoch_ns + cycle * CYCLE_NS)
        # A changing command, as in flight, shows a stuck output.
        coils.command(WANTED * (1.0 + 0.003 * cycle))
        seen.append((0.025 * cycle, coils.state().error))
    miss = float(np.abs(lock.hardware.circuit.currents() - coils.state().current).max())
    coils.close()
    return seen, miss


@pytest.mark.parametrize(
    ("fault", "word"),
    [
        ("pwm: stuck @ 2 for 2", "does not keep"),
        ("pwm: delayed @ 2 for 2", "does not keep"),
        ("pwm: garbage @ 2 for 2", ""),
        ("pwm: brown-out @ 2", "lost its register settings"),
        ("pwm: wrong @ 2", "lost its register settings"),
        ("pwm: off @ 2 for 2", "no acknowledge"),
        ("bus: hang @ 2 for 2", "time-out"),
        ("bus: arbitration @ 2 for 2", "arbitration lost"),
    ],
)
def test_a_chip_that_fails_is_reported_within_half_a_second_and_obeys_again_after(
    fault: str, word: str
) -> None:
    seen, miss = errors_under(fault)
    reports = [(time, error) for time, error in seen if error]
    assert 2.0 <= reports[0][0] <= 2.6
    assert any(word in error for _, error in reports)
    assert all(time < 4.5 for time, _ in reports), "good again within half a second of the fault's end"
    assert miss < 4e-3
    if "for" in fault and "garbage" not in fault:
        lasting = [bool(error) for time, error in seen if 2.6 < time < 3.9]
        assert all(lasting), "reported while the fault lasts"


def test_a_healthy_chip_is_never_reported() -> None:
    seen, miss = errors_under("imu: silent @ 2 for 2")
    assert not any(error for _, error in seen)
    assert miss < 4e-3
