"""Tests of the settings of the star camera: defaults for a CubeSat camera, and the limits of each range."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import pytest

from hal.interfaces.errors import OutOfRange
from sim_hal.star_camera.image import StarCameraModel

DEFAULTS = {
    "columns": 1024, "rows": 1024, "field_of_view": math.radians(20.0), "aperture": 0.025,
    "zero_magnitude_flux": 1.9e10, "read_noise": 10.0, "dark_current": 50.0, "gain": 1.0, "pedestal": 100.0,
    "bits": 12, "full_well": 20_000.0, "psf_sigma": 1.0, "psf": "integrated", "noise": "poisson",
    "hot_pixels": (), "line_time": 0.0, "background_gradient": (0.0, 0.0),
}  # fmt: skip
RANGES = {
    "columns": (1, 16_384), "rows": (1, 16_384), "field_of_view": (1e-4, 2.8), "aperture": (1e-4, 10.0),
    "zero_magnitude_flux": (1.0, 1e13), "read_noise": (0.0, 1e5), "dark_current": (0.0, 1e8),
    "gain": (1e-3, 1e5), "pedestal": (0.0, 65_535.0), "bits": (1, 16), "full_well": (1.0, 1e9),
    "psf_sigma": (0.2, 20.0), "line_time": (0.0, 0.01),
}  # fmt: skip


def made(**changes: Any) -> StarCameraModel:
    """Return a star camera model."""
    return StarCameraModel(**changes)


def test_the_defaults_are_those_of_a_cubesats_camera() -> None:
    model = StarCameraModel()
    assert {field.name: getattr(model, field.name) for field in fields(model)} == DEFAULTS


@pytest.mark.parametrize("name", RANGES)
def test_a_value_may_lie_at_both_ends_of_its_range_and_not_beyond(name: str) -> None:
    low, high = RANGES[name]
    step = 1 if isinstance(low, int) else 1e-9
    for value, beyond in ((low, low - step), (high, high + step * max(1, high))):
        assert getattr(made(**{name: value}), name) == value
        with pytest.raises(OutOfRange):
            made(**{name: beyond})


@pytest.mark.parametrize(
    ("pixel", "possible"),
    [
        ((0, 0, 0.0), True), ((1023, 1023, 1e8), True), ((-1, 0, 1.0), False), ((1024, 0, 1.0), False),
        ((0, -1, 1.0), False), ((0, 1024, 1.0), False), ((0, 0, -1.0), False), ((0, 0, 1.01e8), False),
    ],
)  # fmt: skip
def test_a_hot_pixel_lies_on_the_sensor(pixel: tuple[int, int, float], possible: bool) -> None:
    if possible:
        assert made(hot_pixels=(pixel,)).hot_pixels == (pixel,)
        return
    with pytest.raises(OutOfRange):
        made(hot_pixels=(pixel,))


def test_stray_light_and_choices_are_checked() -> None:
    assert made(background_gradient=(-100.0, 100.0)).background_gradient == (-100.0, 100.0)
    for slope in (-100.1, 100.1):
        with pytest.raises(OutOfRange):
            made(background_gradient=(0.0, slope))
    for name in ("psf", "noise"):
        with pytest.raises(ValueError, match=name):
            made(**{name: "other"})


def test_counts_electrons_and_exposures_follow_from_the_model() -> None:
    assert (made(bits=8).highest_count, made(bits=12).highest_count) == (255, 4095)
    assert [made(bits=bits).count_type.__name__ for bits in (8, 9, 16)] == ["uint8", "uint16", "uint16"]
    area = math.pi * 0.0125**2
    assert made().electrons(0.0, 2.0) == pytest.approx(1.9e10 * area * 2.0)
    assert made().electrons([5.0], 1.0)[0] == pytest.approx(1.9e8 * area)
    rolling = made(rows=100, line_time=1e-3)
    assert rolling.exposure_within(0.3) == pytest.approx(0.2)
    with pytest.raises(OutOfRange):
        rolling.exposure_within(0.1)
