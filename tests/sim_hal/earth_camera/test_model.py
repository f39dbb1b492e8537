"""Tests of the settings of the Earth camera: defaults, and the limits of each range."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import pytest

from hal.interfaces.errors import OutOfRange
from knightcube.vision.camera.lens import Pinhole
from sim_hal.earth_camera.image import EarthCameraModel

DEFAULTS = {
    "rows": 512, "columns": 512, "bits": 8, "response": "logarithmic", "decades": 6.0, "darkest": 0.01,
    "sensitivity": 16_000.0, "full_well": 20_000.0, "gain": 80.0, "read_noise": 20.0, "blooming": False,
    "pedestal": 8.0, "noise": 0.7, "fixed_pattern": 1.0, "response_spread": 0.01, "dead_pixels": 10,
    "hot_pixels": 10, "seed": 0, "blur": 0.6, "scatter": 0.01, "scatter_angle": math.radians(0.5),
}  # fmt: skip
RANGES = {
    "bits": (1, 16), "decades": (0.1, 12.0), "darkest": (1e-6, 1e3), "sensitivity": (1e-3, 1e12),
    "full_well": (1.0, 1e9), "gain": (1e-3, 1e5), "read_noise": (0.0, 1e5),
    "noise": (0.0, 1e4), "fixed_pattern": (0.0, 1e4), "response_spread": (0.0, 1.0),
    "dead_pixels": (0, 1 << 20), "hot_pixels": (0, 1 << 20), "blur": (0.0, 10.0), "scatter": (0.0, 0.5),
    "scatter_angle": (1e-4, 0.5),
}  # fmt: skip


def made(**changes: Any) -> EarthCameraModel:
    """Return a camera model with a pinhole lens for the image size of the model."""
    size = changes.get("columns", 512), changes.get("rows", 512)
    return EarthCameraModel(lens=Pinhole.from_field_of_view(*size, 1.0), **changes)


def test_the_defaults_are_those_of_the_design() -> None:
    model = made()
    found = {field.name: getattr(model, field.name) for field in fields(model) if field.name in DEFAULTS}
    assert found == DEFAULTS


@pytest.mark.parametrize("name", RANGES)
def test_a_value_may_lie_at_both_ends_of_its_range_and_not_beyond(name: str) -> None:
    low, high = RANGES[name]
    step = 1 if isinstance(low, int) else 1e-9
    others: dict[str, Any] = {"bits": {"pedestal": 0.0}}.get(name, {})
    if name.endswith("_pixels"):
        others = {"rows": 2048, "columns": 2048}
    for value, beyond in ((low, low - step), (high, high + step * max(1, high))):
        assert getattr(made(**others, **{name: value}), name) == value
        with pytest.raises(OutOfRange):
            made(**others, **{name: beyond})


def test_the_pedestal_leaves_a_count_for_the_light() -> None:
    for pedestal in (0.0, 254.0):
        assert made(pedestal=pedestal).pedestal == pedestal
    for pedestal in (-1e-9, 255.0):
        with pytest.raises(OutOfRange):
            made(pedestal=pedestal)
