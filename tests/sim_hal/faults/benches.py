"""Devices that several tests of the fault catalogue share."""

from __future__ import annotations

import numpy as np

from sim_hal.faults.catalogue import Bench
from sim_hal.rig import LockStep


def bench_of(lock: LockStep) -> Bench:
    """Return the access of faults to the devices of a lock-step simulation."""
    generator = np.random.default_rng(1)
    line = lock.line
    return Bench(lock.hardware, line, lock.clock.now_ns, generator, line.host, gps_line=lock.gps_line)
