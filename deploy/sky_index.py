"""Build the star tracker's sky index at installation, because it takes seconds at the start of a flight.

Run by install.sh with the installed Python: sky_index.py [--wanted] CONFIG; with --wanted it only prints a
word when there is an index to build.
"""

from __future__ import annotations

import sys
from pathlib import Path

from flight.schema.reader import load


def main(words: list[str]) -> None:
    """Build the index that the configuration needs, or print that it is missing."""
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
