"""Doors of tables and pictures: sky index, star catalogue, image files.

Accepted corruption is a table whose numbers differ from those written under a CRC of 32 bits.
"""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
from PIL import Image as pillow

from knightcube.astro import catalogue
from knightcube.errors import InputError, UsageError
from knightcube.vision.camera.images import read_image
from knightcube.vision.startracker.index.sky_index import Columns, TableKind, load_table, save_table
from tests.studies.fuzz.door import Door, DoorTarget, Files
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.stored_files import Folder

_KIND = TableKind(b"FUZZTABL", 1, "table", "make it again")
_HEADER_BYTES, _CRC_AT = 20, 12


def index() -> DoorTarget:
    """Return the door of a file of columns, as the sky index is."""
    folder = Folder()
    columns: Columns = {
        "star": np.arange(40, dtype=np.int32),
        "direction": np.linspace(-1.0, 1.0, 30).reshape(10, 3),
    }
    save_table(folder.path / "table", _KIND, columns, {"year": 2026.0})
    example = {"table": (folder.path / "table").read_bytes()}

    def enter(files: Files, _: bool) -> str:
        read, facts = load_table(folder.fill(files) / "table", _KIND)
        same = read.keys() == columns.keys() and all(np.array_equal(read[k], columns[k]) for k in columns)
        resealed = files["table"] != example["table"]
        if not resealed and not (same and facts == {"year": 2026.0}):
            raise Finding("a table that comes out as another")
        return "accepted"

    def reseal(_: str, data: bytes) -> bytes:
        if len(data) < _HEADER_BYTES:
            return data
        head = example["table"][:_CRC_AT]
        return head + struct.pack("<I", zlib.crc32(data[_HEADER_BYTES:])) + data[16:]

    return DoorTarget(Door([example], enter, (InputError,), reseal))


def stars() -> DoorTarget:
    """Return the door of the catalogue's table, with a few stars."""
    folder = Folder()
    packed = io.BytesIO()
    columns = {
        name: np.ones((5, 2) if name == "proper_motion" else 5, kind)
        for name, kind in catalogue.COLUMNS.items()
    }
    np.savez_compressed(packed, allow_pickle=False, **columns)
    example = {"stars.npz": packed.getvalue()}
    load = catalogue.load.__wrapped__

    def enter(files: Files, _: bool) -> str:
        found = load(folder.fill(files) / "stars.npz")
        if not np.all(np.isfinite(found.direction)):
            raise Finding("directions that are no numbers")
        return "accepted"

    return DoorTarget(Door([example], enter, (InputError,)))


def images() -> DoorTarget:
    """Return the door of picture files of every kind that is read."""
    folder = Folder()
    draw = np.random.default_rng(3)
    grey = draw.integers(0, 255, (12, 16), dtype=np.uint8)
    deep = draw.integers(0, 65535, (12, 16), dtype=np.uint16)
    examples: list[Files] = []
    for kind, pixels in (
        ("PNG", grey), ("PNG", deep), ("TIFF", grey), ("TIFF", deep), ("BMP", grey), ("JPEG", grey),
        ("PNG", np.repeat(grey[..., None], 3, axis=2)),
    ):  # fmt: skip
        packed = io.BytesIO()
        pillow.fromarray(pixels).save(packed, format=kind)
        examples.append({"picture": packed.getvalue()})
    cards = (
        "SIMPLE  =                    T",
        "BITPIX  =                   16",
        "NAXIS   =                    2",
    )
    sizes = (
        "NAXIS1  =                   16",
        "NAXIS2  =                   12",
        "BZERO   =              32768.0",
        "END",
    )
    header = "".join(card.ljust(80) for card in (*cards, *sizes)).ljust(2880).encode()
    examples.append({"picture": header + deep.astype(">i2").tobytes().ljust(2880, b"\0")})

    def enter(files: Files, _: bool) -> str:
        pixels = read_image(folder.fill(files) / "picture")
        if pixels.ndim != 2 or 0 in pixels.shape or not np.all(np.isfinite(pixels)):
            raise Finding(f"pixels that are no image: {pixels.shape}")
        return "accepted"

    return DoorTarget(Door(examples, enter, (UsageError,)))
