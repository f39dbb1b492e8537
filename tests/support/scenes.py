"""Simulated frames with their truth for the campaigns: real stars, random pointing, constant body rate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.catalogue import StarCatalogue, load
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from sim_hal.star_camera import StarCameraModel, render

FIELD = float(np.deg2rad(20.0))
YEAR = 2026.5
SAMPLES = 41
EXPOSURES = (0.2, 1.0)
"""Exposure times (s) of random slews."""
MOST_TURN = 0.5
"""Largest rotation of a random slew, as a fraction of the field."""
BRIGHTEST = 7000
"""Number of brightest stars that reproduces the tables of the thesis; the thesis does not state it."""
LEAST_USABLE = 5
"""Smallest number of usable stars in a random slew."""
_MOST_SKIES = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A frame with its true motion and stars.

    Attributes:
        pixels: (rows, columns).
        rate: (3,), rad/s, camera frame; `exposure` is in s.
        start, middle, end: positions (n, 2), px, of all catalogue stars near the field; NaN behind the
        camera.
        electrons: (n,), over the whole exposure; `magnitude` (n,).
        directions: (n, 3), ICRS.
        attitudes: (2, 4) at the start and the end, ICRS to camera.
    """

    pixels: Image
    rate: FloatArray
    exposure: float
    start: FloatArray
    middle: FloatArray
    end: FloatArray
    electrons: FloatArray
    magnitude: FloatArray
    directions: FloatArray
    attitudes: FloatArray


@lru_cache(maxsize=4)
def catalogue(limit: float) -> tuple[StarCatalogue, FloatArray]:
    """Return the catalogue of stars brighter than the magnitude `limit`, and their directions (n, 3)."""
    stars = load().brighter_than(limit)
    return stars, stars.directions_at(YEAR)


@lru_cache(maxsize=4)
def faintest(stars: int) -> float:
    """Return the magnitude below which the catalogue has at least `stars` stars."""
    return float(np.nextafter(np.sort(load().magnitude)[stars - 1], np.inf))


def slew(
    generator: np.random.Generator,
    theta: float,
    fraction: float,
    exposure: float,
    limit: float = 8.5,
    model: StarCameraModel | None = None,
) -> Scene:
    """Return a random sky during a rotation by `fraction` of the field, `theta` (rad) off the boresight."""
    camera = model or StarCameraModel(field_of_view=FIELD)
    azimuth = generator.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    rate = axis * fraction * camera.field_of_view / exposure
    middle = normalise(generator.normal(size=4))
    return exposed(camera, middle, rate, exposure, generator, limit)


@dataclass(frozen=True, slots=True)
class RandomSlew:
    """A random motion of a campaign; its star field is drawn when a frame is exposed.

    Attributes:
        seed: seed of the campaign; `run` is the number of the motion.
        theta: angle (deg) between the axis of rotation and the boresight.
        percent: rotation over the exposure, % of the field.
        exposure: exposure time, s.
    """

    seed: int
    run: int
    theta: float
    percent: float
    exposure: float

    @classmethod
    def drawn(cls, seed: int, run: int) -> RandomSlew:
        """Return motion number `run` of a campaign; it does not depend on the number of motions."""
        draw = np.random.default_rng((seed, run, 0))
        theta = float(np.rad2deg(draw.uniform(0.0, 0.5 * np.pi)))
        percent = float(100.0 * draw.uniform(0.0, MOST_TURN))
        return cls(seed, run, theta, percent, float(draw.choice(EXPOSURES)))

    def exposed(self, camera: StarCameraModel) -> tuple[Scene, int]:
        """Return the frame, and the number of skies drawn until one had enough usable stars."""
        generator = np.random.default_rng((self.seed, self.run, 1))
        theta, fraction = np.deg2rad(self.theta), self.percent / 100.0
        for drawn in range(1, _MOST_SKIES + 1):
            scene = slew(generator, float(theta), fraction, self.exposure, model=camera)
            if len(usable(scene, camera)) >= LEAST_USABLE:
                return scene, drawn
        raise ValueError(f"no sky in {_MOST_SKIES} with {LEAST_USABLE} usable stars for {self}")


def exposed(
    camera: StarCameraModel,
    middle: FloatArray,
    rate: FloatArray,
    exposure: float,
    generator: np.random.Generator,
    limit: float = 8.5,
) -> Scene:
    """Return a frame with the attitude `middle` (4,) at mid-exposure and a constant rate (3,), rad/s."""
    stars, directions = catalogue(limit)
    times = np.linspace(0.0, exposure, SAMPLES)
    turns = from_rotation_vector((times - 0.5 * exposure)[:, None] * rate)
    attitudes = multiply(turns, middle)
    pixels = render(camera, directions, stars.magnitude, times, attitudes, generator)
    pinhole = camera.pinhole
    reach = np.cos(pinhole.half_diagonal + 0.5 * float(np.linalg.norm(rate)) * exposure)
    near = directions @ attitude_matrix(middle)[2] > reach
    start, mid, end = (
        pinhole.project(directions[near] @ attitude_matrix(attitude).T)
        for attitude in (attitudes[0], middle, attitudes[-1])
    )
    return Scene(
        pixels=pixels,
        rate=rate,
        exposure=exposure,
        start=start,
        middle=mid,
        end=end,
        electrons=camera.electrons(stars.magnitude[near], exposure),
        magnitude=stars.magnitude[near],
        directions=directions[near],
        attitudes=attitudes[[0, -1]],
    )


def usable(scene: Scene, camera: StarCameraModel, significance: float = 8.0) -> FloatArray:
    """Return the indices of the stars that are completely in the frame and significant along their path."""
    pinhole = camera.pinhole
    inside = pinhole.contains(scene.start, -4.0) & pinhole.contains(scene.end, -4.0)
    inside &= pinhole.contains(scene.middle, -4.0)
    length = np.linalg.norm(scene.end - scene.start, axis=1)
    noise = noise_floor(camera, scene.exposure) ** 0.5
    pixels = 4.0 * camera.psf_sigma * (length + 4.0 * camera.psf_sigma)
    bright = scene.electrons > significance * noise * np.sqrt(pixels)
    return np.asarray(np.flatnonzero(inside & bright))


def noise_floor(camera: StarCameraModel, exposure: float) -> float:
    """Return the variance (e-^2) of a pixel without starlight: read noise, dark current and rounding."""
    return camera.read_noise**2 + camera.dark_current * exposure + camera.gain**2 / 12.0
