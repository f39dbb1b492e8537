"""What identification knows of the sky, in one memory-mapped file: guide stars and their triangles.

Layout: a header of 8 bytes of magic, uint32 version, uint32 CRC-32 of all that follows the header, uint32
length of a JSON table of contents; the table; then the columns, each on a multiple of 64 bytes,
little-endian. `python -m flight.startracker.build` makes the file, the same bytes for the same stars and
limits.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.arrays import FloatArray
from flight.errors import ConfigError
from flight.startracker.guide_stars import GuideStars
from flight.startracker.triangle_index import TriangleIndex

VERSION = 1
PATH = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "knightcube" / f"sky-{VERSION}.index"
)
"""Where the default index is kept."""
CURE = "make it again with `python -m flight.startracker.build`"
_MAGIC = b"KCSKYIDX"
_HEADER = struct.Struct("<8sIII")
_ALIGNMENT = 64


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
        """The stars' directions, one axis a row (3, n): to tell quickly which are near a boresight."""
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
    payload = _payload(sky)
    # Two processes may make it at once: each its own, and the last one stays.
    temporary = path.with_name(f"{path.name}.{os.getpid()}.new")
    temporary.write_bytes(payload)
    temporary.replace(path)


def _columns(sky: SkyIndex) -> dict[str, npt.NDArray[Any]]:
    columns: dict[str, npt.NDArray[Any]] = {
        "hip": sky.stars.hip,
        "direction": sky.stars.direction.astype(np.float32),
        "magnitude": np.round(sky.stars.magnitude * 1000.0).astype(np.int16),
        "motion": sky.motion,
    }
    for field in fields(sky.triangles):
        columns[field.name] = np.asarray(getattr(sky.triangles, field.name))
    return columns


def _payload(sky: SkyIndex) -> bytes:
    columns = {name: np.ascontiguousarray(column) for name, column in _columns(sky).items()}
    contents: dict[str, Any] = {"epoch": sky.stars.epoch, "columns": {}}
    offset = 0
    for name, column in columns.items():
        little = column.dtype.newbyteorder("<").str
        contents["columns"][name] = [little, list(column.shape), offset]
        offset += -(-column.nbytes // _ALIGNMENT) * _ALIGNMENT
    table = json.dumps(contents, sort_keys=True).encode()
    table += b" " * (-(_HEADER.size + len(table)) % _ALIGNMENT)
    body = bytearray(table)
    for column in columns.values():
        body += column.astype(column.dtype.newbyteorder("<"), copy=False).tobytes()
        body += b"\0" * (-column.nbytes % _ALIGNMENT)
    return _HEADER.pack(_MAGIC, VERSION, zlib.crc32(body), len(table)) + bytes(body)


def load(path: Path = PATH) -> SkyIndex:
    """Return the index of a file, its triangles mapped and not read.

    Raises ConfigError when the file is missing, damaged, or of another version.
    """
    try:
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise ConfigError(str(path), f"no sky index can be read here ({error}); {CURE}") from error
    if len(mapped) < _HEADER.size or mapped[: len(_MAGIC)] != _MAGIC:
        raise ConfigError(str(path), f"this is no sky index; {CURE}")
    _, version, checksum, length = _HEADER.unpack_from(mapped)
    if version != VERSION:
        raise ConfigError(str(path), f"a sky index of version {version}, {VERSION} is wanted; {CURE}")
    if zlib.crc32(memoryview(mapped)[_HEADER.size :]) != checksum:
        raise ConfigError(str(path), f"the sky index is damaged, its CRC-32 is wrong; {CURE}")
    contents = json.loads(mapped[_HEADER.size : _HEADER.size + length])
    begin = _HEADER.size + length
    columns = {
        name: np.frombuffer(mapped, kind, int(np.prod(shape)), begin + offset).reshape(shape)
        for name, (kind, shape, offset) in contents["columns"].items()
    }
    return _index(columns, float(contents["epoch"]))


@cache
def load_once(path: Path) -> SkyIndex:
    """Return the index of a file, read once a process. Raises ConfigError as `load`."""
    return load(path)


def _index(columns: dict[str, npt.NDArray[Any]], epoch: float) -> SkyIndex:
    direction: FloatArray = columns["direction"].astype(np.float64)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    stars = GuideStars(columns["hip"], direction, columns["magnitude"] / 1000.0, epoch)
    triangles = TriangleIndex(**{field.name: columns[field.name] for field in fields(TriangleIndex)})
    return SkyIndex(stars, columns["motion"], triangles)
