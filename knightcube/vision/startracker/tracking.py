"""Identification of the stars of a frame with a prior attitude.

A prior attitude with a small error displaces all predicted stars by nearly the same vector. Pairs of an
observed and a predicted star are formed if their distance is within the uncertainty of the prior. The largest
set of pairs with a common displacement is used to refine the attitude. The refined attitude is verified with
the whole field as for an identification without a prior, except that only attitudes near the prior count as
searched.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, StarMatch, refine, stretched
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.verification import (
    VerificationSettings,
    expected_stars,
    nothing,
    verify,
)

PRIOR_SIGMAS = 4.0
"""Largest error of a prior attitude that a search near the prior covers, in standard deviations."""
_BRIGHTEST = 16
# Maximum number of pairs of an observed and a predicted star.
# A comparison of more pairs would be ambiguous and slower than a search of the whole sky.
_MOST_PAIRS = 400
_DEFAULT = VerificationSettings()


def track(
    field: StarField,
    sky: SkyIndex,
    attitude: FloatArray,
    sigma: float,
    settings: VerificationSettings = _DEFAULT,
) -> StarMatch:
    """Return the identification near a prior attitude, or NO_MATCH if the stars contradict the prior.

    The prior is the quaternion `attitude` (4,) from ICRS to camera axes, with the standard deviation `sigma`,
    rad, about each axis. If `sigma` exceeds some degrees, `identify` is faster and more reliable.
    """
    if len(field) < settings.least_matches:
        return nothing(field, MatchStatus.TOO_FEW_STARS)
    scale = math.sqrt(field.scale[0] * field.scale[1])
    matrix = attitude_matrix(attitude)
    observed, star = _same_shift(field, sky, matrix, scale, sigma)
    if len(observed) >= 2:
        free_scale = field.scale[1] > field.scale[0] and len(observed) > 2
        found = refine(
            field.direction[observed],
            sky.stars.direction[star],
            field.sigma[observed],
            matrix,
            scale,
            free_scale,
        )
        if found is not None:
            matrix, scale = found.matrix, found.scale
    # The searched fraction of attitudes is the volume of rotations near the prior, divided by 8 pi^2.
    # A prior that is more accurate than the direction of a star does not make this fraction smaller.
    reach = PRIOR_SIGMAS * max(sigma, float(field.sigma.min()))
    searched = min(reach**3 / (6.0 * math.pi), 1.0)
    return verify(field, sky, matrix, scale, searched, settings)


def _same_shift(
    field: StarField, sky: SkyIndex, matrix: FloatArray, scale: float, sigma: float
) -> tuple[IntArray, npt.NDArray[np.intp]]:
    """Return the indices of the largest set of observed and guide stars that one displacement explains."""
    reach = PRIOR_SIGMAS * sigma
    across, down = (scale * width for width in field.half_width)
    wider = across + reach * (1.0 + across**2), down + reach * (1.0 + down**2)
    area = (wider[0] * wider[1]) / (across * down)
    expected = expected_stars(sky, matrix, wider, int((1.3 * min(len(field), _BRIGHTEST) + 8) * area))
    seen = stretched(field.direction[:_BRIGHTEST], scale)
    shift = seen[:, None, :] - sky.stars.direction[expected] @ matrix.T
    # The displacement of stars by errors of roll and scale differs between the edges of the image.
    radius = math.hypot(across, down)
    star_sigma = float(field.sigma[:_BRIGHTEST].max()) * scale
    stretch = 0.5 * math.log(field.scale[1] / field.scale[0])
    close = (
        np.einsum("ijk,ijk->ij", shift, shift)
        <= (math.sqrt(2.0) * reach + stretch * radius + 4.0 * star_sigma) ** 2
    )
    one, two = np.nonzero(close)
    if not len(one) or len(one) > _MOST_PAIRS:
        return np.empty(0, dtype=np.int64), expected[:0]
    shifts = shift[one, two]
    apart = shifts[:, None, :] - shifts
    tolerance = 4.0 * star_sigma + (PRIOR_SIGMAS * sigma + stretch) * radius
    agree = np.einsum("ijk,ijk->ij", apart, apart) <= tolerance**2
    # Two matches that contain the same observed star or the same guide star do not count as agreeing.
    agree &= (one[:, None] != one) & (two[:, None] != two)
    best = int(agree.sum(axis=1).argmax())
    members = np.append(np.flatnonzero(agree[best]), best)
    nearest = members[np.argsort(np.einsum("ij,ij->i", apart[best, members], apart[best, members]))]
    observed, first = np.unique(one[nearest], return_index=True)
    return observed, expected[two[nearest[first]]]
