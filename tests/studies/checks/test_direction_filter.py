"""Tests of the filter of Meller et al., Fig. 3: start, operation with lost sensors, reported accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
)
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector
from knightcube.gnc.estimation.estimate import ATTITUDE, BIAS
from tests.studies.campaigns.direction_filter import (
    AttitudeDetermination,
    Report,
    Status,
    field_bias,
)
from tests.studies.campaigns.orbit_attitude import settings_of
from tests.support.orbit_geometry import suite

SETTINGS = settings_of(suite("uw"))
SECOND = 1_000_000_000
SIGMA = np.radians(0.02)
SUN: FloatArray = np.array([0.6, -0.48, 0.64])
NADIR: FloatArray = np.array([0.0, 0.8, 0.6])
FIELD: FloatArray = np.array([1e-5, 2.5e-5, -1e-5])
RATE: FloatArray = np.array([2e-4, -1.1e-3, 4e-4])
START: FloatArray = np.array([0.1, 0.7, -0.1, 0.7]) / 1.0
ALL = frozenset({"sun", "nadir", "field"})


class Sky:
    """A body that rotates at a constant rate under a fixed Sun, Earth and field."""

    def __init__(self, seed: int = 1) -> None:
        self._rng = np.random.default_rng(seed)
        self.bias = np.array([2e-3, -1e-3, 3e-3])
        self.hard_iron = np.array([3e-7, -2e-7, 1e-7])

    def attitude(self, seconds: float) -> FloatArray:
        return multiply(from_rotation_vector(RATE * seconds), START / np.linalg.norm(START))

    def show(
        self, estimator: AttitudeDetermination, seconds: float, sensors: frozenset[str], gyro: bool = True
    ) -> None:
        """Give the filter the measurements of the named sensors."""
        now_ns = round(seconds * SECOND)
        turn = attitude_matrix(self.attitude(seconds))
        if gyro:
            noise = SETTINGS.rate_sigma * self._rng.standard_normal(3)
            estimator.rate(now_ns - SECOND // 4, RATE + self.bias + noise)
        for name, reference in (("sun", SUN), ("nadir", NADIR)):
            if name in sensors:
                seen = turn @ reference + SIGMA * self._rng.standard_normal(3)
                estimator.direction(
                    name, now_ns, seen / np.linalg.norm(seen), reference, SIGMA**2 * np.eye(3)
                )
        if "field" in sensors and seconds % 1.0 == 0.0:
            noise = SETTINGS.field_sigma * self._rng.standard_normal(3)
            estimator.field(now_ns, turn @ FIELD + self.hard_iron + noise, FIELD)

    def fly(
        self,
        estimator: AttitudeDetermination,
        begin: float,
        end: float,
        sensors: frozenset[str],
        gyro: bool = True,
    ) -> Report:
        """Give the filter measurements twice a second, and return its report at the end."""
        for half in range(round(2 * begin), round(2 * end)):
            self.show(estimator, 0.5 * half, sensors, gyro)
        return estimator.report(round((end - 0.5) * SECOND))

    def errors(self, report: Report) -> FloatArray:
        """Return the attitude error (3,) in units of its claimed sigma."""
        assert report.estimate is not None
        truth = self.attitude(report.time_ns / SECOND)
        return rotation_vector(multiply(truth, conjugate(report.estimate.quaternion))) / report.sigma


def begun(sensors: frozenset[str] = ALL, seconds: float = 60.0) -> tuple[Sky, AttitudeDetermination]:
    """Return a sky, and a filter that has received its measurements for some time."""
    sky, estimator = Sky(), AttitudeDetermination(SETTINGS)
    sky.fly(estimator, 0.0, seconds, sensors)
    return sky, estimator


@pytest.mark.parametrize("pair", [{"sun", "nadir"}, {"sun", "field"}, {"nadir", "field"}])
def test_any_two_of_three_begin_honestly(pair: set[str]) -> None:
    """Check the NEES over 24 seeds, of the first attitude and of the attitude 15 s later (99.9 % band)."""
    for seconds in (1.5, 15.0):
        total = 0.0
        for seed in range(24):
            sky, estimator = Sky(seed), AttitudeDetermination(SETTINGS)
            # Each seed has another hard iron bias and gyro bias.
            rng = np.random.default_rng(1000 + seed)
            sky.hard_iron = SETTINGS.field_bias_start * rng.standard_normal(3)
            sky.bias = SETTINGS.bias_start * rng.standard_normal(3)
            report = sky.fly(estimator, 0.0, seconds, frozenset(pair))
            assert report.estimate is not None
            truth = sky.attitude(report.time_ns / SECOND)
            off = rotation_vector(multiply(truth, conjugate(report.estimate.quaternion)))
            total += float(off @ np.linalg.solve(report.estimate.covariance[ATTITUDE, ATTITUDE], off))
        low, high = chi2.ppf([0.0005, 0.9995], 3 * 24)
        assert low < total < high


def test_directions_that_contradict_each_other_begin_nothing() -> None:
    """The angle between Sun and nadir is wrong by 3 deg, with sigmas of 0.02 deg."""
    sky, estimator = Sky(), AttitudeDetermination(SETTINGS)
    estimator.rate(0, RATE)
    turn = attitude_matrix(sky.attitude(0.0))
    wrong = attitude_matrix(from_rotation_vector(np.radians(3.0) * np.cross(SUN, NADIR))) @ SUN
    estimator.direction("sun", 0, turn @ wrong, SUN, SIGMA**2 * np.eye(3))
    estimator.direction("nadir", 0, turn @ NADIR, NADIR, SIGMA**2 * np.eye(3))
    assert estimator.report(0).status is Status.ACQUIRING
    estimator.direction("sun", 0, turn @ SUN, SUN, SIGMA**2 * np.eye(3))
    assert estimator.report(0).status is Status.OBSERVED


@pytest.mark.parametrize(
    ("left", "status"),
    [
        ({"nadir", "field"}, Status.OBSERVED),
        ({"sun"}, Status.AIDED),
        ({"field"}, Status.AIDED),
        (set(), Status.COASTING),
    ],
)
def test_without_what_is_lost_it_goes_on_and_says_how_well(left: set[str], status: Status) -> None:
    sky, estimator = begun(seconds=120.0)
    before = estimator.report(round(119.5 * SECOND))
    report = sky.fly(estimator, 120.0, 420.0, frozenset(left))
    assert (report.status, report.in_use) == (status, frozenset(left))
    assert np.all(np.abs(sky.errors(report)) < 4.0)
    if status is Status.COASTING:
        assert np.all(report.sigma > 5.0 * before.sigma)
    elif status is Status.AIDED and "sun" in left:
        # The attitude across the Sun direction remains accurate; the rotation about it drifts.
        assert report.estimate is not None
        about = attitude_matrix(report.estimate.quaternion) @ SUN
        spread = report.estimate.covariance[ATTITUDE, ATTITUDE]
        along = float(about @ spread @ about)
        assert along > 20.0 * 0.5 * float(np.trace(spread) - along)
    assert np.max(np.degrees(report.sigma)) < 2.0


def test_without_gyros_the_body_s_own_inertia_carries_the_attitude() -> None:
    sky, estimator = begun(seconds=120.0)
    report = sky.fly(estimator, 120.0, 240.0, ALL, gyro=False)
    assert np.all(np.abs(sky.errors(report)) < 4.0)
    assert np.max(np.degrees(report.sigma)) < 0.05


def test_both_biases_are_found_and_so_is_how_well() -> None:
    sky, estimator = begun(seconds=240.0)
    report = estimator.report(240 * SECOND)
    assert report.estimate is not None
    spread = report.estimate.covariance[BIAS, BIAS]
    off = report.estimate.bias - sky.bias
    assert off @ np.linalg.solve(spread, off) < 16.3
    assert np.sqrt(np.max(np.diag(spread))) < 2e-5
    found, sigma = field_bias(report.estimate)
    assert np.all(np.abs(found - sky.hard_iron) < 4.0 * sigma)
    assert np.max(sigma) < 3e-8


def test_a_worthless_estimate_is_discarded_and_determination_restarts() -> None:
    sky, estimator = begun()
    restless = AttitudeDetermination(replace(SETTINGS, lost_sigma=np.radians(0.1)))
    sky.fly(restless, 0.0, 60.0, ALL)
    report = sky.fly(restless, 60.0, 500.0, frozenset())
    assert (report.status, report.estimate) == (Status.ACQUIRING, None)
    report = sky.fly(restless, 500.0, 502.0, ALL)
    assert restless.starts == 2
    assert np.all(np.abs(sky.errors(report)) < 4.0)
    assert estimator.starts == 1


def test_sensors_that_all_show_another_attitude_are_believed_in_the_end() -> None:
    """The body was rotated while no sensor was in use, so the filter's attitude is wrong."""
    sky, estimator = begun(seconds=30.0)
    turned = from_rotation_vector(np.array([0.0, 0.5, 0.0]))
    for half in range(60, 240):
        now_ns = half * SECOND // 2
        truth = multiply(turned, sky.attitude(0.5 * half))
        estimator.rate(now_ns, RATE + sky.bias)
        for name, reference in (("sun", SUN), ("nadir", NADIR)):
            seen = attitude_matrix(truth) @ reference
            estimator.direction(name, now_ns, seen, reference, SIGMA**2 * np.eye(3))
    assert estimator.starts == 2
    report = estimator.report(240 * SECOND // 2)
    assert report.estimate is not None
    assert float(angle_between(report.estimate.quaternion, multiply(turned, sky.attitude(120.0)))) < 1e-3
