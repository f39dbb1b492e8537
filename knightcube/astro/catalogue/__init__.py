"""The star catalogue: Hipparcos to V 8.5, positions in ICRS at epoch J1991.25, proper motions, magnitudes.

The table `hipparcos.npz` holds whole numbers, so that it is the same on every machine: milliarcseconds of
right ascension and declination (at most 0.71 mas from the source), hundredths of a milliarcsecond per year of
proper motion and hundredths of a magnitude, both as published. `knightcube.astro.catalogue.build` builds it.

Directions are in the Hipparcos frame, without parallax (at most 0.75") and aberration (20"). An unresolved
close pair is one entry with the joint magnitude, as in Hipparcos.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray
from knightcube.errors import InputError

EPOCH = 1991.25
MILLIARCSECOND = float(np.radians(1.0 / 3_600_000.0))
TABLE = Path(__file__).with_name("hipparcos.npz")
COLUMNS = {
    "hip": np.int32,
    "right_ascension": np.int32,
    "declination": np.int32,
    "proper_motion": np.int32,
    "magnitude": np.int16,
}
"""The table's columns: -, mas, mas, 0.01 mas/yr (n, 2) as mu_alpha cos(delta) and mu_delta, 0.01 mag."""

_DAMAGED = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What a damaged archive raises; RuntimeError for a compression or an encryption that is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class StarCatalogue:
    """Stars, the brightest first; the arrays are read-only.

    Attributes:
        hip: (n,) int32 Hipparcos numbers.
        direction: (n, 3) unit vectors, ICRS, at epoch J1991.25.
        proper_motion: (n, 2) rad/yr: mu_alpha cos(delta) and mu_delta.
        magnitude: (n,) Johnson V.
    """

    hip: npt.NDArray[np.int32]
    direction: FloatArray
    proper_motion: FloatArray
    magnitude: FloatArray

    def __len__(self) -> int:
        return len(self.hip)

    def directions_at(self, year: float) -> FloatArray:
        """Return unit vectors (n, 3), ICRS, at Julian year `year`.

        Each star keeps its speed along the tangent at J1991.25; its radial velocity is assumed zero
        (ESA SP-1200, vol. 1, 1.5.5). Raises ValueError when `year` is not finite.
        """
        if not np.isfinite(year):
            raise ValueError(f"year = {year!r}: a catalogue epoch is a finite Julian year, such as 2030.5")
        x, y, z = self.direction.T
        cosine = np.hypot(x, y)
        east = np.stack([-y / cosine, x / cosine, np.zeros_like(x)], axis=-1)
        north = np.stack([-x * z / cosine, -y * z / cosine, cosine], axis=-1)
        motion = self.proper_motion[:, :1] * east + self.proper_motion[:, 1:] * north
        moved = self.direction + (year - EPOCH) * motion
        return np.asarray(moved / np.linalg.norm(moved, axis=-1, keepdims=True))

    def brighter_than(self, magnitude: float) -> StarCatalogue:
        """Return the stars with V below `magnitude`, without copying."""
        count = int(np.searchsorted(self.magnitude, magnitude, side="left"))
        return StarCatalogue(
            self.hip[:count], self.direction[:count], self.proper_motion[:count], self.magnitude[:count]
        )


@cache
def load(table: Path = TABLE) -> StarCatalogue:
    """Return the catalogue, read once a process. Raises InputError when the table is missing or damaged."""
    try:
        with table.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            columns = {name: stored[name] for name in COLUMNS}
    except _DAMAGED as error:
        cure = "make it again with `python -m knightcube.astro.catalogue.build WHEEL_OR_PARQUET`"
        raise InputError(str(table), f"no star table can be read here ({error}); {cure}") from error
    ra = columns["right_ascension"] * MILLIARCSECOND
    dec = columns["declination"] * MILLIARCSECOND
    cosine = np.cos(dec)
    catalogue = StarCatalogue(
        hip=columns["hip"],
        direction=np.stack([cosine * np.cos(ra), cosine * np.sin(ra), np.sin(dec)], axis=-1),
        proper_motion=columns["proper_motion"] * (0.01 * MILLIARCSECOND),
        magnitude=columns["magnitude"] / 100.0,
    )
    for array in (catalogue.hip, catalogue.direction, catalogue.proper_motion, catalogue.magnitude):
        array.setflags(write=False)
    return catalogue
