"""Cramer-Rao bound of streaks: no unbiased estimator has a smaller covariance.

The electrons of a pixel are Poisson distributed, and the read noise is Gaussian. The Fisher information of
parameters p is the sum over pixels of (dm/dp)(dm/dp)^T / (floor + m), with the mean signal m and the variance
`floor` of all other noise (read noise squared, dark current, rounding). The signal comes from a point that
moves at a constant rate, with a Gaussian point spread integrated over each pixel. The signal is integrated by
Gauss-Legendre quadrature in time, exact to rounding, and independent of the faster model that the estimator
fits. Position, flux and background of every star are unknown, and optionally also the common width of the
point spread. The signal of one star in the pixels of another is ignored, which can only make the bound too
low.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.geometry import paths, sensitivities

# Number of parameters that stars share: rotation (3) and point spread. Each star also has position (2),
# electrons and background as parameters.
_SHARED = 4
_ALONE = 4
_REACH_SIGMAS = 6.0
_PIECE = 40


@dataclass(frozen=True, slots=True, eq=False)
class RateBound:
    """Cramer-Rao bounds of one frame.

    Attributes:
        covariance: smallest covariance (3, 3), rad^2/s^2, of the rate, camera frame.
        positions: smallest covariance (n, 2, 2), px^2, of each star's position at mid-exposure.
    """

    covariance: FloatArray
    positions: FloatArray


def rate_bound(
    pinhole: Pinhole,
    stars: FloatArray,
    electrons: FloatArray,
    rate: FloatArray,
    exposure: float,
    psf_sigma: float,
    floor: float,
    fit_psf: bool = True,
) -> RateBound:
    """Return the bound on the rate (3,), rad/s, from stars at pixels `stars` (n, 2) at mid-exposure.

    `electrons` (n,) are counted over the whole exposure. `floor` is the variance of other noise, e-^2 per
    pixel. Raises numpy.linalg.LinAlgError if the stars do not determine the rate.
    """
    motion = CameraMotion.steady(np.asarray(rate) * exposure)
    shared = np.zeros((_SHARED, _SHARED))
    parts = []
    for star, light in zip(stars, electrons, strict=True):
        information = star_information(pinhole, motion, star, float(light), psf_sigma, floor)
        alone = np.linalg.pinv(information[_SHARED:, _SHARED:], hermitian=True)
        gain = information[:_SHARED, _SHARED:] @ alone
        shared += information[:_SHARED, :_SHARED] - gain @ information[_SHARED:, :_SHARED]
        parts.append((alone, gain))
    kept = _SHARED if fit_psf else 3
    covariance = np.zeros((_SHARED, _SHARED))
    covariance[:kept, :kept] = _inverse(shared[:kept, :kept])
    positions = [(alone + gain.T @ covariance @ gain)[:2, :2] for alone, gain in parts]
    return RateBound(covariance[:3, :3] / exposure**2, np.array(positions).reshape(-1, 2, 2))


def endpoint_bound(
    length: float, electrons: float, psf_sigma: float, floor: float, angle: float = 0.0, fit_psf: bool = False
) -> tuple[float, float]:
    """Return the bounds (px) of an end point of an isolated straight streak, along and across the streak.

    Both ends, `electrons` and background are unknown. `angle` (rad) is the angle between streak and rows. The
    bounds are averaged over the positions of the ends within a pixel.
    """
    phases = np.array([[0.0, 0.0], [0.3, 0.7], [0.5, 0.2], [0.8, 0.4]])
    variance = np.zeros(2)
    direction = np.array([math.cos(angle), math.sin(angle)])
    axes = np.stack([direction, np.array([-direction[1], direction[0]])])
    for phase in phases:
        node, weight = _quadrature(length, psf_sigma)
        mean = np.asarray(phase)
        points = mean + length * node[:, None] * direction
        # Derivatives of each point with respect to the first end (x, y) and the last end (x, y).
        blend = np.zeros((len(node), 2, 4))
        blend[:, 0, 0] = blend[:, 1, 1] = 0.5 - node
        blend[:, 0, 2] = blend[:, 1, 3] = 0.5 + node
        images = _images(points, weight, blend, psf_sigma, electrons, None)
        information = _information(images, electrons, floor)
        # Order of the parameters: ends (4), point spread, electrons, background.
        kept = [0, 1, 2, 3, *([4] if fit_psf else []), 5, 6]
        covariance = _inverse(information[np.ix_(kept, kept)])
        for end in (0, 2):
            block = covariance[end : end + 2, end : end + 2]
            variance += np.einsum("ai,ij,aj->a", axes, block, axes)
    along, across = np.sqrt(variance / (2 * len(phases)))
    return float(along), float(across)


def star_information(
    pinhole: Pinhole, motion: CameraMotion, star: FloatArray, electrons: float, psf_sigma: float, floor: float
) -> FloatArray:
    """Return the Fisher information (8, 8) of one star.

    The parameters are rotation (3), rad; PSF sigma, px; position (2), px; electrons; background. `star` (2,)
    is the pixel at mid-exposure. Signal off the detector gives no information.
    """
    ends = paths(pinhole, motion, np.tile(star, (9, 1)), np.linspace(-0.5, 0.5, 9))
    length = float(np.sum(np.hypot(*np.diff(ends.position, axis=0).T)))
    node, weight = _quadrature(1.3 * length, psf_sigma)
    stars = np.tile(star, (len(node), 1))
    points = paths(pinhole, motion, stars, node).position
    change = sensitivities(pinhole, motion, stars, node)[:, :, [0, 1, 2, 6, 7]]
    images = _images(points, weight, change, psf_sigma, electrons, (pinhole.rows, pinhole.columns))
    if images.shape[1] == 0:
        return np.zeros((_SHARED + _ALONE, _SHARED + _ALONE))
    # Order of the result of _images: rotation (3), x, y, point spread, electrons, background.
    order = [0, 1, 2, 5, 3, 4, 6, 7]
    return _information(images, electrons, floor)[np.ix_(order, order)]


def _quadrature(length: float, psf_sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return times (m,) from -1/2 to 1/2 and normalised weights, for a path of `length` px."""
    pieces = max(1, math.ceil(length / (4.0 * psf_sigma)))
    node, weight = np.polynomial.legendre.leggauss(10)
    times = (np.arange(pieces)[:, None] + 0.5 * (node + 1.0)) / pieces - 0.5
    return times.reshape(-1), np.tile(0.5 * weight / pieces, pieces)


