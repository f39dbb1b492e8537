"""Reader of recorded packets from bytes or from the folder of a run, and their export to other formats.

The reader counts every byte, inside or outside packets. The packets of a run are exported to CSV files,
Parquet files, or one SQLite database, with the same columns: the first column is the mission time `time_s`,
and an array has one column per element, such as quaternion_1 to quaternion_4. Numbers are written with full
precision. The table of events also contains the UTC of each event.
"""

from __future__ import annotations

import csv
import math
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.definitions import EVENT, States
from flight.link.telemetry.log import find_runs, find_segments
from flight.link.telemetry.packets import (
    HEADER_BYTES,
    LAYOUTS,
    SEQUENCE_MODULUS,
    Layout,
    PacketArray,
    TelemetryError,
    to_text,
    truncated_bytes,
    walk,
)
from knightcube.errors import UsageError, reason_of, shown


def text_of(value: bytes) -> str:
    """Return the text of a string field. Control characters, which could affect a terminal, are replaced."""
    return shown(to_text(value))


def named(states: States, number: Any) -> str:
    """Return the name of an enumerated value in a packet, or the number if it has no name."""
    return dict(states).get(int(number), str(int(number)))


@dataclass(frozen=True)
class ScanResult:
    """Packets found in a sequence of bytes, and the numbers of bytes inside and outside packets.

    Attributes:
        packets: structured array of each packet type in order of arrival, which may be empty.
        total_bytes: number of bytes scanned.
        skipped_bytes: number of bytes that belong to no valid packet, excluding a truncated last packet.
        truncated_bytes: number of bytes at the end that look like the beginning of a packet.
        missing: number of missing packets of each type according to the sequence counts. A gap is counted
            modulo 16,384, the range of the sequence count.
        other_versions: number of valid packets whose definition has a different version, which are not
            decoded.
    """

    packets: dict[str, PacketArray]
    total_bytes: int
    skipped_bytes: int
    truncated_bytes: int
    missing: dict[str, int]
    other_versions: int

    @property
    def counts(self) -> dict[str, int]:
        """Number of packets of each packet type in the data, by name."""
        return {name: len(array) for name, array in self.packets.items() if len(array)}

    @property
    def intact(self) -> bool:
        """Whether every byte belongs to a packet and no packet is missing."""
        damage = self.skipped_bytes + self.truncated_bytes + self.other_versions
        return damage + sum(self.missing.values()) == 0


def scan(data: bytes, whole: bool = False) -> ScanResult:
    """Return the packets in `data`, and the numbers of bytes inside and outside packets.

    If `whole` is true, the data are those from the start of a flight, where the sequence counts begin at
    zero, so packets that are missing before the first found packet are counted too.
    """
    found = {name: bytearray() for name in LAYOUTS}  # lists of packets would need twice as much memory
    claimed = other_versions = last = 0
    for layout, begin, end in walk(data):
        if data[begin + HEADER_BYTES] == layout.packet.version:
            found[layout.packet.name] += data[begin:end]
        else:
            other_versions += 1
        claimed += end - begin
        last = end
    truncated = truncated_bytes(data, last)
    joined = {name: bytes(found.pop(name)) for name in LAYOUTS}
    return ScanResult(
        packets={name: LAYOUTS[name].array(raw) for name, raw in joined.items()},
        total_bytes=len(data),
        skipped_bytes=len(data) - claimed - truncated,
        truncated_bytes=truncated,
        missing={name: _missing(LAYOUTS[name], raw, whole) for name, raw in joined.items()},
        other_versions=other_versions,
    )


def _missing(layout: Layout, packets: bytes, whole: bool) -> int:
    """Return the number of packets missing between the found packets, according to their sequence counts.

    If `whole` is true, the packets that are missing before the first found packet are counted too.
    """
    if not packets:
        return 0
    counts = np.asarray(layout.sequence_counts(packets), dtype=np.int64)
    steps = np.diff(counts, prepend=-1) if whole else np.diff(counts)
    return int(np.sum((steps - 1) % SEQUENCE_MODULUS))


def decode(data: bytes) -> dict[str, PacketArray]:
    """Return arrays of the packets in `data` by packet name.

    Raises TelemetryError if a byte belongs to no valid packet or a packet's definition has another version.
    """
    result = scan(data)
    bad = result.skipped_bytes + result.truncated_bytes
    if bad or result.other_versions:
        others = result.other_versions
        raise TelemetryError(f"{bad} bytes belong to no packet, {others} packets are of another version")
    return result.packets


def with_sorted_events(packets: Mapping[str, PacketArray]) -> dict[str, PacketArray]:
    """Return packets by name with the events in the order of their times.

    A log may contain an event up to some seconds after later events, because the flight holds it back
    (`flight.loop.facts.EventLog`).
    """
    events = packets[EVENT.name]
    return {**packets, EVENT.name: events[np.argsort(events["time_ns"], kind="stable")]}


