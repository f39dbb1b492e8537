"""The settings of the search for objects among the stars."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """Thresholds and limits of the search for objects.

    Attributes:
        bounds: standard deviations of centre, displacement and residual below which none fires, whatever the
            spread within the frame: `python -m tests.studies.bench.rso_spread`.
        strict: the thesis's 2.5 sigma, of the spread within the frame.
        psf_sigma: px, of the camera.
        most_streaks: how many regions are examined; the rate needs fewer.
        most_points: how many short regions are examined.
        most_merged: how many regions are searched for an object among the light of their stars.
        least_share: part of a region's light that an object beside stars must have: an error of the rotation
            of 2 % leaves that much at the end of a bright star's streak.
        most_corners: regions with more are left unclear.
        point_significance: least counts of a short region over the noise of its area.
        improvement: least gain in chi-square of an object over stars.
        crossing_improvement: the same for an object that crosses stars, the best of many lines tried.
        worst_fit: largest chi-square per pixel of an accepted object.
    """

    bounds: tuple[float, float, float] = (8.0, 10.0, 10.0)
    strict: float = 2.5
    psf_sigma: float = 1.0
    most_streaks: int = 80
    most_points: int = 20
    most_merged: int = 12
    least_share: float = 0.04
    most_corners: int = 6
    point_significance: float = 20.0
    improvement: float = 300.0
    crossing_improvement: float = 600.0
    worst_fit: float = 2.5
