"""Identification on random testbeds, with the complete software: `python -m tests.ground.identification`."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from ground.identification.fit import absolute, fit, noise_of, prior_of
from tests.ground.identification.worlds import believed, drawn, fly_bare, fly_stack, motion_error, scale_error


def main() -> int:
    """Run flights in random worlds, fit the constants of each world, and compare them with the truth."""
    parser = argparse.ArgumentParser(prog="python -m tests.ground.identification", description=__doc__)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=200.0)
    parser.add_argument(
        "--bare", action="store_true", help="simulate the bare testbed instead of the whole flight stack"
    )
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    config = believed()
    noise = noise_of(config)
    motion, scaled, relative, coloured, reach = [], [], [], 0, 0.0
    for number in range(options.runs):
        world = drawn(rng)
        with tempfile.TemporaryDirectory() as place:
            record = (
                fly_bare(world, options.duration)
                if options.bare
                else fly_stack(world, Path(place), options.duration)
            )
        found = fit(record, noise)
        error = motion_error(world, found.constants)
        motion.append((error, found.covariance[:3, :3]))
        plant = absolute(found, prior_of(config), record.field)
        # One of the six constants is omitted, because it is a combination of the first three and the last two
        # constants.
        keep = [0, 1, 2, 4, 5]
        scaled.append((scale_error(world, plant)[keep], plant.covariance[np.ix_(keep, keep)]))
        relative.append(np.abs(error) / world.constants.to_array()[:3])
        coloured += not found.whiteness.passed
        reach = max(reach, float(np.max(np.abs(record.angle[record.time > 15.0]))))
        sys.stderr.write(f"\r{number + 1} of {options.runs}")
    sys.stderr.write("\n")
    _progress("gain, torsion, damping", motion)
    _progress("with the scale", scaled)
    errors = np.array(relative)
    print(f"relative error, median: {np.median(errors, axis=0)}, worst: {errors.max(axis=0)}")  # noqa: T201
    print(f"innovations not white: {coloured} of {options.runs}; largest |q2|: {np.sin(reach / 2):.3f}")  # noqa: T201
    return 0


def _progress(name: str, pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    squares = np.array([error @ np.linalg.solve(covariance, error) for error, covariance in pairs])
    size = len(pairs[0][0])
    z = np.array([error / np.sqrt(np.diag(covariance)) for error, covariance in pairs])
    low, high = chi2.ppf([0.025, 0.975], size * len(pairs)) / len(pairs)
    print(  # noqa: T201
        f"{name}: mean chi-square {squares.mean():.2f} of {size}, 95 % band [{low:.2f}, {high:.2f}]; "
        f"z mean {np.round(z.mean(axis=0), 2)}, z rms {np.round(np.sqrt((z**2).mean(axis=0)), 2)}"
    )


if __name__ == "__main__":
    sys.exit(main())
