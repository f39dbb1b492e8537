"""Objects that move among the stars, drawn into the simulated frames of `frames`."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from tests.support.streak_frames import Camera, deposit, expose, random_stars, read_out

_STEPS = 801


def object_path(
    camera: Camera, direction: FloatArray, motion: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return the path (801, 2), px, of an object that rotates by `motion` (3,) rad relative to the stars.

    `direction` (3,) is the direction of the object at mid-exposure. An object whose motion equals the
    camera's `rotation` (3,) stays at one pixel.
    """
    time = np.linspace(-0.5, 0.5, _STEPS)[:, None]
    among_stars = np.swapaxes(attitude_matrix(from_rotation_vector(time * motion)), 1, 2) @ direction
    seen = attitude_matrix(from_rotation_vector(time * rotation))
    return camera.pinhole.project(np.einsum("mij,mj->mi", seen, among_stars))


def add_object(
    image: FloatArray, camera: Camera, path: FloatArray, magnitude: float, exposure: float
) -> None:
    """Add the electrons of an object, spread along `path` (m, 2), to `image` in place."""
    electrons = camera.zero_magnitude * 10.0 ** (-0.4 * magnitude) * exposure
    parts = np.array_split(path, 40)
    for part in parts:
        deposit(image, part, electrons * len(part) / len(path), camera.psf_sigma)


def motion_across(direction: FloatArray, angle: float, towards: float) -> FloatArray:
    """Return the rotation (3,) that moves `direction` (3,) by `angle` rad along a great circle.

    `towards` (rad) is the direction of motion in the image: 0 is along +x, pi/2 along +y.
    """
    step = np.array([np.cos(towards), np.sin(towards), 0.0])
    axis = np.cross(direction, step)
    return np.asarray(angle * axis / np.linalg.norm(axis))


def star_field(camera: Camera, seed: int, faintest: float = 7.0) -> tuple[FloatArray, FloatArray]:
    """Return the directions (n, 3) and magnitudes (n,) of the stars in the frames of `frame_with`."""
    return random_stars(np.random.default_rng(seed), camera.pinhole, 0.05, faintest)


def frame_with(
    camera: Camera,
    rotation: FloatArray,
    exposure: float,
    seed: int,
    objects: list[tuple[FloatArray, float]],
    faintest: float = 7.0,
) -> Image:
    """Return a frame of the star field `seed` with some objects (path, magnitude)."""
    image = expose(camera, *star_field(camera, seed, faintest), rotation, exposure)
    for path, magnitude in objects:
        add_object(image, camera, path, magnitude, exposure)
    return read_out(camera, image, exposure, np.random.default_rng([seed, 1]))
