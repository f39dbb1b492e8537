"""Tests of a simulation section and of the assembled hardware: IMU in free fall, field of the coils."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader
from flight.schema import reader as configuration
from flight.schema.devices import UnitCalibration
from flight.schema.document import ConfigError
from flight.schema.sections import Config
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal import settings
from sim_hal.clock import SimClock
from sim_hal.emulators.vn100_sensors import Vn100Sample
from sim_hal.rig import build_lockstep
from sim_hal.settings import FreeBodySection, ImuNoise, TipOff, Truth, Vector
from sim_hal.worlds.world import BodyMotion
from tests.support.flights import demo_config, demo_world
from tests.support.section_defaults import defaults_of

BIAS = (2e-6, -1e-6, 3e-6)


def measured(
    imu: ImuNoise, seconds: float, world: str = "free_body", config: Config | None = None
) -> tuple[list[Vn100Sample], list[BodyMotion]]:
    """Return the samples of the IMU at 40 Hz, and the true motion at the time of each sample."""
    body = FreeBodySection(release=TipOff(speed=0.02))
    section = reader.replace(demo_world(), world=world, free_body=body, imu=imu)
    lock = build_lockstep(config or demo_config(10.0, camera=False), section, None, SimClock())
    seen: list[Vn100Sample] = []
    true: list[BodyMotion] = []

    def note(sample: Vn100Sample) -> Vn100Sample:
        seen.append(sample)
        true.append(lock.hardware.world.motion(lock.clock.now_ns()))
        return sample

    lock.hardware.unit.alter = note
    lock.release(0)
    lock.clock.sleep_until_ns(round(seconds * 1e9))
    return seen, true


def test_the_unit_in_orbit_measures_no_weight_and_has_the_noise_of_the_data_sheet() -> None:
    seen, _ = measured(ImuNoise(profile="datasheet"), 10.0)
    accelerations = np.array([sample.accel for sample in seen])
    assert np.abs(accelerations).max() < 0.1
    assert np.abs(accelerations).max() > 1e-3
    rates = np.array([sample.rate for sample in seen])
    assert np.std(np.diff(rates, axis=0)) / np.sqrt(2.0) == pytest.approx(6.1e-4, rel=0.2)


def test_the_attitude_of_the_unit_is_valid_on_the_thread_and_meaningless_in_orbit() -> None:
    def errors(world: str) -> FloatArray:
        """Return the rotations (n, 4) from the true attitude to the attitude that the IMU measures."""
        pairs = zip(*measured(ImuNoise(), 20.0, world), strict=True)
        more = [quaternion.multiply(quaternion.conjugate(t.quaternion), m.quaternion) for m, t in pairs]
        return np.array(more)

    lost, found = errors("free_body"), errors("testbed")
    assert quaternion.angle_between(lost[0], lost[-1]) > 0.1
    assert quaternion.angle_between(lost[0], found[0]) > 0.1
    assert quaternion.angle_between(found[:1], found).max() < 1e-6


def test_the_magnetometer_has_its_bias() -> None:
    seen, true = measured(ImuNoise(field_bias=BIAS), 1.0)
    np.testing.assert_allclose(1e-4 * seen[-1].mag, true[-1].field_body + np.array(BIAS), atol=1e-12)


def test_the_unit_has_the_errors_that_its_calibration_describes() -> None:
    gyro = ((1.01, 0.002, 0.0), (0.0, 0.99, -0.003), (0.001, 0.0, 1.0))
    config = demo_config(10.0, camera=False)
    known = UnitCalibration(gyro_matrix=gyro, field_bias=BIAS)
    unit = reader.replace(config.inertial_unit, calibration=known)
    seen, true = measured(ImuNoise(), 1.0, config=reader.replace(config, inertial_unit=unit))
    np.testing.assert_allclose(seen[-1].rate, np.array(gyro) @ true[-1].rate, rtol=1e-5)
    np.testing.assert_allclose(1e-4 * seen[-1].mag, true[-1].field_body + np.array(BIAS), atol=1e-12)


NONE: tuple[Vector, Vector, Vector] = ((0.0, 0.0, 0.0),) * 3
UNEQUAL: tuple[Vector, Vector, Vector] = ((5e-4, 1e-4, 0.0), (0.0, 4e-4, 0.0), (-2e-4, 0.0, 3e-4))


def gauss(coil_field: tuple[Vector, Vector, Vector], driven: bool) -> tuple[FloatArray, FloatArray]:
    """Return the last field (gauss) that the IMU measures at rest, and the coil currents (A)."""
    section = configuration.replace(demo_world(), coil_field=coil_field, current_noise=0.0)
    lock = build_lockstep(demo_config(10.0, camera=False), section, None, SimClock())
    seen: list[FloatArray] = []

    def note(measured: Vn100Sample) -> Vn100Sample:
        seen.append(measured.mag)
        return measured

    lock.hardware.unit.alter = note
    if driven:
        # Writes that wake the chip, and drive the input A of x for half a period and the input B of z for a
        # quarter.
        lock.hardware.bus.write_i2c_block_data(0x40, 0x00, [0x20])
        lock.hardware.bus.write_i2c_block_data(0x40, 0x06, [0, 0, 0, 8])
        lock.hardware.bus.write_i2c_block_data(0x40, 0x1A, [0, 0, 0, 4])
    lock.clock.sleep_until_ns(lock.clock.now_ns() + 100_000_000)
    return seen[-1], lock.hardware.circuit.currents()


def test_a_coil_field_or_a_resistance_without_a_value_for_each_coil_is_refused() -> None:
    rows = ((5e-4, 0.0, 0.0, 0.0), (0.0, 4e-4, 0.0, 0.0), (0.0, 0.0, 3e-4, 0.0))
    four = configuration.replace(demo_world(), coil_field=rows)
    with pytest.raises(
        ConfigError, match="coil_field: has 4 values in a row: give one value for each of the 3"
    ):
        build_lockstep(demo_config(10.0, camera=False), four, None, SimClock())
    two = configuration.replace(demo_world(), truth=Truth(resistance=(20.0, 20.0)))
    with pytest.raises(ConfigError, match=r"resistance: has 2 values: give one value for each of the 3"):
        build_lockstep(demo_config(10.0, camera=False), two, None, SimClock())


def test_the_coils_add_their_matrix_times_their_currents() -> None:
    alone, _ = gauss(UNEQUAL, driven=False)
    beside, currents = gauss(UNEQUAL, driven=True)
    full = 3.4 / 23.0
    assert currents == pytest.approx([full / 2, 0.0, -full / 4])
    assert beside - alone == pytest.approx(1e4 * np.array(UNEQUAL) @ currents, abs=1e-9)


def test_by_default_the_magnetometer_does_not_measure_the_field_of_the_coils() -> None:
    alone, _ = gauss(NONE, driven=False)
    beside, _ = gauss(NONE, driven=True)
    assert beside == pytest.approx(alone, abs=1e-9)


def test_the_defaults_are_the_published_ones() -> None:
    """The published defaults do not change, because simulations omit keys that have a default."""
    published = json.loads(Path(__file__).with_name("published_defaults.json").read_text(encoding="utf-8"))
    assert json.loads(json.dumps(defaults_of(settings))) == published
