"""Lost in space: identifies the stars of a frame without prior information.

Every triangle of the brightest observed stars is looked up by shape, turning and size among those of the
guide stars, all at once. Each match votes for its three pairs of an observed and a guide star: true pairs
occur in many triangles, chance pairs in one. The matches with the most votes are verified against the whole
field until one holds. If none does, triangles spread over all stars are looked up: of a thousand enough are
of true stars to win the vote, though most stars and the brightest be false. Last the field is tried as a
mirror shows it, and with a scale outside of a narrow range that was given as a hint.

The shape on the sphere depends on the scale of the image, though little: a wide range of scales is tried in
steps, each narrow enough for the ratios of the sides to stay within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.identification.identification import Identification, Status
from knightcube.vision.startracker.identification.look_up import ScaleSteps, TriangleMatches, look_up
from knightcube.vision.startracker.identification.observed_triangles import BatchSizes, batches_of
from knightcube.vision.startracker.identification.refinement import stretched
from knightcube.vision.startracker.identification.verification import (
    VerificationSettings,
    nothing,
    verify_matrix,
)
from knightcube.vision.startracker.index.sky_index import SkyIndex


@dataclass(frozen=True, slots=True)
class IdentificationSettings:
    """Tolerances and budget of the search.

    Attributes:
        tolerance: of the ratios of sides, in their sigmas.
        distortion: additional error of a ratio of sides, for a lens that is no pinhole.
        batches: numbers of triangles looked up.
        work: entries of the index that may be read in total.
        verified: candidates of each batch that are verified at most.
        mirror: whether the field is searched for as a mirror shows it too.
        hint_error: factor by which a scale within a narrow range, a hint, may lie outside of that range after
            all; 1 where the range is certain. A calibrated scale, (1, 1), is always believed.
        verification: when a candidate is accepted.
    """

    tolerance: float = 3.0
    distortion: float = 0.0015
    batches: BatchSizes = field(default_factory=BatchSizes)
    work: int = 600_000
    verified: int = 12
    mirror: bool = True
    hint_error: float = 1.25
    verification: VerificationSettings = field(default_factory=VerificationSettings)


# Tolerance and verified candidates of triangles spread over many stars: of these there are enough that some
# may be missed, and the true ones have many votes.
_OF_SPREAD = 0.6
# A match in a mirror, or against a hint, must be ten times less likely by chance: most pictures need neither.
_RARE = 10.0
DEFAULT = IdentificationSettings()


def identify(
    observed: StarField, sky: SkyIndex, settings: IdentificationSettings = DEFAULT
) -> Identification:
    """Return which stars the frame shows and their attitude, or why it cannot be identified."""
    if len(observed) < settings.verification.least_matches:
        return nothing(observed, Status.TOO_FEW_STARS)
    answer = _search(observed, sky, settings, 1.0)
    if answer.status is not Status.IDENTIFIED and settings.mirror:
        answer = _search(observed.mirrored(), sky, settings, _RARE)
        answer = replace(answer, mirrored=answer.status is Status.IDENTIFIED)
    lowest, highest = observed.scale
    if answer.status is not Status.IDENTIFIED and 1.0 < highest / lowest < settings.hint_error**2:
        wider = lowest / settings.hint_error, highest * settings.hint_error
        answer = _search(replace(observed, scale=wider), sky, settings, _RARE)
    return answer


def _search(
    observed: StarField, sky: SkyIndex, settings: IdentificationSettings, searched: float
) -> Identification:
    """Return the identification of the field as it is."""
    steps = ScaleSteps.of(observed, settings.distortion)
    found: list[TriangleMatches] = []
    tried: set[tuple[int, int]] = set()
    work = 0
    for triangles, spread in batches_of(observed, settings.batches, len(steps)):
        share = _OF_SPREAD if spread else 1.0
        finds, read = look_up(
            observed,
            sky,
            steps,
            triangles,
            share * settings.tolerance,
            settings.distortion,
            settings.work - work,
        )
        found.append(finds)
        most = round(share * settings.verified)
        for matrix, scale in _candidates(observed, sky, TriangleMatches.of(found), tried, most):
            answer = verify_matrix(observed, sky, matrix, scale, searched, settings.verification)
            if answer.status is Status.IDENTIFIED:
                return answer
        work += read
        if work >= settings.work:
            break
    return nothing(observed)


def _candidates(
    observed: StarField, sky: SkyIndex, finds: TriangleMatches, tried: set[tuple[int, int]], most: int
) -> Iterator[tuple[FloatArray, float]]:
    """Yield attitudes (3, 3) and scales of the matches with the most votes, without repetition."""
    if not len(finds):
        return
    votes = finds.votes().sum(axis=1)
    # Of all matches, which may be a hundred thousand, only the first in order are sorted.
    first = np.argpartition(-votes, min(8 * most, len(votes) - 1))[: 8 * most]
    order = first[np.lexsort((first, -votes[first]))]
    yielded = 0
    for find in order.tolist():
        pairs = list(zip(finds.observed[find].tolist(), finds.star[find].tolist(), strict=True))
        if sum(pair in tried for pair in pairs) >= 2:
            continue
        tried.update(pairs)
        # One triangle gives a poor scale: it is clipped to the lens's range.
        scale = min(max(float(finds.scale[find]), observed.scale[0]), observed.scale[1])
        yield _attitude_of(observed, sky, finds, find), scale
        yielded += 1
        if yielded == most:
            return


def _attitude_of(observed: StarField, sky: SkyIndex, finds: TriangleMatches, find: int) -> FloatArray:
    """Return the attitude (3, 3) that maps a match's guide stars onto the observed ones."""
    seen = stretched(observed.direction[finds.observed[find]], float(finds.scale[find]))
    return np.asarray(_frame(seen).T @ _frame(sky.stars.direction[finds.star[find]]))


def _frame(corners: FloatArray) -> FloatArray:
    """Return the rows of a frame (3, 3) fixed in a triangle (3, 3): its middle, along its longest side."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners.tolist()
    mx, my, mz = ax + bx + cx, ay + by + cy, az + bz + cz
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    mx, my, mz = mx / norm, my / norm, mz / norm
    dx, dy, dz = ax - bx, ay - by, az - bz
    along = mx * dx + my * dy + mz * dz
    dx, dy, dz = dx - along * mx, dy - along * my, dz - along * mz
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / norm, dy / norm, dz / norm
    return np.array([[mx, my, mz], [dx, dy, dz], [my * dz - mz * dy, mz * dx - mx * dz, mx * dy - my * dx]])
