"""The sky index of identification, one memory-mapped file: guide stars and their triangles.

`python -m knightcube.vision.startracker.index.build` makes it (layout: `table_file`), the same bytes for
the same stars and limits.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.index import table_file
from knightcube.vision.startracker.index.guide_stars import GuideStars
from knightcube.vision.startracker.index.triangle_index import TriangleIndex

_VERSION = 3
KIND = table_file.Kind(
    b"KCSKYIDX",
    _VERSION,
    "sky index",
    "make it again with `python -m knightcube.vision.startracker.index.build`",
)
PATH = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "knightcube" / f"sky-{_VERSION}.index"
)
"""Where the default index is kept."""


@dataclass(frozen=True, eq=False)
class SkyIndex:
    """Guide stars and the triangles of the locally bright among them.

    Attributes:
        stars: the guide stars at the index's epoch.
        motion: (n, 3) float32 rad/yr, each direction's change: proper motion.
        triangles: numbers of guide stars by the shape and size of the triangle that they form.
    """

    stars: GuideStars
    motion: npt.NDArray[np.float32]
    triangles: TriangleIndex

    @cached_property
    def coarse(self) -> npt.NDArray[np.float32]:
        """The stars' directions, one axis a row (3, n): for a quick search near a boresight."""
        return np.ascontiguousarray(self.stars.direction.T, dtype=np.float32)

    def at(self, epoch: float) -> SkyIndex:
        """Return the index with the stars moved to Julian year `epoch`.

        The triangles stay: in a century a star of 1"/yr moves by 0.03 deg. Raises ValueError when `epoch` is
        not finite.
        """
        if not np.isfinite(epoch):
            raise ValueError(f"epoch = {epoch!r}: give a finite Julian year, such as 2030.5")
        moved = self.stars.direction + (epoch - self.stars.epoch) * self.motion
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        stars = GuideStars(self.stars.hip, np.asarray(moved), self.stars.magnitude, epoch)
        return SkyIndex(stars, self.motion, self.triangles)


def save(sky: SkyIndex, path: Path) -> None:
    """Write the index to `path`, whole or not at all."""
    columns: table_file.Columns = {
        "hip": sky.stars.hip,
        "direction": sky.stars.direction.astype(np.float32),
        "magnitude": np.round(sky.stars.magnitude * 1000.0).astype(np.int16),
        "motion": sky.motion,
    }
    for field in fields(sky.triangles):
        columns[field.name] = np.asarray(getattr(sky.triangles, field.name))
    table_file.save(path, KIND, columns, {"epoch": sky.stars.epoch})


def load(path: Path = PATH) -> SkyIndex:
    """Return the index of a file, its triangles mapped and not read.

    Raises InputError when the file is missing, damaged, or of another version.
    """
    columns, facts = table_file.load(path, KIND)
    direction: FloatArray = columns["direction"].astype(np.float64)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    stars = GuideStars(columns["hip"], direction, columns["magnitude"] / 1000.0, facts["epoch"])
    triangles = TriangleIndex(**{field.name: columns[field.name] for field in fields(TriangleIndex)})
    return SkyIndex(stars, columns["motion"], triangles)


@cache
def load_once(path: Path) -> SkyIndex:
    """Return the index of a file, read once a process. Raises InputError as `load`."""
    return load(path)
