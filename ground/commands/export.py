"""`flight export`: a run's packets as CSV."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from flight.link.telemetry.reader import read_run
from ground.export import export as export_packets


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Write one CSV file for each kind of packet; fields and units are in docs/telemetry.md."
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the files (default RUN/csv)")
    parser.add_argument("--json", action="store_true", help="print the files as one JSON object")
    parser.set_defaults(command=export)


def export(options: argparse.Namespace) -> int:
    """Write the files and name them."""
    paths = export_packets(read_run(options.run), options.out or options.run / "csv")
    if options.json:
        sys.stdout.write(json.dumps({"files": [str(path) for path in paths]}) + "\n")
    else:
        sys.stdout.write("".join(f"{path}\n" for path in paths))
    return 0
