"""The magnetometer feels the coils by the matrix `simulation.coil_field`."""

from __future__ import annotations

import numpy as np
import pytest

from flight.schema import reader as configuration
from knightcube.astro.arrays import FloatArray
from sim_hal import lockstep
from sim_hal.clock import SimClock
from sim_hal.emulators.vn100_sensors import Vn100Sample
from sim_hal.settings import Row
from tests.support.flights import demo_config, demo_world

NONE: tuple[Row, Row, Row] = ((0.0, 0.0, 0.0),) * 3
UNEQUAL: tuple[Row, Row, Row] = ((5e-4, 1e-4, 0.0), (0.0, 4e-4, 0.0), (-2e-4, 0.0, 3e-4))


def gauss(coil_field: tuple[Row, Row, Row], driven: bool) -> tuple[FloatArray, FloatArray]:
    """Return the field that the held unit measured last, gauss, and the coils' currents, A."""
    section = configuration.replace(demo_world(), coil_field=coil_field, current_noise=0.0)
    lock = lockstep.build(demo_config(10.0, camera=False), section, None, SimClock())
    seen: list[FloatArray] = []

    def note(measured: Vn100Sample) -> Vn100Sample:
        seen.append(measured.mag)
        return measured

    lock.hardware.unit.alter = note
    if driven:
        # Awake, with auto-increment; then input A of x for half, B of z for a quarter of a period.
        lock.hardware.bus.write_i2c_block_data(0x40, 0x00, [0x20])
        lock.hardware.bus.write_i2c_block_data(0x40, 0x06, [0, 0, 0, 8])
        lock.hardware.bus.write_i2c_block_data(0x40, 0x1A, [0, 0, 0, 4])
    lock.clock.sleep_until_ns(lock.clock.now_ns() + 100_000_000)
    return seen[-1], lock.hardware.circuit.currents()


def test_the_coils_add_their_matrix_times_their_currents() -> None:
    alone, _ = gauss(UNEQUAL, driven=False)
    beside, currents = gauss(UNEQUAL, driven=True)
    full = 3.4 / 23.0
    assert currents == pytest.approx([full / 2, 0.0, -full / 4])
    assert beside - alone == pytest.approx(1e4 * np.array(UNEQUAL) @ currents, abs=1e-9)


def test_by_default_the_magnetometer_does_not_feel_them() -> None:
    alone, _ = gauss(NONE, driven=False)
    beside, _ = gauss(NONE, driven=True)
    assert beside == pytest.approx(alone, abs=1e-9)
