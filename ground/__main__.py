"""`python -m ground`: what a ground station needs beside the commands of `python -m flight`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from flight.gnc.errors import FlightError, UsageError
from ground.link.keys import make_keys


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 done, 1 ran and failed, 2 wrong use."""
    parser = argparse.ArgumentParser(prog="python -m ground", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    keys = commands.add_parser("keys", help="make the keys of a link")
    keys.description = (
        "Make new keys: FOLDER/satellite for the board, FOLDER/ground for the ground, readable by their "
        "owner alone. Never overwrites."
    )
    keys.add_argument("folder", type=Path, metavar="FOLDER", help="does not exist yet")
    keys.set_defaults(command=_keys)
    options = parser.parse_args(arguments)
    try:
        status: int = options.command(options)
    except FlightError as error:
        sys.stderr.write(f"ground: {error}\n")
        return 2 if isinstance(error, UsageError) else 1
    return status


def _keys(options: argparse.Namespace) -> int:
    satellite, ground = make_keys(options.folder)
    sys.stdout.write(f"for the satellite: {satellite}\nfor the ground: {ground}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
