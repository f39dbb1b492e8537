"""`flight index`: the sky index for a mission's camera."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

from flight.schema import reader as configuration
from flight.schema.devices import camera_model
from ground.commands.options import add_field
from knightcube.errors import UsageError
from knightcube.vision.star_tracker import field_of_view
from knightcube.vision.startracker.index.build import DEFAULT, IndexSettings, build
from knightcube.vision.startracker.index.sky_index import save


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Make the sky index of one camera: triangles of the sizes that its field of view shows, of stars "
        "down to its faintest, with pairs merged that its pixels do not resolve. The configuration's "
        "camera.star_tracker.index, or --index of `flight solve`, names the file."
    )
    parser.epilog = "example: python -m flight index --camera flight.yaml --faintest 6.5 --out mission.index"
    add_field(parser, required=True)
    parser.add_argument(
        "--faintest",
        type=float,
        default=DEFAULT.faintest,
        metavar="V",
        help="magnitude of the faintest star that the camera sees (default %(default)s)",
    )
    parser.add_argument(
        "--epoch", type=float, default=DEFAULT.epoch, metavar="YEAR", help="Julian year (default %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="where the index is written")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Build and write the index."""
    if not all(math.isfinite(value) for value in (options.faintest, options.epoch)):
        raise UsageError("--faintest and --epoch: give finite numbers")
    sky = build(replace(_settings(options), faintest=options.faintest, epoch=options.epoch))
    try:
        save(sky, options.out)
    except OSError as error:
        raise UsageError(f"--out {options.out}: cannot be written: {error.strerror or error}") from error
    stars, triangles = len(sky.stars), len(sky.triangles)
    if options.json:
        sys.stdout.write(
            json.dumps({"index": str(options.out), "stars": stars, "triangles": triangles}) + "\n"
        )
    else:
        sys.stdout.write(f"{options.out}: {stars} stars, {triangles} triangles\n")
    return 0


def _settings(options: argparse.Namespace) -> IndexSettings:
    if options.camera is None:
        return IndexSettings.of_field(math.radians(options.fov))
    camera = camera_model(configuration.load_camera(options.camera))
    return IndexSettings.of_field(field_of_view(camera), 1.0 / camera.focal_length)
