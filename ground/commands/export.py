"""`flight export`: a run's packets for other people's tools."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ground.export import FORMATS
from ground.export import export as export_packets
from ground.export.tracking_data import write_tracking_data
from ground.telemetry import read_run


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Write one file for each kind of packet, CSV or Parquet (extra `parquet`), or one SQLite file with a "
        "table for each; fields and units are in docs/telemetry.md."
    )
    parser.epilog = "example: python -m flight export runs/demo --format sqlite"
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--format", choices=FORMATS, default="csv", help="default: csv")
    places = ", ".join(f"RUN/{place}" for place in FORMATS.values())
    parser.add_argument(
        "--out",
        type=Path,
        metavar="PLACE",
        help=f"folder of the files, or the SQLite file (default {places})",
    )
    parser.add_argument(
        "--tdm",
        type=Path,
        metavar="FILE",
        help="write the tracks of objects instead: a CCSDS Tracking Data Message",
    )
    parser.add_argument("--json", action="store_true", help="print the files as one JSON object")
    parser.set_defaults(command=export)


def export(options: argparse.Namespace) -> int:
    """Write the files and name them."""
    if options.tdm is not None:
        paths = write_tracking_data(read_run(options.run), options.tdm)
    else:
        place = options.out or options.run / FORMATS[options.format]
        paths = export_packets(read_run(options.run), place, options.format)
    if options.json:
        sys.stdout.write(json.dumps({"files": [str(path) for path in paths]}) + "\n")
    else:
        sys.stdout.write("".join(f"{path}\n" for path in paths))
    return 0
