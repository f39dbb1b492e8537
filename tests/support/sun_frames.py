"""Simulated frames of the Sun, and the results of the Sun sensor for these frames."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from knightcube.vision.sun import LINEAR, SunSettings, find_sun
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render
from tests.sim_hal.earth_camera.scenes import random_scene, random_sun_scene
from tests.support.earth_truth import sun_direction, sun_point

K1 = -0.1
"""Radial distortion coefficient of the lenses; it moves the corners inwards by 30 px."""


CAMERAS: dict[str, tuple[EarthCameraModel, SunSettings]] = {
    "logarithmic": (EarthCameraModel.fuga15d(k1=K1), SunSettings()),
    "linear": (EarthCameraModel.fuga15d(response="linear", k1=K1), LINEAR),
    "overexposed": (
        EarthCameraModel.fuga15d(response="linear", sensitivity=60_000.0, k1=K1),
        SunSettings(least_radius=np.radians(2.6), greatest_radius=np.radians(3.8)),
    ),
}
"""Cameras by name; with `overexposed`, sea and haze are bright and every cloud is saturated."""


@dataclass
class Outcome:
    """Results for a number of frames: errors (rad), normalised squared errors, statuses, CPU times (s)."""

    errors: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)


def frames_with_sun(name: str, count: int, seed: int) -> Outcome:
    """Return the results of `count` frames with the Sun's centre anywhere in the frame and a random Earth."""
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
    """Return the results of `count` frames of the sunlit limb, with the Sun at least 40 px outside."""
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
