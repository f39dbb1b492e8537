"""`flight samples`: pictures to try the other commands on, with their truth."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from flight.app.cli import PROGRAM
from flight.app.cli.run import seed_number
from ground.truth import write_truth
from knightcube.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Render sample pictures: a field of stars, streaks with a satellite among them, the Earth's limb, "
        "and a few night skies for a calibration. truth.json beside them holds what each shows; the "
        "commands to try are printed."
    )
    parser.epilog = "example: python -m flight samples --out samples"
    parser.add_argument("--out", type=Path, default=Path("samples"), metavar="DIR", help="default: samples")
    parser.add_argument("--seed", type=seed_number, default=1, metavar="N", help="of the noise (default 1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Render, write, print the commands to try."""
    from ground.samples import FIELD_DEG, write_samples  # noqa: PLC0415 - the simulator is slow to load

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
