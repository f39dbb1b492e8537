"""Centroids against the Cramer-Rao bound, and their time: `python -m tests.studies.bench.centroids`.

Frames of the simulator's default camera (1024 x 1024, 12 bits, 10 e- read noise) at rest, 0.2 s, each with 40
stars of one magnitude at random places, none near another. The bound is that of place, light, sky and point
spread in the pixels that are not saturated; detection knows none of them, nor the gain. A ratio is the rms
error along one axis over the root of the mean bound. Seeds of its own.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict

from knightcube.vision.startracker.detection.survey import CENTROIDS
from sim_hal.star_camera import StarCameraModel
from tests.support.centroid_bound import compare

_SEED = 27_182


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench.centroids", description=__doc__)
    parser.add_argument("--psf-sigma", type=float, nargs="+", default=[0.7, 1.0, 1.5], help="px")
    parser.add_argument("--magnitudes", type=float, nargs="+", default=[1, 2, 3, 4, 5, 6, 7])
    parser.add_argument("--frames", type=int, default=20, help="a row; default %(default)s")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    options = parser.parse_args(arguments)
    rows = []
    if not options.json:
        sys.stdout.write(
            f"{options.frames} frames of 40 stars a row, seed {options.seed}; px; CPU ms a frame\n"
        )
        sys.stdout.write(
            "PSF  mag method      found      false  rms     bias +-          ratio  NEES  detect  track 30\n"
        )
    for psf_sigma in options.psf_sigma:
        camera = StarCameraModel(psf_sigma=psf_sigma)
        for magnitude in options.magnitudes:
            for method in CENTROIDS:
                row = compare(camera, magnitude, method, options.frames, options.seed)
                rows.append(row)
                if options.json:
                    continue
                sys.stdout.write(
                    f"{row.psf_sigma:.1f} {row.magnitude:4.1f} {row.method:9} {row.found:5d}/{row.stars:<5d}"
                    f" {row.false:4d}  {row.rms:.4f}  {row.bias:.4f} +- {row.bias_error:.4f}"
                    f" {row.ratio:7.2f} {row.nees:6.2f} {row.detect_ms:6.1f} {row.track_ms:6.1f}\n"
                )
                sys.stdout.flush()
    if options.json:
        sys.stdout.write(json.dumps({"frames": options.frames, "rows": [asdict(row) for row in rows]}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
