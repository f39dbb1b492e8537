"""A bound from below for the time that coils take to stop a body, with the field ahead known.

For any unit vector y a dipole within reach R removes at most R times the integral of |B x y| from h . y. So a
time is too short as long as some y asks for more: the largest such time of many y is a bound. Coils at their
limits reach 1.5 limits in the mean over all attitudes; a spin about one axis may have less, or more. That the
rate may be bounded on the way, as by the flight's law, is left out.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray

SATURATED = 1.5
"""Mean over all attitudes of the sum of a unit vector's components, by size."""
DIRECTIONS = 2000
CLOSER, TRIES = (0.06, 0.02, 0.007), 60
"""rad: the worst direction is looked for again so near to it, with so many more."""


def least_time(momentum: FloatArray, field: FloatArray, step: float, reach: float, left: float) -> float:
    """Return the bound, s, for all but `left` N m s of a momentum (3,).

    `field` (n, 3) T is that at the middles of steps of `step` s, in the momentum's inertial axes; `reach` is
    in A m^2. The bound is n steps at most.
    """
    rng = np.random.default_rng(1)
    tried = rng.standard_normal((DIRECTIONS, 3))
    longest, worst = -1.0, tried[0]
    for close in (None, *CLOSER):
        if close is not None:
            tried = worst + close * rng.standard_normal((TRIES, 3))
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        across = np.linalg.norm(np.cross(field[:, None], tried), axis=2)
        removed = np.vstack([np.zeros(len(tried)), np.cumsum(across, axis=0)]) * (step * reach)
        times = _crossed(removed, tried @ momentum - left) * step
        if times.max() > longest:
            longest, worst = float(times.max()), tried[times.argmax()]
    return longest


def _crossed(removed: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return by column the row, in parts, where `removed` (n + 1, k), rising, reaches `wanted` (k,)."""
    row = np.sum(removed < wanted, axis=0)
    after = np.clip(row, 1, len(removed) - 1)
    column = np.arange(len(wanted))
    low, high = removed[after - 1, column], removed[after, column]
    part = np.clip((wanted - low) / np.maximum(high - low, 1e-300), 0.0, 1.0)
    return np.where(wanted <= 0.0, 0.0, after - 1.0 + part)
