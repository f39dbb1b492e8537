"""The Sun sensor on simulated frames: errors, false Suns, time: `python -m tests.studies.bench sun`."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from knightcube.vision.sun import LINEAR, SunSettings, find_sun
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render, sun_direction, sun_point
from tests.sim_hal.earth_camera.scenes import random_scene, random_sun_scene

K1 = -0.1
"""Of the bench's lenses: it draws the corners in by 30 px."""
CAMERAS: dict[str, tuple[EarthCameraModel, SunSettings]] = {
    "logarithmic": (EarthCameraModel.fuga15d(k1=K1), SunSettings()),
    "linear": (EarthCameraModel.fuga15d(response="linear", k1=K1), LINEAR),
    "overexposed": (
        EarthCameraModel.fuga15d(response="linear", sensitivity=60_000.0, k1=K1),
        SunSettings(least_radius=np.radians(2.6), greatest_radius=np.radians(3.8)),
    ),
}
"""`overexposed` sees sea and haze bright and every cloud saturated."""


@dataclass
class Outcome:
    """A campaign's figures: errors in rad, normalised squares, statuses, CPU seconds of each frame."""

    errors: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)


def frames_with_sun(name: str, count: int, seed: int) -> Outcome:
    """Return what `count` frames give whose Sun's centre is anywhere in the frame, Earth where it may be."""
    model, settings = CAMERAS[name]
    generator = np.random.default_rng(seed)
    outcome = Outcome()
    for _ in range(count):
        scene = random_sun_scene(generator, model)
        pixels = render(model, scene, generator)
        begin = time.process_time()
        solution = find_sun(pixels, model.lens, settings)
        outcome.seconds.append(time.process_time() - begin)
        outcome.statuses[solution.status.value] += 1
        if solution.sun is None:
            continue
        off = solution.sun.basis @ sun_direction(scene)
        outcome.errors.append(float(np.hypot(*off)))
        if not solution.sun.cut:
            outcome.whole.append(outcome.errors[-1])
        outcome.squares.append(float(off @ np.linalg.solve(solution.sun.tangent_covariance, off)))
    return outcome


def frames_without_sun(name: str, count: int, seed: int) -> Outcome:
    """Return what `count` frames of the sunlit limb give, the Sun 40 px or more outside the frame."""
    model, settings = CAMERAS[name]
    generator = np.random.default_rng(seed)

    def sun_is_away(scene: EarthScene) -> bool:
        return not model.lens.contains(sun_point(scene, model)[None, :], 40.0)[0]

    outcome = Outcome()
    for _ in range(count):
        scene = random_scene(generator, model, "sunlit", accept=sun_is_away)
        pixels = render(model, scene, generator)
        begin = time.process_time()
        solution = find_sun(pixels, model.lens, settings)
        outcome.seconds.append(time.process_time() - begin)
        outcome.statuses[solution.status.value] += 1
    return outcome


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
