"""Devices that several tests of the fault catalogue share."""

from __future__ import annotations

import numpy as np
import pytest

from flight.schema import reader as configuration
from sim_hal import lockstep
from sim_hal.clock import SimClock
from sim_hal.faults.bench import Bench
from sim_hal.lockstep import LockStep
from tests.support.flights import demo_config, demo_world


@pytest.fixture
def lock() -> LockStep:
    config = configuration.replace(demo_config(10.0))
    return lockstep.build(config, demo_world(), None, SimClock())


def bench_of(lock: LockStep) -> Bench:
    generator = np.random.default_rng(1)
    line = lock.line
    return Bench(lock.hardware, line, lock.clock.now_ns, generator, line.host, gps_line=lock.gps_line)
