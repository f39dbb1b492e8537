"""Tests of the identification of stars with a prior attitude."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.quaternion import (
    angle_between,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.vision.startracker.attitude_fit import MatchStatus
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.tracking import track
from tests.support.star_lists import ListKind, StarList, draw

SKY = default_index()


def _drawn(kind: ListKind, seed: int) -> StarList:
    return draw(kind, SKY.stars, np.random.default_rng([96, seed]))


@pytest.mark.parametrize("sigma_deg", [0.005, 0.02, 0.1, 0.3])
def test_a_prior_within_its_uncertainty_is_followed(sigma_deg: float) -> None:
    sigma = float(np.deg2rad(sigma_deg))
    for seed in range(20):
        drawn = _drawn(ListKind(noise_px=0.3, false_stars=3), seed)
        off = from_rotation_vector(sigma * np.random.default_rng(seed).standard_normal(3))
        found = track(drawn.field(), SKY, multiply(off, drawn.attitude), sigma)
        assert found.status is MatchStatus.IDENTIFIED, seed
        assert found.fix is not None
        assert angle_between(found.fix.quaternion, drawn.attitude) < 0.003
        matched = found.star >= 0
        assert np.mean(found.star[matched] == drawn.star[matched]) > 0.8


def test_a_prior_more_accurate_than_the_stars_does_not_make_a_match_more_certain() -> None:
    """The bound on chance matches is that of a prior as accurate as the star positions."""
    drawn = _drawn(ListKind(noise_px=0.3), 4)
    field = drawn.field()
    exact, alike = (track(field, SKY, drawn.attitude, sigma) for sigma in (0.0, float(field.sigma.min())))
    assert exact.status is alike.status is MatchStatus.IDENTIFIED
    assert exact.log10_false_alarm == pytest.approx(alike.log10_false_alarm)


def test_a_prior_of_another_direction_is_refused() -> None:
    for seed in range(60):
        drawn = _drawn(ListKind(noise_px=0.5, false_stars=5), seed)
        elsewhere = normalise(np.random.default_rng(seed).standard_normal(4))
        assert track(drawn.field(), SKY, elsewhere, np.deg2rad(0.3)).status is MatchStatus.NO_MATCH


def test_a_useless_prior_is_refused_in_limited_time() -> None:
    drawn = _drawn(ListKind(faintest=7.0), 1)
    assert track(drawn.field(), SKY, np.array([0.0, 0.0, 0.0, 1.0]), 0.2).status is MatchStatus.NO_MATCH


def test_three_stars_are_too_few_to_track() -> None:
    drawn = _drawn(ListKind(), 2)
    field = drawn.field().subset(np.arange(3))
    assert track(field, SKY, drawn.attitude, 0.001).status is MatchStatus.TOO_FEW_STARS
