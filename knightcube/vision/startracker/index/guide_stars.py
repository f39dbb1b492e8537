"""The stars that a camera can resolve: the catalogue as a given lens images it (Michalski 3.3).

Proper motion carried to the epoch of observation; stars closer than the image resolves merged into one, at
their centre of light and with their joint magnitude, as a detector shows them. No aberration: it depends on
the camera's velocity and is applied to directions that are matched, on board.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray
from knightcube.astro.catalogue import StarCatalogue


@dataclass(frozen=True, slots=True, eq=False)
class GuideStars:
    """Stars as the camera resolves them, brightest first.

    Attributes:
        hip: (n,) int32 Hipparcos number, of a merged group its brightest.
        direction: (n, 3) unit vectors, ICRS, at `epoch`.
        magnitude: (n,) Johnson V, joint where merged.
        epoch: Julian year.
    """

    hip: npt.NDArray[np.int32]
    direction: FloatArray
    magnitude: FloatArray
    epoch: float

    def __len__(self) -> int:
        return len(self.hip)

    def brighter_than(self, magnitude: float) -> GuideStars:
        """Return the stars with V below `magnitude`, without copying."""
        count = int(np.searchsorted(self.magnitude, magnitude, side="left"))
        return GuideStars(self.hip[:count], self.direction[:count], self.magnitude[:count], self.epoch)


def choose_guide_stars(
    catalogue: StarCatalogue, faintest: float, epoch: float, resolution: float
) -> GuideStars:
    """Return the stars with a joint V below `faintest` at Julian year `epoch`.

    Stars closer together than `resolution` rad, directly or through others, are merged.
    Raises ValueError when `epoch` is not finite.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - to make a table, not to read one

    direction = catalogue.directions_at(epoch)
    pairs = cKDTree(direction).query_pairs(2.0 * np.sin(0.5 * resolution), output_type="ndarray")
    group = _connected(len(catalogue), pairs)
    light = 10.0 ** (-0.4 * catalogue.magnitude)
    joint = np.bincount(group, light, minlength=len(catalogue))
    centre = np.stack(
        [np.bincount(group, light * axis, minlength=len(catalogue)) for axis in direction.T], axis=-1
    )
    # A group bears the number of its first member, and the catalogue is in order of brightness.
    first = np.flatnonzero(group == np.arange(len(catalogue)))
    magnitude = -2.5 * np.log10(joint[first])
    seen = np.flatnonzero(magnitude < faintest)
    order = seen[np.argsort(magnitude[seen], kind="stable")]
    members = first[order]
    directions = centre[members] / np.linalg.norm(centre[members], axis=-1, keepdims=True)
    return GuideStars(catalogue.hip[members], directions, magnitude[order], epoch)


def _connected(count: int, pairs: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return for each of `count` stars (count,) the lowest number of its connected group."""
    group = np.arange(count)
    while True:
        lowest = np.minimum(group[pairs[:, 0]], group[pairs[:, 1]])
        previous = group.copy()
        np.minimum.at(group, pairs[:, 0], lowest)
        np.minimum.at(group, pairs[:, 1], lowest)
        if np.array_equal(previous, group):
            return group
