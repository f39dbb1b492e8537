"""The order in time of a slew's unknowns, and the band that their equations fill.

Each interval has the state (7) and the dipole (3) of its first node, the equation of its midpoint (7), the
midpoint's state (7) and the equation of its end (7); the start's equations stand before all, the end's after
all. So each equation touches its neighbours only, and LAPACK factors the band. It is imported where that is
done, as the control process names the job but does not need it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import PlanningError

STEP = 31
"""Unknowns of an interval."""
WIDE = STEP + 10
"""Unknowns that an interval's equations touch: its own, and the next node's."""
EQUATIONS: IntArray = np.r_[10:17, 24:31]
"""Places of an interval's equations among its unknowns."""
_BAND = 33
_ROWS = 3 * _BAND + 1  # LAPACK's, with room for the pivots


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where each unknown stands among all of a slew.

    Attributes:
        states: (2 k + 1, 7) at nodes and midpoints; dipoles: (k + 1, 3); equations: (k, 14); start: (7,);
            end: (ends,).
        begins: (k + 1,) the first unknown of each interval, and of the last node.
        places, entries: of the band, the places that intervals' blocks fill, and with which of their entries.
    """

    states: IntArray
    dipoles: IntArray
    equations: IntArray
    start: IntArray
    end: IntArray
    begins: IntArray
    places: IntArray
    entries: IntArray

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return int(self.end[-1]) + 1

    def band(self, blocks: FloatArray, tail: FloatArray) -> FloatArray:
        """Return the band of intervals' `blocks` (k, WIDE, WIDE), in part overwritten, and of the `tail`.

        The tail holds the last node's state and dipole and the end's equations.
        """
        # The corner that two intervals share belongs to the second.
        blocks[1:, :10, :10] += blocks[:-1, STEP:, STEP:]
        tail[:10, :10] += blocks[-1, STEP:, STEP:]
        filled = np.zeros(self.size * _ROWS)
        filled[self.places] = blocks.reshape(len(blocks), -1)[:, self.entries]
        band = filled.reshape(self.size, _ROWS)
        row, column = np.indices(tail.shape)
        band[int(self.begins[-1]) + column, 2 * _BAND + row - column] = tail
        for k in range(7):  # the start's equations are the first state itself
            band[k, 2 * _BAND + 7] = band[k + 7, 2 * _BAND - 7] = 1.0
        return band.T


@lru_cache(maxsize=16)
def layout(count: int, ends: int) -> Layout:
    """Return the layout of a slew in `count` intervals with `ends` equations at its end."""
    begins = 7 + STEP * np.arange(count + 1)
    states = np.empty((2 * count + 1, 7), dtype=np.int64)
    states[::2] = begins[:, None] + np.arange(7)
    states[1::2] = begins[:-1, None] + 17 + np.arange(7)
    row, column = np.divmod(np.arange(WIDE * WIDE), WIDE)
    own = (np.minimum(row, column) < STEP) & (np.abs(row - column) <= _BAND)
    rows, columns = (begins[:-1, None] + index[own] for index in (row, column))
    return Layout(
        states,
        begins[:, None] + 7 + np.arange(3),
        begins[:-1, None] + EQUATIONS,
        np.arange(7),
        int(begins[-1]) + 10 + np.arange(ends),
        begins,
        columns * _ROWS + 2 * _BAND + rows - columns,
        np.flatnonzero(own),
    )


class Factors:
    """The factors of a band, for as many right sides as are wanted."""

    def __init__(self, band: FloatArray) -> None:
        """Factor a `band` in its place. Raises PlanningError where it is singular."""
        from scipy.linalg.lapack import dgbtrf  # noqa: PLC0415 - see the top

        self._factors, self._pivots, info = dgbtrf(band, _BAND, _BAND, overwrite_ab=1)
        if info:
            raise PlanningError("the equations of a slew are singular")

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution (size,) of a right side (size,). Raises PlanningError without any."""
        from scipy.linalg.lapack import dgbtrs  # noqa: PLC0415 - see the top

        found, _ = dgbtrs(self._factors, _BAND, _BAND, right[:, None], self._pivots)
        if not np.isfinite(found).all():
            raise PlanningError("the equations of a slew are singular")
        return np.asarray(found[:, 0])
