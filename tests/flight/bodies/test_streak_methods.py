"""Tests that the corner-detector estimator has the settings of the camera that selects it."""

from __future__ import annotations

import pytest

from flight.bodies.streak_methods import CornerEstimator, corner_estimator
from flight.schema.devices import Camera
from knightcube.reference.corner_streaks import StreakSettings


def estimator(**values: object) -> CornerEstimator:
    """Return the rate estimator that a camera section with the given values selects."""
    made = corner_estimator(Camera(**{"columns": 512, "rows": 512, "field_of_view_deg": 20.0, **values}))  # type: ignore[arg-type]
    assert isinstance(made, CornerEstimator)
    return made


@pytest.mark.parametrize("name", ["harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"])
def test_without_further_values_the_settings_are_those_of_the_detector(name: str) -> None:
    expected = StreakSettings.of(name, saturation=4095.0, gain=2.5)  # type: ignore[arg-type]
    assert estimator(estimator=name, bits=12, gain=2.5).settings == expected


def test_given_saturation_and_bias_replace_those_of_format_and_detector() -> None:
    made = estimator(estimator="trajkovic-4", bits=12, saturation=900.0, endpoint_bias=0.0).settings
    assert (made.saturation, made.endpoint_bias) == (900.0, 0.0)
