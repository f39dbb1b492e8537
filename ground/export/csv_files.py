"""CSV, a file for each kind of packet, for spreadsheets.

The first row names the columns. The second row begins with '#' and gives the units. Numbers are written to
full precision.
"""

from __future__ import annotations

import csv
from pathlib import Path

from ground.export.columns import tables
from ground.telemetry import Run


def write_csv(run: Run, folder: Path) -> list[Path]:
    """Write `<packet>.csv` for every kind of packet that came; return the files. Raises OSError."""
    paths = []
    for name, columns in tables(run):
        paths.append(folder / f"{name}.csv")
        values = [v if isinstance(v, list) else v.tolist() for v in (column.values for column in columns)]
        units = [column.unit for column in columns]
        with paths[-1].open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([column.name for column in columns])
            writer.writerow([f"# {units[0]}", *units[1:]])
            writer.writerows(zip(*values, strict=True))
    return paths
