"""Which endpoints are simultaneous: the axis without knowing any streak's direction (Sease 3.17-3.19).

Every star turns about one axis a, so a·(v2 - v1) = 0 for each streak whatever its order: the axis is the
direction most nearly normal to all chords, up to sign. The sign of a·(v1 x v2) then orders each pair (3.19
corrected). Unlike the projected centre of rotation, 3-D vectors have no singular case: the axis may lie along
the boresight or normal to it.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray

# Pairs of the strongest streaks propose axes: 276 hypotheses.
_MOST_PROPOSERS = 24
_PARALLEL = 1e-12


def centre_of_rotation(endpoints: FloatArray) -> FloatArray:
    """Return the pixel (2,) nearest to the bisectors of streaks (n, 2, 2): 3.17, 3.18 corrected.

    For information: it runs to infinity as the axis becomes normal to the boresight; NaN when the chords are
    parallel.
    """
    chord = endpoints[:, 1] - endpoints[:, 0]
    chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    midpoint = endpoints.mean(axis=1)
    centre, _, rank, _ = np.linalg.lstsq(chord, np.sum(chord * midpoint, axis=-1), rcond=1e-9)
    return np.asarray(centre) if rank == 2 else np.full(2, np.nan)


def rotation_axis(
    first: FloatArray, second: FloatArray, tolerance: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the axis (3,), sign arbitrary, that most streaks agree on, and which streaks (n,) do.

    `first` and `second` (n, 3) are unit vectors of the two ends in any order, strongest streaks first;
    `tolerance` (n,) is the error in rad allowed to the direction of each chord. Consensus of pairs, then
    least squares over those that agree; less than about half may be outliers. Deterministic. Raises
    ValueError for fewer than two streaks.
    """
    if len(first) < 2:
        raise ValueError(f"an axis needs two streaks or more, not {len(first)}")
    chord = second - first
    chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    i, j = np.triu_indices(min(len(chord), _MOST_PROPOSERS), k=1)
    proposal = np.cross(chord[i], chord[j])
    size = np.linalg.norm(proposal, axis=-1, keepdims=True)
    proposal = proposal / np.maximum(size, _PARALLEL)
    missed = np.minimum((proposal @ chord.T / tolerance) ** 2, 1.0).sum(axis=-1)
    # Parallel chords propose a null vector, which would agree with everything.
    missed[size[:, 0] < _PARALLEL] = np.inf
    axis = proposal[np.argmin(missed)]
    for _ in range(3):
        agree = np.abs(chord @ axis) <= tolerance
        if np.count_nonzero(agree) < 2:
            break
        axis = np.linalg.svd(chord[agree] / tolerance[agree, None])[2][-1]
    return axis, np.asarray(np.abs(chord @ axis) <= tolerance)


def rotation_angles(first: FloatArray, second: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the angle (n,) in rad by which each star turned about `axis` from `first` to `second` (n, 3).

    Its sign is that of axis·(v1 x v2), 3.19 corrected: streaks of one sign share the order of their ends.
    """
    sine = np.cross(first, second) @ axis
    cosine = np.sum(first * second, axis=-1) - (first @ axis) * (second @ axis)
    return np.asarray(np.arctan2(sine, cosine))
