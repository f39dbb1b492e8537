"""The sky index for star identification: guide stars and their triangles, in one memory-mapped file.

The file begins with a header, which contains 8 magic bytes that identify the kind of table, the version
(uint32), the CRC-32 of everything after the header (uint32), and the length of the table of contents
(uint32). The table of contents is in JSON format and is followed by the columns, which are little-endian and
begin at multiples of 64 bytes. The command `python -m knightcube.vision.startracker.index.build` builds the
index. The same stars and settings give a file with the same bytes.

Guide stars are the catalogue stars as a given lens resolves them (Michalski, section 3.3). Proper motion is
applied up to the epoch of observation. Stars that an image cannot resolve are merged into one star at their
centroid, with their combined magnitude. Aberration depends on the velocity of the camera; it is applied to
the matched directions on board.

The index contains only triangles whose stars are among the brightest in a circle of the triangle's size. The
distance from a star to the `rank`-th nearest of all brighter stars is called the reach of the star. The index
contains a triangle if its longest side is at most the reach of each of its three stars. Each star of a
triangle in the index is therefore one of the `rank` brightest stars in a circle that is centred on the star
and has the longest side as its radius. Frames of any field of view, in dense and in sparse regions of the
sky, therefore contain about the same number of triangles of the index. Near a cluster of bright stars, the
reach of all stars is so short that there would be too few triangles. The sky is therefore also covered by
circles of several radii, and the triangles of the `few` brightest stars of each circle are added to the
index.

The sides of a triangle are chords of the unit sphere. The form of a triangle consists of the orientation
(left or right) of its corners, ordered by the lengths of the opposite sides, and of the cells that contain
the ratios of the shortest and of the middle side to the longest side. The entry of a triangle consists of its
longest side and of the positions of both ratios within their cells. An entry has only four bytes, so that it
is read quickly. Triangles with the same form are contiguous and sorted by their longest sides.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
import threading
import zlib
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cache, cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.catalogue import StarCatalogue
from knightcube.errors import InputError

Columns = dict[str, npt.NDArray[Any]]
Facts = dict[str, float]
_HEADER = struct.Struct("<8sIII")
_ALIGNMENT = 64
_UNFIT = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError, SyntaxError)
"""Exceptions that may be raised if a file with a correct checksum has invalid contents."""


@dataclass(frozen=True, slots=True)
class TableKind:
    """A kind of table file.

    Attributes:
        magic: first 8 bytes of a file of this kind.
        version: version of the layout of the columns.
        name: name of this kind of table in messages.
        cure: advice to the user that is added to messages about an unusable file.
    """

    magic: bytes
    version: int
    name: str
    cure: str

    def __post_init__(self) -> None:
        """Raise ValueError unless `magic` has 8 bytes."""
        if len(self.magic) != 8:
            raise ValueError(f"magic {self.magic!r}: give 8 bytes")


def save_table(path: Path, kind: TableKind, columns: Columns, facts: Facts) -> None:
    """Write a table of `columns` and metadata (`facts`) to the file `path`, in one atomic operation."""
    little = {
        name: np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<"))
        for name, column in columns.items()
    }
    contents: dict[str, Any] = {"facts": facts, "columns": {}}
    offset = 0
    for name, column in little.items():
        contents["columns"][name] = [column.dtype.str, list(column.shape), offset]
        offset += -(-column.nbytes // _ALIGNMENT) * _ALIGNMENT
    table = json.dumps(contents, sort_keys=True).encode()
    table += b" " * (-(_HEADER.size + len(table)) % _ALIGNMENT)
    body = bytearray(table)
    for column in little.values():
        body += column.tobytes() + b"\0" * (-column.nbytes % _ALIGNMENT)
    # Two threads or processes may write at the same time. Each writes a separate file and renames it.
    temporary = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}.new")
    header = _HEADER.pack(kind.magic, kind.version, zlib.crc32(body), len(table))
    try:
        temporary.write_bytes(header + bytes(body))
        temporary.replace(path)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise


def load_table(path: Path, kind: TableKind) -> tuple[Columns, Facts]:
    """Return the columns of a table, memory-mapped and read-only, and its metadata (`facts`).

    Raises InputError if the file is missing, damaged, of another kind or of another version.
    """
    name, cure = kind.name, kind.cure
    try:
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise InputError(str(path), f"the {name} cannot be read ({error}); {cure}") from error
    if len(mapped) < _HEADER.size or mapped[: len(kind.magic)] != kind.magic:
        raise InputError(str(path), f"the file is not a {name}; {cure}")
    _, version, checksum, length = _HEADER.unpack_from(mapped)
    if version != kind.version:
        raise InputError(str(path), f"the {name} has version {version} instead of {kind.version}; {cure}")
    if zlib.crc32(memoryview(mapped)[_HEADER.size :]) != checksum:
        raise InputError(str(path), f"the {name} is damaged: its CRC-32 is wrong; {cure}")
    try:
        return _columns(mapped, _HEADER.size + length)
    except _UNFIT as error:
        raise InputError(str(path), f"the contents of the {name} cannot be read ({error}); {cure}") from error


def _columns(mapped: mmap.mmap, begin: int) -> tuple[Columns, Facts]:
    contents = json.loads(mapped[_HEADER.size : begin])
    columns = {
        name: np.frombuffer(mapped, np.dtype(kind), math.prod(shape), begin + offset).reshape(shape)
        for name, (kind, shape, offset) in contents["columns"].items()
    }
    if any(column.dtype.hasobject for column in columns.values()):
        raise TypeError("a column does not contain numbers")
    return columns, {str(name): float(fact) for name, fact in contents["facts"].items()}


@dataclass(frozen=True, slots=True, eq=False)
class GuideStars:
    """Stars as the camera resolves them, the brightest first.

    Attributes:
        hip: Hipparcos numbers (n,), int32; for merged stars, the number of the brightest star.
        direction: unit vectors to the stars (n, 3), ICRS, at `epoch`.
        magnitude: Johnson V magnitudes (n,); for merged stars, the combined magnitude.
        epoch: Julian year of the directions.
    """

    hip: npt.NDArray[np.int32]
    direction: FloatArray
    magnitude: FloatArray
    epoch: float

    def __len__(self) -> int:
        return len(self.hip)

    def __repr__(self) -> str:
        """Return the number of stars, the magnitude of the faintest, and the epoch, without the arrays."""
        faintest = f" to V {self.magnitude[-1]:.1f}" if len(self) else ""
        return f"<GuideStars: {len(self)} stars{faintest}, epoch {self.epoch:.6g}>"

    def brighter_than(self, magnitude: float) -> GuideStars:
        """Return the stars with V magnitudes below `magnitude`, as views of the same arrays."""
        count = int(np.searchsorted(self.magnitude, magnitude, side="left"))
        return GuideStars(self.hip[:count], self.direction[:count], self.magnitude[:count], self.epoch)


def choose_guide_stars(
    catalogue: StarCatalogue, faintest: float, epoch: float, resolution: float
) -> GuideStars:
    """Return the guide stars with V magnitudes below `faintest`, for the Julian year `epoch`.

    Stars closer together than `resolution`, rad, are merged; a chain of close stars becomes one star. Raises
    ValueError if `epoch` is not finite.
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
    # The catalogue is sorted by magnitude.
    # The number of a group is the index of its first and brightest star.
    first = np.flatnonzero(group == np.arange(len(catalogue)))
    magnitude = -2.5 * np.log10(joint[first])
    seen = np.flatnonzero(magnitude < faintest)
    order = seen[np.argsort(magnitude[seen], kind="stable")]
    members = first[order]
    directions = centre[members] / np.linalg.norm(centre[members], axis=-1, keepdims=True)
    return GuideStars(catalogue.hip[members], directions, magnitude[order], epoch)


