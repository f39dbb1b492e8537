"""Campaign `false-horizons`: false detections in pictures without a limb.

The pictures show ground, weather, skylines, marks and glare. They are independent of `sim_hal.earth_camera`.
Each is an intensity of 0 to 1 on a plane, composed of noise with a power-law spectrum, ramps, polygons and
discs. `photographed` adds blur, noise, camera response and quantisation. Each picture is taken by a random
one of several cameras, and searched with three kinds of prior knowledge: none, the altitude, or that of a
flight in a random scene (position, Sun direction, coarse measurements of Sun and field). Any nadir found in
these pictures is a false detection.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.horizon.nadir import find_nadir
from knightcube.vision.horizon.settings import HorizonKnowledge
from tests.sim_hal.earth_camera.scenes import random_scene
from tests.studies.campaigns.statistics import grouped
from tests.support.limb_frames import camera_model, coarse_knowledge

Size = tuple[int, int]
Maker = Callable[[Size, np.random.Generator], FloatArray]


def spectral_noise(size: Size, slope: float, generator: np.random.Generator) -> FloatArray:
    """Return noise (rows, columns), mean 0, variance 1, with the amplitude spectrum (wave number)^-slope."""
    rows, columns = size
    wave = np.hypot(np.fft.fftfreq(2 * rows)[:, None] * 2 * rows, np.fft.rfftfreq(2 * columns) * 2 * columns)
    white = np.fft.rfft2(generator.standard_normal((2 * rows, 2 * columns)))
    # The noise is cut from an array of twice the size, because opposite borders of periodic noise are equal.
    noise = np.fft.irfft2(white * np.maximum(wave, 1.0) ** -slope * (wave > 0.0))[:rows, :columns]
    return np.asarray((noise - noise.mean()) / noise.std())


def clouds(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return clouds over dark sea, with sharp or soft edges."""
    noise = spectral_noise(size, generator.uniform(1.2, 2.2), generator)
    cover = np.clip((noise - generator.normal(0.0, 0.8)) / generator.uniform(0.02, 1.0) + 0.5, 0.0, 1.0)
    bright = 0.8 + 0.1 * spectral_noise(size, 1.3, generator)
    return np.asarray(0.06 + (bright - 0.06) * cover)


