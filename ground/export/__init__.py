"""A run's packets for other people's tools: CSV files, Parquet files, or one SQLite database.

All have the same columns: mission time `time_s` first; arrays are spread out as quaternion_1 .. quaternion_4.
"""

from __future__ import annotations

from pathlib import Path

from ground.export.csv_files import write_csv
from ground.export.database import write_database
from ground.export.parquet import write_parquet
from ground.telemetry import Run
from knightcube.errors import UsageError

FORMATS = {"csv": "csv", "parquet": "parquet", "sqlite": "run.sqlite"}
"""Each format with its usual place in the folder of a run: a folder of files, or the one file."""


def export(run: Run, place: Path, form: str = "csv") -> list[Path]:
    """Write every kind of packet that came, in one of `FORMATS`; return the files.

    `place` is a folder, for "sqlite" the file. Raises UsageError when nothing can be written there, or when
    Parquet's library is missing.
    """
    write = {"csv": write_csv, "parquet": write_parquet, "sqlite": write_database}[form]
    try:
        (place.parent if form == "sqlite" else place).mkdir(parents=True, exist_ok=True)
        return write(run, place)
    except OSError as error:
        raise UsageError(f"{place}: no {form} can be written there: {error.strerror or error}") from error
