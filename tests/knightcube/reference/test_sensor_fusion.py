"""Tests of attitudes from cameras and magnetometer, and of their fusion, with known errors of directions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import VectorObservation
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.reference.sensor_fusion import (
    GyroBiasFilter,
    KnownAttitude,
    SeparateAttitudes,
    SeparateDetermination,
    attitude_of,
    fuse,
)

S = 1_000_000_000
RATE = np.array([2e-3, -1.2e-3, 5e-4])
BIAS = np.array([2.0e-3, -1.5e-3, 1.0e-3])
SUN, START = np.array([0.6, 0.0, 0.8]), from_rotation_vector(np.array([0.4, -1.1, 0.3]))
SUN_SIGMA, FIELD_SIGMA, GYRO = 1e-3, 5e-3, 1.75e-4


def angle(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between two attitudes, rad."""
    return float(np.linalg.norm(to_rotation_vector(multiply(first, conjugate(second)))))


def test_equal_attitudes_share_the_difference_and_an_accurate_one_wins() -> None:
    turn, unit = np.array([0.02, 0.0, 0.0]), np.eye(3)
    first = KnownAttitude(START, 1e-4 * unit)
    other = multiply(from_rotation_vector(turn), START)
    equal = fuse(first, KnownAttitude(other, 1e-4 * unit))
    assert angle(equal.quaternion, START) == pytest.approx(0.01, rel=1e-6)
    assert equal.covariance == pytest.approx(0.5e-4 * unit)
    nearer = fuse(first, KnownAttitude(other, 1e-6 * unit))
    assert angle(nearer.quaternion, other) == pytest.approx(0.02 / 101.0, rel=1e-3)
    assert fuse(first, KnownAttitude()) is first
    assert fuse(KnownAttitude(), first) is first


def test_one_direction_gives_no_attitude() -> None:
    one = VectorObservation(SUN, SUN, 1e-6 * np.eye(3))
    assert not attitude_of([one]).known
    assert not attitude_of([one, one]).known


def _direction(
    truth: FloatArray, reference: FloatArray, sigma: float, rng: np.random.Generator
) -> VectorObservation:
    seen = attitude_matrix(truth) @ reference + sigma * rng.standard_normal(3)
    return VectorObservation(seen / np.linalg.norm(seen), reference, sigma**2 * np.eye(3))


def fly(seconds: int, sunlit: float) -> list[tuple[float, FloatArray, SeparateAttitudes]]:
    """Return times (s), true attitudes and results at 0.5 Hz. Sun and nadir are in view before `sunlit` s."""
    rng = np.random.default_rng(37)
    method = SeparateDetermination(GyroBiasFilter(GYRO, 3.5e-3, 2.5e-7))
    rows = []
    for number in range(10 * seconds):
        at = (number + 1) / 10.0
        noise = GYRO * math.sqrt(10.0) * rng.standard_normal(3)
        method.gyro(round(at * S), RATE + BIAS + noise)
        if number % 20 != 19:
            continue
        truth = multiply(from_rotation_vector(at * RATE), START)
        # The satellite moves by 0.065 deg/s along its orbit, and the field rotates at twice this rate.
        down = np.array([math.cos(1.14e-3 * at), math.sin(1.14e-3 * at), 0.0])
        field = np.array([math.cos(2.3e-3 * at), 0.3, math.sin(2.3e-3 * at)]) / math.hypot(1.0, 0.3)
        sun = _direction(truth, SUN, SUN_SIGMA, rng) if at < sunlit else None
        nadir = _direction(truth, down, SUN_SIGMA, rng) if at < sunlit else None
        magnetic = _direction(truth, field, FIELD_SIGMA, rng)
        rows.append((at, truth, method.update(round(at * S), sun, nadir, magnetic)))
    return rows


def test_the_filter_learns_the_gyro_bias_and_the_magnetometer_goes_on_without_cameras() -> None:
    rows = fly(500, 300.0)
    lit = [row for row in rows if 200.0 < row[0] < 300.0]
    for name, most in (("cameras", 3e-3), ("filtered", 1e-3)):
        errors = [angle(getattr(found, name).quaternion, truth) for _, truth, found in lit]
        assert math.sqrt(np.mean(np.square(errors))) < most
    assert np.abs(lit[-1][2].bias - BIAS).max() < 1e-4
    dark = [row for row in rows if row[0] > 350.0]
    assert not any(found.cameras.known for _, _, found in dark)
    magnetometer = [
        (angle(found.magnetometer.quaternion, truth), found.magnetometer.sigma) for _, truth, found in dark
    ]
    assert max(error for error, _ in magnetometer) < 0.05
    assert all(error < 4.0 * math.sqrt(3.0) * sigma for error, sigma in magnetometer)
    filtered = [angle(found.filtered.quaternion, truth) for _, truth, found in dark]
    assert math.sqrt(np.mean(np.square(filtered))) < 0.02
    assert [found.fused for _, _, found in dark] == [found.magnetometer for _, _, found in dark]


def test_one_field_alone_gives_no_attitude_at_the_start() -> None:
    first = fly(3, 0.0)
    assert not any(found.magnetometer.known for _, _, found in first)
    assert not any(found.filtered.known for _, _, found in first)


def test_a_drift_of_the_attitude_since_the_start_is_attributed_to_the_gyro_bias() -> None:
    """The gyro bias is the drift of the attitude since the start, divided by the time.

    Apart from their bias, the gyros are accurate.
    """
    filter_ = GyroBiasFilter(1e-9, 1e-2, 0.0)
    filter_.update(KnownAttitude(START, 1e-12 * np.eye(3)))
    for _ in range(10):
        filter_.propagate(from_rotation_vector(BIAS), 1.0)
    filter_.update(KnownAttitude(START, 1e-12 * np.eye(3)))
    assert angle(filter_.attitude.quaternion, START) < 1e-4
    assert filter_.bias == pytest.approx(BIAS, rel=0.01)
    assert filter_.bias_sigma < 1e-6
