"""The direction of the turn, which a rolling shutter makes a part of the motion.

A star that runs down the frame, with the shutter, is exposed for longer than a star that runs up: a motion
and its reverse draw streaks of different lengths. A prior decides before the fit. Without one both directions
are fitted. The stars decide where they agree on one; else the answer lies between both, and its covariance
spans them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.admission import direction_of_time
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.streak_result import StreakStatus

# Streaks of both fits are of one star within this many px. The stars must prefer one direction by this much
# chi-square together, and by this many times their scatter; none counts more than so much.
_SAME = 3.0
_LEAST_MARGIN = 50.0
_LEAST_AGREEMENT = 3.0
_ENOUGH = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class Misfits:
    """Streaks' middles (n, 2) px, and by how much the chi-square (n,) of each exceeds its pixels."""

    middles: FloatArray
    excess: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Directed:
    """The answer for one direction, and its misfits; None where they are not needed."""

    result: MotionResult
    misfits: Misfits | None


def rolling_answer(
    answer: Callable[[FloatArray], Directed | None],
    axis: FloatArray,
    prior_rate: FloatArray | None,
    prior_sigma: float,
    sigmas: float,
) -> MotionResult | None:
    """Return the motion under a rolling shutter; None without one.

    `answer` gives it for turns along a vector (3,), `axis` (3,) is the first guess of the turn's, of either
    sign; the prior (rad/s, None if unknown) is believed beyond `sigmas` of its own.
    """
    if prior_rate is not None:
        sign = direction_of_time(axis, prior_rate, prior_sigma, sigmas)
        found = answer(sign * axis) if sign else None
        if found is not None:
            rate = found.result.rate
            if rate is None:
                return found.result
            if direction_of_time(rate, prior_rate, prior_sigma, sigmas) > 0:
                return replace(found.result, status=StreakStatus.RATE)
    seen = [found for found in (answer(axis), answer(-axis)) if found is not None]
    if not seen:
        return None
    known = [found for found in seen if found.result.rate is not None]
    if len(known) < 2:
        # A direction that failed may be the true one.
        return replace(seen[0].result, status=StreakStatus.FAILED, rate=None, covariance=None)
    one, other = known
    preference = _preference(one.misfits, other.misfits)
    if preference:
        return (one if preference > 0 else other).result
    return _between(one.result, other.result)


def _preference(one: Misfits | None, other: Misfits | None) -> int:
    """Return 1 where the stars agree that `one` fits them better, -1 for `other`, 0 where they do not."""
    assert one is not None
    assert other is not None
    apart = np.linalg.norm(one.middles[:, None] - other.middles, axis=2)
    mine, theirs = np.nonzero(apart < _SAME)
    better = np.clip(other.excess[theirs] - one.excess[mine], -_ENOUGH, _ENOUGH)
    total, scatter = float(better.sum()), float(np.sqrt(np.sum(better**2)))
    if abs(total) < max(_LEAST_MARGIN, _LEAST_AGREEMENT * scatter):
        return 0
    return 1 if total > 0.0 else -1


def _between(one: MotionResult, other: MotionResult) -> MotionResult:
    """Return the motion between two of opposite directions, its covariance spanning both."""
    assert one.rate is not None
    assert one.covariance is not None
    assert other.rate is not None
    assert other.covariance is not None
    apart = one.rate + other.rate
    covariance = 0.5 * (one.covariance + other.covariance) + 0.25 * np.outer(apart, apart)
    return replace(one, rate=one.rate - 0.5 * apart, covariance=covariance)
