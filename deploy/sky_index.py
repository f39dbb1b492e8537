"""Make the star tracker's sky index, which takes seconds, now and not at the start of a flight.

Run by install.sh with the installed Python: sky_index.py [--wanted] CONFIG; with --wanted it only says
whether there is one to be made, by a word or none.
"""

from __future__ import annotations

import sys
from pathlib import Path

from flight.schema.reader import load


def main(words: list[str]) -> None:
    """Make the index that the configuration of the command line wants, or tell that it is missing."""
    camera = load(Path(words[-1])).camera
    tracker = camera.star_tracker if camera is not None else None
    if tracker is None or tracker.index is not None:
        return
    from flight.gnc.vision.startracker.index.build import PATH, ensure_default_index  # noqa: PLC0415

    if PATH.exists():
        return
    if words[0] == "--wanted":
        sys.stdout.write("wanted\n")
    else:
        ensure_default_index()


if __name__ == "__main__":
    main(sys.argv[1:])
