"""Tests of prior information and settings below and above their limits, and of the logarithmic response."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.vision.horizon.settings import (
    EdgeSettings,
    HorizonKnowledge,
    HorizonSettings,
    LogarithmicResponse,
    light_of,
)


def test_a_logarithmic_detector_adds_equal_counts_for_each_decade_of_light() -> None:
    """A logarithmic detector gives the same number of counts for each decade of light.

    With 50 counts per decade above 20, the tested counts correspond to 0, 9 and 99 times the dark current.
    """
    response = LogarithmicResponse(20.0, 50.0)
    counts = np.array([[20, 70, 120]], dtype=np.uint8)
    assert light_of(counts, response) == pytest.approx(np.array([[0.0, 9.0, 99.0]]))
    assert light_of(counts.astype(np.float64), response) == pytest.approx(np.array([[0.0, 9.0, 99.0]]))
    assert light_of(np.array([[255]], dtype=np.uint8), response)[0, 0] == pytest.approx(10.0**4.7 - 1.0)
    assert light_of(counts, None).tolist() == [[20.0, 70.0, 120.0]]


def test_a_camera_is_above_the_air() -> None:
    """A camera must be above the atmosphere, at an altitude of at least 50 km.

    The equatorial radius is 6,378.1 km.
    """
    HorizonKnowledge(position=np.array([0.0, 6_428.2e3, 0.0]), altitude=50e3)
    with pytest.raises(ValueError, match="inside the Earth"):
        HorizonKnowledge(position=np.array([0.0, 6_428.0e3, 0.0]))
    for altitude in (49.9e3, np.inf, np.nan):
        with pytest.raises(ValueError, match="metres above the Earth"):
            HorizonKnowledge(altitude=altitude)


@pytest.mark.parametrize(
    ("sound", "wrong"),
    [
        ({"lines": 2}, {"lines": 1}),
        ({"run": 1}, {"run": -1}),
        ({"run": 7}, {"run": 6}),
        ({"run": 3}, {"run": 0}),
    ],
)
def test_lines_and_windows_have_their_limits(sound: dict[str, int], wrong: dict[str, int]) -> None:
    EdgeSettings(**sound)  # type: ignore[arg-type]  # whole numbers only
    with pytest.raises(UsageError, match=next(iter(wrong))):
        EdgeSettings(**wrong)  # type: ignore[arg-type]  # whole numbers only


@pytest.mark.parametrize("name", ["threshold", "contrast"])
def test_fractions_lie_between_zero_and_one(name: str) -> None:
    for sound in (0.001, 0.999):
        EdgeSettings(**{name: sound})  # type: ignore[arg-type]  # fractions only
    for wrong in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(UsageError, match="between 0 and 1"):
            EdgeSettings(**{name: wrong})  # type: ignore[arg-type]  # fractions only


def test_the_range_of_altitudes_increases_from_fifty_kilometres() -> None:
    HorizonSettings(altitudes=(50e3, 51e3))
    with pytest.raises(UsageError, match="give finite numbers"):
        HorizonSettings(altitudes=(1e5, np.inf))
    for wrong in ((49e3, 1e6), (6e5, 6e5)):
        with pytest.raises(UsageError, match="give the lower altitude first, and at least 50 km"):
            HorizonSettings(altitudes=wrong)


@pytest.mark.parametrize("name", ["limb_height_sigma", "altitude_sigma", "tolerance"])
def test_assumed_errors_of_the_limb_are_positive(name: str) -> None:
    """A standard deviation of 0 would make the normal equations of the limb infinite."""
    HorizonSettings(**{name: 1e-3})  # type: ignore[arg-type]  # numbers only
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(UsageError, match=name):
            HorizonSettings(**{name: wrong})  # type: ignore[arg-type]  # numbers only


@pytest.mark.parametrize("name", ["uneven_limb_sigma", "sphere_sigma"])
def test_the_unevenness_of_the_limb_may_be_zero(name: str) -> None:
    HorizonSettings(**{name: 0.0})  # type: ignore[arg-type]  # numbers only
    with pytest.raises(UsageError, match=name):
        HorizonSettings(**{name: -1.0})  # type: ignore[arg-type]  # numbers only


@pytest.mark.parametrize(("name", "least"), [("least_edges", 3), ("candidates", 1), ("tries", 1)])
def test_a_search_for_a_horizon_needs_edges_and_trials(name: str, least: int) -> None:
    HorizonSettings(**{name: least})  # type: ignore[arg-type]  # whole numbers only
    with pytest.raises(UsageError, match=f"give at least {least}"):
        HorizonSettings(**{name: least - 1})  # type: ignore[arg-type]  # whole numbers only


@pytest.mark.parametrize(
    "wrong", [{"more_lines": 1}, {"most": 0}, {"psf_sigma": -0.1}, {"response": 5.0}], ids=str
)
def test_impossible_settings_of_edges_are_errors(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        EdgeSettings(**wrong)


def test_settings_of_a_wrong_type_are_errors() -> None:
    for wrong in ({"edges": None}, {"altitudes": 5}, {"altitudes": (1e5,)}):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            HorizonSettings(**wrong)
