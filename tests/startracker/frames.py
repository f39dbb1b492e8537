"""Frames of the simulator's star camera, at rest or turning, with the attitude at mid-exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight import catalogue
from flight.arrays import FloatArray, Image
from flight.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from flight.startracker.build import default_index
from flight.startracker.sky_index import SkyIndex
from flight.vision.bound import rate_bound
from sim_hal.star_camera import StarCameraModel, render

EPOCH = 2026.5
NARROW = StarCameraModel(field_of_view=float(np.radians(12.0)))


@dataclass(frozen=True)
class SkyFrame:
    """A frame and its truth.

    Attributes:
        attitude: (4,) at mid-exposure, ICRS to camera.
        rate: (3,) rad/s in the camera's axes.
        stars: (n, 2) px at mid-exposure, the brightest first; `electrons` (n,) of each.
    """

    pixels: Image
    camera: StarCameraModel
    attitude: FloatArray
    rate: FloatArray
    exposure: float
    stars: FloatArray
    electrons: FloatArray

    def rate_bound(self, most: int = 30) -> float:
        """Return the Cramer-Rao bound of the rate's magnitude, rad/s, from the `most` brightest stars."""
        camera = self.camera
        floor = camera.read_noise**2 + camera.dark_current * self.exposure + 1.0 / 12.0
        stars, light = self.stars[:most], self.electrons[:most]
        bound = rate_bound(camera.pinhole, stars, light, self.rate, self.exposure, camera.psf_sigma, floor)
        axis = self.rate / np.linalg.norm(self.rate)
        return float(np.sqrt(axis @ bound.covariance @ axis))


def sky() -> SkyIndex:
    """Return the default index, of the frames' epoch."""
    return default_index()


def sky_frame(
    rng: np.random.Generator, streak_px: float, exposure: float, camera: StarCameraModel = NARROW
) -> SkyFrame:
    """Return a random field of the real sky with streaks of about `streak_px` at the boresight.

    The axis is 30 to 90 deg off the boresight.
    """
    attitude = normalise(rng.standard_normal(4))
    theta, roll = rng.uniform(np.radians(30.0), np.radians(90.0)), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(theta) * np.cos(roll), np.sin(theta) * np.sin(roll), np.cos(theta)])
    turn = axis * streak_px / (camera.pinhole.focal_length * np.sin(theta))
    times = np.linspace(-0.5, 0.5, 3)
    attitudes = multiply(from_rotation_vector(times[:, None] * turn), attitude)
    stars = catalogue.load()
    pixels = render(
        camera, stars.directions_at(EPOCH), stars.magnitude, (times + 0.5) * exposure, attitudes, rng
    )
    places = camera.pinhole.project(stars.directions_at(EPOCH) @ attitude_matrix(attitude).T)
    inside = camera.pinhole.contains(places)
    electrons = camera.electrons(stars.magnitude[inside], exposure)
    return SkyFrame(pixels, camera, attitude, turn / exposure, exposure, places[inside], electrons)
