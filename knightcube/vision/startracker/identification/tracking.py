"""Tracking: identifies the stars of a frame with a prior attitude.

A prior attitude with a small error shifts all predicted stars by nearly the same vector. Of all pairs of
an observed and a predicted star close enough to be the same, the largest set with one shift refines the
attitude, and the whole field verifies it as in lost in space, with the prior's uncertainty in place of the
whole sky as the searched part.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.startracker.identification.attitude_fit import refine, stretched
from knightcube.vision.startracker.identification.star_field import Identification, StarField, Status
from knightcube.vision.startracker.identification.verification import (
    VerificationSettings,
    expected_stars,
    nothing,
    verify_matrix,
)
from knightcube.vision.startracker.index.sky_index import SkyIndex

_BRIGHTEST = 16
_PRIOR_SIGMAS = 4.0
# More pairs are ambiguous, and comparing them takes longer than a search of the whole sky.
_MOST_PAIRS = 400
_DEFAULT = VerificationSettings()


def track(
    field: StarField,
    sky: SkyIndex,
    attitude: FloatArray,
    sigma: float,
    settings: VerificationSettings = _DEFAULT,
) -> Identification:
    """Return the identification of the frame near a prior attitude; NO_MATCH if it points elsewhere.

    `attitude` (4,), ICRS to camera, has the standard deviation `sigma`, rad, about each axis. If `sigma`
    exceeds some degrees, `identify` is faster and more reliable.
    """
    if len(field) < settings.least_matches:
        return nothing(field, Status.TOO_FEW_STARS)
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
    # Volume of the ball of rotations around the prior over that of all rotations, 8 pi^2 in this measure.
    searched = min((_PRIOR_SIGMAS * sigma) ** 3 / (6.0 * math.pi), 1.0)
    return verify_matrix(field, sky, matrix, scale, searched, settings)


def _same_shift(
    field: StarField, sky: SkyIndex, matrix: FloatArray, scale: float, sigma: float
) -> tuple[IntArray, npt.NDArray[np.intp]]:
    """Return observed and guide stars (k,), (k,) of the largest set of pairs with one shift."""
    reach = _PRIOR_SIGMAS * sigma
    across, down = (scale * width for width in field.half_width)
    wider = across + reach * (1.0 + across**2), down + reach * (1.0 + down**2)
    area = (wider[0] * wider[1]) / (across * down)
    expected = expected_stars(sky, matrix, wider, int((1.3 * min(len(field), _BRIGHTEST) + 8) * area))
    seen = stretched(field.direction[:_BRIGHTEST], scale)
    shift = seen[:, None, :] - sky.stars.direction[expected] @ matrix.T
    # Roll, and an unknown scale, make the shifts of stars at the edge differ.
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
    tolerance = 4.0 * star_sigma + (_PRIOR_SIGMAS * sigma + stretch) * radius
    agree = np.einsum("ijk,ijk->ij", apart, apart) <= tolerance**2
    # Pairs that share an observed or a guide star do not support each other.
    agree &= (one[:, None] != one) & (two[:, None] != two)
    best = int(agree.sum(axis=1).argmax())
    members = np.append(np.flatnonzero(agree[best]), best)
    nearest = members[np.argsort(np.einsum("ij,ij->i", apart[best, members], apart[best, members]))]
    observed, first = np.unique(one[nearest], return_index=True)
    return observed, expected[two[nearest[first]]]
