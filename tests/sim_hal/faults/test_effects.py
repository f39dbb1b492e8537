"""Tests of the magnitude of the effects of faults on samples, lines and other emulated hardware."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flight.schema import reader as configuration
from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.clock import SimClock
from sim_hal.emulators.serial_line import LineFaults
from sim_hal.emulators.vn100_sensors import MessageData, Vn100Sample
from sim_hal.faults.catalogue import CATALOGUE, Bench, all_of, hold, no_removal
from sim_hal.rig import build_lockstep
from tests.sim_hal.faults.benches import bench_of
from tests.support.flights import demo_config, demo_world

SAMPLE = Vn100Sample(
    from_rotation_vector(np.array([0.1, -0.2, 0.3])),
    np.array([0.01, 0.02, 0.03]),
    np.array([0.2, -0.1, 0.4]),
    np.array([0.0, 0.1, -9.8]),
)


@pytest.fixture(scope="module")
def bench() -> Bench:
    """Return the devices of the demonstration. Every test removes its fault at the end."""
    lock = build_lockstep(configuration.replace(demo_config(10.0)), demo_world(), None, SimClock())
    return bench_of(lock)


def altered(bench: Bench, name: str, samples: list[Vn100Sample], **given: float) -> list[Vn100Sample]:
    """Return IMU samples while a fault is active."""
    kind = CATALOGUE[name]
    assert kind.begin is not None
    remove = kind.begin(bench, kind, given)
    alter = bench.hardware.unit.alter
    assert alter is not None
    found = [alter(sample) for sample in samples]
    remove()
    assert bench.hardware.unit.alter is None
    return found


def test_a_wrong_unit_turns_about_y_and_adds_to_the_rate_about_y(bench: Bench) -> None:
    (found,) = altered(bench, "imu: wrong", [SAMPLE], angle=0.2, rate=0.05)
    turn = np.array([0.0, np.sin(0.1), 0.0, np.cos(0.1)])
    np.testing.assert_allclose(found.quaternion, multiply(turn, SAMPLE.quaternion))
    np.testing.assert_allclose(found.rate, [0.01, 0.07, 0.03])
    np.testing.assert_array_equal(found.mag, SAMPLE.mag)


def test_a_stuck_unit_repeats_its_first_sample_and_a_stuck_magnetometer_only_its_field(bench: Bench) -> None:
    later = replace(SAMPLE, rate=SAMPLE.rate * 2, mag=SAMPLE.mag * 2)
    assert altered(bench, "imu: stuck", [SAMPLE, later]) == [SAMPLE, SAMPLE]
    first, second = altered(bench, "magnetometer: stuck", [SAMPLE, later])
    np.testing.assert_array_equal(first.mag, SAMPLE.mag)
    np.testing.assert_array_equal(second.mag, SAMPLE.mag)
    np.testing.assert_array_equal(second.rate, later.rate)


def test_a_dead_gyro_makes_only_the_rate_invalid(bench: Bench) -> None:
    (found,) = altered(bench, "imu: gyro-dead", [SAMPLE])
    assert np.isnan(found.rate).all()
    np.testing.assert_array_equal(found.quaternion, SAMPLE.quaternion)
    np.testing.assert_array_equal(found.mag, SAMPLE.mag)
    data = MessageData(0, found, 0, 0.025, 20.0, 101.0)
    rate = data.text("rate")
    assert all(math.isnan(float(value)) for value in rate), "the sentence contains numbers"
    assert data.text("mag") == ["+00.2000", "-00.1000", "+00.4000"]


def test_a_saturated_field_is_2_5_gauss_with_the_sign_of_each_axis(bench: Bench) -> None:
    (found,) = altered(bench, "magnetometer: saturated", [SAMPLE])
    np.testing.assert_array_equal(found.mag, [2.5, -2.5, 2.5])


def test_a_false_field_is_constant_and_has_the_given_strength(bench: Bench) -> None:
    found = altered(bench, "magnetometer: false", [SAMPLE, replace(SAMPLE, mag=np.zeros(3))], field=2e-5)
    added = found[1].mag
    assert np.linalg.norm(added) == pytest.approx(0.2)
    np.testing.assert_allclose(found[0].mag - SAMPLE.mag, added)


@pytest.mark.parametrize(
    ("name", "given", "faults"),
    [
        ("imu: silent", {}, LineFaults(silent=True)),
        ("imu: garbage", {}, LineFaults(garbage=True)),
        ("imu: slow", {"n": 8.0}, LineFaults(thinned=8)),
        ("imu: delayed", {"delay": 0.2}, LineFaults(delay_ns=200_000_000)),
        ("imu: bits", {"chance": 1e-3}, LineFaults(flip_probability=1e-3)),
        ("imu: cut", {"chance": 0.3}, LineFaults(cut_probability=0.3)),
    ],
)
def test_a_fault_of_the_line_has_its_effect_on_the_bytes_to_the_host(
    bench: Bench, name: str, given: dict[str, float], faults: LineFaults
) -> None:
    kind = CATALOGUE[name]
    assert kind.begin is not None
    remove = kind.begin(bench, kind, given)
    assert bench.line.to_host.faults == faults
    assert bench.line.to_device.faults == LineFaults()
    remove()
    assert bench.line.to_host.faults == LineFaults()


def test_of_two_faults_on_a_wire_the_stronger_counts(bench: Bench) -> None:
    wire = bench.line.to_host
    small = LineFaults(cut_probability=0.1, flip_probability=0.4, delay_ns=5, thinned=3)
    large = LineFaults(silent=True, cut_probability=0.3, flip_probability=0.2, delay_ns=9, thinned=2)
    removals = [bench.disturb(wire, small), bench.disturb(wire, large)]
    assert wire.faults == LineFaults(
        silent=True, cut_probability=0.3, flip_probability=0.4, delay_ns=9, thinned=3
    )
    removals[1]()
    assert wire.faults == small
    removals[0]()


class Part:
    """A test double of a device with one attribute."""

    level = 1


def test_an_attribute_is_held_until_the_removal_and_a_newer_value_stays() -> None:
    part = Part()
    remove = hold(part, "level", 5, 1)
    assert part.level == 5
    remove()
    assert part.level == 1
    remove = hold(part, "level", 5, 1)
    part.level = 7
    remove()
    assert part.level == 7
    assert hold(None, "level", 5, 1) is no_removal


def test_several_faults_are_removed_together() -> None:
    removed: list[int] = []
    all_of([lambda: removed.append(1), lambda: removed.append(2)])()
    assert removed == [1, 2]


def test_an_intermittent_fault_is_present_for_its_share_of_each_period() -> None:
    clock = SimClock()
    lock = build_lockstep(configuration.replace(demo_config(10.0)), demo_world(), None, clock)
    bench = bench_of(lock)
    kind = CATALOGUE["imu: intermittent"]
    assert kind.begin is not None
    remove = kind.begin(bench, kind, {"period": 0.4, "share": 0.25})
    seen = []
    for step in range(17):
        clock.sleep_until_ns(step * 50_000_000 + 10_000_000)
        seen.append(bench.line.to_host.faults.silent)
    assert seen == [step % 8 in {0, 1} for step in range(17)]
    remove()
    clock.sleep_until_ns(2_000_000_000)
    assert not bench.line.to_host.faults.silent
