"""Commands `knightcube samples` (pictures for trying other commands) and `knightcube index` (sky index)."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from flight.app.cli import PROGRAM
from flight.app.cli.run import seed_number
from flight.schema import reader as configuration
from flight.schema.devices import camera_model
from ground.commands.options import add_field
from knightcube.errors import UsageError
from knightcube.vision.star_tracker import field_of_view
from knightcube.vision.startracker.index import save
from knightcube.vision.startracker.index.build import DEFAULT, IndexSettings, build


def configure_samples(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube samples` to the parser."""
    parser.description = (
        "Render sample pictures: a field of stars, streaks with a satellite among them, the Earth's limb, "
        "and a few night skies for a calibration. The file truth.json has the true values of each; the "
        "commands to try are printed."
    )
    parser.epilog = "example: knightcube samples --out samples"
    parser.add_argument("--out", type=Path, default=Path("samples"), metavar="DIR", help="default: samples")
    parser.add_argument("--seed", type=seed_number, default=1, metavar="N", help="of the noise (default 1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run_samples)


def run_samples(options: argparse.Namespace) -> int:
    """Render and write the sample images, and print example commands."""
    from ground.samples import FIELD_DEG, write_samples, write_truth  # noqa: PLC0415 - slow to load

    out: Path = options.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{out}: cannot be made: {error.strerror or error}") from error
    written = write_samples(out, options.seed, _progress)
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    write_truth(out / "truth.json", {path.name: sample.truth for path, sample in written})
    nights = [str(path) for path, sample in written if sample.name.startswith("night")]
    lines = [sample.words.format(path) for path, sample in written if not sample.name.startswith("night")]
    lines.append(f"calibrate {' '.join(nights)} --fov {FIELD_DEG:g} --out {out / 'camera.yaml'}")
    facts: dict[str, Any] = {
        "files": [str(path) for path, _ in written],
        "truth": str(out / "truth.json"),
        "try": lines,
    }
    if options.json:
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        sys.stdout.write("".join(f"{path}\n" for path in [*facts["files"], facts["truth"]]))
        sys.stdout.write("\ntry:\n" + "".join(f"  {PROGRAM} {line}\n" for line in lines))
    return 0


def _progress(name: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[Krendering {name} ...")
        sys.stderr.flush()


def configure_index(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube index` to the parser."""
    parser.description = (
        "Make the sky index of one camera: triangles that fit into its field of view, of the stars that it "
        "detects. Pairs of stars that its pixels do not resolve are merged. The file is named by "
        "camera.star_tracker.index of a configuration, or by --index of `knightcube solve`."
    )
    parser.epilog = "example: knightcube index --camera flight.yaml --faintest 6.5 --out mission.index"
    add_field(parser, required=True)
    text = "magnitude of the faintest star that the camera detects (default %(default)s)"
    parser.add_argument("--faintest", type=float, default=DEFAULT.faintest, metavar="V", help=text)
    parser.add_argument(
        "--epoch", type=float, default=DEFAULT.epoch, metavar="YEAR", help="Julian year (default %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file of the index")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run_index)


def run_index(options: argparse.Namespace) -> int:
    """Build and write the sky index."""
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