def coast(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return a fractal coast of textured land and dark sea, with a few clouds in half of the pictures."""
    land = spectral_noise(size, generator.uniform(1.6, 3.0), generator) > generator.normal(0.0, 0.5)
    ground = 0.25 + 0.05 * spectral_noise(size, 1.2, generator)
    light = np.where(land, ground, generator.uniform(0.02, 0.08))
    if generator.random() < 0.5:
        light = np.maximum(light, clouds(size, generator) * (spectral_noise(size, 2.0, generator) > 1.0))
    return np.asarray(light)


def terminator(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return ground or clouds that fade into the night along a straight or curved line."""
    x, y = _turned(size, generator)
    ramp = x + generator.normal(0.0, 0.3) * y**2 - generator.uniform(-0.5, 0.5)
    ground = clouds(size, generator) if generator.random() < 0.7 else coast(size, generator)
    return np.asarray(ground * np.clip(ramp / generator.uniform(0.1, 1.5), 0.0, 1.0))


def bands(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return straight or curved stripes: cloud streets, waves, interference."""
    x, y = _turned(size, generator)
    bent = (
        x
        + generator.normal(0.0, 0.3) * y**2
        + generator.uniform(0.0, 0.05) * spectral_noise(size, 2.0, generator)
    )
    wave = np.sin(2.0 * np.pi * generator.uniform(1.0, 12.0) * bent)
    return np.asarray(np.clip(0.5 + wave * generator.uniform(0.3, 5.0), 0.05, 0.9))


def gradient(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return a smooth ramp or a vignette with faint mottling."""
    x, y = _turned(size, generator)
    ramp = x if generator.random() < 0.5 else -np.hypot(x - generator.normal(), y - generator.normal())
    ramp = (ramp - ramp.min()) / np.ptp(ramp)
    mottle = 0.03 * spectral_noise(size, 1.0, generator)
    return np.asarray(np.clip(ramp ** generator.uniform(0.5, 4.0) + mottle, 0.0, None))


def flat(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return a uniform frame, dark or bright."""
    return np.full(size, generator.uniform(0.0, 1.0))


def noise(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return noise only: white, blurred, or hot pixels on black."""
    kind = generator.integers(3)
    if kind == 2:
        return np.asarray((generator.random(size) < generator.uniform(1e-4, 0.05)).astype(float))
    white = gaussian_filter(generator.standard_normal(size), (0.0, generator.uniform(1.0, 6.0))[kind])
    return np.asarray(np.clip(0.5 + 0.2 * white / white.std(), 0.0, 1.0))


def stars(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return stars above trees, hills, a roof or a dome; these are darker or brighter than the sky."""
    rows, columns = size
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, columns), np.linspace(-1.0, 1.0, rows))
    sky = generator.uniform(0.0, 0.3) * (0.3 + 0.7 * np.clip(y, -1.0, 1.0) ** 2)
    for _ in range(generator.integers(20, 300)):
        row, column = generator.integers(2, rows - 2), generator.integers(2, columns - 2)
        sky[row - 1 : row + 2, column - 1 : column + 2] += generator.pareto(1.5) * 0.1
    kind = generator.integers(4)
    if kind == 0:
        trees = spectral_noise(size, 1.2, generator) + 4.0 * (y - generator.uniform(-0.2, 0.8))
        ground: BoolArray = trees > 0.0
    elif kind == 1:
        walk = spectral_noise((1, columns), generator.uniform(1.0, 2.0), generator)[0]
        ground = y > generator.uniform(0.0, 0.7) + generator.uniform(0.05, 0.2) * walk
    elif kind == 2:
        peak = generator.uniform(-0.6, 0.6, 2)
        ground = y > peak[1] + generator.uniform(0.2, 1.0) * np.abs(x - peak[0])
    else:
        middle, radius = generator.uniform(-0.6, 0.6), generator.uniform(0.2, 0.6)
        ground = np.hypot(x - middle, y - 0.8) < radius
        ground |= y > 0.8 + 0.02 * spectral_noise(size, 1.5, generator)
    texture = 1.0 + generator.uniform(0.05, 0.3) * spectral_noise(size, 1.0, generator)
    return np.asarray(np.where(ground, generator.uniform(0.0, 0.8) * np.clip(texture, 0.0, None), sky))


def marks(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return a logo or a test card: bars, rings and polygons on a uniform background."""
    rows, columns = size
    y, x = np.mgrid[0:rows, 0:columns] / max(size)
    light = np.full(size, generator.uniform(0.0, 0.3))
    for _ in range(generator.integers(4, 30)):
        place, turn = generator.uniform(0.0, 1.0, 2), generator.uniform(0.0, np.pi)
        along = (x - place[0]) * np.cos(turn) + (y - place[1]) * np.sin(turn)
        aside = (y - place[1]) * np.cos(turn) - (x - place[0]) * np.sin(turn)
        long, wide = generator.uniform(0.02, 0.3), generator.uniform(0.005, 0.1)
        shape = (np.abs(along) < long) & (np.abs(aside) < wide)
        if generator.random() < 0.4:
            apart = np.hypot(along, aside * generator.uniform(1.0, 2.0))
            shape = (apart < long) & (apart > long - wide)
        light[shape] = generator.uniform(0.0, 1.0)
    return light


def flares(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return the Sun's glare and its ghost images against a dark sky without the Earth."""
    rows, columns = size
    y, x = np.mgrid[0:rows, 0:columns] / max(size)
    sun, middle = generator.uniform(-0.1, 1.1, 2), np.array([0.5, 0.5])
    apart = np.hypot(x - sun[0], y - sun[1])
    light = 1.0 / (1.0 + (apart / generator.uniform(0.01, 0.15)) ** generator.uniform(1.5, 3.0))
    for _ in range(generator.integers(2, 8)):
        ghost = middle + (middle - sun) * generator.uniform(-1.0, 1.5)
        size_ = generator.uniform(0.01, 0.15)
        disc = np.clip((size_ - np.hypot(x - ghost[0], y - ghost[1])) / 0.01, 0.0, 1.0)
        light = light + generator.uniform(0.02, 0.4) * disc
    return np.asarray(light)


def day_sky(size: Size, generator: np.random.Generator) -> FloatArray:
    """Return a bright sky over darker textured ground, with hills, trees or clouds, as seen from aircraft."""
    x, y = _turned(size, generator) if generator.random() < 0.5 else _level(size)
    bend = generator.choice([0.01, 0.1]) * generator.normal() * x**2
    walk = generator.choice([0.0, 0.003, 0.01, 0.04]) * spectral_noise(
        size, generator.uniform(1.0, 2.0), generator
    )
    below = y - generator.uniform(-0.7, 0.7) + bend + walk
    haze = np.exp(-np.abs(below) / generator.uniform(0.02, 0.5))
    sky = generator.uniform(0.5, 0.9) + generator.uniform(-0.3, 0.3) * haze
    if generator.random() < 0.3:
        sky = sky + generator.uniform(0.02, 0.15) * spectral_noise(
            size, generator.uniform(1.2, 2.2), generator
        )
    texture = spectral_noise(size, generator.uniform(0.8, 1.6), generator)
    ground = generator.uniform(0.08, 0.4) * (1.0 + generator.uniform(0.05, 0.4) * texture)
    ground = ground + generator.uniform(0.0, 0.2) * haze
    soft = generator.uniform(0.002, 0.02)
    share = np.clip(0.5 + below / soft, 0.0, 1.0)
    return np.asarray(np.clip(sky + (ground - sky) * share, 0.0, None))


MAKERS: dict[str, Maker] = {
    each.__name__: each
    for each in (clouds, coast, terminator, bands, gradient, flat, noise, stars, marks, flares, day_sky)
}


def photographed(light: FloatArray, generator: np.random.Generator) -> Image:
    """Return the 8-bit image of an intensity of 0 to 1: blur, exposure, noise, nonlinear response."""
    light = gaussian_filter(light, generator.uniform(0.4, 1.2)) * generator.uniform(0.6, 1.5)
    light = light + generator.uniform(0.002, 0.02) * generator.standard_normal(light.shape)
    counts = 4.0 + 251.0 * np.clip(light, 0.0, 1.0) ** generator.uniform(0.5, 1.0)
    return np.asarray(np.rint(counts).astype(np.uint8))


def _turned(size: Size, generator: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return two coordinates (rows, columns) of about -1 to 1 in axes that are rotated at random."""
    rows, columns = size
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, columns), np.linspace(-1.0, 1.0, rows))
    turn = generator.uniform(0.0, 2.0 * np.pi)
    return x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)


def _level(size: Size) -> tuple[FloatArray, FloatArray]:
    """Return coordinates x and y (rows, columns), each from -1 to 1 across the picture."""
    rows, columns = size
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, columns), np.linspace(-1.0, 1.0, rows))
    return x, y


CAMERAS = ((512, 512, 67.0), (480, 640, 60.0), (768, 1024, 30.0), (768, 1024, 12.8), (512, 512, 100.0))
"""Rows, columns, and horizontal field of view (deg)."""
ALTITUDE = 515e3


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` pictures of each kind."""
    return [
        Case(f"{kind}-{run}", (seed, number, run), {"kind": kind})
        for number, kind in enumerate(MAKERS)
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Search one picture with each kind of prior knowledge."""
    generator = np.random.default_rng(case.seed)
    rows, columns, field = CAMERAS[generator.integers(len(CAMERAS))]
    picture = photographed(MAKERS[case.parameters["kind"]]((rows, columns), generator), generator)
    camera = Pinhole.from_field_of_view(columns, rows, np.radians(field))
    elsewhere = random_scene(generator, camera_model(), "sunlit", (ALTITUDE, ALTITUDE))
    height = float(np.linalg.norm(elsewhere.position)) - 6_371e3
    known = {"nothing": HorizonKnowledge(), "altitude": HorizonKnowledge(altitude=height)}
    known["flight"] = coarse_knowledge(elsewhere, generator)
    found = {name: find_nadir(picture, camera, knowledge) for name, knowledge in known.items()}
    answers = {name: one.status.value if one.nadir is None else "wrong" for name, one in found.items()}
    return {**case.parameters, "seed": list(case.seed), "answers": answers}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the frequency of detected horizons for each kind of picture and knowledge."""
    rows = {
        f"{kind}, {known}": Counter(result["answers"][known] for result in own)
        for kind, own in grouped(results, "kind").items()
        for known in own[0]["answers"]
    }
    wrong = [result["seed"] for result in results if "wrong" in result["answers"].values()]
    return summary({"rows": rows, "false": len(wrong), "empty": len(results), "wrong": wrong})