def _connected(count: int, pairs: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return the lowest star index in the group of each star (count,); the stars of a pair share a group."""
    group = np.arange(count)
    while True:
        lowest = np.minimum(group[pairs[:, 0]], group[pairs[:, 1]])
        previous = group.copy()
        np.minimum.at(group, pairs[:, 0], lowest)
        np.minimum.at(group, pairs[:, 1], lowest)
        if np.array_equal(previous, group):
            return group


CELLS = 128
"""Number of cells (bins) into which the range 0 to 1 of a triangle's side ratio is divided."""
FINE = 256
"""Number of steps into which a cell is divided, for the stored side ratio of a triangle."""
SIZES = 1 << 16
OCTAVE = SIZES // 8
"""Number of steps of a triangle's longest side per factor of two; the chord 1 is step `SIZES`."""
RUN_BITS = 10
"""Binary logarithm of the number of steps (see `SIZES`) in one interval of `TriangleIndex.below`."""
# Number of boxes along each axis into which the cube around the unit sphere is divided for star searches.
_BOXES = 20
TIE = 1e-9
"""Relative tolerance for rounding errors in comparisons of a triangle's side with a limit."""
LEAST_RATIO = 0.1
"""Minimum ratio of the shortest to the longest side of a triangle. Flat triangles are not distinctive."""


# Distance between the centres of neighbouring circles that together cover the sky, relative to their radius.
_CIRCLES_APART = 0.7
# Mean number of stars per circle in the first search, relative to the number of stars needed.
_ENOUGH = 4.0
# Number of stars that are compared with each star, on average, as a multiple of `rank`.
_BRIGHTER = 2.0


@dataclass(frozen=True, eq=False)
class TriangleIndex:
    """Triangles of guide stars, sorted by form and longest side.

    Attributes:
        begin: index of the first triangle of each of f forms, followed by the number of triangles (f + 1,),
            int32.
        entry: entry of each triangle (m,), uint32: the longest side (`size_steps`) in the upper 16 bits, and
            the positions of the shortest and of the middle side's ratios in 8 bits each.
        corners: indices of the guide stars opposite the shortest, middle and longest side (m, 3), uint16.
    """

    begin: npt.NDArray[np.int32]
    entry: npt.NDArray[np.uint32]
    corners: npt.NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.entry)

    def __repr__(self) -> str:
        """Return the number of triangles; the arrays are not read."""
        return f"<TriangleIndex: {len(self)} triangles>"

    @cached_property
    def below(self) -> npt.NDArray[np.int32]:
        """The numbers (i + 1,) of triangles before each of i intervals of the longest side, form by form."""
        form = np.repeat(np.arange(len(self.begin) - 1), np.diff(self.begin))
        intervals = SIZES >> RUN_BITS
        count = np.bincount(
            form * intervals + (self.entry >> np.uint32(16 + RUN_BITS)),
            minlength=(len(self.begin) - 1) * intervals,
        )
        return np.concatenate([[0], np.cumsum(count)]).astype(np.int32)

    @cached_property
    def table(self) -> tuple[npt.NDArray[Any], ...]:
        """The arrays entry, corners and below, contiguous and read-only, and the parameters (6,) of entries.

        The parameters are `CELLS`, `SIZES`, `OCTAVE` and `RUN_BITS`, and the minimum and maximum of the
        encoded longest sides of all triangles.
        """
        size = self.entry >> np.uint32(16)
        limits = (int(size.min()), int(size.max())) if len(size) else (0, 0)
        layout = np.array([CELLS, SIZES, OCTAVE, RUN_BITS, *limits])
        arrays = [
            np.ascontiguousarray(array).view() for array in (self.entry, self.corners, self.below, layout)
        ]
        for array in arrays:
            array.flags.writeable = False
        return tuple(arrays)


