"""The Sun sensor on simulated frames: errors, false Suns, time: `python -m tests.studies.bench sun`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from tests.support.sun_frames import CAMERAS, frames_with_sun, frames_without_sun


def _rms_degrees(errors: Sequence[float]) -> float:
    return float(np.degrees(np.sqrt(np.mean(np.square(errors))))) if errors else float("nan")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures; 1 when a Sun is found where there is none."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200, help="with the Sun, and as many without")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    false_suns = 0
    for name in CAMERAS:
        seen = frames_with_sun(name, options.frames, options.seed)
        unseen = frames_without_sun(name, options.frames, options.seed)
        wrong = unseen.statuses["found"] + unseen.statuses["partial"]
        false_suns += wrong
        squares = np.array(seen.squares)
        sys.stdout.write(
            f"{name}, {options.frames} frames, seed {options.seed}: {dict(seen.statuses)}\n"
            f"  error rms {_rms_degrees(seen.errors):.4f} deg, whole discs {_rms_degrees(seen.whole):.4f}, "
            f"largest {np.degrees(max(seen.errors)):.4f}\n"
            f"  NEES (2 expected) mean {squares.mean():.2f}, 99th percentile "
            f"{np.percentile(squares, 99):.1f}, largest {squares.max():.1f}\n"
            f"  CPU per frame median {1e3 * np.median(seen.seconds):.2f} ms, without a Sun "
            f"{1e3 * np.median(unseen.seconds):.2f} ms\n"
            f"  without a Sun: {dict(unseen.statuses)}, false {wrong}\n"
        )
    return 1 if false_suns else 0


if __name__ == "__main__":
    sys.exit(main())
