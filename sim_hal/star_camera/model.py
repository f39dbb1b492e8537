"""The parameters of a star camera, and the quantities derived from them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole

DEVICE = "star camera model"

HotPixel = tuple[int, int, float]
"""Column, row, and its dark current above its neighbours', e-/s."""

# Minimum, maximum and unit of each parameter.
_LIMITS: dict[str, tuple[float, float, str]] = {
    "columns": (1, 16_384, "px"),
    "rows": (1, 16_384, "px"),
    "field_of_view": (1e-4, 2.8, "rad"),
    "aperture": (1e-4, 10.0, "m"),
    "zero_magnitude_flux": (1.0, 1e13, "e-/s/m^2"),
    "read_noise": (0.0, 1e5, "e-"),
    "dark_current": (0.0, 1e8, "e-/s"),
    "gain": (1e-3, 1e5, "e-/count"),
    "pedestal": (0.0, 65_535.0, "counts"),
    "bits": (1, 16, "bit"),
    "full_well": (1.0, 1e9, "e-"),
    "psf_sigma": (0.2, 20.0, "px"),
    "line_time": (0.0, 0.01, "s"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StarCameraModel:
    """A star camera; the defaults are a CubeSat's, 1024 x 1024 over 20 degrees.

    Attributes:
        columns: pixels across.
        rows: pixels down.
        field_of_view: rad, across the columns, edge to edge.
        aperture: m, diameter.
        zero_magnitude_flux: e-/s per m^2 of aperture for V = 0 (Sease 2.7 corrected: 19,000 is per mm^2).
        read_noise: e-, standard deviation.
        dark_current: e-/s a pixel.
        gain: e- a count; the thesis calls it quantum efficiency.
        pedestal: counts added before the conversion, so that noise below zero survives it.
        bits: depth of the conversion.
        full_well: e- that a pixel holds.
        psf_sigma: px, standard deviation of the Gaussian blur.
        psf: "integrated" over each pixel, or "bilinear": placed on four pixels and blurred with a sampled
            3 x 3 kernel, as in the thesis (2.5, 2.6, 2.9).
        noise: "poisson" (with Gaussian read noise), or "uniform": the thesis's own draw (text at 2.11).
        hot_pixels: pixels of a dark current of their own.
        line_time: s from one row's exposure to the next one's; 0 is a global shutter.
        background_gradient: counts/px along x and along y of stray light, none in the darkest corner.
    """

    columns: int = 1024
    rows: int = 1024
    field_of_view: float = math.radians(20.0)
    aperture: float = 0.025
    zero_magnitude_flux: float = 1.9e10
    read_noise: float = 10.0
    dark_current: float = 50.0
    gain: float = 1.0
    pedestal: float = 100.0
    bits: int = 12
    full_well: float = 20_000.0
    psf_sigma: float = 1.0
    psf: Literal["integrated", "bilinear"] = "integrated"
    noise: Literal["poisson", "uniform"] = "poisson"
    hot_pixels: tuple[HotPixel, ...] = ()
    line_time: float = 0.0
    background_gradient: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check_limits(DEVICE, self, _LIMITS)
        for name, choices in (("psf", ("integrated", "bilinear")), ("noise", ("poisson", "uniform"))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{DEVICE}: {name} = {getattr(self, name)!r}: use {' or '.join(choices)}")
        for slope in self.background_gradient:
            if not -100.0 <= slope <= 100.0:
                raise OutOfRange(DEVICE, "background_gradient", slope, -100.0, 100.0, "counts/px")
        for column, row, current in self.hot_pixels:
            if not 0 <= column < self.columns:
                raise OutOfRange(DEVICE, "hot pixel's column", column, 0, self.columns - 1, "px")
            if not 0 <= row < self.rows:
                raise OutOfRange(DEVICE, "hot pixel's row", row, 0, self.rows - 1, "px")
            if not 0.0 <= current <= 1e8:
                raise OutOfRange(DEVICE, "hot pixel's dark current", current, 0.0, 1e8, "e-/s")

    @property
    def pinhole(self) -> Pinhole:
        """The camera's geometry (Sease 2.3, 2.4 corrected)."""
        return Pinhole.from_field_of_view(self.columns, self.rows, self.field_of_view)

    @property
    def highest_count(self) -> int:
        """The count at which the converter saturates."""
        return (1 << self.bits) - 1

    @property
    def count_type(self) -> type[np.uint8] | type[np.uint16]:
        """The smallest unsigned integer that holds a count."""
        return np.uint8 if self.bits <= 8 else np.uint16

    def exposure_within(self, span: float) -> float:
        """Return each row's exposure, s, when from the first row's start `span` s pass for them all.

        A rolling shutter takes rows times the line time beside the exposure. Raises OutOfRange when no time
        is left to expose.
        """
        readout = self.rows * self.line_time
        if not span > readout:
            raise OutOfRange(DEVICE, "the attitude history's length", span, readout, math.inf, "s")
        return span - readout

    def electrons(self, magnitudes: npt.ArrayLike, exposure: float) -> FloatArray:
        """Return the e- of sources of Johnson V `magnitudes` in `exposure` s (Sease 2.8, Pogson's scale)."""
        area = 0.25 * math.pi * self.aperture**2
        brightness = 10.0 ** (-0.4 * np.asarray(magnitudes, dtype=float))
        return np.asarray(self.zero_magnitude_flux * area * exposure * brightness)


def scatter_hot_pixels(
    model: StarCameraModel, count: int, mean_current: float, rng: np.random.Generator
) -> StarCameraModel:
    """Return `model` with `count` hot pixels at random places, their currents exponential, mean in e-/s."""
    places = rng.choice(model.columns * model.rows, size=count, replace=False)
    currents = rng.exponential(mean_current, size=count)
    hot = tuple(
        (int(place % model.columns), int(place // model.columns), float(current))
        for place, current in zip(places, currents, strict=True)
    )
    return replace(model, hot_pixels=hot)
