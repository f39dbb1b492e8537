"""The VN-100 in orbit: it weighs nothing, and its own attitude has no meaning."""

from __future__ import annotations

import numpy as np
import pytest

from flight.schema import reader
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal import lockstep
from sim_hal.clock import SimClock
from sim_hal.emulators.vn100_sensors import Vn100Sample
from sim_hal.settings import FreeBodySection, ImuNoise, TipOff
from sim_hal.worlds.world import BodyMotion
from tests.support.flights import demo_config, demo_world

BIAS = (2e-6, -1e-6, 3e-6)


def measured(
    imu: ImuNoise, seconds: float, world: str = "free_body"
) -> tuple[list[Vn100Sample], list[BodyMotion]]:
    """Return what the unit sends at 40 Hz, and the true motion at each time."""
    body = FreeBodySection(release=TipOff(speed=0.02))
    section = reader.replace(demo_world(), world=world, free_body=body, imu=imu)
    lock = lockstep.build(demo_config(10.0, camera=False), section, None, SimClock())
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


def test_it_weighs_nothing_and_its_noise_is_the_data_sheets() -> None:
    seen, _ = measured(ImuNoise(profile="datasheet"), 10.0)
    accelerations = np.array([sample.accel for sample in seen])
    assert np.abs(accelerations).max() < 0.1
    assert np.abs(accelerations).max() > 1e-3
    rates = np.array([sample.rate for sample in seen])
    assert np.std(np.diff(rates, axis=0)) / np.sqrt(2.0) == pytest.approx(6.1e-4, rel=0.2)


def test_its_attitude_has_no_meaning_in_orbit_and_a_meaning_on_the_thread() -> None:
    def errors(world: str) -> FloatArray:
        """Return the attitudes that the unit has more than the body (n, 4)."""
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
