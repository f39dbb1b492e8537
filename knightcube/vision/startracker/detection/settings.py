"""The settings of star detection: one frozen dataclass, defaults for a camera of which nothing is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

Method = Literal["psf", "window", "weighted", "gaussian", "iterative"]


CENTROIDS: tuple[Method, ...] = get_args(Method)


@dataclass(frozen=True, slots=True)
class DetectionSettings:
    """How stars are found and measured.

    Attributes:
        method: `psf` fits the point spread, `window` takes the centre of mass of eq. 12-21, the others weigh
            its pixels otherwise (`centroids`).
        threshold_sigmas: least height of a peak of the smoothed frame, over that frame's measured noise.
        most_stars: the brightest are kept, no more; no sixteenth of the frame gives more than its share
            (`selection`).
        psf_sigma: px; None measures it from the frame. Tracking frames hold few stars: give it there.
        gain: electrons per count; None measures it from the scatter of the stars' own pixels.
        saturation: counts at which a pixel clips; None for the frame's highest count where several pixels
            share it, else the top of the integer type.
        window: px, a_ROI of eq. 12-15, odd.
        search_radius: px, how far from its prediction `measure_near` looks for a star.
    """

    method: Method = "psf"
    threshold_sigmas: float = 5.0
    most_stars: int = 60
    psf_sigma: float | None = None
    gain: float | None = None
    saturation: float | None = None
    window: int = 7
    search_radius: float = 4.0

    def __post_init__(self) -> None:
        if self.method not in CENTROIDS:
            raise ValueError(f"method = {self.method!r}: use {', '.join(CENTROIDS)}")
        for name, low, high in (
            ("threshold_sigmas", 1.0, 100.0),
            ("most_stars", 1, 10_000),
            ("psf_sigma", 0.3, 6.0),
            ("gain", 1e-6, 1e6),
            ("saturation", 1e-6, 1e9),
            ("search_radius", 1.0, 50.0),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} = {value!r}: give {low} .. {high}")
        if self.window % 2 == 0 or not 5 <= self.window <= 31:
            raise ValueError(f"window = {self.window!r}: give an odd number of pixels, 5 .. 31")

    def in_units_of(self, unit: float) -> DetectionSettings:
        """Return the settings for a frame whose counts were divided by `unit`."""
        if unit == 1.0:
            return self
        saturation = None if self.saturation is None else self.saturation / unit
        return replace(self, saturation=saturation, gain=None if self.gain is None else self.gain * unit)
