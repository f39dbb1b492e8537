"""Detection of moving objects without a star catalogue, by the common motion of the stars over frames.

The worker measures the points of light in a frame (`measure.measure_points`). If the stars are long streaks,
`detect` finds objects in the single frame, and the directions of the stars are computed from the fitted
streaks. Otherwise the centroids of all bright areas are measured, and a single frame does not distinguish an
object from a star.

The class `StarField` stores the directions of the stars of earlier frames. The points of a new frame are
assigned to the stars of earlier frames by means of the predicted rotation of the camera, and the assigned
stars correct the rotation. A point that is not assigned to a star is noise, an object, or a star that has
entered the field of view. A tracker over several frames determines which points move relative to the stars.
An object that moves less than the matching tolerance from frame to frame is mistaken for a star.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.attitude import solvers
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.vision.objects.settings import FieldPoints

GATE = 5.0
"""Largest distance (standard deviations) of a point from the star to which it is assigned."""
LEAST_STARS = 3
"""Minimum number of assigned stars that determine the rotation of the camera."""
MOST_FAILURES = 3
"""Number of successive frames with too few assigned stars after which all stars are removed from the
field."""
KNOWN = 2
"""Minimum number of frames in which a direction appears before the direction is assumed to be a star."""
FORGOTTEN = 20
"""Number of frames after which a direction that does not appear again is removed, unless it is a star."""
MOST_STARS = 600
"""Maximum number of stored directions; those measured most recently are kept."""


@dataclass(frozen=True, slots=True, eq=False)
class LocatedFrame:
    """The attitude of a frame relative to the stars of earlier frames, and a mask of the stars in the frame.

    The attitude (4,) of the camera relative to the star field has a covariance (3, 3), camera axes, rad^2.
    The flag `begun` is true if this frame is the first frame of the star field.
    """

    quaternion: FloatArray
    covariance: FloatArray
    is_star: BoolArray
    begun: bool


class StarField:
    """Directions of the stars of earlier frames, without a catalogue."""

    def __init__(self) -> None:
        self._directions = np.zeros((0, 3))
        self._sigma = np.zeros(0)
        self._seen = np.zeros(0, dtype=np.int64)
        self._last = np.zeros(0, dtype=np.int64)
        self._frame = self._failures = 0

    def locate(self, found: FieldPoints, predicted: FloatArray, sigma: float) -> LocatedFrame:
        """Return the attitude of a frame relative to the star field, and a mask of the stars in the frame.

        If fewer than three points match stars of the field, the field is not updated, and all points are
        treated as stars. If three successive frames have fewer than three stars of the field, all stars of
        the field are removed, and the points of the third frame become the new field. The `predicted`
        attitude (4,) of the camera relative to the star field has the standard deviation `sigma`, rad.
        """
        self._frame += 1
        candidates = np.flatnonzero(~found.moving)
        fix, pairs = self._fitted(found, candidates, predicted, sigma)
        is_star = np.zeros(len(found.sigma), dtype=np.bool_)
        self._failures = self._failures + 1 if fix is None else 0
        if fix is None and len(self._sigma) and self._failures < MOST_FAILURES:
            return LocatedFrame(predicted, np.zeros((3, 3)), ~is_star, False)
        if fix is None:
            self._failures = 0
            self._directions = np.zeros((0, 3))
            self._sigma, self._seen, self._last = np.zeros(0), self._seen[:0], self._last[:0]
            self._add(found, candidates, predicted)
            return LocatedFrame(predicted, np.zeros((3, 3)), ~found.moving, True)
        point, star = pairs
        is_star[point] = self._seen[star] >= KNOWN - 1
        self._seen[star] += 1
        self._last[star] = self._frame
        self._add(found, np.setdiff1d(candidates, point), fix.quaternion)
        return LocatedFrame(fix.quaternion, fix.covariance, is_star, False)

    def _fitted(
        self, found: FieldPoints, candidates: IntArray, predicted: FloatArray, sigma: float
    ) -> tuple[AttitudeFix | None, tuple[IntArray, IntArray]]:
        """Return the attitude fitted to the points that match stars, and the indices of points and stars."""
        quaternion, fix = predicted, None
        none = np.zeros(0, dtype=np.int64)
        pairs = none, none
        own = found.sigma[candidates]
        for extra in (4.0 * sigma, 0.0, 0.0):
            if not len(candidates) or not len(self._sigma):
                return None, pairs
            there = found.directions[candidates] @ attitude_matrix(quaternion)
            cosines = there @ self._directions.T
            nearest, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
            apart = np.linalg.norm(there - self._directions[nearest], axis=1)
            mutual = back[nearest] == np.arange(len(candidates))
            near = mutual & (apart <= GATE * np.hypot(own, self._sigma[nearest]) + extra)
            point, star = candidates[near], nearest[near]
            if len(point) < LEAST_STARS:
                return None, pairs
            if extra:
                quaternion = _common_rotation(there[near], self._directions[star], quaternion)
                continue
            try:
                error = np.hypot(own[near], self._sigma[star])
                fix = solvers.solve(found.directions[point], self._directions[star], error)
            except AttitudeError:
                return None, pairs
            quaternion, pairs = fix.quaternion, (point, star)
        return fix, pairs

    def _add(self, found: FieldPoints, chosen: IntArray, quaternion: FloatArray) -> None:
        """Add the points with the indices `chosen` to the field, and remove old directions."""
        added = found.directions[chosen] @ attitude_matrix(quaternion)
        self._directions = np.vstack([self._directions, added])
        self._sigma = np.concatenate([self._sigma, found.sigma[chosen]])
        ones = np.ones(len(chosen), dtype=np.int64)
        self._seen = np.concatenate([self._seen, ones])
        self._last = np.concatenate([self._last, self._frame * ones])
        alive = (self._seen >= KNOWN) | (self._frame - self._last < FORGOTTEN)
        kept = np.flatnonzero(alive)
        kept = np.sort(kept[np.argsort(-self._last[kept], kind="stable")[:MOST_STARS]])
        self._directions, self._sigma = self._directions[kept], self._sigma[kept]
        self._seen, self._last = self._seen[kept], self._last[kept]


def _common_rotation(there: FloatArray, stars: FloatArray, quaternion: FloatArray) -> FloatArray:
    """Return the attitude (4,) corrected by the rotation that most pairs of directions (n, 3) have in common.

    Each pair proposes the smallest rotation that aligns its two directions. The proposal that leaves the
    smallest median distance is refined by least squares over the nearer half of the pairs.
    """
    proposals = np.cross(there, stars)
    moved = there[None] + np.cross(proposals[:, None], there[None])
    apart = np.linalg.norm(moved - stars[None], axis=2)
    best = int(np.argmin(np.median(apart, axis=1)))
    near = apart[best] <= max(float(np.median(apart[best])), 1e-12)
    turn = proposals[best]
    if np.count_nonzero(near) >= 2:
        first, second = there[near], stars[near]
        # The rotation vector e is the least-squares solution of second = first + e x first.
        normal = len(first) * np.eye(3) - first.T @ first
        turn = np.linalg.lstsq(normal, np.cross(first, second).sum(axis=0), rcond=1e-9)[0]
    return multiply(quaternion, from_rotation_vector(turn))