def _images(
    points: FloatArray,
    weight: FloatArray,
    change: FloatArray,
    sigma: float,
    electrons: float,
    shape: tuple[int, int] | None,
) -> FloatArray:
    """Return the derivatives (k + 3, pixels) of the signal with respect to k + 3 parameters.

    The parameters are k path parameters, sigma, electrons and background.

    The row of `electrons`, multiplied by `electrons`, is the signal itself. Each of the `points` (m, 2) has a
    fraction `weight` (m,) of the signal; `change` (m, 2, k) are the derivatives of the points with respect to
    the path parameters.
    """
    reach = math.ceil(_REACH_SIGMAS * sigma) + 1
    low, high = np.floor(points.min(axis=0)).astype(int), np.ceil(points.max(axis=0)).astype(int)
    low, high = low - reach, high + reach
    if shape is not None:
        low, high = np.maximum(low, 0), np.minimum(high, np.array(shape[::-1]) - 1)
    if np.any(low > high):
        return np.zeros((change.shape[2] + 3, 0))
    rows = np.zeros((change.shape[2] + 3, high[1] - low[1] + 1, high[0] - low[0] + 1))
    # The path is processed in short segments, because the signal of a short segment is in a small patch of
    # pixels.
    for start in range(0, len(points), _PIECE):
        piece = slice(start, start + _PIECE)
        near, far = points[piece].min(axis=0), points[piece].max(axis=0)
        first = np.maximum(np.floor(near).astype(int) - reach, low)
        last = np.minimum(np.ceil(far).astype(int) + reach, high)
        if np.any(first > last):
            continue
        x, dx, sx = _profile(np.arange(first[0], last[0] + 1), points[piece, 0], sigma)
        y, dy, sy = (part.T for part in _profile(np.arange(first[1], last[1] + 1), points[piece, 1], sigma))
        patch = rows[:, first[1] - low[1] : last[1] - low[1] + 1, first[0] - low[0] : last[0] - low[0] + 1]
        share = weight[piece]
        for k in range(change.shape[2]):
            patch[k] += electrons * ((share * change[piece, 0, k] * y) @ dx)
            patch[k] += electrons * ((share * change[piece, 1, k] * dy) @ x)
        patch[-3] += electrons * ((share * y) @ sx + (share * sy) @ x)
        patch[-2] += (share * y) @ x
    rows[-1] = 1.0
    stacked = rows.reshape(len(rows), -1)
    near = _near_path(stacked[-2])
    return np.asarray(stacked[:, near])


def _near_path(light: FloatArray) -> IntArray:
    """Return the pixels with a significant signal."""
    peak = light.max(initial=0.0)
    return np.flatnonzero(light > peak * math.exp(-0.5 * (_REACH_SIGMAS - 1.0) ** 2))


def _profile(
    pixels: FloatArray, place: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the fraction (m, p) of the signal per pixel, and its derivatives by position and sigma."""
    right = (pixels + 0.5 - place[:, None]) / sigma
    left = (pixels - 0.5 - place[:, None]) / sigma
    bell_right = np.exp(-0.5 * right**2) / math.sqrt(2.0 * math.pi)
    bell_left = np.exp(-0.5 * left**2) / math.sqrt(2.0 * math.pi)
    share = ndtr(right) - ndtr(left)
    return share, (bell_left - bell_right) / sigma, (left * bell_left - right * bell_right) / sigma


def _information(images: FloatArray, electrons: float, floor: float) -> FloatArray:
    """Return the sum over pixels of (dm/dp)(dm/dp)^T / variance."""
    return np.asarray((images / (floor + electrons * images[-2])) @ images.T)


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix whose parameters have very different scales."""
    scale = np.sqrt(np.diag(information))
    if not np.all(scale > 0.0):
        raise np.linalg.LinAlgError("a parameter has no information")
    scaled = information / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e14:
        raise np.linalg.LinAlgError("the stars do not fix the rate")
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))
