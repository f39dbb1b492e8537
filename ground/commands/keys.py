"""`python -m ground keys`: make the keys of a link."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ground.link.keys import make_keys


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Make new keys: FOLDER/satellite for the board, FOLDER/ground for the ground, readable by their "
        "owner alone. Never overwrites."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="does not exist yet")
    parser.set_defaults(command=keys)


def keys(options: argparse.Namespace) -> int:
    """Make them, and say where they are."""
    satellite, ground = make_keys(options.folder)
    sys.stdout.write(f"for the satellite: {satellite}\nfor the ground: {ground}\n")
    return 0
