"""The numbers of an Earth and Sun camera, and what follows from them alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, Self

import numpy as np

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import CameraModel, Lens, Pinhole

DEVICE = "Earth camera model"

# Each number's least and greatest value and its unit.
_LIMITS: dict[str, tuple[float, float, str]] = {
    "rows": (1, 16_384, "px"),
    "columns": (1, 16_384, "px"),
    "bits": (1, 16, "bit"),
    "decades": (0.1, 12.0, ""),
    "darkest": (1e-6, 1e3, ""),
    "sensitivity": (1e-3, 1e12, "e-"),
    "full_well": (1.0, 1e9, "e-"),
    "gain": (1e-3, 1e5, "e-/count"),
    "read_noise": (0.0, 1e5, "e-"),
    "pedestal": (0.0, 65_535.0, "counts"),
    "noise": (0.0, 1e4, "counts"),
    "fixed_pattern": (0.0, 1e4, "counts"),
    "response_spread": (0.0, 1.0, ""),
    "dead_pixels": (0, 1 << 20, "px"),
    "hot_pixels": (0, 1 << 20, "px"),
    "blur": (0.0, 10.0, "px"),
    "scatter": (0.0, 0.5, ""),
    "scatter_angle": (1e-4, 0.5, "rad"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EarthCameraModel:
    """A wide-angle CMOS camera; radiance is in units of a white matt surface's with the Sun overhead.

    Attributes:
        lens: where each pixel looks: a `Pinhole` or a `Lens` with its distortion.
        rows: pixels down, the lens's.
        columns: pixels across, the lens's.
        bits: depth of the conversion.
        response: "logarithmic" (counts in proportion to the logarithm of light plus `darkest`) or "linear".
        decades: of light from `darkest` to the highest count; logarithmic only.
        darkest: the radiance that the dark current is worth; logarithmic only.
        sensitivity: e- a frame from a radiance of one: exposure, aperture and efficiency; linear only.
        full_well: e- that a pixel holds; linear only.
        gain: e- a count; linear only.
        read_noise: e-, standard deviation; linear only.
        blooming: whether charge beyond the full well spills along its column; linear only.
        pedestal: counts of darkness.
        noise: counts, standard deviation, of each pixel, independent in each frame; logarithmic only.
        fixed_pattern: counts, standard deviation, of each pixel's own offset, as calibration left it.
        response_spread: relative standard deviation of each pixel's sensitivity; linear only.
        dead_pixels: how many read zero, whatever falls on them.
        hot_pixels: how many read a bright value of their own.
        seed: of the fixed pattern and of the dead and hot pixels' places.
        blur: px, standard deviation of the optics' Gaussian.
        scatter: share of the light that the optics scatter widely.
        scatter_angle: rad, where the scattered light has half its central radiance.

    Raises OutOfRange for numbers that cannot be, ValueError for a lens of another size.
    """

    lens: CameraModel
    rows: int = 512
    columns: int = 512
    bits: int = 8
    response: Literal["logarithmic", "linear"] = "logarithmic"
    decades: float = 6.0
    darkest: float = 0.01
    sensitivity: float = 16_000.0
    full_well: float = 20_000.0
    gain: float = 80.0
    read_noise: float = 20.0
    blooming: bool = False
    pedestal: float = 8.0
    noise: float = 0.7
    fixed_pattern: float = 1.0
    response_spread: float = 0.01
    dead_pixels: int = 10
    hot_pixels: int = 10
    seed: int = 0
    blur: float = 0.6
    scatter: float = 0.01
    scatter_angle: float = math.radians(0.5)

    def __post_init__(self) -> None:
        check_limits(DEVICE, self, _LIMITS)
        if self.response not in ("logarithmic", "linear"):
            raise ValueError(f"{DEVICE}: response = {self.response!r}: use logarithmic or linear")
        if (self.lens.rows, self.lens.columns) != (self.rows, self.columns):
            raise ValueError(
                f"{DEVICE}: {self.rows} x {self.columns} pixels behind a lens of "
                f"{self.lens.rows} x {self.lens.columns}: give both the same"
            )
        if self.pedestal >= self.highest_count:
            raise OutOfRange(DEVICE, "pedestal", self.pedestal, 0.0, self.highest_count - 1.0, "counts")
        if self.dead_pixels + self.hot_pixels > self.rows * self.columns:
            raise ValueError(f"{DEVICE}: more dead and hot pixels than pixels")

    @classmethod
    def fuga15d(
        cls,
        field_of_view: float = math.radians(67.0),
        centre: tuple[float, float] | None = None,
        k1: float = 0.0,
        k2: float = 0.0,
        **numbers: Any,
    ) -> Self:
        """Return the camera of Meller et al.: 512 x 512, 8 bits, logarithmic over six decades, 67 deg.

        `field_of_view` rad is the undistorted one, edge to edge; `k1`, `k2` and the axis's pixel `centre` are
        those of `knightcube.vision.camera.lens.Lens`; `numbers` are other attributes, `response="linear"`
        among them.
        """
        rows, columns = int(numbers.get("rows", 512)), int(numbers.get("columns", 512))
        ideal = Pinhole.from_field_of_view(columns, rows, field_of_view)
        lens = Lens(columns, rows, ideal.focal_length, centre or ideal.centre, k1, k2)
        return cls(lens=lens, **numbers)

    @property
    def highest_count(self) -> int:
        """The count at which the converter ends."""
        return int((1 << self.bits) - 1)

    @property
    def count_type(self) -> type[np.uint8] | type[np.uint16]:
        """The smallest unsigned integer that holds a count."""
        return np.uint8 if self.bits <= 8 else np.uint16

    @property
    def counts_per_decade(self) -> float:
        """How many counts ten times the light adds in the logarithmic camera."""
        return (self.highest_count - self.pedestal) / self.decades

    def ideal_counts(self, radiance: FloatArray) -> FloatArray:
        """Return the counts (...) of `radiance` (...), unrounded, of a pixel without noise or blemish."""
        light = np.asarray(radiance, dtype=float)
        if self.response == "logarithmic":
            counts = self.pedestal + self.counts_per_decade * np.log10(1.0 + light / self.darkest)
        else:
            counts = self.pedestal + np.minimum(light * self.sensitivity, self.full_well) / self.gain
        return np.asarray(np.clip(counts, 0.0, self.highest_count))

    def radiance_of(self, counts: FloatArray) -> FloatArray:
        """Return the radiance (...) that gives `counts` (...) in a pixel without noise or blemish."""
        above = np.asarray(counts, dtype=float) - self.pedestal
        if self.response == "logarithmic":
            return np.asarray(self.darkest * (10.0 ** (above / self.counts_per_decade) - 1.0))
        return np.asarray(above * self.gain / self.sensitivity)


def pixel_rays(lens: CameraModel) -> FloatArray:
    """Return the unit vectors (rows x columns, 3) in camera axes along which the pixels look; read-only."""
    return _pixel_rays(Lens.of(lens))


@lru_cache(maxsize=4)
def _pixel_rays(lens: Lens) -> FloatArray:
    rows, columns = np.mgrid[0 : lens.rows, 0 : lens.columns]
    rays = lens.unit_vectors(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    rays.setflags(write=False)
    return rays