def reach(direction: FloatArray, rank: int, farthest: float, least: float = 0.0) -> FloatArray:
    """Return the reach of each star (n,): the chord to its `rank`-th nearest brighter star.

    The reach is at most `farthest`, which is also the reach of a star with fewer than `rank` brighter stars.
    The result may be zero for a star whose `rank`-th nearest brighter star is closer than `least`. The unit
    vectors `direction` (n, 3) are in order of brightness, the brightest first.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - to make a table, not to read one

    count = len(direction)
    result = np.full(count, farthest)
    wanted = np.arange(count)
    # Most stars have a reach below `least`. A fast comparison with the brightest stars identifies them.
    brightest = math.ceil(4.0 * _BRIGHTER * rank / least**2) if least > 0.0 else count
    if brightest < count:
        near = cKDTree(direction[:brightest]).query_ball_point(
            direction[brightest:], least * (1.0 - TIE), return_length=True
        )
        result[brightest:][near >= rank] = 0.0
        wanted = np.flatnonzero(result)
    begin = 0
    while begin < count:
        end = min(max(2 * begin, 4 * rank), count)
        stars = wanted[np.searchsorted(wanted, begin) : np.searchsorted(wanted, end)]
        # About half of a star's neighbours are brighter, so that 4 x `rank` neighbours are enough.
        neighbours = min(4 * rank, end)
        distance, number = cKDTree(direction[:end]).query(
            direction[stars], neighbours, distance_upper_bound=farthest * (1.0 + TIE)
        )
        order = np.cumsum(number < stars[:, None], axis=1)
        enough = order[:, -1] >= rank
        column = np.where(enough, np.argmax(order >= rank, axis=1), neighbours - 1)
        found = distance[np.arange(len(stars)), column]
        if neighbours == end:
            found[~enough] = farthest
        result[stars] = np.minimum(found, farthest)
        begin = end
    return result


def build_triangles(direction: FloatArray, sizes: FloatArray, ranks: IntArray, few: int) -> TriangleIndex:
    """Return the index of triangles of the stars with unit vectors `direction` (n, 3), the brightest first.

    Triangles are sorted by their longest side into b bands with the limits `sizes` (b + 1,), which are
    chords. A triangle is included only if, for each of its stars, the number of brighter stars closer than
    the longest side is below the limit `ranks` (b,) of the band. The sky is also covered by circles with the
    radii `sizes`, and the triangles of the `few` brightest stars of each circle are added.
    """
    bands = zip(sizes[:-1], sizes[1:], ranks, strict=True)
    found = [np.sort(_band(direction, *band), axis=1) for band in bands]
    if few >= 3:
        found += [_of_circles(direction, sizes[0], radius, few) for radius in sizes[:-1]]
    return _indexed(direction, _distinct(np.concatenate(found)))


def _of_circles(direction: FloatArray, smallest: float, radius: float, few: int) -> IntArray:
    """Return the triangles (m, 3) of the `few` brightest stars in circles of `radius` that cover the sky."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - to make a table, not to read one

    centres = evenly_spread(math.ceil(4.0 * math.pi / (_CIRCLES_APART * radius) ** 2))
    # All stars are searched only for circles that contain too few of the sky's brightest stars.
    brightest = min(math.ceil(_ENOUGH * few * 4.0 / radius**2), len(direction))
    chosen = np.full((len(centres), few), len(direction))
    for count in sorted({brightest, len(direction)}):
        stars = direction[:count]
        poor = np.flatnonzero(chosen[:, -1] == len(direction))
        inside = cKDTree(stars).query_ball_point(centres[poor], radius, return_sorted=True)
        for circle, numbers in zip(poor, inside, strict=True):
            chosen[circle, : len(numbers)] = numbers[:few]
    one, two, three = np.array(list(combinations(range(few), 3))).T
    corners = np.stack([chosen[:, one], chosen[:, two], chosen[:, three]], axis=-1).reshape(-1, 3)
    corners = _distinct(corners[corners[:, 2] < len(direction)])
    place = direction[corners]
    side = np.linalg.norm(place - np.roll(place, 1, axis=1), axis=-1)
    longest = side.max(axis=1)
    return np.asarray(corners[(longest >= smallest) & (side.min(axis=1) >= LEAST_RATIO * longest)])


