"""Builds the star tracker's sky index at installation, so that flights start some seconds earlier.

The script install.sh runs `sky_index.py [--wanted] CONFIG` with the installed Python. With the option
--wanted the program builds no index, but prints the word `wanted` if an index must be built.
"""

from __future__ import annotations

import sys
from pathlib import Path

from flight.schema.reader import load
from knightcube.errors import UsageError


def main(words: list[str]) -> int:
    """Build the sky index if the configuration needs it and it is missing, and return the exit status."""
    if words[:-1] not in ([], ["--wanted"]) or words[-1:] in ([], ["--wanted"], ["--help"]):
        sys.stderr.write("usage: sky_index.py [--wanted] CONFIG\n")
        return 2
    try:
        camera = load(Path(words[-1])).camera
    except UsageError as error:
        sys.stderr.write(f"install: {error}\n")
        return 2
    tracker = camera.star_tracker if camera is not None else None
    if tracker is None or tracker.index is not None:
        return 0
    from knightcube.vision.startracker.index.build import PATH, ensure_default_index  # noqa: PLC0415

    if PATH.exists():
        return 0
    if words[0] == "--wanted":
        sys.stdout.write("wanted\n")
    else:
        ensure_default_index()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