@dataclass(frozen=True)
class Run:
    """Packets of the logs in the folder of a run. The events are in the order of their times.

    `truth` and `performance` are empty if the run has no such log.
    """

    folder: Path
    flight: ScanResult
    truth: ScanResult
    performance: ScanResult

    @property
    def logs(self) -> dict[str, ScanResult]:
        """The flight log, the truth log and the performance log, by the stems of their file names."""
        return {"flight": self.flight, "truth": self.truth, "performance": self.performance}

    def dropped_segments(self, stem: str) -> int:
        """Return the number of oldest segments that were deleted because the log exceeded its size budget."""
        names = [path.stem for path in find_segments(self.folder, stem)]
        return int(names[0].rpartition("-")[2]) - 1 if names else 0

    def __getitem__(self, name: str) -> PacketArray:
        """Return the packets of a type from the log that contains them, or an empty array."""
        for log in self.logs.values():
            if len(log.packets[name]):
                return log.packets[name]
        return LAYOUTS[name].array(b"")


def flight_segments(folder: Path) -> list[Path]:
    """Return the segments of the flight log in a run's folder. Raises UsageError if there are none."""
    segments = find_segments(folder, "flight")
    if not segments:
        runs = find_runs(folder) if folder.is_dir() else []
        cure = f": give the folder of one run of this archive, such as {runs[-1]}" if runs else ""
        raise UsageError(f"{folder}: no flight log (flight-0001.ccsds) in this folder{cure}")
    return segments


def not_a_folder(path: Path) -> UsageError:
    """Return the error for a file given as a run; it names the file's folder if a flight log is there."""
    near = f", such as {path.parent}" if find_segments(path.parent, "flight") else ""
    return UsageError(f"{path}: is not a folder: give the folder of a run{near}")


def is_first(segment: Path) -> bool:
    """Return whether a file is the first segment of a log, with the first packets of a flight."""
    return int(segment.stem.rpartition("-")[2]) == 1


