"""Tests with damaged two-line elements and damaged star tables."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import given

from knightcube.astro import catalogue
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.errors import InputError, UsageError
from knightcube.vision.startracker.index import Columns, TableKind, load_table, save_table
from tests.support.damaged import Files, chances, fill, offer

DAY = 2_461_000.5
"""Julian date near the epoch of the elements."""
LINES = (
    b"1 25544U 98067A   26060.50000000  .00016717  00000-0  10270-3 0  9004\n"
    b"2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391000006"
)
TABLE = TableKind(b"FUZZTABL", 1, "table", "make it again")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


def checksummed(data: bytes) -> bytes:
    """Return the lines of two-line elements with corrected checksums."""
    lines = [line.ljust(69)[:68] for line in data.split(b"\n")]
    sums = [sum(byte - 48 if 48 <= byte <= 57 else int(byte == 45) for byte in line) % 10 for line in lines]
    return b"\n".join(line + b"%d" % total for line, total in zip(lines, sums, strict=True))


@given(chances())
def test_damaged_elements_are_refused_or_give_a_finite_position(chance: Random) -> None:
    def read(files: Files, _: bool) -> None:
        first, _separator, second = files["tle"].decode("utf-8", "replace").partition("\n")
        state = TwoLineElements(first, second).at(DAY)
        assert all(map(math.isfinite, (*state.position, *state.velocity, state.sigma)))

    offer(chance, [{"tle": checksummed(LINES)}], read, (UsageError, OrbitError), checksummed)


@given(chances())
def test_a_damaged_star_table_is_refused_or_has_finite_directions(folder: Path, chance: Random) -> None:
    packed = io.BytesIO()
    shapes = {name: (5, 2) if name == "proper_motion" else 5 for name in catalogue.COLUMNS}
    columns = {name: np.ones(shapes[name], kind) for name, kind in catalogue.COLUMNS.items()}
    np.savez_compressed(packed, allow_pickle=False, **columns)

    def read(files: Files, _: bool) -> None:
        found = catalogue.load.__wrapped__(fill(folder, files) / "stars.npz")
        assert np.all(np.isfinite(found.direction))

    offer(chance, [{"stars.npz": packed.getvalue()}], read, (InputError,))


@given(chances())
def test_a_damaged_table_of_columns_is_refused_or_comes_back_as_written(folder: Path, chance: Random) -> None:
    columns: Columns = {"star": np.arange(40, dtype=np.int32), "direction": np.linspace(-1.0, 1.0, 30)}
    save_table(folder / "written", TABLE, columns, {"year": 2026.0})
    written = (folder / "written").read_bytes()

    def read(files: Files, _: bool) -> None:
        found, facts = load_table(fill(folder, files) / "table", TABLE)
        if files["table"] == written:
            assert facts == {"year": 2026.0}
            assert all(np.array_equal(found[name], columns[name]) for name in columns)

    def reseal(data: bytes) -> bytes:
        return data if len(data) < 20 else written[:12] + struct.pack("<I", zlib.crc32(data[20:])) + data[16:]

    offer(chance, [{"table": written}], read, (InputError,), reseal)
