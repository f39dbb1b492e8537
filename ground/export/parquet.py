"""Parquet, a file for each kind of packet, for data frames; unit and meaning are each column's metadata."""

from __future__ import annotations

from pathlib import Path

from ground.export.columns import tables
from ground.telemetry import Run
from knightcube.errors import UsageError


def write_parquet(run: Run, folder: Path) -> list[Path]:
    """Write `<packet>.parquet` for every kind of packet that came; return the files.

    Raises OSError; UsageError without pyarrow.
    """
    try:
        import pyarrow  # noqa: PLC0415 - an extra
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise UsageError("Parquet needs pyarrow: pip install 'knightcube-flight[parquet]'") from error
    paths = []
    for name, columns in tables(run):
        arrays = [pyarrow.array(column.values) for column in columns]
        fields = [
            pyarrow.field(column.name, array.type, metadata={"unit": column.unit, "meaning": column.meaning})
            for column, array in zip(columns, arrays, strict=True)
        ]
        paths.append(folder / f"{name}.parquet")
        parquet.write_table(pyarrow.table(arrays, schema=pyarrow.schema(fields)), paths[-1])
    return paths
