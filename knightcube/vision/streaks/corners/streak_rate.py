"""The body rate from one long exposure: Sease chapters 3 and 4, corrected by the errata.

A frame becomes regions, regions streaks, streaks one rotation, the rotation over the exposure a rate. One
frame cannot distinguish omega from -omega; a prior (gyro, or the last estimate) decides. Pure and
deterministic, made for a worker process.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import saturation_level
from knightcube.vision.streaks.corners.rate_fit import fit_rotation
from knightcube.vision.streaks.corners.segmentation import Regions
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streaks import Streaks, measure_streaks, segment_frame
from knightcube.vision.streaks.streak_result import StreakResult, StreakStatus, admit, in_time, validate


def estimate_rate(
    pixels: Image,
    pinhole: Pinhole,
    exposure: float,
    settings: StreakSettings,
    prior_rate: FloatArray | None = None,
    prior_sigma: float = 0.0,
    previous_checksum: int | None = None,
) -> StreakResult:
    """Return the mean rate over one exposure from the star streaks in `pixels`.

    Args:
        pixels: (rows, columns) of an unsigned integer type, as the camera gave them.
        pinhole: the camera, of the same shape.
        exposure: s.
        settings: thresholds, kernels, compensation.
        prior_rate: (3,) rad/s, camera frame, from which only the direction of rotation is taken; None when
            unknown.
        prior_sigma: rad/s, standard deviation of each component of `prior_rate`.
        previous_checksum: of the frame before: the same pixels again are a frozen camera.

    Raises FlightError for a frame, exposure or prior that is impossible. A scene without a rate is reported
    by the status.
    """
    validate(pixels, pinhole, exposure, prior_rate, prior_sigma)
    saturation = saturation_level(pixels, settings.saturation)
    checksum, unusable = admit(pixels, previous_checksum, saturation, settings.saturated_fraction)
    if unusable is not None:
        return StreakResult(unusable, checksum, exposure)
    segmented = segment_frame(pixels, settings)
    seen = StreakResult(StreakStatus.FAILED, checksum, exposure, hot_pixels=segmented.hot_pixels)
    streaks = measure_streaks(segmented, settings)
    result = _rate(streaks, pinhole, exposure, settings, seen)
    if result.rate is not None:
        return in_time(result, prior_rate, prior_sigma, settings.sign_sigmas)
    typical = _typical_length(segmented.regions, settings)
    if typical < settings.least_length:
        # Stars nearly at rest: what looked like streaks were blends.
        return replace(result, status=StreakStatus.TOO_SHORT, length=typical)
    return result


def _rate(
    streaks: Streaks, pinhole: Pinhole, exposure: float, settings: StreakSettings, seen: StreakResult
) -> StreakResult:
    """Return `seen` with the rate that the streaks give, up to its sign, or why they give none."""
    seen = replace(
        seen,
        endpoints=streaks.endpoints,
        sigma=streaks.sigma,
        used=np.zeros(len(streaks), dtype=np.bool_),
        length=float(np.median(streaks.lengths)) if len(streaks) else float("nan"),
    )
    if len(streaks) < settings.least_streaks:
        return replace(seen, status=StreakStatus.TOO_FEW)
    fit = fit_rotation(streaks.endpoints, streaks.sigma, pinhole, settings)
    if fit is None or fit.residual * pinhole.focal_length > settings.worst_residual:
        return seen
    ends = fit.endpoints[fit.used]
    length = float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)))
    if length < settings.least_length:
        return replace(seen, status=StreakStatus.TOO_SHORT, length=length)
    return replace(
        seen,
        status=StreakStatus.AMBIGUOUS,
        length=length,
        endpoints=fit.endpoints,
        used=fit.used,
        rate=fit.rotation_vector / exposure,
        covariance=fit.covariance / exposure**2,
        residual=fit.residual,
    )


def _typical_length(regions: Regions, settings: StreakSettings) -> float:
    """Return the median length in px of the brightest regions, infinity when there are too few."""
    if len(regions) < settings.least_streaks:
        return float("inf")
    brightest = np.argsort(-regions.flux, kind="stable")[: settings.most_streaks]
    return float(np.median(regions.length[brightest]))
