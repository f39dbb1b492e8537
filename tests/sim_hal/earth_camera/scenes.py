"""Scenes for tests and campaigns: random low orbits, optionally with the horizon or the Sun in view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from sim_hal.earth_camera import EarthCameraModel, EarthScene, visible_share
from tests.support.earth_truth import limb_directions, limb_truth, sun_point

View = Literal["sunlit", "terminator", "dark", "any"]

LOW, HIGH = 200e3, 2000e3
"""Range of altitudes (m) above the equatorial radius."""
DAY, NIGHT = 0.1, -0.1
"""Cosines of the Sun's zenith distance above which a limb point is clearly lit, and below which it is dark.
"""
_MOST_DRAWS = 20_000
_LEAST_POINTS = 60
"""Number of limb points, of 720, that must be on the detector for the horizon to be in view."""


def random_direction(generator: np.random.Generator) -> FloatArray:
    """Return a random unit vector (3,), with a uniform distribution over the sphere."""
    vector = generator.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def pointing(boresight: FloatArray, down: FloatArray) -> FloatArray:
    """Return the attitude (4,) with +z along `boresight` (3,) and +y (image down) closest to `down` (3,)."""
    across = np.cross(down, boresight)
    across = across / np.linalg.norm(across)
    return quaternion.from_matrix(np.stack([across, np.cross(boresight, across), boresight]))


def limb_scene(
    altitude: float = 600e3, *, zenith: FloatArray, sun: FloatArray, dip: float = 0.0, texture: int = 0
) -> EarthScene:
    """Return a scene above `zenith` (3,) with the Sun along `sun` (3,), and a horizontal limb in the centre.

    `dip` (rad) is the angle of the boresight below the limb. The camera points to the azimuth of the Sun, or
    of the pole if the Sun is overhead.
    """
    zenith = zenith / np.linalg.norm(zenith)
    side = np.cross(zenith, sun)
    if np.linalg.norm(side) < 1e-6:
        side = np.cross(zenith, [0.0, 0.0, 1.0])
    ahead = np.cross(side / np.linalg.norm(side), zenith)
    angle = np.arcsin(SEMI_MAJOR_AXIS / (SEMI_MAJOR_AXIS + altitude)) - dip
    boresight = -np.cos(angle) * zenith + np.sin(angle) * ahead
    position = (SEMI_MAJOR_AXIS + altitude) * zenith
    distant = ASTRONOMICAL_UNIT * sun / np.linalg.norm(sun)
    return EarthScene(position, pointing(boresight, -zenith), distant, texture=texture)


def random_scene(
    generator: np.random.Generator,
    model: EarthCameraModel,
    view: View = "any",
    altitudes: tuple[float, float] = (LOW, HIGH),
    accept: Callable[[EarthScene], bool] | None = None,
) -> EarthScene:
    """Return a random scene with the horizon in view.

    `view` states the illumination of the visible limb: day, day and night, night, or any. The function
    `accept` may refuse a scene. Raises RuntimeError if no scene is found.
    """
    for _ in range(_MOST_DRAWS):
        scene = _draw(generator, model, altitudes)
        cosines = limb_truth(scene, model, count=720).solar_cosines
        if len(cosines) < _LEAST_POINTS:
            continue
        fits = {
            "sunlit": cosines.min() > DAY,
            "terminator": cosines.min() < NIGHT and cosines.max() > DAY,
            "dark": cosines.max() < NIGHT,
            "any": True,
        }[view]
        if fits and (accept is None or accept(scene)):
            return scene
    raise RuntimeError(f"no scene with {view} limb in {_MOST_DRAWS} draws")


def random_sun_scene(
    generator: np.random.Generator,
    model: EarthCameraModel,
    altitudes: tuple[float, float] = (LOW, HIGH),
    margin: float = 0.0,
) -> EarthScene:
    """Return a scene with the whole Sun at a random pixel, at least `margin` px inside the edge.

    If `margin` is negative, the Sun may be outside the frame by this number of pixels. Raises RuntimeError if
    no scene is found.
    """
    for _ in range(_MOST_DRAWS):
        size = np.array([model.columns, model.rows])
        point = generator.uniform(margin - 0.5, size - 0.5 - margin)
        ray = model.lens.unit_vectors(point[None, :])[0]
        sun = random_direction(generator)
        roll = random_direction(generator)
        # The attitude follows from two triads of vectors, in camera axes and in inertial axes. Each triad
        # consists of the Sun direction and a second direction.
        camera = _triad(ray, np.array([0.6, 0.8, 0.0]))
        attitude = quaternion.from_matrix(camera.T @ _triad(sun, roll))
        position = (SEMI_MAJOR_AXIS + generator.uniform(*altitudes)) * random_direction(generator)
        scene = EarthScene(
            position,
            attitude,
            position + ASTRONOMICAL_UNIT * sun,
            rotation=generator.uniform(0.0, 2.0 * np.pi),
        )
        if visible_share(scene) > 0.99 and np.allclose(sun_point(scene, model), point, atol=1e-3):
            return scene
    raise RuntimeError(f"no scene with the Sun in view in {_MOST_DRAWS} draws")


def _triad(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return an orthonormal triad (3, 3) whose first row is `first`."""
    across = np.cross(first, second)
    across = across / np.linalg.norm(across)
    return np.stack([first, across, np.cross(first, across)])


def _draw(
    generator: np.random.Generator, model: EarthCameraModel, altitudes: tuple[float, float]
) -> EarthScene:
    position = (SEMI_MAJOR_AXIS + generator.uniform(*altitudes)) * random_direction(generator)
    sun = ASTRONOMICAL_UNIT * random_direction(generator)
    upright = EarthScene(position, quaternion.IDENTITY, sun)
    limb, _ = limb_directions(upright, 720)
    target = limb[generator.integers(len(limb))]
    # The boresight is chosen so that the limb point is within the circle around the detector.
    aside = generator.uniform(0.0, model.lens.half_diagonal)
    boresight = np.cos(aside) * target + np.sin(aside) * _normal_to(target, generator)
    attitude = pointing(boresight, _normal_to(boresight, generator))
    return EarthScene(position, attitude, sun, rotation=generator.uniform(0.0, 2.0 * np.pi))


def _normal_to(direction: FloatArray, generator: np.random.Generator) -> FloatArray:
    normal = np.cross(direction, random_direction(generator))
    return np.asarray(normal / np.linalg.norm(normal))
