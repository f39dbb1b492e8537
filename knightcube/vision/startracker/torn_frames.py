"""Frames of which a part of the rows is displaced, or shows the sky of another exposure.

If a packet is lost in the transfer of an image, the following pixels or rows are displaced. If a buffer is
read while it is overwritten, a part of the rows is from another exposure. The stars of such a frame show two
attitudes, and those of the larger part are not necessarily right. Two cases are recognised:

1. The unmatched bright points are stars at another attitude, and are in other rows than the matched stars.
   Ghosts, double exposures and defocused stars have stars of two attitudes in the same rows.

2. The displacement is so small that all stars match. Their residuals then have a step at one row.
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray, median
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_matrix
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, refine
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.lost_in_space import IdentificationSettings, identify
from knightcube.vision.startracker.tracking import track
from knightcube.vision.startracker.verification import expected_stars

# Standard deviations by which the number of runs in the sorted rows is below that of random rows.
_SEPARATED = 3.0
# Minimum number of stars at another attitude.
_FEWEST = 4
# Minimum distance of these stars along the rows if the lens was fitted, as a fraction of the image's width.
_LENS_WIDTH = 0.5
# Standard deviation (px) of the attitude in the search for another attitude near the first attitude.
_SIGMA_PX = 20.0
# Largest common displacement, as a fraction of the image's longer side, and its tolerance (px).
_REACH, _TOLERANCE_PX = 0.15, 1.5
# Largest distance (px) of a point from the predicted position of its star at the first attitude.
_SAME_PX = 0.7
# log10 of the probability of a common displacement of random points that is accepted.
_LOG10_CHANCE = -5.0
# Maximum number of pairs of a point and a predicted star, and of predicted stars.
_MOST_PAIRS, _MOST_EXPECTED = 1_500, 100
# Largest angle to a predicted attitude, in standard deviations about each axis.
_PRIOR_SIGMAS = 5.0
# Minimum position error (px) in the search for a step of the residuals.
_STEP_SIGMA_PX = 0.03
# Minimum increases of the log-likelihood by a step: relative to no step and to a smooth function of the row.
_EVIDENCE, _NOT_SMOOTH = 12.0, 4.0
# Largest median chi-square of stars whose displacement is explained by a step.
_EXPLAINED = 4.0
# Minimum number of stars on each side of a step, and in all if the lens was fitted.
_STEP_STARS, _LENS_STARS = 4, 20
_STEP_ROUNDS = 6


def separated(one: FloatArray, other: FloatArray) -> bool:
    """Return whether two sets of rows (n,) and (m,) are mixed significantly less than random rows.

    The test is that of Wald and Wolfowitz (1940) for the number of runs in the sorted rows.
    """
    total, product = len(one) + len(other), 2.0 * len(one) * len(other)
    if min(len(one), len(other)) < _FEWEST:
        return False
    owner = np.repeat([0, 1], [len(one), len(other)])[np.argsort(np.append(one, other), kind="stable")]
    runs, mean = 1 + np.count_nonzero(np.diff(owner)), 1.0 + product / total
    return bool(runs <= mean - _SEPARATED * math.sqrt((mean - 1.0) * (mean - 2.0) / (total - 1)))


def at_another_attitude(
    points: FloatArray,
    stars: StarField,
    rows: FloatArray,
    camera: CameraModel,
    fix: AttitudeFix,
    sky: SkyIndex,
    prior: tuple[FloatArray, float] | None,
    lens_fitted: bool,
) -> int:
    """Return the number of unmatched points that are stars at another attitude, in other rows; 0 if too few.

    Args:
        points: positions of the unmatched points (n, 2), px.
        stars: the unmatched points as star field.
        rows: rows of the matched points (m,), px.
        camera: camera with which the frame was solved.
        fix: attitude of the matched points.
        sky: sky index.
        prior: predicted attitude (4,) and its standard deviation about each axis, rad. Another attitude that
            is farther from the predicted attitude than `_PRIOR_SIGMAS` standard deviations is ignored.
        lens_fitted: whether the lens was fitted to the stars. Stars in a corner of the image are then
            possibly displaced by the lens, whereas a displaced part of the rows has the width of the image.
    """
    found = _with_common_shift(points, stars, camera, fix, sky)
    if found is None:
        match = track(stars, sky, fix.quaternion, _SIGMA_PX / camera.focal_length)
        if match.status is not MatchStatus.IDENTIFIED:
            match = identify(stars, sky, IdentificationSettings(mirror=False))
        if match.status is not MatchStatus.IDENTIFIED or match.fix is None:
            return 0
        found = np.flatnonzero(match.star >= 0), match.fix.quaternion
    star, quaternion = found
    if prior is not None and angle_between(quaternion, prior[0]) > _PRIOR_SIGMAS * prior[1]:
        return 0
    if lens_fitted and np.ptp(points[star, 0]) < _LENS_WIDTH * camera.columns:
        return 0
    return len(star) if separated(rows, points[star, 1]) else 0


def _with_common_shift(
    points: FloatArray, stars: StarField, camera: CameraModel, fix: AttitudeFix, sky: SkyIndex
) -> tuple[IntArray, FloatArray] | None:
    """Return the indices of the points that one shift moves to predicted stars, and their attitude (4,).

    Returns None if as many random points would have a common shift with a probability above `_LOG10_CHANCE`.
    Unlike an identification, a shift is significant even if most predicted stars of the frame are missing.
    """
    matrix, longer = attitude_matrix(fix.quaternion), max(camera.columns, camera.rows)
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    star = expected_stars(sky, matrix, half_width, _MOST_EXPECTED)
    shift = points[:, None] - camera.project(sky.stars.direction[star] @ matrix.T)
    distance = np.hypot(shift[..., 0], shift[..., 1])
    # A point near a predicted star is that star, with an error that is larger than expected.
    elsewhere = np.all(distance > _SAME_PX, axis=1, keepdims=True)
    one, two = np.nonzero(elsewhere & (distance < _REACH * longer))
    if not 0 < len(one) <= _MOST_PAIRS:
        return None
    apart = shift[one, two][:, None] - shift[one, two]
    near = np.hypot(apart[..., 0], apart[..., 1]) < _TOLERANCE_PX
    best = int(near.sum(axis=1).argmax())
    members = np.flatnonzero(near[best])
    members = members[np.unique(one[members], return_index=True)[1]]
    members = members[np.unique(two[members], return_index=True)[1]]
    others, mean = len(members) - 1, len(one) * (_TOLERANCE_PX / (_REACH * longer)) ** 2
    chance = math.log(len(one)) + others * math.log(mean) - math.lgamma(others + 1.0)
    if others < _FEWEST - 1 or chance > _LOG10_CHANCE * math.log(10.0):
        return None
    seen, guide = one[members], star[two[members]]
    moved = refine(stars.direction[seen], sky.stars.direction[guide], stars.sigma[seen], matrix, 1.0, False)
    return None if moved is None else (seen, from_matrix(moved.matrix))


def displacement(
    points: FloatArray, residual: FloatArray, covariance: FloatArray, camera: CameraModel, lens_fitted: bool
) -> FloatArray:
    """Return the displacement (2,), px, between the stars above and below a row, or zeros if not significant.

    A displacement that starts at one row is compared with no displacement and with polynomials of the row,
    which approximate distortion and motion of the camera during the readout. All are fitted to the residuals
    (n, 2), px, of the stars at `points` (n, 2), together with shift, rotation and scale. If the lens was
    fitted to the stars, the displacement has changed the lens, so that terms of the lens are fitted again.
    """
    none = np.zeros(2)
    if len(points) < (_LENS_STARS if lens_fitted else 2 * _STEP_STARS):
        return none
    variance = 0.5 * np.trace(covariance, axis1=1, axis2=2) + _STEP_SIGMA_PX**2
    order = np.argsort(points[:, 1], kind="stable")
    points, residual, variance = points[order], residual[order], variance[order]
    x, y = (2.0 * (points - np.array(camera.centre)) / max(camera.columns, camera.rows)).T
    pose = [*_both(np.ones(len(x))), np.stack([-y, x], axis=1), np.stack([x, y], axis=1)]
    smooth = [*_both(y**2), *_both(y**3)]
    if lens_fitted:
        shape = [np.stack([x, -y], axis=1), np.stack([y, x], axis=1), (x**2 + y**2)[:, None] * pose[3]]
        pose += [*shape, *_both(x**2), *_both(x * y), *_both(y**2)]
        smooth = [*_both(y**3), *_both(y**4)]
    least, *_ = _t_fit(pose, residual, variance)
    below = [np.arange(len(x)) >= first for first in range(_STEP_STARS, len(x) - _STEP_STARS + 1)]
    fits = [_t_fit([*pose, *_both(part.astype(float))], residual, variance) for part in below]
    best, found, square = max(fits, key=lambda fit: fit[0])
    if best - least < _EVIDENCE or median(square) > _EXPLAINED:
        return none
    even, *_ = _t_fit([*pose, *smooth], residual, variance)
    return found[-2:] if best - even > _NOT_SMOOTH else none


def _both(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return displacements (n, 2) by `values` (n,) along x, and along y."""
    return np.stack([values, 0.0 * values], axis=1), np.stack([0.0 * values, values], axis=1)


def _t_fit(
    columns: list[FloatArray], residual: FloatArray, variance: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Return the log-likelihood, parameters (k,) and chi-squares (n,) of a fit of k `columns` (n, 2).

    The residuals (n, 2) have a bivariate t-distribution with four degrees of freedom.
    """
    slopes = np.stack(columns, axis=2)
    square: FloatArray = np.zeros(len(residual))
    found: FloatArray = np.zeros(len(columns))
    for _ in range(_STEP_ROUNDS):
        root = np.sqrt(1.0 / (variance * (1.0 + 0.25 * square)))[:, None]
        rows = (slopes * root[..., None]).reshape(-1, len(columns))
        found = np.asarray(np.linalg.lstsq(rows, (residual * root).reshape(-1), rcond=None)[0], np.float64)
        square = np.sum((residual - slopes @ found) ** 2, axis=1) / variance
    return -3.0 * float(np.log1p(0.25 * square).sum()), found, square
