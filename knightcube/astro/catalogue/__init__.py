"""Star catalogue: Hipparcos stars to V 8.5 with ICRS positions at J1991.25, proper motions, magnitudes.

The table `hipparcos.npz` is built by `knightcube.astro.catalogue.build`. The table contains integers, so that
its content does not depend on the machine. Right ascension and declination are stored in milliarcseconds
(rounded by at most 0.71 mas), proper motions in 0.01 mas per year, and magnitudes in 0.01 mag.

Directions are in the Hipparcos frame, without parallax (at most 0.75") and aberration (20"). An unresolved
close pair of stars is one entry with the combined magnitude, as in Hipparcos.
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
"""Integer types of the table's columns.

Right ascension and declination are in mas, and magnitudes in 0.01 mag. Proper motions (n, 2), mu_alpha
cos(delta) and mu_delta, are in 0.01 mas/yr.
"""

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
"""Exceptions that can be raised while a damaged table is read. The module zipfile raises RuntimeError for
encrypted members and unknown compression methods."""


@dataclass(frozen=True, slots=True, eq=False)
class StarCatalogue:
    """Catalogue of stars in order of brightness, brightest first. The arrays are read-only.

    Attributes:
        hip: (n,) Hipparcos numbers.
        direction: (n, 3) ICRS unit vectors at epoch J1991.25.
        proper_motion: (n, 2) proper motions mu_alpha cos(delta) and mu_delta, rad/yr.
        magnitude: (n,) Johnson V magnitudes.
    """

    hip: npt.NDArray[np.int32]
    direction: FloatArray
    proper_motion: FloatArray
    magnitude: FloatArray

    def __len__(self) -> int:
        return len(self.hip)

    def directions_at(self, year: float) -> FloatArray:
        """Return ICRS unit vectors (n, 3) of the stars at a Julian year.

        Stars are assumed to move uniformly along the tangent at J1991.25, with zero radial velocity (ESA
        SP-1200, vol. 1, section 1.5.5). Raises ValueError if `year` is not finite.
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
        """Return the stars with a V magnitude below `magnitude`, without copying the arrays."""
        count = int(np.searchsorted(self.magnitude, magnitude, side="left"))
        return StarCatalogue(
            self.hip[:count], self.direction[:count], self.proper_motion[:count], self.magnitude[:count]
        )


@cache
def load(table: Path = TABLE) -> StarCatalogue:
    """Return the star catalogue, which is cached. Raises InputError if the table is missing or damaged."""
    try:
        with table.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            columns = {name: stored[name] for name in COLUMNS}
    except _DAMAGED as error:
        cure = "make it again with `python -m knightcube.astro.catalogue.build WHEEL_OR_PARQUET`"
        raise InputError(str(table), f"the star table cannot be read ({error}); {cure}") from error
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


PROPER_NAMES: dict[int, str] = {
    677: "Alpheratz", 746: "Caph", 1067: "Algenib", 2081: "Ankaa", 3179: "Schedar", 3419: "Diphda",
    5447: "Mirach", 7588: "Achernar", 8903: "Sheratan", 9640: "Almach", 9884: "Hamal", 10826: "Mira",
    11767: "Polaris", 14135: "Menkar", 14576: "Algol", 15863: "Mirfak", 17702: "Alcyone", 17847: "Atlas",
    21421: "Aldebaran", 23015: "Hassaleh", 23875: "Cursa", 24436: "Rigel", 24608: "Capella",
    25336: "Bellatrix", 25428: "Elnath", 25606: "Nihal", 25930: "Mintaka", 25985: "Arneb", 26241: "Hatysa",
    26311: "Alnilam", 26634: "Phact", 26727: "Alnitak", 27366: "Saiph", 27628: "Wazn", 27989: "Betelgeuse",
    28360: "Menkalinan", 30122: "Furud", 30324: "Mirzam", 30438: "Canopus", 31681: "Alhena", 32349: "Sirius",
    33579: "Adhara", 34444: "Wezen", 35904: "Aludra", 36188: "Gomeisa", 36850: "Castor", 37279: "Procyon",
    37826: "Pollux", 39429: "Naos", 41037: "Avior", 42913: "Alsephina", 44816: "Suhail", 45238: "Miaplacidus",
    45556: "Aspidiske", 45941: "Markeb", 46390: "Alphard", 49669: "Regulus", 50372: "Tania Borealis",
    50583: "Algieba", 50801: "Tania Australis", 53910: "Merak", 54061: "Dubhe", 54872: "Zosma",
    55219: "Alula Borealis", 57632: "Denebola", 58001: "Phecda", 59774: "Megrez", 59803: "Gienah",
    60718: "Acrux", 60965: "Algorab", 61084: "Gacrux", 61359: "Kraz", 61941: "Porrima", 62434: "Mimosa",
    62956: "Alioth", 63090: "Minelauva", 63125: "Cor Caroli", 63608: "Vindemiatrix", 65378: "Mizar",
    65474: "Spica", 65477: "Alcor", 66249: "Heze", 67301: "Alkaid", 67927: "Muphrid", 68702: "Hadar",
    68756: "Thuban", 68933: "Menkent", 69673: "Arcturus", 71075: "Seginus", 71683: "Rigil Kentaurus",
    72105: "Izar", 72607: "Kochab", 72622: "Zubenelgenubi", 73555: "Nekkar", 74785: "Zubeneschamali",
    75097: "Pherkad", 75458: "Edasich", 76267: "Alphecca", 77070: "Unukalhai", 78265: "Fang",
    78401: "Dschubba", 78820: "Acrab", 79593: "Yed Prior", 80112: "Alniyat", 80763: "Antares",
    80816: "Kornephoros", 81266: "Paikauhale", 82273: "Atria", 82396: "Larawag", 84012: "Sabik",
    84345: "Rasalgethi", 85670: "Rastaban", 85927: "Shaula", 86032: "Rasalhague", 86228: "Sargas",
    86742: "Cebalrai", 87833: "Eltanin", 88635: "Alnasl", 89931: "Kaus Media", 90185: "Kaus Australis",
    90496: "Kaus Borealis", 91262: "Vega", 92420: "Sheliak", 92855: "Nunki", 93194: "Sulafat",
    93506: "Ascella", 95947: "Albireo", 97165: "Fawaris", 97278: "Tarazed", 97649: "Altair",
    98036: "Alshain", 100453: "Sadr", 100751: "Peacock", 101421: "Aldulfin", 101769: "Rotanev",
    101958: "Sualocin", 102098: "Deneb", 102488: "Aljanah", 105199: "Alderamin", 106278: "Sadalsuud",
    106985: "Nashira", 107315: "Enif", 107556: "Deneb Algedi", 109074: "Sadalmelik", 109268: "Alnair",
    112029: "Homam", 112122: "Tiaki", 112158: "Matar", 113368: "Fomalhaut", 113881: "Scheat",
    113963: "Markab",
}  # fmt: skip
"""Proper names of bright stars by Hipparcos number, as approved by the IAU Working Group on Star Names.

A star with several Hipparcos entries has the number of its brightest entry.
"""