def read_run(folder: Path) -> Run:
    """Read a run's folder. Raises UsageError if the folder has no flight log with a valid packet."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise not_a_folder(folder)
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder of a run (option --out of the run)")
    segments = flight_segments(folder)
    logs = []
    for stem in ("flight", "truth", "performance"):
        try:
            paths = segments if stem == "flight" else find_segments(folder, stem)
            # If the oldest segments of a log were deleted, their packets are not counted as missing.
            whole = stem == "flight" and is_first(paths[0])
            logs.append(scan(b"".join(path.read_bytes() for path in paths), whole))
        except OSError as error:
            raise UsageError(f"{folder}: the {stem} log cannot be read: {reason_of(error)}") from error
    flight, truth, performance = logs
    if not flight.counts:
        raise UsageError(f"{folder}: no valid packet in the {flight.total_bytes} bytes of the flight log")
    flight = replace(flight, packets=with_sorted_events(flight.packets))
    return Run(folder, flight, truth, performance)


@dataclass(frozen=True, slots=True)
class PacketColumn:
    """Values of a column, as a list of texts or an array (n,) of numbers in native byte order."""

    name: str
    unit: str
    meaning: str
    values: list[str] | npt.NDArray[Any]


def tables(run: Run) -> Iterator[tuple[str, list[PacketColumn]]]:
    """Yield the name and the columns of each packet type in the run."""
    for name, layout in LAYOUTS.items():
        if len(run[name]):
            columns = list(_columns(layout, run[name]))
            yield name, columns + ([_dates(run)] if layout.packet is EVENT else [])


def _dates(run: Run) -> PacketColumn:
    """Return the column with the UTC of each event, computed from the newest packet `run`."""
    label, times = run["run"], run["event"]["time_ns"].tolist()
    start_ns = int(label["utc_ns"][-1]) if len(label) else 0
    meaning = "UTC by the newest packet run; empty if the flight knew no UTC"
    texts = [date_of(start_ns + time_ns) if start_ns > 0 else "" for time_ns in times]
    return PacketColumn("utc", "-", meaning, texts)


def date_of(utc_ns: int) -> str:
    """Return a UTC in ns since 1970 as ISO 8601 text with milliseconds; an impossible date is empty."""
    with suppress(OverflowError, ValueError, OSError):
        date = datetime.fromtimestamp(utc_ns // 10**9, UTC)
        return f"{date:%Y-%m-%dT%H:%M:%S}.{utc_ns // 10**6 % 1000:03d}Z"
    return ""


def _columns(layout: Layout, packets: PacketArray) -> Iterator[PacketColumn]:
    yield PacketColumn("time_s", "s", "mission time", np.asarray(packets["time_ns"] / 1e9))
    for field in layout.packet.fields:
        values = packets[field.name]
        if field.kind.startswith("S"):
            yield PacketColumn(field.name, field.unit, field.meaning, [to_text(value) for value in values])
            continue
        native = values.astype(values.dtype.newbyteorder("="))
        spread = {field.name: native}
        if field.count > 1:
            spread = {f"{field.name}_{i + 1}": native[:, i] for i in range(field.count)}
        for column, own in spread.items():
            yield PacketColumn(column, field.unit, field.meaning, own)


def write_csv(run: Run, folder: Path) -> list[Path]:
    """Write `<packet>.csv` for each packet type, and return the files. Raises OSError.

    The first row contains the names of the columns, and all other rows contain values. The file `fields.csv`
    has one row for each column of each packet type, with its unit and meaning. NaN is written as `NaN`,
    because polars reads a column with `nan` as text.
    """
    paths, described = [], []
    for name, columns in tables(run):
        paths.append(folder / f"{name}.csv")
        described += [(name, column.name, column.unit, column.meaning) for column in columns]
        rows = zip(*(_printed(column.values) for column in columns), strict=True)
        _write_rows(paths[-1], [column.name for column in columns], rows)
    paths.append(folder / "fields.csv")
    _write_rows(paths[-1], ["packet", "name", "unit", "meaning"], described)
    return paths


def _printed(values: list[str] | npt.NDArray[Any]) -> list[Any]:
    if isinstance(values, list):
        return values
    return ["NaN" if math.isnan(value) else value for value in values.tolist()]


def _write_rows(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        writer.writerows(rows)


_TYPES = {"f": "REAL", "i": "INTEGER", "u": "INTEGER"}
_MAX_INTEGER = (1 << 63) - 1  # largest integer that SQLite supports


def write_database(run: Run, file: Path) -> list[Path]:
    """Write an SQLite database with one table per packet type, which replaces an existing file.

    Raises OSError.

    The table `fields` contains the unit and the meaning of each column. NaN becomes NULL, and a column with
    integers of more than 63 bits becomes text, because SQLite supports neither.
    """
    made = file.with_name(f"{file.name}.part")
    made.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(made)) as database, database:
            database.execute("CREATE TABLE fields (packet TEXT, name TEXT, unit TEXT, meaning TEXT)")
            for name, columns in tables(run):
                described = [(name, column.name, column.unit, column.meaning) for column in columns]
                database.executemany("INSERT INTO fields VALUES (?, ?, ?, ?)", described)
                kinds, values = zip(*(_in_database(column.values) for column in columns), strict=True)
                shape = ", ".join(f'"{one.name}" {kind}' for one, kind in zip(columns, kinds, strict=True))
                database.execute(f'CREATE TABLE "{name}" ({shape})')
                marks = ", ".join("?" * len(columns))
                database.executemany(f'INSERT INTO "{name}" VALUES ({marks})', zip(*values, strict=True))
        os.replace(made, file)
    except sqlite3.Error as error:
        raise OSError(None, str(error), str(file)) from error
    finally:
        made.unlink(missing_ok=True)
    return [file]


def _in_database(values: list[str] | npt.NDArray[Any]) -> tuple[str, list[Any]]:
    """Return the SQLite type of a column and its values; integers that SQLite does not support are texts."""
    if isinstance(values, list):
        return "TEXT", values
    if values.dtype.kind == "u" and np.any(values > _MAX_INTEGER):
        return "TEXT", [str(value) for value in values.tolist()]
    return _TYPES[values.dtype.kind], values.tolist()


def write_parquet(run: Run, folder: Path) -> list[Path]:
    """Write `<packet>.parquet` for each packet type, with unit and meaning as metadata, and return the files.

    Raises OSError if a file cannot be written, and UsageError if pyarrow is not installed.
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
        with paths[-1].open("wb") as file:  # pyarrow itself opens only paths that are UTF-8
            parquet.write_table(pyarrow.table(arrays, schema=pyarrow.schema(fields)), file)
    return paths


FORMATS = {"csv": "csv", "parquet": "parquet", "sqlite": "run.sqlite"}
"""Default output of each format in the folder of a run: a folder, or for SQLite a file."""


def export(run: Run, place: Path, form: str = "csv") -> list[Path]:
    """Write all packets in one of `FORMATS` into the folder or file `place`, and return the files.

    Raises UsageError if `place` cannot be written or a library is missing.
    """
    write = {"csv": write_csv, "parquet": write_parquet, "sqlite": write_database}[form]
    try:
        (place.parent if form == "sqlite" else place).mkdir(parents=True, exist_ok=True)
        return write(run, place)
    except OSError as error:
        raise UsageError(f"{place}: {form} cannot be written: {reason_of(error)}") from error
