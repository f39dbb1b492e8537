"""Builds the star tracker's sky index at installation, so that flights start some seconds earlier.

The script install.sh runs `sky_index.py [--wanted] CONFIG` with the installed Python. With the option
--wanted the program builds no index, but prints the word `wanted` if an index must be built.
"""

from __future__ import annotations

import sys
from pathlib import Path

from flight.schema.reader import load


def main(words: list[str]) -> None:
    """Build the sky index if the configuration needs it and it is missing."""
    camera = load(Path(words[-1])).camera
    tracker = camera.star_tracker if camera is not None else None
    if tracker is None or tracker.index is not None:
        return
    from knightcube.vision.startracker.index.build import PATH, ensure_default_index  # noqa: PLC0415

    if PATH.exists():
        return
    if words[0] == "--wanted":
        sys.stdout.write("wanted\n")
    else:
        ensure_default_index()


if __name__ == "__main__":
    main(sys.argv[1:])
