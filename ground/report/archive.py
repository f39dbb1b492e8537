"""An archive of runs as a table: a row for each boot, and whether it ended by itself."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flight.link import events
from flight.link.telemetry.archive import find_runs
from flight.link.telemetry.packets import to_text
from ground.report.text import number, table
from ground.telemetry.reader import Run, read_run
from knightcube.errors import UsageError

Object = dict[str, Any]


def summarise_archive(archive: Path) -> Object:
    """Return what each run of an archive was and how it ended, ready for JSON. One run is read at a time."""
    return {"archive": str(archive), "runs": [_row(folder) for folder in find_runs(archive)]}


def format_archive(summary: Object) -> str:
    """Return the table, ending in a newline."""
    head = ["run", "configuration", "UTC (a label)", "s", "packets", "bad bytes", "missing", "end"]
    rows = [
        [
            Path(row["folder"]).name,
            row["config_name"] or "-",
            row["utc"] or "-",
            number(row["duration_s"], 1),
            str(row["packets"]),
            str(row["bad_bytes"]),
            str(row["missing_packets"]),
            row["end"],
        ]
        for row in summary["runs"]
    ]
    lines = [f"Archive {summary['archive']}: {len(rows)} runs", *table(head, rows)]
    return "\n".join(lines) + "\n"


def _row(folder: Path) -> Object:
    row: Object = {
        "folder": str(folder),
        "config_name": None,
        "utc": None,
        "duration_s": None,
        "packets": 0,
        "bad_bytes": 0,
        "missing_packets": 0,
    }
    try:
        run = read_run(folder)
    except UsageError:
        return {**row, "end": "no flight log"}
    log = run.flight
    if len(run["run"]):
        first = run["run"][0]
        row |= {"config_name": to_text(first["config_name"]), "utc": _label(int(first["utc_ns"]))}
    if len(run["control"]):
        row["duration_s"] = float(run["control"]["time_ns"][-1]) * 1e-9
    return {
        **row,
        "packets": sum(log.counts.values()),
        "bad_bytes": log.skipped_bytes + log.truncated_bytes,
        "missing_packets": sum(log.missing.values()),
        "end": _end(run),
    }


def _end(run: Run) -> str:
    """Return the reason that the loop gave for its end; a log without one stopped in the middle."""
    recorded = run["event"]
    stops = recorded["text"][recorded["code"] == events.STOPPED.code]
    return to_text(stops[-1]) if len(stops) else "unclean: the log just stops"


def _label(utc_ns: int) -> str | None:
    try:
        return f"{datetime.fromtimestamp(utc_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return None
