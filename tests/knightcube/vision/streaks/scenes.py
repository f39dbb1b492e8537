"""Simulated frames of the real sky with their true motion and stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro import catalogue, quaternion
from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.geometry import paths
from sim_hal.star_camera import StarCameraModel, render
from tests.support.streak_bound import RateBound, rate_bound

CAMERA = StarCameraModel()
SATURATION = float(CAMERA.highest_count)
EPOCH = 2030.0


@dataclass(frozen=True)
class Scene:
    """A frame with its true motion and its stars, brightest first.

    `stars` (n, 2) are the positions of the stars at mid-exposure, px, and `electrons` (n,) are their fluxes.
    """

    pixels: Image
    rate: FloatArray
    exposure: float
    stars: FloatArray
    electrons: FloatArray
    camera: StarCameraModel

    def bound(self, most: int = 20) -> RateBound:
        """Return the Cramer-Rao bound of the rate from the `most` brightest stars."""
        floor = self.camera.read_noise**2 + self.camera.dark_current * self.exposure + 1.0 / 12.0
        return rate_bound(
            self.camera.pinhole,
            self.stars[:most],
            self.electrons[:most],
            self.rate,
            self.exposure,
            self.camera.psf_sigma,
            floor,
        )


def turn_of(theta: float, length: float, roll: float, camera: StarCameraModel = CAMERA) -> FloatArray:
    """Return a rotation (3,), rad, about an axis `theta` rad off boresight, for streaks of `length` px."""
    pinhole = camera.pinhole
    axis = np.array([np.sin(theta) * np.cos(roll), np.sin(theta) * np.sin(roll), np.cos(theta)])
    off_axis = 0.5 * pinhole.columns / pinhole.focal_length
    share = 0.5 if theta > 0.3 else 1.0
    speed = np.hypot(np.sin(theta), share * off_axis * np.cos(theta))
    return np.asarray(axis * length / (pinhole.focal_length * speed))


def real_sky(
    seed: int,
    theta: float,
    length: float,
    exposure: float,
    camera: StarCameraModel = CAMERA,
    faintest: float = 8.5,
) -> Scene:
    """Return a random field of the real sky at a constant rate. The field depends only on the seed."""
    rng = np.random.default_rng([seed, 777])
    turn = turn_of(theta, length, rng.uniform(0.0, 2.0 * np.pi), camera)
    return taken(rng, turn, np.zeros(3), exposure, camera, faintest)


def taken(
    rng: np.random.Generator,
    turn: FloatArray,
    growth: FloatArray,
    exposure: float,
    camera: StarCameraModel = CAMERA,
    faintest: float = 8.5,
) -> Scene:
    """Return a frame of a random field at the rate turn + growth t, where `growth` is parallel to `turn`.

    With a rolling shutter, the motion continues until all rows are read.
    """
    middle = quaternion.normalise(rng.standard_normal(4))
    open_for = 1.0 + camera.rows * camera.line_time / exposure
    time = open_for * np.linspace(-0.5, 0.5, 41 if growth.any() else 3)
    vectors = time[:, None] * turn + 0.5 * time[:, None] ** 2 * growth
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(vectors), middle)
    stars = catalogue.load().brighter_than(faintest)
    directions = stars.directions_at(EPOCH)
    pixels = render(camera, directions, stars.magnitude, (time - time[0]) * exposure, attitudes, rng)
    seen = directions @ quaternion.attitude_matrix(middle).T
    front = seen[:, 2] > 0.5
    places, magnitudes = camera.pinhole.project(seen[front]), stars.magnitude[front]
    samples = np.linspace(-0.5, 0.5, 9)
    along = paths(
        camera.pinhole,
        CameraMotion(turn, growth),
        np.repeat(places, 9, axis=0),
        np.tile(samples, len(places)),
    )
    visible = camera.pinhole.contains(along.position.reshape(-1, 9, 2)).mean(axis=1) > 0.3
    electrons = camera.electrons(magnitudes[visible], exposure)
    return Scene(pixels, turn / exposure, exposure, places[visible], electrons, camera)
