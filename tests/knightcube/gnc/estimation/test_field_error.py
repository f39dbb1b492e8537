"""Tests that the filter estimates the error of the field model with stars, and covers it without stars."""

from __future__ import annotations

import copy
import math
from functools import cache

import numpy as np
import pytest

from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.quaternion import (
    IDENTITY,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.estimate import Knowledge
from knightcube.gnc.estimation.free_filter import (
    ATTITUDE,
    FIELD_MEMORY,
    MINIMUM_FIELD_ERROR,
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
)

INERTIA = np.diag([0.0066, 0.0333, 0.0333])
STEP, NOISE, STAR, GYRO = 5.0, 5e-8, 5e-5, 4e-5
IRON = np.array([2e-7, -1e-7, 1e-7])
SETTINGS = FreeFilterSettings()


class Sky:
    """A body at rest in a rotating field whose model has a Gauss-Markov error of `sigma` (T)."""

    def __init__(self, sigma: float, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.sigma, self.time = sigma, 0.0
        self.error = sigma * self.rng.standard_normal(3)
        self.filter = FreeFilter(INERTIA, SETTINGS)
        self.filter.start(IDENTITY, STAR**2 * np.eye(3), np.zeros(3))

    def fly(self, seconds: float, *, stars: bool) -> None:
        kept = math.exp(-STEP / FIELD_MEMORY)
        for k in range(round(seconds / STEP)):
            self.time += STEP
            turned = attitude_matrix(from_rotation_vector(np.array([0.0, 2.2e-3 * self.time, 0.0])))
            nothing = Pressures(np.zeros((1, 3)), np.zeros((1, 3)))
            here = FilterEnvironment(
                turned.T @ np.array([1e-5, 2e-5, 3e-5]), np.array([7e9, 0.0, 0.0]), nothing, 0.0
            )
            drawn = self.rng.standard_normal((4, 3))
            self.error = kept * self.error + self.sigma * math.sqrt(1.0 - kept**2) * drawn[0]
            self.filter.advance(STEP, np.zeros(3), here)
            self.filter.gyro(GYRO * drawn[1], GYRO**2 * np.eye(3))
            seen = here.field + IRON + self.error + NOISE * drawn[2]
            self.filter.field(seen, here.field, NOISE**2 * np.eye(3))
            if stars and k % 2 == 0:
                self.filter.attitude(from_rotation_vector(STAR * drawn[3]), STAR**2 * np.eye(3))


@cache
def flown_with_stars(sigma: float) -> Sky:
    """Return a body after 6,000 s with star attitudes. A test that continues the run must copy the body."""
    sky = Sky(sigma, 4)
    sky.fly(6_000.0, stars=True)
    return sky


@pytest.mark.parametrize("sigma", [1e-8, 5e-8, 1.5e-7])
def test_the_size_of_the_field_error_is_estimated_with_stars(sigma: float) -> None:
    sky = flown_with_stars(sigma)
    assert 0.5 * sigma < sky.filter.field_error < 1.6 * sigma + 2.0 * MINIMUM_FIELD_ERROR
    assert sky.filter.refused == 0


def test_without_a_fine_attitude_the_field_error_is_not_estimated() -> None:
    sky = Sky(3e-7, 4)
    sky.filter.start(IDENTITY, np.radians(2.0) ** 2 * np.eye(3), np.zeros(3))
    while sky.filter.knowledge is Knowledge.COARSE and sky.time < 1_000.0:
        assert sky.filter.field_error == SETTINGS.field
        sky.fly(STEP, stars=False)
    assert sky.time > 100.0


def test_a_contradicted_estimate_expects_the_error_of_the_start_again() -> None:
    sky = copy.deepcopy(flown_with_stars(1e-8))
    learned = sky.filter.field_error
    sky.filter.start(IDENTITY, STAR**2 * np.eye(3), np.zeros(3))
    assert sky.filter.field_error == learned < SETTINGS.field
    sky.filter.start(IDENTITY, STAR**2 * np.eye(3), np.zeros(3), doubted=True)
    assert sky.filter.field_error == SETTINGS.field


@pytest.mark.parametrize("sigma", [1e-8, 5e-8])
def test_without_stars_the_attitude_error_agrees_with_its_covariance(sigma: float) -> None:
    """After 1,000 s without stars, the attitude error agrees with its covariance.

    The body has five intervals without stars, each after 300 s with star attitudes.
    """
    nees, claims, sky = [], [], copy.deepcopy(flown_with_stars(sigma))
    for _ in range(5):
        sky.fly(300.0, stars=True)
        sky.fly(1_000.0, stars=False)
        off = to_rotation_vector(multiply(IDENTITY, conjugate(sky.filter.quaternion)))
        covariance = sky.filter.covariance[ATTITUDE, ATTITUDE]
        nees.append(float(off @ np.linalg.solve(covariance, off)) / 3.0)
        claims.append(math.sqrt(covariance.trace()))
    assert np.mean(nees) < 2.5, "99.9 % of a chi-square of 15 over 15"
    assert max(claims) < np.radians(0.6)