def _distinct(corners: IntArray) -> IntArray:
    """Return the distinct rows of triangles (m, 3) in ascending order; there are at most 2^16 stars."""
    one, two, three = corners.T
    packed = np.sort((one << 32) + (two << 16) + three)
    packed = packed[np.diff(packed, prepend=-1) > 0]
    return np.stack([packed >> 32, (packed >> 16) & 0xFFFF, packed & 0xFFFF], axis=-1)


def evenly_spread(count: int) -> FloatArray:
    """Return unit vectors (count, 3) that cover the sphere evenly (a Fibonacci lattice)."""
    place = np.arange(count) + 0.5
    z = 1.0 - 2.0 * place / count
    turn = place * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)


def _band(direction: FloatArray, smallest: float, largest: float, rank: int) -> IntArray:
    """Return the triangles (m, 3) with a longest side between `smallest` and `largest`.

    For each star of a triangle, fewer than `rank` brighter stars are closer to it than the longest side.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - to make a table, not to read one

    limit = reach(direction, rank, largest, smallest)
    able = np.flatnonzero(limit >= smallest)
    # With stars sorted by `limit`, each triangle is found once, from its star with the smallest `limit`.
    able = able[np.argsort(-limit[able], kind="stable")]
    limit, place = limit[able] * (1.0 + TIE), direction[able]
    first, last = np.sort(cKDTree(place).query_pairs(largest, output_type="ndarray"), axis=1).T
    close = np.linalg.norm(place[first] - place[last], axis=-1) <= limit[last]
    first, last = first[close], last[close]
    order = np.lexsort((first, last))
    first = first[order]
    count = np.bincount(last, minlength=len(able))
    begin = np.cumsum(count) - count
    found = []
    for partners in range(2, int(count.max(initial=0)) + 1):
        stars = np.flatnonzero(count == partners)
        near = first[begin[stars, None] + np.arange(partners)]
        one, two = np.triu_indices(partners, 1)
        corners = np.stack(np.broadcast_arrays(stars[:, None], near[:, one], near[:, two]), axis=-1).reshape(
            -1, 3
        )
        side = np.linalg.norm(place[corners] - place[np.roll(corners, 1, axis=1)], axis=-1)
        longest = side.max(axis=1)
        kept = (longest <= limit[corners[:, 0]]) & (longest >= smallest) & (longest < largest)
        kept &= side.min(axis=1) >= LEAST_RATIO * longest
        found.append(able[corners[kept]])
    return np.concatenate([np.empty((0, 3), dtype=np.int64), *found])


def _indexed(direction: FloatArray, corners: IntArray) -> TriangleIndex:
    a, b, c = (direction[corners[:, column]] for column in range(3))
    sides = np.stack(
        [np.linalg.norm(b - c, axis=-1), np.linalg.norm(c - a, axis=-1), np.linalg.norm(a - b, axis=-1)], -1
    )
    order = np.argsort(sides, axis=-1)
    sides = np.take_along_axis(sides, order, axis=-1)
    corners = np.take_along_axis(corners, order, axis=-1)
    a, b, c = (direction[corners[:, column]] for column in range(3))
    left = np.einsum("ij,ij->i", np.cross(a, b), c) > 0.0
    place = np.minimum(sides[:, :2] / sides[:, 2:] * (CELLS * FINE), CELLS * FINE - 1).astype(np.int64)
    cell, fine = np.divmod(place, FINE)
    form = (left * CELLS + cell[:, 0]) * CELLS + cell[:, 1]
    entry = (size_steps(sides[:, 2]) * FINE + fine[:, 0]) * FINE + fine[:, 1]
    sorting = np.lexsort((corners[:, 2], corners[:, 1], corners[:, 0], (form << 32) | entry))
    count = np.bincount(form, minlength=2 * CELLS * CELLS)
    return TriangleIndex(
        np.concatenate([[0], np.cumsum(count)]).astype(np.int32),
        entry[sorting].astype(np.uint32),
        corners[sorting].astype(np.uint16),
    )


def size_steps(size: FloatArray) -> IntArray:
    """Return longest sides of triangles in logarithmic steps: `OCTAVE` steps for each factor of two."""
    return np.asarray(np.clip(np.log2(size) * OCTAVE + SIZES, 0, SIZES - 1), dtype=np.int64)


_VERSION = 4
KIND = TableKind(
    b"KCSKYIDX",
    _VERSION,
    "sky index",
    "make it with `knightcube index`; "
    "`python -m knightcube.vision.startracker.index.build` makes the default index",
)
PATH = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "knightcube" / f"sky-{_VERSION}.index"
)
"""Path of the default sky index."""


@dataclass(frozen=True, eq=False)
class SkyIndex:
    """Guide stars, and triangles of the locally brightest guide stars.

    Attributes:
        stars: guide stars at the epoch of the index.
        motion: proper motion of each guide star as the change of its unit vector (n, 3), rad/yr, float32.
        triangles: triangles of guide stars, sorted by form and longest side.
    """

    stars: GuideStars
    motion: npt.NDArray[np.float32]
    triangles: TriangleIndex

    def __repr__(self) -> str:
        """Return the numbers of stars and triangles, without the arrays."""
        return f"<SkyIndex: {self.stars!r}, {self.triangles!r}>"

    @cached_property
    def coarse(self) -> npt.NDArray[np.float32]:
        """The unit vectors to the guide stars as (3, n), float32, for a fast search near a boresight."""
        return np.ascontiguousarray(self.stars.direction.T, dtype=np.float32)

    @cached_property
    def boxes(self) -> tuple[npt.NDArray[np.int32], FloatArray, npt.NDArray[np.int32]]:
        """Guide stars sorted by spatial box: indices (n,), directions (n, 3), and the offset of each box.

        The cube around the unit sphere is divided into boxes, the same number along each axis. The stars of a
        box are in order of brightness, the brightest first.
        """
        x, y, z = np.minimum(((self.stars.direction + 1.0) * (0.5 * _BOXES)).astype(np.int64), _BOXES - 1).T
        box = (x * _BOXES + y) * _BOXES + z
        count = np.bincount(box, minlength=_BOXES**3)
        begin = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
        star = np.argsort(box, kind="stable").astype(np.int32)
        return star, self.stars.direction[star], begin

    def at(self, epoch: float) -> SkyIndex:
        """Return the index with the directions of the stars at the Julian year `epoch`.

        The triangles are not changed, because a star with a proper motion of 1"/yr moves by only 0.03 deg in
        a century. Raises ValueError if `epoch` is not finite.
        """
        if not np.isfinite(epoch):
            raise ValueError(f"epoch = {epoch!r}: give a finite Julian year, such as 2030.5")
        moved = self.stars.direction + (epoch - self.stars.epoch) * self.motion
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        stars = GuideStars(self.stars.hip, np.asarray(moved), self.stars.magnitude, epoch)
        return SkyIndex(stars, self.motion, self.triangles)


def save(sky: SkyIndex, path: Path | str) -> None:
    """Write the sky index atomically to the file `path`. Raises OSError if the file cannot be written."""
    columns: Columns = {
        "hip": sky.stars.hip,
        "direction": sky.stars.direction.astype(np.float32),
        "magnitude": np.round(sky.stars.magnitude * 1000.0).astype(np.int16),
        "motion": sky.motion,
    }
    for field in fields(sky.triangles):
        columns[field.name] = np.asarray(getattr(sky.triangles, field.name))
    save_table(Path(path), KIND, columns, {"epoch": sky.stars.epoch})


def load(path: Path | str = PATH) -> SkyIndex:
    """Return the sky index in a file; the triangles are memory-mapped.

    Raises InputError if the file is missing, damaged, or of another version.
    """
    columns, facts = load_table(Path(path), KIND)
    direction: FloatArray = columns["direction"].astype(np.float64)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    stars = GuideStars(columns["hip"], direction, columns["magnitude"] / 1000.0, facts["epoch"])
    triangles = TriangleIndex(**{field.name: columns[field.name] for field in fields(TriangleIndex)})
    return SkyIndex(stars, columns["motion"], triangles)


@cache
def load_once(path: Path) -> SkyIndex:
    """Return the sky index in a file, which is read once per process.

    Raises InputError if the file is missing, damaged, or of another version.
    """
    return load(path)
